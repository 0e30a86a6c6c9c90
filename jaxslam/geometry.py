"""Angles, SE(2) and polar form."""

import jax.numpy as jnp

from jaxslam.types import Array


def wrap_angle(angle: Array) -> Array:
    """Return the same angle [rad] in [-pi, pi); its derivative is 1 wherever it has one."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))


def wrap_line(angle: Array) -> Array:
    """Return the same direction of an undirected line [rad] in [-pi/2, pi/2)."""
    return angle - jnp.pi * jnp.floor(angle / jnp.pi + 0.5)


def rotation(angle: Array) -> Array:
    """Matrix (2, 2) that turns vectors counter-clockwise by `angle` [rad]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


def compose(pose: Array, motion: Array) -> Array:
    """Pose (3,) reached from `pose` (3,) by `motion` (3,), which is in the frame of `pose`."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return jnp.stack(
        [
            pose[0] + c * motion[0] - s * motion[1],
            pose[1] + s * motion[0] + c * motion[1],
            wrap_angle(pose[2] + motion[2]),
        ]
    )


def between(a: Array, b: Array) -> Array:
    """Motion (3,) that leads from pose `a` (3,) to pose `b` (3,): the inverse of `compose`."""
    c, s = jnp.cos(a[2]), jnp.sin(a[2])
    d = b[:2] - a[:2]
    return jnp.stack([c * d[0] + s * d[1], c * d[1] - s * d[0], wrap_angle(b[2] - a[2])])


def to_world(pose: Array, points: Array) -> Array:
    """Points (..., 2) of the robot frame of `pose` (3,), in the world frame."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = points[..., 0], points[..., 1]
    return jnp.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y], axis=-1)


def to_robot(pose: Array, points: Array) -> Array:
    """Points (..., 2) of the world, in the robot frame of `pose` (3,)."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = points[..., 0] - pose[0], points[..., 1] - pose[1]
    return jnp.stack([c * x + s * y, c * y - s * x], axis=-1)


def range_bearing(offset: Array) -> Array:
    """Polar form (2,) [m, rad] of an offset (2,) [m]; its gradient at the origin is 0."""
    away = jnp.any(offset != 0.0)
    safe = jnp.where(away, offset, jnp.ones_like(offset))
    polar = jnp.stack([jnp.hypot(safe[0], safe[1]), jnp.arctan2(safe[1], safe[0])])
    return jnp.where(away, polar, 0.0)


def unit(angle: Array) -> Array:
    """Unit vector (..., 2) that points along `angle` (...) [rad]."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def cross(a: Array, b: Array) -> Array:
    """Third component (...) of the cross product of plane vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def dot(a: Array, b: Array) -> Array:
    """Scalar product (...) of plane vectors (..., 2)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
