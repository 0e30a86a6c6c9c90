"""Medial axis of the free space of an occupancy grid, by topology-preserving thinning.

The free configurations of a disc-shaped robot (the cells where its centre may be) are thinned from
the outside in, in the order of their distance to the nearest obstacle. Only simple cells are
removed, those whose removal changes neither connected components nor holes; so the medial cells
have the components and the holes of the free configurations by construction. Cells half-way
between two facing walls are anchors: they are kept, and so dead ends do not shrink away.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

_ROUND = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
"""Offsets of the eight neighbours of a cell, in circular order; bit k of a pattern is the k-th."""

_EIGHT = np.ones((3, 3), bool)

COARSE_DISTANCE = 11.0
"""[cells] Nearer to a right corner its two walls may appear under 120 degrees, in cells."""

MIN_RUN = 4
"""[cells] Nearer to walls than that, fewer anchors beside each other are no dead end."""


_ROWS = 64  # of the grid, whose distances are computed at once


class FreeConfigurations(NamedTuple):
    """Free configurations of a disc-shaped robot, H x W cells.

    Attributes:
        distance: (H, W) float64 [cells] distance to the edge of the nearest cell that is not free.
        nearest_obstacle: (2, H, W) int index of that cell; it may lie one cell beyond the grid.
        region: (H, W) int connected region of free configurations, 1 for the largest; 0 where the
            robot does not fit.
        region_sizes: (K,) int [cells] size of each region, descending.
    """

    distance: np.ndarray
    nearest_obstacle: np.ndarray
    region: np.ndarray
    region_sizes: np.ndarray


def free_space(
    occupied: np.ndarray, free: np.ndarray, *, min_obstacle_size: float, min_unknown_size: float
) -> np.ndarray:
    """Free cells (H, W) bool, with small islands filled.

    Args:
        occupied: (H, W) bool.
        free: (H, W) bool; a cell that is neither is unknown.
        min_obstacle_size: [cells] islands in free space no wider and no higher than this are noise.
        min_unknown_size: [cells] the same for islands of unknown cells alone, which are no walls.
    """
    free = free & ~occupied
    island, count = ndimage.label(~free, structure=_EIGHT)
    boxes = ndimage.find_objects(island)
    has_wall = np.zeros(count + 1, bool)
    has_wall[np.unique(island[occupied])] = True
    filled = np.zeros(count + 1, bool)
    for k, box in enumerate(boxes, start=1):
        enclosed = all(s.start > 0 and s.stop < n for s, n in zip(box, free.shape, strict=True))
        width = max(side.stop - side.start for side in box)
        filled[k] = enclosed and width <= (
            min_obstacle_size if has_wall[k] else max(min_obstacle_size, min_unknown_size)
        )
    return free | filled[island]


def nearest_obstacles(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (H, W) [cells] of cells (H, W) to the nearest one that is not free, and its index.

    Returns:
        (H, W) float64 between the centres of the cells, and (2, H, W) int32.
    """
    nearest = ndimage.distance_transform_edt(free, return_distances=False, return_indices=True)
    distance, column = np.empty(free.shape), np.arange(free.shape[1], dtype=float)
    for top in range(0, len(free), _ROWS):
        rows = np.arange(top, min(top + _ROWS, len(free)), dtype=float)[:, None]
        i, j = nearest[:, top : top + _ROWS]
        distance[top : top + _ROWS] = np.sqrt((i - rows) ** 2 + (j - column) ** 2)
    return distance, nearest


def free_configurations(
    free: np.ndarray, *, clearance: float, also_free: np.ndarray | None = None
) -> FreeConfigurations:
    """Regions of free cells in which a disc-shaped robot fits.

    Args:
        free: (H, W) bool; what lies beyond the grid is not free.
        clearance: [cells] radius of the robot.
        also_free: (H, W) bool, cells of `free` where the robot fits, as it was there.
    """
    to_centre, foot = nearest_obstacles(np.pad(free, 1))
    to_edge = to_centre[1:-1, 1:-1] - 0.5
    fits = to_edge >= clearance
    if also_free is not None:
        fits |= also_free
        # Where it drove nearer to a wall, free cells between make no ring.
        hole, count = ndimage.label(np.pad(~fits, 1, constant_values=True))
        has_wall = np.zeros(count + 1, bool)
        has_wall[hole[np.pad(~free, 1, constant_values=True)]] = True
        fits |= ~has_wall[hole[1:-1, 1:-1]] & ~fits
    region, count = ndimage.label(fits, structure=_EIGHT)
    sizes = np.bincount(region.ravel(), minlength=count + 1)[1:]
    order = np.argsort(-sizes, kind="stable")
    rank = np.zeros(count + 1, region.dtype)
    rank[1 + order] = np.arange(1, count + 1)
    return FreeConfigurations(to_edge, foot[:, 1:-1, 1:-1] - 1, rank[region], sizes[order])


def between_walls(space: FreeConfigurations, wall: np.ndarray, *, angle: float) -> np.ndarray:
    """Cells half-way between two obstacles that face each other, the anchors of dead ends.

    Two neighbouring cells whose nearest obstacles f1 and f2 lie far from each other have the medial
    axis between them. With d the larger of their distances to these, f1 and f2 appear under an
    angle of at least `angle` if |f1 - f2| >= 2 d sin(angle / 2):

        ### f1 ####################
             |
             | d1          d = max(d1, d2)
            [ ][ ]
                | d2
        ####### f2 ################

    Of the two cells the one farther from its obstacle is marked. Each obstacle is known to a cell
    or so: few marks beside each other, near to walls, are a corner, and are dropped.

    Args:
        space: Free configurations.
        wall: (H, W) bool; unknown cells keep the robot out but are no walls, and one of the two
            obstacles must be a wall.
        angle: [rad] between the two obstacles, at least.

    Returns:
        (H, W) bool.
    """
    inside = space.region > 0
    anchors = np.zeros(inside.shape, bool)
    last_index = np.array(inside.shape)[:, None] - 1
    factor = 2 * np.sin(0.5 * angle)
    (row, column), distance = space.nearest_obstacle, space.distance
    for low, high in (np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:]):
        # The larger distance is at least one cell, so nearer obstacles are not far enough apart.
        apart = np.maximum(np.abs(row[low] - row[high]), np.abs(column[low] - column[high]))
        pair = np.nonzero(inside[low] & inside[high] & (apart >= factor / np.sqrt(2)))
        feet = [np.stack([row[side][pair], column[side][pair]]) for side in (low, high)]
        far_low, far_high = distance[low][pair] + 0.5, distance[high][pair] + 0.5
        between = np.hypot(*(feet[0] - feet[1])) >= factor * np.maximum(far_low, far_high)
        is_wall = [wall[tuple(np.clip(foot, 0, last_index))] for foot in feet]
        between &= is_wall[0] | is_wall[1]
        for side, chosen in ((low, far_high <= far_low), (high, far_high > far_low)):
            anchors[side][pair[0][between & chosen], pair[1][between & chosen]] = True
    return anchors & ~_few(anchors, space.distance)


def _few(anchors: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Anchors (H, W) near to walls with few others beside them.

    Args:
        anchors: (H, W) bool.
        distance: (H, W) [cells] to the nearest obstacle.
    """
    group, _ = ndimage.label(ndimage.binary_dilation(anchors, _EIGHT), structure=_EIGHT)
    of_anchor = group[anchors]
    count = np.bincount(of_anchor)
    farthest = np.zeros(len(count))
    np.maximum.at(farthest, of_anchor, distance[anchors])
    few = np.zeros(anchors.shape, bool)
    few[anchors] = ((count < MIN_RUN) & (farthest < COARSE_DISTANCE))[of_anchor]
    return few


def medial_cells(space: FreeConfigurations, regions: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Medial cells of some regions of the free configurations, one cell thin.

    Two passes: the first thins down to the anchors and shortens every branch without one; the
    second thins what is left between clustered anchors and keeps the tips of branches.

    Args:
        space: Free configurations.
        regions: (H, W) bool, the cells of the regions.
        kept: (H, W) bool, anchors: cells that hold dead ends.

    Returns:
        (H, W) bool.
    """
    level = (4.0 * space.distance).astype(np.int32)
    rough = _thin(regions, level, kept, ends=False)
    return _thin(rough, level, np.zeros_like(kept), ends=True)


def _rules() -> tuple[np.ndarray, np.ndarray]:
    """For each pattern (256,) of the eight neighbours: is the cell simple, how many are set.

    A cell is simple if its removal changes neither components nor holes: its neighbours hold one
    component (8-connected) and one component of background (4-connected) that touches it. This is
    so if its 8-connectivity number is 1. With b_k = 1 for a background neighbour, k in circular
    order from a side neighbour,

        N = sum over k in {0, 2, 4, 6} of  b_k - b_k b_(k+1) b_(k+2)

          # # #             # # #              # = set
          . x .   N = 2     . x #   N = 1      left: removing x would join the two sides
          # # #             . # #              right: x is simple

    References:
        Yokoi, Toriwaki, Fukumura (1975), An analysis of topological properties of digitized
        binary pictures using local features.
    """
    pattern = np.arange(256)
    background = [1 - ((pattern >> (k % 8)) & 1) for k in range(9)]
    terms = [
        background[k] - background[k] * background[k + 1] * background[k + 2] for k in (0, 2, 4, 6)
    ]
    return np.sum(terms, axis=0) == 1, 8 - np.sum(background[:8], axis=0)


_SIMPLE, _COUNT = _rules()


def _thin(cells: np.ndarray, level: np.ndarray, kept: np.ndarray, *, ends: bool) -> np.ndarray:
    """Remove simple cells, level by level, as long as there are any.

        for each level, ascending:
            pending = removable cells of this level
            while pending:
                for each of the four parity classes, one after the other:
                    remove all pending cells of the class that are simple
                pending = remaining removable cells, of this level or lower, beside a removed one

    Cells of one class do not touch, so removing them at once is the same as one by one:

        0 1 0 1
        2 3 2 3      parity class = 2 (row mod 2) + (column mod 2)
        0 1 0 1

    Args:
        cells: (H, W) bool.
        level: (H, W) int, the order of removal; a cell that is not simple when its level comes is
            tried again whenever a neighbour has been removed.
        kept: (H, W) bool, cells that are never removed.
        ends: Whether a cell with a single neighbour, the tip of a branch, is kept.

    Returns:
        (H, W) bool.
    """
    # Flat indices of a padded grid: neighbours are at constant offsets, and all of them exist.
    width = cells.shape[1] + 2
    is_set = np.pad(cells, 1).ravel()
    removable = is_set & ~np.pad(kept, 1).ravel()
    level = np.where(removable, np.pad(level, 1).ravel(), np.iinfo(level.dtype).max)
    offsets = np.array([row * width + column for row, column in _ROUND])
    bits = 1 << np.arange(8)
    order = np.flatnonzero(removable)
    order = order[np.argsort(level[order], kind="stable")]
    levels, first = np.unique(level[order], return_index=True)
    for current, pending in zip(levels, np.split(order, first[1:]), strict=True):
        while pending.size:
            removed = []
            parity = 2 * (pending // width % 2) + pending % width % 2
            for parity_class in range(4):
                tried = pending[parity == parity_class]
                pattern = is_set[tried[:, None] + offsets] @ bits
                remove = _SIMPLE[pattern] & ~(ends & (_COUNT[pattern] == 1))
                is_set[tried[remove]] = False
                removed.append(tried[remove])
            beside = (np.concatenate(removed)[:, None] + offsets).ravel()
            pending = np.unique(beside[is_set[beside] & (level[beside] <= current)])
    return is_set.reshape(-1, width)[1:-1, 1:-1]
