"""Keyframes: scans that are chosen by motion; those between them are only matched.

A scan becomes a keyframe where the matched motion since the last keyframe exceeds a distance or an
angle; of logs whose scans are that far apart, all are. Of the scans i + 1 .. j from one keyframe
to the next, the filter gets one increment by the wheels and one by scan matching, each the
composition of theirs:

    u = u_(i+1) (+) ... (+) u_j

Scans are matched with a submap that is longer than the path between two keyframes, not with the
scan before. So the error of u is that of two poses in one submap, however many scans are between,
and does not grow with their number n. Its covariance is the mean of theirs, turned into the frame
of keyframe i,

    C = 1/n sum_t R_t H_t^-1 R_t^T,    H = C^-1

with the information H_t of match t, in the frame of pose t - 1, which has the heading of R_t in the
frame of i. Directions that some of the scans do not constrain, as along a bare corridor, have
little information in the mean too, and are those of the wheels. What is expected in place of the
wheels (`ScanMatch.expected`) is dead reckoning: its variances are summed.

After smoothing, the poses of the scans t between two keyframes i and j follow from their matched
motion m_t since i, and the correction g of the whole increment, by their share s_t of the path:

    x_t = x_i (+) s_t g (+) m_t,    g = (x_i^-1 x_j) (+) m_j^-1

All functions run on the host, in NumPy and double precision.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxslam.core.measurement import ScanMatch
from jaxslam.core.se2_np import compose, motion_size, relative
from jaxslam.core.types import AnyArray

NO_INFORMATION = 1.0
"""[1/m^2], [1/rad^2] information that is little: a metre and a radian."""

MAX_FRACTION = 0.5
"""Fraction of the scans above which choosing keyframes saves little, and all scans are kept."""

AT_REST = (0.0, 0.0, 0.0)


def check_distance(distance: Any) -> None:
    """Raise unless this is a distance of keyframes, as `choose_keyframes` takes it.

    Raises:
        ValueError: It is neither None nor two positive numbers.
    """
    if distance is None:
        return
    good = isinstance(distance, tuple) and len(distance) == 2
    if not good or not all(isinstance(x, int | float) and 0.0 < x < math.inf for x in distance):
        raise ValueError(
            f"config.keyframe_distance is {distance}, not a tuple of two positive numbers, "
            "[m] and [rad], or None"
        )


def distance_for_log(
    distance: tuple[float, float] | None, odometry: np.ndarray
) -> tuple[float, float] | None:
    """The distance of keyframes for a log; None, every scan, where it has hardly more scans.

    Many logs were thinned when they were recorded. To leave out a few of their scans saves nothing,
    and costs what these would show of the landmarks.

    Args:
        distance: [m], [rad] as of `choose_keyframes`.
        odometry: (T, 3) [m, m, rad] increments by the wheels; all zero where there are none.
    """
    is_keyframe, _ = choose_keyframes(distance, odometry)
    return distance if np.mean(is_keyframe) <= MAX_FRACTION else None


def choose_keyframes(
    distance: tuple[float, float] | None,
    increments: np.ndarray,
    before: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Choose keyframes among successive scans by their motion.

    Args:
        distance: [m], [rad] motion since the last keyframe that a keyframe exceeds in one of both;
            None: every scan is one.
        increments: (N, 3) [m, m, rad] motion since the scan before, in its frame.
        before: (3,) [m, m, rad] motion from the last keyframe to the scan before these; None before
            the first scan of a log, which is a keyframe.

    Returns:
        Whether each scan is a keyframe, (N,) bool; and the motion (3,) since the last of them,
        `before` of the next scans.
    """
    if distance is None:
        return np.ones(len(increments), bool), np.zeros(3)
    chosen: list[bool] = []
    motion: Sequence[float] = AT_REST if before is None else before.tolist()
    for increment in np.asarray(increments, float).tolist():
        motion = _compose_one(motion, increment)
        far = math.hypot(motion[0], motion[1]) > distance[0] or abs(motion[2]) > distance[1]
        chosen.append(far or (before is None and not chosen))
        if chosen[-1]:
            motion = AT_REST
    return np.array(chosen, bool), np.array(motion)


def motion_since_keyframe(increments: AnyArray, is_keyframe: np.ndarray) -> np.ndarray:
    """Motion (N, 3) [m, m, rad] since the last keyframe before each scan, in its frame.

    At a keyframe this is the motion since the keyframe before, the product of all increments.

    Args:
        increments: (N, 3) [m, m, rad]; the first scan follows a keyframe, or begins the log.
        is_keyframe: (N,) bool.
    """
    motion = np.asarray(increments, float).tolist()
    for k in (np.flatnonzero(~is_keyframe[:-1]) + 1).tolist():
        motion[k] = _compose_one(motion[k - 1], motion[k])
    return np.array(motion).reshape(-1, 3)


def _compose_one(pose: Sequence[float], increment: Sequence[float]) -> Sequence[float]:
    """`se2_np.compose` of one pose, without the overhead of arrays."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    heading = pose[2] + increment[2]
    return (
        pose[0] + cos * increment[0] - sin * increment[1],
        pose[1] + sin * increment[0] + cos * increment[1],
        heading - 2 * math.pi * math.floor((heading + math.pi) / (2 * math.pi)),
    )


def compose_matches(matches: ScanMatch, is_keyframe: np.ndarray) -> ScanMatch:
    """Increments by scan matching [K] from keyframe to keyframe, of those [N] of all scans.

    Keyframes that follow a keyframe keep their match as it is. Where a scan has no information at
    all, the whole increment has none.

    Args:
        matches: [N], NumPy; the first follows a keyframe, or begins the log.
        is_keyframe: (N,) bool; the last scan is one.
    """
    ends = np.flatnonzero(is_keyframe)
    starts = np.append(0, ends[:-1] + 1)[: len(ends)]
    count = (ends - starts + 1).astype(float)
    motion = motion_since_keyframe(matches.increment, is_keyframe)
    heading = np.append(0.0, np.where(is_keyframe, 0.0, motion[:, 2])[:-1])
    turn = np.zeros((len(motion), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(heading)
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(heading), -np.sin(heading), 1.0

    def mean(values: np.ndarray) -> np.ndarray:
        shape = (-1,) + (1,) * (values.ndim - 1)
        return np.add.reduceat(values, starts) / count.reshape(shape)

    own = np.asarray(matches.information, float)
    information = _mean_of_covariances(turn @ own @ turn.swapaxes(1, 2), mean)
    some = np.minimum.reduceat(own.any(axis=(1, 2)), starts)
    information = np.where(some[:, None, None], information, 0.0)
    information = np.where((count == 1)[:, None, None], own[ends], information)
    expected = variance = weight = None
    if matches.expected is not None:
        expected = motion_since_keyframe(matches.expected, is_keyframe)[ends]
    if matches.expected_variance is not None:
        variance = np.einsum("nij,nj->ni", turn**2, matches.expected_variance)
        variance = np.add.reduceat(variance, starts)
    if matches.odometry_weight is not None:
        weight = mean(np.asarray(matches.odometry_weight, float))
    inliers = np.minimum.reduceat(np.asarray(matches.inlier_fraction, float), starts)
    fields = motion[ends], information, inliers, expected, variance, weight
    dtype = np.asarray(matches.increment).dtype
    return ScanMatch._make(None if x is None else x.astype(dtype) for x in fields)


def _mean_of_covariances(
    information: np.ndarray, mean: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Information (K, 3, 3) whose inverse is the mean of the inverses of (N, 3, 3), by `mean`.

    Of singular matrices it is the limit of regular ones.
    """
    little = NO_INFORMATION * np.eye(3)
    result = np.linalg.inv(mean(np.linalg.inv(information + little))) - little
    values, axes = np.linalg.eigh((result + result.swapaxes(1, 2)) / 2)
    return (axes * np.maximum(values, 0.0)[:, None]) @ axes.swapaxes(1, 2)


def poses_since_keyframes(
    keyframe_poses: np.ndarray, is_keyframe: np.ndarray, motion: np.ndarray
) -> np.ndarray:
    """Poses (T, 3) of all scans: that of the last keyframe, and the motion since.

    Args:
        keyframe_poses: (K, 3) [m, m, rad] map frame.
        is_keyframe: (T,) bool; the first scan is one.
        motion: (T, 3) [m, m, rad] since the last keyframe, as of `motion_since_keyframe`.
    """
    last = np.cumsum(is_keyframe) - 1
    poses = compose(keyframe_poses[last], motion)
    poses[is_keyframe] = keyframe_poses
    return poses


def interpolate_poses(
    keyframe_poses: np.ndarray,
    is_keyframe: np.ndarray,
    motion: np.ndarray,
    increments: np.ndarray,
) -> np.ndarray:
    """Poses (T, 3) of all scans, between keyframes by their own motion; see the module's docstring.

    Args:
        keyframe_poses: (K, 3) [m, m, rad] map frame, smoothed.
        is_keyframe: (T,) bool; the first scan is one.
        motion: (T, 3) [m, m, rad] since the last keyframe, as of `motion_since_keyframe`.
        increments: (T, 3) [m, m, rad] since the scan before; their sizes are the shares of a path.
    """
    inverse = relative(motion[is_keyframe][1:], np.zeros((1, 3)))
    corrections = compose(relative(keyframe_poses[:-1], keyframe_poses[1:]), inverse)
    corrections = np.concatenate([corrections, np.zeros((1, 3))])  # none after the last keyframe
    last, first = np.cumsum(is_keyframe) - 1, np.flatnonzero(is_keyframe)  # (T,), (K,)
    driven = np.cumsum(motion_size(increments))
    length = np.append(np.diff(driven[first]), np.inf)
    share = (driven - driven[first][last]) / np.where(length > 0.0, length, 1.0)[last]
    poses = compose(compose(keyframe_poses[last], share[:, None] * corrections[last]), motion)
    poses[is_keyframe] = keyframe_poses
    return poses
