"""Boundaries of labelled cells, as polygons with holes."""

import numpy as np
from scipy import ndimage

from jaxslam.core import polylines

TOLERANCE = 1.0  # [cells] of a polygon


def outlines(label: np.ndarray, count: int) -> list[list[np.ndarray]]:
    """Boundaries (n, 2) [cells] of each of the labels 1 to `count`.

    The first of a label is its outer one, counter-clockwise; others are those of its holes,
    clockwise. If it has several parts, they are those of the largest. Cell [i, j] is the square
    from (i, j) to (i + 1, j + 1).

    Args:
        label: (H, W) int.
        count: Number of labels; each has a cell.
    """
    found = []
    for k, box in enumerate(ndimage.find_objects(label, count), start=1):
        corner = np.array([side.start for side in box])
        cells, parts = ndimage.label(np.pad(label[box] == k, 1))
        largest = np.bincount(cells.ravel())[1:].argmax() + 1 if parts > 1 else 1
        found.append([_simplified(loop) + corner - 1.0 for loop in _boundaries(cells == largest)])
    return found


def _boundaries(cells: np.ndarray) -> list[np.ndarray]:
    """Corners (n, 2) of the boundaries of connected cells (H, W) bool; the border is not set.

    The first is the outer one. Each side of a cell whose neighbour is not set is an edge with the
    cell on its left. Where two cells meet in a corner alone, the boundary stays with its cell:

        # .         a turn to the left wherever there is a choice
        . #
    """
    moves = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # each turned left from the one before
    beside = ((0, -1), (1, 0), (0, 1), (-1, 0))  # neighbour on the right of each edge
    starts = ((0, 0), (1, 0), (1, 1), (0, 1))  # corner of the cell where it begins
    edges = []
    for turn, ((i, j), (row, column)) in enumerate(zip(beside, starts, strict=True)):
        neighbour = cells[1 + i : cells.shape[0] - 1 + i, 1 + j : cells.shape[1] - 1 + j]
        here = np.argwhere(cells[1:-1, 1:-1] & ~neighbour) + [1 + row, 1 + column]
        edges.append(np.column_stack([np.full(len(here), turn), here]))
    turns, rows, columns = np.concatenate(edges).T
    shape = (4, cells.shape[0] + 1, cells.shape[1] + 1)
    key = np.ravel_multi_index((turns, rows, columns), shape)  # ascending

    def number(turn: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Number of each edge, -1 where there is none."""
        wanted = np.ravel_multi_index((turn, row, column), shape)
        found = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[found] == wanted, found, -1)

    ends = np.stack([rows, columns], axis=1) + moves[turns]
    follower = np.full(len(turns), -1)
    for change in (-1, 0, 1):  # right, straight on, left: the last one found is taken
        nxt = number((turns + change) % 4, *ends.T)
        follower = np.where(nxt >= 0, nxt, follower)
    start = int(np.searchsorted(turns, 3))  # of the first cell, which has no neighbour before it
    corners = np.stack([rows, columns], axis=1).astype(float)
    following = follower.tolist()
    waiting = dict.fromkeys([start, *range(len(turns))])
    found = []
    while waiting:
        loop, edge = [], next(iter(waiting))
        while edge in waiting:
            del waiting[edge]
            loop.append(edge)
            edge = following[edge]
        is_corner = turns[loop] != np.roll(turns[loop], 1)
        found.append(corners[loop][is_corner])
    return found


def _simplified(polygon: np.ndarray) -> np.ndarray:
    """Polygon of fewer corners, at most `TOLERANCE` from the given one (n, 2)."""
    first = int(np.lexsort(polygon.T[::-1])[0])
    loop = np.roll(polygon, -first, axis=0)
    loop = np.concatenate([loop, loop[:1]])
    middle = int(np.hypot(*(loop - loop[0]).T).argmax())
    halves = loop[: middle + 1], loop[middle:]
    fewer = np.concatenate([polylines.simplify(half, TOLERANCE)[:-1] for half in halves])
    return fewer if len(fewer) > 2 else polygon
