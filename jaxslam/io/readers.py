"""Recorded logs of any form: which it is, the file itself tells."""

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

LOOK = 1000  # lines in which the first of a known kind must come

_WORDS = {b"VERTEX_SE2": g2o, b"EDGE_SE2": g2o, b"VERTEX_XY": g2o}
_WORDS |= dict.fromkeys((b"FLASER", b"ODOM", b"ROBOTLASER1", b"PARAM", b"RLASER"), carmen)


class Known(NamedTuple):
    """A log that a package brings."""

    package: str  # that is imported for it
    extra: str  # of this project that installs it
    file: tuple[str, ...]  # in the package's folder


KNOWN = {"killian": Known("rtbdata", "data", ("data", "killian.g2o.zip"))}


def read(
    path: str | PathLike,
    *,
    reach: float = REACH,
    scans: str | None = None,
    odometry: str | None = None,
) -> Recording:
    """Read a log: CARMEN's, a bag of ROS, a pose graph of g2o with scans, a recording of `npz`.

    Args:
        path: The log, or the name of one of `KNOWN`.
        reach: Range [m] from which on a reading counts as no return.
        scans: Topic of the laser scans in a bag.
        odometry: Topic of the odometry in a bag, or of the transforms.

    Raises:
        InputError: The log is of no known form, or has no topics, or as its reader says.
    """
    path = find(path)
    reader = reader_of(path)
    if reader is bags:
        return bags.read(path, reach=reach, scans=scans, odometry=odometry)
    if scans is not None or odometry is not None:
        raise InputError("has no topics", path=path, advice="name topics of bags only")
    return reader.read(path, reach=reach)


def find(path: str | PathLike) -> Path:
    """The path itself, or that of the log with this name which a package brings.

    Raises:
        InputError: It is such a name, and the package is not installed.
    """
    name = str(path)
    if Path(path).exists() or name not in KNOWN:
        return Path(path)
    known = KNOWN[name]
    spec = find_spec(known.package)
    if spec is None or not spec.submodule_search_locations:
        problem = f"comes with the package {known.package}, which is missing"
        raise InputError(problem, path=name, advice=f"pip install '.[{known.extra}]'")
    return Path(next(iter(spec.submodule_search_locations))).joinpath(*known.file)


def reader_of(path: Path) -> ModuleType:
    """The module that reads a log.

    Raises:
        InputError: The file cannot be read, or no line of a known kind comes early.
    """
    if bags.is_bag(path):
        return bags
    if path.is_file() and _holds_arrays(path):
        return npz
    for number, text in lines(path):
        word = text.split(maxsplit=1)[:1]
        if word and word[0] in _WORDS:
            return _WORDS[word[0]]
        if number >= LOOK:
            break
    problem = "is no log that can be read"
    advice = "known are CARMEN logs, ROS bags, graphs of g2o with scans, recordings of NumPy"
    raise InputError(problem, path=path, advice=advice)


def _holds_arrays(path: Path) -> bool:
    """Whether a file is one of NumPy's; if it is broken, others tell."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except Exception:  # zipfile lists nowhere what damage raises
        return False
