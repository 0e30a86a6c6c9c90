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
from jaxslam.pipeline.episodes import EPISODE_BATCH, TrialResult, filter_batch
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_noise import TrialNoise, draw_noises, simulate_from_noise
from jaxslam.simulation.trials import trial_keys
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


class _Common(NamedTuple):
    """What all trials have in common, as `Variant` has it."""

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
        world = jax.tree.map(_in_precision, variant.world)
        path = jnp.asarray(variant.path, float)
        self._common = _Common(variant.params, world, path, variant.life)

    def draw(self, keys: Key) -> TrialNoise:
        """Noise [B] of trials with the keys (B,)."""
        own = self._variant
        return draw_noises(keys, own.config.frontend.lidar, own.robot, own.num_scans)

    def noise_of(self, seed: int, numbers: np.ndarray) -> TrialNoise:
        """Noise [B] of plain trials with the numbers (B,), each the same whatever the others are."""
        return self.draw(trial_keys(jax.random.key(seed), jnp.asarray(numbers, jnp.int32)))

    def score(self, noise: TrialNoise) -> np.ndarray:
        """Scores (B,) of trials with the noise [B]; NaN where the estimate is not finite."""
        return self._run(_score_group, noise)

    def results(self, noise: TrialNoise) -> TrialResult:
        """Results [B] of trials with the noise [B]."""
        return self._run(_filter_group, noise)

    def _run(self, spread: DeviceMap, noise: TrialNoise) -> Any:
        count = leading_size("noise", noise.wheels)
        data = noise._replace(
            start=jax.random.key_data(noise.start), scans=jax.random.key_data(noise.scans)
        )
        data = pad_to(data, to=count + -count % EPISODE_BATCH)
        groups = jax.tree.map(lambda x: x.reshape(-1, EPISODE_BATCH, *x.shape[1:]), data)
        own = self._variant
        static = own.config.frontend, own.config.filter, own.robot, self._score
        kind = jax.random.key_impl(noise.start)
        found = spread(*static, kind, self._common, groups)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], found)


def _filter(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    score: Score,
    key_type: Any,
    common: _Common,
    data: TrialNoise,
) -> TrialResult:
    """Simulate the trials of a group in turn, and filter them together."""

    def simulate(one: TrialNoise) -> Any:
        keys = (jax.random.wrap_key_data(x, impl=key_type) for x in (one.start, one.scans))
        noise = TrialNoise(one.wheels, one.ranges, *keys)
        given = frontend, robot, common.world, common.path
        return simulate_from_noise(noise, *given, life=common.life)

    return filter_batch(config, common.params, jax.lax.map(simulate, data))


def _scores(
    frontend: FrontendConfig,
    config: FilterConfig,
    robot: Robot,
    score: Score,
    key_type: Any,
    common: _Common,
    data: TrialNoise,
) -> Array:
    """Scores of the trials of a group."""
    result = _filter(frontend, config, robot, score, key_type, common, data)
    return jnp.where(result.finite, jax.vmap(score)(result), jnp.nan)


_filter_group = DeviceMap(_filter, size=1, static=5)
_score_group = DeviceMap(_scores, size=1, static=5)


def _in_precision(x: Any) -> Array:
    array = np.asarray(x)
    return jnp.asarray(array, float if array.dtype.kind == "f" else None)
