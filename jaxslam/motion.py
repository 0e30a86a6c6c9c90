"""Motion model of a differential-drive robot: odometry increments and their process noise."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.geometry import compose, dot, range_bearing, unit
from jaxslam.types import Array


class Robot(NamedTuple):
    """A differential-drive robot, the origin of its frame between the wheels; static under jit.

    Attributes:
        base: [m] distance between the wheels.
        wheel_noise: [m / sqrt(m)] standard deviation of a wheel's encoder over one metre; its
            variance grows in proportion to the distance rolled.
    """

    base: float = 0.4
    wheel_noise: float = 0.005


def arc(distance: Array, turn: Array) -> Array:
    """Motion (3,) along an arc of length `distance` [m] on which the heading turns by `turn` [rad].

    The chord is shorter than the arc by sin(turn / 2) / (turn / 2) and points along turn / 2.
    """
    chord = distance * jnp.sinc(turn / (2 * jnp.pi)) * unit(turn / 2)
    return jnp.append(chord, turn)


def increment(left: Array, right: Array, base: float) -> Array:
    """Odometry increment (3,) of wheels `base` [m] apart that roll `left` and `right` [m]."""
    return arc((left + right) / 2, (right - left) / base)


def wheels(motion: Array, base: float) -> tuple[Array, Array]:
    """Distances left and right [m] that the wheels roll along the arc `motion` (3,).

    The inverse of `increment`.
    """
    turn = motion[2]
    distance = dot(motion[:2], unit(turn / 2)) / jnp.sinc(turn / (2 * jnp.pi))
    return distance - base * turn / 2, distance + base * turn / 2


def process_noise(odometry: Array, motion: Array) -> Array:
    """Process noise Q (3, 3) of an increment, in the frame of the pose before it.

    Over d metres and t radians, the variances of the distance and of the heading grow as

        var_d = o0^2 |d| + o1^2 |t|        var_t = o2^2 |d| + o3^2 |t|

    The distance error e points along t / 2. The heading error is a random walk w(s), with s = 0..1
    the fraction of the increment driven, var w(s) = s var_t. It rotates the rest of the increment,
    so the end moves sideways by p times the mean of w, p being the increment turned left by 90
    degrees:

        var mean(w) = var_t / 3        cov(mean(w), w(1)) = var_t / 2

    that is, mean(w) = w(1) / 2 + r, with r independent of w(1) and var r = var_t / 12. So

        error = e (cos t/2, sin t/2, 0) + w(1) (p / 2, 1) + r (p, 0)
        Q = G^T diag(var_d, var_t, var_t / 12) G,    rows of G: these three vectors

    which is positive semi-definite. The curvature of the arc within one increment is neglected; it
    adds terms of order t^2.

    Args:
        odometry: (4,) o0 [m / sqrt(m)], o1 [m / sqrt(rad)], o2 [rad / sqrt(m)],
            o3 [rad / sqrt(rad)]: the alphas of an odometry motion model.
        motion: (3,) the increment [m, m, rad].

    References:
        Compare the odometry motion model of Thrun, Burgard, Fox (2005), Probabilistic Robotics,
        section 5.4.
    """
    driven = jnp.stack([range_bearing(motion[:2])[0], jnp.abs(motion[2])])
    var_d, var_t = odometry[:2] ** 2 @ driven, odometry[2:] ** 2 @ driven
    zero = jnp.zeros_like(motion[:1])
    sideways = jnp.concatenate([-motion[1:2], motion[:1], zero])
    directions = jnp.stack(
        [
            jnp.concatenate([unit(motion[2] / 2), zero]),
            sideways / 2 + jnp.concatenate([zero, zero, zero + 1]),
            sideways,
        ]
    )
    return directions.T @ (jnp.stack([var_d, var_t, var_t / 12])[:, None] * directions)


def wheel_coefficients(robot: Robot) -> Array:
    """Coefficients (4,) of `process_noise` for the encoder noise of a robot's wheels.

    The error of a wheel that rolls a distance w has standard deviation k sqrt(|w|), so
    var_d = k^2 (|l| + |r|) / 4 and var_t = k^2 (|l| + |r|) / base^2. Driving straight |l| + |r| is
    2 d, turning in place it is base |t|; on an arc the sum of the two is an upper bound, and the
    small correlation of distance with heading is neglected.
    """
    base = robot.base
    return robot.wheel_noise * jnp.sqrt(jnp.array([1 / 2, base / 4, 2 / base**2, 1 / base]))


def slip(distance: Array, noise: float) -> Array:
    """Standard deviation [m] of the distance that a wheel rolls; its gradient at 0 is 0.

    Args:
        distance: (...) [m] that the encoder reads.
        noise: [m / sqrt(m)] of the encoder.
    """
    moves = distance != 0.0
    return jnp.where(moves, noise * jnp.sqrt(jnp.abs(jnp.where(moves, distance, 1.0))), 0.0)


def roll(robot: Robot, draws: Array, motion: Array) -> Array:
    """True motion (3,) of a robot whose encoders read the arc `motion` (3,).

    Args:
        robot: Wheel base and encoder noise.
        draws: (N, 2) standard normals, left and right; the arc is rolled in N equal parts.
        motion: (3,) what odometry reports [m, m, rad].
    """
    encoders = jnp.stack(wheels(motion, robot.base))[None] / draws.shape[0]  # (1, 2)
    rolled = encoders + slip(encoders, robot.wheel_noise) * draws  # (N, 2)

    def body(pose: Array, left_right: Array) -> tuple[Array, None]:
        return compose(pose, increment(left_right[0], left_right[1], robot.base)), None

    return jax.lax.scan(body, jnp.zeros_like(motion), rolled)[0]
