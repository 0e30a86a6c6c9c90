"""Routes of a robot over a topological map, between any two points of free space.

points of the arcs that are wide enough, with an edge between neighbours (`arc_points`)
+ an edge from the start to each that free space joins to it (`free_paths`), likewise to the
  goal, and one from start to goal
-> shortest path in this graph (`route_search`) -> polyline -> legs (`route_legs`)
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.maps import OccupancyMap, TopologicalMap, check_occupancy, without_arcs
from jaxslam.core.regions import Regions
from jaxslam.core.types import as_numpy, as_size, check_array
from jaxslam.mapping import no_route, route_ends, route_search
from jaxslam.mapping.arc_points import arc_points
from jaxslam.mapping.clearance import ClearanceField, clearance_field
from jaxslam.mapping.free_paths import free_space
from jaxslam.mapping.planner_data import check_types
from jaxslam.mapping.route_legs import (
    Leg,
    followed,
    narrowest,
    split_into_legs,
    without_straight_points,
)


class PlannedRoute(NamedTuple):
    """A route of a robot, map frame.

    Attributes:
        line: (n, 2) [m] polyline from start to goal.
        length: [m].
        clearance: [m] distance to the nearest obstacle at its narrowest place; NaN if not known.
            Without an occupancy map that of its arcs, NaN if it follows none.
        arcs: Indices of the arcs that it follows, in order.
        legs: Its parts, as a person would describe them.
    """

    line: np.ndarray
    length: float
    clearance: float
    arcs: tuple[int, ...]
    legs: tuple[Leg, ...]


def route(
    topological_map: TopologicalMap,
    start: ArrayLike,
    goal: ArrayLike | str,
    *,
    occupancy: OccupancyMap | None = None,
    regions: Regions | None = None,
    robot_radius: float = 0.25,
    directed: ArrayLike | None = None,
) -> PlannedRoute:
    """Shortest route over a topological map between two points, or from a point to a room.

    The route leads through free space to an arc, over arcs, and through free space to the goal.
    It enters and leaves arcs anywhere, where its length is least, and follows none if start and
    goal see each other. Without an occupancy map it goes straight to the nearest arc and straight
    from an arc to the goal, however near the two are: no other line is known to be free. A route
    from a point to itself has no length.

    Args:
        topological_map: The map.
        start: (2,) [m] map frame.
        goal: (2,) [m] map frame, or the name of a region: a point of an arc inside.
        occupancy: Occupancy map in the same frame: obstacles, and the width along arcs.
        regions: Rooms and doors in the same frame, for `goal` and the legs.
        robot_radius: [m] An arc is followed where the robot fits: by the occupancy map, to within a
            cell, else by `arc_clearance`. Where the width is not known it fits only if this is 0.
        directed: (A,) bool arcs that are driven in the direction of their polylines alone; the
            robot does not go beside them in the other direction, either.

    Raises:
        ValueError: In one line: the start or goal is in a wall, in unknown space, too near to an
            obstacle or outside of the map, or, without an occupancy map, more than 5 m from all
            arcs; there is no such region; no route leads there; or an argument is of another type,
            shape or range.
    """
    check_types(topological_map, regions)
    robot_radius = as_size("robot_radius", robot_radius)
    if directed is not None:
        directed = as_numpy("directed", directed)
        check_array("directed", directed, (len(topological_map.arc_lines),), np.bool_)
    field = _field(occupancy)
    points = arc_points(topological_map, field, directed)
    ends = [("start", route_ends.checked_point("start", start))]
    where = route_ends.checked_goal(goal, points, regions, field, robot_radius)
    if where.xy is not None:
        ends.append(("goal", where.xy))
    space = None if field is None else free_space(field, points, robot_radius)
    for name, xy in ends:
        if space is None:
            route_ends.require_near(name, xy, points)
        else:
            route_ends.require_free(name, xy, space, robot_radius)
    given = points, field, ends[0][1], where, robot_radius
    found = route_search.find_line(*given)
    if found is None:
        raise ValueError(no_route.reason(*given, regions))
    line, arc = found
    legs = split_into_legs(topological_map, line, arc, field=field, regions=regions)
    return PlannedRoute(
        line=without_straight_points(line),
        length=float(np.hypot(*np.diff(line, axis=0).T).sum()),
        clearance=narrowest(legs, field),
        arcs=followed(np.array([k for leg in legs for k in leg.arcs], int)),
        legs=legs,
    )


def drivable(
    topological_map: TopologicalMap, robot_radius: float, *, occupancy: OccupancyMap | None = None
) -> TopologicalMap:
    """The part of a map that a robot can drive: all nodes, and the arcs on which it fits.

    Args:
        topological_map: The map.
        robot_radius: [m].
        occupancy: Occupancy map in the same frame, which gives the width along arcs to within a
            cell. Without it, and beyond it, `arc_clearance` counts; an arc whose width neither
            knows is left out, but of a robot of radius 0.

    Raises:
        ValueError: An argument is of another type, shape or range.
    """
    check_types(topological_map)
    robot_radius = as_size("robot_radius", robot_radius)
    points = arc_points(topological_map, _field(occupancy))
    gone = np.zeros(len(topological_map.arc_lines), bool)
    gone[points.arc[~points.passable(robot_radius)]] = True
    return without_arcs(topological_map, gone)


def _field(occupancy: OccupancyMap | None) -> ClearanceField | None:
    """Distances to the obstacles of an occupancy map, checked, if there is one."""
    return None if occupancy is None else clearance_field(check_occupancy(occupancy))
