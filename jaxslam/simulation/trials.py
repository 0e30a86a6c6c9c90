"""Monte-Carlo trials: many simulated drives, filtered on all devices."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.devices import DeviceMap
from jaxslam.core.episode import Episode
from jaxslam.core.scan import Scan
from jaxslam.core.types import Array, Key, as_count, as_size, check_type
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.pipeline import offline
from jaxslam.pipeline.arguments import as_params, check_config
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import EPISODE_BATCH, TrialResult, filter_batch
from jaxslam.pipeline.results import SlamResult
from jaxslam.simulation import arguments, path_checks
from jaxslam.simulation.drives import num_scans_of_drive, simulate_episode, simulate_scans
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

ROBOT = Robot()  # the default one


class _Drive(NamedTuple):
    """What is driven, checked.

    Attributes:
        robot: With its encoder noise.
        world: The walls.
        path: (N, 2) [m, world].
        num_scans: T, number of scans.
        life: What may go wrong; None: nothing.
    """

    robot: Robot
    world: World
    path: Array
    num_scans: int
    life: Life | None


def _drive_of(
    key: Key,
    config: Config,
    robot: Robot,
    world: str | World,
    path: Any,
    num_scans: int | None,
    life: Life | None,
) -> _Drive:
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
    if num_scans is None:
        return _Drive(robot, walls, points, num_scans_of_drive(robot, points, walls), life)
    return _Drive(robot, walls, points, as_count("num_scans", num_scans), life)


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
) -> tuple[Array, SlamResult]:
    """Simulate one trial of an experiment again and run SLAM on it, without scan matching.

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

    Returns:
        True poses (T, 3), and the result of `offline.run_slam`, not smoothed.

    Raises:
        ValueError: An argument is not possible.
    """
    params = as_params(params, match_scans=False)
    given = _drive_of(key, config, robot, world, path, num_scans, life)
    number = as_count("trial", trial, least=0)
    trial_key = trial_keys(key, jnp.array([number]))[0]

    def scans_of(own: Key) -> tuple[Array, Array, Scan]:
        lidar, (robot, world, path, num_scans, life) = config.frontend.lidar, given
        return simulate_scans(own, lidar, robot, world, path, num_scans=num_scans, life=life)

    truth, odometry, scans = jax.jit(scans_of)(trial_key)
    result = offline.run_slam(
        config, params, odometry, scans, start=truth[0], match_scans=False, smooth=False
    )
    return truth, result


def simulate_keys(
    keys: Key,
    config: Config,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
) -> Episode:
    """Simulate one trial of `num_scans` scans for each of the keys (B,)."""
    return _simulate_keys(
        keys,
        config.frontend,
        robot,
        world,
        path,
        num_scans=num_scans,
        noise_by_incidence=noise_by_incidence,
        life=life,
    )


@partial(jax.jit, static_argnames=("config", "robot", "num_scans", "noise_by_incidence"))
def _simulate_keys(
    keys: Key,
    config: FrontendConfig,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_scans: int,
    noise_by_incidence: float = 0.0,
    life: Life | None = None,
) -> Episode:
    """`simulate_keys`, compiled for the front end alone."""
    one = partial(
        simulate_episode, num_scans=num_scans, noise_by_incidence=noise_by_incidence, life=life
    )
    return lax.map(lambda key: one(key, config, robot, world, path), keys)


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

    Returns:
        [B] episodes.

    Raises:
        ValueError: An argument is not possible; the message says what is expected.
    """
    given = _drive_of(key, config, robot, world, path, num_scans, life)
    keys = trial_keys(key, jnp.arange(as_count("num_trials", num_trials)))
    robot, walls, points, steps, life = given
    return simulate_keys(
        keys,
        config,
        robot,
        walls,
        points,
        num_scans=steps,
        noise_by_incidence=as_size("noise_by_incidence", noise_by_incidence, unit="1 / rad"),
        life=life,
    )


class _Common(NamedTuple):
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


def _filter_group(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    num_scans: int,
    key_type: Any,
    common: _Common,
    numbers: Array,
) -> TrialResult:
    """Simulate the trials with the numbers (EPISODE_BATCH,) in turn, and filter them together."""
    keys = trial_keys(jax.random.wrap_key_data(common.key, impl=key_type), numbers)
    given = frontend, robot, common.world, common.path
    episodes = _simulate_keys(keys, *given, num_scans=num_scans, life=common.life)
    return filter_batch(config, common.params, episodes)


_SPREAD_GROUPS = DeviceMap(_filter_group, size=1, static=5)


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
    first: int = 0,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[TrialResult]:
    """Simulate and filter trials `first` to B - 1; yield results in order, some at a time.

    A round gives each of D devices one group of `EPISODE_BATCH` trials. Round i + 1 is queued
    before round i is waited for, so devices work while the caller has the results of round i:

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
        first: Number of the first trial; those before it were done by another call.
        devices: To be used; all, of all processes, by default.

    Raises:
        ValueError: An argument is not possible; at the call, before the first result is asked for.
    """
    params = as_params(params, match_scans=False)
    given = _drive_of(key, config, robot, world, path, num_scans, life)
    total = as_count("num_trials", num_trials)
    begin = as_count("first", first, least=0)
    if devices is not None and not len(devices):
        raise ValueError("devices is empty; None stands for all")
    used = jax.devices() if devices is None else devices
    return _run_groups(key, config, params, given, begin, total, used)


def _run_groups(
    key: Key,
    config: Config,
    params: NoiseParams,
    given: _Drive,
    first: int,
    num_trials: int,
    devices: Sequence[jax.Device],
) -> Iterator[TrialResult]:
    """The loop of `run_trials`, whose arguments are checked."""
    common = _Common(jax.random.key_data(key), params, given.world, given.path, given.life)
    static = config.frontend, config.filter, given.robot, given.num_scans, jax.random.key_impl(key)
    per_round = EPISODE_BATCH * len(devices)

    def begin(start: int) -> Callable[[], TrialResult]:
        # The last round is filled up with its last trial, so that nothing is compiled again.
        numbers = np.minimum(start + np.arange(per_round, dtype=np.int32), num_trials - 1)
        groups = numbers.reshape(-1, EPISODE_BATCH)
        return _SPREAD_GROUPS.begin(*static, common, groups, devices=devices)

    def end(start: int, finish: Callable[[], TrialResult]) -> TrialResult:
        wanted = slice(max(0, first - start), num_trials - start)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[wanted], finish())

    pending = None
    # Groups begin at multiples of EPISODE_BATCH, whatever `first` is.
    for start in range(first - first % EPISODE_BATCH, num_trials, per_round):
        following = start, begin(start)
        if pending is not None:
            yield end(*pending)
        pending = following
    if pending is not None:
        yield end(*pending)
