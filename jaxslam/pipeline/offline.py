"""SLAM on a whole log: chunks of scans, then batch smoothing with loop closures."""

from collections.abc import Callable
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
from jaxslam.matching import loop_closure
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.pipeline import online
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.online import (
    CHUNK,
    ChunkResult,
    SlamState,
    _chunk_at,
    _filter,
    _front_end,
    init,
)
from jaxslam.smoothing import numbering, problem, sparse
from jaxslam.smoothing.problem import SmoothingProblem

MAX_CLOSURE_ROUNDS = (
    2  # searches for loop closures at most, each from the trajectory smoothed before it;
)
CLOSURE_CONVERGED = 0.3  # [m] the search ends when no pose has moved further than this
PADDING_MULTIPLE = (
    512  # numbers of scans and landmarks are padded to multiples of this to be smoothed
)


class SlamResult(NamedTuple):
    """Result of SLAM on a log of T scans.

    Attributes:
        poses: (T, 3) float64 [m, m, rad] estimated trajectory, map frame: filtered, or smoothed.
        belief: Of the filter after the last scan; if smoothed, with the smoothed last pose and
            landmark positions, and still the covariance of the filter.
        info: [T] diagnostics of the filter, with its estimates at the time.
        features: [T] features.
        topological_map: Topological map.
        scan_matches: [T] motions by scan matching, where scans were matched.
        loop_closures: Loop closures that the trajectory was smoothed with, where there were any.
    """

    poses: np.ndarray
    belief: Belief
    info: StepInfo
    features: Features
    topological_map: TopologicalMap
    scan_matches: ScanMatch | None = None
    loop_closures: LoopClosures | None = None


def run_slam(
    config: Config,
    params: NoiseParams,
    pose: Array,
    odometry: Array,
    scans: Scan,
    *,
    match_scans: bool = False,
    smooth: bool = False,
    callback: Callable[[SlamState, ChunkResult], Any] | None = None,
) -> SlamResult:
    """Run SLAM on a whole log.

    The filter estimates each pose from the measurements up to it. With `smooth`, all poses and
    landmarks are estimated from all measurements (`sparse.smooth_log`), and where scans are matched,
    loops are closed by matching scans of later visits with those of earlier ones (`loop_closure.find_loop_closures`).

    Args:
        config: Of front end and filter; `landmarks` is the largest number of landmarks of the map.
        params: Noise parameters of the filter.
        pose: (3,) [m, m, rad] first pose, map frame.
        odometry: (T, 3) [m, m, rad] odometry since the scan before, zero at the first.
        scans: [T].
        match_scans: Whether scans are to be matched, and the motions fused with the odometry.
        smooth: Whether the trajectory is to be smoothed at the end.
        callback: Callback, called after each chunk with the state and the result of the chunk.

    Raises:
        ValueError: There is no scan; or scans are to be matched and `params.alignment` is None.
    """
    # NumPy, as each slice of a JAX array would be compiled.
    odometry, scans = np.asarray(odometry), jax.tree.map(np.asarray, scans)
    mapper, parts = init(config, pose, match_scans=match_scans), []
    following = _front_end(config, mapper.submap, *_chunk_at(0, odometry, scans))
    for first in range(0, len(odometry), CHUNK):
        chunk, after = following, first + CHUNK
        if after < len(odometry):  # in the background while the filter works on this chunk
            following = _front_end(config, chunk.local, *_chunk_at(after, odometry, scans))
        mapper, part = _filter(config, params, mapper, chunk)
        parts.append(part)
        if callback is not None:
            callback(mapper, part)
    info, features, matched = jax.tree.map(lambda *chunks: np.concatenate(chunks), *parts)
    poses, found = np.asarray(info.pose, np.float64), None
    if smooth:
        inputs = Measurement(odometry.astype(info.pose.dtype), features, scan_match=matched)
        to_close = scans if match_scans else None
        poses, belief, found = smooth_result(
            config, params, pose, inputs, info, mapper.belief, to_close
        )
        mapper = mapper._replace(belief=belief)
    topological_map = online.topological_map(config, mapper, poses)
    return SlamResult(poses, mapper.belief, info, features, topological_map, matched, found)


_build_problem = trace_cache.jit(problem.build_problem, static_argnames="untrusted_inflation")


def smooth_result(
    config: Config,
    params: NoiseParams,
    pose: Array,
    measurements: Measurement,
    info: StepInfo,
    belief: Belief,
    scans: Scan | None = None,
) -> tuple[np.ndarray, Belief, LoopClosures | None]:
    """Smooth a filtered trajectory by all its measurements.

        smooth with the filter's data association
        up to ROUNDS times:
            find loop closures from the smoothed trajectory, smooth again with them
            stop if no pose has moved by STILL or more

    Args:
        config: Of the filter.
        params: Noise parameters of the filter.
        pose: (3,) [m, m, rad] first pose, map frame.
        measurements: [T] measurements of the filter, NumPy.
        info: [T] its diagnostics, NumPy.
        belief: After the last scan.
        scans: [T] to find loop closures with, NumPy; None for none but the filter's own.

    Returns:
        Poses (T, 3) float64; the belief with the smoothed last pose and landmark positions, and the
        covariance of the filter; and the loop closures, None without scans.

    Raises:
        ValueError: There are scans, and `params.alignment` is None.
    """
    if scans is not None and params.scan_match_std_scale is None:
        raise ValueError("noise.alignment is None, and there are scans to close loops with")
    steps = len(info.pose)
    capacity = _padded(np.count_nonzero(np.unique(info.id) >= 0))
    found = numbering.number_landmarks(info.id, info.pose, measurements.features, capacity=capacity)
    records, guess = _padded_records(
        config, params, pose, measurements, found.landmark_index, info.pose
    )
    track, closed = sparse.smooth_log(records, guess, found.positions), None
    for _ in range(0 if scans is None else MAX_CLOSURE_ROUNDS):
        before = track.poses
        closed = loop_closure.find_loop_closures(
            config.loop_closure,
            config.scan_matching,
            config.frontend.lidar,
            before[:steps],
            scans,
            std_scale=float(params.scan_match_std_scale),
        )
        track = sparse.smooth_log(records, before, track.landmark_positions, loop_closures=closed)
        if np.max(np.abs(track.poses - before)[:, :2]) < CLOSURE_CONVERGED:
            break
    poses = track.poses[:steps]
    positions = _positions_of(belief, np.asarray(found.id), track.landmark_positions)
    mean = np.concatenate([poses[-1], positions.ravel()])
    return poses, belief._replace(mean=jnp.asarray(mean, belief.mean.dtype)), closed


def _padded(count: int) -> int:
    """The next larger multiple of `PADDING_MULTIPLE`."""
    return (count // PADDING_MULTIPLE + 1) * PADDING_MULTIPLE


def _padded_records(
    config: Config,
    noise: NoiseParams,
    start: Array,
    inputs: Measurement,
    which: Array,
    guess: np.ndarray,
) -> tuple[SmoothingProblem, np.ndarray]:
    """Smoothing problem and guess (P, 3), padded by steps without motion and measurements.

    Args:
        config: Of the filter.
        noise: Noise parameters of the filter.
        start: (3,) first pose.
        inputs: [T].
        which: (T, M) landmark of each feature.
        guess: (T, 3) poses.
    """
    steps = len(guess)
    inputs, which, guess = pad_to((inputs, np.asarray(which), guess), to=_padded(steps))
    which[steps:] = -1
    inputs.odometry[steps:] = 0.0
    if inputs.scan_match is not None:
        inputs.scan_match.increment[steps:] = 0.0
    return _build_problem(
        noise, start, inputs, which, doubt=config.filter.untrusted_inflation
    ), guess


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
