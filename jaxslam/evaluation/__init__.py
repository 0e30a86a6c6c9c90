"""Errors of trajectories, NEES of beliefs, consistency of maps, summaries of trials and maps."""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.core.types import Metrics as Metrics
    from jaxslam.evaluation.consistency import chi_square_bounds as chi_square_bounds
    from jaxslam.evaluation.consistency import nees as nees
    from jaxslam.evaluation.consistency import nees_per_dof as nees_per_dof
    from jaxslam.evaluation.consistency import pose_error as pose_error
    from jaxslam.evaluation.consistency import rmse as rmse
    from jaxslam.evaluation.filter_consistency import ConsistencyReport as ConsistencyReport
    from jaxslam.evaluation.filter_consistency import consistency_of_nis as consistency_of_nis
    from jaxslam.evaluation.filter_consistency import consistency_report as consistency_report
    from jaxslam.evaluation.filter_consistency import report_metrics as report_metrics
    from jaxslam.evaluation.log_errors import Trajectory as Trajectory
    from jaxslam.evaluation.log_errors import errors_against as errors_against
    from jaxslam.evaluation.log_errors import mean_ate as mean_ate
    from jaxslam.evaluation.log_errors import mean_nees_per_dof as mean_nees_per_dof
    from jaxslam.evaluation.slam_statistics import FilterStatistics as FilterStatistics
    from jaxslam.evaluation.slam_statistics import filter_with_statistics as filter_with_statistics
    from jaxslam.evaluation.slam_statistics import slam_consistency as slam_consistency
    from jaxslam.evaluation.summary import evaluate as evaluate
    from jaxslam.evaluation.trajectory import align_trajectory as align_trajectory
    from jaxslam.evaluation.trajectory import ate as ate
    from jaxslam.evaluation.trajectory import relation_errors as relation_errors
    from jaxslam.evaluation.trajectory import rpe as rpe
    from jaxslam.mapping.map_consistency import MapConsistency as MapConsistency
    from jaxslam.mapping.map_consistency import check_map as check_map
    from jaxslam.mapping.map_warnings import MapWarning as MapWarning

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.core.types": "Metrics",
        "jaxslam.evaluation.consistency": "chi_square_bounds nees nees_per_dof pose_error rmse",
        "jaxslam.evaluation.filter_consistency": (
            "ConsistencyReport consistency_of_nis consistency_report report_metrics"
        ),
        "jaxslam.evaluation.log_errors": "Trajectory errors_against mean_ate mean_nees_per_dof",
        "jaxslam.evaluation.slam_statistics": (
            "FilterStatistics filter_with_statistics slam_consistency"
        ),
        "jaxslam.evaluation.summary": "evaluate",
        "jaxslam.evaluation.trajectory": "align_trajectory ate relation_errors rpe",
        "jaxslam.mapping.map_consistency": "MapConsistency check_map",
        "jaxslam.mapping.map_warnings": "MapWarning",
    },
)
