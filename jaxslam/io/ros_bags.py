"""ROS 1 and ROS 2 bags, read by the library rosbags; ROS itself is not needed.

Scans are `sensor_msgs/LaserScan`. Odometry is `nav_msgs/Odometry` or, without such a topic, the
transform from `odom` to the robot in `/tf`. The pose of the scanner in the robot frame
(`base_link`) is taken from the transforms; without any, the scanner is at the origin of the
robot. The poses of the log are those of the scanner.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.logs import (
    DEFAULT_RANGE_MAX,
    DEFAULT_RANGE_STD,
    MAX_BROKEN_FRACTION,
    LaserLog,
    mark_no_return,
)
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose
from jaxslam.core.time_series import interpolate_poses
from jaxslam.io.errors import InputError, check_range_max
from jaxslam.io.ros_transforms import (
    Transform,
    add_transform,
    frame_name,
    mount_pose,
    odometry_of_transforms,
    planar_pose,
    seconds,
)
from jaxslam.io.text import with_progress

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"  # the latter in old bags


class Topics(NamedTuple):
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


class _Messages(NamedTuple):
    """Content of the messages of a bag."""

    scans: list[_Scan]  # those that are not broken
    broken: int  # number of broken scans
    scan_frame: str  # "" without scans
    base_frame: str  # frame of the robot; "" if unknown
    odometry: list[tuple[float, float, float, float]]  # t x y heading [s, m, m, rad] of the robot
    transforms: dict[str, Transform]  # by child frame


def is_bag(path: Path) -> bool:
    """Whether the name of a file, or the content of a folder, is that of a bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix in (".bag", ".db3", ".mcap")


def read(
    path: str | PathLike,
    *,
    range_max: float = DEFAULT_RANGE_MAX,
    scan_topic: str | None = None,
    odometry_topic: str | None = None,
) -> LaserLog:
    """Read a bag: a file of ROS 1, a folder of ROS 2, or one file of such a folder.

    Args:
        path: The bag.
        range_max: Range [m] from which on a reading counts as no return, unless the scanner's own
            range_max is smaller; so does a reading below the scanner's range_min.
        scan_topic: Topic of the laser scans; by default the one with most messages.
        odometry_topic: Topic of the odometry or of the transforms; by default the one with most
            messages.

    Raises:
        InputError: `range_max` is not positive, rosbags is not installed, the bag cannot be read or
            lacks scans or odometry, or more than 5 % of its scans are broken.
    """
    check_range_max(range_max, infinite=True)
    with _open_bag(Path(path)) as bag:
        chosen = _choose_topics(path, bag, scan_topic, odometry_topic)
        return _build_log(path, chosen, _read_messages(path, bag, chosen), range_max)


def topics(path: str | PathLike) -> Topics:
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
) -> Topics:
    """The requested topics; of those not requested, the topic with most messages."""
    types = {connection.topic: connection.msgtype for connection in bag.connections}
    counts: Counter[str] = Counter()
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

    return Topics(
        choose(scans, "scans", (SCAN,)),
        choose(odometry, "odometry", (ODOMETRY, *TRANSFORMS)),
    )


def _read_messages(path: str | PathLike, bag: Any, chosen: Topics) -> _Messages:
    """Read the chosen topics and all transforms."""
    scans: list[_Scan] = []
    odometry: list[tuple[float, float, float, float]] = []
    transforms: dict[str, Transform] = {}
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
    for connection, _, raw in with_progress(messages, Path(path), "message", count):
        message = bag.deserialize(raw, connection.msgtype)
        if connection.topic == chosen.scans:
            scan = _parse_scan(message)
            broken += scan is None
            if scan is not None:
                scans.append(scan)
                scan_frame = scan_frame or frame_name(message.header.frame_id)
        elif connection.msgtype == ODOMETRY:
            pose = message.pose.pose
            planar = planar_pose(pose.position, pose.orientation)
            base_frame = base_frame or frame_name(message.child_frame_id)
            if np.isfinite(planar).all():
                odometry.append((seconds(message.header.stamp), *planar))
        else:
            for transform in message.transforms:
                add_transform(transforms, transform)
    if not odometry:
        base_frame, odometry = odometry_of_transforms(path, transforms)
    return _Messages(scans, broken, scan_frame, base_frame, odometry, transforms)


def _build_log(
    path: str | PathLike, chosen: Topics, messages: _Messages, range_max: float
) -> LaserLog:
    """Interpolate the odometry at the scans; move it to the scanner; beams counter-clockwise."""
    scans, other_scanner = _with_first_scanner(messages.scans)
    stream = np.array(sorted(messages.odometry))
    inside = [scan for scan in scans if stream[0, 0] <= scan.time <= stream[-1, 0]]
    skipped = messages.broken + other_scanner + len(scans) - len(inside)
    total = len(inside) + skipped
    if not inside or skipped > MAX_BROKEN_FRACTION * total:
        problem = f"{skipped} of {total} scans are broken, or outside the time of {chosen.odometry}"
        raise InputError(problem, path=path, advice="compare their time stamps")
    mount, flipped = mount_pose(messages.transforms, messages.scan_frame, messages.base_frame)
    poses = compose(stream[:, 1:], mount)
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
    return LaserLog(
        times=times[order],
        odom_poses=interpolate_poses(times[order], stream[:, 0], poses),
        ranges=mark_no_return(ranges, range_max),
        lidar=Lidar(ranges.shape[1], angle_min, abs(angle_increment), range_max, DEFAULT_RANGE_STD),
        num_skipped=skipped,
        odom_stream_times=stream[:, 0],
        odom_stream_poses=poses,
        source=f", scans of {chosen.scans}, odometry of {chosen.odometry}",
    )


def _parse_scan(message: Any) -> _Scan | None:
    """The scan of a message; None if it is broken."""
    ranges = np.asarray(message.ranges, np.float64).copy()
    increment, range_max = float(message.angle_increment), float(message.range_max)
    metadata = float(message.angle_min), increment, range_max
    if ranges.size < 2 or not np.isfinite(metadata).all() or increment == 0.0 or range_max <= 0.0:
        return None
    ranges[~(ranges >= max(float(message.range_min), 0.0))] = np.inf
    return _Scan(seconds(message.header.stamp), metadata[0], increment, range_max, ranges)


def _with_first_scanner(scans: list[_Scan]) -> tuple[list[_Scan], int]:
    """Scans with the metadata of the first, and the number of the others."""
    if not scans:
        return scans, 0

    def metadata(scan: _Scan) -> tuple[float, ...]:
        return scan.angle_min, scan.angle_increment, scan.range_max, scan.ranges.size

    same = [scan for scan in scans if metadata(scan) == metadata(scans[0])]
    return same, len(scans) - len(same)
