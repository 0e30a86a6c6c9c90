"""Topological SLAM for a robot with a 2-D laser scanner, as differentiable, batched JAX.

The names below are what most programs need; they are imported when they are first used. The
packages (`jaxslam.frontend`, `jaxslam.filtering`, ...) hold the rest, each with a README.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

if _TYPE_CHECKING:
    from jaxslam.core.caches import enable_caches as enable_caches
    from jaxslam.core.episode import Episode as Episode
    from jaxslam.core.logs import LaserLog as LaserLog
    from jaxslam.core.measurement import Measurement as Measurement
    from jaxslam.core.scan import Lidar as Lidar
    from jaxslam.evaluation.summary import evaluate as evaluate
    from jaxslam.filtering.config import init as init
    from jaxslam.filtering.noise import NoiseParams as NoiseParams
    from jaxslam.filtering.slam_filter import run_filter as run_filter
    from jaxslam.filtering.slam_filter import step as step
    from jaxslam.io.map_file import load_map as load_map
    from jaxslam.io.readers import read_log as read_log
    from jaxslam.pipeline.config import Config as Config
    from jaxslam.pipeline.episodes import episode_from_arrays as episode_from_arrays
    from jaxslam.pipeline.episodes import filter_episodes as filter_episodes
    from jaxslam.pipeline.offline import run_slam as run_slam
    from jaxslam.simulation.trial_episodes import simulate_episodes as simulate_episodes
    from jaxslam.simulation.trials import run_trials as run_trials
    from jaxslam.tuning.fitting import tune as tune
    from jaxslam.tuning.standard_errors import standard_errors as standard_errors

_MODULES = {
    "Config": "pipeline.config",
    "Episode": "core.episode",
    "LaserLog": "core.logs",
    "Lidar": "core.scan",
    "Measurement": "core.measurement",
    "NoiseParams": "filtering.noise",
    "enable_caches": "core.caches",
    "episode_from_arrays": "pipeline.episodes",
    "evaluate": "evaluation.summary",
    "filter_episodes": "pipeline.episodes",
    "init": "filtering.config",
    "load_map": "io.map_file",
    "read_log": "io.readers",
    "run_filter": "filtering.slam_filter",
    "run_slam": "pipeline.offline",
    "run_trials": "simulation.trials",
    "simulate_episodes": "simulation.trial_episodes",
    "standard_errors": "tuning.standard_errors",
    "step": "filtering.slam_filter",
    "tune": "tuning.fitting",
}

__all__ = list(_MODULES)  # noqa: PLE0604


def __getattr__(name: str) -> _Any:
    """A public name, imported from its module when it is first used; or the version."""
    if name == "__version__":
        return _version()
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version(__name__)
    except metadata.PackageNotFoundError:  # the source tree, not installed
        return "0+unknown"
