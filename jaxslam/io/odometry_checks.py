"""Checks of a log's odometry, the same for all formats: is it there, does it restart?

Many public logs hold poses corrected by a SLAM program in the lines of the scans, and the raw
odometry in lines of their own; and the odometry restarts at zero when a robot is switched off and
on.

Odometry that latches, or reports driving backwards as driving forwards, is found by scan matching.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.core.logs import MAX_BROKEN_FRACTION
from jaxslam.core.se2_np import dead_reckoning, motion_size, relative
from jaxslam.core.time_series import interpolate_poses

# [m], [rad] tolerance of `odometry_jumps`, beyond what `MAX_SPEED` allows
MAX_STEP = np.array([1.0, 1.0])
MAX_SPEED = np.array([5.0, 5.0])  # [m/s], [rad/s] no robot of these logs is faster
SAME_FRAME_SPREAD = np.array([0.3, 0.1])  # [m], [rad] tolerance of `poses_are_corrected`
MIN_OVERLAP = 0.9  # least fraction of the scans within the time of the odometry, for a comparison
MIN_EXTENT = np.array([0.01, 0.01, 0.02])  # [m, m, rad] that an odometry which works exceeds
MIN_POSES = 10  # fewer may have that little extent
MAX_GAP = 3.5  # [s] without odometry that needs no note
MAX_GAP_RATIO = 20.0  # of such a gap over the usual step
MIN_GAP_MOTION = 0.3  # [m] in such a gap; a radian counts as half a metre


class CheckedOdometry(NamedTuple):
    """Odometry after the checks.

    Attributes:
        poses: (N, 3) [m, m, rad].
        is_stale: (N,) bool, whether the increment to a pose is not to be trusted: there was none
            when it was needed, and what is here was interpolated or left out.
        notes: What has been changed.
        restarts: Number of restarts.
        usable: Whether there is any odometry at all; if not, the poses are all the first.
    """

    poses: np.ndarray
    is_stale: np.ndarray
    notes: tuple[str, ...]
    restarts: int = 0
    usable: bool = True


def check_odometry(times: np.ndarray, poses: np.ndarray) -> CheckedOdometry:
    """Check a stream of poses and correct what can be corrected.

    Args:
        times: (N,) [s], for the duration of the steps.
        poses: (N, 3) [m, m, rad] by odometry, in the order in which they were driven.

    Returns:
        The odometry; `poses` itself if nothing is wrong.
    """
    if is_frozen(poses):
        return _no_odometry(poses, f"its pose is the same in all {len(poses)}")
    is_jump = odometry_jumps(times, poses) | _restarts(poses)
    restarts = int(is_jump.sum())
    if restarts > MAX_BROKEN_FRACTION * len(poses) and restarts > 1:
        return _no_odometry(poses, f"it jumps {restarts} times in {len(poses)} poses")
    notes = []
    if restarts:
        poses = _without(is_jump, poses)
        notes.append(f"odometry restarts ({restarts} x): no motion is assumed there")
    is_stale = np.concatenate([[False], is_jump])
    return CheckedOdometry(poses, is_stale, tuple(notes), restarts)


def missing_spans(times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Find spans without odometry in which the robot moved.

    Args:
        times: (N,) [s], ascending.
        poses: (N, 3) [m, m, rad] by odometry.

    Returns:
        (N - 1,) bool: the step takes longer than `MAX_GAP` and far longer than the others.
    """
    steps = np.diff(times)
    motion = relative(poses[:-1], poses[1:])
    usual = float(np.median(steps)) if steps.size else 0.0
    return (steps > max(MAX_GAP, MAX_GAP_RATIO * usual)) & (motion_size(motion) > MIN_GAP_MOTION)


def is_frozen(poses: np.ndarray) -> bool:
    """Whether poses (N, 3) never change, or, from `MIN_POSES` on, hardly."""
    if len(poses) < 2:
        return False
    extent = np.ptp(np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]), axis=0)
    return bool(not extent.any() or (len(poses) >= MIN_POSES and (extent < MIN_EXTENT).all()))


def odometry_jumps(times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Find steps that are too large for a robot.

    Args:
        times: (N,) [s].
        poses: (N, 3) [m, m, rad] by odometry.

    Returns:
        (N - 1,) bool: the step is larger than `MAX_STEP` + `MAX_SPEED` * its duration.
    """
    motion = relative(poses[:-1], poses[1:])
    size = np.column_stack([np.hypot(motion[:, 0], motion[:, 1]), np.abs(motion[:, 2])])
    return (size > MAX_STEP + MAX_SPEED * np.abs(np.diff(times))[:, None]).any(axis=1)


def poses_are_corrected(
    times: np.ndarray, poses: np.ndarray, wheel_times: np.ndarray, wheel_poses: np.ndarray
) -> bool:
    """Whether the poses of scans differ from the odometry: another program corrected them.

    A constant offset is allowed: a scanner that is not at the centre of the robot. Compared is the
    90 % quantile of the deviation from the median offset, with `SAME_FRAME_SPREAD`.

    Args:
        times: (T,) of the scans, [s] or places in the file.
        poses: (T, 3) [m, m, rad] of the scans.
        wheel_times: (N,) of the odometry, on the same axis and ascending.
        wheel_poses: (N, 3) [m, m, rad] of the odometry.
    """
    inside = (times >= wheel_times[0]) & (times <= wheel_times[-1])
    if len(wheel_times) < 2 or inside.mean() < MIN_OVERLAP:
        return False
    odometry = interpolate_poses(times[inside], wheel_times, wheel_poses)
    offset = relative(odometry, poses[inside])
    offset = relative(offset[0], offset)
    deviation = np.abs(offset - np.median(offset, axis=0))
    distance = np.hypot(deviation[:, 0], deviation[:, 1])
    spread = np.quantile(distance, 0.9), np.quantile(deviation[:, 2], 0.9)
    return bool((spread > SAME_FRAME_SPREAD).any())


def _no_odometry(poses: np.ndarray, reason: str) -> CheckedOdometry:
    """Poses that stand still, with the reason."""
    still = np.repeat(poses[:1], len(poses), axis=0)
    note = f"no odometry: {reason}"
    return CheckedOdometry(still, np.ones(len(poses), bool), (note,), usable=False)


def _restarts(poses: np.ndarray) -> np.ndarray:
    """Steps (N - 1,) bool to where the odometry began, far larger than all others but a few."""
    size = motion_size(relative(poses[:-1], poses[1:]))
    if len(size) < MIN_POSES:
        return np.zeros(len(size), bool)
    usual = float(np.quantile(size, 0.95))
    from_start = motion_size(relative(np.broadcast_to(poses[0], poses[1:].shape), poses[1:]))
    at_start = np.minimum(from_start, motion_size(poses[1:])) <= usual
    return at_start & (size > 10.0 * usual) & (size > 0.1)


def _without(is_jump: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (N, 3) from the first on, with no motion in the steps (N - 1,) that are jumps."""
    increments = relative(poses[:-1], poses[1:])
    increments[is_jump] = 0.0
    return np.concatenate([poses[:1], dead_reckoning(poses[0], increments)])
