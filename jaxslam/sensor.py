"""What a robot observes of a landmark: range and bearing, or the direction of a wall."""

import jax
import jax.numpy as jnp

from jaxslam.geometry import range_bearing, wrap_angle, wrap_line
from jaxslam.nodes import Nodes
from jaxslam.types import WALL, Array


def observation(nodes: Nodes) -> Array:
    """Features as the filter sees them, (M, 2): range and bearing, or direction and 0."""
    polar = jax.vmap(range_bearing)(nodes.xy)
    wall = jnp.stack([nodes.direction, jnp.zeros_like(nodes.direction)], axis=-1)
    return jnp.where((nodes.kind == WALL)[:, None], wall, polar)


def polar_cov(xy: Array, cov: Array) -> Array:
    """Covariance (2, 2) of range and bearing of a point (2,) with covariance (2, 2)."""
    jacobian = jax.jacfwd(range_bearing)(xy)
    return jacobian @ cov @ jacobian.T


def expect(pose: Array, place: Array, kind: Array) -> tuple[Array, Array, Array]:
    """Expected observation (2,) of a slot (2,), and its derivatives by pose and slot.

    References:
        Paper, eqs. (6)-(8); the bearing of (7) corrected by the robot's heading.
    """
    offset = place - pose[:2]
    square = jnp.sum(offset**2)
    away = square > 1e-8
    square = jnp.where(away, square, 1.0)
    distance = jnp.sqrt(square)
    dx, dy = jnp.where(away, offset, jnp.array([1.0, 0.0], offset.dtype))
    bearing = wrap_angle(jnp.arctan2(dy, dx) - pose[2])
    zero, one = jnp.zeros_like(dx), jnp.ones_like(dx)
    by_slot = jnp.stack(
        [jnp.stack([dx / distance, dy / distance]), jnp.stack([-dy / square, dx / square])]
    )
    by_pose = jnp.concatenate([-by_slot, jnp.stack([zero, -one])[:, None]], axis=1)
    polar = jnp.stack([jnp.where(away, distance, 0.0), bearing])
    is_wall = kind == WALL
    wall = jnp.stack([wrap_line(place[0] - pose[2]), zero])
    wall_by_pose = jnp.zeros((2, 3), offset.dtype).at[0, 2].set(-1.0)
    wall_by_slot = jnp.zeros((2, 2), offset.dtype).at[0, 0].set(1.0)
    return (
        jnp.where(is_wall, wall, polar),
        jnp.where(is_wall, wall_by_pose, by_pose),
        jnp.where(is_wall, wall_by_slot, by_slot),
    )


def differences(x: Array, y: Array, is_wall: Array) -> tuple[Array, Array]:
    """Differences of observations, their two numbers apart; the one place where angles are wrapped.

    Arrays of one shape each: of range [m] or a wall's direction [rad], and of bearing [rad].
    """
    return jnp.where(is_wall, wrap_line(x), x), jnp.where(is_wall, 0.0, wrap_angle(y))


def residual(seen: Array, expected: Array, kind: Array) -> Array:
    """Difference (..., 2) of observations."""
    error = seen - expected
    return jnp.stack(differences(error[..., 0], error[..., 1], kind == WALL), axis=-1)
