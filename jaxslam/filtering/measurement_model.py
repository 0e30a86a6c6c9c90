"""Measurement model: range and bearing of a point landmark, or the direction of a wall."""

import jax
import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.se2 import range_bearing, wrap_angle, wrap_direction
from jaxslam.core.types import WALL, Array


def measure(features: Features) -> Array:
    """Measurements (M, 2) of the features of a scan.

    Range [m] and bearing [rad] of a point, direction [rad] and 0 of a wall; base_link frame.
    """
    polar = jax.vmap(range_bearing)(features.xy)
    wall = jnp.stack([features.direction, jnp.zeros_like(features.direction)], axis=-1)
    return jnp.where((features.kind == WALL)[:, None], wall, polar)


def polar_cov(xy: Array, cov: Array) -> Array:
    """Covariance (2, 2) of range [m] and bearing [rad] of a point.

    Args:
        xy: (2,) [m] the point, base_link frame.
        cov: (2, 2) [m^2] its covariance.
    """
    jacobian = jax.jacfwd(range_bearing)(xy)
    return jacobian @ cov @ jacobian.T


def predict_measurement(pose: Array, position: Array, kind: Array) -> tuple[Array, Array, Array]:
    """Predict the measurement of one landmark, with its Jacobians.

    With the offset (dx, dy) from robot to landmark, its length r and the robot's heading t:

        point:  h = (r, atan2(dy, dx) - t)

                             |  dx / r      dy / r   |
                H_landmark = | -dy / r^2    dx / r^2 |      H_pose = | -H_landmark   (0, -1)^T |

        wall of direction a:  h = (a - t, 0),   dh / da = (1, 0),   dh / dt = (-1, 0)

    Args:
        pose: (3,) [m, m, rad] map frame.
        position: (2,) position [m] of a point, or direction [rad] of a wall and 0; map frame.
        kind: () int32 kind of the landmark.

    Returns:
        The measurement (2,), its Jacobian (2, 3) with respect to the pose, and its Jacobian (2, 2)
        with respect to the landmark.

    References:
        Paper, eqs. (6)-(8); the bearing of (7) corrected by the robot's heading.
    """
    point, point_by_pose, point_by_landmark = _predict_point(pose, position)
    wall, wall_by_pose, wall_by_landmark = _predict_wall(pose, position)
    is_wall = kind == WALL
    return (
        jnp.where(is_wall, wall, point),
        jnp.where(is_wall, wall_by_pose, point_by_pose),
        jnp.where(is_wall, wall_by_landmark, point_by_landmark),
    )


def _predict_point(pose: Array, position: Array) -> tuple[Array, Array, Array]:
    """`predict_measurement` of a junction or corner.

    On the landmark itself (within 0.1 mm) there is no bearing: the offset (1, 0) stands in for it,
    so that all derivatives stay finite, and the range is 0.
    """
    offset = position - pose[:2]
    square = jnp.sum(offset**2)
    is_away = square > 1e-8
    square = jnp.where(is_away, square, 1.0)
    distance = jnp.sqrt(square)
    dx, dy = jnp.where(is_away, offset, jnp.array([1.0, 0.0], offset.dtype))
    bearing = wrap_angle(jnp.arctan2(dy, dx) - pose[2])
    zero, one = jnp.zeros_like(dx), jnp.ones_like(dx)
    by_landmark = jnp.stack(
        [jnp.stack([dx / distance, dy / distance]), jnp.stack([-dy / square, dx / square])]
    )
    by_pose = jnp.concatenate([-by_landmark, jnp.stack([zero, -one])[:, None]], axis=1)
    return jnp.stack([jnp.where(is_away, distance, 0.0), bearing]), by_pose, by_landmark


def _predict_wall(pose: Array, position: Array) -> tuple[Array, Array, Array]:
    """`predict_measurement` of a wall direction."""
    direction = wrap_direction(position[0] - pose[2])
    by_pose = jnp.zeros((2, 3), position.dtype).at[0, 2].set(-1.0)
    by_landmark = jnp.zeros((2, 2), position.dtype).at[0, 0].set(1.0)
    return jnp.stack([direction, jnp.zeros_like(direction)]), by_pose, by_landmark


def wrapped_differences(x: Array, y: Array, is_wall: Array) -> tuple[Array, Array]:
    """Wrap differences of measurements; the one place where their angles are wrapped.

    Args:
        x: Differences of range [m], or of a wall's direction [rad].
        y: Differences of bearing [rad]; same shape.
        is_wall: bool, broadcastable to that shape.

    Returns:
        The two differences, angles wrapped: a bearing to a full turn, an undirected wall to a half.
    """
    return jnp.where(is_wall, wrap_direction(x), x), jnp.where(is_wall, 0.0, wrap_angle(y))


def residual(measured: Array, predicted: Array, kind: Array) -> Array:
    """Innovations (..., 2): measurement minus prediction, angles wrapped.

    Args:
        measured: (..., 2) measurements, as of `measure`.
        predicted: (..., 2) predictions, as of `predict_measurement`.
        kind: (...) int32 kinds of landmark.
    """
    error = measured - predicted
    return jnp.stack(wrapped_differences(error[..., 0], error[..., 1], kind == WALL), axis=-1)
