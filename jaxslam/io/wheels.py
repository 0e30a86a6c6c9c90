"""The odometry of a log, checked: where it was started anew, and where scans have another's poses.

Public logs often hold poses that a SLAM program has corrected in the lines of the scans, and those
of the wheels in lines of their own; and a robot that was switched off and on counts from zero.
"""

import numpy as np

from jaxslam.poses import by_time, chain, interpolate, seen_from

JUMP = np.array([1.0, 1.0])  # [m], [rad] beyond what a robot moves, odometry was started anew
PACE = np.array([5.0, 5.0])  # [m/s], [rad/s] no robot of these logs is faster
SPREAD = np.array([0.3, 0.1])  # [m], [rad] between two frames that are the same
INSIDE = 0.9  # part of the scans that must lie in the time of the wheels for a comparison


def jumps(times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Steps (N - 1,) bool of poses (N, 3) at times (N,) [s] that no robot makes."""
    moved = seen_from(poses[:-1], poses[1:])
    size = np.column_stack([np.hypot(moved[:, 0], moved[:, 1]), np.abs(moved[:, 2])])
    return (size > JUMP + PACE * np.abs(np.diff(times))[:, None]).any(axis=1)


def without_jumps(times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, int]:
    """Poses (N, 3) in which the robot stands still where it seemed to jump, and how often it did.

    They begin where the given ones begin.
    """
    jump = jumps(times, poses)
    if not jump.any():
        return poses, 0
    moves = seen_from(poses[:-1], poses[1:])
    moves[jump] = 0.0
    return chain(moves, poses[0]), int(jump.sum())


def foreign(
    times: np.ndarray, poses: np.ndarray, wheel_times: np.ndarray, wheel_poses: np.ndarray
) -> bool:
    """Whether poses (T, 3) of scans are not those of the wheels (N, 3): corrected by another.

    A constant offset is a scanner that does not sit in the middle of the robot.
    """
    inside = (times >= wheel_times.min()) & (times <= wheel_times.max())
    if len(wheel_times) < 2 or inside.mean() < INSIDE:
        return False
    at = interpolate(times[inside], *by_time(wheel_times, wheel_poses))
    gap = seen_from(at, poses[inside])
    gap = seen_from(gap[0], gap)
    off = np.abs(gap - np.median(gap, axis=0))
    spread = np.quantile(np.hypot(off[:, 0], off[:, 1]), 0.9), np.quantile(off[:, 2], 0.9)
    return bool((spread > SPREAD).any())
