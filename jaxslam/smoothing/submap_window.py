"""A new submap in the map by its surroundings alone, in a time that the size of the map hardly has.

A window are the submaps that are fewest steps from the newest; a step leads to the submap after or
before, or to one that holds some of the same landmarks. It gives

    covariances     of the newest frame relative to those near it, by the terms of the window alone:
                    what is left out would only make them smaller
    a solution      of what only the window's submaps hold; what others hold, too, stays. Where this
                    does not explain the new submap as well as its noise lets expect, which is
                    where a loop closes, the rest has to move, too: a larger window, or all

The window's solution is one step of block coordinate descent of the sum of `submap_joining`.

References:
    Kaess, Johannsson, Roberts, Ila, Leonard, Dellaert (2012), iSAM2: Incremental smoothing and
    mapping using the Bayes tree. Bosse, Newman, Leonard, Teller (2004), SLAM in large-scale cyclic
    environments using the Atlas framework.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order

from jaxslam.filtering.submaps import Submap
from jaxslam.smoothing.sparse import factorise
from jaxslam.smoothing.submap_joining import JoinedSubmaps, minimise, relative_poses_of
from jaxslam.smoothing.submap_terms import (
    columns_of,
    costs_of,
    linearise,
    make_terms,
    place_others,
    times_held,
)

EXPLAINED = 0.999
"""Probability that the cost of a right submap in a right map is less than a window may have."""


def choose_window(
    landmark_index: Sequence[np.ndarray],
    num_landmarks: int,
    start: int,
    wanted: np.ndarray,
    size: int,
    *,
    min_shared: int,
) -> np.ndarray:
    """The submaps fewest steps from one of them, and those that the steps to others lead over.

    Args:
        landmark_index: Of each submap the indices (n,) of its landmarks.
        num_landmarks: Number of landmarks.
        start: The submap from which steps are counted.
        wanted: (C,) int submaps that are in the window, however far.
        size: Number of submaps that are in it for being near.
        min_shared: Landmarks that two submaps hold for a step between them.

    Returns:
        (W,) int submaps in order.
    """
    count = len(landmark_index)
    by = np.repeat(np.arange(count), [len(one) for one in landmark_index])
    held = np.concatenate(landmark_index)
    holds = csr_array((np.ones(len(held)), (by, held)), shape=(count, num_landmarks))
    both = coo_array(holds @ holds.T)
    near = both.data >= min_shared
    chain = np.arange(count - 1)
    ends = np.append(both.row[near], chain), np.append(both.col[near], chain + 1)
    graph = csr_array((np.ones(len(ends[0])), ends), shape=(count, count))
    order, before = breadth_first_order(graph, start, directed=False)
    chosen = set(order[:size].tolist())
    for one in wanted.tolist():
        while one not in chosen:
            chosen.add(one)
            one = int(before[one])
    return np.array(sorted(chosen))


def relative_poses_in(
    window: np.ndarray,
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    joined: JoinedSubmaps,
    first: np.ndarray,
    second: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of one frame relative to others, with covariance by the terms of a window alone.

    Args:
        window: (W,) int submaps, as of `choose_window`.
        submaps: N submaps or more.
        landmark_index: Of each of N the indices (n,) of its landmarks.
        joined: N submaps, joined, or a window of them.
        first: (C,) int frames of submaps of the window, relative to which it is.
        second: The frame of a submap of the window, or the next.

    Returns:
        (C, 3) [m, m, rad] and (C, 3, 3).
    """
    times = times_held(landmark_index, len(joined.landmark_positions))
    terms = make_terms(submaps, landmark_index, window, times > 1, joined.restricted)
    origins, landmarks = np.zeros(len(joined.origins), bool), np.zeros(len(times), bool)
    origins[window] = origins[window + 1] = True
    origins[window[0]] = False  # relative poses do not depend on which one is known
    for term in terms:
        landmarks[term.landmarks] = True
    columns = columns_of(origins, landmarks)
    state = joined.origins, joined.landmark_positions
    factors = factorise(linearise(terms, state, columns)[1])
    return relative_poses_of(joined.origins, factors, columns.origins, first, second)


def join_in_window(
    window: np.ndarray,
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    origins: np.ndarray,
    landmark_positions: np.ndarray,
    previous: JoinedSubmaps,
    *,
    max_iterations: int,
) -> JoinedSubmaps | None:
    """Join the last of N submaps with N - 1 that are joined, and move only what a window holds.

    Args:
        window: (W,) int submaps of the first N - 1, as of `choose_window`.
        submaps: N submaps.
        landmark_index: Of each the indices (n,) of its landmarks.
        origins: (N + 1, 3) [m, m, rad] guess.
        landmark_positions: (L, 2) [m] guess.
        previous: The first N - 1, joined, or a window of them.
        max_iterations: Largest number of Gauss-Newton steps.

    Returns:
        All, with the cost of the window; None if more than the window has to move.
    """
    from scipy.special import chdtri  # imported here, because it is slow to import

    last = len(submaps) - 1
    times = times_held(landmark_index, len(landmark_positions))
    inside = np.append(window, last)
    terms = make_terms(submaps, landmark_index, inside, times > 1, previous.restricted)
    own = times_held([landmark_index[i] for i in inside], len(times))
    is_in = np.zeros(last + 1, bool)
    is_in[inside] = True
    unknown = np.append(False, is_in & np.append(is_in[1:], True))
    columns = columns_of(unknown, (own == times) & (times > 1))
    before = float(costs_of(terms[:-1], (origins, landmark_positions)).sum())
    state, costs, _ = minimise(terms, (origins, landmark_positions), columns, max_iterations)
    dof = len(terms[-1].restricted.mean) - 3
    if costs[-1] - before > chdtri(max(dof, 1), 1 - EXPLAINED):
        return None
    positions = state[1].copy()
    place_others(submaps, landmark_index, terms, state, positions)
    restricted = [*previous.restricted, terms[-1].restricted]
    for term in terms:
        restricted[term.submap] = term.restricted
    return JoinedSubmaps(state[0], positions, np.array(costs), dof, None, tuple(restricted))
