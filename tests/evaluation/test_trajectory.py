import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2
from jaxslam.core.se2_np import compose, relative, transform
from jaxslam.evaluation import trajectory
from jaxslam.io import carmen, relations, tum


def drive(seed, count=60):
    """Times (count,) and poses (count, 3) of a wandering robot."""
    rng = np.random.default_rng(seed)
    increments = rng.normal([0.4, 0.0, 0.0], [0.1, 0.02, 0.4], (count - 1, 3))
    poses = [np.array([1.0, 2.0, 3.0])]
    for increment in increments:
        poses.append(compose(poses[-1], increment))
    return np.sort(rng.uniform(0, count, count)), np.array(poses)


def test_align_trajectory_finds_the_transform():
    points = np.random.default_rng(1).normal(size=(30, 2)) + [5e5, 4e6]
    motion = np.array([-3.0, 7.0, 2.8])
    goal = transform(motion, points)
    found = trajectory.align_trajectory(points, goal)
    np.testing.assert_allclose(found[2], 2.8, atol=1e-9)
    moved = transform(np.asarray(found), points)
    np.testing.assert_allclose(moved, goal, atol=1e-6)


def test_align_trajectory_is_least_squares():
    rng = np.random.default_rng(2)
    points, goal = rng.normal(size=(20, 2)), rng.normal(size=(20, 2))

    def cost(motion):
        return jnp.sum((se2.transform(motion, jnp.array(points)) - goal) ** 2)

    best = jnp.array(trajectory.align_trajectory(points, goal))
    np.testing.assert_allclose(jax.jit(jax.grad(cost))(best), 0.0, atol=1e-9)
    assert np.linalg.eigvalsh(jax.jit(jax.hessian(cost))(best)).min() > 0.0


@pytest.mark.parametrize(
    "estimate, reference, problem",
    [
        (np.zeros((2, 2)), np.zeros((3, 2)), r"reference is float64 \(3, 2\), not \(2, 2\)"),
        (np.zeros((2, 3)), np.zeros((2, 3)), r"estimate is float64 \(2, 3\), not \(N, 2\)"),
        (np.zeros((0, 2)), np.zeros((0, 2)), "estimate is empty"),
        ("here", np.zeros((2, 2)), "estimate is .*, not numbers"),
    ],
)
def test_align_trajectory_names_the_argument_that_does_not_fit(estimate, reference, problem):
    with pytest.raises(ValueError, match=problem):
        trajectory.align_trajectory(estimate, reference)


def by_evo(estimate_file, reference_file):
    """ATE [m] and RPE [m], [deg] over 1 m by the evo package, which reads the files itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from evo.core import metrics as evo_metrics
        from evo.core import sync
        from evo.tools import file_interface

        estimate = file_interface.read_tum_trajectory_file(str(estimate_file))
        reference = file_interface.read_tum_trajectory_file(str(reference_file))
        reference, estimate = sync.associate_trajectories(reference, estimate, max_diff=0.05)
        estimate.align(reference, correct_scale=False)
        kinds = evo_metrics.PoseRelation
        how = {"delta": 1.0, "delta_unit": evo_metrics.Unit.meters, "pairs_from_reference": True}
        errors = (
            evo_metrics.APE(kinds.translation_part),
            evo_metrics.RPE(kinds.translation_part, **how),
            evo_metrics.RPE(kinds.rotation_angle_deg, **how),
        )
        for error in errors:
            error.process_data((reference, estimate))
        rmse = evo_metrics.StatisticsType.rmse
        return *(error.get_statistic(rmse) for error in errors), estimate.num_poses


def ate_and_rpe(*trajectories):
    """The same by this package."""
    found = trajectory.ate(*trajectories) | trajectory.rpe(*trajectories)
    names = "ate_rmse_m", "rpe_translation_rmse_m", "rpe_rotation_rmse_deg", "matched"
    return tuple(found[name] for name in names)


def test_ate_and_rpe_equal_evo(tmp_path):
    times, poses = drive(5)
    rng = np.random.default_rng(6)
    moved = compose(np.tile([4.0, -2.0, 1.0], (60, 1)), poses)
    estimate = moved + rng.normal(0, 0.3, moved.shape)
    tum.write(tmp_path / "truth.tum", times, poses)
    tum.write(tmp_path / "estimate.tum", times[5:] + 0.01, estimate[5:])
    found = ate_and_rpe(times[5:] + 0.01, estimate[5:], times, poses)
    expected = by_evo(tmp_path / "estimate.tum", tmp_path / "truth.tum")
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert expected[-1] == 55 and 0.1 < expected[0] < 1.0


def test_rpe_of_a_trajectory_too_short_is_none():
    times, poses = drive(5)
    short = trajectory.rpe(times, poses, times, poses, delta=1e3)
    assert set(short.values()) == {None}


TWO = np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"times": [0.0, 1.0, 2.0]}, r"poses is float64 \(2, 3\), not \(3, 3\)"),
        ({"times": np.zeros((2, 1))}, r"times is float64 \(2, 1\), not \(N,\)"),
        ({"times": ["a", "b"]}, "times is .*, not numbers"),
        ({"times": [], "poses": np.zeros((0, 3))}, "times is empty"),
        ({"poses": np.zeros((2, 2))}, r"poses is float64 \(2, 2\), not \(2, 3\)"),
        ({"poses": [[0, 0, 0], [1]]}, "poses is not an array: its parts differ in shape"),
        ({"ref_poses": np.zeros((3, 3))}, r"ref_poses is float64 \(3, 3\), not \(2, 3\)"),
        ({"ref_times": [], "ref_poses": []}, "ref_times is empty"),
        ({"tolerance": -1.0}, "tolerance is -1.0, not a number of seconds >= 0"),
    ],
)
@pytest.mark.parametrize("function", [trajectory.ate, trajectory.rpe])
def test_ate_and_rpe_name_the_argument_that_does_not_fit(function, wrong, problem):
    given = dict(zip(("times", "poses", "ref_times", "ref_poses"), TWO * 2, strict=True))
    with pytest.raises(ValueError, match=problem):
        function(**{**given, **wrong})


def test_rpe_refuses_a_delta_that_is_not_positive():
    with pytest.raises(ValueError, match="delta is 0.0, not a positive number of metres"):
        trajectory.rpe(*TWO, *TWO, delta=0.0)


def test_lists_numpy_and_jax_arrays_give_the_same_errors():
    times, poses = (np.round(x * 256) / 256 for x in drive(5))
    reference, moved = (times, poses), poses + [0.5, 0.25, 0.125]
    known = [x[:1] for x in relations_of(times, poses)]
    known[2] = np.round(known[2] * 256) / 256
    want = trajectory.ate(times, moved, *reference) | trajectory.rpe(times, moved, *reference)
    want |= trajectory.relation_errors(times, moved, times, poses, tuple(known))
    for convert in (np.ndarray.tolist, np.float32, jnp.asarray, lambda x: jnp.asarray(x, "f4")):
        given = convert(times), convert(moved), convert(times), convert(poses)
        found = trajectory.ate(*given) | trajectory.rpe(*given)
        found |= trajectory.relation_errors(*given, tuple(map(convert, known)))
        assert found == want


def test_ate_of_moved_truth_is_zero_and_other_clocks_are_refused():
    times, poses = drive(7)
    moved = compose(np.tile([4.0, -2.0, 1.0], (60, 1)), poses)
    assert trajectory.ate(times, moved, times, poses)["ate_rmse_m"] < 1e-9
    with pytest.raises(ValueError, match="0 times agree with ref_times within 0.05 s"):
        trajectory.ate(times + 1e6, moved, times, poses)


def relations_of(times, poses):
    """All relations between poses five apart."""
    return times[:-5], times[5:], relative(poses[:-5], poses[5:])


def test_relations_of_the_truth_have_no_error_in_any_order():
    times, poses = drive(8)
    mixed = np.random.default_rng(0).permutation(60)
    frozen = np.zeros((60, 3))  # no help: each pose must be found by its own time
    rounded = times[mixed] + 1e-6
    found = trajectory.relation_errors(
        rounded, poses[mixed], times, frozen, relations_of(times, poses)
    )
    assert found["used"] == 55
    assert found["translation_mean_m"] < 1e-9 and found["rotation_mean_deg"] < 1e-9


def test_odometry_extends_the_estimate_between_scans():
    times, poses = drive(9)
    odometry = compose(np.tile([7.0, 3.0, -2.0], (60, 1)), poses)  # same motions, another frame
    found = trajectory.relation_errors(
        times[::7], poses[::7], times, odometry, relations_of(times, poses)
    )
    assert found["used"] == 55 and found["translation_mean_m"] < 1e-9
    frozen = np.tile(odometry[:1], (60, 1))
    worse = trajectory.relation_errors(
        times[::7], poses[::7], times, frozen, relations_of(times, poses)
    )
    assert worse["translation_mean_m"] > 0.1


def test_odometry_headings_are_interpolated_across_the_cut():
    odom_times = np.array([1.0, 0.0])
    odom_poses = np.array([[2.0, 0.0, -np.pi + 0.1], [1.0, 0.0, np.pi - 0.1]])
    start, halfway = np.array([[0.0, 0.0, 0.0]]), np.array([[-0.5 * np.cos(0.1), 0.0, 0.1]])
    halfway[0, 1] = -0.5 * np.sin(0.1)
    known = np.array([0.0]), np.array([0.5]), halfway
    found = trajectory.relation_errors(np.array([0.0]), start, odom_times, odom_poses, known)
    assert found["translation_mean_m"] < 1e-9 and found["rotation_mean_deg"] < 1e-9


def test_relation_errors_are_in_metres_and_degrees():
    times, poses = drive(10)
    t1, t2, true = relations_of(times, poses)
    off = np.tile([0.3, 0.4, np.radians(-2.0)], (55, 1))
    off[::5] = 0.0
    off[1::2, 2] *= -1.0
    found = trajectory.relation_errors(times, poses, times, poses, (t1, t2, compose(true, off)))
    std = np.std([0.0] * 11 + [1.0] * 44)
    assert found["translation_mean_m"] == pytest.approx(0.4)
    assert found["translation_std_m"] == pytest.approx(0.5 * std)
    assert found["rotation_mean_deg"] == pytest.approx(1.6)
    assert found["rotation_std_deg"] == pytest.approx(2.0 * std)


def test_relations_outside_the_trajectory_are_left_out():
    times, poses = drive(11)
    known = relations_of(times, poses)
    found = trajectory.relation_errors(times[20:], poses[20:], times[20:], poses[20:], known)
    assert found["used"] == 35 and found["translation_mean_m"] < 1e-9
    back = known[1], known[0], relative(poses[5:], poses[:-5])
    found = trajectory.relation_errors(times[20:], poses[20:], times[20:], poses[20:], back)
    assert found["used"] == 35 and found["translation_mean_m"] < 1e-9
    with pytest.raises(ValueError, match="no relation lies within"):
        trajectory.relation_errors(times + 1e6, poses, times + 1e6, poses, known)


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"odom_poses": np.zeros((1, 3))}, r"odom_poses is float64 \(1, 3\), not \(2, 3\)"),
        ({"odom_times": [], "odom_poses": []}, "odom_times is empty"),
        ({"poses": np.zeros((3, 3))}, r"^poses is float64 \(3, 3\), not \(2, 3\)"),
        ({"relations": np.zeros(3)}, "relations is not a tuple of t1, t2 and relative poses"),
        ({"relations": ([], [], [])}, "relations is empty"),
        ({"relations": ([0.0], [0.0, 1.0], [])}, r"relations t2 is float64 \(2,\), not \(1,\)"),
        ({"relations": ([0.0], [1.0], [0.0])}, r"relative_pose is float64 \(1,\), not \(1, 3\)"),
    ],
)
def test_relation_errors_names_the_argument_that_does_not_fit(wrong, problem):
    given = dict(zip(("times", "poses", "odom_times", "odom_poses"), TWO * 2, strict=True))
    given["relations"] = ([0.0], [1.0], [[1.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match=problem):
        trajectory.relation_errors(**{**given, **wrong})


def test_intel_reference_and_odometry_score_what_is_published(shared_data):
    folder = shared_data / "intel"
    log = carmen.read(folder / "intel.clf")
    times, poses = tum.read(folder / "intel.reference.tum")
    known = relations.read(folder / "intel.relations")
    stream = (log.odom_stream_times, log.odom_stream_poses)
    reference = trajectory.relation_errors(times, poses, *stream, known)
    odometry = trajectory.relation_errors(log.times, log.odom_poses, *stream, known)
    assert reference["used"] == odometry["used"] == 2984
    assert 0.060 < reference["translation_mean_m"] < 0.073
    assert 7.3 < odometry["translation_mean_m"] < 7.5


def test_ate_and_rpe_of_recorded_odometry_equal_evo(shared_data, tmp_path):
    log = carmen.read(shared_data / "aces" / "aces.clf")
    file = shared_data / "aces" / "aces.reference.tum"
    tum.write(tmp_path / "odometry.tum", log.times, log.odom_poses)
    found = ate_and_rpe(log.times, log.odom_poses, *tum.read(file))
    expected = by_evo(tmp_path / "odometry.tum", file)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert expected[-1] == 440
