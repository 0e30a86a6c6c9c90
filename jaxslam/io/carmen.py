"""Logs of the CARMEN toolkit, as most public 2-D laser logs are kept.

    ODOM x y theta tv rv accel ipc_time host logger_time
    FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_time host logger_time
    ROBOTLASER1 ... (`robotlaser`)

All other messages and comments are passed over, and ROBOTLASER1 too where there is FLASER, which
then holds the same scans. Poses of ROBOTLASER1 are those of the laser. Where odometry was started
anew, or the scans have poses that another program corrected, the wheels' own are put together again
from the ODOM lines, and `Recording.mended` tells so.
"""

import math
from collections import Counter
from os import PathLike

import numpy as np

from jaxslam.io import robotlaser
from jaxslam.io.errors import InputError
from jaxslam.io.recording import NOISE, REACH, TOLERATED, Recording, no_return
from jaxslam.io.robotlaser import Laser
from jaxslam.io.text import lines, number
from jaxslam.io.wheels import foreign, without_jumps
from jaxslam.lidar import Lidar
from jaxslam.poses import by_time, interpolate

_FORMS = {
    b"ODOM": "ODOM x y theta tv rv accel ipc_time host logger_time",
    b"ROBOTLASER1": robotlaser.FORM,
    b"FLASER": "FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_time host logger_time",
}


def read(path: str | PathLike, *, reach: float = REACH) -> Recording:
    """Read a CARMEN log, plain or gzipped, in file order.

    Args:
        path: The log.
        reach: Range [m] from which on a reading counts as no return; so does one <= 0.

    Raises:
        InputError: The file cannot be read or is no CARMEN log, more than 5 % of its ODOM and
            FLASER lines are broken, there is no scan, or its odometry never changes.
    """
    if not 0.0 < reach < math.inf:
        raise InputError(f"reach {reach} m", advice="give a positive number of metres")
    wheels, scans, broken = [], [], {}
    lasers: dict[int, Laser] = {}
    for line, text in lines(path):
        fields = text.split()
        kind = fields[0] if fields else b""
        try:
            if kind == b"ODOM":
                wheels.append(_odom(fields))
            elif kind == b"FLASER":
                scans.append((line, *_flaser(fields)))
            elif kind == b"ROBOTLASER1":
                lasers[line] = robotlaser.parse(line, fields)
        except InputError as error:
            broken[line] = kind, str(error)
    newer = bool(lasers) and not scans
    unused = b"FLASER" if newer else b"ROBOTLASER1"
    broken = {line: one for line, one in broken.items() if one[0] != unused}
    if newer:
        lasers, odd = robotlaser.alike(lasers)
        broken |= {line: (b"ROBOTLASER1", problem) for line, problem in odd.items()}
        _check_broken(path, broken, len(wheels) + len(lasers) + len(broken))
        return _newer(path, wheels, list(lasers.values()), len(broken), reach)
    if not wheels and not scans and not broken:
        advice = "name a CARMEN log; other formats have other readers"
        raise InputError("has neither FLASER nor ODOM lines", path=path, advice=advice)
    total = len(wheels) + len(scans) + len(broken)
    scans, odd = _same_size(scans)
    broken |= odd
    _check_broken(path, broken, total)
    if not scans:
        problem = f"has no usable FLASER line among its {total} FLASER and ODOM lines"
        raise InputError(problem, path=path, advice="name a log that holds laser scans")
    return _recording(path, wheels, scans, len(broken), reach)


def _odom(fields: list[bytes]) -> tuple[float, float, float, float]:
    """Time and pose of an ODOM line; errors do not know the place."""
    if len(fields) != 10:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of 10")
    names = ("field 8 (ipc_time)", "field 2 (x)", "field 3 (y)", "field 4 (theta)")
    return tuple(number(fields[i], name) for i, name in zip((7, 1, 2, 3), names, strict=True))


def _flaser(fields: list[bytes]) -> tuple[tuple[float, float, float, float], np.ndarray]:
    """Time and odometry pose of a FLASER line, and its ranges (n,) [m]; errors know no place."""
    count = number(fields[1], "field 2 (n)") if len(fields) > 1 else 0.0
    if count < 2 or count != int(count):
        raise InputError(f"{count:g} is no number of beams", field="field 2 (n)")
    n = int(count)
    extra = len(fields) - 2 - n
    if extra in (0, 3):
        raise InputError("no odometry: the fields x y theta odom_x odom_y odom_theta are missing")
    if extra != 9:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {n + 11}")
    names = ("ipc_time", "odom_x", "odom_y", "odom_theta")
    places = (n + 8, n + 5, n + 6, n + 7)
    stamped = tuple(
        number(fields[i], f"field {i + 1} ({name})") for i, name in zip(places, names, strict=True)
    )
    return stamped, _ranges(fields[2 : 2 + n])


def _ranges(fields: list[bytes]) -> np.ndarray:
    """Readings (n,) float64 [m], some perhaps infinite; errors know no place."""
    try:
        ranges = np.array([float(field) for field in fields])
    except ValueError:
        ranges = np.array([math.nan])
    if np.isnan(ranges).any():
        for i, field in enumerate(fields):
            if field.lower() not in (b"inf", b"+inf", b"-inf"):
                number(field, f"field {i + 3} (range {i + 1})")
    return ranges


def _same_size(scans: list) -> tuple[list, dict]:
    """Scans of the most frequent beam count, and what is wrong with the others by line."""
    if not scans:
        return scans, {}
    n = Counter(ranges.size for _, _, ranges in scans).most_common(1)[0][0]
    odd = {
        line: (b"FLASER", f"field 2 (n): beam count changes: {ranges.size} instead of {n}")
        for line, _, ranges in scans
        if ranges.size != n
    }
    return [scan for scan in scans if scan[0] not in odd], odd


def _check_broken(path: str | PathLike, broken: dict, total: int) -> None:
    """Raise if more lines are broken than is tolerated."""
    if len(broken) <= TOLERATED * total:
        return
    line = min(broken)
    kind, reason = broken[line]
    problem = f"{reason} ({len(broken)} of {total} lines of scans and odometry are broken)"
    advice = f"repair them, each is: {_FORMS[kind]}"
    raise InputError(problem, path=path, line=line, advice=advice)


def _recording(
    path: str | PathLike, wheels: list, scans: list, skipped: int, reach: float
) -> Recording:
    """Stack the lines' values; readings that are no return become inf."""
    stamped = np.array([stamp for _, stamp, _ in scans])  # (T, 4)
    ranges = no_return(np.array([ranges for _, _, ranges in scans]), reach)
    lidar = layout(ranges.shape[1], reach)
    return _joined(path, wheels, stamped, ranges, lidar, skipped)


def _newer(
    path: str | PathLike, wheels: list, scans: list[Laser], skipped: int, reach: float
) -> Recording:
    """The same of ROBOTLASER1 lines."""
    stamped = np.array([(one.time, *one.pose) for one in scans])
    first = scans[0]
    reach = min(reach, first.reach)
    ranges = no_return(np.array([one.ranges for one in scans]), reach)
    lidar = Lidar(ranges.shape[1], first.first, first.step, reach, NOISE)
    return _joined(path, wheels, stamped, ranges, lidar, skipped)


def _joined(
    path: str | PathLike,
    wheels: list,
    stamped: np.ndarray,
    ranges: np.ndarray,
    lidar: Lidar,
    skipped: int,
) -> Recording:
    """Scans (T, R) with their times and poses (T, 4), and the stream of the wheels."""
    if len(stamped) > 1 and not np.ptp(stamped[:, 1:], axis=0).any():
        problem = f"no odometry: its pose is the same in all {len(stamped)} scans"
        raise InputError(problem, path=path, advice="name a log with wheel odometry")
    stream = np.array(wheels) if wheels else stamped  # (N, 4)
    times, wheel_times = stamped[:, 0].copy(), stream[:, 0].copy()
    corrected = bool(wheels) and foreign(times, stamped[:, 1:], wheel_times, stream[:, 1:])
    wheel_poses, restarts = without_jumps(wheel_times, stream[:, 1:].copy())
    if restarts > TOLERATED * len(stream):
        problem = f"its odometry jumps {restarts} times in {len(stream)} lines"
        raise InputError(problem, path=path, advice="name a log with wheel odometry")
    mended = []
    if restarts:
        mended.append(f"odometry starts anew ({restarts} x): the robot stands still there")
    if corrected:
        mended.append("poses of the scans are not those of the wheels: ODOM lines are used instead")
    odometry = stamped[:, 1:].copy()
    if wheels and mended:
        odometry = interpolate(times, *by_time(wheel_times, wheel_poses))
    elif not wheels:
        odometry = wheel_poses.copy()
    return Recording(
        times=times,
        odometry=odometry,
        ranges=ranges,
        lidar=lidar,
        skipped=skipped,
        wheel_times=wheel_times,
        wheel_poses=wheel_poses,
        mended=tuple(mended),
    )


def layout(beams: int, reach: float) -> Lidar:
    """Lidar of a half circle from -90 degrees on; an odd count of beams includes +90 degrees.

    Args:
        beams: Number of beams, at least 2.
        reach: Range [m] beyond which nothing returns.
    """
    steps = beams - 1 if beams % 2 else beams
    return Lidar(beams, -math.pi / 2, math.pi / steps, float(reach), NOISE)
