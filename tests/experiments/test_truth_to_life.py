"""Measures of drives and counterparts of robots, each against what it must be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import counterparts, drive_measures, truth_to_life
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import dead_reckoning, increments
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import init
from jaxslam.simulation import life_defaults
from jaxslam.simulation.scanners import pieces
from tests.landmark_drives import CONFIG, PARAMS, drive

LIDAR = Lidar(num_beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=20.0)
WALLS = np.array([[4.0, -30.0, 4.0, 30.0]])


def wall_ranges(num_scans, std=0.0, seed=0):
    """Ranges (T, R) of a wall 4 m ahead, with noise."""
    angles = LIDAR.angle_min + LIDAR.angle_increment * np.arange(LIDAR.num_beams)
    with np.errstate(divide="ignore"):
        exact = np.where(np.abs(angles) < 1.3, 4.0 / np.cos(angles), np.inf)
    return exact + std * np.random.default_rng(seed).normal(size=(num_scans, LIDAR.num_beams))


def test_the_square_of_a_feature_alone_is_that_of_the_filter():
    """With one update a step, the filter's NIS is that of its one feature."""
    _, measurements = drive(jax.random.key(0), steps=30)
    config = CONFIG._replace(max_updates=1)
    start = init(config, jnp.zeros(3))
    found = drive_measures.nis_by_feature(config, PARAMS, start, measurements)
    nis, used = map(np.asarray, found)
    _, info = slam_filter.run_filter(config, PARAMS, start, measurements)
    np.testing.assert_array_equal(used, info.used)
    assert int(used.sum()) >= 28
    np.testing.assert_allclose((nis * used).sum(axis=1), info.nis, rtol=1e-6, atol=1e-9)


def test_roughness_is_the_noise_of_ranges_on_a_wall():
    found = drive_measures.roughness(LIDAR, wall_ranges(200, std=0.01))
    assert found == pytest.approx(0.01, rel=0.06)  # the median of a root is a little less


def test_ranges_are_compared_with_the_walls():
    """One beam in ten does not return, one in ten is a metre short, one in ten a metre long."""
    ranges = wall_ranges(50)
    number = np.broadcast_to(np.arange(LIDAR.num_beams), ranges.shape)
    given = ranges + np.where(number % 10 == 1, -1.0, 0.0) + np.where(number % 10 == 2, 1.0, 0.0)
    hit = np.isfinite(ranges) & (number % 10 > 0)
    scans = Scan(np.where(hit, given, 20.0), hit)
    found = drive_measures.range_numbers(LIDAR, scans, np.zeros((50, 3)), WALLS)
    beams = np.isfinite(ranges[0])
    meets = np.abs(LIDAR.angle_min + LIDAR.angle_increment * np.arange(181)) < np.arccos(0.2)
    assert found["missing"] == pytest.approx(1.0 - hit.mean())
    expected = (meets & ~hit[0]).sum() / meets.sum()
    assert found["missing_at_wall"] == pytest.approx(expected, abs=0.02)
    both = beams & hit[0]
    for name, rest in (("short", 1), ("long", 2)):
        assert found[name] == pytest.approx((both & (number[0] % 10 == rest)).sum() / both.sum())
    assert found["range_std_m"] < 1e-3


def test_the_errors_of_wheels_are_found():
    """Factors within 5 standard errors or so; one turn in twenty far off is an outlier."""
    rng = np.random.default_rng(0)
    count, std = 4000, 0.02
    read = np.column_stack(
        [np.full(count, 0.5), np.zeros(count), rng.choice([0.0, 0.2, -0.2], count)]
    )
    rolled = 0.5 + counterparts.WHEEL_BASE / 2 * np.abs(read[:, 2])
    turn = 1.05 * read[:, 2] + 0.03 * read[:, 0]
    turn += std * np.sqrt(rolled) * rng.normal(size=count)
    turn[::20] += 0.5
    true = np.column_stack([1.02 * read[:, 0], np.zeros(count), turn])
    zero = np.zeros((1, 3))
    poses, odom = (dead_reckoning(zero[0], np.vstack([zero, x])) for x in (true, read))
    wheels = counterparts.fit_wheels(poses, odom)
    assert wheels.distance == pytest.approx(1.02, abs=1e-6)
    assert wheels.turn == pytest.approx(1.05, abs=0.02)
    assert wheels.turn_per_metre == pytest.approx(0.03, abs=0.01)
    assert wheels.turn_std == pytest.approx(std, rel=0.12)
    assert wheels.outliers == pytest.approx(0.05, abs=0.01)
    robot = counterparts.robot_of(
        counterparts.scanner_of("hall", LIDAR), wheels._replace(outliers=0)
    )
    assert robot.encoder_noise * 2**0.5 / robot.wheel_base == pytest.approx(wheels.turn_std)


def test_a_counterpart_without_errors_drives_and_scans_as_the_log():
    """Ahead to the wall, with exact wheels and ranges: its odometry and ranges are the log's."""
    steps = np.tile([0.1, 0.0, 0.0], (12, 1)) * np.r_[0.0, np.ones(11)][:, None]
    poses = dead_reckoning(np.zeros(3), steps)
    times = 0.5 * np.arange(12)
    ranges = wall_ranges(12)
    log = LaserLog.from_arrays(times, poses, ranges, LIDAR)
    counterpart = counterparts.counterpart_of("hall", log, poses, WALLS)
    np.testing.assert_allclose(
        counterpart.velocities[1:-1], np.tile([0.2, 0, 0], (10, 1)), atol=1e-9
    )
    scanner = counterpart.robot.scanner
    assert scanner.turn_time == 1 / 75 and scanner.num_turns == 1
    quiet = scanner._replace(range_noise=pieces((0.0, 0.0, 0.0)), turn_time=None)
    robot = counterpart.robot._replace(scanner=quiet, encoder_noise=0.0)
    found = counterparts.simulate(jax.random.key(0), counterpart._replace(robot=robot), None)
    np.testing.assert_allclose(increments(found.odom_poses), increments(poses), atol=1e-9)
    middle = slice(40, 141)
    error = found.ranges[0, middle] - ranges[0, middle]
    assert np.abs(error).max() <= 0.005 + 1e-6  # its resolution


def test_what_is_asked_for_is_on_the_line_between_both_simulations():
    """Half of the further short ranges: half of the people; a shared error by its square."""
    base = {"short": 0.01, "missing_at_wall": 0.0, "residual_median_m": 0.003}
    typical = {"short": 0.03, "missing_at_wall": 0.04, "residual_median_m": 0.005}
    log = {"short": 0.02, "missing_at_wall": 0.06, "residual_median_m": np.sqrt(17e-6)}
    found = truth_to_life.asked_for(log, base, typical)
    assert found["people_per_metre"] == pytest.approx(life_defaults.PEOPLE_PER_METRE / 2)
    assert found["black"] == pytest.approx(1.5 * life_defaults.RANGES.black)
    assert found["shared_std"] == pytest.approx(life_defaults.RANGES.shared_std / np.sqrt(2))
    assert truth_to_life.asked_for(base, base, typical)["black"] == 0.0


def test_a_figure_is_drawn_of_rows_with_and_without_numbers(tmp_path):
    recorded = {name: 2.0 for name in truth_to_life.TARGETS} | {"walls_nis": None}
    rows = []
    for log in ("intel", "aces"):
        rows.append({"log": log, "variant": "recorded", "measures": recorded})
        for variant in (*truth_to_life.VARIANTS, truth_to_life.LEFT_OUT):
            found = {name: 1.0 for name in recorded} | {"ate_rmse_m": 0.1}
            own = truth_to_life.ratios(found, recorded)
            assert own == {name: 0.5 for name in truth_to_life.TARGETS} | {"walls_nis": None}
            rows.append({"log": log, "variant": variant, "measures": found, "ratios": own})
            assert "nis 0.50" in truth_to_life.line(rows[-1])
    truth_to_life.draw({"rows": rows}, tmp_path / "life.png")
    assert (tmp_path / "life.png").stat().st_size > 10_000


def test_a_folder_without_the_logs_is_refused(tmp_path, capsys):
    out = str(tmp_path / "out")
    assert truth_to_life.main(["--out", out, "--data", str(tmp_path)]) == 2
    assert "none of the logs intel, aces" in capsys.readouterr().err
