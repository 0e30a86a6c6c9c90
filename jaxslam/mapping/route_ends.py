"""Start and goal of a route: what they may be, and what is wrong with those that may not."""

import difflib
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.regions import Regions, innermost
from jaxslam.core.types import as_float64
from jaxslam.mapping.arc_points import ArcPoints
from jaxslam.mapping.clearance import ClearanceField, clearance_at
from jaxslam.mapping.free_paths import FreeSpace
from jaxslam.mapping.planner_data import region_at

DOOR_DISTANCE = 1.0  # [m] from the doors of a room from which on a point is well inside
MAX_STRAIGHT = 5.0  # [m] from an arc, at most, without an occupancy map
MAX_NAMES = 5  # names of regions in an error


class Goal(NamedTuple):
    """Where a route ends: at a point, or at the nearest of some points of arcs.

    Attributes:
        name: As a person would say it.
        xy: (2,) [m] the point, map frame, or None.
        points: Indices of points of arcs, empty if there is a point.
    """

    name: str
    xy: np.ndarray | None
    points: np.ndarray


def text(xy: np.ndarray) -> str:
    """A point [m] as text."""
    return f"({xy[0]:.2f}, {xy[1]:.2f})"


def checked_point(name: str, xy: ArrayLike) -> np.ndarray:
    """A point (2,) [m] as an array; ValueError if it is none or not finite."""
    point = as_float64(name, xy, (2,))
    if not np.isfinite(point).all():
        raise ValueError(f"{name} ({point[0]:g}, {point[1]:g}) is not finite")
    return point


def checked_goal(
    goal: ArrayLike | str,
    points: ArcPoints,
    regions: Regions | None,
    field: ClearanceField | None,
    robot_radius: float,
) -> Goal:
    """The goal of a route, a point or what of a region is well inside.

    That is: its points of arcs at least `DOOR_DISTANCE` from its doors, else the one farthest from
    them; in a region without arcs for this robot the point farthest from obstacles.

    Raises:
        ValueError: It is no point, or there is no such region.
    """
    if not isinstance(goal, str):
        xy = checked_point("goal", goal)
        return Goal(text(xy), xy, np.zeros(0, int))
    if regions is None or not regions.regions:
        raise ValueError(f"goal is {goal!r}, and the map has no rooms")
    names = [region.name for region in regions.regions]
    if goal not in names:
        near = difflib.get_close_matches(goal, names, MAX_NAMES, cutoff=0.0)
        more = f" and {len(names) - len(near)} more" if len(names) > len(near) else ""
        raise ValueError(f"goal is {goal!r}, no room of the map; it has {', '.join(near)}{more}")
    index = names.index(goal)
    on_arc = np.unique(points.edges[points.passable(robot_radius)])
    inside = on_arc[region_at(regions, points.xy[on_arc]) == index]
    if not inside.size:
        return Goal(goal, _middle(regions, index, field), inside)
    doors = [regions.doors[k].xy for k in regions.regions[index].doors]
    if not doors:
        return Goal(goal, None, inside)
    offset = points.xy[inside][:, None] - np.array(doors)
    distance = np.hypot(offset[..., 0], offset[..., 1]).min(axis=1)
    return Goal(goal, None, inside[distance >= min(DOOR_DISTANCE, distance.max())])


def _middle(regions: Regions, index: int, field: ClearanceField | None) -> np.ndarray:
    """The point (2,) [m] of a region that is farthest from obstacles."""
    polygon = regions.regions[index].polygon
    if field is None:
        return innermost(regions.regions[index])[0]
    cells = np.floor(field.to_cells(polygon)).astype(int)
    low, high = (
        np.maximum(cells.min(axis=0), 0),
        np.minimum(cells.max(axis=0) + 1, field.free.shape),
    )
    window = field.distance[low[0] : high[0], low[1] : high[1]]
    centres = field.to_map(np.indices(window.shape).reshape(2, -1).T + low + 0.5)
    inside = (region_at(regions, centres) == index) & field.free[
        low[0] : high[0], low[1] : high[1]
    ].ravel()
    if not inside.any():
        return innermost(regions.regions[index])[0]
    return np.asarray(centres[np.argmax(np.where(inside, window.ravel(), -1.0))])


def require_free(name: str, xy: np.ndarray, space: FreeSpace, robot_radius: float) -> None:
    """Raise ValueError unless a robot may be at a point (2,) [m]."""
    field, where = space.field, f"{name} {text(xy)} is"
    if not field.contains(xy[None])[0]:
        h, w = field.free.shape
        corners = field.to_map(np.array([[0, 0], [h, 0], [0, w], [h, w]], float))
        (x, y), (x_max, y_max) = corners.min(axis=0), corners.max(axis=0)
        limits = f"x {x:.1f} to {x_max:.1f} m, y {y:.1f} to {y_max:.1f} m"
        raise ValueError(f"{where} outside of the map, which reaches {limits}")
    cell = tuple(np.floor(field.to_cells(xy[None])[0]).astype(int))
    if field.distance[cell] == 0.0:
        raise ValueError(f"{where} in a wall")
    if not field.free[cell]:
        raise ValueError(f"{where} in unknown space")
    if not space.free[cell]:
        near = min(float(clearance_at(field, xy[None])[0]), field.distance[cell])
        problem = f"{where} {near:.2f} m from an obstacle, nearer than the robot radius of"
        raise ValueError(f"{problem} {robot_radius:g} m{_nearest_free(space, xy)}")


def _nearest_free(space: FreeSpace, xy: np.ndarray) -> str:
    """The point nearest to another where the robot may be, as an advice; empty without any."""
    centres = space.field.to_map(np.argwhere(space.free) + 0.5)
    if not len(centres):
        return ""
    return f"; it fits at {text(centres[np.argmin(np.hypot(*(centres - xy).T))])}"


def require_near(name: str, xy: np.ndarray, points: ArcPoints) -> None:
    """Raise ValueError if a point (2,) [m] is far from all arcs, or there are none."""
    on_arc = points.xy[np.unique(points.edges)]
    if not on_arc.size:
        raise ValueError("the map has no arcs, and without an occupancy map routes follow arcs")
    distance = np.hypot(*(on_arc - xy).T).min(initial=np.inf)
    if not distance <= MAX_STRAIGHT:
        raise ValueError(
            f"{name} {text(xy)} is {distance:.1f} m from the nearest arc; without an occupancy map "
            f"{MAX_STRAIGHT:g} m are allowed"
        )
