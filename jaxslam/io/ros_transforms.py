"""Transforms of ROS bags: odometry and the mount of the scanner."""

from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from jaxslam.io.errors import InputError

ODOM_FRAME = "odom"  # frame of the odometry
MAX_TRANSFORMS = 32  # transforms between two frames at most


class Transform(NamedTuple):
    """The pose of a frame in its parent frame over time.

    Attributes:
        parent: Name of the parent frame.
        times: [s].
        values: Translation x y z [m] and quaternion x y z w at each of the times.
    """

    parent: str
    times: list[float]
    values: list[tuple[float, ...]]


def seconds(stamp: Any) -> float:
    """Seconds of a ROS time stamp."""
    return stamp.sec + 1e-9 * stamp.nanosec


def frame_name(frame: str) -> str:
    """Name of a frame without the slash that ROS 1 puts before it."""
    return frame.removeprefix("/")


def planar_pose(position: Any, rotation: Any) -> tuple[float, float, float]:
    """Pose in the plane of a position and a quaternion."""
    heading = np.arctan2(
        2 * (rotation.w * rotation.z + rotation.x * rotation.y),
        1 - 2 * (rotation.y**2 + rotation.z**2),
    )
    return float(position.x), float(position.y), float(heading)


def add_transform(transforms: dict[str, Transform], message: Any) -> None:
    """Add a `TransformStamped`; one that is not finite or has a second parent is skipped."""
    position, rotation = message.transform.translation, message.transform.rotation
    values = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    if not np.isfinite(values).all():
        return
    child, parent = frame_name(message.child_frame_id), frame_name(message.header.frame_id)
    transform = transforms.setdefault(child, Transform(parent, [], []))
    if transform.parent == parent:
        transform.times.append(seconds(message.header.stamp))
        transform.values.append(values)


class _Vector(NamedTuple):
    """A position, or a quaternion."""

    x: float
    y: float
    z: float
    w: float = 0.0


def odometry_of_transforms(
    path: str | PathLike, transforms: dict[str, Transform]
) -> tuple[str, list[tuple[float, float, float, float]]]:
    """Odometry by transforms.

    Args:
        path: The bag, for errors.
        transforms: Transforms by child frame.

    Returns:
        Name of the robot frame, and t x y heading [s, m, m, rad] of it in the odometry frame.

    Raises:
        InputError: No frame has the odometry frame as its parent.
    """
    for child, transform in transforms.items():
        if transform.parent == ODOM_FRAME:
            poses = [planar_pose(_Vector(*v[:3]), _Vector(*v[3:])) for v in transform.values]
            stamped = zip(transform.times, poses, strict=True)
            return child, [(time, *pose) for time, pose in stamped]
    advice = "name a bag with odometry, or with the transform of the robot in `odom`"
    raise InputError(f"has no transform from {ODOM_FRAME!r}", path=path, advice=advice)


def mount_pose(
    transforms: dict[str, Transform], scan_frame: str, base_frame: str
) -> tuple[np.ndarray, bool]:
    """Mount of the scanner.

    Args:
        transforms: Transforms by child frame; the first value of each is used.
        scan_frame: Frame of the scans.
        base_frame: Frame of the robot.

    Returns:
        Pose (3,) [m, m, rad] of the scanner in the robot frame, and whether it is mounted upside
        down. Zero and False if no transforms join the two frames.
    """
    position, rotation = np.zeros(3), np.eye(3)
    frame = scan_frame
    for _ in range(MAX_TRANSFORMS):
        if frame == base_frame or frame not in transforms:
            break
        transform = transforms[frame]
        x, y, z, *quaternion = transform.values[0]
        parent_rotation = _rotation_matrix(*quaternion)
        position = np.array([x, y, z]) + parent_rotation @ position
        rotation = parent_rotation @ rotation
        frame = transform.parent
    if frame != base_frame:
        return np.zeros(3), False
    heading = np.arctan2(rotation[1, 0], rotation[0, 0])
    return np.array([*position[:2], heading]), bool(rotation[2, 2] < 0.0)


def _rotation_matrix(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Rotation (3, 3) of a quaternion x y z w, which is normalised first."""
    x, y, z, w = np.array([x, y, z, w]) / (np.linalg.norm([x, y, z, w]) or 1.0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
