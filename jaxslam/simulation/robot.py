"""A robot: its kinematics, noise, systematic errors, limits and scanner; two driven wheels.

The motion of the other robots is in `kinematics`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.calibration import Calibration
from jaxslam.core.se2 import compose, dot, unit_vector
from jaxslam.core.types import Array
from jaxslam.simulation.scanners import Scanner


class Robot(NamedTuple):
    """A robot, the origin of its frame between the (rear) wheels; static under jit.

    Attributes:
        wheel_base: [m] distance between the two wheels of a differential drive, between the axles
            of an Ackermann drive, between opposite wheels of a holonomic one.
        encoder_noise: [m / sqrt(m)] standard deviation of a wheel's encoder over one metre; its
            variance grows in proportion to the distance rolled. An Ackermann drive has one encoder
            for both rear wheels.
        wheel_scales: [-] true distance per distance that the encoder reads, left and right; the
            same number twice where the drive is not differential.
        wheel_base_scale: [-] true distance between the wheels per `wheel_base`, which odometry
            assumes.
        mount: [m, m, rad] pose of the scanner in the frame of `nominal_mount`: an error that the
            robot's user does not know.
        time_offset: [s] by which the clock of the odometry is ahead: a scan with stamp t is taken
            where the odometry has the robot at t + time_offset.
        scan_period: [s] from a scan to the next.
        max_speed: [m/s] of a robot that follows a path.
        max_turn_rate: [rad/s] likewise.
        kinematics: `"differential"`, `"ackermann"` or `"holonomic"`.
        max_steering: [rad] largest angle of the steered wheels, of an Ackermann drive; 0: only
            `min_turning_radius` bounds it.
        min_turning_radius: [m] of the middle of the rear axle, of an Ackermann drive; 0: only
            `max_steering` bounds it.
        steering_noise: [rad sqrt(m)] standard deviation of the mean error of the steering angle
            over one metre; that of a distance falls with its root.
        steering_offset: [rad] true steering angle where it reads 0.
        slip_noise: [m / sqrt(m), m / sqrt(m), rad / sqrt(m)] standard deviations of ahead, left and
            heading of a holonomic drive's odometry over one metre; that of the heading also grows
            with what the wheels roll where it turns.
        odometry_rate: [Hz] of the odometry, which is interpolated at the scans; 0: it is reported
            with each scan.
        nominal_mount: [m, m, rad] pose of the scanner in the frame of the robot as its user knows
            it; odometry is reported for the scanner there.
        radius: [m] of a circle around the origin that holds the robot; 0: not known.
        scanner: The scanner; None: the `Lidar` of the configuration, with noise alike at all
            ranges.
    """

    wheel_base: float = 0.4
    encoder_noise: float = 0.005
    wheel_scales: tuple[float, float] = (1.0, 1.0)
    wheel_base_scale: float = 1.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset: float = 0.0
    scan_period: float = 0.5
    max_speed: float = 0.6
    max_turn_rate: float = 0.4
    kinematics: str = "differential"
    max_steering: float = 0.0
    min_turning_radius: float = 0.0
    steering_noise: float = 0.0
    steering_offset: float = 0.0
    slip_noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    odometry_rate: float = 0.0
    nominal_mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.0
    scanner: Scanner | None = None

    def calibration(self) -> Calibration:
        """The systematic errors, as `calibrate_odometry` removes them; NumPy arrays.

        Raises:
            ValueError: The steering has an offset: no calibration makes its odometry exact, because
                the error of the heading is not linear in distance and turn.
        """
        if self.steering_offset:
            raise ValueError(
                f"robot.steering_offset is {self.steering_offset}: it has no calibration; one is "
                "defined for scales, mount and time offset"
            )
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
