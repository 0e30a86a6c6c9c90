"""Joins submaps and takes back matches that the others contradict, as one would bend the map.

With r the residual of a submap and O its information, without some of its matches, S, the cost of
the submap is less by

    u_S^T O_SS^-1 u_S        u = O r

which for right matches is at most chi-square of 2 |S|. Tested are each landmark that a submap
shares, and all that it shares with one other submap that is neither before nor after it. The most
improbable are taken back, one among submaps that share landmarks, and all is solved again, until
none is left. A landmark whose match is taken back is one of its own.

This is a kernel of weight one or zero. A smooth one, as that of `sparse`, has no place here: the
landmarks of a submap are correlated, and its Gaussian is to stay as it is where all is well.

References:
    Neira, Tardos (2001), Data association in stochastic mapping using the joint compatibility test.
    Latif, Cadena, Neira (2013), Robust loop closing over time for pose graph SLAM.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxslam.core.types import AnyArray
from jaxslam.filtering.submaps import Submap
from jaxslam.smoothing.submap_joining import JoinedSubmaps, join_submaps
from jaxslam.smoothing.submap_terms import Term, make_terms, residual_of, times_held

IMPROBABLE = 1e-6
"""Probability that a right match, or right matches with one submap, are taken back."""

COMPARABLE = 0.5
"""Of the largest excess: what is less improbable may be so for the most improbable alone."""

MAX_ROUNDS = 20
"""Of solving and taking back, at most."""


class Contradiction(NamedTuple):
    """Matches of one submap that are improbable.

    Attributes:
        excess: By how many times the cost without them is less than it may be.
        submap: Its index.
        landmarks: (S,) int which of its landmarks they are.
    """

    excess: float
    submap: int
    landmarks: np.ndarray


def join_consistent(
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    origins: AnyArray,
    landmark_positions: AnyArray,
    *,
    previous: JoinedSubmaps | None = None,
    max_iterations: int = 20,
) -> tuple[JoinedSubmaps, tuple[np.ndarray, ...]]:
    """As `join_submaps`, without the matches that the others contradict.

    Returns:
        All submaps, joined, and for each the index (n,) of its landmarks.

    Raises:
        ValueError: As of `join_submaps`.
    """
    index = tuple(landmark_index)
    joined = join_submaps(
        submaps,
        index,
        origins,
        landmark_positions,
        previous=previous,
        max_iterations=max_iterations,
    )
    found, is_converged = contradictions(submaps, index, joined), False
    for _ in range(MAX_ROUNDS):
        if not found:
            break
        if is_converged:  # before, a step that is still missing may look like a contradiction
            index, positions = _taken_back(index, found, joined.landmark_positions)
        else:
            positions = joined.landmark_positions
        joined = join_submaps(submaps, index, joined.origins, positions, previous=joined)
        found, is_converged = contradictions(submaps, index, joined), True
    return joined, index


def contradictions(
    submaps: Sequence[Submap], landmark_index: Sequence[np.ndarray], joined: JoinedSubmaps
) -> list[Contradiction]:
    """Improbable matches, the most improbable first, one among submaps that share landmarks."""
    from scipy.special import chdtri  # imported here, because it is slow to import

    is_shared = times_held(landmark_index, len(joined.landmark_positions)) > 1
    every = range(len(submaps))
    terms = make_terms(submaps, landmark_index, every, is_shared, joined.restricted)
    state = joined.origins, joined.landmark_positions
    holders: dict[int, list[int]] = {}
    for term in terms:
        for landmark in term.landmarks.tolist():
            holders.setdefault(landmark, []).append(term.submap)
    found = []
    for term in terms:
        information = term.restricted.information
        u = information @ residual_of(term, state)[0]
        for group in _groups(term, holders):
            at = (3 + 2 * group[:, None] + np.arange(2)).reshape(-1)
            gain = u[at] @ np.linalg.solve(information[np.ix_(at, at)], u[at])
            excess = float(gain / chdtri(len(at), IMPROBABLE))
            if excess > 1.0:
                found.append(Contradiction(excess, term.submap, group))
    found.sort(key=lambda one: -one.excess)
    disturbed: set[int] = set()
    chosen = []
    for one in found:
        term = terms[one.submap]
        around = {other for landmark in term.landmarks.tolist() for other in holders[landmark]}
        if one.excess >= COMPARABLE * found[0].excess and one.submap not in disturbed:
            chosen.append(one._replace(landmarks=term.restricted.held[one.landmarks]))
            disturbed |= around
    return chosen


def _groups(term: Term, holders: dict[int, list[int]]) -> list[np.ndarray]:
    """Matches that are tested together: each, and all with one submap that is no neighbour."""
    groups = [np.array([k]) for k in range(len(term.landmarks))]
    others: dict[int, list[int]] = {}
    for k, landmark in enumerate(term.landmarks.tolist()):
        for other in holders[landmark]:
            if abs(other - term.submap) > 1:
                others.setdefault(other, []).append(k)
    return groups + [np.array(group) for group in others.values() if len(group) > 1]


def _taken_back(
    landmark_index: Sequence[np.ndarray], found: Sequence[Contradiction], positions: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Indices and positions, where landmarks of contradictions are landmarks of their own."""
    result, number = [one.copy() for one in landmark_index], len(positions)
    for one in found:
        result[one.submap][one.landmarks] = number + np.arange(len(one.landmarks))
        number += len(one.landmarks)
    held, first = np.unique(np.concatenate(result), return_index=True)
    guess = positions[np.concatenate(list(landmark_index))[first]]
    return tuple(np.searchsorted(held, one) for one in result), guess
