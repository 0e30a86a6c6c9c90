"""Where the scanner sits on the robot, and how transforms move the robot: trees of frames."""

from collections.abc import Iterable, Mapping
from os import PathLike
from typing import NamedTuple

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.quaternions import headings, rotation_matrix
from jaxslam.io.raw_log import RawOdometry, RawTransform, as_stamps

ODOM_FRAMES = ("odom", "odom_combined", "odometry")
WORLD_FRAMES = (*ODOM_FRAMES, "map", "world", "earth")
BASE_FRAMES = ("base_link", "base_footprint", "base")
MAX_TILT = 0.9  # least cosine between the axis of a scanner and the vertical, without a note
MAX_MOUNT_MOTION = 0.05  # [m], or of a quaternion, that a mount may change without a note

Transforms = Mapping[tuple[str, str], RawTransform]
"""Transforms by (parent, child)."""


class Mount(NamedTuple):
    """How a scanner is mounted.

    Attributes:
        pose: (3,) [m, m, rad] of the scanner in the frame of the robot.
        upside_down: Whether its beams go clockwise, seen from above.
    """

    pose: np.ndarray
    upside_down: bool


def frame_name(frame: str) -> str:
    """Name of a frame without the slash that ROS 1 puts before it."""
    return frame.strip().removeprefix("/")


def find_mount(
    path: str | PathLike,
    transforms: Transforms,
    scan_frame: str,
    base_frame: str,
    odom_frame: str | None = None,
) -> tuple[Mount, list[str]]:
    """Mount of a scanner by the transforms of a log, whose first values are used.

    A frame that no transform names stands for one of the same name in another namespace, and
    `base_footprint` and `base_link` stand for each other. Without a transform of the scanner, it
    is taken to be at the origin of the robot.

    Args:
        path: The log, for errors.
        transforms: Transforms of the log.
        scan_frame: Frame of the scans.
        base_frame: Frame that the odometry moves; "" if the log does not say.
        odom_frame: Frame of the odometry, if it has an unusual name.

    Returns:
        The mount, and notes on what was assumed.

    Raises:
        InputError: There is a transform of the scanner, but none that joins it to the robot.
    """
    joints = _joints(transforms, odom_frame)
    base_name = base_frame or "the robot"
    scan_names = _alike(scan_frame, joints)
    if scan_frame and scan_frame == base_frame:
        return Mount(np.zeros(3), False), []
    if not scan_names:
        note = (
            f"no transform from {base_name!r} to {scan_frame!r}: the scanner is taken to be at the "
            "robot's origin; --mount settles it"
        )
        return Mount(np.zeros(3), False), [note]
    for scan_name in scan_names:
        reached = _reachable(joints, scan_name)
        for name in _base_candidates(base_frame, transforms, reached, scan_name):
            mount, notes = _mount_of(reached[name])
            notes += _motion_notes(transforms, scan_name)
            if name != base_frame:
                what = f"frame {base_frame!r}" if base_frame else "frame of the robot"
                notes.insert(0, f"{what}, by the odometry, is taken to be {name!r}")
            return mount, notes
    problem = f"no transform joins {base_name!r} to {scan_frame!r}"
    known = ", ".join(sorted({frame for pair in transforms for frame in pair})[:12])
    advice = f"name --base-frame or --scan-frame, or give --mount X Y YAW; frames are: {known}"
    raise InputError(problem, path=path, advice=advice)


def odometry_of_transforms(
    path: str | PathLike, transforms: Transforms, scan_frame: str, odom_frame: str | None
) -> tuple[RawOdometry | None, str, list[str]]:
    """Odometry by the transform of the robot in the odometry frame.

    Of several children the one is taken that the scanner is mounted on.

    Args:
        path: The log, for errors.
        transforms: Transforms of the log.
        scan_frame: Frame of the scans.
        odom_frame: Frame of the odometry; by default one that is called so.

    Returns:
        The odometry, None without such a transform; the frame that it moves; and notes.

    Raises:
        InputError: There is no transform from the given `odom_frame`.
    """
    found = [pair for pair in transforms if _is_odom(pair[0], odom_frame)]
    if not found:
        if odom_frame is not None:
            parents = ", ".join(sorted({parent for parent, _ in transforms})) or "none"
            problem = f"there is no transform from {odom_frame!r}"
            advice = f"frames with transforms from them: {parents}"
            raise InputError(problem, path=path, field="--odom-frame", advice=advice)
        return None, "", []
    joints = _joints(transforms, odom_frame)
    reached = [_reachable(joints, name) for name in _alike(scan_frame, joints)]

    def preference(pair: tuple[str, str]) -> tuple[int, int]:
        carries = any(pair[1] in frames for frames in reached)
        return int(carries), len(transforms[pair].values)

    chosen = max(sorted(found), key=preference)
    notes = []
    if len(found) > 1:
        children = ", ".join(sorted(child for _, child in found))
        notes.append(f"{chosen[0]!r} has the children {children}: {chosen[1]!r} is the odometry")
    transform = transforms[chosen]
    values = np.array(transform.values)
    heading, valid, more = headings(values[:, 3:])
    poses = np.column_stack([values[:, :2], heading])[valid]
    stamps = as_stamps([row for row, use in zip(transform.stamps, valid, strict=True) if use])
    return RawOdometry(stamps, poses), chosen[1], notes + more


def _is_odom(frame: str, odom_frame: str | None) -> bool:
    """Whether a frame is that of the odometry."""
    if odom_frame is not None:
        return frame == frame_name(odom_frame)
    return _last(frame) in ODOM_FRAMES


def _last(frame: str) -> str:
    """Name of a frame without its namespace."""
    return frame.rsplit("/", 1)[-1]


Joints = dict[str, list[tuple[str, np.ndarray]]]
"""By frame: its neighbours and its pose (4, 4) in each."""


def _joints(transforms: Transforms, odom_frame: str | None) -> Joints:
    """Transforms between frames of the robot and their inverses, by the first value of each."""
    joints: Joints = {}
    for (parent, child), transform in transforms.items():
        if _last(parent) in WORLD_FRAMES or _is_odom(parent, odom_frame):
            continue
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(np.array(transform.values[0][3:]))
        pose[:3, 3] = transform.values[0][:3]
        joints.setdefault(child, []).append((parent, pose))
        joints.setdefault(parent, []).append((child, np.linalg.inv(pose)))
    return joints


def _reachable(joints: Joints, start: str) -> dict[str, np.ndarray]:
    """Pose (4, 4) of `start` in every frame that is joined to it, nearest first."""
    poses = {start: np.eye(4)}
    queue = [start]
    for frame in queue:
        for other, pose in joints.get(frame, ()):
            if other not in poses:
                poses[other] = pose @ poses[frame]
                queue.append(other)
    return poses


def _alike(frame: str, frames: Iterable[str]) -> list[str]:
    """The frame itself if it is there, or those of the same name in other namespaces."""
    known = set(frames)
    if frame in known:
        return [frame]
    return sorted(name for name in known if frame and _last(name) == _last(frame))


def _base_candidates(
    base_frame: str, transforms: Transforms, reached: Mapping[str, np.ndarray], scan_frame: str
) -> list[str]:
    """Frames joined to the scanner that may be the robot's, the best first.

    Without a name for it: one that is usually the robot's, or else the root of the tree.
    """
    names = _alike(base_frame, reached)
    if not base_frame or _last(base_frame) in BASE_FRAMES:
        usual = [name for base in BASE_FRAMES for name in _alike(base, reached)]
        names += [name for name in usual if name not in names]
    if not base_frame and not names:
        children = {child for _, child in transforms}
        names = [name for name in reached if name not in children and name != scan_frame]
    return names


def _mount_of(pose: np.ndarray) -> tuple[Mount, list[str]]:
    """The mount at a pose (4, 4), and a note if the scanner is tilted."""
    notes = []
    if abs(pose[2, 2]) < MAX_TILT:
        angle = np.degrees(np.arccos(min(abs(pose[2, 2]), 1.0)))
        notes.append(f"scanner is tilted by {angle:.0f} degrees: its scans are taken as level")
    upside_down = bool(pose[2, 2] < 0.0)
    heading = np.arctan2(pose[1, 0], pose[0, 0])
    return Mount(np.array([pose[0, 3], pose[1, 3], heading]), upside_down), notes


def _motion_notes(transforms: Transforms, scan_frame: str) -> list[str]:
    """A note if the scanner moves on the robot."""
    for (parent, child), transform in transforms.items():
        if child == scan_frame and _last(parent) not in WORLD_FRAMES:
            if np.ptp(np.array(transform.values), axis=0).max() > MAX_MOUNT_MOTION:
                return [f"scanner moves in {parent!r}: its first pose there is used throughout"]
    return []
