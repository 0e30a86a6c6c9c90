"""What a robot does between two scans, by its kinematics: the motion it makes, and its odometry.

Odometry reports the motion that the robot means to make, as its encoders have it; the true motion
differs by noise and systematic errors. The interval is driven in N equal parts, each with noise of
its own, so that the noise is that of a walk along the motion. With d the distance and t the turn of
a part, z standard normals, k `encoder_noise`, L `wheel_base`, and the true scales s, b:

    differential  each wheel rolls s w + k sqrt(s w) z                            (`robot`)
    ackermann     d' = s d + k sqrt(s d) z,  tan(a) = L t / d the steering angle that is read,
                  t' = d' tan(a + offset) / (b L) + q (1 + tan(a)^2) sqrt(s d) z / (b L)
    holonomic     (x, y)' = s (x, y) + (q_x, q_y) sqrt(s d) z,
                  t' = s t / b + q_t sqrt(s d + s L |t| / 2) z

The error of the steering angle, q / sqrt(d) over a distance d, is linear in t': it is white, and
has no finite angle in a part of no length.

References:
    Siegwart, Nourbakhsh, Scaramuzza (2011), Introduction to autonomous mobile robots, chapters 3
    (wheels) and 5.2.4 (errors that grow with the root of the distance).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.batching import on_device
from jaxslam.core.calibration import along_arc
from jaxslam.core.se2 import compose, range_bearing, relative, rotation
from jaxslam.core.types import Array
from jaxslam.filtering.noise import NoiseParams
from jaxslam.simulation import path_following
from jaxslam.simulation.robot import Robot, arc_increment, true_increment, wheel_std
from jaxslam.simulation.wall_directions import direction_std
from jaxslam.simulation.worlds import World

KINEMATICS = ("differential", "ackermann", "holonomic")
"""Known drives, for `Robot.kinematics`."""


def num_draws(robot: Robot) -> int:
    """Standard normals that a part of a motion takes."""
    return 3 if robot.kinematics == "holonomic" else 2


def turning_radius(robot: Robot) -> float:
    """Smallest radius [m] on which the middle of an Ackermann robot's rear axle drives, else 0."""
    if robot.kinematics != "ackermann":
        return 0.0
    steered = robot.wheel_base / math.tan(robot.max_steering) if robot.max_steering else 0.0
    return max(steered, robot.min_turning_radius)


def next_motion(robot: Robot, path: Array, index: Array, pose: Array) -> tuple[Array, Array]:
    """Motion (3,) between two scans along a path (N, 2) from a pose (3,), and the path index ()."""
    max_step = robot.max_speed * robot.scan_period
    max_turn = robot.max_turn_rate * robot.scan_period
    if robot.kinematics == "holonomic":
        return path_following.holonomic_pursuit(
            path, index, pose, max_step=max_step, max_turn=max_turn
        )
    return path_following.pure_pursuit(
        path,
        index,
        pose,
        max_step=max_step,
        max_turn=max_turn,
        min_radius=turning_radius(robot),
    )


def true_motion(robot: Robot, draws: Array, motion: Array, *, part: float = 1.0) -> Array:
    """True motion (3,) of a robot whose odometry reports the motion (3,) [m, m, rad].

    Args:
        robot: With its noise and systematic errors.
        draws: (N, D) standard normals, D = `num_draws(robot)`; the motion is made in N equal parts.
        motion: (3,) what odometry reports: an arc, or any motion of a holonomic robot.
        part: [-] of the time that the motion takes; its first part is returned.
    """
    if robot.kinematics == "differential":
        return true_increment(robot, draws, motion, part=part)
    steps = draws.shape[0]
    share = np.clip(part * steps - np.arange(steps), 0.0, 1.0)
    ahead_left, turn = along_arc(motion) / steps, motion[2] / steps
    drive = _ackermann if robot.kinematics == "ackermann" else _holonomic
    moved, turned = drive(robot, draws, ahead_left, turn)
    if part != 1.0:
        moved *= jnp.asarray(share, motion.dtype)[:, None]
        turned *= jnp.asarray(share, motion.dtype)

    def body(pose: Array, now: tuple[Array, Array]) -> tuple[Array, None]:
        return compose(pose, _twist_increment(*now)), None

    return jax.lax.scan(body, jnp.zeros_like(motion), (moved, turned))[0]


def _twist_increment(ahead_left: Array, turn: Array) -> Array:
    """Motion (3,) at the constant velocities ahead and left (2,) [m] and of the heading [rad]."""
    on_circle = arc_increment(jnp.ones_like(turn), turn)[:2]
    x, y = ahead_left[0], ahead_left[1]
    left = jnp.stack([-on_circle[1], on_circle[0]])
    return jnp.append(x * on_circle + y * left, turn)


def _ackermann(robot: Robot, draws: Array, ahead_left: Array, turn: Array) -> tuple[Array, Array]:
    """True motion (N, 2) [m] and turn (N,) [rad] of the parts of an Ackermann robot's motion."""
    distance = ahead_left[0]
    moves = distance != 0.0
    read = jnp.where(moves, robot.wheel_base * turn / jnp.where(moves, distance, 1.0), 0.0)
    steered = read
    if robot.steering_offset:
        steered = jnp.tan(jnp.arctan(read) + robot.steering_offset)
    base = robot.wheel_base * robot.wheel_base_scale
    true = distance * robot.wheel_scales[0]
    rolled = true + wheel_std(true, robot.encoder_noise) * draws[:, 0]
    swing = wheel_std(true, robot.steering_noise) * (1.0 + read**2) / base
    moved = jnp.stack([rolled, jnp.zeros_like(rolled)], axis=1)
    return moved, rolled * steered / base + swing * draws[:, 1]


def _holonomic(robot: Robot, draws: Array, ahead_left: Array, turn: Array) -> tuple[Array, Array]:
    """True motion (N, 2) [m] and turn (N,) [rad] of the parts of a holonomic robot's motion."""
    scale = robot.wheel_scales[0]
    true, turned = scale * ahead_left, scale / robot.wheel_base_scale * turn
    distance = range_bearing(true)[0]
    rolled = distance + robot.wheel_base / 2 * jnp.abs(scale * turn)
    ahead, left, heading = robot.slip_noise
    std = jnp.stack([wheel_std(distance, ahead), wheel_std(distance, left)])
    moved = true[None] + std[None] * draws[:, :2]
    return moved, turned + wheel_std(rolled, heading) * draws[:, 2]


def report_odometry(robot: Robot, odometry: Array) -> Array:
    """Increments (T, 3) of a robot's odometry as it is reported with the scans.

    Odometry that has a rate of its own is sampled at it, from the first scan on, and interpolated
    at the scans on arcs; after the last scan the robot stands still. Increments are those of the
    scanner at `nominal_mount`.

    Args:
        robot: With its rate of odometry, period of scans and mount.
        odometry: (T, 3) [m, m, rad] increments of the robot between scans, zero at the first.
    """
    if robot.odometry_rate:
        odometry = _resampled(odometry, robot.odometry_rate * robot.scan_period)
    if robot.nominal_mount != (0.0, 0.0, 0.0):
        mount = jnp.asarray(robot.nominal_mount, odometry.dtype)

        def moved(increment: Array) -> Array:
            return relative(mount, compose(increment, mount))

        odometry = jax.vmap(moved)(odometry)
    return odometry


def _resampled(odometry: Array, samples: float) -> Array:
    """Increments (T, 3) between scans that were sampled `samples` times from scan to scan."""
    count = odometry.shape[0]
    zero = jnp.zeros_like(odometry[:1])

    def add(pose: Array, increment: Array) -> tuple[Array, Array]:
        pose = compose(pose, increment)
        return pose, pose

    def at(poses: Array, increments: Array, where: np.ndarray) -> Array:
        """Poses (K, 3) at fractional indices (K,), on arcs between whole ones."""
        where = np.clip(where, 0.0, len(increments) - 1)
        before = np.minimum(np.floor(where).astype(int), len(increments) - 1)
        after = np.minimum(before + 1, len(increments) - 1)
        share = jnp.asarray(where - before, odometry.dtype)[:, None]
        straight = jnp.append(along_arc(increments), increments[:, 2:], axis=1)[after]
        part = share * straight
        return jax.vmap(compose)(poses[before], jax.vmap(_twist_increment)(part[:, :2], part[:, 2]))

    poses = jax.lax.scan(add, zero[0], odometry)[1]
    sampled = at(poses, odometry, np.arange(1 + math.ceil((count - 1) * samples)) / samples)
    between = jnp.concatenate([zero, jax.vmap(relative)(sampled[:-1], sampled[1:])])
    found = at(sampled, between, np.arange(count) * samples)
    return jnp.concatenate([zero, jax.vmap(relative)(found[:-1], found[1:])])


def noise_params(
    robot: Robot, world: World | None = None, *, match_scans: bool = False
) -> NoiseParams:
    """Noise that the filter assumes for a robot: `NoiseParams.for_simulated_robot`, by its drive.

    In a world whose walls are not quite parallel, R of a wall's direction has their variance, too.

    Straight on, and in place, Q is that of the drive; on a curve it is an upper bound. With R the
    smallest radius and m = L / R the largest tangent of the steering angle, an Ackermann drive has

        var_d = k^2 d,      var_t = (q / L)^2 d + (k^2 / R + q^2 (2 m + m^3) / L) |t|

    because the steering angle's part, q^2 (1 + tan(a)^2)^2 d / L^2, has tan(a) d = L |t|. A scanner
    away from the origin moves sideways with each error of the heading: the part of Q that grows
    with the distance is then `odometry_cov_rate`, in the frame of the scanner.

    Args:
        robot: The robot.
        world: Where it drives; None: its walls are parallel, or square to each other.
        match_scans: Whether odometry is fused with scan matching.

    Raises:
        ValueError: The robot has no noise, of which there is no filter.
    """
    params = _drive_noise(robot)
    if match_scans:
        matched = NoiseParams.for_laser_log(match_scans=True)
        params = params._replace(scan_match_std_scale=matched.scan_match_std_scale)
    if world is None:
        return params
    std = np.hypot(float(params.wall_angle_std), direction_std(world.walls))
    return params._replace(wall_angle_std=on_device(std))


def _drive_noise(robot: Robot) -> NoiseParams:
    """`noise_params` in any world."""
    k, base = robot.encoder_noise, robot.wheel_base
    if robot.kinematics == "differential":
        params = NoiseParams.for_simulated_robot(base, k)
    else:
        params = NoiseParams.for_simulated_robot()
    if robot.kinematics == "ackermann":
        q, radius = robot.steering_noise, turning_radius(robot)
        if not (k > 0.0 and q > 0.0):
            raise ValueError(f"encoder_noise is {k} and steering_noise {q}, not both above 0")
        tan = base / radius
        turned = k**2 / radius + q**2 * (2 * tan + tan**3) / base
        coefficients = jnp.asarray([k, 0.0, q / base, math.sqrt(turned)], float)
        params = params._replace(odometry_coefficients=coefficients)
    rate = np.diag(np.asarray(params.odometry_coefficients)[[0, 1, 2]] ** 2 * [1, 0, 1])
    if robot.kinematics == "holonomic":
        if not all(noise > 0.0 for noise in robot.slip_noise):
            raise ValueError(f"slip_noise is {robot.slip_noise}, not three numbers above 0")
        rate = np.diag(np.square(robot.slip_noise))
        turned = robot.slip_noise[2] * math.sqrt(base / 2)
        coefficients = jnp.asarray([0.0, 0.0, 0.0, turned], float)
        params = params._replace(odometry_coefficients=coefficients)
    elif robot.nominal_mount[:2] == (0.0, 0.0):
        return params
    x, y, yaw = robot.nominal_mount
    moved = np.eye(3)
    moved[:2, 2] = -y, x
    turned_back = np.eye(3)
    turned_back[:2, :2] = np.asarray(rotation(jnp.asarray(-yaw, float)))
    moved = turned_back @ moved
    kept = jnp.asarray([0.0, 1.0, 0.0, 1.0], float) * params.odometry_coefficients
    return params._replace(
        odometry_coefficients=kept,
        odometry_cov_rate=jnp.asarray(moved @ rate @ moved.T, float),
    )
