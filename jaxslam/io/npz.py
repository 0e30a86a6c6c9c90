"""Recordings as NumPy files, for scanners that no other reader knows.

    np.savez(path, format="jaxslam-recording", version=1, times=..., odometry=..., ranges=...,
             first=..., step=..., reach=...)

`times` (T,) [s]; `odometry` (T, 3) [m, m, rad] pose that the wheels report at each scan; `ranges`
(T, R) [m], where what is infinite, NaN, not above zero or not below `reach` [m] returned nothing;
beam k looks along `first + k step` [rad] from straight ahead, to the left. Also, where they are
known: `noise` [m] of a range, and the whole stream of wheel poses, `wheel_times` (N,) and
`wheel_poses` (N, 3).
"""

import math
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.output import replace
from jaxslam.io.recording import NOISE, Recording, no_return
from jaxslam.lidar import Lidar

FORMAT, VERSION = "jaxslam-recording", 1
_NEEDED = ("format", "version", "times", "odometry", "ranges", "first", "step", "reach")
_MAY = ("noise", "wheel_times", "wheel_poses")
_ADVICE = f"it is a NumPy file with {', '.join(_NEEDED)}"


def write(path: str | PathLike, recording: Recording) -> None:
    """Write a recording.

    Raises:
        InputError: The file cannot be written.
    """
    lidar = recording.lidar
    arrays = {name: getattr(recording, name) for name in ("times", "odometry", "ranges")}
    arrays |= {"wheel_times": recording.wheel_times, "wheel_poses": recording.wheel_poses}
    scanner = {name: getattr(lidar, name) for name in ("first", "step", "reach", "noise")}
    with replace(Path(path)) as file:
        np.savez_compressed(file, format=FORMAT, version=VERSION, **arrays, **scanner)


def read(path: str | PathLike, *, reach: float = math.inf) -> Recording:
    """Read a recording.

    Args:
        path: The file.
        reach: Range [m] from which on a reading counts as no return, if the file's is not smaller.

    Raises:
        InputError: The file cannot be read, lacks an array, has an unknown one, or one of a wrong
            shape or with values out of range.
    """
    given = _load(path)
    for name in sorted(given.keys() - {*_NEEDED, *_MAY}):
        raise InputError("unknown array", path=path, field=name, advice=_ADVICE)
    for name in _NEEDED:
        if name not in given:
            raise InputError("missing", path=path, field=name, advice=_ADVICE)
    if str(given["format"]) != FORMAT or str(given["version"]) != str(VERSION):
        problem = f"is {given['format']} {given['version']}, not {FORMAT} {VERSION}"
        raise InputError(problem, path=path, field="format", advice=_ADVICE)

    times = _array(path, given, "times", (None,))
    count = len(times)
    odometry = _array(path, given, "odometry", (count, 3))
    ranges = _array(path, given, "ranges", (count, None), finite=False)
    if not count or ranges.shape[1] < 2:
        advice = "give one scan at least, of two beams at least"
        raise InputError(f"has the shape {ranges.shape}", path=path, field="ranges", advice=advice)
    positive = {"step": (1e-6, math.pi), "reach": (1e-3, 1e6), "noise": (1e-6, 1e3)}
    scanner = {"noise": NOISE, "first": float(_array(path, given, "first", ()))}
    for name, (low, high) in positive.items():
        if name in given:
            value = scanner[name] = float(_array(path, given, name, ()))
            if not low <= value <= high:
                problem = f"{value:g} is not between {low:g} and {high:g}"
                raise InputError(problem, path=path, field=name, advice=_ADVICE)
    scanner["reach"] = min(scanner["reach"], reach)

    stream = {"wheel_times": times, "wheel_poses": odometry}
    if stream.keys() & given.keys():
        for name, shape in (("wheel_times", (None,)), ("wheel_poses", (None, 3))):
            if name not in given:
                raise InputError("missing", path=path, field=name, advice="give both or neither")
            stream[name] = _array(path, given, name, shape)
        if len(stream["wheel_times"]) != len(stream["wheel_poses"]):
            problem = "has another length than wheel_times"
            raise InputError(problem, path=path, field="wheel_poses", advice=_ADVICE)
    return Recording(
        times=times,
        odometry=odometry,
        ranges=no_return(ranges, scanner["reach"]),
        lidar=Lidar(ranges.shape[1], **scanner),
        skipped=0,
        **stream,
    )


def _load(path: str | PathLike) -> dict[str, np.ndarray]:
    """All arrays of the file."""
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check the name") from None
    except IsADirectoryError:
        raise InputError("is a folder", path=path, advice="name a file inside it") from None
    except Exception as error:  # NumPy and zipfile list nowhere what damage raises
        problem = f"is no NumPy file that can be read ({type(error).__name__})"
        raise InputError(problem, path=path, advice=_ADVICE) from None


def _array(
    path: str | PathLike,
    given: dict[str, Any],
    name: str,
    shape: tuple[int | None, ...],
    *,
    finite: bool = True,
) -> np.ndarray:
    """An array as float64, of this shape: any number where None."""
    found = np.asarray(given[name])
    fits = found.ndim == len(shape) and all(
        have == want or want is None for have, want in zip(found.shape, shape, strict=True)
    )
    if found.dtype.kind not in "fiu" or not fits:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        problem = f"is {found.dtype} {found.shape}, not numbers {wanted}"
        raise InputError(problem, path=path, field=name, advice=_ADVICE)
    found = found.astype(np.float64)
    if finite and not np.isfinite(found).all():
        raise InputError("holds NaN or infinity", path=path, field=name, advice=_ADVICE)
    return found
