"""Episodes from recorded logs and from arrays, and the filter over one episode or many."""

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core import se2_np
from jaxslam.core.batching import BatchSize, map_batches, on_device
from jaxslam.core.devices import DeviceMap
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.features import Features
from jaxslam.core.logs import LandmarkLog, LaserLog
from jaxslam.core.scan import Scan
from jaxslam.core.se2 import dead_reckoning
from jaxslam.core.time_series import match_times
from jaxslam.core.types import Array, as_float64, check_array, check_type
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig, check_config, confirmed, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.frontend import extract
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.features import features_from_range_bearing
from jaxslam.pipeline import arguments, online
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.stacking import as_episodes, numpy_episode
from jaxslam.pipeline.stacking import stack_episodes as stack_episodes
from jaxslam.pipeline.stacking import to_numpy_precision as to_numpy_precision

EPISODE_BATCH = BatchSize(cpu=4, accelerator=256)  # trials that a device filters together
MIN_MAX_LANDMARKS = 384, 1024  # capacity for landmarks with a laser scanner: least and most
METRES_PER_LANDMARK = 2.5  # [m] driven per landmark, for the capacity in between
# Standard deviation of the range of a landmark measurement, as a fraction of the range, in the
# feature's own covariance; `NoiseParams.feature_std_scale` scales it.
RANGE_STD_FRACTION = 0.01
MAX_BEARING = 2 * math.pi  # [rad] larger ones are in degrees


class TrialResult(NamedTuple):
    """Result of the filter on one drive, for evaluation.

    Attributes:
        truth: (T, 3) [m, m, rad] true pose at each scan, world frame.
        estimate: (T, 3) [m, m, rad] online estimate of it.
        cov: (T, 3, 3) covariance of the estimate.
        dead_reckoning: (T, 3) [m, m, rad] dead reckoning.
        num_updates: (T,) int32 number of features that updated the state.
        num_landmarks: () int32 number of confirmed landmarks at the end.
        finite: () bool False if an update was left out because it was not finite.
        truth_mask: (T,) bool True where `truth` is known and errors count.
        num_steps: () int32 number of scans, those after it are padding.
    """

    truth: Array
    estimate: Array
    cov: Array
    dead_reckoning: Array
    num_updates: Array
    num_landmarks: Array
    finite: Array
    truth_mask: Array
    num_steps: Array


def filter_episode(config: FilterConfig, params: NoiseParams, episode: Episode) -> TrialResult:
    """Run the filter on one drive, from its true start."""
    return filter_whole_episode(config, params, episode)[0]


def filter_whole_episode(
    config: FilterConfig, params: NoiseParams, episode: Episode
) -> tuple[TrialResult, Belief, StepInfo]:
    """`filter_episode`, with the belief at the end and the diagnostics [T]."""
    belief, info = slam_filter.run_filter(
        config, params, init(config, episode.truth[0]), measurements_of(episode)
    )
    return trial_result(config, episode, belief, info), belief, info


def filter_whole_batch(
    config: FilterConfig, params: NoiseParams, episodes: Episode
) -> tuple[TrialResult, Belief, StepInfo]:
    """`filter_batch`, not jitted, with the beliefs [B] at the end and the diagnostics [B, T]."""
    one = partial(filter_whole_episode, config, params)
    return map_batches(one, episodes, batch_size=EPISODE_BATCH)


def trial_result(
    config: FilterConfig, episode: Episode, belief: Belief, info: StepInfo
) -> TrialResult:
    """Result of the filter on one drive, from its last belief and its diagnostics [T]."""
    steps = len(episode.truth)
    mask, count = episode.truth_mask, episode.num_steps
    return TrialResult(
        truth=episode.truth,
        estimate=info.pose,
        cov=info.pose_cov,
        dead_reckoning=dead_reckoning(episode.truth[0], episode.odometry),
        num_updates=jnp.sum(info.used, axis=1, dtype=jnp.int32),
        num_landmarks=jnp.sum(confirmed(config, belief), dtype=jnp.int32),
        finite=jnp.all(info.finite),
        truth_mask=jnp.ones(steps, bool) if mask is None else mask,
        num_steps=jnp.int32(steps) if count is None else count,
    )


def filter_episodes(
    config: Config, params: NoiseParams, episodes: Episode | list[Episode]
) -> TrialResult:
    """Run the filter on B drives with the same noise, `EPISODE_BATCH` at a time.

    Args:
        config: Of the filter.
        params: Q and R of the filter.
        episodes: [B] drives, as `stack_episodes` and `simulate_episodes` make them; or a list of
            single ones, which are stacked.

    Returns:
        [B] results.

    Raises:
        ValueError: The filter's configuration is not possible; the arrays of the episodes do not
            lead with B and T; or they hold scan matches that the parameters have no noise for, or
            landmarks that the map has no slots for.
    """
    params, stacked = check_drives(config, params, episodes)
    return filter_batch(config.filter, params, stacked)


def check_drives(
    config: Config, params: NoiseParams, episodes: Episode | list[Episode]
) -> tuple[NoiseParams, Episode]:
    """Noise and stacked episodes as the filter takes them; ValueError as of `filter_episodes`."""
    check_type("config", config, Config)
    check_config(config.filter)  # the scanner does not matter here
    stacked = as_episodes(episodes)
    check_array("episodes.odometry", stacked.odometry, ("B", "T", 3), jnp.floating)
    sizes = stacked.odometry.shape[:2]
    check_array("episodes.truth", stacked.truth, (*sizes, 3), jnp.floating)
    check_array("episodes.features.kind", stacked.features.kind, (*sizes, "M"), jnp.integer)
    params = arguments.as_params(params, match_scans=stacked.scan_matches is not None)
    ids, capacity = stacked.landmark_ids, config.filter.max_landmarks
    if ids is not None:
        check_array("episodes.landmark_ids", ids, stacked.features.kind.shape, jnp.integer)
        if not isinstance(ids, jax.core.Tracer) and np.max(ids, initial=-1) >= capacity:
            raise ValueError(
                f"episodes.landmark_ids holds {np.max(ids)}, but config.filter.max_landmarks is "
                f"{capacity}: ids are 0 to max_landmarks - 1"
            )
    return params, stacked


@partial(jax.jit, static_argnames="config")
def filter_batch(config: FilterConfig, params: NoiseParams, episodes: Episode) -> TrialResult:
    """`filter_episodes` of a filter configuration, unchecked; traced for it alone."""
    return map_batches(partial(filter_episode, config, params), episodes, batch_size=EPISODE_BATCH)


def concatenate_results(parts: Iterable[TrialResult]) -> TrialResult:
    """Join groups of trials, as `run_trials` yields them."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _features(config: FrontendConfig, _: tuple, scan: Scan) -> Features:
    return extract.extract_features(config, scan)


_SPREAD_FEATURES = DeviceMap(_features, size=extract.SCAN_BATCH, static=1)


def extract_all(config: FrontendConfig, scans: Scan) -> Features:
    """Extract the features [T] of scans [T], on all devices; NumPy arrays."""
    return _SPREAD_FEATURES(config, (), scans)


def laser_log_config(logs: Sequence[LaserLog]) -> Config:
    """Default configuration to tune on recordings by the same laser scanner.

    The capacity for landmarks is one per `METRES_PER_LANDMARK` metres of the longest trajectory,
    rounded up to a multiple of 128, within `MIN_MAX_LANDMARKS`.
    """
    lengths = [np.hypot(*np.diff(log.odom_poses[:, :2], axis=0).T).sum() for log in logs]
    least, most = MIN_MAX_LANDMARKS
    capacity = 128 * math.ceil(max(lengths) / METRES_PER_LANDMARK / 128)
    return Config.for_laser_log(logs[0].lidar, max_landmarks=min(max(capacity, least), most))


def episode_from_laser_log(
    config: Config,
    laser_log: LaserLog,
    reference: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    match_scans: bool = False,
) -> Episode:
    """Convert laser scans with odometry, from the first scan or the first that has a reference.

    Args:
        config: Of the front end, and of scan matching.
        laser_log: T scans with odometry.
        reference: Times (N,) [s] on the recording's clock, and true poses (N, 3).
        match_scans: Whether to add odometry increments by scan matching.

    Raises:
        ValueError: The log is of another scanner than the configuration, an array of it has another
            shape, or no scan is at a time of the reference.
    """
    arguments.check_config(config)
    if laser_log.lidar.num_beams != config.frontend.lidar.num_beams:
        raise ValueError(
            f"laser_log has {laser_log.lidar.num_beams} beams, "
            f"config.frontend.lidar {config.frontend.lidar.num_beams}"
        )
    odometry = as_float64("laser_log.odom_poses", laser_log.odom_poses, ("T", 3))
    ranges = as_float64(
        "laser_log.ranges", laser_log.ranges, (len(odometry), config.frontend.lidar.num_beams)
    )
    truth, truth_mask, begin = np.zeros_like(odometry), np.zeros(len(odometry), bool), 0
    if reference is not None:
        times = as_float64("reference[0]", reference[0], ("N",))
        poses = as_float64("reference[1]", reference[1], (len(times), 3))
        i, j = match_times(np.asarray(laser_log.times), times).T
        if not i.size:
            raise ValueError("the reference has no pose at the time of a scan")
        truth[i], truth_mask[i], begin = poses[j], True, int(i.min())
    increments = se2_np.increments(odometry[begin:])
    scans = arguments.scans_of_log(config.frontend.lidar, on_device(ranges[begin:]))
    guessed = laser_log.odometry_guessed
    guessed = None if guessed is None else guessed[begin:]
    matched = (
        online.match_log(config, increments, scans, odometry_guessed=guessed)
        if match_scans
        else None
    )
    return numpy_episode(
        truth[begin:],
        increments,
        extract_all(config.frontend, scans),
        truth_mask=truth_mask[begin:],
        scan_matches=matched,
    )


def episode_from_landmark_log(landmark_log: LandmarkLog) -> Episode:
    """Convert landmark measurements with known identities.

    The filter starts at the first reference pose, else at zero. A measurement of range r gets the
    covariance of a point along the beam with the standard deviation `RANGE_STD_FRACTION` r. So
    `NoiseParams.feature_std_scale` counts percents of the range, in addition to
    `NoiseParams.range_std` and `NoiseParams.bearing_std`.
    """
    return _landmark_episode(
        landmark_log.odometry,
        landmark_log.range_bearing,
        landmark_log.valid,
        landmark_log.landmark_index,
        landmark_log.truth,
        landmark_log.truth_mask,
    )


def episode_from_arrays(
    odometry: Any, range_bearing: Any, landmark_ids: Any, truth: Any = None
) -> Episode:
    """Episode of a sensor that measures range and bearing of landmarks that it identifies.

    `Config.for_landmark_sensor` and `NoiseParams.for_landmark_sensor` go with it. The noise model
    is that of `episode_from_landmark_log`.

    Args:
        odometry: (T, 3) [m, m, rad] increments: the motion since the step before, in the frame of
            the pose before, zero at the first; `core.se2_np.increments` makes them from poses.
        range_bearing: (T, M, 2) range [m] and bearing [rad] of up to M landmarks a step.
        landmark_ids: (T, M) integers 0 to L - 1, the landmark of each; -1 for no measurement.
        truth: (T, 3) [m, m, rad] true poses, world frame, NaN in the rows of unknown ones. The
            filter starts at the first, which must be known. None if there are none: the filter
            starts at zero.

    Raises:
        ValueError: An argument has another shape or kind, or is out of range; or the odometry holds
            poses.
    """
    increments = arguments.as_log_odometry(odometry)
    steps = len(increments)
    polar = as_float64("range_bearing", range_bearing, (steps, "M", 2))
    ids = np.asarray(landmark_ids)
    check_array("landmark_ids", ids, polar.shape[:2], jnp.integer)
    if np.min(ids, initial=-1) < -1:
        raise ValueError(f"landmark_ids holds {ids.min()}, not an index or -1")
    valid = ids >= 0
    measured = polar[valid]
    if not (np.isfinite(measured).all() and np.all(measured[:, 0] > 0.0)):
        raise ValueError("range_bearing holds a range that is not above zero, or is not finite")
    if np.max(np.abs(measured[:, 1]), initial=0.0) > MAX_BEARING:
        raise ValueError("range_bearing holds a bearing of more than a turn; it is in radians")
    has_truth = np.zeros(steps, bool)
    poses = np.zeros((steps, 3)) if truth is None else as_float64("truth", truth, (steps, 3))
    if truth is not None:
        has_truth[:] = np.isfinite(poses).all(axis=1)
        if not has_truth[0]:
            raise ValueError("truth[0] is not finite; the filter starts at the first true pose")
    polar = np.where(valid[..., None], polar, 0.0)
    poses = np.where(has_truth[:, None], poses, 0.0)
    return _landmark_episode(increments, polar, valid, ids, poses, has_truth)


def _landmark_episode(
    odometry: np.ndarray,
    range_bearing: np.ndarray,
    valid: np.ndarray,
    landmark_ids: np.ndarray,
    truth: np.ndarray,
    truth_mask: np.ndarray,
) -> Episode:
    """Episode of landmark measurements, of arrays that fit each other."""
    features = jax.vmap(features_from_range_bearing, in_axes=(0, 0, None))(
        jnp.asarray(range_bearing, float), jnp.asarray(valid), RANGE_STD_FRACTION
    )
    return numpy_episode(
        truth,
        odometry,
        features,
        landmark_ids=np.asarray(landmark_ids, np.int32),
        truth_mask=truth_mask,
    )


def landmark_log_config(logs: Sequence[LandmarkLog]) -> Config:
    """Default configuration for landmark measurements: capacity for all of them, in every step."""
    return Config.for_landmark_sensor(
        max(len(log.landmark_names) for log in logs), max(log.valid.shape[1] for log in logs)
    )
