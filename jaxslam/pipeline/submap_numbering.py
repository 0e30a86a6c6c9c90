"""Landmarks of a new submap among those of the map: candidates, matches, and numbers.

candidates  the submap before, and those that have landmarks near those of the new one
match       its landmarks with theirs (`smoothing.submap_matching`), the surest guess first
number      a matched landmark has the number of its match, the others are new; two landmarks
            of the map that match the same one become one, unless a submap holds both
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from jaxslam.core import se2_np
from jaxslam.core.types import as_count, as_size
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.submaps import Submap
from jaxslam.smoothing.submap_joining import JoinedSubmaps
from jaxslam.smoothing.submap_matching import match_submaps
from jaxslam.smoothing.submap_window import choose_window, relative_poses_in


class SubmapSpec(NamedTuple):
    """When submaps are closed, and with what they are matched.

    Attributes:
        max_distance: [m] driven after which a submap is closed.
        max_candidates: Submaps that a closed one is matched with, at most.
        search_distance: [m] within which landmarks of the estimated map make a submap a candidate.
        min_matches: Matches with a submap below which there are none.
        max_iterations: Gauss-Newton steps at each closing; the end of `run_submaps` takes more.
        window: Submaps around a closed one that alone are solved at first.
    """

    max_distance: float = 20.0
    max_candidates: int = 8
    search_distance: float = 2.0
    min_matches: int = 3
    max_iterations: int = 1
    window: int = 24


def check_submap_spec(spec: SubmapSpec) -> None:
    """Raise ValueError, naming the field, unless all are positive."""
    for name in ("max_distance", "search_distance"):
        as_size(f"spec.{name}", getattr(spec, name), positive=True)
    for name in ("max_candidates", "min_matches", "max_iterations", "window"):
        as_count(f"spec.{name}", getattr(spec, name))


class Numbered(NamedTuple):
    """Landmarks of N + 1 submaps, of which N are joined.

    Attributes:
        landmark_index: For each of the N + 1 the indices (n,) 0..L-1.
        positions: (L, 2) [m] a guess of the landmarks.
        window: (W,) int those of the N submaps that are around the new one.
    """

    landmark_index: tuple[np.ndarray, ...]
    positions: np.ndarray
    window: np.ndarray


def number_landmarks(
    association: AssociationSpec,
    spec: SubmapSpec,
    submaps: Sequence[Submap],
    landmark_index: Sequence[np.ndarray],
    joined: JoinedSubmaps,
) -> Numbered:
    """Indices of the landmarks of N + 1 submaps, of which N are joined, and their positions.

    Args:
        association: Thresholds of data association.
        spec: With what the last submap is matched.
        submaps: N + 1 submaps.
        landmark_index: For each of the first N the index (n,) of its landmarks in `joined`.
        joined: The first N, joined.
    """
    submap, num_known = submaps[-1], len(joined.landmark_positions)
    positions = se2_np.transform(joined.origins[-1], submap.positions)
    candidates = _candidates(spec, landmark_index, joined, positions)
    window = choose_window(
        landmark_index,
        num_known,
        len(landmark_index) - 1,
        candidates,
        spec.window,
        min_shared=spec.min_matches,
    )
    relative, cov = relative_poses_in(
        window, submaps, landmark_index, joined, candidates, len(landmark_index)
    )
    index = np.full(len(positions), -1)
    label = np.arange(num_known)  # of each landmark of the map, as some become one
    for at in np.argsort(np.trace(cov, axis1=1, axis2=2), kind="stable"):
        candidate = int(candidates[at])
        matches = match_submaps(
            association,
            submaps[candidate],
            submap,
            relative[at],
            cov[at],
            min_matches=spec.min_matches,
        )
        for own in np.flatnonzero(matches >= 0):
            other = label[landmark_index[candidate][matches[own]]]
            if other == index[own] or other in index:
                continue
            if index[own] < 0:
                index[own] = other
            elif not any({index[own], other} <= set(label[one]) for one in landmark_index):
                label[label == other] = index[own]
    fresh = np.flatnonzero(index < 0)
    index[fresh] = num_known + np.arange(len(fresh))
    whole = np.concatenate([label, index[fresh]])
    kept, label = np.unique(whole, return_inverse=True)
    guess = np.concatenate([joined.landmark_positions, positions[fresh]])[kept]
    return Numbered(tuple(label[one] for one in (*landmark_index, index)), guess, window)


def _candidates(
    spec: SubmapSpec,
    landmark_index: Sequence[np.ndarray],
    joined: JoinedSubmaps,
    positions: np.ndarray,
) -> np.ndarray:
    """Submaps (C,) int that a new one is to be matched with; the one before is always the first.

    Of the others that which has most landmarks near those of the new one, not counting those that
    are near landmarks of two candidates already, is the next.
    """
    count, last, known = len(landmark_index), len(landmark_index) - 1, joined.landmark_positions
    if min(len(known), len(positions)) == 0:
        return np.array([last])
    own = cKDTree(positions)
    near = own.sparse_distance_matrix(
        cKDTree(known), spec.search_distance, output_type="coo_matrix"
    )
    held = np.concatenate(landmark_index)
    by = np.repeat(np.arange(count), [len(one) for one in landmark_index])
    holds = csr_array((np.ones(len(held)), (held, by)), shape=(len(known), count))
    pairs = csr_array((np.ones(near.nnz), (near.row, near.col)), shape=near.shape)
    overlap = ((pairs @ holds).toarray() > 0).astype(int)  # (m, N)
    chosen, left = [last], 2 - overlap[:, last]
    while len(chosen) < spec.max_candidates:
        gain = (left > 0) @ overlap
        gain[chosen] = 0
        best = int(gain.argmax())
        if gain[best] == 0:
            break
        chosen.append(best)
        left = left - overlap[:, best]
    return np.array(chosen)
