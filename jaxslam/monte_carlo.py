"""Many runs at once: simulate them, filter them, sum up their errors.

The only module, beside `fit`, in which arrays lead with B, the runs.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam import lidar, motion, plan, slam
from jaxslam.geometry import compose
from jaxslam.metrics import nees, pose_error
from jaxslam.motion import Robot
from jaxslam.nodes import Nodes
from jaxslam.slam import Config, Info, Inputs, Noise
from jaxslam.types import Array, Key
from jaxslam.world import World

SUBSTEPS = 4  # parts in which the wheels' noise is drawn between two scans
SCANS = 16  # scans of a run that are looked at together


class Log(NamedTuple):
    """One simulated run: what happened and what the robot was told of it."""

    truth: Array  # (T, 3) pose at each scan, world frame
    motion: Array  # (T, 3) odometry since the scan before, zero at the first
    nodes: Nodes  # [T] features of each scan


class Track(NamedTuple):
    """One filtered run, for evaluation."""

    truth: Array  # (T, 3)
    estimate: Array  # (T, 3)
    cov: Array  # (T, 3, 3)
    odometry: Array  # (T, 3) dead reckoning
    matches: Array  # (T,) int32 features that updated the state
    landmarks: Array  # () int32 landmarks that count at the end
    finite: Array  # () bool


class Summary(NamedTuple):
    """Errors over all runs and steps; diverged runs are counted, runs with NaN left out."""

    position_rmse: Array  # [m]
    heading_rmse: Array  # [rad]
    nees: Array  # mean over runs and steps, per degree of freedom of the pose
    diverged: Array  # runs whose final position error exceeds 1 m, or is not a number
    runs: Array


def start(path: Array) -> Array:
    """Pose (3,) at the beginning of a path (N, 2), looking along it."""
    ahead = path[5] - path[0]
    return jnp.append(path[0], jnp.arctan2(ahead[1], ahead[0]))


def drive(key: Key, robot: Robot, path: Array, *, steps: int) -> tuple[Array, Array]:
    """Drive along a path (N, 2), steered by the true pose.

    Returns:
        True poses (T, 3) and odometry increments (T, 3), one for each of `steps` scans.
    """
    first = start(path)
    draws = jax.random.normal(key, (steps - 1, SUBSTEPS, 2), path.dtype)

    def body(now, draw):
        pose, place = now
        told, place = plan.follow(path, place, pose)
        pose = compose(pose, motion.roll(robot, draw, told))
        return (pose, place), (pose, told)

    _, (poses, told) = lax.scan(body, (first, jnp.int32(0)), draws)
    return jnp.concatenate([first[None], poses]), jnp.pad(told, ((1, 0), (0, 0)))


def drive_steps(robot: Robot, path: Array) -> int:
    """Number of scans on a noise-free drive to the end of a path (N, 2)."""
    most = 40 + int(4 * np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)) / 0.3)
    still = robot._replace(wheel_noise=0.0)
    told = jax.jit(partial(drive, steps=most), static_argnums=1)(jax.random.key(0), still, path)[1]
    moving = np.abs(np.asarray(told)[1:]).sum(axis=1) > 0
    return 1 + int(moving.sum())


def simulate_one(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, steps: int
) -> Log:
    """Drive once along `path` (N, 2) and look at the world `steps` times."""
    drive_key, scan_key = jax.random.split(key)
    truth, told = drive(drive_key, robot, path, steps=steps)

    def look(now: tuple[Array, Key]) -> Nodes:
        pose, scan_key = now
        scan = lidar.cast(world, pose, config.lidar)
        return slam.front_end(config, lidar.disturb(scan_key, scan, config.lidar))

    seen = lax.map(look, (truth, jax.random.split(scan_key, steps)), batch_size=SCANS)
    return Log(truth=truth, motion=told, nodes=seen)


@partial(jax.jit, static_argnames=("config", "robot", "steps"))
def _simulate(keys, config, world, robot, path, *, steps) -> Log:
    return lax.map(
        lambda key: simulate_one(key, config, world, robot, path, steps=steps), keys
    )


def simulate(
    key: Key, config: Config, world: World, robot: Robot, path: Array, *, runs: int, steps: int
) -> Log:
    """Simulate B runs of `steps` scans along `path` (N, 2); run i has the key fold_in(key, i)."""
    keys = jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(runs))
    return _simulate(keys, config, world, robot, path, steps=steps)


def dead_reckoning(first: Array, told: Array) -> Array:
    """Poses (T, 3) by composing odometry increments (T, 3) from the pose `first` (3,)."""

    def body(pose, step):
        pose = compose(pose, step)
        return pose, pose

    return lax.scan(body, first, told)[1]


def track(config: Config, noise: Noise, log: Log) -> Track:
    """Filter one run from its true start."""
    belief, info = slam.run(
        config, noise, slam.init(config, log.truth[0]), Inputs(log.motion, log.nodes)
    )
    return Track(
        truth=log.truth,
        estimate=info.pose,
        cov=info.pose_cov,
        odometry=dead_reckoning(log.truth[0], log.motion),
        matches=jnp.sum(info.used, axis=1, dtype=jnp.int32),
        landmarks=jnp.sum(belief.seen >= config.confirm, dtype=jnp.int32),
        finite=jnp.all(info.finite),
    )


@partial(jax.jit, static_argnames="config")
def tracks(config: Config, noise: Noise, logs: Log) -> Track:
    """Filter B runs, all with the same noise."""
    return jax.vmap(track, in_axes=(None, None, 0))(config, noise, logs)
