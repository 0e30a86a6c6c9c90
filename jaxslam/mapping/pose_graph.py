"""The pose graph of a filtered log: measurements with information matrices, estimates as guess.

It is what `jaxslam.io.g2o_writer` writes, for other optimisers such as g2o and GTSAM.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core import trace_cache
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import WALL, Array, as_float64, check_array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig, confirmed
from jaxslam.filtering.noise import NoiseParams, measurement_cov, motion_estimate
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.smoothing.problem import ODOMETRY_STD_FLOOR

# One program, not one for each of its operations.
_confirmed = jax.jit(confirmed, static_argnums=0)


class PoseGraph(NamedTuple):
    """Poses (T,), landmarks (L,), and the factors between them.

    Attributes:
        poses: (T, 3) [m, m, rad] estimates, map frame.
        landmark_positions: (L, 2) [m] estimates, map frame.
        odometry: (T - 1, 3) [m, m, rad] odometry from each pose to the next, in its frame.
        odometry_information: (T - 1, 3, 3) inverse covariance, in the frame of the first pose.
        pose_index: (K,) index of the pose that a landmark was observed from.
        landmark_index: (K,) index of the landmark.
        landmark_xy: (K, 2) [m] observed position, robot frame.
        landmark_information: (K, 2, 2) inverse covariance.
        closure_ends: (C, 2) indices of the two poses of a loop closure.
        closure_pose: (C, 3) [m, m, rad] the second pose in the frame of the first.
        closure_information: (C, 3, 3) inverse covariance, in the frame of the first pose.
    """

    poses: np.ndarray
    landmark_positions: np.ndarray
    odometry: np.ndarray
    odometry_information: np.ndarray
    pose_index: np.ndarray
    landmark_index: np.ndarray
    landmark_xy: np.ndarray
    landmark_information: np.ndarray
    closure_ends: np.ndarray = np.zeros((0, 2), int)
    closure_pose: np.ndarray = np.zeros((0, 3))
    closure_information: np.ndarray = np.zeros((0, 3, 3))


@partial(trace_cache.jit, static_argnames="config", compile_quickly="unoptimised")
def _noise_model(
    config: FilterConfig, params: NoiseParams, measurements: Measurement
) -> tuple[Array, Array, Array]:
    """Motions (T, 3), their covariances (T, 3, 3), and those of features (T, M, 2, 2)."""
    inflation, model = config.untrusted_inflation, config.noise_model

    def of_scan(measurement: Measurement) -> tuple[Array, Array, Array]:
        motion, q = motion_estimate(params, measurement, noise_model=model)
        r = measurement_cov(
            params,
            measurement.features,
            measurement,
            untrusted_inflation=inflation,
            noise_model=model,
        )
        return motion, q, r

    return jax.vmap(of_scan)(measurements)


def build_pose_graph(
    config: FilterConfig,
    params: NoiseParams,
    poses: ArrayLike,
    belief: Belief,
    info: StepInfo,
    measurements: Measurement,
    loop_closures: LoopClosures | None = None,
) -> PoseGraph:
    """Pose graph of a filtered log: measurements with information matrices, estimates as guess.

    Landmarks are the confirmed junctions and corners. Features are measured in polar form (range
    r, bearing b) with covariance R, and written in Cartesian form (x, y) with covariance J R J^T,

        J = d(x, y) / d(r, b) = [ x / r   -y ]
                                [ y / r    x ]

    Args:
        config: Of the filter.
        params: Noise parameters of the filter.
        poses: (T, 3) [m, m, rad] estimated poses of the scans, map frame.
        belief: Of the filter at the end.
        info: [T] of the filter.
        measurements: [T] that it was given.
        loop_closures: Loop closures, if there are any.

    Raises:
        ValueError: An argument is of another type, or their numbers of scans differ.
    """
    poses = _checked(config, poses, belief, info, measurements)
    kept = np.asarray(_confirmed(config, belief)) & (np.asarray(belief.kind) != WALL)
    landmark_ids, feature_ids = np.asarray(belief.id)[kept], np.asarray(info.id)
    scan, feature = np.nonzero(np.isin(feature_ids, landmark_ids) & (feature_ids >= 0))
    index = {landmark: k for k, landmark in enumerate(landmark_ids.tolist())}
    odometry, q, r = _noise_model(config, params, measurements)
    q = np.asarray(q, np.float64) + ODOMETRY_STD_FLOOR**2 * np.eye(3)
    r = np.asarray(r, np.float64)[scan, feature]
    xy = np.asarray(measurements.features.xy, np.float64)[scan, feature]
    by_bearing = np.stack([-xy[:, 1], xy[:, 0]], axis=-1)
    by_range = xy / np.linalg.norm(xy, axis=1, keepdims=True)
    from_polar = np.stack([by_range, by_bearing], axis=-1)
    graph = PoseGraph(
        poses=poses,
        landmark_positions=np.asarray(belief.landmark_positions, np.float64)[kept],
        odometry=np.asarray(odometry, np.float64)[1:],
        odometry_information=np.linalg.inv(q[1:]),
        pose_index=scan,
        landmark_index=np.array(
            [index[landmark] for landmark in feature_ids[scan, feature].tolist()], int
        ),
        landmark_xy=xy,
        landmark_information=np.linalg.inv(from_polar @ r @ from_polar.transpose(0, 2, 1)),
    )
    if loop_closures is None:
        return graph
    return graph._replace(
        closure_ends=np.stack([loop_closures.first, loop_closures.second], axis=1),
        closure_pose=loop_closures.relative_pose,
        closure_information=loop_closures.information,
    )


def _checked(
    config: FilterConfig,
    poses: ArrayLike,
    belief: Belief,
    info: StepInfo,
    measurements: Measurement,
) -> np.ndarray:
    """Poses (T, 3) in float64; ValueError if types or shapes do not fit."""
    for name, record, kind in (
        ("config", config, FilterConfig),
        ("belief", belief, Belief),
        ("info", info, StepInfo),
        ("measurements", measurements, Measurement),
    ):
        if not isinstance(record, kind):
            raise ValueError(f"{name} is of type {type(record).__name__}, not {kind.__name__}")
    poses = as_float64("poses", poses, ("T", 3))
    count = len(poses)
    check_array("measurements.odometry", measurements.odometry, (count, 3), jnp.floating)
    num_features = np.shape(measurements.features.valid)[-1]
    check_array("info.id", info.id, (count, num_features), jnp.integer)
    check_array("measurements.features.xy", measurements.features.xy, (count, num_features, 2))
    return poses
