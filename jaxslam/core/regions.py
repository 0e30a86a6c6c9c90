"""Rooms, corridors and halls of a map, and the doors between them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

REGION_KINDS = ("room", "corridor", "hall")
_SAMPLES = 40_000  # points in the bounding box of a region, of which one is the innermost


class Region(NamedTuple):
    """A part of free space that doors bound.

    Attributes:
        name: `room_12`, whatever its kind; unique, and the same in later sessions.
        kind: One of `REGION_KINDS`.
        polygon: (n >= 3, 2) [m] its outer boundary, map frame, counter-clockwise, open.
        area: [m^2] of its free cells.
        doors: Indices of its doors.
        neighbours: Indices of the regions that it shares a door with.
        holes: (n >= 3, 2) [m] its inner boundaries, map frame, clockwise, open.
    """

    name: str
    kind: str
    polygon: np.ndarray
    area: float
    doors: tuple[int, ...]
    neighbours: tuple[int, ...]
    holes: tuple[np.ndarray, ...] = ()


class Door(NamedTuple):
    """A narrow place between two regions, with or without a door leaf.

    Attributes:
        name: `door_3`; unique.
        xy: (2,) [m] its middle, map frame.
        jambs: (2, 2) [m] the two ends of its narrowest line across, map frame.
        width: [m] of that line.
        regions: Indices of the regions on its two sides.
    """

    name: str
    xy: np.ndarray
    jambs: np.ndarray
    width: float
    regions: tuple[int, int]


class Regions(NamedTuple):
    """Division of an occupancy map into regions.

    Attributes:
        label: (H, W) int32 of the cells of the map [i, j]: k + 1 in region k, 0 in none.
        regions: R regions.
        doors: D doors.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
        last_numbers: Highest numbers that names of regions and of doors ever had, also of those
            that are no more.
    """

    label: np.ndarray
    regions: tuple[Region, ...]
    doors: tuple[Door, ...]
    resolution: float
    origin: np.ndarray
    last_numbers: tuple[int, int] = (0, 0)


class PlannerData(NamedTuple):
    """What a planner needs of the N nodes and A arcs of a topological map, beyond the map itself.

    Attributes:
        node_region: (N,) int index of the region that a node lies in, -1 for none.
        arc_region: (A,) int index of the region that most of an arc lies in, -1 for none.
        arc_doors: Indices of the doors that each arc passes through, or ends at, in its direction.
        arc_widths: A arrays (n,) [m] distance to the nearest obstacle at places of the arc, evenly
            from its first end to its last, its width profile; NaN where it is not known.
        frontier_doors: Indices of the doors between each open end and its node, in that direction;
            empty where that was not looked at.
    """

    node_region: np.ndarray
    arc_region: np.ndarray
    arc_doors: tuple[tuple[int, ...], ...]
    arc_widths: tuple[np.ndarray, ...]
    frontier_doors: tuple[tuple[int, ...], ...] = ()


def signed_area(ring: np.ndarray) -> float:
    """Area [m^2] that a closed ring (n, 2) [m] encloses, negative if it is clockwise."""
    x, y = (ring - ring[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def outer_first(regions: Sequence[Region]) -> list[int]:
    """Indices of regions, those with large polygons first.

    Of regions whose holes are not known, the last one that contains a point is the innermost.
    """
    return sorted(range(len(regions)), key=lambda k: (-abs(signed_area(regions[k].polygon)), k))


def contains(region: Region, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 2) [m, map frame] lie in a region: a ray crosses its rings an odd number.

    Returns:
        (N,) bool.
    """
    rings = region.polygon, *region.holes
    start = np.concatenate(rings)
    end = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    across, up = (end - start).T
    slope = across / np.where(up == 0.0, 1.0, up)
    order = np.argsort(points[:, 1], kind="stable")
    x, y = points[order].T
    first, last = np.searchsorted(y, np.sort([start[:, 1], end[:, 1]], axis=0))
    odd = np.zeros(len(points), bool)
    for k in np.flatnonzero(first < last).tolist():
        spanned = slice(first[k], last[k])
        odd[spanned] ^= x[spanned] < start[k, 0] + slope[k] * (y[spanned] - start[k, 1])
    inside = np.zeros(len(points), bool)
    inside[order] = odd
    return inside


def innermost(region: Region) -> tuple[np.ndarray, float]:
    """The point of a region that is farthest from its border, the middle one of several.

    Returns:
        The point (2,) [m, map frame], and its distance [m] to the border or a little less.
    """
    low, high = region.polygon.min(axis=0), region.polygon.max(axis=0)
    size = np.maximum(high - low, 1e-9)
    step = max(float(np.sqrt(np.prod(size) / _SAMPLES)), 1e-3 * float(size.max()))
    shape = np.ceil(size / step).astype(int)
    from_middle = np.indices(shape).reshape(2, -1).T - 0.5 * (shape - 1)
    points = 0.5 * (low + high) + step * from_middle
    inside = contains(region, points)
    if not inside.any():
        return np.asarray(region.polygon[0]), 0.0
    distance = ndimage.distance_transform_edt(np.pad(inside.reshape(shape), 1))[1:-1, 1:-1].ravel()
    middle = points[inside].mean(axis=0)
    candidates = np.flatnonzero(distance > distance.max() - 1.0)
    best = candidates[np.hypot(*(points[candidates] - middle).T).argmin()]
    return points[best], max(float(distance[best]) - 1.5, 0.0) * step
