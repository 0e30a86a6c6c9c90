"""Laser logs as NumPy files, for scanners that no other reader supports.

    np.savez(path, format="jaxslam-recording", version=1, times=..., odometry=..., ranges=...,
             first=..., step=..., reach=...)

| array | shape, unit | meaning |
|---|---|---|
| `times` | (T,) [s] | time of each scan |
| `odometry` | (T, 3) [m, m, rad] | pose by odometry at each scan |
| `ranges` | (T, R) [m] | no return where infinite, NaN, not above zero or not below `reach` |
| `first` | () [rad] | `angle_min`: direction of beam 0, counter-clockwise from straight ahead |
| `step` | () [rad] | `angle_increment`: beam k has the direction `first + k step` |
| `reach` | () [m] | `range_max` |
| `noise` | () [m] | standard deviation of a range; optional |
| `wheel_times` | (N,) [s] | times of the whole odometry stream; optional |
| `wheel_poses` | (N, 3) [m, m, rad] | its poses; optional |
| `mount` | (3,) [m, m, rad] | pose of the scanner on the robot; optional |

The poses are those of the scanner.
"""

import math
from collections.abc import Mapping
from os import PathLike
from pathlib import Path

import numpy as np

from jaxslam.core.logs import DEFAULT_RANGE_STD, LaserLog
from jaxslam.io.assemble import read_assembled
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace
from jaxslam.io.raw_log import RawLog, RawOdometry, RawScan, Stamps, as_odometry

FRAME = "laser"  # of the scans, whose poses the odometry is
FORMAT, VERSION = "jaxslam-recording", 1
_REQUIRED = ("format", "version", "times", "odometry", "ranges", "first", "step", "reach")
_OPTIONAL = ("noise", "wheel_times", "wheel_poses", "mount")
_LIMITS = {"step": (1e-6, math.pi), "reach": (1e-3, 1e6), "noise": (1e-6, 1e3)}
_ADVICE = f"it is a NumPy file with {', '.join(_REQUIRED)}"


def write(path: str | PathLike, log: LaserLog) -> None:
    """Write a laser log.

    Args:
        path: File to write, atomically.
        log: The log; its numbers may be NumPy arrays, JAX arrays or lists.

    Raises:
        ValueError: `LaserLog.from_arrays` refuses a field, or `read` would refuse the scanner.
        InputError: The file cannot be written.
    """
    mount = log.mount
    log = LaserLog.from_arrays(
        log.times,
        log.odom_poses,
        log.ranges,
        log.lidar,
        odom_stream_times=log.odom_stream_times,
        odom_stream_poses=log.odom_stream_poses,
    )
    lidar = log.lidar
    limited = {
        "angle_increment": _LIMITS["step"],
        "range_max": _LIMITS["reach"],
        "range_std": _LIMITS["noise"],
    }
    for field, (low, high) in limited.items():
        value = getattr(lidar, field)
        if not low <= value <= high:
            raise ValueError(f"lidar.{field} is {value:g}, not between {low:g} and {high:g}")
    with replace(Path(path)) as file:
        np.savez_compressed(
            file,
            format=FORMAT,
            version=VERSION,
            times=log.times,
            odometry=log.odom_poses,
            ranges=log.ranges,
            wheel_times=log.odom_stream_times,
            wheel_poses=log.odom_stream_poses,
            first=lidar.angle_min,
            step=lidar.angle_increment,
            reach=lidar.range_max,
            noise=lidar.range_std,
            mount=np.asarray(mount, np.float64),
        )


def read(path: str | PathLike, *, range_max: float = math.inf) -> LaserLog:
    """Read a laser log.

    Args:
        path: The file.
        range_max: Range [m] from which on a reading counts as no return, unless that of the file is
            smaller.

    Raises:
        InputError: `range_max` is not positive; or the file cannot be read, lacks an array, has an
            unknown one, or one of a wrong shape or with values out of range.
    """
    return read_assembled(path, read_raw, range_max=range_max)


def read_raw(path: str | PathLike) -> RawLog:
    """Scans and odometry of a log.

    Raises:
        InputError: The file cannot be read, lacks an array, has an unknown one, or one of a wrong
            shape or with values out of range.
    """
    arrays = _load(path)
    for name in sorted(arrays.keys() - {*_REQUIRED, *_OPTIONAL}):
        raise InputError("unknown array", path=path, field=name, advice=_ADVICE)
    for name in _REQUIRED:
        if name not in arrays:
            raise InputError("missing", path=path, field=name, advice=_ADVICE)
    if str(arrays["format"]) != FORMAT or str(arrays["version"]) != str(VERSION):
        problem = f"is {arrays['format']} {arrays['version']}, not {FORMAT} {VERSION}"
        raise InputError(problem, path=path, field="format", advice=_ADVICE)
    times = _array(path, arrays, "times", (None,))
    count = len(times)
    poses = _array(path, arrays, "odometry", (count, 3))
    ranges = _array(path, arrays, "ranges", (count, None), finite=False)
    if not count or ranges.shape[1] < 2:
        advice = "give one scan at least, of two beams at least"
        raise InputError(f"has the shape {ranges.shape}", path=path, field="ranges", advice=advice)
    first = float(_array(path, arrays, "first", ()))
    step, reach = _number(path, arrays, "step"), _number(path, arrays, "reach")
    return RawLog(
        scans=[
            RawScan(time, math.nan, index, FRAME, first, step, reach, reading)
            for index, (time, reading) in enumerate(zip(times.tolist(), ranges, strict=True))
        ],
        odometry=_odometry_stream(path, arrays, count),
        base_frame=FRAME,
        scan_poses=poses,
        range_std=_number(path, arrays, "noise") if "noise" in arrays else DEFAULT_RANGE_STD,
        mount=_array(path, arrays, "mount", (3,)) if "mount" in arrays else np.zeros(3),
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
    except Exception as error:  # NumPy and zipfile do not document what damage raises
        problem = f"is no NumPy file that can be read ({type(error).__name__})"
        raise InputError(problem, path=path, advice=_ADVICE) from None


def _array(
    path: str | PathLike,
    arrays: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int | None, ...],
    *,
    finite: bool = True,
) -> np.ndarray:
    """An array as float64, checked to have this shape, in which None stands for any size."""
    array = np.asarray(arrays[name])
    fits = array.ndim == len(shape) and all(
        size == wanted or wanted is None for size, wanted in zip(array.shape, shape, strict=True)
    )
    if array.dtype.kind not in "fiu" or not fits:
        wanted = "(" + ", ".join("any" if size is None else str(size) for size in shape) + ")"
        problem = f"is {array.dtype} {array.shape}, not numbers {wanted}"
        raise InputError(problem, path=path, field=name, advice=_ADVICE)
    array = array.astype(np.float64)
    if finite and not np.isfinite(array).all():
        raise InputError("holds NaN or infinity", path=path, field=name, advice=_ADVICE)
    return array


def _number(path: str | PathLike, arrays: Mapping[str, np.ndarray], name: str) -> float:
    """A number within its `_LIMITS`."""
    low, high = _LIMITS[name]
    value = float(_array(path, arrays, name, ()))
    if not low <= value <= high:
        problem = f"{value:g} is not between {low:g} and {high:g}"
        raise InputError(problem, path=path, field=name, advice=_ADVICE)
    return value


def _odometry_stream(
    path: str | PathLike, arrays: Mapping[str, np.ndarray], num_scans: int
) -> RawOdometry:
    """The odometry stream; empty if the file has none. Its order is that along the scans."""
    if "wheel_times" not in arrays and "wheel_poses" not in arrays:
        return as_odometry([])
    for name in ("wheel_times", "wheel_poses"):
        if name not in arrays:
            raise InputError("missing", path=path, field=name, advice="give both or neither")
    times = _array(path, arrays, "wheel_times", (None,))
    poses = _array(path, arrays, "wheel_poses", (None, 3))
    if len(times) != len(poses):
        problem = "has another length than wheel_times"
        raise InputError(problem, path=path, field="wheel_poses", advice=_ADVICE)
    order = np.linspace(0.0, num_scans - 1.0, len(times))
    return RawOdometry(Stamps(times, np.full(len(times), np.nan), order), poses)
