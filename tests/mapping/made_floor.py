"""A made floor for tests of routes: a corridor, two rooms beside it, three doors that make a ring.

Cells of 0.1 m; in the frame of the grid, in metres:

    6.0  +---------------+------------------+
         |    room_1   door_3     room_2    |     door_3: x 6.0, y 4.0 to 5.0
    3.0  +---door_1------+--------door_2----+     door_1: x 2.0 to 3.0, door_2: x 9.0 to 9.6
         |            room_3 (corridor)     |
    1.2  +----------------------------------+
         0.3                               11.7
"""

from functools import cache

import numpy as np

from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.regions import Door, Region, Regions
from jaxslam.core.se2_np import transform
from jaxslam.mapping import extract_topology

RESOLUTION, RADIUS = 0.1, 0.2
ORIGIN = np.array([-5.0, 2.0, 0.3])
BOXES = {"room_1": (0.3, 3.2, 5.9, 6.0), "room_2": (6.1, 3.2, 11.7, 6.0)}
BOXES["room_3"] = (0.3, 1.2, 11.7, 3.0)
DOORS = {"door_1": (2.0, 3.0, 3.0, 3.2), "door_2": (9.0, 3.0, 9.6, 3.2)}
DOORS["door_3"] = (5.9, 4.0, 6.1, 5.0)
SIDES = {"door_1": (0, 2), "door_2": (1, 2), "door_3": (0, 1)}


def at(*points):
    """Points of the frame of the grid [m] in the map frame."""
    return transform(ORIGIN, np.array(points, float))


def cells(box):
    """The cells of a box (x, y, x, y) [m]."""
    x, y, x_end, y_end = np.round(np.array(box) / RESOLUTION).astype(int)
    return np.s_[x:x_end, y:y_end]


def occupancy(closed=()):
    free = np.zeros((121, 71), bool)
    for name, box in (BOXES | DOORS).items():
        if name not in closed:
            free[cells(box)] = True
    known = np.zeros(free.shape, bool)
    known[:, :62] = True  # what lies behind is unknown
    return OccupancyMap(known & ~free, free, RESOLUTION, ORIGIN)


def regions(with_cells=True):
    label = np.zeros((121, 71), np.int32)
    found = []
    for k, (name, box) in enumerate(BOXES.items()):
        label[cells(box)] = k + 1
        x, y, x_end, y_end = box
        polygon = at((x, y), (x_end, y), (x_end, y_end), (x, y_end))
        doors = tuple(d for d, sides in enumerate(SIDES.values()) if k in sides)
        others = tuple(j for sides in SIDES.values() if k in sides for j in sides if j != k)
        kind = "corridor" if name == "room_3" else "room"
        found.append(Region(name, kind, polygon, (x_end - x) * (y_end - y), doors, others))
    doors = []
    for name, (x, y, x_end, y_end) in DOORS.items():
        middle = 0.5 * (x + x_end), 0.5 * (y + y_end)
        along_x = x_end - x > y_end - y
        jambs = [(x, middle[1]), (x_end, middle[1])] if along_x else [(middle[0], y)]
        jambs = at(*jambs) if along_x else at((middle[0], y), (middle[0], y_end))
        width = float(np.hypot(*(jambs[1] - jambs[0])))
        doors.append(Door(name, at(middle)[0], jambs, width, SIDES[name]))
    label = label if with_cells else np.zeros((0, 0), np.int32)
    return Regions(label, tuple(found), tuple(doors), RESOLUTION, ORIGIN)


@cache
def graph():
    """The topological map of the floor."""
    grid = occupancy()
    return extract_topology(
        grid.occupied,
        grid.free,
        resolution=RESOLUTION,
        origin=ORIGIN,
        robot_radius=RADIUS,
    ).graph


def straight_graph(xy, pairs, lines=None, clearance=1.0):
    """Arcs without a bend, by default, between nodes (N, 2) [m]."""
    pairs = np.array(pairs)
    lines = tuple(xy[pair] for pair in pairs) if lines is None else lines
    return TopologicalMap(
        id=np.arange(len(xy)),
        xy=xy,
        kind=np.zeros(len(xy), int),
        clearance=np.ones(len(xy)),
        arc_ends=pairs,
        arc_length=np.array([np.hypot(*np.diff(line, axis=0).T).sum() for line in lines]),
        arc_clearance=np.full(len(pairs), clearance),
        arc_lines=lines,
    )
