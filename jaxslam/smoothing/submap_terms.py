"""Terms of the sum that joins submaps: residuals, Jacobians and the normal matrix, of all or some.

See `submap_joining` for the sum. A state is all origins and all landmarks of the map. `Columns` say
which numbers of it are unknown: all of them, or those of a window, while the others stay.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import lapack

from jaxslam.core import se2_np
from jaxslam.filtering.submaps import Submap, point_rows

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


class Term(NamedTuple):
    """One submap in the sum.

    Attributes:
        submap: Its index.
        restricted: Its numbers that others hold too.
        landmarks: (k,) int indices of these landmarks in the map.
    """

    submap: int
    restricted: Restricted
    landmarks: np.ndarray


State = tuple[np.ndarray, np.ndarray]
"""Origins (N + 1, 3) and landmarks (L, 2)."""


class Columns(NamedTuple):
    """Columns of the unknown numbers in the normal matrix, -1 where a number is known.

    Attributes:
        origins: (N + 1, 3) int.
        landmarks: (L, 2) int.
        size: Number of unknowns.
    """

    origins: np.ndarray
    landmarks: np.ndarray
    size: int


def columns_of(origins: np.ndarray, landmarks: np.ndarray) -> Columns:
    """Columns of the origins and landmarks that are unknown, masks (N + 1,) and (L,) bool."""
    split, size = 3 * int(origins.sum()), 2 * int(landmarks.sum())
    result = np.full((len(origins), 3), -1), np.full((len(landmarks), 2), -1)
    result[0][origins] = np.arange(split).reshape(-1, 3)
    result[1][landmarks] = split + np.arange(size).reshape(-1, 2)
    return Columns(*result, split + size)


def times_held(landmark_index: Sequence[np.ndarray], num_landmarks: int) -> np.ndarray:
    """Number (L,) of submaps that hold each landmark."""
    return np.bincount(np.concatenate(landmark_index), minlength=num_landmarks)


def make_terms(
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    chosen: Sequence[int] | np.ndarray,
    is_shared: np.ndarray,
    known: Sequence[Restricted],
) -> list[Term]:
    """Terms of the chosen submaps.

    Args:
        submaps: All submaps.
        landmark_index: For each the index (n,) of its landmarks in the map.
        chosen: Indices of the submaps.
        is_shared: (L,) bool whether several submaps hold a landmark.
        known: Of the first submaps what was computed before; used where it still fits.

    Raises:
        ValueError: A covariance is not positive definite.
    """
    result = []
    for i in chosen:
        held = np.flatnonzero(is_shared[landmark_index[i]])
        same = i < len(known) and np.array_equal(known[i].held, held)
        one = known[i] if same else restrict(submaps[i], held)
        result.append(Term(int(i), one, landmark_index[i][held]))
    return result


def restrict(submap: Submap, held: np.ndarray) -> Restricted:
    """The marginal of a submap of its last pose and of some landmarks (k,)."""
    rows = np.concatenate([np.arange(3), point_rows(held)])
    mean = np.concatenate([submap.last_pose, submap.positions[held].reshape(-1)])
    cov = submap.cov[np.ix_(rows, rows)] + STD_FLOOR**2 * np.eye(len(rows))
    _, information, failed = lapack.dposv(cov, np.eye(len(rows)), lower=1)
    if failed:
        raise ValueError("the covariance of a submap is not positive definite")
    return Restricted(held, mean, 0.5 * (information + information.T))


def residual_of(term: Term, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Residual (s,) h - z of one submap, and R^T (2, 2)."""
    origin, following = state[0][term.submap], state[0][term.submap + 1]
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    turn = np.array([[cos, sin], [-sin, cos]])
    residual = np.empty(len(term.restricted.mean))
    residual[:2] = turn @ (following[:2] - origin[:2])
    residual[2] = following[2] - origin[2]
    residual[3:] = ((state[1][term.landmarks] - origin[:2]) @ turn.T).reshape(-1)
    residual -= term.restricted.mean
    residual[2] = se2_np.wrap_angle(residual[2])
    return residual, turn


def _jacobian(mean: np.ndarray, residual: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Jacobian (s, 6 + 2 k) of a residual by the submap's origin, the next, and the landmarks.

    With (x, y) a point in the frame of the submap, its derivative by the frame's heading is
    (y, -x).
    """
    size = len(residual)
    jacobian = np.zeros((size, size + 3))
    value = residual + mean
    xy = np.append(np.arange(2), np.arange(3, size)).reshape(-1, 2)  # rows of points
    jacobian[xy[:, :, None], (xy + 3)[:, None, :]] = turn
    jacobian[xy, 0], jacobian[xy, 1] = -turn[:, 0], -turn[:, 1]
    jacobian[xy[:, 0], 2], jacobian[xy[:, 1], 2] = value[xy[:, 1]], -value[xy[:, 0]]
    jacobian[2, [2, 5]] = -1.0, 1.0
    return jacobian


def linearise(
    terms: Sequence[Term], state: State, columns: Columns
) -> tuple[np.ndarray, sparse.csc_array]:
    """Half the gradient and the normal matrix, of the unknown numbers."""
    size = columns.size
    values, rows, cols, gradient = [], [], [], np.zeros(size)
    for term in terms:
        residual, turn = residual_of(term, state)
        i = term.submap
        own = columns.origins[i : i + 2].reshape(-1), columns.landmarks[term.landmarks].reshape(-1)
        at = np.concatenate(own)
        jacobian = _jacobian(term.restricted.mean, residual, turn)
        unknown = at >= 0
        if not unknown.all():
            at, jacobian = at[unknown], jacobian[:, unknown]
        weighted = term.restricted.information @ jacobian
        gradient[at] += residual @ weighted
        values.append((jacobian.T @ weighted).ravel())
        rows.append(np.repeat(at, len(at)))
        cols.append(np.tile(at, len(at)))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))
    return gradient, sparse.csc_array(entries, shape=(size, size))


def costs_of(terms: Sequence[Term], state: State) -> np.ndarray:
    """Squared Mahalanobis norm of the residual of each submap."""
    result = np.empty(len(terms))
    for t, term in enumerate(terms):
        residual, _ = residual_of(term, state)
        result[t] = residual @ term.restricted.information @ residual
    return result


def moved(state: State, step: np.ndarray, columns: Columns) -> State:
    """The state after a step of the unknown numbers."""
    step = np.append(step, 0.0)  # column -1
    return state[0] + step[columns.origins], state[1] + step[columns.landmarks]


def place_others(
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    terms: Sequence[Term],
    state: State,
    positions: np.ndarray,
) -> None:
    """Write into `positions` (L, 2) the landmarks that only one of these submaps holds."""
    for term in terms:
        submap, index = submaps[term.submap], landmark_index[term.submap]
        alone = np.setdiff1d(np.arange(len(index)), term.restricted.held, assume_unique=True)
        if len(alone) == 0:
            continue
        residual, _ = residual_of(term, state)
        rows = np.append(np.arange(3), point_rows(term.restricted.held))
        cross = submap.cov[point_rows(alone)[:, None], rows]
        pull = cross @ (term.restricted.information @ residual)
        local = submap.positions[alone] + pull.reshape(-1, 2)
        positions[index[alone]] = se2_np.transform(state[0][term.submap], local)
