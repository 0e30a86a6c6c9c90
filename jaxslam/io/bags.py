"""ROS 1 and ROS 2 bags, read by the library rosbags; ROS itself is not needed.

Scans are `sensor_msgs/LaserScan`. Odometry is `nav_msgs/Odometry` or, without such a topic, the
transform from `odom` to the robot in `/tf`. The pose of the scanner in the robot frame
(`base_link`) is taken from the transforms; without any, the scanner is at the origin of the robot.
The poses of the log are those of the scanner.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.recording import NOISE, REACH, TOLERATED, Recording, no_return
from jaxslam.io.text import shown
from jaxslam.lidar import Lidar
from jaxslam.poses import composed, interpolate

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"  # the latter in old bags
FIXED = "odom"  # frame of the odometry
CHAIN = 32  # transforms between two frames at most


class Choice(NamedTuple):
    """Topics that a log is read from.

    Attributes:
        scans: Topic of the laser scans.
        odometry: Topic of the odometry or of the transforms.
    """

    scans: str
    odometry: str


class _Scan(NamedTuple):
    """One `LaserScan` message."""

    time: float  # [s]
    angle_min: float  # [rad]
    angle_increment: float  # [rad]
    range_max: float  # [m]
    ranges: np.ndarray  # (R,) float64 [m], infinite where below the scanner's range_min


class _Transform(NamedTuple):
    """The pose of a frame in its parent frame over time."""

    parent: str
    times: list[float]  # [s]
    values: list[tuple[float, ...]]  # translation x y z [m], quaternion x y z w


class _Messages(NamedTuple):
    """Content of the messages of a bag."""

    scans: list[_Scan]  # those that are not broken
    broken: int  # number of broken scans
    scan_frame: str  # "" without scans
    base_frame: str  # frame of the robot; "" if unknown
    odometry: list[tuple[float, float, float, float]]  # t x y heading [s, m, m, rad] of the robot
    transforms: dict[str, _Transform]  # by child frame


def is_bag(path: Path) -> bool:
    """Whether the name of a file, or the content of a folder, is that of a bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix in (".bag", ".db3", ".mcap")


def read(
    path: str | PathLike,
    *,
    reach: float = REACH,
    scans: str | None = None,
    odometry: str | None = None,
) -> Recording:
    """Read a bag: a file of ROS 1, a folder of ROS 2, or one file of such a folder.

    Args:
        path: The bag.
        reach: Range [m] from which on a reading counts as no return, unless the scanner's own
            range_max is smaller; so does a reading below the scanner's range_min.
        scans: Topic of the laser scans; by default the one with most messages.
        odometry: Topic of the odometry or of the transforms; by default the one with most messages.

    Raises:
        InputError: rosbags is not installed, the bag cannot be read or lacks scans or odometry, or
            more than 5 % of its scans are broken.
    """
    with _open_bag(Path(path)) as bag:
        chosen = _choose_topics(path, bag, scans, odometry)
        return _build_log(path, chosen, _read_messages(path, bag, chosen), reach)


def topics(path: str | PathLike) -> Choice:
    """The topics that `read` uses by default.

    Raises:
        InputError: As `read`.
    """
    with _open_bag(Path(path)) as bag:
        return _choose_topics(path, bag, None, None)


@contextmanager
def _open_bag(path: Path) -> Iterator[Any]:
    """Open a bag; any error while it is read becomes an InputError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        advice = "pip install '.[ros]'"
        raise InputError("is a ROS bag, which needs rosbags", path=path, advice=advice) from None
    bag_path = path.parent if path.suffix in (".db3", ".mcap") else path
    if not bag_path.exists():
        raise InputError("does not exist", path=path, advice="check the name")
    try:
        with AnyReader([bag_path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            yield bag
    except InputError:
        raise
    except Exception as error:  # rosbags does not document what a damaged bag raises
        reason = " ".join(str(error).split())[:200]
        problem = f"is a bag that cannot be read ({type(error).__name__}: {reason})"
        raise InputError(problem, path=path, advice="copy it again, or reindex it") from None


def _choose_topics(
    path: str | PathLike, bag: Any, scans: str | None, odometry: str | None
) -> Choice:
    """The requested topics; of those not requested, the topic with most messages."""
    types = {connection.topic: connection.msgtype for connection in bag.connections}
    counts = Counter()
    for connection in bag.connections:
        counts[connection.topic] += connection.msgcount

    def choose(requested: str | None, field: str, allowed: tuple[str, ...]) -> str:
        usable = {name: kind for name, kind in types.items() if kind in allowed and counts[name]}
        if requested is not None and requested not in usable:
            problem = f"there is no {allowed[0]} in {requested!r}"
            advice = f"topics of that type: {', '.join(sorted(usable)) or 'none'}"
            raise InputError(problem, path=path, field=field, advice=advice)
        if not usable:
            names = " or ".join(allowed)
            listed = ", ".join(sorted(types)) or "none"
            advice = f"name another bag; its topics are: {listed}"
            raise InputError(f"has no {names}", path=path, advice=advice)
        preferred = min(allowed.index(kind) for kind in usable.values())
        best = [name for name, kind in usable.items() if allowed.index(kind) == preferred]
        return requested or max(sorted(best), key=counts.__getitem__)

    return Choice(
        choose(scans, "scans", (SCAN,)),
        choose(odometry, "odometry", (ODOMETRY, *TRANSFORMS)),
    )


def _read_messages(path: str | PathLike, bag: Any, chosen: Choice) -> _Messages:
    """Read the chosen topics and all transforms."""
    scans: list[_Scan] = []
    odometry: list[tuple[float, float, float, float]] = []
    transforms: dict[str, _Transform] = {}
    scan_frame, base_frame = "", ""
    broken = 0
    connections = [
        connection
        for connection in bag.connections
        if connection.topic in chosen
        or (connection.msgtype in TRANSFORMS and "tf" in connection.topic)
    ]
    count = sum(connection.msgcount for connection in connections)
    messages = bag.messages(connections=connections)
    for connection, _, raw in shown(messages, Path(path), "message", count):
        message = bag.deserialize(raw, connection.msgtype)
        if connection.topic == chosen.scans:
            scan = _parse_scan(message)
            broken += scan is None
            if scan is not None:
                scans.append(scan)
                scan_frame = scan_frame or _frame_name(message.header.frame_id)
        elif connection.msgtype == ODOMETRY:
            pose = message.pose.pose
            planar = _planar_pose(pose.position, pose.orientation)
            base_frame = base_frame or _frame_name(message.child_frame_id)
            if np.isfinite(planar).all():
                odometry.append((_seconds(message.header.stamp), *planar))
        else:
            for transform in message.transforms:
                _add_transform(transforms, transform)
    if not odometry:
        base_frame, odometry = _odometry_of_transforms(path, transforms)
    return _Messages(scans, broken, scan_frame, base_frame, odometry, transforms)


def _build_log(
    path: str | PathLike, chosen: Choice, messages: _Messages, range_max: float
) -> Recording:
    """Interpolate the odometry at the scans; move it to the scanner; beams counter-clockwise."""
    scans, other_scanner = _with_first_scanner(messages.scans)
    stream = np.array(sorted(messages.odometry))
    inside = [scan for scan in scans if stream[0, 0] <= scan.time <= stream[-1, 0]]
    skipped = messages.broken + other_scanner + len(scans) - len(inside)
    total = len(inside) + skipped
    if not inside or skipped > TOLERATED * total:
        problem = f"{skipped} of {total} scans are broken, or outside the time of {chosen.odometry}"
        raise InputError(problem, path=path, advice="compare their time stamps")
    mount, flipped = _mount_pose(messages.transforms, messages.scan_frame, messages.base_frame)
    poses = composed(stream[:, 1:], mount)
    times = np.array([scan.time for scan in inside])
    order = np.argsort(times, kind="stable")
    ranges = np.array([inside[index].ranges for index in order])
    first = inside[0]
    angle_min, angle_increment = first.angle_min, first.angle_increment
    if (angle_increment < 0.0) != flipped:  # the beams are clockwise in the robot frame
        ranges = ranges[:, ::-1]
        angle_min = angle_min + angle_increment * (ranges.shape[1] - 1)
    if flipped:
        angle_min = -angle_min
    range_max = min(range_max, first.range_max)
    return Recording(
        times=times[order],
        odometry=interpolate(times[order], stream[:, 0], poses),
        ranges=no_return(ranges, range_max),
        lidar=Lidar(ranges.shape[1], angle_min, abs(angle_increment), range_max, NOISE),
        skipped=skipped,
        wheel_times=stream[:, 0],
        wheel_poses=poses,
        source=f", scans of {chosen.scans}, odometry of {chosen.odometry}",
    )


def _seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def _frame_name(frame: str) -> str:
    return frame.removeprefix("/")


def _parse_scan(message: Any) -> _Scan | None:
    """The scan of a message; None if it is broken."""
    ranges = np.asarray(message.ranges, np.float64).copy()
    increment, range_max = float(message.angle_increment), float(message.range_max)
    metadata = float(message.angle_min), increment, range_max
    if ranges.size < 2 or not np.isfinite(metadata).all() or increment == 0.0 or range_max <= 0.0:
        return None
    ranges[~(ranges >= max(float(message.range_min), 0.0))] = np.inf
    return _Scan(_seconds(message.header.stamp), metadata[0], increment, range_max, ranges)


def _with_first_scanner(scans: list[_Scan]) -> tuple[list[_Scan], int]:
    """Scans with the metadata of the first, and the number of the others."""
    if not scans:
        return scans, 0

    def metadata(scan: _Scan) -> tuple[float, ...]:
        return scan.angle_min, scan.angle_increment, scan.range_max, scan.ranges.size

    same = [scan for scan in scans if metadata(scan) == metadata(scans[0])]
    return same, len(scans) - len(same)


def _planar_pose(position: Any, rotation: Any) -> tuple[float, float, float]:
    """Pose in the plane of a position and a quaternion."""
    heading = np.arctan2(
        2 * (rotation.w * rotation.z + rotation.x * rotation.y),
        1 - 2 * (rotation.y**2 + rotation.z**2),
    )
    return float(position.x), float(position.y), float(heading)


def _add_transform(transforms: dict[str, _Transform], message: Any) -> None:
    """Add a `TransformStamped`; one that is not finite or has a second parent is skipped."""
    position, rotation = message.transform.translation, message.transform.rotation
    values = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    if not np.isfinite(values).all():
        return
    child, parent = _frame_name(message.child_frame_id), _frame_name(message.header.frame_id)
    transform = transforms.setdefault(child, _Transform(parent, [], []))
    if transform.parent == parent:
        transform.times.append(_seconds(message.header.stamp))
        transform.values.append(values)


class _Vector(NamedTuple):
    """A position, or a quaternion."""

    x: float
    y: float
    z: float
    w: float = 0.0


def _odometry_of_transforms(
    path: str | PathLike, transforms: dict[str, _Transform]
) -> tuple[str, list[tuple[float, float, float, float]]]:
    """The robot frame, and its times and poses in the odometry frame."""
    for child, transform in transforms.items():
        if transform.parent == FIXED:
            poses = [_planar_pose(_Vector(*v[:3]), _Vector(*v[3:])) for v in transform.values]
            stamped = zip(transform.times, poses, strict=True)
            return child, [(time, *pose) for time, pose in stamped]
    advice = "name a bag with odometry, or with the transform of the robot in `odom`"
    raise InputError(f"has no transform from {FIXED!r}", path=path, advice=advice)


def _mount_pose(
    transforms: dict[str, _Transform], scan_frame: str, base_frame: str
) -> tuple[np.ndarray, bool]:
    """Pose (3,) of the scanner in the robot frame, and whether it is mounted upside down."""
    position, rotation = np.zeros(3), np.eye(3)
    frame = scan_frame
    for _ in range(CHAIN):
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
