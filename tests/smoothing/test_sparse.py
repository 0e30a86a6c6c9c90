"""The sparse smoother, beside the dense one, and beside SciPy's least squares with its kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from smoothing_problems import KINDS, L, T, assert_same, drive, pack, residuals, unpack

from jaxslam.core.types import WALL
from jaxslam.smoothing.dense import smooth_trial
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem
from jaxslam.smoothing.sparse import smooth_log


@pytest.mark.parametrize("seed", range(2))
def test_without_a_kernel_it_finds_what_the_dense_one_finds(seed):
    given = drive(seed)
    expected = jax.tree.map(np.asarray, smooth_trial(*given, iterations=10))
    found = smooth_log(*given, robust_scale=np.inf)
    assert_same(found, expected, 1e-5)
    np.testing.assert_allclose(found.cost[[0, -1]], expected.cost[[0, -1]], rtol=1e-6)
    assert np.all(np.diff(found.cost) <= 0.0)


def test_outliers_are_weighted_by_the_cauchy_kernel():
    problem, poses, positions = drive(1)
    measured = np.array(problem.measurement)
    measured[3, :2] += 0.4  # two that are not what they were taken for
    problem = jax.tree.map(np.asarray, problem._replace(measurement=measured))
    found = smooth_log(problem, poses, positions, robust_scale=2.0)
    # The kernel is on the norm of a feature: a row that is as long as the root of rho.
    sizes = [1 if KINDS[i] == WALL else 2 for row in problem.landmark_index for i in row if i >= 0]
    counts = [np.count_nonzero(row >= 0) for row in problem.landmark_index]

    def robust(x):
        white, out, size = residuals(problem, *unpack(x)), [], iter(sizes)
        first = 0
        for count in counts:
            out.append(white[first : first + 3])
            first += 3
            for n in (next(size) for _ in range(count)):
                norm = np.linalg.norm(white[first : first + n])
                out.append([2.0 * np.sqrt(np.log1p(norm**2 / 4.0))])
                first += n
        return np.concatenate([*out, white[first:]])

    start = pack(found.poses, found.landmark_positions)
    best = least_squares(robust, start, "3-point", xtol=1e-14, ftol=1e-14, max_nfev=20)
    assert_same(found, unpack(best.x), 2e-3)
    np.testing.assert_allclose(found.cost[-1], 2 * best.cost, rtol=1e-5)
    least = smooth_log(problem, poses, positions, robust_scale=np.inf)
    right = smooth_log(drive(1)[0], poses, positions, robust_scale=2.0)
    error, error_of_least_squares = (
        np.abs(result.poses[:, :2] - right.poses[:, :2]).max() for result in (found, least)
    )
    assert error < 0.5 * error_of_least_squares


def test_a_problem_in_single_precision_is_smoothed_in_double():
    given = drive(0)
    single = jax.tree.map(lambda x: np.asarray(x, np.float32 if x.dtype == float else None), given)
    with jax.enable_x64(False):
        found = smooth_log(*single)
    assert found.poses.dtype == found.landmark_positions.dtype == np.float64
    assert_same(found, smooth_log(*given), 1e-3)


def test_padding_is_invisible():
    problem, poses, positions = jax.tree.map(np.asarray, drive(0))
    alone = smooth_log(problem, poses, positions)

    def more(x, n, fill):
        return np.concatenate([x, np.full((n, *x.shape[1:]), fill, x.dtype)])

    q = np.concatenate([problem.odometry_cov, np.tile(np.eye(3), (3, 1, 1))])
    longer = problem._replace(
        odometry=more(problem.odometry, 3, 0.0),
        odometry_cov=q,
        measurement=more(problem.measurement, 3, 0.0),
        measurement_cov=more(problem.measurement_cov, 3, 0.0),
        kind=more(problem.kind, 3, 0),
        landmark_index=more(problem.landmark_index, 3, -1),
        prior=LandmarkPrior(*(more(x, 4, 0.0) for x in problem.prior)),
    )
    padded = smooth_log(longer, np.append(poses, poses[[-1] * 3], axis=0), more(positions, 4, 0.0))
    np.testing.assert_allclose(padded.cost, alone.cost, rtol=1e-9)
    cut = padded._replace(poses=padded.poses[:T], landmark_positions=padded.landmark_positions[:L])
    assert_same(cut, alone, 1e-9)


def test_a_guess_without_a_cost_is_given_back():
    problem, poses, positions = jax.tree.map(np.asarray, drive(0))
    found = smooth_log(problem._replace(odometry=np.full((T, 3), np.nan)), poses, positions)
    np.testing.assert_allclose(found.poses[:, :2], poses[:, :2])
    assert found.cost.shape == (1,)


def test_lists_numpy_and_jax_give_the_same():
    problem, poses, positions = jax.tree.map(np.asarray, drive(2))
    expected = smooth_log(problem, poses, positions)
    lists = [x.tolist() for x in problem[:-1]]
    prior = LandmarkPrior(*(x.tolist() for x in problem.prior))
    to_list = SmoothingProblem(*lists, prior), poses.tolist(), positions.tolist()
    for given in (to_list, jax.tree.map(jnp.asarray, (problem, poses, positions))):
        jax.tree.map(np.testing.assert_array_equal, smooth_log(*given), expected)


def test_wrong_arguments_are_refused_by_name():
    problem, poses, positions = drive(0)
    with pytest.raises(ValueError, match="robust_scale is 0, not a positive"):
        smooth_log(problem, poses, positions, robust_scale=0)
    with pytest.raises(ValueError, match="max_iterations is 1.5, not a whole number"):
        smooth_log(problem, poses, positions, max_iterations=1.5)
    with pytest.raises(ValueError, match=r"poses is .*\(12, 2\), not"):
        smooth_log(problem, poses[:, :2], positions)
    with pytest.raises(ValueError, match=r"problem.measurement is .*, not .*\(12, 5, 2\)"):
        smooth_log(problem._replace(measurement=np.zeros((12, 5))), poses, positions)
    with pytest.raises(ValueError, match="problem is a tuple, not a SmoothingProblem"):
        smooth_log(tuple(problem), poses, positions)
    with pytest.raises(ValueError, match="loop_closures is a list, not LoopClosures"):
        smooth_log(problem, poses, positions, loop_closures=[])
