"""Angles, SE(2) poses and polar form, in JAX; `se2_np` is the same for logs, in NumPy.

A pose (3,) is x [m], y [m] and heading [rad] of a frame in another one (glossary: `types`).
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.types import Array


def wrap_angle(angle: Array) -> Array:
    """Return the same angle [rad] in [-pi, pi); its derivative is 1 wherever it has one."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))


def wrap_direction(angle: Array) -> Array:
    """Return the same direction of an undirected line [rad] in [-pi/2, pi/2)."""
    return angle - jnp.pi * jnp.floor(angle / jnp.pi + 0.5)


def rotation(angle: Array) -> Array:
    """Matrix (2, 2) that turns vectors counter-clockwise by `angle` [rad]."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])


def compose(pose: Array, increment: Array) -> Array:
    """Pose (3,) after an increment (3,), given in the frame of `pose` (3,): pose (+) increment."""
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    return jnp.stack(
        [
            pose[0] + cos * increment[0] - sin * increment[1],
            pose[1] + sin * increment[0] + cos * increment[1],
            wrap_angle(pose[2] + increment[2]),
        ]
    )


def relative(a: Array, b: Array) -> Array:
    """Pose `b` (3,) relative to pose `a` (3,), in the frame of `a`: the inverse of `compose`."""
    cos, sin = jnp.cos(a[2]), jnp.sin(a[2])
    gap = b[:2] - a[:2]
    x, y = cos * gap[0] + sin * gap[1], cos * gap[1] - sin * gap[0]
    return jnp.stack([x, y, wrap_angle(b[2] - a[2])])


def transform(pose: Array, points: Array) -> Array:
    """Transform points (..., 2) [m] from the robot frame at `pose` (3,) to the world frame."""
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = points[..., 0], points[..., 1]
    return jnp.stack([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y], axis=-1)


def inverse_transform(pose: Array, points: Array) -> Array:
    """Transform points (..., 2) [m] from the world frame to the robot frame at `pose` (3,)."""
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = points[..., 0] - pose[0], points[..., 1] - pose[1]
    return jnp.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def dead_reckoning(start: Array, increments: Array) -> Array:
    """Poses by composing increments, one after the other.

        poses[0] = start (+) increments[0],     poses[t] = poses[t - 1] (+) increments[t]

    Args:
        start: (3,) [m, m, rad].
        increments: (T, 3) [m, m, rad], each in the frame of the pose before it; where the first is
            zero, the first pose is `start`.

    Returns:
        (T, 3) [m, m, rad], in the frame of `start`.
    """

    def body(pose: Array, increment: Array) -> tuple[Array, Array]:
        pose = compose(pose, increment)
        return pose, pose

    return lax.scan(body, start, increments)[1]


def increments(poses: Array) -> Array:
    """Increments (T, 3) to each of poses (T, 3) from the one before, in its frame; zero at first.

    The inverse of `dead_reckoning` from the first pose.
    """
    first = jnp.zeros((1, 3), poses.dtype)
    return jnp.concatenate([first, jax.vmap(relative)(poses[:-1], poses[1:])])


def range_bearing(offset: Array) -> Array:
    """Polar form (2,) [m, rad] of an offset (2,) [m]; its gradient at the origin is 0."""
    away = jnp.any(offset != 0.0)
    safe = jnp.where(away, offset, jnp.ones_like(offset))
    polar = jnp.stack([jnp.hypot(safe[0], safe[1]), jnp.arctan2(safe[1], safe[0])])
    return jnp.where(away, polar, 0.0)


def vector_length(x: Array, y: Array) -> Array:
    """Length of vectors, at least 1e-6, with finite derivatives."""
    return jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))


def unit_vector(angle: Array) -> Array:
    """Unit vector (..., 2) that points along `angle` (...) [rad]."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def cross(a: Array, b: Array) -> Array:
    """Third component (...) of the cross product of plane vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def dot(a: Array, b: Array) -> Array:
    """Scalar product (...) of plane vectors (..., 2)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
