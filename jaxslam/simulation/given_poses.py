"""Odometry and scans of a robot whose true poses are given, such as those of a recorded drive.

No path is followed: the robot is where it was. Its wheels report the motion between the poses,
with their noise and their faults.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.se2 import compose, relative
from jaxslam.core.types import Array, Key, as_float64, check_type
from jaxslam.frontend.lidar import to_scan
from jaxslam.simulation import arguments, scan_motion, wheel_faults
from jaxslam.simulation.life import Life, draw_events, scan_life
from jaxslam.simulation.robot import Robot, wheel_distances, wheel_increment, wheel_std
from jaxslam.simulation.traffic import Movers
from jaxslam.simulation.worlds import World

LEAST_KEPT = 0.1  # of the motion of a wheel that slips: what its encoder reads stays finite


def simulate_at_poses(
    key: Key,
    lidar: Lidar,
    robot: Robot,
    world: str | World,
    poses: Any,
    *,
    times: Any = None,
    velocities: Any = None,
    life: Life | None = None,
) -> tuple[Array, Scan]:
    """Odometry and scans of a robot at given poses.

    Args:
        key: Of all that is random.
        lidar: The scanner as the front end knows it.
        robot: With two wheels: their noise, its scanner and mount, and its period of scans.
        world: Name of the world, or its walls.
        poses: (T, 3) [m, m, rad] true poses of the scanner in the world.
        times: (T,) [s] of the scans, for what moves; by default `robot.scan_period` apart.
        velocities: (T, 3) [m/s, m/s, rad/s] of the scanner in its own frame, for scans that take
            time (`Scanner.turn_time`); by default those from pose to pose.
        life: What may go wrong; None: nothing. Carpet, and a robot that is carried, would need
            other poses.

    Returns:
        Increments (T, 3) [m, m, rad] as odometry reports them, zero at the first, and scans [T].

    Raises:
        ValueError: An argument is not possible; the message names it.
    """
    arguments.check_key(key)
    check_lidar(lidar)
    robot = arguments.as_robot(robot)
    arguments.check_lidar_of(robot, lidar)
    if robot.kinematics != "differential" or robot.odometry_rate or robot.time_offset:
        raise ValueError(
            "robot: at given poses it has two wheels, and odometry with each scan, without offset "
            f"in time; given are kinematics {robot.kinematics!r}, odometry_rate "
            f"{robot.odometry_rate} and time_offset {robot.time_offset}"
        )
    walls = arguments.as_world(world, lidar.range_max)
    points = as_float64("poses", poses, ("T", 3))
    stamps = np.arange(len(points)) * robot.scan_period
    if times is not None:
        stamps = as_float64("times", times, (len(points),))
    speeds = np.zeros((len(points), 3))
    if velocities is not None:
        speeds = as_float64("velocities", velocities, (len(points), 3))
    elif robot.scanner is not None and robot.scanner.turn_time is not None:
        speeds = np.asarray(scan_motion.velocities(jnp.asarray(points), jnp.asarray(stamps)))
    for name, array in (("poses", points), ("times", stamps), ("velocities", speeds)):
        if not array.size or not np.isfinite(array).all():
            raise ValueError(f"{name}: one pose at least is expected, and finite numbers")
    if life is None:
        life = _nothing_goes_wrong(len(walls.walls))
    check_type("life", life, Life, advice=": see jaxslam.simulation.life_in")
    if len(life.materials) != len(walls.walls):
        raise ValueError("life.materials: make it by jaxslam.simulation.life_in of this world")
    for name in ("carpet", "carried"):
        if float(getattr(life.wheels, name)):
            raise ValueError(f"life.wheels.{name} is not 0, and the true poses are given")
    own = (jnp.asarray(x, float) for x in (points, stamps, speeds))
    return _at_poses(lidar, robot, key, walls, *own, life)


def _nothing_goes_wrong(num_walls: int) -> Life:
    """Life without faults, in which nothing moves."""
    none = jnp.zeros((0, 4))
    nobody = Movers(jnp.zeros(0, jnp.int32), jnp.zeros((2, 2)), none, none, none)
    return Life(nobody, jnp.zeros(num_walls, jnp.int32))


@partial(jax.jit, static_argnums=(0, 1))
def _at_poses(
    lidar: Lidar,
    robot: Robot,
    key: Key,
    world: World,
    poses: Array,
    times: Array,
    velocities: Array,
    life: Life,
) -> tuple[Array, Scan]:
    """`simulate_at_poses` of what has been checked."""
    count = len(poses)
    of_wheels, of_ranges, of_events, of_odometry, of_scans = jax.random.split(key, 5)
    events = draw_events(of_events, life, count)
    draws = jax.random.normal(of_wheels, (count - 1, 2), poses.dtype)
    odometry = jax.vmap(partial(_report, robot))(_motions(robot, poses), draws, events.faults.slip)
    odometry = jnp.pad(odometry, ((1, 0), (0, 0)))
    odometry = wheel_faults.fail_odometry(of_odometry, life.wheels, odometry)
    kept = wheel_faults.keeps_scan(of_scans, life.wheels, count, poses.dtype)

    def living(item: tuple) -> Scan:
        pose, own, time, velocity, is_kept = item
        seen = lidar, robot.scanner, world, life, events, pose, time
        scan = scan_life(own, *seen, velocity=velocity)
        return to_scan(lidar, jnp.where(is_kept & scan.hit, scan.ranges, jnp.inf))

    items = poses, jax.random.split(of_ranges, count), times, velocities, kept
    return odometry, lax.map(living, items)


def _motions(robot: Robot, poses: Array) -> Array:
    """Motions (T - 1, 3) of the robot whose scanner is at poses (T, 3)."""
    zero = jnp.zeros(3, poses.dtype)
    for mount in (robot.mount, robot.nominal_mount):
        back = relative(jnp.asarray(mount, poses.dtype), zero)
        poses = jax.vmap(compose, in_axes=(0, None))(poses, back)
    return jax.vmap(relative)(poses[:-1], poses[1:])


def _report(robot: Robot, motion: Array, draws: Array, slip: Array) -> Array:
    """What the wheels report (3,) of a true motion (3,) of the robot: an arc.

    A motion aside turns no wheel, and is not seen.

    Args:
        robot: With its wheels and the nominal mount of its scanner.
        motion: (3,) [m, m, rad].
        draws: (2,) standard normals, left and right.
        slip: (2,) share of its motion that each wheel loses.
    """
    true = jnp.stack(wheel_distances(motion, robot.wheel_base * robot.wheel_base_scale))
    read = true / jnp.asarray(robot.wheel_scales, motion.dtype) / jnp.maximum(1 - slip, LEAST_KEPT)
    read += wheel_std(read, robot.encoder_noise) * draws
    reported = wheel_increment(read[0], read[1], robot.wheel_base)
    mount = jnp.asarray(robot.nominal_mount, motion.dtype)
    return relative(mount, compose(reported, mount))
