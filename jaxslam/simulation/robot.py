"""A robot with two driven wheels: kinematics, encoder noise and systematic errors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.calibration import Calibration
from jaxslam.core.se2 import compose, dot, unit_vector
from jaxslam.core.types import Array


class Robot(NamedTuple):
    """A differential-drive robot, the origin of its frame between the wheels; static under jit.

    Attributes:
        wheel_base: [m] distance between the wheels.
        encoder_noise: [m / sqrt(m)] standard deviation of a wheel's encoder over one metre; its
            variance grows in proportion to the distance rolled.
        wheel_scales: [-] true distance per distance that the encoder reads, left and right.
        wheel_base_scale: [-] true distance between the wheels per `wheel_base`, which odometry
            assumes.
        mount: [m, m, rad] pose of the scanner in the frame of the robot.
        time_offset: [s] by which the clock of the odometry is ahead: a scan with stamp t is taken
            where the odometry has the robot at t + time_offset.
        scan_period: [s] from a scan to the next. A robot that follows a path moves by 0.3 m and
            turns by 0.2 rad in it, at most: by default at 0.6 m/s and 0.4 rad/s.
    """

    wheel_base: float = 0.4
    encoder_noise: float = 0.005
    wheel_scales: tuple[float, float] = (1.0, 1.0)
    wheel_base_scale: float = 1.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset: float = 0.0
    scan_period: float = 0.5

    def calibration(self) -> Calibration:
        """The systematic errors, as `calibrate_odometry` removes them; NumPy arrays."""
        left, right = self.wheel_scales
        wheels = Calibration.of_wheels(
            left, right, self.wheel_base_scale, wheel_base=self.wheel_base
        )
        mount, time_offset = np.asarray(self.mount), np.asarray(self.time_offset)
        whole = wheels._replace(mount=mount, time_offset=time_offset)
        return Calibration(*(np.asarray(x, float) for x in whole))


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


def true_increment(robot: Robot, draws: Array, motion: Array, *, part: float = 1.0) -> Array:
    """True motion (3,) of a robot whose encoders read an arc, the motion (3,).

    Args:
        robot: Its wheels and their noise.
        draws: (N, 2) standard normals, left and right; the arc is rolled in N equal parts.
        motion: (3,) what odometry reports [m, m, rad].
        part: [-] of the time that the motion takes; its first part is returned.
    """
    steps = draws.shape[0]
    encoders = jnp.stack(wheel_distances(motion, robot.wheel_base))[None] / steps  # (1, 2)
    if robot.wheel_scales != (1.0, 1.0):
        encoders = encoders * jnp.asarray(robot.wheel_scales, motion.dtype)[None]
    rolled = encoders + wheel_std(encoders, robot.encoder_noise) * draws  # (N, 2)
    if part != 1.0:
        share = np.clip(part * steps - np.arange(steps), 0.0, 1.0)
        rolled = rolled * jnp.asarray(share, motion.dtype)[:, None]
    base = robot.wheel_base * robot.wheel_base_scale

    def body(pose: Array, left_right: Array) -> tuple[Array, None]:
        return compose(pose, wheel_increment(left_right[0], left_right[1], base)), None

    return jax.lax.scan(body, jnp.zeros_like(motion), rolled)[0]
