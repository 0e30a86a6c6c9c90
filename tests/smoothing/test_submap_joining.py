"""Joined submaps against a dense least-squares solution by SciPy, and the statistics of draws."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from jaxslam.core import se2_np
from jaxslam.core.types import CORNER
from jaxslam.filtering.submaps import Submap
from jaxslam.smoothing.submap_joining import join_submaps, relative_poses
from jaxslam.smoothing.submap_terms import STD_FLOOR

ORIGINS = np.array([[0.5, 0.2, 2.9], [-4.0, 2.0, -2.2], [-6.0, -2.0, -0.7], [-1.0, -2.5, 0.4]])
LANDMARKS = np.array(
    [[-1.0, 3.0], [-3.0, 1.0], [-6.0, 1.0], [-5.0, -4.0], [-2.0, -1.0], [1.0, 1.0]]
)
HELD = [np.array([0, 5, 1]), np.array([2, 1, 3]), np.array([4, 3, 0])]  # 2, 4 and 5 are held once


def submaps_of(seed, std):
    """Three submaps with errors that are draws of their correlated covariances."""
    rng, result = np.random.default_rng(seed), []
    shape = np.random.default_rng(7)  # the covariances are the same for all seeds
    for i, index in enumerate(HELD):
        size = 3 + 2 * len(index)
        root = std * (np.eye(size) + 0.3 * shape.normal(size=(size, size)))
        exact = np.concatenate(
            [
                se2_np.relative(ORIGINS[i], ORIGINS[i + 1]),
                se2_np.inverse_transform(ORIGINS[i], LANDMARKS[index]).ravel(),
            ]
        )
        z = exact + root @ rng.normal(size=size)
        k = np.full(len(index), CORNER, np.int32)
        cov, none = root @ root.T, np.zeros(len(index))
        result.append(Submap(z[:3], z[3:].reshape(-1, 2), cov, k, k, none, none))
    return result


def guess(seed):
    rng = np.random.default_rng(seed)
    origins = ORIGINS + 0.05 * rng.normal(size=ORIGINS.shape) * [[0.0], [1.0], [1.0], [1.0]]
    return origins, LANDMARKS + 0.1 * rng.normal(size=LANDMARKS.shape)


def reference(submaps):
    """All origins but the first, and all landmarks, by dense least squares of all numbers."""

    def residuals(x):
        origins = np.concatenate([ORIGINS[:1], x[:9].reshape(3, 3)])
        landmarks, parts = x[9:].reshape(-1, 2), []
        for i, (one, index) in enumerate(zip(submaps, HELD, strict=True)):
            error = se2_np.relative(origins[i], origins[i + 1]) - one.last_pose
            error[2] = se2_np.wrap_angle(error[2])
            local = se2_np.inverse_transform(origins[i], landmarks[index]) - one.positions
            cov = one.cov + STD_FLOOR**2 * np.eye(len(one.cov))
            whole = np.concatenate([error, local.ravel()])
            parts.append(np.linalg.solve(np.linalg.cholesky(cov), whole))
        return np.concatenate(parts)

    start = np.concatenate([ORIGINS[1:].ravel(), LANDMARKS.ravel()])
    found = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    cov = np.linalg.inv(found.jac.T @ found.jac)
    return found.x[:9].reshape(3, 3), found.x[9:].reshape(-1, 2), 2 * found.cost, cov


@pytest.mark.parametrize("seed", [0, 1])
def test_joined_submaps_are_the_dense_least_squares_solution(seed):
    submaps = submaps_of(seed, 0.02)
    joined = join_submaps(submaps, HELD, *guess(seed))
    origins, landmarks, cost, cov = reference(submaps)
    np.testing.assert_array_equal(joined.origins[0], ORIGINS[0])
    np.testing.assert_allclose(joined.origins[1:, :2], origins[:, :2], atol=1e-6)
    turned = se2_np.wrap_angle(joined.origins[1:, 2] - origins[:, 2])
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)
    np.testing.assert_allclose(joined.landmark_positions, landmarks, atol=1e-6)
    assert joined.cost[-1] == pytest.approx(cost, rel=1e-4)
    # The covariance of the last origin in the frame of the first is that of the normal matrix.
    pose, found = relative_poses(joined, np.array([0]), 3)
    cos, sin = np.cos(ORIGINS[0, 2]), np.sin(ORIGINS[0, 2])
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(found[0], turn @ cov[6:9, 6:9] @ turn.T, rtol=0.02, atol=1e-9)
    np.testing.assert_allclose(pose[0], se2_np.relative(ORIGINS[0], joined.origins[3]), atol=1e-12)


def test_cost_and_relative_poses_have_the_statistics_of_their_model():
    """The cost is chi-square of `dof`, and the NEES of a relative pose of 3; 300 draws."""
    count, costs, nees = 300, [], []
    for seed in range(count):
        joined = join_submaps(submaps_of(seed, 0.003), HELD, ORIGINS, LANDMARKS)
        costs.append(joined.cost[-1])
        pose, cov = relative_poses(joined, np.array([1]), 3)
        error = pose[0] - se2_np.relative(ORIGINS[1], ORIGINS[3])
        nees.append(error @ np.linalg.solve(cov[0], error))
    assert joined.dof == 27 - 9 - 12
    for values, dof in ((costs, joined.dof), (nees, 3)):
        low, high = chi2.ppf([1e-4, 1 - 1e-4], count * dof) / count
        assert low < np.mean(values) < high


def test_a_submap_alone_stays_as_it_is():
    one = submaps_of(3, 0.02)[:1]
    joined = join_submaps(one, [np.arange(3)], *(x[: 2 + i] for i, x in enumerate(guess(3))))
    wanted = se2_np.transform(ORIGINS[0], one[0].positions)
    np.testing.assert_allclose(joined.landmark_positions, wanted, atol=1e-9)
    wanted = se2_np.compose(ORIGINS[0], one[0].last_pose)
    np.testing.assert_allclose(joined.origins[1], wanted, atol=1e-9)
    assert joined.dof == 0 and joined.cost[-1] < 1e-12


def test_what_was_computed_before_changes_nothing():
    submaps, start = submaps_of(4, 0.02), guess(4)
    index = [np.array([0, 1, 2]), np.array([3, 2, 4])]
    first = join_submaps(submaps[:2], index, start[0][:3], start[1][[0, 5, 1, 2, 3]])
    again = join_submaps(submaps, HELD, *start, previous=first)
    afresh = join_submaps(submaps, HELD, *start)
    np.testing.assert_array_equal(again.origins, afresh.origins)
    np.testing.assert_array_equal(again.landmark_positions, afresh.landmark_positions)


@pytest.mark.parametrize(
    ("index", "message"),
    [
        (HELD[:2], "landmark_index holds 2 and submaps 3"),
        ([*HELD[:2], np.array([4, 3])], r"landmark_index\[2\] is of shape \(2,\)"),
        ([*HELD[:2], np.array([4, 3, 6])], r"landmark_index\[2\] is not all of 0 to 5"),
        ([*HELD[:2], np.array([4, 3, 3])], r"landmark_index\[2\] holds a landmark twice"),
        ([*HELD[:2], np.array([1, 3, 0])], "landmark 4 is in no submap"),
    ],
)
def test_wrong_indices_are_refused(index, message):
    with pytest.raises(ValueError, match=message):
        join_submaps(submaps_of(0, 0.02), index, ORIGINS, LANDMARKS)
