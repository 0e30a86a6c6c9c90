"""A path followed by pure pursuit."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxslam.core.se2 import inverse_transform, range_bearing
from jaxslam.core.types import AnyArray, Array, as_float64
from jaxslam.simulation.robot import arc_increment

SEARCH_WINDOW = 40  # points of the path ahead of the robot that are searched
LOOKAHEAD = 0.5  # [m] along the path from the point nearest to the robot to its target
TURN_ON_SPOT_ANGLE = 0.6  # [rad] the robot turns on the spot to a target at a larger bearing
GOAL_TOLERANCE = 0.05  # [m] the robot stops this close to the end of the path


def densify(waypoints: Any, spacing: float = 0.05) -> np.ndarray:
    """Points (N, 2) about `spacing` [m] apart on the straight lines that join waypoints (K, 2) [m].

    The waypoints are among them.

    Raises:
        ValueError: The waypoints have another shape or are not finite, or the spacing is not above
            zero.
    """
    waypoints = as_float64("waypoints", waypoints, ("K", 2))
    if not len(waypoints):
        raise ValueError("waypoints is empty; one at least is expected")
    if not np.isfinite(waypoints).all():
        raise ValueError("waypoints holds numbers that are not finite")
    if not spacing > 0.0:
        raise ValueError(f"spacing is {spacing}, not above 0")
    legs = np.hypot(*np.diff(waypoints, axis=0).T)
    at_waypoint = np.concatenate([[0.0], np.cumsum(legs)])
    wanted = np.linspace(0.0, at_waypoint[-1], round(at_waypoint[-1] / spacing) + 1)
    wanted = np.unique(np.concatenate([wanted, at_waypoint]))
    return np.stack([np.interp(wanted, at_waypoint, waypoints[:, k]) for k in range(2)], axis=1)


def poses_along(path: AnyArray, spacing: float, look_ahead: float = 0.3) -> np.ndarray:
    """Poses (T, 3) [m, m, rad] along a path (K, 2) [m], that look at it a little further on.

    Args:
        path: Points of the path, in the order of the drive.
        spacing: [m] along it between two poses.
        look_ahead: [m] from a pose to the point of the path that it looks at; the poses end as far
            before the end.

    Raises:
        ValueError: The path has another shape.
    """
    path = as_float64("path", path, ("K", 2))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    driven = np.arange(0.0, along[-1] - look_ahead, spacing)
    x, y = (np.interp(driven, along, column) for column in path.T)
    x_ahead, y_ahead = (np.interp(driven + look_ahead, along, column) for column in path.T)
    return np.stack([x, y, np.arctan2(y_ahead - y, x_ahead - x)], axis=1)


def pure_pursuit(
    path: Array,
    index: Array,
    pose: Array,
    *,
    lookahead: float = LOOKAHEAD,
    max_step: float = 0.3,
    max_turn: float = 0.2,
    min_radius: float = 0.0,
) -> tuple[Array, Array]:
    """Motion to make between two scans to follow a path by pure pursuit.

    The circle that starts ahead and leads to a target at distance r and bearing a has the
    curvature 2 sin(a) / r, and its part up to the target the length r a / sin(a):

               o target           The target is the first point of the path `lookahead` further
             /  |                 along than the point nearest to the robot. A target at a bearing
          r / a ' circle          of more than `TURN_ON_SPOT_ANGLE` is first turned to on the spot.
           /   .
          robot -> ahead

    Args:
        path: (N, 2) points of the path [m, map frame]; `SEARCH_WINDOW` of them must span the
            lookahead.
        index: () int32 index of the path point that was nearest at the last call, 0 at the first.
        pose: (3,) [m, m, rad] of the robot, map frame.
        lookahead: [m] distance along the path from the nearest path point to the target.
        max_step: [m] largest length of the motion.
        max_turn: [rad] largest change of heading of the motion.
        min_radius: [m] smallest radius of a circle that the robot can drive on; 0: it turns on the
            spot. A robot that does not looks as far ahead, drives on the smallest circle where the
            target asks for less, and has arrived when the end of the path is beside it.

    Returns:
        Motion (3,) [m, m, rad] in the frame of the robot, zero at the end of the path, and the
        index () int32 of the nearest path point.

    Raises:
        ValueError: The path or the pose has another shape; while tracing.

    References:
        Coulter (1992), Implementation of the pure pursuit path tracking algorithm.
    """
    if path.ndim != 2 or path.shape[1] != 2:
        raise ValueError(f"path is {path.shape}, not (N, 2)")
    if pose.shape != (3,):
        raise ValueError(f"pose is {pose.shape}, not (3,)")
    nearest, target = _nearest_and_target(path, index, pose, max(lookahead, min_radius))
    distance, bearing = range_bearing(inverse_transform(pose, path[target]))
    if min_radius > 0.0:
        limits = max_step, max_turn, min_radius
        passed = (target == path.shape[0] - 1) & (jnp.abs(bearing) > jnp.pi / 2)
        done = passed & (distance < max(lookahead, min_radius)) | _at_end(path, target, distance)
        return jnp.where(done, 0.0, _on_a_circle(distance, bearing, *limits)), nearest

    limited = jnp.clip(bearing, -TURN_ON_SPOT_ANGLE, TURN_ON_SPOT_ANGLE)
    curvature = 2 * jnp.sin(limited) / jnp.maximum(distance, GOAL_TOLERANCE)
    length = jnp.minimum(max_step, distance / jnp.sinc(limited / jnp.pi))
    length = jnp.minimum(length, max_turn / jnp.maximum(jnp.abs(curvature), max_turn / max_step))

    on_the_spot = jnp.abs(bearing) > TURN_ON_SPOT_ANGLE
    done = _at_end(path, target, distance)
    length = jnp.where(done | on_the_spot, 0.0, length)
    rotation = jnp.where(on_the_spot, jnp.clip(bearing, -max_turn, max_turn), length * curvature)
    return arc_increment(length, jnp.where(done, 0.0, rotation)), nearest


def _at_end(path: Array, target: Array, distance: Array) -> Array:
    """Whether () the target is the end of the path, and reached."""
    return (target == path.shape[0] - 1) & (distance < GOAL_TOLERANCE)


def _on_a_circle(
    distance: Array, bearing: Array, max_step: float, max_turn: float, min_radius: float
) -> Array:
    """Motion (3,) towards a target on a circle that starts ahead, of at least `min_radius` [m]."""
    limited = jnp.clip(bearing, -jnp.pi / 2, jnp.pi / 2)
    curvature = 2 * jnp.sin(limited) / jnp.maximum(distance, GOAL_TOLERANCE)
    curvature = jnp.clip(curvature, -1 / min_radius, 1 / min_radius)
    length = jnp.minimum(max_step, distance / jnp.sinc(limited / jnp.pi))
    length = jnp.minimum(length, max_turn / jnp.maximum(jnp.abs(curvature), max_turn / max_step))
    return arc_increment(length, length * curvature)


def holonomic_pursuit(
    path: Array, index: Array, pose: Array, *, max_step: float, max_turn: float
) -> tuple[Array, Array]:
    """Motion to make between two scans by a robot that drives in any direction.

    Its chord points at the target of `pure_pursuit`; meanwhile the robot turns towards it.

    Args:
        path: (N, 2) points of the path [m, map frame].
        index: () int32 index of the path point that was nearest at the last call, 0 at the first.
        pose: (3,) [m, m, rad] of the robot, map frame.
        max_step: [m] largest length of the motion.
        max_turn: [rad] largest change of heading of the motion.

    Returns:
        As of `pure_pursuit`.
    """
    nearest, target = _nearest_and_target(path, index, pose, LOOKAHEAD)
    ahead = inverse_transform(pose, path[target])
    distance, bearing = range_bearing(ahead)
    share = jnp.minimum(1.0, max_step / jnp.maximum(distance, GOAL_TOLERANCE))
    motion = jnp.append(share * ahead, jnp.clip(bearing, -max_turn, max_turn))
    return jnp.where(_at_end(path, target, distance), 0.0, motion), nearest


def _nearest_and_target(
    path: Array, previous: Array, pose: Array, lookahead: float
) -> tuple[Array, Array]:
    """Indices () of the path point nearest to the robot, and of the first `lookahead` [m] on.

    Both are searched in a window of `SEARCH_WINDOW` points, so that a path that crosses itself is
    followed in order.
    """
    last = path.shape[0] - 1
    index = jnp.minimum(previous + jnp.arange(SEARCH_WINDOW, dtype=previous.dtype), last)
    offset = path[index] - pose[None, :2]
    nearest = index[jnp.argmin(jnp.sum(offset**2, axis=1))]

    index = jnp.minimum(nearest + jnp.arange(SEARCH_WINDOW, dtype=previous.dtype), last)
    step = jnp.diff(path[index], axis=0)
    along_path = jnp.cumsum(jnp.sqrt(jnp.sum(step**2, axis=1)))
    ahead = jnp.minimum(jnp.sum(along_path < lookahead) + 1, SEARCH_WINDOW - 1)
    return nearest, index[ahead]
