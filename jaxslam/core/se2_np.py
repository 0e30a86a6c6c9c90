"""SE(2) poses in NumPy and float64, for logs and metrics; `se2` is the same in JAX."""

import numpy as np


def compose(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Poses (..., 3) after motions (..., 3), given in their frames; as `se2.compose`."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + cos * motion[..., 0] - sin * motion[..., 1]
    y = pose[..., 1] + sin * motion[..., 0] + cos * motion[..., 1]
    return np.stack([x, y, wrap_angle(pose[..., 2] + motion[..., 2])], axis=-1)


def relative(frames: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (..., 3) relative to the frames (..., 3), in them; as `se2.relative`."""
    cos, sin = np.cos(frames[..., 2]), np.sin(frames[..., 2])
    gap = poses - frames
    x, y = cos * gap[..., 0] + sin * gap[..., 1], cos * gap[..., 1] - sin * gap[..., 0]
    return np.stack([x, y, wrap_angle(gap[..., 2])], axis=-1)


def transform(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points (..., 2) [m] from the frames of poses (..., 3) to that of the poses.

    As `se2.transform`.
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
        poses[i + 1] = compose(poses[i], move)
    return poses


def wrap_angle(angle: np.ndarray) -> np.ndarray:
    """As `se2.wrap_angle`."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
