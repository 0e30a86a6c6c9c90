"""A map of two rooms and a corridor with doors, an open end, a loop and parallel arcs."""

import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import Door, PlannerData, Region, Regions
from jaxslam.core.types import CORNER, JUNCTION

ARC_WIDTHS = (
    np.array([1.2, 0.45, 0.45, 1.2]),
    np.array([1.2, 0.9, np.nan, 1.0]),
    np.array([np.nan, np.nan]),
    np.array([0.3, 0.3, 0.3, 0.3, 0.3]),
)


def building():
    """Nodes 5 and 8 in the corridor, 11 in room 1, a corner 7; open end 30."""
    return TopologicalMap(
        id=np.array([5, 7, 8, 11]),
        xy=np.array([[0.0, 0.0], [1.0, 3.0], [6.0, 0.0], [6.0, 8.0]]),
        kind=np.array([JUNCTION, CORNER, JUNCTION, JUNCTION]),
        clearance=np.array([1.2, 0.0, 1.2, np.inf]),
        arc_ends=np.array([[2, 3], [0, 2], [0, 2], [3, 3]]),
        arc_length=np.array([8.0, 6.1, 9.0, 6.0]),
        arc_clearance=np.array([0.5, 0.8, np.nan, 0.3]),
        arc_lines=(
            np.array([[6.0, 0.0], [6.05, 3.9], [6.0, 4.1], [6.0, 8.0]]),
            np.array([[0.0, 0.0], [2.0, 0.02], [4.0, 0.02], [6.0, 0.0]]),
            np.array([[0.0, 0.0], [3.0, -3.0], [6.0, 0.0]])[[0, 1, 1, 2]],
            np.array([[6.0, 8.0], [8.0, 8.0], [8.0, 9.0], [6.0, 9.0], [6.0, 8.0]]),
        ),
        frontiers=(np.array([[0.0, 0.0], [-1.0, 0.0], [-1.0, -2.0]]),),
        frontier_node=np.array([0]),
        frontier_id=np.array([30]),
    )


def regions():
    """Corridor `room_2` and `room_1`, with two doors one behind the other on arc 0."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    return Regions(
        label=np.zeros((2, 2), np.int32),
        regions=(
            Region("room_2", "corridor", square, 30.0, (0, 1), (1,)),
            Region("room_1", "room", square + 5.0, 20.0, (0, 1), (0,)),
        ),
        doors=(
            Door("door_3", np.array([6.0, 4.0]), np.array([[5.5, 4.0], [6.5, 4.0]]), 1.0, (0, 1)),
            Door("door_4", np.array([6.0, 5.2]), np.array([[5.6, 5.2], [6.4, 5.2]]), 0.8, (0, 1)),
        ),
        resolution=0.05,
        origin=np.zeros(3),
    )


def planner():
    return PlannerData(
        node_region=np.array([0, -1, 0, 1]),
        arc_region=np.array([0, 0, -1, 1]),
        arc_doors=((0, 1), (), (), ()),
        arc_widths=ARC_WIDTHS,
    )
