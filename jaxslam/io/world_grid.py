"""Walls of an occupancy grid: the outline of its occupied cells."""

import numpy as np
from scipy import ndimage

from jaxslam.core.maps import OccupancyMap
from jaxslam.core.se2_np import transform
from jaxslam.io.world_outline import rings, straight_sides

SPECK = 2  # cells of an obstacle that may be noise of the map, at most


def walls(occupancy: OccupancyMap) -> tuple[np.ndarray, tuple[str, ...]]:
    """Walls (S, 4) [m, map frame] of a grid: both faces of what is occupied; and notes.

    Unknown space is no wall: a robot that mapped the building has not seen one there, and one made
    up would return beams that leave in truth; the note says how long the border is that beams can
    cross. Pockets that occupied cells close off without a free cell inside are part of the walls,
    as no beam can get there. Specks stay, since furniture is as small.
    """
    occupied, free = np.asarray(occupancy.occupied), np.asarray(occupancy.free)
    space, count = ndimage.label(~occupied)
    seen = np.zeros(count + 1, bool)
    seen[space[free & ~occupied]] = True
    for border in (space[0], space[-1], space[:, 0], space[:, -1]):
        seen[border] = True
    seen[0] = False
    outlines = rings(~seen[space])
    del space
    sides = [np.hstack([p, np.roll(p, -1, axis=0)]) for p in map(straight_sides, outlines)]
    ends = np.concatenate(sides).reshape(-1, 2, 2) if sides else np.zeros((0, 2, 2))
    ends = transform(np.asarray(occupancy.origin, float), ends * occupancy.resolution)
    return ends.reshape(-1, 4), (*occupancy.notes, *_notes(occupied, free, occupancy.resolution))


def _notes(occupied: np.ndarray, free: np.ndarray, resolution: float) -> list[str]:
    """Notes on what is not certain."""
    notes = []
    unknown = ~(occupied | free)
    border = sum(
        int((free[a] & unknown[b]).sum() + (unknown[a] & free[b]).sum())
        for a, b in (
            ((slice(1, None), ...), (slice(None, -1), ...)),
            ((..., slice(1, None)), (..., slice(None, -1))),
        )
    )
    if border:
        notes.append(
            f"unknown space is no wall: free space borders it on {border * resolution:.0f} m"
        )
    parts, _ = ndimage.label(occupied, np.ones((3, 3)))
    small = int((np.bincount(parts.ravel())[1:] <= SPECK).sum())
    if small:
        notes.append(f"specks of {SPECK} cells or less are kept as obstacles ({small})")
    return notes
