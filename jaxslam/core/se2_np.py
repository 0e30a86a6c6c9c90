"""SE(2) poses in NumPy, for logs and metrics; `se2` is the same in JAX, with the same names.

Frames and poses may lead with any axes here, and dtypes follow NumPy's rules: float64 for logs.
"""

from collections.abc import Sequence

import numpy as np


def wrap_angle(angle: np.ndarray) -> np.ndarray:
    """Return the same angle [rad] in [-pi, pi)."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))


def compose(pose: np.ndarray, increment: np.ndarray) -> np.ndarray:
    """Poses (..., 3) after increments (..., 3), given in the frames of `pose`."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + cos * increment[..., 0] - sin * increment[..., 1]
    y = pose[..., 1] + sin * increment[..., 0] + cos * increment[..., 1]
    return np.stack([x, y, wrap_angle(pose[..., 2] + increment[..., 2])], axis=-1)


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses `b` (..., 3) relative to poses `a` (..., 3): the inverse of `compose`."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    gap = b - a
    x, y = cos * gap[..., 0] + sin * gap[..., 1], cos * gap[..., 1] - sin * gap[..., 0]
    return np.stack([x, y, wrap_angle(gap[..., 2])], axis=-1)


def transform(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points (..., 2) [m] from the frames at poses (..., 3) to that of the poses."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = points[..., 0], points[..., 1]
    return np.stack([pose[..., 0] + cos * x - sin * y, pose[..., 1] + sin * x + cos * y], axis=-1)


def inverse_transform(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points (..., 2) [m] to the frames at poses (..., 3) from that of the poses."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = points[..., 0] - pose[..., 0], points[..., 1] - pose[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def dead_reckoning(start: np.ndarray, increments: np.ndarray) -> np.ndarray:
    """Poses by composing increments, one after the other.

        poses[0] = start (+) increments[0],     poses[t] = poses[t - 1] (+) increments[t]

    Args:
        start: (3,) [m, m, rad].
        increments: (T, 3) [m, m, rad], each in the frame of the pose before it; where the first is
            zero, the first pose is `start`.

    Returns:
        (T, 3) float64 [m, m, rad], in the frame of `start`.
    """
    poses, pose = np.zeros((len(increments), 3)), np.asarray(start, float)
    for index, increment in enumerate(increments):
        pose = poses[index] = compose(pose, increment)
    return poses


def increments(poses: np.ndarray) -> np.ndarray:
    """Increments (T, 3) to each of poses (T, 3) from the one before, in its frame; zero at first.

    The inverse of `dead_reckoning` from the first pose.
    """
    return np.concatenate([np.zeros((1, 3)), relative(poses[:-1], poses[1:])])


def motion_size(increments: np.ndarray) -> np.ndarray:
    """Sizes (...) [m] of increments (..., 3), of which a radian counts as half a metre."""
    return np.hypot(increments[..., 0], increments[..., 1]) + 0.5 * np.abs(increments[..., 2])


def trajectories_as_one(trajectories: Sequence[np.ndarray]) -> np.ndarray:
    """Trajectories (T, 3) one after the other, with a row of NaN between two of them."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([x for one in trajectories for x in (gap, one)][1:])
