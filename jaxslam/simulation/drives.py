"""Simulated drives: a robot that follows a path, its odometry and its scans."""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import map_batches
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose
from jaxslam.core.types import Array, Key
from jaxslam.frontend import extract
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.lidar import to_scan
from jaxslam.simulation import arguments, path_following, ray_casting
from jaxslam.simulation.robot import Robot, true_increment
from jaxslam.simulation.worlds import World

SUBSTEPS = 4  # parts of the motion between two scans with encoder noise of their own


def start_pose(path: Array) -> Array:
    """Pose (3,) at the beginning of a path (N, 2) [m, world], heading along it.

    Raises:
        ValueError: The path has too few points; while tracing.
    """
    arguments.check_path(path)
    along = path[arguments.MIN_PATH_POINTS - 1] - path[0]
    return jnp.append(path[0], jnp.arctan2(along[1], along[0]))


def drive(key: Key, robot: Robot, path: Array, *, num_scans: int) -> tuple[Array, Array]:
    """Drive along a path by pure pursuit, steered by the true pose of the robot.

    The robot stands still before the first scan and after the last one, by the odometry's clock.

    Args:
        key: Of the encoder noise.
        robot: With its encoder noise and systematic errors.
        path: (N, 2) [m, world] of the point between its wheels.
        num_scans: T, number of scans.

    Returns:
        True poses (T, 3) [m, m, rad] of the scanner in the world, and increments (T, 3) of the
        robot as odometry reports them, zero at the first.
    """
    first = start_pose(path)
    draws = jax.random.normal(key, (num_scans - 1, SUBSTEPS, 2), path.dtype)
    late = robot.time_offset / robot.scan_period  # [scans]
    whole, part = math.floor(late), late - math.floor(late)

    def body(carry: tuple[Array, Array], draw: Array) -> tuple[tuple[Array, Array], Any]:
        pose, path_index = carry
        odometry, path_index = path_following.pure_pursuit(path, path_index, pose)
        between = pose
        if part:
            between = compose(pose, true_increment(robot, draw, odometry, part=part))
        pose = compose(pose, true_increment(robot, draw, odometry))
        return (pose, path_index), (pose, odometry, between)

    _, (poses, odometry, between) = lax.scan(body, (first, jnp.int32(0)), draws)
    poses = jnp.concatenate([first[None], poses])
    if late:
        at = np.arange(num_scans) + whole
        poses = jnp.concatenate([between, poses[-1:]])[np.clip(at, 0, num_scans - 1)]
        poses = jnp.where((at < 0)[:, None], first[None], poses)
    if robot.mount != (0.0, 0.0, 0.0):
        poses = jax.vmap(compose, in_axes=(0, None))(poses, jnp.asarray(robot.mount, path.dtype))
    return poses, jnp.pad(odometry, ((1, 0), (0, 0)))


def num_scans_of_drive(robot: Robot, path: Any) -> int:
    """Number of scans on a noise-free drive to the end of a path (N, 2).

    Raises:
        ValueError: The robot or the path is not possible, or the robot does not arrive.
    """
    points = arguments.as_path(path, None)
    noise_free = arguments.as_robot(robot)._replace(encoder_noise=0.0)
    upper_bound = 40 + int(4 * np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)) / 0.3)
    simulated = jax.jit(partial(drive, num_scans=upper_bound), static_argnums=1)
    _, odometry = simulated(jax.random.key(0), noise_free, points)
    moving = np.abs(np.asarray(odometry)[1:]).sum(axis=1) > 0
    if moving.all():
        raise ValueError(
            f"robot does not arrive at the end of the path in {upper_bound} scans; its "
            f"wheel_scales are {robot.wheel_scales}, its wheel_base_scale {robot.wheel_base_scale}"
        )
    return 1 + int(moving.sum())


def simulate_episode(
    key: Key,
    config: FrontendConfig,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    noise_by_incidence: float = 0.0,
) -> Episode:
    """One trial: drive along `path` (N, 2), scan the world `num_scans` times, extract features.

    The standard deviation of a range has the factor exp(`noise_by_incidence` times the angle [rad]
    between its beam and the normal of the wall).
    """
    truth, odometry, scan_keys = _drive(key, robot, path, num_scans=num_scans)

    def features(item: tuple[Array, Key]) -> Features:
        scan = _scan(config.lidar, world, *item, noise_by_incidence=noise_by_incidence)
        return extract.extract_features(config, scan)

    extracted = map_batches(features, (truth, scan_keys), batch_size=extract.SCAN_BATCH)
    return Episode(truth=truth, odometry=odometry, features=extracted)


def simulate_scans(
    key: Key, lidar: Lidar, robot: Robot, world: World, path: Array, *, num_scans: int
) -> tuple[Array, Array, Scan]:
    """True poses (T, 3), odometry increments (T, 3) and scans [T] of `simulate_episode`."""
    truth, odometry, scan_keys = _drive(key, robot, path, num_scans=num_scans)
    return truth, odometry, lax.map(lambda x: _scan(lidar, world, *x), (truth, scan_keys))


def _drive(key: Key, robot: Robot, path: Array, *, num_scans: int) -> tuple[Array, Array, Key]:
    """True poses (T, 3), odometry increments (T, 3), and a key (T,) for each scan."""
    drive_key, scan_key = jax.random.split(key)
    truth, odometry = drive(drive_key, robot, path, num_scans=num_scans)
    return truth, odometry, jax.random.split(scan_key, num_scans)


def _scan(
    lidar: Lidar, world: World, pose: Array, key: Key, *, noise_by_incidence: float = 0.0
) -> Scan:
    """Noisy scan of the world from a pose (3,)."""
    hits, factors = ray_casting.find_hits(lidar, world, pose), None
    if noise_by_incidence != 0.0:
        angle = ray_casting.incidence(lidar, world, pose, hits=hits)
        factors = jnp.exp(noise_by_incidence * angle)
    return ray_casting.add_range_noise(key, lidar, to_scan(lidar, hits.distance), factors)
