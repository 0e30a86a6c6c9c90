"""Simulated drives: a robot that follows a path, its odometry and its scans."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import se2_np, trace_cache
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose
from jaxslam.core.types import Array, Key
from jaxslam.frontend.lidar import to_scan
from jaxslam.simulation import (
    arguments,
    kinematics,
    path_checks,
    ray_casting,
    scanners,
    wheel_faults,
)
from jaxslam.simulation.drive_draws import SUBSTEPS, Draws, draw_drive
from jaxslam.simulation.life import Events, Life, scan_life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.scan_motion import velocities
from jaxslam.simulation.scanners import Scanner
from jaxslam.simulation.worlds import World

MAX_DEPARTURE = 0.5  # [m] from its path, of a robot that cannot turn on the spot


def start_pose(path: Array) -> Array:
    """Pose (3,) at the beginning of a path (N, 2) [m, world], heading along it.

    Raises:
        ValueError: The path has too few points; while tracing.
    """
    arguments.check_path(path)
    along = path[arguments.MIN_PATH_POINTS - 1] - path[0]
    return jnp.append(path[0], jnp.arctan2(along[1], along[0]))


def drive(
    key: Key,
    robot: Robot,
    path: Array,
    *,
    num_scans: int,
    life: Life | None = None,
    events: Events | None = None,
) -> tuple[Array, Array]:
    """Drive along a path by pure pursuit, steered by the true pose of the robot.

    The robot stands still before the first scan and after the last one, by the odometry's clock.

    Args:
        key: Of the encoder noise.
        robot: With its encoder noise and systematic errors.
        path: (N, 2) [m, world] of the origin of its frame.
        num_scans: T, number of scans.
        life: What may go wrong, with `events`; None: nothing.
        events: What happens on this drive, by `life.draw_events`.

    Returns:
        True poses (T, 3) [m, m, rad] of the scanner in the world, and increments (T, 3) of the
        robot, or of the scanner at `robot.nominal_mount`, as odometry reports them, zero at the
        first.
    """
    shape = num_scans - 1, SUBSTEPS, kinematics.num_draws(robot)
    draws = jax.random.normal(key, shape, path.dtype)
    return drive_as_drawn(draws, robot, path, life=life, events=events)


def drive_as_drawn(
    draws: Array,
    robot: Robot,
    path: Array,
    *,
    life: Life | None = None,
    events: Events | None = None,
) -> tuple[Array, Array]:
    """`drive` by standard normals (T - 1, SUBSTEPS, D), D = `kinematics.num_draws(robot)`."""
    first, num_scans = start_pose(path), len(draws) + 1
    late = robot.time_offset / robot.scan_period  # [scans]
    whole, part = math.floor(late), late - math.floor(late)

    def body(carry: tuple[Array, Array], now: tuple) -> tuple[tuple[Array, Array], Any]:
        pose, path_index = carry
        draw, slip, is_carried = now
        if life is not None:
            pose, path_index = wheel_faults.carry(life.wheels, is_carried, path, path_index, pose)
        odometry, path_index = kinematics.next_motion(robot, path, path_index, pose)

        def moved(part: float) -> Array:
            motion = kinematics.true_motion(robot, draw, odometry, part=part)
            if life is not None and events is not None:
                own = life.wheels, events.faults, slip, robot.wheel_base
                motion = wheel_faults.slipped(*own, pose, motion)
            return compose(pose, motion)

        between = moved(part) if part else pose
        pose = moved(1.0)
        return (pose, path_index), (pose, odometry, between)

    slips, carried = None, None
    if events is not None:
        slips = events.faults.slip
        carried = jnp.arange(num_scans - 1, dtype=jnp.int32) == events.faults.carried_at
    steps = draws, slips, carried
    _, (poses, odometry, between) = lax.scan(body, (first, jnp.int32(0)), steps)
    poses = jnp.concatenate([first[None], poses])
    if late:
        at = np.arange(num_scans) + whole
        poses = jnp.concatenate([between, poses[-1:]])[np.clip(at, 0, num_scans - 1)]
        poses = jnp.where((at < 0)[:, None], first[None], poses)
    for mount in (robot.nominal_mount, robot.mount):
        if mount != (0.0, 0.0, 0.0):
            poses = jax.vmap(compose, in_axes=(0, None))(poses, jnp.asarray(mount, path.dtype))
    return poses, kinematics.report_odometry(robot, jnp.pad(odometry, ((1, 0), (0, 0))))


_drive = trace_cache.jit(
    drive, static_argnames=("robot", "num_scans"), compile_quickly="unoptimised"
)


def num_scans_of_drive(robot: Robot, path: Any, world: World | None = None) -> int:
    """Number of scans on a noise-free drive to the end of a path (N, 2).

    Args:
        robot: The robot.
        path: Its path.
        world: Walls that neither robot nor scanner may go through; None for none.

    Raises:
        ValueError: The robot or the path is not possible, the robot does not arrive, or it cannot
            turn on the spot and leaves the path; or it goes through a wall.
    """
    points = arguments.as_path(path, None)
    # Neither where the scanner is nor its clock changes how the robot drives.
    still = (0.0, 0.0, 0.0)
    robot = arguments.as_robot(robot)
    mount = se2_np.compose(np.array(robot.nominal_mount), np.array(robot.mount))
    robot = robot._replace(mount=still, nominal_mount=still, time_offset=0.0)
    robot = robot._replace(encoder_noise=0.0, steering_noise=0.0, slip_noise=still)
    robot = robot._replace(odometry_rate=0.0)
    upper_bound = 40 + int(4 * _least_motions(robot, np.asarray(points)))
    poses, odometry = _drive(jax.random.key(0), robot=robot, path=points, num_scans=upper_bound)
    moving = np.abs(np.asarray(odometry)[1:]).sum(axis=1) > 0
    if moving.all():
        raise ValueError(
            f"robot does not arrive at the end of the path in {upper_bound} scans; its "
            f"wheel_scales are {robot.wheel_scales}, its wheel_base_scale {robot.wheel_base_scale}"
        )
    radius = kinematics.turning_radius(robot)
    driven = np.asarray(poses, float)[: 1 + int(moving.sum())]
    if radius:
        departure = max(np.hypot(*(np.asarray(points) - at[None, :2]).T).min() for at in driven)
        if departure > MAX_DEPARTURE:
            raise ValueError(
                f"robot leaves the path by {departure:.2f} m, at most {MAX_DEPARTURE} m are "
                f"driven: its turning radius is {radius:.2f} m; give a path with wider bends"
            )
    if world is not None:
        about = "following the path, the"
        path_checks.check_line_in_world(driven[:, :2], world, f"{about} robot")
        if mount[:2].any():
            scanner = se2_np.compose(driven, mount)[:, :2]
            path_checks.check_line_in_world(scanner, world, f"{about} scanner, at its mount,")
    return len(driven)


def _least_motions(robot: Robot, path: np.ndarray) -> float:
    """Motions between scans that the length of a path (N, 2), or its bends, take at least."""
    along = np.diff(path, axis=0)
    legs = along[np.any(along != 0.0, axis=1)]
    turns = np.diff(np.unwrap(np.arctan2(legs[:, 1], legs[:, 0])))
    steps = np.sum(np.linalg.norm(along, axis=1)) / (robot.max_speed * robot.scan_period)
    return max(steps, np.abs(turns).sum() / (robot.max_turn_rate * robot.scan_period))


def simulate_scans(
    key: Key,
    lidar: Lidar,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    life: Life | None = None,
) -> tuple[Array, Array, Scan]:
    """True poses (T, 3), odometry increments (T, 3) and scans [T] of `simulate_episode`."""
    scan_of, items, odometry = drive_by_key(
        key, lidar, robot, world, path, num_scans=num_scans, life=life
    )
    return items[0], odometry, lax.map(scan_of, items)


def drive_by_key(
    key: Key,
    lidar: Lidar,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
) -> tuple[Callable[[tuple], Scan], tuple, Array]:
    """A drive whose scans are still to be made.

    Returns:
        A function that makes a scan of an item; the items [T], of which the first is the true pose
        (T, 3); and odometry increments (T, 3).
    """
    draws = draw_drive(key, robot, num_scans, path.dtype, life=life)
    given = lidar, robot, world, path
    return drive_and_scan(draws, *given, noise_by_incidence=noise_by_incidence, life=life)


def drive_and_scan(
    draws: Draws,
    lidar: Lidar,
    robot: Robot,
    world: World,
    path: Array,
    *,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
    mount_error: Array | None = None,
) -> tuple[Callable[[tuple], Scan], tuple, Array]:
    """A drive whose scans are still to be made.

    Args:
        draws: All that is random, with that of `life`, if there is one.
        lidar: The scanner as the front end knows it.
        robot: The robot.
        world: The walls.
        path: (N, 2) [m, world] to drive along.
        noise_by_incidence: As of `simulate_episode`.
        life: What may go wrong; None: nothing.
        mount_error: (3,) [m, m, rad] pose of the scanner in the frame of the scanner as the robot
            has it, traced; None: zero.

    Returns:
        A function that makes a scan of an item; the items [T], of which the first is the true pose
        (T, 3); and odometry increments (T, 3).

    Raises:
        ValueError: There is life without its draws, or draws without life; while tracing.
    """
    if (life is None) != (draws.life is None):
        raise ValueError("one of life and draws.life is None; give both or none")
    keys, ranges, drawn = draws.scans, draws.ranges, draws.life
    events = None if drawn is None else drawn.events
    truth, odometry = drive_as_drawn(draws.wheels, robot, path, life=life, events=events)
    if mount_error is not None:
        truth = jax.vmap(compose, in_axes=(0, None))(truth, mount_error)
    if life is None or drawn is None:
        scan = partial(
            _scan, lidar, world, noise_by_incidence=noise_by_incidence, scanner=robot.scanner
        )
        return (lambda item: scan(*item)), (truth, keys, ranges), odometry

    odometry = wheel_faults.fail_as_drawn(drawn.failures, life.wheels, odometry)
    times = robot.scan_period * jnp.arange(len(truth), dtype=truth.dtype)

    def living(item: tuple) -> Scan:
        pose, own, normals, time, is_kept, velocity = item
        given = lidar, robot.scanner, world, life, drawn.events, pose, time
        scan = scan_life(own, *given, draws=normals, velocity=velocity)
        return to_scan(lidar, jnp.where(is_kept & scan.hit, scan.ranges, jnp.inf))

    items = truth, keys, ranges, times, drawn.kept, velocities(truth, times)
    return living, items, odometry


def _scan(
    lidar: Lidar,
    world: World,
    pose: Array,
    key: Key,
    draws: Array | None = None,
    *,
    noise_by_incidence: float = 0.0,
    scanner: Scanner | None = None,
) -> Scan:
    """Noisy scan of the world from a pose (3,), with the errors of a scanner if there is one."""
    hits, factors = ray_casting.find_hits(lidar, world, pose), None
    scan = to_scan(lidar, hits.distance)
    if noise_by_incidence != 0.0:
        angle = ray_casting.incidence(lidar, world, pose, hits=hits)
        factors = jnp.exp(noise_by_incidence * angle)
    if scanner is None:
        return ray_casting.add_range_noise(key, lidar, scan, factors, draws)
    std = jnp.asarray(scanner.range_std(scan.ranges)) * (1.0 if factors is None else factors)
    unit = lidar._replace(range_std=1.0)
    noisy = ray_casting.add_range_noise(key, unit, scan, std, draws)
    return scanners.digitise(scanner, noisy)
