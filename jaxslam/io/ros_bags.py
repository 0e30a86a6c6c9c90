"""ROS 1 and ROS 2 bags, read by the library rosbags; ROS itself is not needed.

Scans are `sensor_msgs/LaserScan` or `sensor_msgs/MultiEchoLaserScan`, of which the first echo is
taken. Odometry is `nav_msgs/Odometry` or, without such a topic, the transform from `odom` to the
robot in `/tf`. The poses of the log are those of the scanner.
"""

import math
from collections import Counter
from collections.abc import Iterator
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.logs import DEFAULT_RANGE_MAX, MAX_BROKEN_FRACTION, LaserLog
from jaxslam.io.assemble import read_assembled
from jaxslam.io.bag_files import open_bag
from jaxslam.io.errors import InputError
from jaxslam.io.mounts import frame_name
from jaxslam.io.quaternions import headings
from jaxslam.io.raw_log import RawLog, RawOdometry, RawScan, RawTransform, as_odometry
from jaxslam.io.text import with_progress

SCAN, MULTI_ECHO = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"  # the latter in old bags


class Topics(NamedTuple):
    """Topics that a log is read from.

    Attributes:
        scans: Topic of the laser scans.
        odometry: Topic of the odometry or of the transforms; "" if there is neither.
    """

    scans: str
    odometry: str


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
            lacks scans, more than 5 % of its scans are broken, or as `assemble`.
    """
    of_topics = partial(read_raw, scan_topic=scan_topic, odometry_topic=odometry_topic)
    return read_assembled(path, of_topics, range_max=range_max)


def read_raw(
    path: str | PathLike,
    *,
    scan_topic: str | None = None,
    odometry_topic: str | None = None,
) -> RawLog:
    """Scans, odometry and transforms of a bag, in order of their reception.

    Args:
        path: The bag.
        scan_topic: As for `read`.
        odometry_topic: As for `read`.

    Raises:
        InputError: As `read`.
    """
    with open_bag(Path(path)) as bag:
        chosen, notes = _choose_topics(path, bag, scan_topic, odometry_topic)
        return _read_messages(path, bag, chosen, notes)


def topics(path: str | PathLike) -> Topics:
    """The topics that `read` uses by default.

    Raises:
        InputError: As `read`.
    """
    with open_bag(Path(path)) as bag:
        return _choose_topics(path, bag, None, None)[0]


def _choose_topics(
    path: str | PathLike, bag: Any, scans: str | None, odometry: str | None
) -> tuple[Topics, list[str]]:
    """The requested topics; of those not requested, the topic with most messages; and notes."""
    types = {connection.topic: connection.msgtype for connection in bag.connections}
    counts: Counter[str] = Counter()
    for connection in bag.connections:
        counts[connection.topic] += connection.msgcount

    def usable(*allowed: str) -> list[str]:
        names = [name for name, kind in types.items() if kind in allowed and counts[name]]
        return sorted(names, key=lambda name: (-counts[name], name))

    def choose(requested: str | None, field: str, names: list[str], kind: str) -> str:
        if requested is not None and requested not in names:
            problem = f"there is no {kind} in {requested!r}"
            advice = f"topics of that type: {', '.join(sorted(names)) or 'none'}"
            raise InputError(problem, path=path, field=field, advice=advice)
        return requested or next(iter(names), "")

    scan_topics = usable(SCAN) + usable(MULTI_ECHO)
    chosen = Topics(
        choose(scans, "scans", scan_topics, SCAN),
        choose(odometry, "odometry", usable(ODOMETRY) + usable(*TRANSFORMS), ODOMETRY),
    )
    if not chosen.scans:
        listed = ", ".join(sorted(types)) or "none"
        advice = f"name another bag; its topics are: {listed}"
        raise InputError(f"has no {SCAN}", path=path, advice=advice)
    others = [f"{name} ({counts[name]})" for name in scan_topics if name != chosen.scans]
    if scans is not None or not others:
        return chosen, []
    note = f"scans of {chosen.scans} are used, not of {', '.join(others)}; --scan-topic chooses"
    return chosen, [note]


def _read_messages(path: str | PathLike, bag: Any, chosen: Topics, notes: list[str]) -> RawLog:
    """Read the chosen topics and all transforms."""
    scans: list[RawScan] = []
    rows: list[tuple[float, ...]] = []
    transforms: dict[tuple[str, str], RawTransform] = {}
    base_frame, broken = "", 0
    for order, received, kind, message in _messages(path, bag, chosen):
        if kind in (SCAN, MULTI_ECHO):
            scan = _parse_scan(message, received, order)
            broken += scan is None
            if scan is not None:
                scans.append(scan)
        elif kind == ODOMETRY:
            rows.append(
                (_seconds(message.header.stamp), received, order, *_pose(message.pose.pose))
            )
            base_frame = base_frame or frame_name(message.child_frame_id)
        else:
            for one in message.transforms:
                _add_transform(transforms, one, received, order)
    total = len(scans) + broken
    if broken > MAX_BROKEN_FRACTION * total:
        problem = f"{broken} of {total} scans of {chosen.scans} are broken"
        advice = "their angles are not numbers, or they have fewer than two beams"
        raise InputError(problem, path=path, advice=advice)
    odometry, more = _as_odometry(rows)
    return RawLog(
        scans=scans,
        odometry=odometry,
        base_frame=base_frame,
        transforms=transforms,
        names_frames=True,
        source=f", scans of {chosen.scans}, odometry of {chosen.odometry or 'none'}",
        num_skipped=broken,
        notes=(*notes, *more),
    )


def _messages(
    path: str | PathLike, bag: Any, chosen: Topics
) -> Iterator[tuple[int, float, str, Any]]:
    """Place, time of reception [s], type and content of each message of interest."""
    connections = [
        connection
        for connection in bag.connections
        if connection.topic in chosen or connection.msgtype in TRANSFORMS
    ]
    count = sum(connection.msgcount for connection in connections)
    messages = with_progress(bag.messages(connections=connections), Path(path), "message", count)
    for order, (connection, received, raw) in enumerate(messages):
        kind = connection.msgtype
        yield order, 1e-9 * received, kind, bag.deserialize(raw, kind)


def _seconds(stamp: Any) -> float:
    """Seconds of a ROS time stamp."""
    return stamp.sec + 1e-9 * stamp.nanosec


def _pose(pose: Any) -> tuple[float, ...]:
    """Position x y [m] and quaternion x y z w of a `geometry_msgs/Pose`."""
    position, turn = pose.position, pose.orientation
    return position.x, position.y, turn.x, turn.y, turn.z, turn.w


def _as_odometry(rows: list[tuple[float, ...]]) -> tuple[RawOdometry, list[str]]:
    """Odometry of rows (own, received, order, x, y, quaternion), and notes on the quaternions."""
    finite = [row for row in rows if all(map(math.isfinite, row))]
    if not finite:
        return as_odometry([]), []
    table = np.array(finite)
    heading, valid, notes = headings(table[:, 5:])
    poses = np.column_stack([table[:, :5], heading])[valid]
    return as_odometry(list(map(tuple, poses))), notes


def _add_transform(
    transforms: dict[tuple[str, str], RawTransform], message: Any, received: float, order: int
) -> None:
    """Add a `TransformStamped`; one that is not finite is skipped."""
    position, turn = message.transform.translation, message.transform.rotation
    values = (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w)
    if not all(map(math.isfinite, values)):
        return
    pair = frame_name(message.header.frame_id), frame_name(message.child_frame_id)
    transform = transforms.setdefault(pair, RawTransform(*pair, [], []))
    transform.stamps.append((_seconds(message.header.stamp), received, order))
    transform.values.append(values)


def _parse_scan(message: Any, received: float, order: int) -> RawScan | None:
    """The scan of a message; None if it is broken."""
    ranges = _first_echoes(message.ranges)
    first, step = float(message.angle_min), float(message.angle_increment)
    if ranges.size < 2 or not math.isfinite(first):
        return None
    if not math.isfinite(step) or step == 0.0:
        step = (float(message.angle_max) - first) / (ranges.size - 1)
    if not 0.0 < abs(step) <= math.pi:
        return None
    range_max, range_min = float(message.range_max), float(message.range_min)
    range_max = range_max if range_max > 0.0 else math.inf  # 0 and NaN: not stated
    ranges[~(ranges >= (range_min if range_min > 0.0 else 0.0))] = np.inf
    ranges[ranges >= range_max] = np.inf
    frame = frame_name(message.header.frame_id)
    time = _seconds(message.header.stamp)
    return RawScan(time, received, order, frame, first, step, range_max, ranges)


def _first_echoes(ranges: Any) -> np.ndarray:
    """Ranges (R,) float64 [m] of a scan; of several echoes the first."""
    if len(ranges) and hasattr(ranges[0], "echoes"):
        ranges = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in ranges]
    return np.array(ranges, np.float64)
