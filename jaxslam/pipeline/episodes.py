"""Episodes from recorded logs, and the filter over one episode or many."""

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.batching import map_batches
from jaxslam.core.devices import DeviceMap
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.features import Features
from jaxslam.core.logs import LandmarkLog, LaserLog
from jaxslam.core.scan import Scan
from jaxslam.core.se2 import dead_reckoning
from jaxslam.core.se2_np import relative
from jaxslam.core.time_series import match_times
from jaxslam.core.types import JUNCTION, Array
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import FilterConfig, confirmed, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.frontend.features import features_from_range_bearing
from jaxslam.frontend.lidar import to_scan
from jaxslam.pipeline import online
from jaxslam.pipeline.config import Config

EPISODE_BATCH = 4  # trials that a device filters together


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


def filter_episode(config: Config, params: NoiseParams, episode: Episode) -> TrialResult:
    """Run the filter on one drive, from its true start."""
    belief, info = slam_filter.run_filter(
        config.filter, params, init(config.filter, episode.truth[0]), measurements_of(episode)
    )
    return TrialResult(
        truth=episode.truth,
        estimate=info.pose,
        cov=info.pose_cov,
        dead_reckoning=dead_reckoning(episode.truth[0], episode.odometry),
        num_updates=jnp.sum(info.used, axis=1, dtype=jnp.int32),
        num_landmarks=jnp.sum(confirmed(config.filter, belief), dtype=jnp.int32),
        finite=jnp.all(info.finite),
        truth_mask=jnp.ones(len(episode.truth), bool)
        if episode.truth_mask is None
        else episode.truth_mask,
        num_steps=jnp.int32(len(episode.truth)) if episode.num_steps is None else episode.num_steps,
    )


@partial(jax.jit, static_argnames="config")
def filter_episodes(config: Config, params: NoiseParams, episodes: Episode) -> TrialResult:
    """Run the filter on B drives with the same noise; RUNS at a time, which fits the cache."""
    return map_batches(partial(filter_episode, config, params), episodes, batch_size=EPISODE_BATCH)


def concatenate_results(parts: Iterable[TrialResult]) -> TrialResult:
    """Join groups of trials, as `run_trials` yields them."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


MIN_MAX_LANDMARKS = 384, 1024  # capacity for landmarks with a laser scanner: least and most
METRES_PER_LANDMARK = 2.5  # [m] driven per landmark, for the capacity in between
LOG_CONFIRM_COUNT = (
    3  # observations: clutter in real buildings is taken for a landmark once or twice
)
RANGE_STD_FRACTION = 0.01  # standard deviation of a feature's own covariance per range; `NoiseParams.feature_std_scale` times it


def _features(config: Config, _: tuple, scan: Scan) -> Features:
    return extract.extract_features(config.frontend, scan)


_SPREAD_FEATURES = DeviceMap(_features, size=extract.SCAN_BATCH, static=1)


def extract_all(config: Config, scans: Scan) -> Features:
    """Extract the features [T] of scans [T], on all devices; NumPy arrays."""
    return _SPREAD_FEATURES(config, (), scans)


def laser_log_config(logs: Sequence[LaserLog]) -> Config:
    """Default configuration for recordings by the same laser scanner.

    The capacity for landmarks is one per `METRES_PER_LANDMARK` metres of the longest trajectory, rounded up to
    a multiple of 128, within `MIN_MAX_LANDMARKS`.
    """
    lengths = [
        np.hypot(*np.diff(recording.odom_poses[:, :2], axis=0).T).sum() for recording in logs
    ]
    least, most = MIN_MAX_LANDMARKS
    capacity = 128 * math.ceil(max(lengths) / METRES_PER_LANDMARK / 128)
    lidar = logs[0].lidar
    return Config.for_lidar(
        lidar,
        filter=FilterConfig(
            max_landmarks=min(max(capacity, least), most),
            confirm_count=LOG_CONFIRM_COUNT,
        ),
    )


def episode_from_laser_log(
    config: Config,
    laser_log: LaserLog,
    reference: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    match_scans: bool = False,
) -> Episode:
    """Convert laser scans with odometry, from the first scan or the first that has a reference.

    Args:
        laser_log: T scans with odometry.
        config: Of the front end.
        reference: Times (N,) [s] on the recording's clock, and true poses (N, 3).
        match_scans: Whether to add odometry increments by scan matching (`Config.scan_matching`).

    Raises:
        ValueError: No scan is at a time of the reference.
    """
    odometry = np.asarray(laser_log.odom_poses, np.float64)
    truth, truth_mask, begin = np.zeros_like(odometry), np.zeros(len(odometry), bool), 0
    if reference is not None:
        times, poses = reference
        i, j = match_times(laser_log.times, times).T
        if not i.size:
            raise ValueError("the reference has no pose at the time of a scan")
        truth[i], truth_mask[i], begin = poses[j], True, int(i.min())
    increments = odometry_increments(odometry[begin:])
    scans = to_scan(config.frontend.lidar, jnp.asarray(laser_log.ranges[begin:], float))
    matched = online.match_log(config, scans, increments) if match_scans else None
    log = Episode(
        truth=truth[begin:],
        odometry=increments,
        features=extract_all(config, scans),
        truth_mask=truth_mask[begin:],
        scan_matches=matched,
    )
    return to_numpy_precision(log)


def odometry_increments(poses: np.ndarray) -> np.ndarray:
    """Increments (T, 3) to each of poses (T, 3) from the one before, zero at the first."""
    return np.concatenate([np.zeros((1, 3)), relative(poses[:-1], poses[1:])])


def episode_from_landmark_log(landmark_log: LandmarkLog) -> Episode:
    """Convert landmark measurements with known identities.

    The filter starts at the first reference pose, else at zero. A measurement of range r gets the
    covariance of a point along the beam with the standard deviation `RANGE_STD_FRACTION` r. So `NoiseParams.feature_std_scale`
    counts percents of the range, in addition to `NoiseParams.range_std` and `NoiseParams.bearing_std`.
    """
    polar, valid = jnp.asarray(landmark_log.range_bearing, float), jnp.asarray(landmark_log.valid)
    features = jax.vmap(features_from_range_bearing, in_axes=(0, 0, None))(
        polar, valid, RANGE_STD_FRACTION
    )
    log = Episode(
        truth=landmark_log.truth,
        odometry=landmark_log.odometry,
        features=features,
        landmark_ids=np.asarray(landmark_log.landmark_index, np.int32),
        truth_mask=landmark_log.truth_mask,
    )
    return to_numpy_precision(log)


def landmark_log_config(logs: Sequence[LandmarkLog]) -> Config:
    """Default configuration for landmark measurements: capacity for all of them, in every step.

    Updates use the invariant linearisation: with few, distant landmarks corrections of the heading
    are large.
    """
    most = max(robot.valid.shape[1] for robot in logs)
    count = max(len(robot.landmark_names) for robot in logs)
    return Config(
        filter=FilterConfig(
            landmark_kinds=(JUNCTION,),
            linearisation="invariant",
            max_landmarks=count,
            max_updates=most,
            max_new=most,
        ),
    )


def stack_episodes(episodes: Sequence[Episode]) -> Episode:
    """Stack the logs of B drives; shorter ones are padded with scans without motion or features.

    Raises:
        ValueError: There are none, or some have `known` or `aligned` and others do not.
    """
    if not episodes:
        raise ValueError("no logs")
    for name in ("known", "aligned"):
        if len({getattr(log, name) is None for log in episodes}) > 1:
            raise ValueError(f"logs with and without `{name}` do not go together")
    scans = max(len(log.odometry) for log in episodes)
    features = max(log.features.valid.shape[1] for log in episodes)

    def fill(x: np.ndarray, width: int | None = None, value: float = 0) -> np.ndarray:
        """Pad the scans of an array and, if a width is given, the features of each scan."""
        ends = [(0, scans - len(x))]
        ends += [] if width is None else [(0, width - x.shape[1])]
        ends += [(0, 0)] * (x.ndim - len(ends))
        return np.pad(x, ends, constant_values=value)

    padded = [
        Episode(
            truth=fill(log.truth),
            odometry=fill(log.odometry),
            features=jax.tree.map(lambda x: fill(np.asarray(x), features), log.features),
            landmark_ids=None if log.landmark_ids is None else fill(log.landmark_ids, features, -1),
            truth_mask=fill(
                np.ones(len(log.truth), bool) if log.truth_mask is None else log.truth_mask
            ),
            num_steps=np.int32(len(log.truth)),
            scan_matches=jax.tree.map(lambda x: fill(np.asarray(x)), log.scan_matches),
        )
        for log in episodes
    ]
    return jax.tree.map(lambda *x: np.stack(x), *padded)


def to_numpy_precision(episode: Episode) -> Episode:
    """The log with NumPy arrays, floats in the precision of JAX (float32 unless x64 is on)."""
    precision = jnp.zeros(()).dtype

    def convert(x: np.ndarray) -> np.ndarray:
        x = np.asarray(x)
        return x.astype(precision) if x.dtype.kind == "f" else x

    return jax.tree.map(convert, episode)
