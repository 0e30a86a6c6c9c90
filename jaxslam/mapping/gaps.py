"""Gaps of free space: straight lines between two walls that face each other.

Where the medial axis passes between two walls, its two nearest obstacle cells (feet) lie on
opposite sides of it. The line between the two feet is a gap. Doors and the ends of corridors are
gaps that are narrow for what lies beside them (`doors`).
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

FACING_ANGLE = np.radians(150.0)  # at least, between the directions to the two feet
PASSAGE_WIDENING = 1.1  # of the widths in one passage; a cell more is noise
_ROWS = 256  # of the grid, that are searched at once


class Gaps(NamedTuple):
    """K gaps.

    Attributes:
        feet: (K, 2, 2) int cells of the two obstacles at the ends of each gap.
        middle: (K, 2) [cells] their middle.
        along: (K, 2) unit vector from the first foot to the second.
        width: (K,) [cells] of free space between the feet.
    """

    feet: np.ndarray
    middle: np.ndarray
    along: np.ndarray
    width: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        """(K, 2) unit vectors through the gaps."""
        return np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)


def gaps_between(feet: np.ndarray) -> Gaps:
    """Gaps between pairs (K, 2, 2) of obstacle cells."""
    feet = np.reshape(feet, (-1, 2, 2)).astype(np.int64)
    across = (feet[:, 1] - feet[:, 0]).astype(float)
    length = np.hypot(*across.T)
    return Gaps(feet, feet.mean(axis=1), across / np.maximum(length, 1.0)[:, None], length - 1.0)


def take(gaps: Gaps, index: np.ndarray) -> Gaps:
    """The gaps of an index or mask."""
    return Gaps(*(field[index] for field in gaps))


def find_gaps(free: np.ndarray, distance: np.ndarray, nearest: np.ndarray) -> Gaps:
    """All gaps, one for each pair of neighbouring cells with the medial axis between them.

    With d the larger of the distances of two neighbouring cells to their feet f1 and f2, these
    appear under an angle of at least `FACING_ANGLE` if |f1 - f2| >= 2 d sin(angle / 2); at a local
    minimum of the clearance along the medial axis it is 180 degrees. In a passage one cell wide the
    medial axis goes through the cells, not between two: the obstacles on both sides are the feet.

    Args:
        free: (H, W) bool; cells at the border of the grid are not free.
        distance: (H, W) [cells] to the edge of the nearest obstacle.
        nearest: (2, H, W) int index of that obstacle.

    References:
        Thrun (1998), Learning metric-topological maps for indoor mobile robot navigation: critical
        lines through the minima of the clearance.
    """
    factor = 2.0 * np.sin(0.5 * FACING_ANGLE)
    found = [np.zeros((0, 2, 2), np.int64)]
    for top in range(0, free.shape[0], _ROWS):
        block = np.s_[top : top + _ROWS + 1]
        inside, far, foot = free[block], distance[block], nearest[:, block]
        for low, high in ((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:_ROWS, :-1], np.s_[:_ROWS, 1:])):
            first, second = (foot[(slice(None), *side)] for side in (low, high))
            apart = np.abs(first - second).max(axis=0)  # a lower bound, in whole numbers
            pair = np.flatnonzero(inside[low] & inside[high] & (apart > 1))
            first, second = first.reshape(2, -1)[:, pair], second.reshape(2, -1)[:, pair]
            larger = np.maximum(far[low].ravel()[pair], far[high].ravel()[pair]) + 0.5
            facing = np.hypot(*(first - second)) >= factor * larger
            found.append(np.stack([first[:, facing].T, second[:, facing].T], axis=1))
    for side in np.eye(2, dtype=np.int64):
        before, after = (np.roll(free, step, axis=(0, 1)) for step in (side, -side))
        narrow = np.argwhere(free & ~before & ~after)
        found.append(np.stack([narrow - side, narrow + side], axis=1))
    feet = np.unique(np.concatenate(found), axis=0)
    return gaps_between(feet[~_at_a_step(free, feet)])


def _at_a_step(free: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Which pairs of feet (K, 2, 2) have an obstacle that touches both, as at a step of a wall.

    # f1
      #  f2      no passage, though a free cell below the step is near to both
    """
    middle = feet.sum(axis=1) // 2
    touched = np.zeros(len(feet), bool)
    last = np.array(free.shape)[:, None] - 1
    for step in np.argwhere(np.ones((3, 3), bool)) - 1:
        cell = middle + step
        beside = np.abs(feet - cell[:, None]).max(axis=(1, 2)) == 1
        touched |= beside & ~free[tuple(np.clip(cell.T, 0, last))]
    return touched


class Passages:
    """Gaps that can be looked up by their place."""

    def __init__(self, gaps: Gaps, wall: float):
        """Index all gaps of a map by their middles; `wall` [cells] is the depth of a door frame."""
        self.gaps = gaps
        self._tree = cKDTree(gaps.middle)
        pairs = self._tree.query_pairs(wall, output_type="ndarray")
        itself = np.arange(len(gaps.width))
        first = np.concatenate([pairs[:, 0], pairs[:, 1], itself])
        second = np.concatenate([pairs[:, 1], pairs[:, 0], itself])
        same = self._in_one_passage(first, second)
        first, second = first[same], second[same]
        self._in_frame = second[np.lexsort((second, first))]
        self._frame_of = np.searchsorted(np.sort(first), np.arange(len(gaps.width) + 1)).tolist()

    def near(self, middle: np.ndarray, radius: float) -> list[int]:
        """Indices of gaps whose middle is within a radius [cells] of a point (2,)."""
        return self._tree.query_ball_point(middle, radius)

    def beside(self, k: int, radius: float) -> np.ndarray:
        """Indices of the gaps (n,) in the same passage as gap k, itself included.

        They are within a radius [cells], parallel to it, in front of or behind it, and at most
        `PASSAGE_WIDENING` times as wide.
        """
        near = np.array(sorted(self.near(self.gaps.middle[k], radius)))
        return near[self._in_one_passage(np.full(len(near), k), near)]

    def frame(self, k: int) -> np.ndarray:
        """As `beside`, within the depth of a door frame."""
        return self._in_frame[self._frame_of[k] : self._frame_of[k + 1]]

    def _in_one_passage(self, k: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Whether gaps `other` (n,) are in front of or behind the gaps k (n,), or these."""
        (along_x, along_y), width = self.gaps.along[k].T, self.gaps.width[k]
        other_x, other_y = self.gaps.along[other].T
        x, y = (self.gaps.middle[other] - self.gaps.middle[k]).T
        same = np.abs(other_x * along_x + other_y * along_y) > 0.9
        same &= np.abs(x * along_x + y * along_y) <= 0.25 * width + 1.0
        same &= self.gaps.width[other] <= PASSAGE_WIDENING * width + 1.0
        return same | (other == k)


def narrowest(passages: Passages, *, max_width: float) -> np.ndarray:
    """Indices (n,) of the gaps to try as doors, narrow ones first.

    Of gaps nearer to each other than half their width one is kept: the narrowest, or the middle
    one where walls are parallel.

    Args:
        passages: All gaps of a map.
        max_width: [cells] of the widest.
    """
    gaps = passages.gaps
    order = np.lexsort((*gaps.middle.T, gaps.width))
    tried = gaps.width > max_width
    kept = []
    for k in order.tolist():
        if tried[k]:
            continue
        beside = passages.frame(k)
        beside = beside[(gaps.width[beside] <= gaps.width[k] + 1.0) & ~tried[beside]]
        middle = gaps.middle[beside]
        offset = middle - middle.sum(axis=0) / len(middle)
        best = int(beside[np.hypot(offset[:, 0], offset[:, 1]).argmin()])
        kept.append(best)
        for done in {best, k}:
            tried[passages.near(gaps.middle[done], max(0.5 * gaps.width[done], 3.0))] = True
    chosen = np.array(kept, int)
    return chosen[np.argsort(gaps.width[chosen], kind="stable")]


def line_cells(feet: np.ndarray) -> np.ndarray:
    """Cells (n, 2) of the 8-connected line between two cells (2, 2)."""
    steps = int(np.abs(feet[1] - feet[0]).max())
    share = np.linspace(0.0, 1.0, steps + 1)[:, None]
    return np.rint(feet[0] + share * (feet[1] - feet[0])).astype(np.int64)
