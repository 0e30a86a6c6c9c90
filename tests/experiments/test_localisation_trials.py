import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import localisation, localisation_batch, localisation_drives, particle_filter
from experiments.localisation_drives import MappedLog, make_drives, truth_by_nearest
from experiments.localisation_metrics import Tracks, found_at, reliability, split, summary
from experiments.log_folder import Log
from experiments.particle_filter import ParticleSpec
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, relative
from jaxslam.matching.place_index import PlaceIndex

INF = np.inf


def tracks(error, driven=None, probability=None, exists=None, inside=None):
    """Tracks whose headings are right, from lists (B, T)."""
    error = np.asarray(error, float)
    everywhere = np.ones(error.shape, bool)
    driven = np.arange(error.shape[1]) if driven is None else driven
    probability = np.zeros(error.shape) if probability is None else np.asarray(probability)
    return Tracks(
        error,
        np.zeros(error.shape),
        probability,
        probability > 0.9,
        np.broadcast_to(np.asarray(driven, float), error.shape),
        everywhere if exists is None else np.asarray(exists),
        everywhere if inside is None else np.asarray(inside),
    )


def test_a_robot_is_found_where_it_stays_right_for_ten_metres():
    error = np.full((5, 15), 1.0)
    error[0, 3:] = 0.1
    error[1, 2:] = 0.1
    error[1, 6] = 0.3  # wrong again
    error[2, 2:11] = 0.1  # wrong only after 10 m
    error[3, 8:12] = 0.1  # of 5 m more it is right for 3
    np.testing.assert_array_equal(found_at(tracks(error)), [3.0, 7.0, 2.0, INF, INF])
    outside = np.ones((5, 15), bool)
    outside[1, 6] = False  # where the map does not show it, it need not be right
    np.testing.assert_array_equal(found_at(tracks(error, inside=outside))[:2], [3.0, 2.0])
    shorter = np.arange(15) < [[15], [15], [15], [12], [15]]
    assert found_at(tracks(error, exists=shorter))[3] == 8.0  # to the end


def test_summary_counts_starts_and_steps():
    error = [[1.0, 0.1, 0.1, 0.1], [0.2, 0.2, 0.2, 0.2], [1.0, 1.0, 1.0, 0.4]]
    probability = [[0.95, 0.95, 0.5, 0.95], [0.5, 0.5, 0.5, 0.95], [0.5, 0.5, 0.99, 0.99]]
    exists = [[True] * 4, [True] * 4, [True] * 3 + [False]]
    found = summary(tracks(error, [0.0, 2.0, 4.0, 6.0], probability, exists))
    assert found["found_at_m"] == [2.0, 0.0, None]
    assert found["found_within_5_m"] == pytest.approx(2 / 3)
    assert found["sure_within_5_m"] == pytest.approx(1 / 3)
    assert (found["sure"], found["wrong_but_sure"], found["drives_wrong_but_sure"]) == (5, 2, 2)
    assert found["found_at_95_m"] is None and found["found_at_median_m"] == 2.0
    assert found["position_m"][0] == 0.1 and found["position_m"][-1] == 0.2
    low, high = found["wrong_but_sure_interval"]
    assert low < 2 / 5 < high
    nothing = summary(tracks([[1.0]], probability=[[0.0]]))
    assert nothing["wrong_but_sure_share"] is None and nothing["position_m"] is None


def test_reliability_is_calibrated_where_probabilities_are_true():
    rng = np.random.default_rng(3)
    probability = rng.uniform(0.0, 1.0, (50, 200))
    error = np.where(rng.uniform(size=probability.shape) < probability, 0.1, 1.0)
    rows = reliability(tracks(error, probability=probability))
    assert sum(row["steps"] for row in rows) == probability.size
    for row in rows:
        p = row["probability"]
        assert abs(row["right"] - p) < 4 * np.sqrt(p * (1 - p) / row["steps"])


def test_drives_are_split_where_the_robot_is_carried():
    error = np.arange(8.0).reshape(2, 4)
    before, after = split(tracks(error), np.array([1, 4]))
    np.testing.assert_array_equal(before.exists, [[True] + [False] * 3, [True] * 4])
    np.testing.assert_array_equal(after.exists, [[True] * 3 + [False], [False] * 4])
    np.testing.assert_array_equal(after.position_error[0, :3], error[0, 1:])
    np.testing.assert_array_equal(after.driven[0, :3], [0.0, 1.0, 2.0])


def test_truth_is_the_nearest_pose_of_the_map_and_the_motion_from_there():
    """The map is that of the first half, moved as a whole and broken between two scans."""
    rng = np.random.default_rng(4)
    first = np.column_stack([np.arange(6.0), np.zeros((6, 2))])
    moves = np.array([[3.0, 1.0, 0.4]] * 3 + [[3.5, 1.0, 0.4]] * 3)
    mapped = np.stack([compose(a, b) for a, b in zip(moves, first, strict=True)])
    mapped[1] = np.nan
    nearest = np.array([0, 2, 3, 5])
    off = rng.uniform(-0.2, 0.2, (4, 3))
    far = np.array([[20.0, 3.0, 0.0], [2.0, 0.0, 2.0], [np.nan] * 3])
    reference = np.concatenate([first, compose(first[nearest], off), far])
    truth, inside = truth_by_nearest(reference, mapped)
    np.testing.assert_allclose(relative(mapped[nearest], truth[6:10]), off, atol=1e-12)
    assert inside[:10].all() and not inside[10:].any()
    assert np.isnan(truth[-1]).all()


def mapped_log(count=120):
    """A log along a line, half of which is in the map; without a map."""
    lidar = Lidar(4, -np.pi / 2, np.pi / 4, 10.0, 0.0)
    odometry = np.tile([0.5, 0.0, 0.0], (count, 1))
    truth = np.column_stack([0.5 * np.arange(count), np.zeros((count, 2))])
    scans = Scan(np.ones((count, 4), np.float32), np.ones((count, 4), bool))
    scans.ranges[:, 0] = np.arange(count)
    in_map = np.arange(count) < count // 2
    inside = np.arange(count) < 75
    return MappedLog(lidar, scans, odometry, None, truth, inside, in_map)


def test_drives_are_of_scans_that_follow_each_other():
    mapped = mapped_log()
    drives = make_drives(mapped, localisation_drives.OWN, 30, np.random.default_rng(0))
    number = np.arange(drives.numbers.shape[1])[None]
    begins = (number == 0) | (number == drives.carried_at[:, None])
    jumps = np.diff(drives.numbers, axis=1) != 1
    assert not (jumps & ~begins[:, 1:])[drives.exists[:, 1:]].any()
    np.testing.assert_array_equal(drives.odometry[..., 0] == 0.0, begins)
    assert (drives.carried_at == 30).all()  # 15 m
    scans, odometry = localisation_drives.scans_of(mapped, drives, slice(3, 5))
    np.testing.assert_array_equal(scans.ranges[..., 0], drives.numbers[3:5])
    assert odometry.dtype == np.float32


def test_drives_of_the_second_half_begin_where_the_map_shows_five_metres():
    mapped, rng = mapped_log(), np.random.default_rng(0)
    half = make_drives(mapped, localisation_drives.HALF, 200, rng)
    outside = make_drives(mapped, localisation_drives.OUTSIDE, 200, rng)
    # Of 11 scans in 5 m at least 6 are among the first 75; 15 m are ahead.
    assert set(half.numbers[:, 0]) == set(range(60, 70))
    assert set(outside.numbers[:, 0]) == set(range(70, 89))
    everywhere = mapped._replace(in_map=np.ones(120, bool))
    assert make_drives(everywhere, localisation_drives.HALF, 5, rng) is None


def test_low_variance_resampling_takes_each_particle_floor_or_ceil_times():
    rng = np.random.default_rng(1)
    weights = rng.exponential(size=40)
    weights /= weights.sum()
    mean, starts = np.zeros(40), np.linspace(0.0, 1.0, 200, endpoint=False)
    for start in starts:
        found = particle_filter.resample(jnp.asarray(weights), jnp.asarray(start), 100)
        times = np.bincount(found, minlength=40)
        assert times.sum() == 100 and (np.abs(times - 100 * weights) < 1 + 1e-9).all()
        mean += times / len(starts)
    np.testing.assert_allclose(mean, 100 * weights, atol=0.011)


def test_the_weight_of_a_particle_is_that_of_the_slow_version():
    rng = np.random.default_rng(2)
    lidar = Lidar(7, -1.0, 1 / 3, 8.0, 0.0)
    spec = ParticleSpec(num_particles=5, num_beams=4)
    field = jnp.asarray(rng.uniform(0, 0.6, (60, 50)))
    none = jnp.zeros(0)
    index = PlaceIndex(jnp.array([-1.0, -2.0]), field, none, none, none, none, none)
    place_map = localisation.PlaceMap(index, none, jnp.array(6.0))
    ranges, hit = rng.uniform(0.5, 4, 7), np.array([True, True, False, True, False, True, True])
    ranges[4] = 7.0  # beyond the reach of the map's scanner
    poses = rng.uniform(-0.5, 2, (5, 3))
    expected = []
    for x, y, heading in poses:
        product = 1.0
        for beam in (0, 2, 4, 6):
            if not hit[beam] or ranges[beam] >= 6.0:
                continue
            angle = heading - 1.0 + beam / 3
            i = round((x + ranges[beam] * np.cos(angle) + 1.0) / 0.1)
            j = round((y + ranges[beam] * np.sin(angle) + 2.0) / 0.1)
            d = float(field[np.clip(i, 0, 59), np.clip(j, 0, 49)])
            p = spec.z_hit * np.exp(-(d**2) / (2 * spec.sigma_hit**2)) + spec.z_rand / 6.0
            product *= p / (spec.z_hit + spec.z_rand / 6.0)
        expected.append(product**spec.tempering)
    scan = Scan(jnp.asarray(ranges), jnp.asarray(hit))
    found = particle_filter._weights(spec, lidar, place_map, jnp.asarray(poses), scan)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_particle_filter_finds_most_robots_in_the_office():
    place_map = localisation_batch.office_map()
    poses, scans, odometry = localisation_batch.office_drives(8, 20, 3)
    spec = ParticleSpec(num_particles=4000)
    run = jax.jit(
        lambda place_map, items: jax.lax.map(
            lambda item: particle_filter.run_drive(
                spec, localisation_batch.LIDAR, place_map, *item
            ),
            items,
        )
    )
    found = run(place_map, (scans, jnp.asarray(odometry), jax.random.split(jax.random.key(0), 8)))
    off = relative(poses, np.asarray(found.pose))
    right = (np.hypot(off[..., 0], off[..., 1]) < 0.25) & (np.abs(off[..., 2]) < np.radians(5))
    assert right[:, -1].sum() >= 6
    assert right[:, -1].sum() > right[:, 0].sum()


def test_logs_without_a_reference_and_numbers_below_one_are_refused(tmp_path, monkeypatch, capsys):
    lidar = Lidar(32, -np.pi / 2, np.pi / 32, 20.0, 0.02)
    laser_log = LaserLog.from_arrays(np.arange(4), np.zeros((4, 3)), np.ones((4, 32)), lidar)
    log = Log("hall", tmp_path, laser_log, None, None)
    monkeypatch.setattr(localisation.log_folder, "find_logs", lambda *_, **__: [log])
    assert localisation.main(["--out", str(tmp_path / "out")]) == 2
    assert "no log with a reference trajectory" in capsys.readouterr().err
    for flag in ("--starts", "--batch"):
        assert localisation.main(["--out", str(tmp_path / "out"), flag, "0"]) == 2
