"""Logs of any supported format, which is detected from the file."""

import zipfile
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from jaxslam.core.logs import DEFAULT_RANGE_MAX, LaserLog
from jaxslam.io import carmen, g2o, npz, ros_bags
from jaxslam.io.errors import InputError, check_range_max
from jaxslam.io.text import lines

MAX_LINES_SEARCHED = 1000  # lines among which there must be one of a known format

_KEYWORDS = {b"VERTEX_SE2": g2o, b"EDGE_SE2": g2o, b"VERTEX_XY": g2o}
_KEYWORDS |= dict.fromkeys((b"FLASER", b"ODOM", b"ROBOTLASER1", b"PARAM", b"RLASER"), carmen)


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
) -> LaserLog:
    """Read a log: CARMEN log, ROS bag, g2o pose graph with scans, or NumPy file (`npz`).

    Args:
        path: The log, or the name of one of `NAMED_LOGS`.
        range_max: Range [m] from which on a reading counts as no return.
        scan_topic: Topic of the laser scans in a bag.
        odometry_topic: Topic of the odometry or of the transforms in a bag.

    Raises:
        InputError: `path` is no path, `range_max` is not positive, the format of the log is
            unknown, topics are named for a log without topics, or the reader of the format raises
            it.
    """
    check_range_max(range_max, infinite=True)
    path = find_log(path)
    reader = reader_of(path)
    if reader is ros_bags:
        return ros_bags.read(
            path, range_max=range_max, scan_topic=scan_topic, odometry_topic=odometry_topic
        )
    if scan_topic is not None or odometry_topic is not None:
        raise InputError("has no topics", path=path, advice="name topics only for ROS bags")
    return reader.read(path, range_max=range_max)


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
    if ros_bags.is_bag(path):
        return ros_bags
    if path.is_file() and _is_npz(path):
        return npz
    for number, text in lines(path):
        keyword = text.split(maxsplit=1)[:1]
        if keyword and keyword[0] in _KEYWORDS:
            return _KEYWORDS[keyword[0]]
        if number >= MAX_LINES_SEARCHED:
            break
    problem = "is a log of no known format"
    advice = "the formats are CARMEN logs, ROS bags, g2o pose graphs with scans, NumPy files"
    raise InputError(problem, path=path, advice=advice)


def _is_npz(path: Path) -> bool:
    """Whether a file is a NumPy archive; False if it is damaged, so that another reader reports."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except Exception:  # zipfile does not document what damage raises
        return False
