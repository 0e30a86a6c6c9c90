"""A robot with two driven wheels: kinematics and encoder noise."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.se2 import compose, dot, unit_vector
from jaxslam.core.types import Array


class Robot(NamedTuple):
    """A differential-drive robot, the origin of its frame between the wheels; static under jit.

    Attributes:
        wheel_base: [m] distance between the wheels.
        encoder_noise: [m / sqrt(m)] standard deviation of a wheel's encoder over one metre; its
            variance grows in proportion to the distance rolled.
    """

    wheel_base: float = 0.4
    encoder_noise: float = 0.005


def arc_increment(distance: Array, turn: Array) -> Array:
    """Motion (3,) along an arc of length `distance` [m] on which the heading turns by `turn` [rad].

    The chord is shorter than the arc by sin(turn / 2) / (turn / 2) and points along turn / 2.
    """
    chord = distance * jnp.sinc(turn / (2 * jnp.pi)) * unit_vector(turn / 2)
    return jnp.append(chord, turn)


def wheel_increment(left: Array, right: Array, base: float) -> Array:
    """Odometry increment (3,) of wheels `base` [m] apart that roll `left` and `right` [m]."""
    return arc_increment((left + right) / 2, (right - left) / base)


def wheel_distances(motion: Array, base: float) -> tuple[Array, Array]:
    """Distances left and right [m] that the wheels roll along an arc, the motion (3,).

    The inverse of `wheel_increment`.
    """
    turn = motion[2]
    distance = dot(motion[:2], unit_vector(turn / 2)) / jnp.sinc(turn / (2 * jnp.pi))
    return distance - base * turn / 2, distance + base * turn / 2


def wheel_std(distance: Array, noise: float) -> Array:
    """Standard deviation [m] of the distance that a wheel rolls; its gradient at 0 is 0.

    Args:
        distance: (...) [m] that the encoder reads.
        noise: [m / sqrt(m)] of the encoder.
    """
    moves = distance != 0.0
    return jnp.where(moves, noise * jnp.sqrt(jnp.abs(jnp.where(moves, distance, 1.0))), 0.0)


def true_increment(robot: Robot, draws: Array, motion: Array) -> Array:
    """True motion (3,) of a robot whose encoders read an arc, the motion (3,).

    Args:
        robot: Wheel base and encoder noise.
        draws: (N, 2) standard normals, left and right; the arc is rolled in N equal parts.
        motion: (3,) what odometry reports [m, m, rad].
    """
    encoders = jnp.stack(wheel_distances(motion, robot.wheel_base))[None] / draws.shape[0]  # (1, 2)
    rolled = encoders + wheel_std(encoders, robot.encoder_noise) * draws  # (N, 2)

    def body(pose: Array, left_right: Array) -> tuple[Array, None]:
        return compose(pose, wheel_increment(left_right[0], left_right[1], robot.wheel_base)), None

    return jax.lax.scan(body, jnp.zeros_like(motion), rolled)[0]
