"""Headings of quaternions as robots send them: not of unit length, zero, or a yaw in z."""

import numpy as np

UNIT_TOLERANCE = 1e-3  # of the length of a quaternion that is used as it is
MIN_LENGTH = 1e-3  # of a quaternion that has a direction


def headings(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Headings of the orientations of a stream.

    Args:
        quaternions: (N, 4) x y z w.

    Returns:
        (N,) [rad]; (N,) bool whether there is a heading, which a quaternion of zeros has not; and
        notes on quaternions that are none.
    """
    x, y, z, w = quaternions.T
    length = np.linalg.norm(quaternions, axis=1)
    only_z = (x == 0.0) & (y == 0.0) & (w == 0.0)
    if only_z.all() and z.any() and np.abs(length - 1.0).max() > UNIT_TOLERANCE:
        note = "orientations of the odometry are no quaternions: their z is taken for the yaw"
        return z.copy(), np.ones(len(z), bool), [note]
    valid = np.isfinite(length) & (length > MIN_LENGTH)
    notes = []
    if valid.any() and not valid.all():
        number = int((~valid).sum())
        notes.append(f"{number} poses of the odometry have no orientation and are left out")
    off_unit = valid & (np.abs(length - 1.0) > UNIT_TOLERANCE)
    scaled = quaternions.copy()
    scaled[off_unit] /= length[off_unit, None]
    if off_unit.mean() > 0.5:
        notes.append("quaternions of the odometry are not of unit length: they are scaled")
    return yaw_of(scaled), valid, notes


def yaw_of(quaternions: np.ndarray) -> np.ndarray:
    """Yaw (N,) [rad] of unit quaternions (N, 4) x y z w."""
    x, y, z, w = quaternions.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a quaternion (4,) x y z w, which is normalised first."""
    x, y, z, w = quaternion / (np.linalg.norm(quaternion) or 1.0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
