"""Medial cells of a map: where a robot that fits keeps furthest from all that is not free.

The places of the robot's centre are thinned from the outside in, in the order of their distance
to the nearest cell that is not free. Only cells whose loss changes neither pieces nor holes go, so
the medial cells have the pieces and the rings of those places, by construction. Cells half-way
between two walls that face each other stay, so that dead ends do.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

_ROUND = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
"""The eight cells around a cell, in order."""

_EIGHT = np.ones((3, 3), bool)


class Places(NamedTuple):
    """Where the centre of a robot may be."""

    room: np.ndarray  # (H, W) float64 [cells] to the edge of the nearest cell that is not free
    foot: np.ndarray  # (2, H, W) int index of that cell
    inside: np.ndarray  # (H, W) int region of the robot's centre, 1 for the largest; 0 for none
    sizes: np.ndarray  # (K,) int [cells] of each region, falling


def free_space(occupied: np.ndarray, free: np.ndarray, *, speck: float, gap: float) -> np.ndarray:
    """Free cells (H, W) bool, specks in them filled.

    Args:
        occupied: (H, W) bool.
        free: (H, W) bool; a cell that is neither is unknown.
        speck: [cells] islands in free space no wider and no higher than this are noise.
        gap: [cells] the same for islands of unknown cells alone, which are no walls.
    """
    free = free & ~occupied
    island, count = ndimage.label(~free, structure=_EIGHT)
    boxes = ndimage.find_objects(island)
    wall = np.zeros(count + 1, bool)
    wall[np.unique(island[occupied])] = True
    filled = np.zeros(count + 1, bool)
    for k, box in enumerate(boxes, start=1):
        inner = all(s.start > 0 and s.stop < n for s, n in zip(box, free.shape, strict=True))
        width = max(s.stop - s.start for s in box)
        filled[k] = inner and width <= (speck if wall[k] else max(speck, gap))
    return free | filled[island]


def places(free: np.ndarray, *, clearance: float) -> Places:
    """Regions of free cells (H, W) bool in which a robot of radius `clearance` [cells] fits.

    What lies beyond the grid is not free.
    """
    distance, foot = ndimage.distance_transform_edt(np.pad(free, 1), return_indices=True)
    inner = np.s_[1:-1, 1:-1]
    room = distance[inner] - 0.5
    inside, count = ndimage.label(room >= clearance, structure=_EIGHT)
    sizes = np.bincount(inside.ravel(), minlength=count + 1)[1:]
    order = np.argsort(-sizes, kind="stable")
    rank = np.zeros(count + 1, inside.dtype)
    rank[1 + order] = np.arange(1, count + 1)
    return Places(room, foot[:, 1:-1, 1:-1] - 1, rank[inside], sizes[order])


def facing(space: Places, wall: np.ndarray, *, angle: float) -> np.ndarray:
    """Cells (H, W) bool between two things that, seen from the cell, are `angle` [rad] apart.

    Two neighbours whose nearest obstacles lie far apart have the medial axis between them. Unknown
    cells keep the robot out but are no walls: one of the two at least must be `wall` (H, W) bool.
    """
    inside = space.inside > 0
    kept = np.zeros(inside.shape, bool)
    shape = np.array(inside.shape)[:, None, None] - 1
    real = wall[tuple(np.clip(space.foot, 0, shape))]
    distance = space.room + 0.5
    for low, high in (np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:]):
        apart = np.hypot(*(space.foot[(slice(None), *low)] - space.foot[(slice(None), *high)]))
        wide = apart >= 2 * np.sin(0.5 * angle) * np.maximum(distance[low], distance[high])
        wide &= inside[low] & inside[high] & (real[low] | real[high])
        upper = distance[high] > distance[low]
        kept[low] |= wide & ~upper
        kept[high] |= wide & upper
    return kept


def medial(space: Places, regions: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Medial cells (H, W) bool, one cell thin, of the regions that `regions` (H, W) bool picks.

    `kept` (H, W) bool are the cells that hold dead ends.
    """
    level = (4.0 * space.room).astype(np.int64)
    rough = _thin(regions, level, kept, ends=False)
    return _thin(rough, level, np.zeros_like(kept), ends=True)


def _rules() -> tuple[np.ndarray, np.ndarray]:
    """Of each pattern (256,) around a cell: whether the cell is simple, and how many are set.

    A cell is simple if its loss changes neither pieces nor holes: its eight neighbours hold one
    piece (8-connected) and one piece of background (4-connected) that touches it.

    References:
        Yokoi, Toriwaki, Fukumura (1975), An analysis of topological properties of digitized
        binary pictures using local features.
    """
    pattern = np.arange(256)
    clear = [1 - ((pattern >> (k % 8)) & 1) for k in range(9)]
    number = sum(clear[k] - clear[k] * clear[k + 1] * clear[k + 2] for k in (0, 2, 4, 6))
    return number == 1, 8 - sum(clear[:8])


_SIMPLE, _COUNT = _rules()


def _thin(cells: np.ndarray, level: np.ndarray, kept: np.ndarray, *, ends: bool) -> np.ndarray:
    """Take simple cells away, level by level, as long as there are any.

    Args:
        cells: (H, W) bool.
        level: (H, W) int, the order; a cell that may not go at its level is tried again whenever
            a neighbour has gone.
        kept: (H, W) bool, cells that stay.
        ends: Whether a cell with one neighbour stays.
    """
    width = cells.shape[1] + 2
    on = np.pad(cells, 1).ravel()
    may = on & ~np.pad(kept, 1).ravel()
    level = np.pad(level, 1).ravel()
    # Cells of one row parity and column parity do not touch: they can go at the same time.
    parity = np.add.outer(2 * (np.arange(cells.shape[0] + 2) % 2), np.arange(width) % 2).ravel()
    steps = np.array([i * width + j for i, j in _ROUND])
    weights = 1 << np.arange(8)
    order = np.flatnonzero(may)
    order = order[np.argsort(level[order], kind="stable")]
    levels, first = np.unique(level[order], return_index=True)
    for now, pending in zip(levels, np.split(order, first[1:]), strict=True):
        while pending.size:
            lost = []
            for own in range(4):
                tried = pending[parity[pending] == own]
                pattern = on[tried[:, None] + steps] @ weights
                loses = _SIMPLE[pattern] & ~(ends & (_COUNT[pattern] == 1))
                on[tried[loses]] = False
                lost.append(tried[loses])
            near = np.unique(np.concatenate(lost)[:, None] + steps)
            pending = near[on[near] & may[near] & (level[near] <= now)]
    return on.reshape(-1, width)[1:-1, 1:-1]
