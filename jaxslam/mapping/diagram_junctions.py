"""Junctions of the diagram of a grid whose third branch leads into a corner.

The medial axis of `medial_axis` has no branches into corners, as no robot needs them. A junction of
the paper is where a circle touches three walls, wherever its branches lead; so along the medial
axis those cells are looked for that have obstacles in three directions at the same distance:

        +-----------------
        |     third foot
        |  o-----------o        both o are junctions; their branches into the corners of the
        |                       room are not in the medial axis
        +-----------------
"""

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxslam.core.maps import OccupancyMap
from jaxslam.mapping.medial_axis import FreeConfigurations

MIN_FOOT_ANGLE = 0.6
"""[rad] between two feet, as of a trusted junction of a scan (`FeatureSpec`)."""

TOUCH = 1.3
"""[cells] by which two feet of one circle may differ in distance, for the size of the cells."""

SNAP = 4.0
"""[cells] from a cell where branches meet, within which it is the same junction."""

HIDDEN = 0.3
"""[m] from a wall that was seen, within which a foot lies."""

_EIGHT = np.ones((3, 3), bool)


def corner_junctions(
    occupancy: OccupancyMap, free: np.ndarray, space: FreeConfigurations, cells: np.ndarray
) -> np.ndarray:
    """Which cells (H, W) bool of a medial axis are junctions, one cell for each.

    Args:
        occupancy: The grid.
        free: (H, W) bool, its free cells, small islands filled.
        space: Free configurations.
        cells: (H, W) bool, the medial axis.
    """
    junctions = np.zeros(cells.shape, bool)
    edge = np.argwhere(~free & ndimage.binary_dilation(free, _EIGHT))
    index = np.argwhere(cells)
    if not len(edge) or not len(index) or not occupancy.occupied.any():
        return junctions
    tree, walls = cKDTree(edge), cKDTree(np.argwhere(occupancy.occupied))
    hidden = HIDDEN / occupancy.resolution
    uneven = np.full(cells.shape, np.inf)
    for i, j in index.tolist():
        here = np.array([i, j])
        near = edge[tree.query_ball_point(here, space.distance[i, j] + 0.5 + TOUCH)]
        feet = _feet(near - here)
        if len(feet) >= 3 and np.all(walls.query(feet + here)[0] < hidden):
            lengths = np.sort(np.hypot(*feet.T))
            uneven[i, j] = lengths[2] - lengths[0]
    label, count = ndimage.label(np.isfinite(uneven), structure=_EIGHT)
    if not count:
        return junctions
    found = np.array(ndimage.minimum_position(uneven, label, np.arange(1, count + 1)))
    # Where three branches of the axis meet beside it, that cell is the junction.
    around = ndimage.convolve(cells.astype(int), _EIGHT.astype(int), mode="constant") - 1
    meeting = np.argwhere(cells & (around > 2))
    if len(meeting):
        apart, nearest = cKDTree(meeting).query(found)
        found = np.where((apart < SNAP)[:, None], meeting[nearest], found)
    junctions[tuple(found.T)] = True
    return junctions


def _feet(offsets: np.ndarray) -> np.ndarray:
    """The nearest of each group of offsets (N, 2) that lie in one direction."""
    angle = np.arctan2(offsets[:, 1], offsets[:, 0])
    order = np.argsort(angle)
    gaps = np.diff(np.append(angle[order], angle[order[0]] + 2 * np.pi))
    breaks = np.flatnonzero(gaps > MIN_FOOT_ANGLE)
    if len(breaks) < 3:
        return np.zeros((0, 2))
    groups = np.split(np.roll(order, -breaks[0] - 1), np.cumsum(np.diff(breaks)))
    return np.array([offsets[g[np.argmin(np.hypot(*offsets[g].T))]] for g in groups])
