"""Logs of any supported format, which is detected from the file."""

import zipfile
from collections.abc import Sequence
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from jaxslam.core.logs import DEFAULT_RANGE_MAX, LaserLog
from jaxslam.io import bag_files, carmen, g2o, npz, player, ros_bags
from jaxslam.io.assemble import LogOptions, assemble, check_options
from jaxslam.io.errors import InputError
from jaxslam.io.raw_log import RawLog
from jaxslam.io.text import lines

MAX_LINES_SEARCHED = 1000  # lines among which there must be one of a known format

_KEYWORDS = {b"VERTEX_SE2": g2o, b"EDGE_SE2": g2o, b"VERTEX_XY": g2o}
_KEYWORDS |= dict.fromkeys((*carmen.SCAN_KEYWORDS, b"ODOM", b"PARAM", b"RLASER"), carmen)


class NamedLog(NamedTuple):
    """A log that a Python package contains.

    Attributes:
        package: Name of the package, as imported.
        extra: Extra of this project that installs it.
        file: Path of the log in the package's folder, in parts.
    """

    package: str
    extra: str
    file: tuple[str, ...]


NAMED_LOGS = {"killian": NamedLog("rtbdata", "data", ("data", "killian.g2o.zip"))}


def read_log(
    path: str | PathLike,
    *,
    range_max: float = DEFAULT_RANGE_MAX,
    scan_topic: str | None = None,
    odometry_topic: str | None = None,
    mount: Sequence[float] | None = None,
    upside_down: bool = False,
    scan_frame: str | None = None,
    base_frame: str | None = None,
    odom_frame: str | None = None,
    angle_increment: float | None = None,
) -> LaserLog:
    """Read a log: CARMEN or Player log, ROS bag, g2o pose graph with scans, or NumPy file (`npz`).

    What had to be corrected or assumed is in `LaserLog.notes`.

    Args:
        path: The log, or the name of one of `NAMED_LOGS`.
        range_max: Range [m] from which on a reading counts as no return, unless the scanner's own
            is smaller.
        scan_topic: Topic of the laser scans in a bag.
        odometry_topic: Topic of the odometry or of the transforms in a bag.
        mount: Pose (x, y, yaw) [m, m, rad] of the scanner on the robot, instead of that by
            transforms or parameters of the log.
        upside_down: Whether the scanner is mounted upside down.
        scan_frame: Frame of the scans to read, if there are several scanners.
        base_frame: Frame of the robot, which the odometry moves.
        odom_frame: Frame of the odometry among the transforms.
        angle_increment: Step [rad] between beams, instead of that of the scans.

    Raises:
        InputError: `path` is no path, an option is impossible, the format of the log is unknown,
            topics are named for a log without topics, or the log cannot be read or assembled.
    """
    options = LogOptions(
        range_max, mount, upside_down, scan_frame, base_frame, odom_frame, angle_increment
    )
    check_options(options)
    path = find_log(path)
    reader = reader_of(path)
    raw: RawLog
    if reader is ros_bags:
        raw = ros_bags.read_raw(path, scan_topic=scan_topic, odometry_topic=odometry_topic)
    elif scan_topic is not None or odometry_topic is not None:
        raise InputError("has no topics", path=path, advice="name topics only for ROS bags")
    else:
        raw = reader.read_raw(path)
    return assemble(path, raw, options)


def find_log(path: str | PathLike) -> Path:
    """The path itself, or that of the log of this name in `NAMED_LOGS`, unless such a file exists.

    Raises:
        InputError: It is no path, or it is the name of a log in `NAMED_LOGS` and the package is not
            installed.
    """
    if not isinstance(path, str | PathLike):
        raise InputError(f"path is {path!r:.40}", advice="name a file, as text or pathlib.Path")
    name = str(path)
    if Path(path).exists() or name not in NAMED_LOGS:
        return Path(path)
    known = NAMED_LOGS[name]
    spec = find_spec(known.package)
    if spec is None or not spec.submodule_search_locations:
        problem = f"comes with the package {known.package}, which is not installed"
        raise InputError(problem, path=name, advice=f"pip install '.[{known.extra}]'")
    return Path(next(iter(spec.submodule_search_locations))).joinpath(*known.file)


def reader_of(path: Path) -> ModuleType:
    """The module that reads a log; its format is detected from the content.

    Raises:
        InputError: The file cannot be read, or has no line of a known format among the first
            `MAX_LINES_SEARCHED`.
    """
    if bag_files.is_bag(path):
        return ros_bags
    if path.is_file() and _is_npz(path):
        return npz
    for number, text in lines(path):
        keyword = text.split(maxsplit=1)[:1]
        if keyword and keyword[0] in _KEYWORDS:
            return _KEYWORDS[keyword[0]]
        if player.is_line(text):
            return player
        if number >= MAX_LINES_SEARCHED:
            break
    problem = "is a log of no known format"
    advice = "the formats are CARMEN and Player logs, ROS bags, g2o graphs with scans, NumPy files"
    raise InputError(problem, path=path, advice=advice)


def _is_npz(path: Path) -> bool:
    """Whether a file is a NumPy archive; False if it is damaged, so that another reader reports."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except Exception:  # zipfile does not document what damage raises
        return False
