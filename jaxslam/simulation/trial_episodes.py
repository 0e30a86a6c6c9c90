"""Simulated drives of one robot in one world, as episodes: one for each trial of an experiment."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.batching import BatchSize, map_batches, traced_platform
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.scan import Scan
from jaxslam.core.types import Array, Key, as_count, as_size, check_type
from jaxslam.frontend import extract
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.extract import SCAN_BATCH
from jaxslam.matching import scan_matching
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.pipeline.arguments import check_config
from jaxslam.pipeline.config import Config
from jaxslam.simulation import arguments, drives, path_checks
from jaxslam.simulation.drives import num_scans_of_drive
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

ROBOT = Robot()  # the default one

DRIVE_BATCH = BatchSize(cpu=1, accelerator=256)  # drives that are simulated together
DRIVE_SCAN_BATCH = BatchSize(
    *(max(1, scans // drives) for scans, drives in zip(SCAN_BATCH, DRIVE_BATCH, strict=True))
)  # scans of each of them


class TrialDrive(NamedTuple):
    """What is driven, checked.

    Attributes:
        robot: With its encoder noise.
        world: The walls.
        path: (N, 2) [m, world].
        num_scans: T, number of scans.
        life: What may go wrong; None: nothing.
        matching: Options by which scans are matched; None: they are not.
    """

    robot: Robot
    world: World
    path: Array
    num_scans: int
    life: Life | None
    matching: ScanMatchSpec | None


def drive_of(
    key: Key,
    config: Config,
    robot: Robot,
    world: str | World,
    path: Any,
    num_scans: int | None,
    life: Life | None,
    match_scans: bool,
) -> TrialDrive:
    """The drive that the arguments of the functions below describe.

    Raises:
        ValueError: One of them is not possible; the message names it.
    """
    arguments.check_key(key)
    check_config(config)
    robot = arguments.as_robot(robot)
    walls = arguments.as_world(world, config.frontend.lidar.range_max)
    arguments.check_lidar_of(robot, config.frontend.lidar)
    points = arguments.as_path(path, world)
    path_checks.check_line_in_world(np.asarray(points), walls, "path")
    if life is not None:
        check_type("life", life, Life, advice=": see jaxslam.simulation.life_in")
        if len(life.materials) != len(walls.walls):
            raise ValueError(
                f"life.materials has {len(life.materials)} walls and world.walls "
                f"{len(walls.walls)}; make it by jaxslam.simulation.life_in of this world"
            )
    check_type("match_scans", match_scans, bool)
    matching = config.scan_matching if match_scans else None
    if num_scans is None:
        steps = num_scans_of_drive(robot, points, walls)
    else:
        steps = as_count("num_scans", num_scans)
    return TrialDrive(robot, walls, points, steps, life, matching)


def simulate_drives(
    keys: Key,
    config: FrontendConfig,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
    matching: ScanMatchSpec | None = None,
) -> Episode:
    """Simulate one trial of `num_scans` scans for each of the keys (B,).

    It is compiled for front end and scan matching alone, not for each filter; quickly, where there
    are few scans.
    """
    return _drives_of(keys.shape[0] * num_scans)(
        keys,
        config,
        robot,
        world,
        path,
        num_scans=num_scans,
        noise_by_incidence=noise_by_incidence,
        life=life,
        matching=matching,
    )[0]


def drives_and_scans(
    keys: Key,
    config: FrontendConfig,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
    matching: ScanMatchSpec | None = None,
    with_scans: bool = False,
) -> tuple[Episode, Scan | None]:
    """`simulate_drives`, not jitted, and the scans [B, T] of each if they are wanted."""
    one = partial(
        simulate_episode,
        num_scans=num_scans,
        noise_by_incidence=noise_by_incidence,
        life=life,
        matching=matching,
        with_scans=with_scans,
    )
    return map_drives(lambda key: one(key, config, robot, world, path), keys)


_drives_of = trace_cache.jit_by_length(
    drives_and_scans,
    static_argnames=("config", "robot", "num_scans", "noise_by_incidence", "matching"),
)


def map_drives(simulate: Callable, items: Any) -> Any:
    """`simulate` of each of `items` [B]: one after the other on a CPU, else some at a time."""
    together = DRIVE_BATCH.on(traced_platform())
    if together == 1:
        return lax.map(simulate, items)
    return map_batches(simulate, items, batch_size=together)


def simulate_episode(
    key: Key,
    config: FrontendConfig,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
    matching: ScanMatchSpec | None = None,
    with_scans: bool = False,
) -> tuple[Episode, Scan | None]:
    """One trial: drive along `path` (N, 2), scan the world `num_scans` times, extract features.

    Scans are matched, too, if `matching` says by which options. The standard deviation of a range
    has the factor exp(`noise_by_incidence` times the angle [rad] between its beam and the normal of
    the wall). It is that of `robot.scanner`, if there is one.
    """
    scan_of, items, odometry = drives.drive_by_key(
        key,
        config.lidar,
        robot,
        world,
        path,
        num_scans=num_scans,
        noise_by_incidence=noise_by_incidence,
        life=life,
    )

    return episode_of(config, scan_of, items, odometry, matching=matching, with_scans=with_scans)


def episode_of(
    config: FrontendConfig,
    scan_of: Callable[[tuple], Scan],
    items: tuple,
    odometry: Array,
    *,
    matching: ScanMatchSpec | None = None,
    with_scans: bool = False,
) -> tuple[Episode, Scan | None]:
    """The episode of a drive whose scans are still to be made, by `drive_and_scan`; and these."""
    matches = None
    if matching is not None:
        # Scan matching takes them in turn, the front end some at a time: they are made before.
        items = items[0], lax.map(scan_of, items)
        empty = scan_matching.empty_submap(matching, config.lidar)
        matches = scan_matching.match_scans(matching, config.lidar, empty, items[1], odometry)[1]

    def observe(item: tuple) -> tuple[Features, Scan | None]:
        scan = item[1] if matching else scan_of(item)
        return extract.extract_features(config, scan), scan if with_scans else None

    features, scans = map_batches(observe, items, batch_size=DRIVE_SCAN_BATCH)
    episode = Episode(truth=items[0], odometry=odometry, features=features, scan_matches=matches)
    return episode, scans


@jax.jit
def trial_keys(key: Key, trials: Array) -> Key:
    """Keys (B,) of the trials with numbers (B,): each can be repeated without the others."""
    return jax.vmap(partial(jax.random.fold_in, key))(trials)


def simulate_episodes(
    key: Key,
    config: Config,
    robot: Robot = ROBOT,
    world: str | World = "office",
    path: Any = None,
    *,
    num_trials: int,
    num_scans: int | None = None,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
    match_scans: bool = False,
) -> Episode:
    """Simulate trials 0 to B - 1: drives of a robot along a path, and the features of its scans.

    Args:
        key: Key of the experiment; trial i has `trial_keys(key, i)`.
        config: Of the front end.
        robot: The robot, with its encoder noise.
        world: Name of the world (`worlds.NAMES`), or its walls.
        path: (N, 2) [m, world] to drive along, N >= 6; the world's own waypoints, densified, by
            default.
        num_trials: B, number of trials.
        num_scans: T, scans of a trial; to the end of the path by default.
        noise_by_incidence: [1 / rad] by which the logarithm of the standard deviation of a range
            grows with the angle between its beam and the normal of the wall.
        life: What may go wrong, by `life_in`; None: nothing.
        match_scans: Whether increments by scan matching are added, those of `config.scan_matching`.

    Returns:
        [B] episodes.

    Raises:
        ValueError: An argument is not possible; the message says what is expected.
    """
    given = drive_of(key, config, robot, world, path, num_scans, life, match_scans)
    keys = trial_keys(key, np.arange(as_count("num_trials", num_trials)))
    return simulate_drives(
        keys,
        config.frontend,
        given.robot,
        given.world,
        given.path,
        num_scans=given.num_scans,
        noise_by_incidence=as_size("noise_by_incidence", noise_by_incidence, unit="1 / rad"),
        life=given.life,
        matching=given.matching,
    )
