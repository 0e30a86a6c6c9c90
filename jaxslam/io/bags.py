"""Bags of ROS 1 and ROS 2, by the library rosbags: no ROS is needed.

Scans are `sensor_msgs/LaserScan`. Poses of the wheels are `nav_msgs/Odometry` or, where there is
none, the transform from `odom` in `/tf`. Where the scanner sits on the robot is looked up in the
transforms; without any it is the robot's origin. The poses of the recording are the scanner's.
"""

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
FIXED = "odom"  # frame in which wheels count
CHAIN = 32  # transforms between two frames at most


class Choice(NamedTuple):
    """Where the scans and the poses of a bag come from."""

    scans: str  # topic
    odometry: str  # topic


class _Scan(NamedTuple):
    time: float  # [s]
    first: float  # [rad]
    step: float  # [rad]
    reach: float  # [m]
    ranges: np.ndarray  # (R,) float64 [m]


class _Link(NamedTuple):
    """How a frame sits in its parent, over time."""

    parent: str
    times: list[float]  # [s]
    moves: list[tuple[float, ...]]  # x y z [m], and the quaternion x y z w


def is_bag(path: Path) -> bool:
    """Whether a file or folder is called as bags are."""
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
        reach: Range [m] from which on a reading counts as no return, if the scanner's is not
            smaller; so does one below the scanner's least range.
        scans: Topic of the laser scans; that with most of them unless given.
        odometry: Topic of the odometry, or of the transforms; likewise.

    Raises:
        InputError: rosbags is not installed, the bag cannot be read or lacks scans or odometry, or
            more than 5 % of its scans are broken.
    """
    with _opened(Path(path)) as bag:
        chosen = _choose(path, bag, scans, odometry)
        return _recording(path, bag, chosen, reach)


def topics(path: str | PathLike) -> Choice:
    """What `read` takes of a bag unless told.

    Raises:
        InputError: As `read`.
    """
    with _opened(Path(path)) as bag:
        return _choose(path, bag, None, None)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The bag; whatever a broken one raises while it is read is told in one line."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        advice = "pip install '.[ros]'"
        raise InputError("is a ROS bag, which needs rosbags", path=path, advice=advice) from None
    whole = path.parent if path.suffix in (".db3", ".mcap") else path
    if not whole.exists():
        raise InputError("does not exist", path=path, advice="check the name")
    try:
        with AnyReader([whole], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            yield bag
    except InputError:
        raise
    except Exception as error:  # what damage raises in the readers of bags is listed nowhere
        said = " ".join(str(error).split())[:200]
        problem = f"is a bag that cannot be read ({type(error).__name__}: {said})"
        raise InputError(problem, path=path, advice="copy it again, or reindex it") from None


def _choose(path: str | PathLike, bag: Any, scans: str | None, odometry: str | None) -> Choice:
    """Topics of a bag."""
    kinds = {one.topic: one.msgtype for one in bag.connections}
    count = lambda topic: sum(one.msgcount for one in bag.connections if one.topic == topic)

    def pick(wanted: str | None, field: str, *allowed: str) -> str:
        known = {topic: kind for topic, kind in kinds.items() if kind in allowed and count(topic)}
        told = f"topics of that kind: {', '.join(sorted(known)) or 'none'}"
        if wanted is not None and wanted not in known:
            problem = f"there is no {allowed[0]} in {wanted!r}"
            raise InputError(problem, path=path, field=field, advice=told)
        if not known:
            names = " or ".join(allowed)
            listed = ", ".join(sorted(kinds)) or "none"
            advice = f"name another bag; its topics are: {listed}"
            raise InputError(f"has no {names}", path=path, advice=advice)
        first = min(allowed.index(kind) for kind in known.values())
        best = [topic for topic, kind in known.items() if allowed.index(kind) == first]
        return wanted or max(sorted(best), key=count)

    return Choice(pick(scans, "scans", SCAN), pick(odometry, "odometry", ODOMETRY, *TRANSFORMS))


def _recording(path: str | PathLike, bag: Any, chosen: Choice, reach: float) -> Recording:
    kept: list[_Scan] = []
    frame, base = "", ""
    wheels: list[tuple[float, float, float, float]] = []
    links: dict[str, _Link] = {}
    broken = 0
    wanted = [
        one
        for one in bag.connections
        if one.topic in chosen or (one.msgtype in TRANSFORMS and "tf" in one.topic)
    ]
    count = sum(one.msgcount for one in wanted)
    messages = bag.messages(connections=wanted)
    for connection, _, raw in shown(messages, Path(path), "message", count):
        message = bag.deserialize(raw, connection.msgtype)
        if connection.topic == chosen.scans:
            one = _scan(message, reach)
            broken += one is None
            if one is not None:
                kept.append(one)
                frame = frame or _plain(message.header.frame_id)
        elif connection.msgtype == ODOMETRY:
            pose = message.pose.pose
            moved = _flat(pose.position, pose.orientation)
            base = base or _plain(message.child_frame_id)
            if np.isfinite(moved).all():
                wheels.append((_seconds(message.header.stamp), *moved))
        else:
            for one in message.transforms:
                _note(links, one)
    if not wheels:
        base, wheels = _from_links(path, links)
    kept, odd = _alike(kept)
    stream = np.array(sorted(wheels))
    inside = [one for one in kept if stream[0, 0] <= one.time <= stream[-1, 0]]
    left = broken + odd + len(kept) - len(inside)
    total = len(inside) + left
    if not inside or left > TOLERATED * total:
        problem = f"{left} of {total} scans are broken, or outside the time of {chosen.odometry}"
        raise InputError(problem, path=path, advice="compare their time stamps")
    mount, flipped = _mount(links, frame, base)
    poses = composed(stream[:, 1:], mount)
    times = np.array([one.time for one in inside])
    order = np.argsort(times, kind="stable")
    ranges = np.array([inside[i].ranges for i in order])
    first = inside[0]
    start, step = first.first, first.step
    if (step < 0.0) != flipped:  # beams from right to left as the robot sees it
        ranges, start = ranges[:, ::-1], start + step * (ranges.shape[1] - 1)
    if flipped:
        start = -start
    reach = min(reach, first.reach)
    return Recording(
        times=times[order],
        odometry=interpolate(times[order], stream[:, 0], poses),
        ranges=no_return(ranges, reach),
        lidar=Lidar(ranges.shape[1], start, abs(step), reach, NOISE),
        skipped=left,
        wheel_times=stream[:, 0],
        wheel_poses=poses,
        source=f", scans of {chosen.scans}, odometry of {chosen.odometry}",
    )


def _seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def _plain(frame: str) -> str:
    return frame.removeprefix("/")


def _scan(message: Any, reach: float) -> _Scan | None:
    """A scan; None if it is broken."""
    ranges = np.asarray(message.ranges, np.float64).copy()
    step, most = float(message.angle_increment), float(message.range_max)
    numbers = float(message.angle_min), step, most
    if ranges.size < 2 or not np.isfinite(numbers).all() or step == 0.0 or most <= 0.0:
        return None
    ranges[~(ranges >= max(float(message.range_min), 0.0))] = np.inf
    return _Scan(_seconds(message.header.stamp), numbers[0], step, most, ranges)


def _alike(scans: list[_Scan]) -> tuple[list[_Scan], int]:
    """Scans with the scanner of the first, and how many have another one."""
    if not scans:
        return scans, 0
    scanner = lambda one: (one.first, one.step, one.reach, one.ranges.size)
    same = [one for one in scans if scanner(one) == scanner(scans[0])]
    return same, len(scans) - len(same)


def _flat(position: Any, turn: Any) -> tuple[float, float, float]:
    """Pose in the plane of a position and a quaternion."""
    heading = np.arctan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
    return float(position.x), float(position.y), float(heading)


def _note(links: dict[str, _Link], one: Any) -> None:
    """Add a transform to those known."""
    move, turn = one.transform.translation, one.transform.rotation
    values = (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
    if not np.isfinite(values).all():
        return
    child, parent = _plain(one.child_frame_id), _plain(one.header.frame_id)
    link = links.setdefault(child, _Link(parent, [], []))
    if link.parent == parent:
        link.times.append(_seconds(one.header.stamp))
        link.moves.append(values)


class _Vector(NamedTuple):
    x: float
    y: float
    z: float
    w: float = 0.0


def _from_links(
    path: str | PathLike, links: dict[str, _Link]
) -> tuple[str, list[tuple[float, float, float, float]]]:
    """The robot's frame and its poses over time, from the transforms."""
    for child, link in links.items():
        if link.parent == FIXED:
            poses = [_flat(_Vector(*m[:3]), _Vector(*m[3:])) for m in link.moves]
            return child, [(t, *pose) for t, pose in zip(link.times, poses, strict=True)]
    advice = "name a bag with odometry, or with the transform of the robot in `odom`"
    raise InputError(f"has no transform from {FIXED!r}", path=path, advice=advice)


def _mount(links: dict[str, _Link], frame: str, base: str) -> tuple[np.ndarray, bool]:
    """Pose (3,) of the scanner on the robot, and whether it hangs upside down."""
    place, turn = np.zeros(3), np.eye(3)
    for _ in range(CHAIN):
        if frame == base or frame not in links:
            break
        link = links[frame]
        x, y, z, qx, qy, qz, qw = link.moves[0]
        turned_by = _matrix(qx, qy, qz, qw)
        place, turn = np.array([x, y, z]) + turned_by @ place, turned_by @ turn
        frame = link.parent
    if frame != base:
        return np.zeros(3), False
    return np.array([*place[:2], np.arctan2(turn[1, 0], turn[0, 0])]), bool(turn[2, 2] < 0.0)


def _matrix(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Rotation (3, 3) of a quaternion, of whatever length."""
    x, y, z, w = np.array([x, y, z, w]) / (np.linalg.norm([x, y, z, w]) or 1.0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
