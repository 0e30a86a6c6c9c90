"""Logs of the CARMEN toolkit, the format of most public 2-D laser logs.

    ODOM x y theta tv rv accel ipc_time host logger_time
    FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_time host logger_time
    ROBOTLASER1 ... (`robotlaser`)

All other messages and comments are ignored, and so is ROBOTLASER1 in a log with FLASER, where both
hold the same scans. Poses of ROBOTLASER1 are those of the laser. Where the odometry restarts, or
the poses of the scans were corrected by another program, the odometry is rebuilt from the ODOM
lines, and `LaserLog.odometry_repairs` says so.
"""

import math
from collections import Counter
from os import PathLike

import numpy as np

from jaxslam.core.logs import (
    DEFAULT_RANGE_MAX,
    DEFAULT_RANGE_STD,
    MAX_BROKEN_FRACTION,
    LaserLog,
    mark_no_return,
)
from jaxslam.core.scan import Lidar
from jaxslam.core.time_series import interpolate_poses, sort_by_time
from jaxslam.io import robotlaser
from jaxslam.io.errors import InputError, check_range_max
from jaxslam.io.odometry_repair import poses_are_corrected, remove_jumps
from jaxslam.io.robotlaser import RobotLaser
from jaxslam.io.text import lines, number

_FORMS = {
    b"ODOM": "ODOM x y theta tv rv accel ipc_time host logger_time",
    b"ROBOTLASER1": robotlaser.FORM,
    b"FLASER": "FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_time host logger_time",
}

_StampedPose = tuple[float, float, float, float]
"""Time [s] and pose [m, m, rad]."""

_FlaserScan = tuple[int, _StampedPose, np.ndarray]
"""Line number, time and odometry pose, ranges (R,) [m] of a FLASER line."""

_Broken = dict[int, tuple[bytes, str]]
"""Keyword of each broken line and what is wrong with it, by line number."""


def read(path: str | PathLike, *, range_max: float = DEFAULT_RANGE_MAX) -> LaserLog:
    """Read a CARMEN log, plain or gzipped, in file order.

    Args:
        path: The log.
        range_max: Range [m] from which on a reading counts as no return; so does one <= 0.

    Raises:
        InputError: `range_max` is not positive, the file cannot be read or is no CARMEN log, more
            than 5 % of its ODOM and FLASER lines are broken, there is no scan, or its odometry
            never changes.
    """
    check_range_max(range_max)
    odometry: list[_StampedPose] = []
    flaser: list[_FlaserScan] = []
    robotlaser1: dict[int, RobotLaser] = {}
    broken: _Broken = {}
    for line, text in lines(path):
        fields = text.split()
        keyword = fields[0] if fields else b""
        try:
            if keyword == b"ODOM":
                odometry.append(_parse_odom(fields))
            elif keyword == b"FLASER":
                flaser.append((line, *_parse_flaser(fields)))
            elif keyword == b"ROBOTLASER1":
                robotlaser1[line] = robotlaser.parse(line, fields)
        except InputError as error:
            broken[line] = keyword, str(error)
    use_robotlaser1 = bool(robotlaser1) and not flaser
    unused = b"FLASER" if use_robotlaser1 else b"ROBOTLASER1"
    broken = {line: problem for line, problem in broken.items() if problem[0] != unused}
    if use_robotlaser1:
        robotlaser1, other_scanner = robotlaser.same_scanner(robotlaser1)
        broken |= {line: (b"ROBOTLASER1", problem) for line, problem in other_scanner.items()}
        _check_broken(path, broken, len(odometry) + len(robotlaser1) + len(broken))
        return _from_robotlaser1(path, odometry, list(robotlaser1.values()), len(broken), range_max)
    if not odometry and not flaser and not broken:
        advice = "name a CARMEN log; other formats have other readers"
        raise InputError("has neither FLASER nor ODOM lines", path=path, advice=advice)
    total = len(odometry) + len(flaser) + len(broken)
    flaser, other_count = _with_usual_beam_count(flaser)
    broken |= other_count
    _check_broken(path, broken, total)
    if not flaser:
        problem = f"has no usable FLASER line among its {total} FLASER and ODOM lines"
        raise InputError(problem, path=path, advice="name a log that holds laser scans")
    return _from_flaser(path, odometry, flaser, len(broken), range_max)


def _parse_odom(fields: list[bytes]) -> _StampedPose:
    """Time and pose of an ODOM line; errors carry no line number."""
    if len(fields) != 10:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of 10")
    time = number(fields[7], "field 8 (ipc_time)")
    x, y = number(fields[1], "field 2 (x)"), number(fields[2], "field 3 (y)")
    return time, x, y, number(fields[3], "field 4 (theta)")


def _parse_flaser(fields: list[bytes]) -> tuple[_StampedPose, np.ndarray]:
    """Time and odometry pose of a FLASER line, and its ranges (n,) [m]; errors as above."""
    count = number(fields[1], "field 2 (n)") if len(fields) > 1 else 0.0
    if count < 2 or count != int(count):
        raise InputError(f"{count:g} is not a beam count", field="field 2 (n)")
    num_beams = int(count)
    num_other = len(fields) - 2 - num_beams
    if num_other in (0, 3):
        raise InputError("no odometry: the fields x y theta odom_x odom_y odom_theta are missing")
    if num_other != 9:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {num_beams + 11}")
    names = {8: "ipc_time", 5: "odom_x", 6: "odom_y", 7: "odom_theta"}
    time, x, y, theta = (
        number(fields[num_beams + i], f"field {num_beams + i + 1} ({name})")
        for i, name in names.items()
    )
    return (time, x, y, theta), _parse_ranges(fields[2 : 2 + num_beams])


def _parse_ranges(fields: list[bytes]) -> np.ndarray:
    """Ranges (n,) float64 [m], perhaps infinite; errors carry no line number."""
    try:
        ranges = np.array([float(field) for field in fields])
    except ValueError:
        ranges = np.array([math.nan])
    if np.isnan(ranges).any():
        for i, field in enumerate(fields):
            if field.lower() not in (b"inf", b"+inf", b"-inf"):
                number(field, f"field {i + 3} (range {i + 1})")
    return ranges


def _with_usual_beam_count(scans: list[_FlaserScan]) -> tuple[list[_FlaserScan], _Broken]:
    """Scans with the most frequent beam count, and the others as broken lines."""
    if not scans:
        return scans, {}
    usual = Counter(ranges.size for _, _, ranges in scans).most_common(1)[0][0]
    others = {
        line: (b"FLASER", f"field 2 (n): beam count changes: {ranges.size} instead of {usual}")
        for line, _, ranges in scans
        if ranges.size != usual
    }
    return [scan for scan in scans if scan[0] not in others], others


def _check_broken(path: str | PathLike, broken: _Broken, total: int) -> None:
    """Raise if more of `total` lines are broken than `MAX_BROKEN_FRACTION` allows."""
    if len(broken) <= MAX_BROKEN_FRACTION * total:
        return
    line = min(broken)
    keyword, reason = broken[line]
    problem = f"{reason} ({len(broken)} of {total} lines of scans and odometry are broken)"
    advice = f"repair them, each is: {_FORMS[keyword]}"
    raise InputError(problem, path=path, line=line, advice=advice)


def _from_flaser(
    path: str | PathLike,
    odometry: list[_StampedPose],
    scans: list[_FlaserScan],
    skipped: int,
    range_max: float,
) -> LaserLog:
    """The log of FLASER lines."""
    stamped_poses = np.array([stamped_pose for _, stamped_pose, _ in scans])
    ranges = mark_no_return(np.array([ranges for _, _, ranges in scans]), range_max)
    lidar = half_circle_lidar(ranges.shape[1], range_max)
    return _build_log(path, odometry, stamped_poses, ranges, lidar, skipped)


def _from_robotlaser1(
    path: str | PathLike,
    odometry: list[_StampedPose],
    scans: list[RobotLaser],
    skipped: int,
    range_max: float,
) -> LaserLog:
    """The log of ROBOTLASER1 lines."""
    stamped_poses = np.array([(scan.time, *scan.pose) for scan in scans])
    first = scans[0]
    range_max = min(range_max, first.range_max)
    ranges = mark_no_return(np.array([scan.ranges for scan in scans]), range_max)
    lidar = Lidar(
        ranges.shape[1], first.angle_min, first.angle_increment, range_max, DEFAULT_RANGE_STD
    )
    return _build_log(path, odometry, stamped_poses, ranges, lidar, skipped)


def _build_log(
    path: str | PathLike,
    odometry: list[_StampedPose],
    stamped_poses: np.ndarray,
    ranges: np.ndarray,
    lidar: Lidar,
    skipped: int,
) -> LaserLog:
    """Combine scans and odometry, and repair the odometry where it restarts or was corrected.

    Args:
        path: The log, for errors.
        odometry: Times and poses of the ODOM lines.
        stamped_poses: (T, 4) times [s] and poses [m, m, rad] of the scans.
        ranges: (T, R) float32 [m].
        lidar: The scanner.
        skipped: Number of broken lines.
    """
    if len(stamped_poses) > 1 and not np.ptp(stamped_poses[:, 1:], axis=0).any():
        problem = f"no odometry: its pose is the same in all {len(stamped_poses)} scans"
        raise InputError(problem, path=path, advice="name a log with wheel odometry")
    stream = np.array(odometry) if odometry else stamped_poses  # (N, 4)
    times, odom_times = stamped_poses[:, 0].copy(), stream[:, 0].copy()
    corrected = bool(odometry) and poses_are_corrected(
        times, stamped_poses[:, 1:], odom_times, stream[:, 1:]
    )
    odom_poses, restarts = remove_jumps(odom_times, stream[:, 1:].copy())
    if restarts > MAX_BROKEN_FRACTION * len(stream):
        problem = f"its odometry jumps {restarts} times in {len(stream)} lines"
        raise InputError(problem, path=path, advice="name a log with wheel odometry")
    repairs = []
    if restarts:
        repairs.append(f"odometry restarts ({restarts} x): no motion is assumed there")
    if corrected:
        repairs.append("poses of the scans are not odometry: ODOM lines are used instead")
    scan_poses = stamped_poses[:, 1:].copy()
    if odometry and repairs:
        scan_poses = interpolate_poses(times, *sort_by_time(odom_times, odom_poses))
    elif not odometry:
        scan_poses = odom_poses.copy()
    return LaserLog(
        times=times,
        odom_poses=scan_poses,
        ranges=ranges,
        lidar=lidar,
        num_skipped=skipped,
        odom_stream_times=odom_times,
        odom_stream_poses=odom_poses,
        odometry_repairs=tuple(repairs),
    )


def half_circle_lidar(num_beams: int, range_max: float) -> Lidar:
    """Lidar of a half circle from -90 degrees on; an odd count of beams includes +90 degrees.

    Args:
        num_beams: Number of beams, at least 2.
        range_max: Range [m] from which on a reading counts as no return.
    """
    intervals = num_beams - 1 if num_beams % 2 else num_beams
    return Lidar(num_beams, -math.pi / 2, math.pi / intervals, float(range_max), DEFAULT_RANGE_STD)
