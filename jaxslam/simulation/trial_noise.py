"""A trial as a function of its noise, so that the noise can be moved, scaled and kept.

`simulate_episodes` draws all noise from one key. Here it is an argument: what is normal as standard
normals, and the rest as keys, one for each scan. So one part can be drawn anew while the others
stay (`study.rare_failures`), and the same noise can be had at another size
(`study.sensitivities`).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.episode import Episode
from jaxslam.core.scan import Lidar
from jaxslam.core.types import Array, Key
from jaxslam.frontend.config import FrontendConfig
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.simulation import drives, kinematics, wheel_faults
from jaxslam.simulation.drive_draws import LIFE, SUBSTEPS, Draws, LifeDraws
from jaxslam.simulation.life import Life, draw_events
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_episodes import episode_of
from jaxslam.simulation.worlds import World


class TrialNoise(NamedTuple):
    """All that is random in a trial of T scans of R beams.

    Attributes:
        wheels: (T - 1, SUBSTEPS, D) standard normals of the encoders, D = `num_draws(robot)`.
        ranges: (T, R) standard normals of the ranges.
        start: Key of what is drawn once: people, doors, materials, carpet, a robot that is carried.
        scans: (T,) keys of the rest, by scan: beams that miss, edges, slip before it, odometry
            that fails, and whether it is lost.
    """

    wheels: Array
    ranges: Array
    start: Key
    scans: Key


def draw_noise(
    key: Key, lidar: Lidar, robot: Robot, num_scans: int, dtype: Any = float
) -> TrialNoise:
    """Noise of a trial of T scans."""
    of_wheels, of_ranges, start, of_scans = jax.random.split(key, 4)
    shape = num_scans - 1, SUBSTEPS, kinematics.num_draws(robot)
    return TrialNoise(
        jax.random.normal(of_wheels, shape, dtype),
        jax.random.normal(of_ranges, (num_scans, lidar.num_beams), dtype),
        start,
        jax.random.split(of_scans, num_scans),
    )


def draws_of(noise: TrialNoise, life: Life | None) -> Draws:
    """What the noise of a trial means for its drive."""
    draws = Draws(wheels=noise.wheels, scans=noise.scans, ranges=noise.ranges)
    if life is None:
        return draws
    count, dtype = len(noise.scans), noise.wheels.dtype

    def uniform(own: Key) -> Array:
        return jax.random.uniform(jax.random.fold_in(own, LIFE), (8,), dtype)

    drawn = jax.vmap(uniform)(noise.scans)
    events = draw_events(noise.start, life, count)
    slip = wheel_faults.slip_shares(life.wheels, drawn[1:, :2], 0.9999 * drawn[1:, 2:4])
    return draws._replace(
        life=LifeDraws(
            events=events._replace(faults=events.faults._replace(slip=slip)),
            failures=drawn[:, 4:7],
            kept=drawn[:, 7] >= life.wheels.dropped,
        )
    )


def simulate_from_noise(
    noise: TrialNoise,
    config: FrontendConfig,
    robot: Robot,
    world: World,
    path: Array,
    *,
    life: Life | None = None,
    mount_error: Array | None = None,
    matching: ScanMatchSpec | None = None,
) -> Episode:
    """One trial of T scans: as `simulate_episode`, from noise that is given.

    Args:
        noise: Of the trial; scaled, it is that of encoders or ranges with as many times the noise.
        config: Of the front end.
        robot: The robot.
        world: The walls.
        path: (N, 2) [m, world] to drive along.
        life: What may go wrong; None: nothing.
        mount_error: (3,) [m, m, rad] pose of the scanner in the frame of the scanner where it is
            thought to be; None: zero.
        matching: Options by which scans are matched; None: they are not.
    """
    given = config.lidar, robot, world, path
    scan_of, items, odometry = drives.drive_and_scan(
        draws_of(noise, life), *given, life=life, mount_error=mount_error
    )

    return episode_of(config, scan_of, items, odometry, matching=matching)[0]


@partial(jax.jit, static_argnums=(1, 2, 3))
def draw_noises(keys: Key, lidar: Lidar, robot: Robot, num_scans: int) -> TrialNoise:
    """Noise [B] of trials with the keys (B,)."""
    dtype = jnp.zeros(()).dtype
    return jax.vmap(lambda key: draw_noise(key, lidar, robot, num_scans, dtype))(keys)
