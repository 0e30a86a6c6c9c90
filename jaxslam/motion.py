"""Odometry of a two-wheel robot: increments, their noise, and the motions they stand for."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.geometry import compose, dot, range_bearing, unit
from jaxslam.types import Array


class Robot(NamedTuple):
    """A robot with two driven wheels, the origin of its frame midway; static under jit."""

    base: float = 0.4  # [m] between the wheels
    wheel_noise: float = 0.005  # [m / sqrt(m)] std of a wheel's encoder per root of a metre rolled


def arc(distance: Array, turn: Array) -> Array:
    """Motion (3,) along an arc of length `distance` [m] on which the heading turns by `turn` [rad].

    The chord is shorter than the arc by sin(turn / 2) / (turn / 2) and points along turn / 2.
    """
    chord = distance * jnp.sinc(turn / (2 * jnp.pi)) * unit(turn / 2)
    return jnp.append(chord, turn)


def increment(left: Array, right: Array, base: float) -> Array:
    """Motion (3,) of a robot whose wheels, `base` [m] apart, roll `left` and `right` [m]."""
    return arc((left + right) / 2, (right - left) / base)


def wheels(motion: Array, base: float) -> tuple[Array, Array]:
    """Distances left and right [m] that the wheels roll along the arc `motion` (3,)."""
    turn = motion[2]
    distance = dot(motion[:2], unit(turn / 2)) / jnp.sinc(turn / (2 * jnp.pi))
    return distance - base * turn / 2, distance + base * turn / 2


def process_noise(odometry: Array, motion: Array) -> Array:
    """Covariance (3, 3) of an increment, in the frame of the pose before it.

    Over d metres and t radians, the variances of the distance and of the heading grow as

        var_d = o0^2 |d| + o1^2 |t|        var_t = o2^2 |d| + o3^2 |t|

    The distance error e points along t / 2. The heading error is a random walk w(s), s = 0..1 the
    part of the way that is done, var w(s) = s var_t. It swings what is still ahead, so the end
    moves sideways by p times the mean of w, with p the increment turned left by 90 degrees:

        var mean(w) = var_t / 3        cov(mean(w), w(1)) = var_t / 2

    that is, mean(w) = w(1) / 2 + r, with r independent of w(1) and var r = var_t / 12. The sum of
    the three outer products (of e, w(1), r) is positive semi-definite. The bend of the arc within
    one increment is left out; it adds terms of order t^2.

    Args:
        odometry: (4,) o0 [m / sqrt(m)], o1 [m / sqrt(rad)], o2 [rad / sqrt(m)],
            o3 [rad / sqrt(rad)].
        motion: (3,) the increment [m, m, rad].
    """
    rolled = jnp.stack([range_bearing(motion[:2])[0], jnp.abs(motion[2])])
    var_d, var_t = odometry[:2] ** 2 @ rolled, odometry[2:] ** 2 @ rolled
    zero = jnp.zeros_like(motion[:1])
    sideways = jnp.concatenate([-motion[1:2], motion[:1], zero])
    shape = jnp.stack(
        [
            jnp.concatenate([unit(motion[2] / 2), zero]),
            sideways / 2 + jnp.concatenate([zero, zero, zero + 1]),
            sideways,
        ]
    )
    return shape.T @ (jnp.stack([var_d, var_t, var_t / 12])[:, None] * shape)


def wheel_coefficients(robot: Robot) -> Array:
    """The four coefficients (4,) of `process_noise` that a robot's two wheels amount to.

    A wheel that rolls a distance w errs by k sqrt(|w|), so var_d = k^2 (|l| + |r|) / 4 and
    var_t = k^2 (|l| + |r|) / base^2. Straight on |l| + |r| = 2 d, on the spot it is base |t|; on
    an arc the sum of the two is an upper bound, and the small correlation of distance with heading
    is left out.
    """
    base = robot.base
    return robot.wheel_noise * jnp.sqrt(jnp.array([1 / 2, base / 4, 2 / base**2, 1 / base]))


def slip(distance: Array, noise: float) -> Array:
    """Standard deviation [m] of a wheel's roll over `distance` [m]; its gradient at 0 is 0."""
    rolls = distance != 0.0
    return jnp.where(rolls, noise * jnp.sqrt(jnp.abs(jnp.where(rolls, distance, 1.0))), 0.0)


def roll(robot: Robot, draws: Array, motion: Array) -> Array:
    """True motion (3,) of a robot whose encoders read the arc `motion` (3,).

    Args:
        robot: Wheel base and encoder noise.
        draws: (N, 2) standard normals, left and right; the arc is rolled in N equal parts.
        motion: (3,) what odometry reports [m, m, rad].
    """
    part = jnp.stack(wheels(motion, robot.base))[None] / draws.shape[0]  # (1, 2)
    rolled = part + slip(part, robot.wheel_noise) * draws  # (N, 2)

    def body(pose: Array, both: Array) -> tuple[Array, None]:
        return compose(pose, increment(both[0], both[1], robot.base)), None

    return jax.lax.scan(body, jnp.zeros_like(motion), rolled)[0]
