"""Rooms, corridors and halls of a map, and the doors between them."""

from typing import NamedTuple

import numpy as np

REGION_KINDS = ("room", "corridor", "hall")


class Region(NamedTuple):
    """A part of free space that doors bound.

    Attributes:
        name: `room_12`, whatever its kind; unique, and the same in later sessions.
        kind: One of `REGION_KINDS`.
        polygon: (n >= 3, 2) [m] its outer boundary, map frame, counter-clockwise, open.
        area: [m^2] of its free cells.
        doors: Indices of its doors.
        neighbours: Indices of the regions that it shares a door with.
    """

    name: str
    kind: str
    polygon: np.ndarray
    area: float
    doors: tuple[int, ...]
    neighbours: tuple[int, ...]


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
        arc_doors: Indices of the doors that each arc passes through, in its direction.
        arc_widths: A arrays (n,) [m] distance to the nearest obstacle at places of the arc, evenly
            from its first end to its last, its width profile; NaN where it is not known.
    """

    node_region: np.ndarray
    arc_region: np.ndarray
    arc_doors: tuple[tuple[int, ...], ...]
    arc_widths: tuple[np.ndarray, ...]
