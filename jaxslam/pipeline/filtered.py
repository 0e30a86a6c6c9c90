"""Keyframes given to the filter, and what becomes of them: trajectory, landmarks, map."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import trajectories_as_one
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.matching.map_places import ScanMap
from jaxslam.pipeline import keyframes, odometry_notes, online, self_check, sessions, stages
from jaxslam.pipeline.chunks import ChunkResult
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.online import SlamState
from jaxslam.pipeline.results import SlamResult, piece_of, spread
from jaxslam.pipeline.smoothing_stage import smooth_result
from jaxslam.pipeline.stages import KeyframeChunk

Callback = Callable[[SlamState, ChunkResult], Any]


class Run(NamedTuple):
    """What all stages of a run need: arguments of `run_slam`, checked."""

    config: Config
    params: NoiseParams
    scans: Scan
    match_scans: bool
    smooth: bool
    callback: Callback | None


class Filtered(NamedTuple):
    """Keyframes that the filter was given.

    Attributes:
        start: (3,) [m, m, rad] first pose.
        state: After them.
        saved: The map that they go on in, if there is one.
        chunks: The keyframes.
        results: Of the filter; their scan matches are what the smoother is given.
        motion: (K, 3) [m, m, rad] that the filter was given, where this is not what was matched.
        notes: How they were put together.
    """

    start: Any
    state: SlamState
    saved: SavedMap | None = None
    chunks: tuple[KeyframeChunk, ...] = ()
    results: tuple[ChunkResult, ...] = ()
    motion: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def nothing_filtered(run: Run, start: Any, saved: SavedMap | None = None) -> Filtered:
    """No keyframes yet, in a map of their own or in a saved one."""
    if saved is None:
        return Filtered(start, online.init(run.config, start))
    return Filtered(start, sessions.resume(run.config, saved), saved)


def filter_chunks(run: Run, filtered: Filtered, chunks: Sequence[KeyframeChunk]) -> Filtered:
    """Give chunks of keyframes to the filter."""
    for now in chunks:
        state, result = online.advance(run.config, run.params, filtered.state, now.chunk)
        result = result._replace(keyframes=now.keyframes)
        if run.callback is not None:
            run.callback(state, result)
        filtered = filtered._replace(
            state=state, chunks=(*filtered.chunks, now), results=(*filtered.results, result)
        )
    return filtered


def filter_along(
    run: Run, filtered: Filtered, chunks: Sequence[KeyframeChunk], motion: np.ndarray
) -> Filtered:
    """Give chunks of K keyframes to the filter as if motion (K, 3) had been matched.

    The smoother is given them as they are.
    """
    before = len(filtered.results)
    ends = np.cumsum([len(chunk.keyframes) for chunk in chunks])
    given = [
        _moved(chunk, own) for chunk, own in zip(chunks, np.split(motion, ends[:-1]), strict=True)
    ]
    after = filter_chunks(run, filtered, given)
    results = [
        result._replace(scan_matches=_matches_of(chunk))
        for result, chunk in zip(after.results[before:], chunks, strict=True)
    ]
    return after._replace(chunks=(*filtered.chunks, *chunks), results=(*filtered.results, *results))


def _moved(chunk: KeyframeChunk, motion: np.ndarray) -> KeyframeChunk:
    """The chunk as if its motion (N, 3) had been matched."""
    match = chunk.chunk.measurements.scan_match
    assert match is not None and match.expected is not None
    increment = match.increment.at[: len(motion)].set(motion.astype(match.increment.dtype))
    return stages.with_scan_match(chunk, match._replace(increment=increment, expected=increment))


def _matches_of(chunk: KeyframeChunk) -> ScanMatch:
    """The scan matches [N] of a chunk, NumPy."""
    count = len(chunk.keyframes)
    return jax.tree.map(lambda x: np.asarray(x)[:count], chunk.chunk.measurements.scan_match)


def scan_map(run: Run, result: SlamResult) -> ScanMap:
    """The keyframes of a result."""
    scans = jax.tree.map(lambda x: x[result.keyframes], run.scans)
    return ScanMap(run.config.frontend.lidar, result.poses[result.keyframes], scans)


def smoother_input(run: Run, filtered: Filtered) -> tuple[Measurement, StepInfo, Scan]:
    """Measurements, diagnostics and scans [K] of keyframes, those of a saved map first; NumPy."""
    info, features, matches, numbers = stages.concatenate(list(filtered.results))
    odometry = np.concatenate([chunk.odometry for chunk in filtered.chunks])
    own: Any = odometry.astype(info.pose.dtype)  # NumPy, like the rest
    measurements = Measurement(own, features, scan_match=matches)
    scans = jax.tree.map(lambda x: x[numbers], run.scans)
    if filtered.saved is None:
        return measurements, info, scans
    return sessions.with_saved_keyframes(filtered.saved, measurements, info, scans)


def result_of(run: Run, filtered: Filtered, guess: np.ndarray | None = None) -> SlamResult:
    """The result of keyframes that were filtered, smoothed if that is asked for.

    Args:
        run: What all stages need.
        filtered: The keyframes.
        guess: (K, 3) as of `smooth_result`.
    """
    state, config, notes = filtered.state, run.config, filtered.notes
    info, features, matches, numbers = stages.concatenate(list(filtered.results))
    keyframe_odometry = np.concatenate([chunk.odometry for chunk in filtered.chunks])
    matched = stages.concatenate([chunk.matched for chunk in filtered.chunks])
    motion = keyframes.motion_since_keyframe(matched.increments, matched.is_keyframe)
    keyframe_poses, closures = np.asarray(info.pose, np.float64), None
    online_poses = keyframes.poses_since_keyframes(keyframe_poses, matched.is_keyframe, motion)
    poses = online_poses
    saved_poses = None if filtered.saved is None else filtered.saved.poses
    if run.smooth:
        measurements, diagnostics, scans = smoother_input(run, filtered)
        smoothed, belief, closures = smooth_result(
            config,
            run.params,
            filtered.start,
            measurements,
            diagnostics,
            state.belief,
            scans if run.match_scans else None,
            guess,
        )
        state = state._replace(belief=belief)
        if saved_poses is not None:
            saved_poses = smoothed[: len(saved_poses)]
        keyframe_poses = smoothed[len(smoothed) - len(keyframe_poses) :]
        poses = keyframes.interpolate_poses(
            keyframe_poses, matched.is_keyframe, motion, matched.increments
        )
    num_saved = 0 if saved_poses is None else len(saved_poses)
    closures, saved_closures = sessions.split_closures(closures, num_saved)
    piece = piece_of(filtered.chunks, len(run.scans.hit))
    drives = np.split(keyframe_poses, np.flatnonzero(np.diff(piece[numbers])) + 1)
    if saved_poses is not None:
        drives.insert(0, saved_poses)
    topological_map = online.topological_map(config, state, trajectories_as_one(drives))
    if matched.matches is not None and config.scan_matching.use_odometry:
        notes += odometry_notes.contradictions(matched.matches)
        notes += odometry_notes.unsigned(matched.matches, matched.odometry)
        notes += odometry_notes.wrong_scale(matched.matches, matched.odometry)
    all_poses = spread(poses, piece >= 0)
    saved = None
    if filtered.saved is not None and saved_poses is not None:
        saved = filtered.saved, saved_poses
    lidar = config.frontend.lidar
    consistency = self_check.check_poses(lidar, all_poses, run.scans, piece, saved)
    return SlamResult(
        all_poses,
        spread(online_poses, piece >= 0),
        numbers,
        state.belief,
        info,
        features,
        topological_map,
        consistency,
        matches,
        closures,
        keyframe_odometry,
        notes,
        state.arcs,
        piece,
        saved_poses,
        saved_closures,
    )
