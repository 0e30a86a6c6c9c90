"""Routes over a map, and how to follow a path."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam import ways
from jaxslam.geometry import range_bearing, to_robot
from jaxslam.motion import arc
from jaxslam.topomap import Graph
from jaxslam.types import Array

WINDOW = 40  # points of the path ahead of the robot that are looked at
SHARP = 0.6  # [rad] a target farther off the bow than this is first turned to
CLOSE = 0.05  # [m] from the end of its path the robot stops


def densify(waypoints: np.ndarray, spacing: float = 0.05) -> np.ndarray:
    """Points (N, 2) about `spacing` [m] apart on the straight lines that join way points (K, 2).

    Raises:
        ValueError: The way points have another shape.
    """
    if np.ndim(waypoints) != 2 or len(waypoints) < 1 or np.shape(waypoints)[1] != 2:
        raise ValueError(f"waypoints is {np.shape(waypoints)}, not (K >= 1, 2)")
    legs = np.hypot(*np.diff(waypoints, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    at = np.linspace(0.0, along[-1], round(along[-1] / spacing) + 1)
    at = np.unique(np.concatenate([at, along]))
    return np.stack([np.interp(at, along, waypoints[:, k]) for k in range(2)], axis=1)


def follow(
    path: Array,
    place: Array,
    pose: Array,
    *,
    lookahead: float = 0.5,
    stride: float = 0.3,
    turn: float = 0.2,
) -> tuple[Array, Array]:
    """Motion to make between two scans to follow a path by pure pursuit.

    The arc that starts ahead and leads to a target at distance r and bearing a has the curvature
    2 sin(a) / r and the length r a / sin(a). A target that lies more than `SHARP` to one side is
    first turned to on the spot.

    Args:
        path: (N, 2) points of the path [m, world]; `WINDOW` of them must span the lookahead.
        place: () int32 index of the path point where the robot was last.
        pose: (3,) of the robot.
        lookahead: Distance along the path [m] from the robot's place to its target.
        stride: Largest distance [m] of the motion.
        turn: Largest change of heading [rad] of the motion.

    Returns:
        Motion (3,), zero at the end of the path, and the index () int32 of the nearest path point.

    Raises:
        ValueError: The path or the pose has another shape; while tracing.
    """
    if path.ndim != 2 or path.shape[1] != 2:
        raise ValueError(f"path is {path.shape}, not (N, 2)")
    if pose.shape != (3,):
        raise ValueError(f"pose is {pose.shape}, not (3,)")
    last = path.shape[0] - 1
    index = jnp.minimum(place + jnp.arange(WINDOW, dtype=place.dtype), last)
    offset = path[index] - pose[None, :2]
    place = index[jnp.argmin(jnp.sum(offset**2, axis=1))]

    index = jnp.minimum(place + jnp.arange(WINDOW, dtype=place.dtype), last)
    step = jnp.diff(path[index], axis=0)
    along = jnp.cumsum(jnp.sqrt(jnp.sum(step**2, axis=1)))
    ahead = jnp.minimum(jnp.sum(along < lookahead) + 1, WINDOW - 1)
    target = index[ahead]
    away, bearing = range_bearing(to_robot(pose, path[target]))

    ahead_of = jnp.clip(bearing, -SHARP, SHARP)
    curvature = 2 * jnp.sin(ahead_of) / jnp.maximum(away, CLOSE)
    length = jnp.minimum(stride, away / jnp.sinc(ahead_of / jnp.pi))
    length = jnp.minimum(length, turn / jnp.maximum(jnp.abs(curvature), turn / stride))

    sharp = jnp.abs(bearing) > SHARP
    done = (target == last) & (away < CLOSE)
    length = jnp.where(done | sharp, 0.0, length)
    swing = jnp.where(sharp, jnp.clip(bearing, -turn, turn), length * curvature)
    return arc(length, jnp.where(done, 0.0, swing)), place


class Route(NamedTuple):
    """A way over a map."""

    nodes: list[int]  # indices of its nodes, in order
    arcs: list[int]  # indices of the arcs between them
    line: np.ndarray  # (n, 2) [m, world]
    length: float  # [m]


def route(graph: Graph, start: int, goal: int, *, clearance: float = 0.0) -> Route:
    """The shortest way over a map.

    Args:
        graph: The map.
        start: Index of the first node.
        goal: Index of the last node.
        clearance: Clearance [m] that each arc must have; above 0, arcs without a known one are
            not used.

    Raises:
        ValueError: No arcs of that clearance lead from `start` to `goal`, or there is no such node.
    """
    wide = (clearance <= 0.0) | (graph.arc_clearance >= clearance)  # NaN compares false
    lengths = np.where(wide, graph.length, np.inf)
    arcs = ways.shortest(graph.pairs, lengths, start, goal, places=len(graph.xy))
    nodes, line = ways.along(graph.lines, graph.pairs, arcs, start)
    line = line if arcs else graph.xy[[start]]
    return Route(nodes, arcs, line, float(np.sum(graph.length[arcs])))
