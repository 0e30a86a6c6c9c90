"""Poses of logs: SE(2) in NumPy and float64, whatever JAX's precision."""

import numpy as np


def by_time(times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses in float64, sorted stably by time."""
    order = np.argsort(times, kind="stable")
    return np.asarray(times, np.float64)[order], np.asarray(poses, np.float64)[order]


def interpolate(wanted: np.ndarray, times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (K, 3) at times (K,), linearly between those of (N,) sorted times."""
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    return np.stack([np.interp(wanted, times, column) for column in columns], axis=-1)


def composed(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """As `geometry.compose`, for (..., 3)."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * motion[..., 0] - s * motion[..., 1]
    y = pose[..., 1] + s * motion[..., 0] + c * motion[..., 1]
    return np.stack([x, y, _wrap(pose[..., 2] + motion[..., 2])], axis=-1)


def seen_from(frames: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (..., 3) in the frames of others (..., 3), as `geometry.between`."""
    c, s = np.cos(frames[..., 2]), np.sin(frames[..., 2])
    d = poses - frames
    x, y = c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]
    return np.stack([x, y, _wrap(d[..., 2])], axis=-1)


def placed(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (..., 2) of the frames of poses (..., 3), in the world; as `geometry.to_world`."""
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    x, y = points[..., 0], points[..., 1]
    return np.stack([poses[..., 0] + c * x - s * y, poses[..., 1] + s * x + c * y], axis=-1)


def chain(moves: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Poses (N + 1, 3) from a start (3,), zero by default, by moves (N, 3) in the frame before."""
    poses = np.zeros((len(moves) + 1, 3))
    poses[0] = 0.0 if start is None else start
    for i, move in enumerate(moves):
        poses[i + 1] = composed(poses[i], move)
    return poses


def _wrap(angle: np.ndarray) -> np.ndarray:
    """As `geometry.wrap_angle`."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
