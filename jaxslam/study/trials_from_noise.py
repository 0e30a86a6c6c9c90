"""Trials of a variant as functions of their noise, in bounded memory, on all devices."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.batching import leading_size, pad_to
from jaxslam.core.devices import DeviceMap
from jaxslam.core.types import Array, Key
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.pipeline.episodes import EPISODE_BATCH, TrialResult, filter_batch
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_episodes import map_drives, trial_keys
from jaxslam.simulation.trial_noise import TrialNoise, draw_noises, simulate_from_noise
from jaxslam.simulation.worlds import World
from jaxslam.study.runner import Variant

Score = Callable[[TrialResult], Array]
"""Of the result of one trial: how near it is to a failure, a number ()."""


def largest_error(result: TrialResult) -> Array:
    """Largest distance () [m] of the estimated position from the true one on a drive."""
    gap = (result.estimate - result.truth)[:, :2]
    return jnp.max(jnp.sqrt(jnp.sum(gap**2, axis=1)))


def final_error(result: TrialResult) -> Array:
    """Distance () [m] of the estimated position from the true one at the end of a drive."""
    gap = (result.estimate - result.truth)[-1, :2]
    return jnp.sqrt(jnp.sum(gap**2))


class Common(NamedTuple):
    """What all trials have in common.

    Attributes:
        params: Q and R that the filter assumes.
        world: The world.
        path: (N, 2) [m, world].
        life: What may go wrong; None: nothing.
    """

    params: NoiseParams
    world: World
    path: Array
    life: Life | None


class TrialsFromNoise:
    """Trials of a variant, whose noise is an argument.

    ```
    trials = TrialsFromNoise(variant)
    found = rare_failure(key, trials.draw, trials.score, threshold=0.5)
    ```
    """

    def __init__(self, variant: Variant, score: Score = largest_error):
        """Prepare trials.

        Args:
            variant: What is driven.
            score: Of a trial; infinite or NaN where the estimate is not finite.
        """
        self._variant = variant
        self._score = score
        self._matching = variant.config.scan_matching if variant.match_scans else None
        world = jax.tree.map(_in_precision, variant.world)
        path = jnp.asarray(variant.path, float)
        self._common = Common(variant.params, world, path, variant.life)

    def draw(self, keys: Key) -> TrialNoise:
        """Noise [B] of trials with the keys (B,)."""
        own = self._variant
        return draw_noises(keys, own.config.frontend.lidar, own.robot, own.num_scans)

    def plain_noise(self, seed: int, numbers: np.ndarray) -> TrialNoise:
        """Noise [B] of plain trials with the numbers (B,), each the same in any company."""
        return self.draw(trial_keys(jax.random.key(seed), jnp.asarray(numbers, jnp.int32)))

    def score(self, noise: TrialNoise) -> np.ndarray:
        """Scores (B,) of trials with the noise [B]; NaN where the estimate is not finite."""
        return self.spread(_SCORES, noise, (self._score, self._matching))

    def results(self, noise: TrialNoise) -> TrialResult:
        """Results [B] of trials with the noise [B]."""
        return self.spread(_RESULTS, noise, (self._score, self._matching))

    def spread(self, mapped: DeviceMap, noise: TrialNoise, static: Any, *given: Array) -> Any:
        """Results of a function of a group of `EPISODE_BATCH` trials, on all devices.

        Args:
            mapped: Of configuration of front end and filter, robot, `static`, type of keys; what
                is common; and the noise of a group, whose keys are data: `with_keys`.
            noise: [B] of the trials.
            static: Hashable argument.
            given: Arrays that all trials have in common, in addition; without any, what is common
                is a `Common` alone.
        """
        count = leading_size("noise", noise.wheels)
        data = noise._replace(
            start=jax.random.key_data(noise.start), scans=jax.random.key_data(noise.scans)
        )
        size = EPISODE_BATCH.on(jax.default_backend())
        data = pad_to(data, to=count + -count % size)
        groups = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), data)
        own = self._variant
        fixed = own.config.frontend, own.config.filter, own.robot, static
        common = (self._common, *given) if given else self._common
        found = mapped(*fixed, jax.random.key_impl(noise.start), common, groups)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], found)


def with_keys(data: TrialNoise, key_type: Any) -> TrialNoise:
    """Noise whose keys are given as data."""
    keys = (jax.random.wrap_key_data(x, impl=key_type) for x in (data.start, data.scans))
    return TrialNoise(data.wheels, data.ranges, *keys)


def _filter(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    static: tuple[Score, ScanMatchSpec | None],
    key_type: Any,
    common: Common,
    data: TrialNoise,
) -> TrialResult:
    """Simulate the trials of a group in turn, and filter them together."""

    def simulate(one: TrialNoise) -> Any:
        given = frontend, robot, common.world, common.path
        noise = with_keys(one, key_type)
        return simulate_from_noise(noise, *given, life=common.life, matching=static[1])

    return filter_batch(config, common.params, map_drives(simulate, data))


def _scores(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    static: tuple[Score, ScanMatchSpec | None],
    key_type: Any,
    common: Common,
    data: TrialNoise,
) -> Array:
    """Scores of the trials of a group."""
    result = _filter(frontend, config, robot, static, key_type, common, data)
    return jnp.where(result.finite, jax.vmap(static[0])(result), jnp.nan)


_RESULTS = DeviceMap(_filter, size=1, static=5)
_SCORES = DeviceMap(_scores, size=1, static=5)


def _in_precision(x: Any) -> Array:
    array = np.asarray(x)
    return jnp.asarray(array, float if array.dtype.kind == "f" else None)
