"""Logs of any supported format, which is detected from the file."""

import zipfile
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from jaxslam.io import bags, carmen, g2o, npz
from jaxslam.io.errors import InputError
from jaxslam.io.recording import REACH, Recording
from jaxslam.io.text import lines

LOOK = 1000  # lines within which the first of a known format must come

_KEYWORDS = {b"VERTEX_SE2": g2o, b"EDGE_SE2": g2o, b"VERTEX_XY": g2o}
_KEYWORDS |= dict.fromkeys((b"FLASER", b"ODOM", b"ROBOTLASER1", b"PARAM", b"RLASER"), carmen)


class Known(NamedTuple):
    """A log that a Python package contains.

    Attributes:
        package: Name of the package, as imported.
        extra: Extra of this project that installs it.
        file: Path of the log in the package's folder, in parts.
    """

    package: str
    extra: str
    file: tuple[str, ...]


KNOWN = {"killian": Known("rtbdata", "data", ("data", "killian.g2o.zip"))}


def read(
    path: str | PathLike,
    *,
    reach: float = REACH,
    scans: str | None = None,
    odometry: str | None = None,
) -> Recording:
    """Read a log: CARMEN log, ROS bag, g2o pose graph with scans, or NumPy file (`npz`).

    Args:
        path: The log, or the name of one of `KNOWN`.
        reach: Range [m] from which on a reading counts as no return.
        scans: Topic of the laser scans in a bag.
        odometry: Topic of the odometry or of the transforms in a bag.

    Raises:
        InputError: The format of the log is unknown, topics are named for a log without topics, or
            the reader of the format raises it.
    """
    path = find(path)
    reader = reader_of(path)
    if reader is bags:
        return bags.read(path, reach=reach, scans=scans, odometry=odometry)
    if scans is not None or odometry is not None:
        raise InputError("has no topics", path=path, advice="name topics only for ROS bags")
    return reader.read(path, reach=reach)


def find(path: str | PathLike) -> Path:
    """The path itself, or that of the log of this name in `KNOWN`, unless such a file exists.

    Raises:
        InputError: It is the name of a log in `KNOWN`, and the package is not installed.
    """
    name = str(path)
    if Path(path).exists() or name not in KNOWN:
        return Path(path)
    known = KNOWN[name]
    spec = find_spec(known.package)
    if spec is None or not spec.submodule_search_locations:
        problem = f"comes with the package {known.package}, which is not installed"
        raise InputError(problem, path=name, advice=f"pip install '.[{known.extra}]'")
    return Path(next(iter(spec.submodule_search_locations))).joinpath(*known.file)


def reader_of(path: Path) -> ModuleType:
    """The module that reads a log; its format is detected from the content.

    Raises:
        InputError: The file cannot be read, or has no line of a known format among the first
            `LOOK`.
    """
    if bags.is_bag(path):
        return bags
    if path.is_file() and _is_npz(path):
        return npz
    for number, text in lines(path):
        keyword = text.split(maxsplit=1)[:1]
        if keyword and keyword[0] in _KEYWORDS:
            return _KEYWORDS[keyword[0]]
        if number >= LOOK:
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
