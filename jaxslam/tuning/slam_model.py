"""The SLAM filter as a model whose parameters are tuned."""

from functools import lru_cache
from typing import Any, NamedTuple, cast

import numpy as np

from jaxslam.core.batching import BatchSize
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import as_count
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig, check_options
from jaxslam.filtering.config import init as initial_belief
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import EPISODE_BATCH
from jaxslam.tuning.inputs import as_episodes, as_params, check_scan_matching
from jaxslam.tuning.model import Model
from jaxslam.tuning.model_checks import check_hashable


class SlamInit(NamedTuple):
    """`Model.init` of the SLAM filter: at the first true pose, without a map.

    Attributes:
        config: Of the filter.
    """

    config: FilterConfig

    def __call__(self, params: NoiseParams, episode: Episode) -> Belief:
        """The belief before the first step."""
        del params
        return initial_belief(self.config, episode.truth[0])


class SlamStep(NamedTuple):
    """`Model.step` of the SLAM filter.

    Attributes:
        config: Of the filter.
    """

    config: FilterConfig

    def __call__(
        self, params: NoiseParams, belief: Belief, now: Measurement
    ) -> tuple[Belief, StepInfo]:
        """One step of `slam_filter`."""
        return slam_filter.unchecked_step(self.config, params, belief, now)


def measurements(params: NoiseParams, episode: Episode) -> Measurement:
    """`Model.inputs` of the SLAM filter: measurements and controls [T]."""
    del params
    return measurements_of(episode)


class SlamCheck(NamedTuple):
    """`Model.check` of the SLAM filter.

    Attributes:
        config: Of the filter.
    """

    config: FilterConfig

    def __call__(
        self, params: NoiseParams, episodes: Any, name: str
    ) -> tuple[NoiseParams, Episode]:
        """Noise and episodes [B] as arrays, checked; a list of single episodes is stacked.

        Raises:
            ValueError: A field of the noise or of the episodes has another shape or kind; or there
                are scan matches without a factor on them, or the reverse; or landmark ids above
                the capacity; or parameters of an option that the filter's configuration has not.
        """
        params = as_params(params, positive=False)
        check_options(self.config, params)
        stacked = as_episodes(episodes, name=name)
        check_scan_matching(params, stacked, name=name)
        capacity, ids = self.config.max_landmarks, stacked.landmark_ids
        if ids is not None and np.max(ids, initial=-1) >= capacity:
            raise ValueError(
                f"{name}.landmark_ids holds {np.max(ids)}, but config.filter.max_landmarks is "
                f"{capacity}: ids are 0 to max_landmarks - 1"
            )
        return params, stacked


@lru_cache
def slam_model(config: Config) -> Model:
    """The SLAM filter as a model: `NoiseParams`, episodes, and `StepInfo` of each step.

    Data association is found anew at every evaluation, and derivatives are those of the filter with
    its matches held fixed.

    Args:
        config: Its filter is the one that is tuned.
    """
    own = config.filter
    # mypy does not see that a NamedTuple can be called.
    init, step, check = cast(Any, (SlamInit(own), SlamStep(own), SlamCheck(own)))
    return Model(init, step, measurements, check, batch_size=EPISODE_BATCH)


def as_model(model: Model | Config) -> Model:
    """A model itself, or the SLAM filter of a configuration.

    Raises:
        ValueError: It is neither.
    """
    if isinstance(model, Config):
        return slam_model(model)
    if not isinstance(model, Model):
        order = "the order is model, params, data"  # two that were swapped are the usual cause
        raise ValueError(f"model is {type(model).__name__}, not Config or a tuning.Model; {order}")
    for name, function in model._asdict().items():
        if name != "batch_size" and not callable(function):
            raise ValueError(f"model.{name} is {function!r}, not a function")
    if not isinstance(model.batch_size, BatchSize):
        as_count("model.batch_size", model.batch_size)
    check_hashable("model", model)
    return model
