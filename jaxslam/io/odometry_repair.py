"""Checks of a log's odometry: restarts, and poses of scans that are not odometry.

Many public logs hold poses corrected by a SLAM program in the lines of the scans, and the raw
odometry in lines of their own; and the odometry restarts at zero when a robot is switched off and
on.
"""

import numpy as np

from jaxslam.core.se2_np import dead_reckoning, relative
from jaxslam.core.time_series import interpolate_poses, sort_by_time

# [m], [rad] tolerance of `odometry_jumps`, beyond what `MAX_SPEED` allows
MAX_STEP = np.array([1.0, 1.0])
MAX_SPEED = np.array([5.0, 5.0])  # [m/s], [rad/s] no robot of these logs is faster
SAME_FRAME_SPREAD = np.array([0.3, 0.1])  # [m], [rad] tolerance of `poses_are_corrected`
MIN_OVERLAP = 0.9  # least fraction of the scans within the time of the odometry, for a comparison


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


def remove_jumps(times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, int]:
    """Replace jumps of the odometry by no motion.

    Args:
        times: (N,) [s].
        poses: (N, 3) [m, m, rad] by odometry.

    Returns:
        Poses (N, 3) that start at the first given one, and the number of jumps.
    """
    is_jump = odometry_jumps(times, poses)
    if not is_jump.any():
        return poses, 0
    increments = relative(poses[:-1], poses[1:])
    increments[is_jump] = 0.0
    repaired = np.concatenate([poses[:1], dead_reckoning(poses[0], increments)])
    return repaired, int(is_jump.sum())


def poses_are_corrected(
    times: np.ndarray, poses: np.ndarray, wheel_times: np.ndarray, wheel_poses: np.ndarray
) -> bool:
    """Whether the poses of scans differ from the odometry: another program corrected them.

    A constant offset is allowed: a scanner that is not at the centre of the robot. Compared is the
    90 % quantile of the deviation from the median offset, with `SAME_FRAME_SPREAD`.

    Args:
        times: (T,) [s] of the scans.
        poses: (T, 3) [m, m, rad] of the scans.
        wheel_times: (N,) [s] of the odometry.
        wheel_poses: (N, 3) [m, m, rad] of the odometry.
    """
    inside = (times >= wheel_times.min()) & (times <= wheel_times.max())
    if len(wheel_times) < 2 or inside.mean() < MIN_OVERLAP:
        return False
    odometry = interpolate_poses(times[inside], *sort_by_time(wheel_times, wheel_poses))
    offset = relative(odometry, poses[inside])
    offset = relative(offset[0], offset)
    deviation = np.abs(offset - np.median(offset, axis=0))
    distance = np.hypot(deviation[:, 0], deviation[:, 1])
    spread = np.quantile(distance, 0.9), np.quantile(deviation[:, 2], 0.9)
    return bool((spread > SAME_FRAME_SPREAD).any())
