"""Batch smoothing of a whole drive: all poses and landmarks from all measurements, with loops."""

import numpy as np

from jaxslam.core import trace_cache
from jaxslam.core.batching import on_device, pad_to
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.core.types import AnyArray, Array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.matching import loop_closure
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.pipeline import arguments
from jaxslam.pipeline.config import Config
from jaxslam.smoothing import numbering, sparse
from jaxslam.smoothing import problem as smoothing_problem
from jaxslam.smoothing.problem import SmoothingProblem, SmoothingResult

# Searches for loop closures at most, each from the trajectory smoothed before it.
MAX_CLOSURE_ROUNDS = 2
CLOSURE_CONVERGED = 0.3  # [m] the search ends when no pose has moved further than this
# Numbers of scans and landmarks are padded to multiples of this to be smoothed.
PADDING_MULTIPLE = 512

_build_problem = trace_cache.jit(
    smoothing_problem.build_problem,
    static_argnames=("untrusted_inflation", "noise_model"),
    compile_quickly="unoptimised",
)


def smooth_result(
    config: Config,
    params: NoiseParams,
    start: Array,
    measurements: Measurement,
    info: StepInfo,
    belief: Belief,
    scans: Scan | None = None,
    guess: np.ndarray | None = None,
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
        guess: (T, 3) [m, m, rad] poses that are better than those of the filter, in whose loops
            places already coincide; None for none.

    Returns:
        Poses (T, 3) float64; the belief with the smoothed last pose and landmark positions, and the
        covariance of the filter; and the loop closures, None without scans.

    Raises:
        ValueError: There are scans, and `params.scan_match_std_scale` is None.
    """
    params = arguments.as_params(params, match_scans=scans is not None)
    steps = len(info.pose)
    capacity = _padded(int(np.count_nonzero(np.unique(info.id) >= 0)))
    initial = np.asarray(info.pose) if guess is None else guess.astype(info.pose.dtype)
    numbered = numbering.number_landmarks(
        info.id, initial, measurements.features, capacity=capacity
    )
    problem, initial = padded_problem(
        config.filter,
        params,
        start,
        measurements,
        numbered.landmark_index,
        initial,
    )
    if guess is None:
        smoothed = sparse.smooth_log(problem, initial, numbered.positions)
    else:
        smoothed = SmoothingResult(initial, np.asarray(numbered.positions), np.zeros(0))
    closures = None
    std_scale = params.scan_match_std_scale
    if scans is not None and std_scale is not None:
        smoothed, closures = _close_loops(
            config, problem, smoothed, scans, num_scans=steps, std_scale=float(std_scale)
        )
    poses, positions = map(np.asarray, (smoothed.poses[:steps], smoothed.landmark_positions))
    positions = _positions_of(belief, np.asarray(numbered.id), positions)
    mean = np.concatenate([poses[-1], positions.ravel()])
    return poses, belief._replace(mean=on_device(mean)), closures


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


def padded_problem(
    config: FilterConfig,
    params: NoiseParams,
    start: Array,
    measurements: Measurement,
    landmark_index: AnyArray,
    poses: np.ndarray,
) -> tuple[SmoothingProblem, np.ndarray]:
    """Smoothing problem and guess (P, 3), padded by steps without motion and measurements.

    Args:
        config: Of the filter.
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
        params,
        start,
        measurements,
        index,
        untrusted_inflation=config.untrusted_inflation,
        noise_model=config.noise_model,
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
    positions = np.asarray(belief.mean)[3:].reshape(-1, 2)
    is_smoothed = (np.asarray(belief.num_seen) > 0) & (ids[index] == np.asarray(belief.id))
    return np.where(is_smoothed[:, None], smoothed_positions[index], positions)
