"""EKF-SLAM with junctions, corners and wall directions as landmarks; see README.md here."""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.filtering.adaptation import AdaptationSpec as AdaptationSpec
    from jaxslam.filtering.belief import Belief as Belief
    from jaxslam.filtering.belief import add_known_landmarks as add_known_landmarks
    from jaxslam.filtering.belief import grow_belief as grow_belief
    from jaxslam.filtering.config import FilterConfig as FilterConfig
    from jaxslam.filtering.config import check_config as check_config
    from jaxslam.filtering.config import confirmed as confirmed
    from jaxslam.filtering.config import init as init
    from jaxslam.filtering.config import with_options as with_options
    from jaxslam.filtering.covariance import DeferredCovariance as DeferredCovariance
    from jaxslam.filtering.covariance import defer as defer
    from jaxslam.filtering.covariance import flush as flush
    from jaxslam.filtering.data_association import AssociationSpec as AssociationSpec
    from jaxslam.filtering.ekf import LINEARISATIONS as LINEARISATIONS
    from jaxslam.filtering.heteroscedastic import MeasurementWeights as MeasurementWeights
    from jaxslam.filtering.heteroscedastic import OdometryWeights as OdometryWeights
    from jaxslam.filtering.inputs import check_params as check_params
    from jaxslam.filtering.noise import NoiseParams as NoiseParams
    from jaxslam.filtering.noise_model import NoiseModel as NoiseModel
    from jaxslam.filtering.slam_filter import StepInfo as StepInfo
    from jaxslam.filtering.slam_filter import run_filter as run_filter
    from jaxslam.filtering.slam_filter import step as step

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.filtering.adaptation": "AdaptationSpec",
        "jaxslam.filtering.belief": "Belief add_known_landmarks grow_belief",
        "jaxslam.filtering.config": "FilterConfig check_config confirmed init with_options",
        "jaxslam.filtering.covariance": "DeferredCovariance defer flush",
        "jaxslam.filtering.data_association": "AssociationSpec",
        "jaxslam.filtering.ekf": "LINEARISATIONS",
        "jaxslam.filtering.heteroscedastic": "MeasurementWeights OdometryWeights",
        "jaxslam.filtering.inputs": "check_params",
        "jaxslam.filtering.noise": "NoiseParams",
        "jaxslam.filtering.noise_model": "NoiseModel",
        "jaxslam.filtering.slam_filter": "StepInfo run_filter step",
    },
)
