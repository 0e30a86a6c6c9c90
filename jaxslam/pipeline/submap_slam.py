"""SLAM in submaps: the filter with maps of bounded size, which are joined as they are closed.

For areas whose landmarks are too many for one dense covariance. Scan by scan only the filter of one
submap runs, which takes the same time wherever the robot is. When the robot has driven
`SubmapSpec.max_distance`, or the map is full, the submap is closed:

    close       the Gaussian of its last pose and its landmarks (`filtering.submaps`)
    number      its landmarks, by matches with those of other submaps (`submap_numbering`)
    join        poses of frames, and landmarks: of the submaps around (`smoothing.submap_window`);
                of all, where a loop closes, and in the end (`smoothing.submap_gate`), without
                matches that the rest contradicts
    begin       the next submap, at the pose of its first scan

Until a submap is closed it does not profit from those before: `online_poses` drift by what the
filter drifts in one submap, and by what the last loop left. Measurements count once. Errors of the
joined submaps are those of a batch smoother whose Jacobians the filter has taken; the poses of the
scans inside of a submap stay as filtered in it.

References:
    Huang, Wang, Dissanayake (2008), Sparse local submap joining filter for building large-scale
    maps.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core import se2_np
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import AnyArray, as_float64
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.inputs import check_inputs
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo, run_filter
from jaxslam.filtering.submaps import Submap, begin_submap, close_submap
from jaxslam.pipeline.submap_numbering import SubmapSpec, check_submap_spec, number_landmarks
from jaxslam.smoothing.submap_gate import join_consistent
from jaxslam.smoothing.submap_joining import JoinedSubmaps
from jaxslam.smoothing.submap_window import choose_window, join_in_window

CHUNK = 20  # scans that one call of the filter's program takes
RESOLVED = 1.2  # times as many submaps as when all were solved last: all are solved again
WIDENED = 4  # times as many submaps, where a window is too small

DEFAULT = SubmapSpec()


class SubmapState(NamedTuple):
    """State between scans.

    Attributes:
        belief: Of the filter, in the frame of the open submap.
        origin: (3,) [m, m, rad] of the open submap, map frame, as its first scan shows it.
        driven: [m] in the open submap.
        start: (3,) [m, m, rad] origin of the first submap, map frame.
        submaps: Those that are closed.
        landmark_index: For each of them the index (n,) of its landmarks in `joined`.
        joined: Those that are closed, joined; None while there is none.
        num_solved: Number of submaps when all of them were solved last.
    """

    belief: Belief
    origin: np.ndarray
    driven: float
    start: np.ndarray
    submaps: tuple[Submap, ...]
    landmark_index: tuple[np.ndarray, ...]
    joined: JoinedSubmaps | None
    num_solved: int


class SubmapResult(NamedTuple):
    """A log in submaps; NumPy.

    Attributes:
        poses: (T, 3) [m, m, rad] by the joined submaps, map frame.
        online_poses: (T, 3) likewise, as they were known at the time of each scan.
        submap: (T,) int submap of each scan.
        landmark_id: (T, M) int landmark of each feature in its submap, `Submap.id`; -1 for none.
        submaps: N submaps.
        landmark_index: For each the index (n,) of its landmarks in `joined.landmark_positions`.
        joined: The submaps, joined.
    """

    poses: np.ndarray
    online_poses: np.ndarray
    submap: np.ndarray
    landmark_id: np.ndarray
    submaps: tuple[Submap, ...]
    landmark_index: tuple[np.ndarray, ...]
    joined: JoinedSubmaps


def init(config: FilterConfig, start: AnyArray) -> SubmapState:
    """State of a robot at `start` (3,) [m, m, rad], map frame, without submaps.

    Raises:
        ValueError: As of `begin_submap`, or `start` is no pose.
    """
    start = as_float64("start", start, (3,))
    return SubmapState(begin_submap(config), start, 0.0, start, (), (), None, 0)


def update(
    config: FilterConfig,
    params: NoiseParams,
    state: SubmapState,
    measurements: Measurement,
    *,
    spec: SubmapSpec = DEFAULT,
) -> tuple[SubmapState, StepInfo]:
    """Filter some scans; before, close the open submap where it is due.

    A submap ends with the increment that leads to the first scan of the next, whose frame is the
    pose of that scan: its landmarks are seen from the origin itself. That scan is a measurement of
    the next submap alone; where the one before sees its landmarks, too, `SubmapState.origin` takes
    the pose that it has there, and no estimate of a submap is made with it.

    Args:
        config: Configuration of the filter.
        params: Noise parameters.
        state: State before.
        measurements: [T] measurements without `landmark_ids` and `scan_match`; programs are
            compiled for each T.
        spec: When submaps are closed, and with what they are matched.

    Returns:
        The state, and the diagnostics [T], in the frame of the open submap, `state.origin`.

    Raises:
        ValueError: As of `run_filter`; or `landmark_ids` or `scan_match` is given.
    """
    for name in ("landmark_ids", "scan_match"):
        if getattr(measurements, name) is not None:
            raise ValueError(f"measurements.{name} is given, which submaps do not take")
    odometry = np.array(measurements.odometry)
    if state.driven >= spec.max_distance or _is_full(config, state.belief):
        first = jax.tree.map(lambda x: x[0], measurements)
        seen = run_filter(config, params, state.belief, measurements)[1].pose[0]
        given = check_inputs(params, state.belief, first, over_time=False)
        ended = state._replace(belief=_predict(config, given[0], state.belief, given[1]))
        state = close(config, spec, ended)
        assert state.joined is not None
        origin = se2_np.compose(state.joined.origins[-2], np.asarray(seen, float))
        state = state._replace(origin=origin)
        odometry[0] = 0.0
    belief, info = run_filter(
        config, params, state.belief, measurements._replace(odometry=jnp.asarray(odometry))
    )
    driven = state.driven + float(np.linalg.norm(odometry[:, :2], axis=1).sum())
    return state._replace(belief=belief, driven=driven), info


@partial(jax.jit, static_argnames="config")
def _predict(
    config: FilterConfig, params: NoiseParams, belief: Belief, measurement: Measurement
) -> Belief:
    """The belief after the increment of a measurement."""
    return slam_filter.predict(config, params, belief, measurement)[0]


def close(config: FilterConfig, spec: SubmapSpec, state: SubmapState) -> SubmapState:
    """Close the open submap, join it with the others, and begin the next."""
    submap = close_submap(config, state.belief)
    submaps, previous = (*state.submaps, submap), state.joined
    if previous is None:
        origins = state.start[None]
        landmark_index: tuple[np.ndarray, ...] = (np.arange(len(submap.positions)),)
        positions, window = se2_np.transform(state.start, submap.positions), np.arange(0)
    else:
        origins = previous.origins
        landmark_index, positions, window = number_landmarks(
            config.association, spec, submaps, state.landmark_index, previous
        )
    origins = np.concatenate([origins, se2_np.compose(origins[-1], submap.last_pose)[None]])
    joined, num_solved = None, state.num_solved
    if previous is not None and len(submaps) < RESOLVED * num_solved:
        joined = _join_nearby(spec, submaps, landmark_index, origins, positions, previous, window)
    if joined is None:
        num_solved = len(submaps)
        joined, landmark_index = join_consistent(
            submaps,
            landmark_index,
            origins,
            positions,
            previous=previous,
            max_iterations=spec.max_iterations,
        )
    begun = begin_submap(config)
    return SubmapState(
        begun, joined.origins[-1], 0.0, state.start, submaps, landmark_index, joined, num_solved
    )


def _join_nearby(
    spec: SubmapSpec,
    submaps: tuple[Submap, ...],
    landmark_index: tuple[np.ndarray, ...],
    origins: np.ndarray,
    positions: np.ndarray,
    previous: JoinedSubmaps,
    window: np.ndarray,
) -> JoinedSubmaps | None:
    """All submaps, of which only those around the last are solved; None if that does not do."""
    size = spec.window
    while len(window) < len(submaps) - 1:
        joined = join_in_window(
            window,
            submaps,
            landmark_index,
            origins,
            positions,
            previous,
            max_iterations=spec.max_iterations,
        )
        if joined is not None or size > len(submaps) / 2:
            return joined
        size *= WIDENED
        window = choose_window(
            landmark_index[:-1],
            len(positions),
            len(submaps) - 2,
            window,
            size,
            min_shared=spec.min_matches,
        )
    return None


def run_submaps(
    config: FilterConfig,
    params: NoiseParams,
    start: AnyArray,
    measurements: Measurement,
    *,
    spec: SubmapSpec = DEFAULT,
    callback: Callable[[int, SubmapState], None] | None = None,
) -> SubmapResult:
    """SLAM in submaps over one log.

    The time of a scan does not depend on the size of the map, and that of a closing hardly does:
    only the submaps around are solved, or all, where that does not explain the new one. Memory is
    proportional to the number of submaps.

    Args:
        config: Configuration of the filter; `max_landmarks` is the capacity of one submap.
        params: Noise parameters.
        start: (3,) [m, m, rad] known pose before the first increment, map frame.
        measurements: [T] measurements without `landmark_ids` and `scan_match`.
        spec: When submaps are closed, and with what they are matched.
        callback: Called after each chunk with the number of scans so far and the state.

    Returns:
        Trajectory and submaps, joined until the cost hardly falls.

    Raises:
        ValueError: As of `init`, `check_submap_spec` and `update`; or there is no scan.
    """
    check_submap_spec(spec)
    state = init(config, start)
    measurements = jax.tree.map(np.asarray, measurements)
    num_scans = len(measurements.odometry)
    if num_scans == 0:
        raise ValueError("measurements holds no scan")
    poses, online, numbers, ids = [], [], [], []
    for begin in range(0, num_scans, CHUNK):
        chunk = jax.tree.map(lambda x, begin=begin: x[begin : begin + CHUNK], measurements)
        state, info = update(config, params, state, chunk, spec=spec)
        local = np.asarray(info.pose, float)
        poses.append(local)
        online.append(se2_np.compose(state.origin, local))
        numbers.append(np.full(len(local), len(state.submaps)))
        ids.append(np.asarray(info.id))
        if callback is not None:
            callback(begin + len(local), state)
    state = close(config, spec, state)
    joined = state.joined
    assert joined is not None  # the last scan closes a submap
    joined, landmark_index = join_consistent(
        state.submaps,
        state.landmark_index,
        joined.origins,
        joined.landmark_positions,
        previous=joined,
    )
    number = np.concatenate(numbers)
    return SubmapResult(
        poses=se2_np.compose(joined.origins[number], np.concatenate(poses)),
        online_poses=np.concatenate(online),
        submap=number,
        landmark_id=np.concatenate(ids),
        submaps=state.submaps,
        landmark_index=landmark_index,
        joined=joined,
    )


def _is_full(config: FilterConfig, belief: Belief) -> bool:
    """Whether the map has fewer free slots than a scan may need."""
    return int(np.count_nonzero(belief.num_seen)) > config.max_landmarks - config.max_new
