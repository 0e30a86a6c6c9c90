"""SLAM on a whole log: chunks of keyframes, then batch smoothing with loop closures."""

from collections.abc import Callable
from contextlib import closing
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core import trace_cache
from jaxslam.core.batching import pad_to
from jaxslam.core.features import Features
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.scan import Scan
from jaxslam.core.types import Array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.matching import loop_closure
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.pipeline import arguments, keyframes, odometry_notes, online, stages
from jaxslam.pipeline.chunks import ChunkResult
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.online import SlamState
from jaxslam.smoothing import numbering, sparse
from jaxslam.smoothing import problem as smoothing_problem
from jaxslam.smoothing.problem import SmoothingProblem, SmoothingResult

# Searches for loop closures at most, each from the trajectory smoothed before it.
MAX_CLOSURE_ROUNDS = 2
CLOSURE_CONVERGED = 0.3  # [m] the search ends when no pose has moved further than this
# Numbers of scans and landmarks are padded to multiples of this to be smoothed.
PADDING_MULTIPLE = 512

_build_problem = trace_cache.jit(
    smoothing_problem.build_problem, static_argnames="untrusted_inflation"
)


class SlamResult(NamedTuple):
    """Result of SLAM on a log of T scans, K of which are keyframes.

    Attributes:
        poses: (T, 3) float64 [m, m, rad] estimated trajectory, map frame: filtered, or smoothed.
        online_poses: (T, 3) float64 [m, m, rad] estimates at the time: those of the filter, and
            between keyframes the matched motion since.
        keyframes: (K,) int numbers of the keyframes, which the filter was given; the first and the
            last scan are among them. All scans where `config.keyframe_distance` is None.
        belief: Of the filter after the last scan; if smoothed, with the smoothed last pose and
            landmark positions, and still the covariance of the filter.
        info: [K] diagnostics of the filter, with its estimates at the time.
        features: [K] features.
        topological_map: Topological map.
        scan_matches: [K] increments by scan matching since the keyframe before, where scans were
            matched.
        loop_closures: Loop closures that the trajectory was smoothed with, where there were any;
            they are between keyframes, by their index 0 .. K - 1.
        odometry: (K, 3) [m, m, rad] increments since the keyframe before that the filter was given:
            repaired, or zero where odometry is not used.
        notes: What was wrong with the odometry, to be printed.
        arcs: Arcs that the topological map is made of, as observed; to go on from.
    """

    poses: np.ndarray
    online_poses: np.ndarray
    keyframes: np.ndarray
    belief: Belief
    info: StepInfo
    features: Features
    topological_map: TopologicalMap
    scan_matches: ScanMatch | None = None
    loop_closures: LoopClosures | None = None
    odometry: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    arcs: ArcTable | None = None


def run_slam(
    config: Config,
    params: NoiseParams,
    odometry: Any,
    ranges: Any,
    *,
    start: Any = None,
    odometry_guessed: Any = None,
    match_scans: bool = True,
    smooth: bool = True,
    callback: Callable[[SlamState, ChunkResult], Any] | None = None,
) -> SlamResult:
    """Run SLAM on a whole log.

    Every scan is matched, in order; front end, filter and smoother work on keyframes, which are
    chosen by the matched motion (`config.keyframe_distance`), and the poses of the scans between
    them follow from their own matched motion (`keyframes`). Every scan is a keyframe without scan
    matching, and where by the odometry more than half of them would be.

    The filter estimates each pose from the measurements up to it. With `smooth`, all poses and
    landmarks are estimated from all measurements (`sparse.smooth_log`), and where scans are
    matched, loops are closed by matching scans of later visits with those of earlier ones
    (`loop_closure.find_loop_closures`).

    Args:
        config: For the scanner, as `Config.for_laser_log` makes it; `config.filter.max_landmarks`
            is the largest size of the map.
        params: Q and R of the filter, as `NoiseParams.for_laser_log(match_scans=True)`.
        odometry: (T, 3) [m, m, rad] increments: the motion since the scan before, in the frame of
            the pose before, zero at the first; `core.se2_np.increments` makes them from poses.
        ranges: (T, R) raw ranges [m] of the scanner's R beams; NaN, infinite, not above zero or not
            below `range_max` is no return. Or a `Scan` [T].
        start: (3,) [m, m, rad] first pose, map frame; zero by default.
        odometry_guessed: (T,) bool, which increments of the odometry are guesses of whoever read
            the log, not what the wheels said (`LaserLog.odometry_guessed`); none by default.
        match_scans: Whether scans are matched, and the increments fused with the odometry.
        smooth: Whether the trajectory is smoothed at the end.
        callback: Called after each chunk of keyframes with the state and the result of the chunk;
            the submap of the state may already hold later scans.

    Raises:
        ValueError: An argument has another shape, or does not fit the others; the odometry holds
            poses; or scans are matched and `params.scan_match_std_scale` is None.
    """
    arguments.check_config(config)
    params = arguments.as_params(params, match_scans=match_scans)
    increments = arguments.as_log_odometry(odometry)
    # NumPy, as each slice of a JAX array would be compiled.
    scans = arguments.as_scans(config.frontend.lidar, ranges, len(increments))
    pose = arguments.as_start(start)
    notes: tuple[str, ...] = ()
    guessed = arguments.as_guessed(odometry_guessed, len(increments))
    if match_scans and config.scan_matching.use_odometry:
        increments, is_share, notes = odometry_notes.share_out(increments, scans)
        guessed |= is_share
    elif match_scans:
        increments = np.zeros_like(increments)
    distance = keyframes.distance_for_log(config.keyframe_distance, increments)
    config = config._replace(keyframe_distance=distance)
    state, parts = online.init(config, pose, match_scans=match_scans), []
    log = stages.keyframe_chunks(config, state.submap, increments, scans, guessed)
    odometry_parts, matched_parts = [], []
    with closing(log):  # whatever happens, no scans are matched any more after it
        following = next(log, None)
        while following is not None:
            now, following = following, next(log, None)  # in the background of the filter
            state, part = online.advance(config, params, state, now.chunk)
            odometry_parts.append(now.odometry)
            matched_parts.append(now.matched)
            parts.append(part._replace(keyframes=now.keyframes))
            if callback is not None:
                callback(state, parts[-1])
    info, features, matches, numbers = stages.concatenate(parts)
    keyframe_odometry, matched = np.concatenate(odometry_parts), stages.concatenate(matched_parts)
    motion = keyframes.motion_since_keyframe(matched.increments, matched.is_keyframe)
    keyframe_poses, closures = np.asarray(info.pose, np.float64), None
    online_poses = keyframes.poses_since_keyframes(keyframe_poses, matched.is_keyframe, motion)
    poses = online_poses
    if smooth:
        own: Any = keyframe_odometry.astype(info.pose.dtype)  # NumPy, like the rest
        keyframe_poses, belief, closures = smooth_result(
            config,
            params,
            pose,
            Measurement(own, features, scan_match=matches),
            info,
            state.belief,
            jax.tree.map(lambda x: x[numbers], scans) if match_scans else None,
        )
        state = state._replace(belief=belief)
        poses = keyframes.interpolate_poses(
            keyframe_poses, matched.is_keyframe, motion, matched.increments
        )
    topological_map = online.topological_map(config, state, keyframe_poses)
    if matched.matches is not None and config.scan_matching.use_odometry:
        notes += odometry_notes.contradictions(matched.matches)
        notes += odometry_notes.unsigned(matched.matches, matched.odometry)
        notes += odometry_notes.wrong_scale(matched.matches, matched.odometry)
    return SlamResult(
        poses,
        online_poses,
        numbers,
        state.belief,
        info,
        features,
        topological_map,
        matches,
        closures,
        keyframe_odometry,
        notes,
        state.arcs,
    )


def smooth_result(
    config: Config,
    params: NoiseParams,
    start: Array,
    measurements: Measurement,
    info: StepInfo,
    belief: Belief,
    scans: Scan | None = None,
) -> tuple[np.ndarray, Belief, LoopClosures | None]:
    """Smooth a filtered trajectory by all its measurements.

        smooth with the filter's data association
        up to `MAX_CLOSURE_ROUNDS` times:
            find loop closures from the smoothed trajectory, smooth again with them
            stop if no pose has moved by `CLOSURE_CONVERGED` or more

    Args:
        config: Of the filter, of scan matching and of loop closures.
        params: Q and R of the filter.
        start: (3,) [m, m, rad] first pose, map frame.
        measurements: [T] measurements of the filter, NumPy.
        info: [T] its diagnostics, NumPy.
        belief: After the last scan.
        scans: [T] to find loop closures with, NumPy; None for none but the filter's own.

    Returns:
        Poses (T, 3) float64; the belief with the smoothed last pose and landmark positions, and the
        covariance of the filter; and the loop closures, None without scans.

    Raises:
        ValueError: There are scans, and `params.scan_match_std_scale` is None.
    """
    params = arguments.as_params(params, match_scans=scans is not None)
    steps = len(info.pose)
    capacity = _padded(int(np.count_nonzero(np.unique(info.id) >= 0)))
    numbered = numbering.number_landmarks(
        info.id, info.pose, measurements.features, capacity=capacity
    )
    problem, guess = _padded_problem(
        config.filter.untrusted_inflation,
        params,
        start,
        measurements,
        numbered.landmark_index,
        np.asarray(info.pose),
    )
    smoothed = sparse.smooth_log(problem, guess, numbered.positions)
    closures = None
    std_scale = params.scan_match_std_scale
    if scans is not None and std_scale is not None:
        smoothed, closures = _close_loops(
            config, problem, smoothed, scans, num_scans=steps, std_scale=float(std_scale)
        )
    poses, positions = map(np.asarray, (smoothed.poses[:steps], smoothed.landmark_positions))
    positions = _positions_of(belief, np.asarray(numbered.id), positions)
    mean = np.concatenate([poses[-1], positions.ravel()])
    return poses, belief._replace(mean=jnp.asarray(mean, belief.mean.dtype)), closures


def _close_loops(
    config: Config,
    problem: SmoothingProblem,
    smoothed: SmoothingResult,
    scans: Scan,
    *,
    num_scans: int,
    std_scale: float,
) -> tuple[SmoothingResult, LoopClosures]:
    """Smooth with loop closures that are found from the smoothed trajectory, until it is at rest.

    Args:
        config: Of scan matching and of loop closures.
        problem: Padded.
        smoothed: Without loop closures.
        scans: [T].
        num_scans: T.
        std_scale: Factor on the standard deviation of scan matching.
    """
    for _ in range(MAX_CLOSURE_ROUNDS):
        before = smoothed
        closures = loop_closure.find_loop_closures(
            config.loop_closure,
            config.scan_matching,
            config.frontend.lidar,
            before.poses[:num_scans],
            scans,
            std_scale=std_scale,
        )
        smoothed = sparse.smooth_log(
            problem, before.poses, before.landmark_positions, loop_closures=closures
        )
        if np.max(np.abs(smoothed.poses - before.poses)[:, :2]) < CLOSURE_CONVERGED:
            break
    return smoothed, closures


def _padded(count: int) -> int:
    """The next larger multiple of `PADDING_MULTIPLE`."""
    return (count // PADDING_MULTIPLE + 1) * PADDING_MULTIPLE


def _padded_problem(
    untrusted_inflation: float,
    params: NoiseParams,
    start: Array,
    measurements: Measurement,
    landmark_index: Array,
    poses: np.ndarray,
) -> tuple[SmoothingProblem, np.ndarray]:
    """Smoothing problem and guess (P, 3), padded by steps without motion and measurements.

    Args:
        untrusted_inflation: Of the filter's configuration.
        params: Q and R of the filter.
        start: (3,) first pose.
        measurements: [T].
        landmark_index: (T, M) landmark of each feature.
        poses: (T, 3) guess.
    """
    steps = len(poses)
    given = measurements, np.asarray(landmark_index), poses
    measurements, index, guess = pad_to(given, to=_padded(steps))
    index[steps:] = -1
    measurements.odometry[steps:] = 0.0
    if measurements.scan_match is not None:
        measurements.scan_match.increment[steps:] = 0.0
    problem = _build_problem(
        params, start, measurements, index, untrusted_inflation=untrusted_inflation
    )
    return problem, guess


def _positions_of(belief: Belief, ids: np.ndarray, smoothed_positions: np.ndarray) -> np.ndarray:
    """Positions (L, 2) of the slots of a belief: smoothed where the landmark was, else as they are.

    Args:
        belief: The belief.
        ids: (S,) ids of the smoothed landmarks, ascending; then at least one -1, the padding.
        smoothed_positions: (S, 2).
    """
    ids = np.where(ids < 0, np.iinfo(ids.dtype).max, ids)  # sorts last, and is no landmark's id
    index = np.searchsorted(ids, belief.id)
    is_smoothed = (np.asarray(belief.num_seen) > 0) & (ids[index] == np.asarray(belief.id))
    return np.where(is_smoothed[:, None], smoothed_positions[index], belief.landmark_positions)
