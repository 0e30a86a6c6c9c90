import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.stats import chi2

from jaxslam.core import se2, time_series
from jaxslam.evaluation import consistency, trajectory
from jaxslam.io import carmen, relations, tum


def covariances(seed, count, k):
    """Well-conditioned covariances (count, k, k)."""
    a = np.random.default_rng(seed).normal(size=(count, k, k))
    return a @ a.transpose(0, 2, 1) + 0.1 * np.eye(k)


def drive(seed, count=60):
    """Times (count,) and poses (count, 3) of a wandering robot."""
    rng = np.random.default_rng(seed)
    steps = rng.normal([0.4, 0.0, 0.0], [0.1, 0.02, 0.4], (count - 1, 3))
    poses = [np.array([1.0, 2.0, 3.0])]
    for step in steps:
        poses.append(np.asarray(se2.compose(jnp.array(poses[-1]), jnp.array(step))))
    return np.sort(rng.uniform(0, count, count)), np.array(poses)


def between(a, b):
    return np.asarray(jax.vmap(se2.relative)(jnp.array(a), jnp.array(b)))


def compose(a, b):
    return np.asarray(jax.vmap(se2.compose)(jnp.array(a), jnp.array(b)))


def test_pose_error_wraps_the_heading_only():
    error = consistency.pose_error(jnp.array([[9.0, 1.0, 3.1]]), jnp.array([[1.0, 2.0, -3.1]]))
    np.testing.assert_allclose(error, [[8.0, -1.0, 6.2 - 2 * np.pi]])


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_nees_equals_solving(k):
    cov = covariances(k, 50, k)
    error = np.random.default_rng(9).normal(size=(50, k))
    expected = np.sum(error * np.linalg.solve(cov, error[..., None])[..., 0], axis=-1)
    found = jax.jit(consistency.nees)(jnp.array(error), jnp.array(cov))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(
        consistency.nees(jnp.array(error[7]), jnp.array(cov[7])), expected[7]
    )


def test_nees_in_single_precision_with_unequal_scales():
    scale = np.array([3e-2, 2.0, 1e-3])  # std of a pose known well along one direction only
    corr = np.array([[1.0, 0.99, -0.9], [0.99, 1.0, -0.9], [-0.9, -0.9, 1.0]])
    cov = corr * np.outer(scale, scale)
    error = scale * np.array([0.5, -0.4, 1.2])
    found = consistency.nees(jnp.array(error, jnp.float32), jnp.array(cov, jnp.float32))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, error @ np.linalg.solve(cov, error), rtol=1e-4)


def test_nees_of_what_is_broken_is_infinite_with_zero_gradient():
    cov = np.stack([np.eye(3)] * 5)
    error = np.ones((5, 3))
    error[0, 1] = np.nan
    cov[1, 2, 2] = np.inf
    cov[2, 0, 0] = -1.0
    cov[3] = 1.0  # singular
    found = consistency.nees(jnp.array(error), jnp.array(cov))
    np.testing.assert_array_equal(found, [np.inf] * 4 + [3.0])

    def total(error, cov):
        values = consistency.nees(error, cov)
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0.0))

    by_error, by_cov = jax.grad(total, argnums=(0, 1))(jnp.array(error), jnp.array(cov))
    np.testing.assert_array_equal(by_error, [[0.0] * 3] * 4 + [[2.0] * 3])
    assert jnp.isfinite(by_cov).all() and not by_cov[:4].any() and by_cov[4].any()


def test_nees_gradient_matches_finite_differences():
    error, cov = jnp.array([0.3, -0.2, 0.1]), jnp.array(covariances(4, 1, 3)[0])
    check_grads(lambda scale: consistency.nees(error, scale * cov), (1.3,), order=1, rtol=1e-5)


def test_rmse_ignores_what_the_mask_leaves_out():
    values, mask = jnp.array([3.0, jnp.nan, 4.0, 100.0]), jnp.array([True, False, True, False])
    np.testing.assert_allclose(consistency.rmse(values, mask), np.sqrt(12.5))
    slope = jax.grad(consistency.rmse)(values, mask)
    np.testing.assert_allclose(slope, np.array([3.0, 0.0, 4.0, 0.0]) / 2 / np.sqrt(12.5))


def test_rmse_of_nothing_and_of_no_error():
    values, none = jnp.array([1.0, 2.0]), jnp.array([False, False])
    assert jnp.isnan(consistency.rmse(values, none))
    assert not jax.grad(consistency.rmse)(values, none).any()
    zero, everything = jnp.zeros(2), jnp.array([True, True])
    assert consistency.rmse(zero, everything) == 0.0
    assert not jax.grad(consistency.rmse)(zero, everything).any()


@pytest.mark.parametrize("dof, count, probability", [(3, 1, 0.95), (3, 100, 0.95), (2, 7, 0.99)])
def test_chi_square_bounds_equal_the_quantiles(dof, count, probability):
    low, high = consistency.chi_square_bounds(dof, count, probability)
    assert low < dof < high
    np.testing.assert_allclose(chi2.cdf(low * count, dof * count), (1 - probability) / 2)
    np.testing.assert_allclose(chi2.sf(high * count, dof * count), (1 - probability) / 2)


def test_align_finds_the_motion():
    points = np.random.default_rng(1).normal(size=(30, 2)) + [5e5, 4e6]
    motion = np.array([-3.0, 7.0, 2.8])
    goal = np.asarray(se2.transform(jnp.array(motion), jnp.array(points)))
    found = trajectory.align_trajectory(points, goal)
    np.testing.assert_allclose(found[2], 2.8, atol=1e-9)
    moved = se2.transform(jnp.array(found), jnp.array(points))
    np.testing.assert_allclose(moved, goal, atol=1e-6)


def test_align_is_the_best_motion():
    rng = np.random.default_rng(2)
    points, goal = rng.normal(size=(20, 2)), rng.normal(size=(20, 2))

    def cost(motion):
        return jnp.sum((se2.transform(motion, jnp.array(points)) - goal) ** 2)

    best = jnp.array(trajectory.align_trajectory(points, goal))
    np.testing.assert_allclose(jax.grad(cost)(best), 0.0, atol=1e-9)
    assert np.linalg.eigvalsh(jax.hessian(cost)(best)).min() > 0.0


def test_align_refuses_different_shapes():
    with pytest.raises(ValueError, match=r"\(2, 2\) and \(3, 2\)"):
        trajectory.align_trajectory(np.zeros((2, 2)), np.zeros((3, 2)))


def test_match_times_pairs_nearest_once():
    times = np.array([5.0, 1.0, 1.02, 3.0, 9.0])
    reference = np.array([3.04, 1.03, 4.97, 2.0, 8.9])
    pairs = time_series.match_times(times, reference, 0.05)
    np.testing.assert_array_equal(pairs, [[0, 2], [2, 1], [3, 0]])
    assert time_series.match_times(times, np.array([])).shape == (0, 2)


def test_match_times_equals_brute_force():
    rng = np.random.default_rng(3)
    times, reference = rng.permutation(40) + rng.uniform(-0.1, 0.1, 40), rng.permutation(50) * 1.0
    gaps = np.abs(times[:, None] - reference)
    expected = [[i, gaps[i].argmin()] for i in range(40) if gaps[i].min() <= 0.06]
    np.testing.assert_array_equal(time_series.match_times(times, reference, 0.06), expected)
    assert 0 < len(expected) < 40


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


def ate_and_rpe(*given):
    """The same by this package."""
    found = trajectory.ate(*given) | trajectory.rpe(*given)
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


def test_rpe_of_a_way_too_short_is_none_and_the_distance_is_checked():
    times, poses = drive(5)
    short = trajectory.rpe(times, poses, times, poses, delta=1e3)
    assert set(short.values()) == {None}
    with pytest.raises(ValueError, match="motions 0.0 m apart"):
        trajectory.rpe(times, poses, times, poses, delta=0.0)


def test_ate_of_moved_truth_is_zero_and_other_clocks_are_told():
    times, poses = drive(7)
    moved = compose(np.tile([4.0, -2.0, 1.0], (60, 1)), poses)
    assert trajectory.ate(times, moved, times, poses)["ate_rmse_m"] < 1e-9
    with pytest.raises(ValueError, match="0 times agree within 0.05 s"):
        trajectory.ate(times + 1e6, moved, times, poses)


def relations_of(times, poses):
    """All relations between poses five apart."""
    return times[:-5], times[5:], between(poses[:-5], poses[5:])


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


def test_wheels_carry_the_estimate_on_between_scans():
    times, poses = drive(9)
    wheels = compose(np.tile([7.0, 3.0, -2.0], (60, 1)), poses)  # same motions, another frame
    found = trajectory.relation_errors(
        times[::7], poses[::7], times, wheels, relations_of(times, poses)
    )
    assert found["used"] == 55 and found["translation_mean_m"] < 1e-9
    frozen = np.tile(wheels[:1], (60, 1))
    worse = trajectory.relation_errors(
        times[::7], poses[::7], times, frozen, relations_of(times, poses)
    )
    assert worse["translation_mean_m"] > 0.1


def test_wheel_headings_are_read_across_the_cut():
    wheel_times = np.array([1.0, 0.0])
    wheels = np.array([[2.0, 0.0, -np.pi + 0.1], [1.0, 0.0, np.pi - 0.1]])
    start, halfway = np.array([[0.0, 0.0, 0.0]]), np.array([[-0.5 * np.cos(0.1), 0.0, 0.1]])
    halfway[0, 1] = -0.5 * np.sin(0.1)
    known = np.array([0.0]), np.array([0.5]), halfway
    found = trajectory.relation_errors(np.array([0.0]), start, wheel_times, wheels, known)
    assert found["translation_mean_m"] < 1e-9 and found["rotation_mean_deg"] < 1e-9


def test_relations_error_is_in_metres_and_degrees():
    times, poses = drive(10)
    t1, t2, motion = relations_of(times, poses)
    off = np.tile([0.3, 0.4, np.radians(-2.0)], (55, 1))
    off[::5] = 0.0
    off[1::2, 2] *= -1.0
    found = trajectory.relation_errors(times, poses, times, poses, (t1, t2, compose(motion, off)))
    spread = np.std([0.0] * 11 + [1.0] * 44)
    assert found["translation_mean_m"] == pytest.approx(0.4)
    assert found["translation_std_m"] == pytest.approx(0.5 * spread)
    assert found["rotation_mean_deg"] == pytest.approx(1.6)
    assert found["rotation_std_deg"] == pytest.approx(2.0 * spread)


def test_relations_outside_the_trajectory_are_left_out():
    times, poses = drive(11)
    known = relations_of(times, poses)
    found = trajectory.relation_errors(times[20:], poses[20:], times[20:], poses[20:], known)
    assert found["used"] == 35 and found["translation_mean_m"] < 1e-9
    back = known[1], known[0], between(poses[5:], poses[:-5])
    found = trajectory.relation_errors(times[20:], poses[20:], times[20:], poses[20:], back)
    assert found["used"] == 35 and found["translation_mean_m"] < 1e-9
    with pytest.raises(ValueError, match="no relation lies within"):
        trajectory.relation_errors(times + 1e6, poses, times + 1e6, poses, known)


def test_intel_reference_and_wheels_score_what_is_published(shared_data):
    folder = shared_data / "intel"
    log = carmen.read(folder / "intel.clf")
    times, poses = tum.read(folder / "intel.reference.tum")
    known = relations.read(folder / "intel.relations")
    stream = (log.odom_stream_times, log.odom_stream_poses)
    reference = trajectory.relation_errors(times, poses, *stream, known)
    wheels = trajectory.relation_errors(log.times, log.odom_poses, *stream, known)
    assert reference["used"] == wheels["used"] == 2984
    assert 0.060 < reference["translation_mean_m"] < 0.073
    assert 7.3 < wheels["translation_mean_m"] < 7.5


def test_ate_and_rpe_of_recorded_wheels_equal_evo(shared_data, tmp_path):
    log = carmen.read(shared_data / "aces" / "aces.clf")
    file = shared_data / "aces" / "aces.reference.tum"
    tum.write(tmp_path / "wheels.tum", log.times, log.odom_poses)
    found = ate_and_rpe(log.times, log.odom_poses, *tum.read(file))
    expected = by_evo(tmp_path / "wheels.tum", file)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert expected[-1] == 440
