"""From a log of scans and odometry to trajectory and map: whole, scan by scan, or as episodes."""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.pipeline.config import Config as Config
    from jaxslam.pipeline.episodes import TrialResult as TrialResult
    from jaxslam.pipeline.episodes import concatenate_results as concatenate_results
    from jaxslam.pipeline.episodes import episode_from_arrays as episode_from_arrays
    from jaxslam.pipeline.episodes import episode_from_landmark_log as episode_from_landmark_log
    from jaxslam.pipeline.episodes import episode_from_laser_log as episode_from_laser_log
    from jaxslam.pipeline.episodes import filter_episodes as filter_episodes
    from jaxslam.pipeline.episodes import landmark_log_config as landmark_log_config
    from jaxslam.pipeline.episodes import laser_log_config as laser_log_config
    from jaxslam.pipeline.offline import run_slam as run_slam
    from jaxslam.pipeline.online import ChunkResult as ChunkResult
    from jaxslam.pipeline.online import SlamState as SlamState
    from jaxslam.pipeline.online import init as init
    from jaxslam.pipeline.online import match_log as match_log
    from jaxslam.pipeline.online import topological_map as topological_map
    from jaxslam.pipeline.online import update as update
    from jaxslam.pipeline.online import whole_map as whole_map
    from jaxslam.pipeline.results import SlamResult as SlamResult
    from jaxslam.pipeline.saving import to_saved_map as to_saved_map
    from jaxslam.pipeline.stacking import stack_episodes as stack_episodes

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.pipeline.config": "Config",
        "jaxslam.pipeline.episodes": (
            "TrialResult concatenate_results episode_from_arrays episode_from_landmark_log "
            "episode_from_laser_log filter_episodes landmark_log_config laser_log_config"
        ),
        "jaxslam.pipeline.offline": "run_slam",
        "jaxslam.pipeline.online": (
            "ChunkResult SlamState init match_log topological_map update whole_map"
        ),
        "jaxslam.pipeline.results": "SlamResult",
        "jaxslam.pipeline.saving": "to_saved_map",
        "jaxslam.pipeline.stacking": "stack_episodes",
    },
)
