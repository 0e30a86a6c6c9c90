"""Loop closures in the batch problem, beside SciPy's least squares."""

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares
from smoothing_problems import assert_same, drive, pack, residuals, unpack

from jaxslam.core import se2
from jaxslam.core.se2_np import relative
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.smoothing.loop_closure_factors import closure_residuals
from jaxslam.smoothing.sparse import smooth_log


def random_closures(poses, rng):
    """Loop closures that are a little off, and of a random information each."""
    first, second = np.array([0, 2, 1]), np.array([5, 6, 7])
    relative_pose = relative(poses[first], poses[second]) + 0.05 * rng.normal(size=(3, 3))
    root = np.eye(3) * 8.0 + rng.normal(size=(3, 3, 3))
    return LoopClosures(first, second, relative_pose, root @ root.swapaxes(1, 2))


def test_residuals_of_closures_and_their_derivatives_are_right():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(8, 3)) * [3.0, 3.0, 2.0]
    closures = random_closures(poses, rng)
    residual, by_first, by_second = closure_residuals(poses, closures)
    error = (
        jax.vmap(se2.relative)(poses[closures.first], poses[closures.second])
        - closures.relative_pose
    )
    square = np.einsum("ci,cij,cj->c", error, closures.information, error)
    np.testing.assert_allclose(np.sum(residual**2, axis=1), square, rtol=1e-9)
    for index, jacobian in ((closures.first, by_first), (closures.second, by_second)):
        for k in range(3):
            moved = poses.copy()
            moved[index, k] += 1e-6
            change = (closure_residuals(moved, closures)[0] - residual) / 1e-6
            np.testing.assert_allclose(jacobian[..., k], change, atol=1e-4)


def test_a_smoothed_log_with_closures_is_that_of_scipy():
    problem, poses, positions = drive(1)
    poses, closures = (
        np.asarray(poses),
        random_closures(np.asarray(poses), np.random.default_rng(1)),
    )
    problem = jax.tree.map(np.asarray, problem)
    found = smooth_log(problem, poses, positions, loop_closures=closures, robust_scale=np.inf)

    def both(x):
        state = unpack(x)
        return np.append(residuals(problem, *state), closure_residuals(state[0], closures)[0])

    start = pack(found.poses, found.landmark_positions)
    best = least_squares(both, start, "3-point", max_nfev=20)
    assert_same(found, unpack(best.x), 1e-4)
    np.testing.assert_allclose(found.cost[-1], 2 * best.cost, rtol=1e-5)
    plain = smooth_log(problem, poses, positions, robust_scale=np.inf)
    assert np.abs(plain.poses - found.poses).max() > 1e-3


def test_closures_are_weighted_by_the_cauchy_kernel():
    problem, poses, positions = drive(1)
    poses, closures = (
        np.asarray(poses),
        random_closures(np.asarray(poses), np.random.default_rng(1)),
    )
    problem = jax.tree.map(np.asarray, problem)
    # Of no feature, which would have the kernel too.
    problem = problem._replace(landmark_index=np.full_like(problem.landmark_index, -1))
    found = smooth_log(problem, poses, positions, loop_closures=closures, robust_scale=1.5)

    def both(x):
        state = unpack(x)
        size = np.linalg.norm(closure_residuals(state[0], closures)[0], axis=1)
        return np.append(residuals(problem, *state), 1.5 * np.sqrt(np.log1p((size / 1.5) ** 2)))

    start = pack(found.poses, found.landmark_positions)
    best = least_squares(both, start, "3-point", max_nfev=20)
    assert_same(found, unpack(best.x), 2e-3)
    np.testing.assert_allclose(found.cost[-1], 2 * best.cost, rtol=1e-5)


def test_the_kernel_bounds_the_effect_of_a_wrong_closure():
    problem, poses, positions = drive(1)
    poses = np.asarray(poses)
    closures = random_closures(poses, np.random.default_rng(1))
    true = relative(poses[closures.first], poses[closures.second])
    right = closures._replace(relative_pose=true)
    wrong = closures._replace(relative_pose=true + np.array([[0.0] * 3, [0.0] * 3, [3.0, 0, 0]]))

    def smooth(closures, scale):
        return smooth_log(problem, poses, positions, loop_closures=closures, robust_scale=scale)

    def error(scale):
        return np.abs(smooth(wrong, scale).poses - smooth(right, scale).poses).max()

    assert error(3.0) < 0.2 * error(np.inf)


@pytest.mark.parametrize(
    "field, wrong, message",
    [
        ("first", np.array([0, 2, -1]), "loop_closures.first holds -1 to 2, not 0 to 11"),
        ("second", np.array([5, 6, 12]), "loop_closures.second holds 5 to 12, not 0 to 11"),
        ("second", np.array([5, 6]), r"loop_closures.second is .*\(2,\), not .*\(3,\)"),
        ("first", np.zeros(3), r"loop_closures.first is float64 \(3,\), not integer"),
        ("relative_pose", np.zeros((3, 2)), r"loop_closures.relative_pose is .*\(3, 2\), not"),
        ("information", np.zeros((3, 3)), r"loop_closures.information is .*\(3, 3\), not"),
    ],
)
def test_wrong_closures_are_refused_by_name(field, wrong, message):
    problem, poses, positions = drive(1)
    closures = random_closures(np.asarray(poses), np.random.default_rng(1))
    closures = closures._replace(**{field: wrong})
    with pytest.raises(ValueError, match=message):
        smooth_log(problem, poses, positions, loop_closures=closures)
