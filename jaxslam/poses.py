"""SE(2) poses in NumPy and float64, for logs and metrics; `geometry` is the same in JAX."""

import numpy as np


def by_time(times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses in float64, sorted stably by time."""
    order = np.argsort(times, kind="stable")
    return np.asarray(times, np.float64)[order], np.asarray(poses, np.float64)[order]


def interpolate(wanted: np.ndarray, times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (K, 3) at times (K,) [s], linearly between poses (N, 3) at sorted times (N,) [s]."""
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    return np.stack([np.interp(wanted, times, column) for column in columns], axis=-1)


def composed(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Poses (..., 3) after motions (..., 3), given in their frames; as `geometry.compose`."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + cos * motion[..., 0] - sin * motion[..., 1]
    y = pose[..., 1] + sin * motion[..., 0] + cos * motion[..., 1]
    return np.stack([x, y, _wrap(pose[..., 2] + motion[..., 2])], axis=-1)


def seen_from(frames: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (..., 3) relative to the frames (..., 3), in them; as `geometry.between`."""
    cos, sin = np.cos(frames[..., 2]), np.sin(frames[..., 2])
    gap = poses - frames
    x, y = cos * gap[..., 0] + sin * gap[..., 1], cos * gap[..., 1] - sin * gap[..., 0]
    return np.stack([x, y, _wrap(gap[..., 2])], axis=-1)


def placed(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points (..., 2) [m] from the frames of poses (..., 3) to that of the poses.

    As `geometry.to_world`.
    """
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    x, y = points[..., 0], points[..., 1]
    return np.stack([poses[..., 0] + cos * x - sin * y, poses[..., 1] + sin * x + cos * y], axis=-1)


def chain(moves: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Trajectory of increments: dead reckoning.

    Args:
        moves: (N, 3) increments, each in the frame of the pose before it.
        start: (3,) first pose; zero by default.

    Returns:
        (N + 1, 3) poses.
    """
    poses = np.zeros((len(moves) + 1, 3))
    poses[0] = 0.0 if start is None else start
    for i, move in enumerate(moves):
        poses[i + 1] = composed(poses[i], move)
    return poses


def _wrap(angle: np.ndarray) -> np.ndarray:
    """As `geometry.wrap_angle`."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
