"""Routes over a graph of places, and how to follow a path."""

import jax.numpy as jnp
import numpy as np
from scipy.sparse import csgraph

from jaxslam.geometry import range_bearing, to_robot
from jaxslam.motion import arc
from jaxslam.types import Array

WINDOW = 40  # points of the path ahead of the robot that are looked at
SHARP = 0.6  # [rad] a target farther off the bow than this is first turned to
CLOSE = 0.05  # [m] from the end of its path the robot stops


def densify(waypoints: np.ndarray, spacing: float = 0.05) -> np.ndarray:
    """Points (N, 2) about `spacing` [m] apart on the straight lines that join way points (K, 2)."""
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
    """
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


def route(
    positions: np.ndarray, pairs: np.ndarray, lengths: np.ndarray, start: int, goal: int
) -> list[int]:
    """Places on the shortest way from `start` to `goal`, both included.

    Args:
        positions: (L, 2) of the places [m].
        pairs: (A, 2) int, the two places each arc joins; two places may share several arcs.
        lengths: (A,) of the arcs [m].
        start: Index of the first place.
        goal: Index of the last place.

    Raises:
        ValueError: No arcs lead from `start` to `goal`.
    """
    count = len(positions)
    for place in (start, goal):
        if not 0 <= place < count:
            raise ValueError(f"no place {place}: the map has the places 0 to {count - 1}")
    table = np.full((count, count), np.inf)
    ends = np.asarray(pairs, int).reshape(-1, 2)
    np.minimum.at(table, (ends[:, 0], ends[:, 1]), lengths)
    graph = csgraph.csgraph_from_dense(table, null_value=np.inf)
    before = csgraph.dijkstra(graph, directed=False, indices=start, return_predecessors=True)[1]
    way = [int(goal)]
    while way[-1] != start:
        if before[way[-1]] < 0:
            raise ValueError(f"no route leads from place {start} to place {goal}")
        way.append(int(before[way[-1]]))
    return way[::-1]
