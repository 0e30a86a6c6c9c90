"""Joins submaps: poses of their frames and all landmarks, from the Gaussians of the submaps.

Each submap i is one measurement, of the next submap's origin and of its landmarks in its own frame,
with the covariance P_i that the filter has computed (`filtering.submaps`). With R_i and t_i the
rotation and position of its origin o_i in the map frame,

    minimise  sum_i | h_i - z_i |^2_P_i      h_i = (o_i^-1 o_i+1,  R_i^T (l_k - t_i) of its k)

Submaps have no measurement in common, so their errors are independent, and the sum counts each
once. A landmark that several submaps hold is one unknown. What only one submap holds is left out of
the sum: the marginal of a Gaussian is a block of its covariance. It follows in the end,

    l_u = z_u + P_us P_ss^-1 (h_s - z_s)     of the shared numbers s, in the frame of the submap

which is the minimum of the whole sum. The normal matrix is sparse: a submap ties only what it
holds. Gauss-Newton on the host, double precision, SuperLU. Nothing of a submap is linearised anew
but the pose of its frame: the Jacobians of the filter stay as they were taken in it.

References:
    Huang, Wang, Dissanayake (2008), Sparse local submap joining filter for building large-scale
    maps. Huang, Wang, Frese, Dissanayake (2012), On the number of local minima to the point feature
    based SLAM problem.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import SuperLU

from jaxslam.core import se2_np
from jaxslam.core.types import AnyArray, as_count, as_float64
from jaxslam.filtering.submaps import Submap
from jaxslam.smoothing.sparse import CONVERGED, MAX_HALVINGS, factorise
from jaxslam.smoothing.submap_terms import (
    Columns,
    Restricted,
    State,
    Term,
    columns_of,
    costs_of,
    linearise,
    make_terms,
    moved,
    place_others,
    times_held,
)


class JoinedSubmaps(NamedTuple):
    """N submaps joined; NumPy, float64, map frame.

    Attributes:
        origins: (N + 1, 3) [m, m, rad] poses of the frames of the submaps; the last is that of the
            next submap, where the robot is.
        landmark_positions: (L, 2) [m].
        cost: (iterations + 1,) squared Mahalanobis norm of all residuals, the guess's first.
        dof: Degrees of freedom: expectation of the cost where all correspondences are right.
        factors: SuperLU factors of the normal matrix, of origins 1..N first, as last linearised;
            None where a window was solved (`submap_window`), of which are then cost and dof.
        restricted: Of each submap, for the next time that it is joined.
    """

    origins: np.ndarray
    landmark_positions: np.ndarray
    cost: np.ndarray
    dof: int
    factors: SuperLU | None
    restricted: tuple[Restricted, ...]


def join_submaps(
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    origins: AnyArray,
    landmark_positions: AnyArray,
    *,
    previous: JoinedSubmaps | None = None,
    max_iterations: int = 20,
) -> JoinedSubmaps:
    """Maximum a posteriori origins and landmarks of N consecutive submaps, from a guess.

    Args:
        submaps: N submaps, in order; each begins where the one before ends.
        landmark_index: For each the index 0..L-1 (n,) int of its landmarks; no index twice.
        origins: (N + 1, 3) [m, m, rad] guess, map frame; the first is known and stays.
        landmark_positions: (L, 2) [m] guess, map frame.
        previous: The first of these submaps joined, if they were: what did not change of them is
            not computed again.
        max_iterations: Largest number of Gauss-Newton steps.

    Raises:
        ValueError: There is no submap, lengths or shapes do not fit, an index is out of range or
            twice in one submap, a landmark is in no submap, or a covariance is not positive
            definite.
    """
    num_submaps = len(submaps)
    if num_submaps == 0 or len(landmark_index) != num_submaps:
        raise ValueError(
            f"landmark_index holds {len(landmark_index)} and submaps {num_submaps}, not 1 or more "
            "of each"
        )
    origins = as_float64("origins", origins, (num_submaps + 1, 3))
    positions = as_float64("landmark_positions", landmark_positions, ("L", 2))
    max_iterations = as_count("max_iterations", max_iterations)
    _check_index(submaps, landmark_index, len(positions))
    times = times_held(landmark_index, len(positions))
    if len(times) and times.min() == 0:
        raise ValueError(f"landmark {times.argmin()} is in no submap")
    known = () if previous is None else previous.restricted
    terms = make_terms(submaps, landmark_index, range(num_submaps), times > 1, known)
    columns = columns_of(np.arange(num_submaps + 1) > 0, times > 1)
    state, costs, factors = minimise(terms, (origins, positions), columns, max_iterations)
    positions = state[1].copy()
    place_others(submaps, landmark_index, terms, state, positions)
    restricted = tuple(term.restricted for term in terms)
    dof = sum(len(one.mean) for one in restricted) - columns.size
    return JoinedSubmaps(state[0], positions, np.array(costs), dof, factors, restricted)


def _check_index(
    submaps: Sequence[Submap], landmark_index: Sequence[np.ndarray], num_landmarks: int
) -> None:
    """Raise ValueError where an index of a landmark is wrong."""
    for i, (submap, index) in enumerate(zip(submaps, landmark_index, strict=True)):
        if np.shape(index) != (len(submap.positions),):
            raise ValueError(
                f"landmark_index[{i}] is of shape {np.shape(index)}, and submap {i} has "
                f"{len(submap.positions)} landmarks"
            )
        if len(index) and not 0 <= np.min(index) <= np.max(index) < num_landmarks:
            raise ValueError(f"landmark_index[{i}] is not all of 0 to {num_landmarks - 1}")
        if len(np.unique(index)) < len(index):
            raise ValueError(f"landmark_index[{i}] holds a landmark twice")


def minimise(
    terms: Sequence[Term], state: State, columns: Columns, max_iterations: int
) -> tuple[State, list[float], SuperLU]:
    """Gauss-Newton; the state, the cost after each step, and factors of the last normal matrix."""
    costs = [float(costs_of(terms, state).sum())]
    for _ in range(max_iterations):
        gradient, matrix = linearise(terms, state, columns)
        factors = factorise(matrix)
        step = factors.solve(-gradient)
        for fraction in 0.5 ** np.arange(MAX_HALVINGS + 1):
            new = moved(state, fraction * step, columns)
            cost = float(costs_of(terms, new).sum())
            if cost <= costs[-1]:
                break
        else:
            break
        state = new
        costs.append(cost)
        if costs[-2] - cost <= CONVERGED * costs[-2]:
            break
    origins = state[0].copy()
    origins[1:, 2] = se2_np.wrap_angle(origins[1:, 2])
    return (origins, state[1]), costs, factors


def relative_poses(
    joined: JoinedSubmaps, first: np.ndarray, second: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of one frame relative to others, with covariance.

    Args:
        joined: Submaps that were joined, all of them.
        first: (C,) int indices of the frames 0..N relative to which it is.
        second: Index of the frame.

    Returns:
        (C, 3) [m, m, rad] and (C, 3, 3).

    Raises:
        ValueError: Only a window of the submaps was solved.
    """
    if joined.factors is None:
        raise ValueError("joined has no factors: only a window of the submaps was solved")
    columns = np.arange(-3, 3 * len(joined.origins) - 3).reshape(-1, 3)
    columns[0] = -1
    return relative_poses_of(joined.origins, joined.factors, columns, first, second)


def relative_poses_of(
    origins: np.ndarray, factors: SuperLU, columns: np.ndarray, first: np.ndarray, second: int
) -> tuple[np.ndarray, np.ndarray]:
    """As `relative_poses`, of origins (N + 1, 3) that have columns (N + 1, 3) in the factors."""
    frames = np.unique(np.append(first, second))
    rows = columns[frames].reshape(-1)
    unknown = np.flatnonzero(rows >= 0)
    right = np.zeros((factors.shape[0], len(rows)))
    right[rows[unknown], unknown] = 1.0
    cov = np.zeros((len(rows), len(rows)))
    cov[unknown] = factors.solve(right)[rows[unknown]]
    cov = (cov + cov.T) / 2
    of_second = np.searchsorted(frames, second)
    relative = se2_np.relative(origins[first], origins[second])
    result = np.empty((len(first), 3, 3))
    for c, (index, pose) in enumerate(zip(np.searchsorted(frames, first), relative, strict=True)):
        cos, sin = np.cos(origins[first[c], 2]), np.sin(origins[first[c], 2])
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        by_first = -turn
        by_first[:2, 2] = pose[1], -pose[0]
        at = np.concatenate([3 * index + np.arange(3), 3 * of_second + np.arange(3)])
        jacobian = np.concatenate([by_first, turn], axis=1)
        result[c] = jacobian @ cov[np.ix_(at, at)] @ jacobian.T
    return relative, result
