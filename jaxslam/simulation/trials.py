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
from jaxslam.core.types import Array, Key
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline import offline
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import EPISODE_BATCH, TrialResult, filter_episodes
from jaxslam.pipeline.offline import SlamResult
from jaxslam.simulation.drives import simulate_episode, simulate_scans
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World


def replay_trial(
    key: Key,
    config: Config,
    robot: Robot,
    params: NoiseParams,
    world: World,
    path: Array,
    *,
    trial: int,
    num_scans: int,
) -> tuple[Array, SlamResult]:
    """Simulate one trial of an experiment again and run SLAM on it.

    Args:
        key: Key of the experiment; the other arguments, too, are those of `run_trials`.
        config: Of front end and filter.
        params: Q and R that the filter assumes.
        world: The world.
        robot: The robot, with its encoder noise.
        path: (N, 2) [m, world] to drive along.
        trial: Number of the trial.
        num_scans: T, number of scans.

    Returns:
        True poses (T, 3), and the result of `offline.run_slam`.
    """
    trial_key = trial_keys(key, jnp.array([trial]))[0]

    def scans_of(own: Key) -> tuple[Array, Array, Scan]:
        return simulate_scans(own, config, robot, world, path, num_scans=num_scans)

    truth, odometry, scans = jax.jit(scans_of)(trial_key)
    return truth, offline.run_slam(config, params, truth[0], odometry, scans)


@partial(jax.jit, static_argnames=("config", "robot", "num_scans"))
def simulate_keys(
    keys: Key, config: Config, robot: Robot, world: World, path: Array, *, num_scans: int
) -> Episode:
    """Simulate one trial of `num_scans` scans for each of the keys (B,)."""
    return lax.map(
        lambda key: simulate_episode(key, config, robot, world, path, num_scans=num_scans), keys
    )


def trial_keys(key: Key, trials: Array) -> Key:
    """Keys (B,) of the trials with numbers (B,): each can be repeated without the others."""
    return jax.vmap(partial(jax.random.fold_in, key))(trials)


def simulate_episodes(
    key: Key,
    config: Config,
    robot: Robot,
    world: World,
    path: Array,
    *,
    num_trials: int,
    num_scans: int,
) -> Episode:
    """Simulate trials 0 to B - 1, each of `num_scans` scans along `path` (N, 2)."""
    keys = trial_keys(key, jnp.arange(num_trials))
    return simulate_keys(keys, config, robot, world, path, num_scans=num_scans)


class _Common(NamedTuple):
    """What all trials of an experiment have in common.

    Attributes:
        key: Data of the experiment's key, which NumPy can hold.
        noise: Q and R that the filter assumes.
        world: The world.
        path: (N, 2) [m, world].
    """

    key: Array
    noise: NoiseParams
    world: World
    path: Array


def _group_tracks(
    config: Config, robot: Robot, steps: int, key_type: Any, common: _Common, numbers: Array
) -> TrialResult:
    """Simulate the trials with the numbers (RUNS,) in turn, and filter them together."""
    keys = trial_keys(jax.random.wrap_key_data(common.key, impl=key_type), numbers)
    logs = simulate_keys(keys, config, robot, common.world, common.path, num_scans=steps)
    return filter_episodes(config, common.noise, logs)


_spread_groups = DeviceMap(_group_tracks, size=1, static=4)


def run_trials(
    key: Key,
    config: Config,
    robot: Robot,
    params: NoiseParams,
    world: World,
    path: Array,
    *,
    num_trials: int,
    num_scans: int,
    first: int = 0,
    devices: Sequence[jax.Device] | None = None,
) -> Iterator[TrialResult]:
    """Simulate and filter trials `first` to B - 1; yield their tracks in order, some at a time.

    A round gives each of D devices one group of RUNS trials. Round i + 1 is queued before round i
    is waited for, so devices work while the caller has the results of round i:

        host      queue 0, 1 | wait 0 | yield 0 | queue 2 | wait 1 | yield 1 | wait 2 | yield 2
        devices     | round 0         | round 1           | round 2          |

    Memory is bounded by two rounds. The result of a trial depends neither on how many there are
    nor on where it runs, bit for bit where devices are alike. With several processes all must
    call it with the same arguments, and all get all tracks, which hold NumPy arrays.

    Args:
        key: Key of the experiment; trial i has `trial_keys(key, i)`.
        config: Of front end and filter.
        params: Q and R that the filter assumes.
        world: The world.
        robot: The robot, with its encoder noise.
        path: (N, 2) [m, world] to drive along.
        num_trials: B, number of trials.
        num_scans: T, scans of a trial.
        first: Number of the first trial; those before it were done by another call.
        devices: To be used; all, of all processes, by default.
    """
    devices = jax.devices() if devices is None else devices
    common = _Common(jax.random.key_data(key), params, world, path)
    per_round = EPISODE_BATCH * len(devices)
    key_type = jax.random.key_impl(key)

    def begin(start: int) -> Callable[[], TrialResult]:
        # The last round is filled up with its last trial, so that nothing is compiled again.
        numbers = np.minimum(start + np.arange(per_round, dtype=np.int32), num_trials - 1)
        groups = numbers.reshape(-1, EPISODE_BATCH)
        return _spread_groups.begin(
            config, robot, num_scans, key_type, common, groups, devices=devices
        )

    def end(start: int, finish: Callable[[], TrialResult]) -> TrialResult:
        wanted = slice(max(0, first - start), num_trials - start)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[wanted], finish())

    pending = None
    # Groups begin at multiples of RUNS, whatever `first` is.
    for start in range(first - first % EPISODE_BATCH, num_trials, per_round):
        following = start, begin(start)
        if pending is not None:
            yield end(*pending)
        pending = following
    if pending is not None:
        yield end(*pending)
