"""Why no route leads to a goal, in one line."""

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.regions import Regions
from jaxslam.mapping.arc_points import ArcPoints
from jaxslam.mapping.clearance import ClearanceField, widest_near
from jaxslam.mapping.route_ends import Goal, text
from jaxslam.mapping.route_search import find_line, is_joined

PRECISION = 0.005  # [m] of the width of the narrowest place
NEAR_DOOR = 0.5  # [m] from the middle of a door within which a narrow place is named after it


def reason(
    points: ArcPoints,
    field: ClearanceField | None,
    start: np.ndarray,
    goal: Goal,
    robot_radius: float,
    regions: Regions | None = None,
) -> str:
    """Why there is no route; the arguments are those of `find_line`, which found none."""
    what = f"no route leads from {text(start)} to {goal.name}: "
    if is_joined(points, field, start, goal, robot_radius):
        both = points._replace(directed=np.zeros_like(points.directed))
        if points.directed.any() and find_line(both, field, start, goal, robot_radius) is not None:
            return what + "one-way arcs lead in the other direction"
        return what + "the arcs near the two are not joined"
    if not is_joined(points, field, start, goal, 0.0):
        return what + "they are in separate parts of the map"
    low, high = 0.0, robot_radius
    while high - low > PRECISION:
        middle = 0.5 * (low + high)
        joined = is_joined(points, field, start, goal, middle)
        low, high = (middle, high) if joined else (low, middle)
    if low == 0.0 and np.isnan(points.width).any() and field is None:
        return what + "the width of an arc to it is not known"
    xy = _narrowest(points, field, start, goal, low)
    where = "" if xy is None else f", at {text(xy)},"
    for door in () if regions is None or xy is None else regions.doors:
        if np.hypot(*(door.xy - xy)) <= NEAR_DOOR:
            where = f", the door {door.name},"
            if door.width < 2.0 * robot_radius:
                is_wide = f"is {door.width:.2f} m wide"
                return what + f"its door {door.name} {is_wide}, the robot {2 * robot_radius:.2f} m"
    return what + (
        f"its narrowest place{where} is {low:.2f} m from obstacles, and the robot needs "
        f"{robot_radius:.2f} m"
    )


def _narrowest(
    points: ArcPoints,
    field: ClearanceField | None,
    start: np.ndarray,
    goal: Goal,
    robot_radius: float,
) -> np.ndarray | None:
    """The point (2,) [m] where the route of a robot is narrowest, in any direction of travel."""
    both = points._replace(directed=np.zeros_like(points.directed))
    found = find_line(both, field, start, goal, robot_radius)
    if found is None:
        return None
    line, arc = found
    if field is None:
        edge = np.flatnonzero(np.isin(points.arc, arc[arc >= 0]))
        edge = edge[[np.argmin(np.nan_to_num(points.width[edge], nan=0.0))]]
        return np.asarray(points.xy[points.edges[edge[0]]].mean(axis=0))
    samples = polylines.refine(line, 0.05)
    return np.asarray(samples[np.argmin(widest_near(field, samples))])
