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
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.linalg import SuperLU

from jaxslam.core import se2_np
from jaxslam.core.types import AnyArray, as_count, as_float64
from jaxslam.filtering.submaps import Submap, point_rows
from jaxslam.smoothing.sparse import CONVERGED, MAX_HALVINGS, factorise

STD_FLOOR = 1e-4
"""[m], [rad] std added to each number of a submap: that of the pose of a robot at rest is zero."""


class Restricted(NamedTuple):
    """A submap restricted to what others hold too: s numbers, of the last pose and k landmarks.

    Attributes:
        held: (k,) int which of the landmarks of the submap they are.
        mean: (s,) z_s.
        information: (s, s) P_ss^-1.
    """

    held: np.ndarray
    mean: np.ndarray
    information: np.ndarray


class JoinedSubmaps(NamedTuple):
    """N submaps joined; NumPy, float64, map frame.

    Attributes:
        origins: (N + 1, 3) [m, m, rad] poses of the frames of the submaps; the last is that of the
            next submap, where the robot is.
        landmark_positions: (L, 2) [m].
        cost: (iterations + 1,) squared Mahalanobis norm of all residuals, the guess's first.
        dof: Degrees of freedom: expectation of the cost where all correspondences are right.
        factors: SuperLU factors of the normal matrix, of origins 1..N first, as last linearised.
        restricted: Of each submap, for the next time that it is joined.
    """

    origins: np.ndarray
    landmark_positions: np.ndarray
    cost: np.ndarray
    dof: int
    factors: SuperLU
    restricted: tuple[Restricted, ...]


Terms = list[tuple[Restricted, np.ndarray]]
"""Of each submap the numbers that others hold too, and (k,) indices of its shared landmarks."""

State = tuple[np.ndarray, np.ndarray]
"""Origins (N + 1, 3) and shared landmarks (K, 2)."""


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
    times = _times_held(submaps, landmark_index, len(positions))
    shared = np.flatnonzero(times > 1)
    number = np.full(len(positions), -1)
    number[shared] = np.arange(len(shared))
    known = () if previous is None else previous.restricted
    terms: Terms = []
    for i, (submap, index) in enumerate(zip(submaps, landmark_index, strict=True)):
        held = np.flatnonzero(number[index] >= 0)
        same = i < len(known) and np.array_equal(known[i].held, held)
        terms.append((known[i] if same else _restrict(submap, held), number[index[held]]))
    state, costs, factors = _minimise(terms, (origins, positions[shared]), max_iterations)
    positions = _all_positions(submaps, landmark_index, terms, number, state)
    restricted = tuple(one for one, _ in terms)
    dof = sum(len(one.mean) for one in restricted) - 3 * num_submaps - 2 * len(shared)
    return JoinedSubmaps(state[0], positions, np.array(costs), dof, factors, restricted)


def _times_held(
    submaps: Sequence[Submap], landmark_index: Sequence[np.ndarray], num_landmarks: int
) -> np.ndarray:
    """Number (L,) of submaps that hold each landmark; ValueError where an index is wrong."""
    times = np.zeros(num_landmarks, int)
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
        times[index] += 1
    if num_landmarks and times.min() == 0:
        raise ValueError(f"landmark {times.argmin()} is in no submap")
    return times


def _restrict(submap: Submap, held: np.ndarray) -> Restricted:
    """The marginal of a submap of its last pose and of some landmarks (k,)."""
    rows = np.concatenate([np.arange(3), point_rows(held)])
    mean = np.concatenate([submap.last_pose, submap.positions[held].reshape(-1)])
    cov = submap.cov[np.ix_(rows, rows)] + STD_FLOOR**2 * np.eye(len(rows))
    root, failed = lapack.dpotrf(cov, lower=1)
    if failed:
        raise ValueError("the covariance of a submap is not positive definite")
    half, _ = lapack.dpotri(root, lower=1)
    return Restricted(held, mean, np.tril(half) + np.tril(half, -1).T)


def _residual(
    term: Restricted, origin: np.ndarray, following: np.ndarray, landmarks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residual (s,) h - z of one submap, and R^T (2, 2)."""
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    turn = np.array([[cos, sin], [-sin, cos]])
    residual = np.empty(len(term.mean))
    residual[:2] = turn @ (following[:2] - origin[:2])
    residual[2] = following[2] - origin[2]
    residual[3:] = ((landmarks - origin[:2]) @ turn.T).reshape(-1)
    residual -= term.mean
    residual[2] = se2_np.wrap_angle(residual[2])
    return residual, turn


def _jacobian(term: Restricted, residual: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Jacobian (s, 6 + 2 k) of a residual by the submap's origin, the next, and the landmarks.

    With (x, y) a point in the frame of the submap, its derivative by the frame's heading is
    (y, -x).
    """
    size = len(residual)
    jacobian = np.zeros((size, size + 3))
    value = residual + term.mean
    xy = np.append(np.arange(2), np.arange(3, size)).reshape(-1, 2)  # rows of points
    jacobian[xy[:, :, None], (xy + 3)[:, None, :]] = turn
    jacobian[xy, 0], jacobian[xy, 1] = -turn[:, 0], -turn[:, 1]
    jacobian[xy[:, 0], 2], jacobian[xy[:, 1], 2] = value[xy[:, 1]], -value[xy[:, 0]]
    jacobian[2, [2, 5]] = -1.0, 1.0
    return jacobian


def _linearise(terms: Terms, state: State) -> tuple[np.ndarray, sparse.csc_array]:
    """Half the gradient and the normal matrix, of origins 1..N and shared landmarks."""
    origins, landmarks = state
    size, first = 3 * len(origins) - 3 + landmarks.size, 3 * len(origins) - 3
    values, rows, columns, gradient = [], [], [], np.zeros(size)
    for i, (term, index) in enumerate(terms):
        residual, turn = _residual(term, origins[i], origins[i + 1], landmarks[index])
        at = np.append(np.arange(3 * i - 3, 3 * i + 3), first - 3 + point_rows(index))
        jacobian = _jacobian(term, residual, turn)
        if i == 0:  # its origin is known
            at, jacobian = at[3:], jacobian[:, 3:]
        weighted = term.information @ jacobian
        gradient[at] += residual @ weighted
        values.append((jacobian.T @ weighted).ravel())
        rows.append(np.repeat(at, len(at)))
        columns.append(np.tile(at, len(at)))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return gradient, sparse.csc_array(entries, shape=(size, size))


def _cost(terms: Terms, state: State) -> float:
    """Squared Mahalanobis norm of all residuals."""
    origins, landmarks, cost = *state, 0.0
    for i, (term, index) in enumerate(terms):
        residual, _ = _residual(term, origins[i], origins[i + 1], landmarks[index])
        cost += residual @ term.information @ residual
    return float(cost)


def _minimise(
    terms: Terms, state: State, max_iterations: int
) -> tuple[State, list[float], SuperLU]:
    """Gauss-Newton; the state, the cost after each step, and factors of the last normal matrix."""
    costs, split = [_cost(terms, state)], state[0].size - 3
    for _ in range(max_iterations):
        gradient, matrix = _linearise(terms, state)
        factors = factorise(matrix)
        step = factors.solve(-gradient)
        poses = np.append(np.zeros(3), step[:split]).reshape(-1, 3)
        for fraction in 0.5 ** np.arange(MAX_HALVINGS + 1):
            new = state[0] + fraction * poses, state[1] + fraction * step[split:].reshape(-1, 2)
            cost = _cost(terms, new)
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


def _all_positions(
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    terms: Terms,
    number: np.ndarray,
    state: State,
) -> np.ndarray:
    """Positions (L, 2) of all landmarks, from those that are shared and the origins."""
    origins, shared = state
    positions = np.zeros((len(number), 2))
    positions[number >= 0] = shared
    for i, (submap, index) in enumerate(zip(submaps, landmark_index, strict=True)):
        alone = np.flatnonzero(number[index] < 0)
        if len(alone) == 0:
            continue
        term, of_shared = terms[i]
        residual, _ = _residual(term, origins[i], origins[i + 1], shared[of_shared])
        rows = np.append(np.arange(3), point_rows(term.held))
        cross = submap.cov[point_rows(alone)[:, None], rows]
        moved = submap.positions[alone] + (cross @ (term.information @ residual)).reshape(-1, 2)
        positions[index[alone]] = se2_np.transform(origins[i], moved)
    return positions


def relative_poses(
    joined: JoinedSubmaps, first: np.ndarray, second: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of one frame relative to others, with covariance.

    Args:
        joined: Submaps that were joined.
        first: (C,) int indices of the frames 0..N relative to which it is.
        second: Index of the frame.

    Returns:
        (C, 3) [m, m, rad] and (C, 3, 3).
    """
    columns = np.unique(np.append(first, second))
    cov = _origin_cov(joined, columns)
    of_second = np.searchsorted(columns, second)
    relative = se2_np.relative(joined.origins[first], joined.origins[second])
    result = np.empty((len(first), 3, 3))
    for c, (index, pose) in enumerate(zip(np.searchsorted(columns, first), relative, strict=True)):
        cos, sin = np.cos(joined.origins[first[c], 2]), np.sin(joined.origins[first[c], 2])
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        by_first = -turn
        by_first[:2, 2] = pose[1], -pose[0]
        at = np.concatenate([3 * index + np.arange(3), 3 * of_second + np.arange(3)])
        jacobian = np.concatenate([by_first, turn], axis=1)
        result[c] = jacobian @ cov[np.ix_(at, at)] @ jacobian.T
    return relative, result


def _origin_cov(joined: JoinedSubmaps, index: np.ndarray) -> np.ndarray:
    """Covariance (3 K, 3 K) of the origins of frames (K,) int; zero of the first frame."""
    rows = (3 * index[:, None] + np.arange(3)).reshape(-1) - 3
    known = rows < 0
    right = np.zeros((joined.factors.shape[0], len(rows)))
    right[rows[~known], np.flatnonzero(~known)] = 1.0
    cov = joined.factors.solve(right)[rows]
    cov[known] = 0.0
    return (cov + cov.T) / 2
