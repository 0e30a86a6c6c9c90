"""Monte-Carlo trials: many simulated drives, filtered on all devices."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.devices import DeviceMap
from jaxslam.core.scan import Scan
from jaxslam.core.types import Array, Key, as_count
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.pipeline import offline
from jaxslam.pipeline.arguments import as_params
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import (
    EPISODE_BATCH,
    TrialResult,
    filter_batch,
    filter_whole_batch,
)
from jaxslam.pipeline.results import SlamResult
from jaxslam.simulation.drives import simulate_scans
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_episodes import (
    ROBOT,
    TrialDrive,
    drive_of,
    drives_and_scans,
    trial_keys,
)
from jaxslam.simulation.trial_map import FilteredDrive
from jaxslam.simulation.worlds import World


def replay_trial(
    key: Key,
    config: Config,
    params: NoiseParams,
    robot: Robot = ROBOT,
    world: str | World = "office",
    path: Any = None,
    *,
    trial: int,
    num_scans: int | None = None,
    life: Life | None = None,
    match_scans: bool = False,
) -> tuple[Array, SlamResult]:
    """Simulate one trial of an experiment again and run SLAM on it, to have its map.

    Args:
        key: Key of the experiment; the other arguments, too, are those of `run_trials`.
        config: Of front end and filter.
        params: Q and R that the filter assumes.
        robot: The robot, with its encoder noise.
        world: Name of the world, or its walls.
        path: (N, 2) [m, world] to drive along; the world's own by default.
        trial: Number of the trial, from 0.
        num_scans: T, number of scans; to the end of the path by default.
        life: What may go wrong, by `life_in`; None: nothing.
        match_scans: Whether scans are matched.

    Returns:
        True poses (T, 3), and the result of `offline.run_slam`, not smoothed.

    Raises:
        ValueError: An argument is not possible.
    """
    params = as_params(params, match_scans=match_scans)
    given = drive_of(key, config, robot, world, path, num_scans, life, match_scans)
    number = as_count("trial", trial, least=0)
    trial_key = trial_keys(key, jnp.array([number]))[0]

    def scans_of(own: Key) -> tuple[Array, Array, Scan]:
        where = config.frontend.lidar, given.robot, given.world, given.path
        return simulate_scans(own, *where, num_scans=given.num_scans, life=given.life)

    truth, odometry, scans = jax.jit(scans_of)(trial_key)
    every_scan = config._replace(keyframe_distance=None)  # updates the state, as in `run_trials`
    result = offline.run_slam(
        every_scan, params, odometry, scans, start=truth[0], match_scans=match_scans, smooth=False
    )
    return truth, result


class TrialsCommon(NamedTuple):
    """What all trials of an experiment have in common.

    Attributes:
        key: Data of the experiment's key, which NumPy can hold.
        params: Q and R that the filter assumes.
        world: The world.
        path: (N, 2) [m, world].
        life: What may go wrong; None: nothing.
    """

    key: Array
    params: NoiseParams
    world: World
    path: Array
    life: Life | None


def filter_group(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    num_scans: int,
    key_type: Any,
    matching: ScanMatchSpec | None,
    with_map: bool,
    common: TrialsCommon,
    numbers: Array,
) -> tuple[TrialResult, FilteredDrive | None]:
    """Simulate the trials with the numbers (B,) in turn, and filter them together; not jitted.

    It is the program of `run_trials`, a device and round.

    Args:
        frontend: Of the front end.
        config: Of the filter.
        robot: The robot, with its encoder noise.
        num_scans: T, scans of a trial.
        key_type: Implementation of the experiment's key, as of `jax.random.key_impl`.
        matching: Options by which scans are matched; None: they are not.
        with_map: Whether what the map of the first one is made of is wanted.
        common: What all trials have in common.
        numbers: (B,) int32 of the trials.

    Returns:
        The results, and what the first one's map is made of; None without `with_map`.
    """
    keys = trial_keys(jax.random.wrap_key_data(common.key, impl=key_type), numbers)
    episodes, scans = drives_and_scans(
        keys,
        frontend,
        robot,
        common.world,
        common.path,
        num_scans=num_scans,
        life=common.life,
        matching=matching,
        with_scans=with_map,
    )
    if scans is None:
        return filter_batch(config, common.params, episodes), None
    results, beliefs, infos = filter_whole_batch(config, common.params, episodes)
    drives = FilteredDrive(beliefs, infos, episodes.features, episodes.odometry, scans)
    return results, jax.tree.map(lambda x: x[0], drives)


# Compiled quickly, it would run a third slower, which pays only below some hundred drives of the
# office; and chosen by the number of trials, a trial would depend on that number.
_SPREAD_GROUPS = DeviceMap(filter_group, size=1, static=7)


def run_trials(
    key: Key,
    config: Config,
    params: NoiseParams,
    robot: Robot = ROBOT,
    world: str | World = "office",
    path: Any = None,
    *,
    num_trials: int,
    num_scans: int | None = None,
    life: Life | None = None,
    match_scans: bool = False,
    first: int = 0,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[TrialResult]:
    """Simulate and filter trials `first` to B - 1; yield results in order, some at a time.

    A round gives each of D devices one group of trials, 4 on a CPU (`EPISODE_BATCH`). Round i + 1
    is queued before round i is waited for, so devices work while the caller has the results of
    round i:

        host      queue 0, 1 | wait 0 | yield 0 | queue 2 | wait 1 | yield 1 | wait 2 | yield 2
        devices     | round 0         | round 1           | round 2          |

    Memory is bounded by two rounds. The result of a trial depends neither on how many there are
    nor on where it runs, bit for bit where devices are alike. With several processes all must
    call it with the same arguments, and all get all results, which hold NumPy arrays.

    Args:
        key: Key of the experiment; trial i has `trial_keys(key, i)`.
        config: Of front end and filter.
        params: Q and R that the filter assumes.
        robot: The robot, with its encoder noise.
        world: Name of the world (`worlds.NAMES`), or its walls.
        path: (N, 2) [m, world] to drive along, N >= 6; the world's own waypoints, densified, by
            default.
        num_trials: B, number of trials.
        num_scans: T, scans of a trial; to the end of the path by default.
        life: What may go wrong, by `life_in`; None: nothing.
        match_scans: Whether odometry is fused with scan matching, by `config.scan_matching`, as
            that of recorded logs is: for wheels that slip, and odometry that fails.
        first: Number of the first trial; those before it were done by another call.
        devices: To be used; all, of all processes, by default.

    Raises:
        ValueError: An argument is not possible; at the call, before the first result is asked for.
    """
    params = as_params(params, match_scans=match_scans)
    given = drive_of(key, config, robot, world, path, num_scans, life, match_scans)
    total = as_count("num_trials", num_trials)
    begin = as_count("first", first, least=0)
    if devices is not None and not len(devices):
        raise ValueError("devices is empty; None stands for all")
    used = jax.devices() if devices is None else devices
    groups = _run_groups(key, config, params, given, begin, total, used, with_map=False)
    return (results for results, _ in groups)


def run_trials_and_map(
    key: Key,
    config: Config,
    params: NoiseParams,
    robot: Robot = ROBOT,
    world: str | World = "office",
    path: Any = None,
    *,
    num_trials: int,
    num_scans: int | None = None,
    life: Life | None = None,
) -> Iterator[tuple[TrialResult, FilteredDrive]]:
    """`run_trials` without scan matching; each part with what its first trial's map is made of.

    `trial_map.slam_result` makes the map, without the programs that `replay_trial` compiles.

    Args:
        key: Key of the experiment; the other arguments, too, are those of `run_trials`.
        config: Of front end and filter.
        params: Q and R that the filter assumes.
        robot: The robot, with its encoder noise.
        world: Name of the world, or its walls.
        path: (N, 2) [m, world] to drive along; the world's own by default.
        num_trials: B, number of trials.
        num_scans: T, scans of a trial; to the end of the path by default.
        life: What may go wrong, by `life_in`; None: nothing.

    Raises:
        ValueError: An argument is not possible; at the call, before the first result is asked for.
    """
    params = as_params(params, match_scans=False)
    given = drive_of(key, config, robot, world, path, num_scans, life, False)
    total = as_count("num_trials", num_trials)
    groups = _run_groups(key, config, params, given, 0, total, jax.devices(), with_map=True)
    return ((results, drive) for results, drive in groups if drive is not None)


def _run_groups(
    key: Key,
    config: Config,
    params: NoiseParams,
    given: TrialDrive,
    first: int,
    num_trials: int,
    devices: Sequence[jax.Device],
    *,
    with_map: bool,
) -> Iterator[tuple[TrialResult, FilteredDrive | None]]:
    """The loop of `run_trials`, whose arguments are checked."""
    common = TrialsCommon(jax.random.key_data(key), params, given.world, given.path, given.life)
    key_type = jax.random.key_impl(key)
    of_drive = given.robot, given.num_scans, key_type, given.matching
    static = config.frontend, config.filter, *of_drive, with_map
    group_size = EPISODE_BATCH.on(devices[0].platform)
    per_round = group_size * len(devices)

    def begin(start: int) -> Callable[[], tuple[TrialResult, FilteredDrive | None]]:
        # The last round is filled up with its last trial, so that nothing is compiled again.
        numbers = np.minimum(start + np.arange(per_round, dtype=np.int32), num_trials - 1)
        groups = numbers.reshape(-1, group_size)
        return _SPREAD_GROUPS.begin(*static, common, groups, devices=devices)

    def end(
        start: int, finish: Callable[[], tuple[TrialResult, FilteredDrive | None]]
    ) -> tuple[TrialResult, FilteredDrive | None]:
        wanted = slice(max(0, first - start), num_trials - start)
        results, drives = finish()
        results = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[wanted], results)
        return results, jax.tree.map(lambda x: x[0].copy(), drives)

    pending = None
    # Groups begin at multiples of their size, whatever `first` is.
    for start in range(first - first % group_size, num_trials, per_round):
        following = start, begin(start)
        if pending is not None:
            yield end(*pending)
        pending = following
    if pending is not None:
        yield end(*pending)
