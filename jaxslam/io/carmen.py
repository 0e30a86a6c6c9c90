"""Logs of the CARMEN toolkit, the format of most public 2-D laser logs.

    ODOM x y theta tv rv accel ipc_time host logger_time
    FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_time host logger_time
    ROBOTLASER1, RAWLASER1 ... (`robotlaser`)
    PARAM name value ...

Scans are those of FLASER or, without these, of ROBOTLASER1 or of RAWLASER1: a log often holds the
same scans twice. FLASER lines may also end after the readings, or hold no poses. PARAM lines may
say where the front laser sits on the robot. All other messages and comments are ignored.
"""

import math
from os import PathLike

import numpy as np

from jaxslam.core.logs import (
    DEFAULT_RANGE_MAX,
    DEFAULT_RANGE_STD,
    MAX_BROKEN_FRACTION,
    LaserLog,
)
from jaxslam.core.scan import Lidar
from jaxslam.io import robotlaser
from jaxslam.io.assemble import read_assembled
from jaxslam.io.errors import InputError
from jaxslam.io.raw_log import RawLog, RawScan, RawTransform, as_odometry
from jaxslam.io.text import lines, number

_FORMS = {
    b"ODOM": "ODOM x y theta tv rv accel ipc_time host logger_time",
    b"ROBOTLASER1": robotlaser.FORM,
    b"RAWLASER1": robotlaser.RAW_FORM,
    b"FLASER": "FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_time host logger_time",
}
SCAN_KEYWORDS = (b"FLASER", b"ROBOTLASER1", b"RAWLASER1")  # the first that occurs is read
_MOUNT_PARAMS = ("robot_frontlaser", "robot_front_laser", "laser_front_laser")  # + _offset ...
LASER_FRAME, BASE_FRAME = "front_laser", "base_link"

_Pose = tuple[float, float, float]
"""Pose [m, m, rad]."""

_Scan = tuple[RawScan, _Pose | None]
"""A scan and its pose by odometry; None if the line has none."""

_Broken = dict[int, tuple[bytes, str]]
"""Keyword of each broken line and what is wrong with it, by line number."""


def read(path: str | PathLike, *, range_max: float = DEFAULT_RANGE_MAX) -> LaserLog:
    """Read a CARMEN log, plain or gzipped, in file order.

    Args:
        path: The log.
        range_max: Range [m] from which on a reading counts as no return; so does one <= 0.

    Raises:
        InputError: `range_max` is not positive, the file cannot be read or is no CARMEN log, more
            than 5 % of its lines of scans and odometry are broken, or there is no scan.
    """
    return read_assembled(path, read_raw, range_max=range_max)


def read_raw(path: str | PathLike) -> RawLog:
    """Scans, odometry and mount of a log.

    Raises:
        InputError: The file cannot be read or is no CARMEN log, more than 5 % of its lines of
            scans and odometry are broken, or there is no scan.
    """
    odometry: list[tuple[float, float, int, float, float, float]] = []
    scans: dict[bytes, list[_Scan]] = {keyword: [] for keyword in SCAN_KEYWORDS}
    params: dict[str, float] = {}
    broken: _Broken = {}
    for line, text in lines(path):
        fields = text.split()
        keyword = fields[0] if fields else b""
        try:
            if keyword == b"ODOM":
                odometry.append(_parse_odom(line, fields))
            elif keyword == b"FLASER":
                scans[keyword].append(_parse_flaser(line, fields))
            elif keyword in scans:
                scans[keyword].append(_parse_robotlaser(line, fields))
            elif keyword == b"PARAM":
                _parse_param(fields, params)
        except InputError as error:
            broken[line] = keyword, str(error)
    used = next((keyword for keyword in SCAN_KEYWORDS if scans[keyword]), b"FLASER")
    broken = {line: problem for line, problem in broken.items() if problem[0] in (used, b"ODOM")}
    if not odometry and not scans[used] and not broken:
        advice = "name a CARMEN log; other formats have other readers"
        raise InputError("has neither FLASER nor ODOM lines", path=path, advice=advice)
    chosen, without_poses = _with_poses(scans[used])
    broken |= without_poses
    total = len(odometry) + len(chosen) + len(broken)
    _check_broken(path, broken, total)
    if not chosen:
        problem = f"has no usable FLASER line among its {total} FLASER and ODOM lines"
        raise InputError(problem, path=path, advice="name a log that holds laser scans")
    poses = [pose for _, pose in chosen if pose is not None]
    return RawLog(
        scans=[scan for scan, _ in chosen],
        odometry=as_odometry(odometry),
        base_frame=LASER_FRAME if used == b"ROBOTLASER1" else BASE_FRAME,
        scan_poses=np.array(poses) if poses else None,
        transforms=_mount_transform(params) if used == b"FLASER" else {},
        num_skipped=len(broken),
        poses_may_be_corrected=True,
    )


def _parse_odom(line: int, fields: list[bytes]) -> tuple[float, float, int, float, float, float]:
    """Stamp, time of logging, line and pose of an ODOM line; errors carry no line number."""
    if len(fields) != 10:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of 10")
    time = number(fields[7], "field 8 (ipc_time)")
    x, y = number(fields[1], "field 2 (x)"), number(fields[2], "field 3 (y)")
    theta = number(fields[3], "field 4 (theta)")
    return time, robotlaser.logger_time(fields), line, x, y, theta


def _parse_flaser(line: int, fields: list[bytes]) -> _Scan:
    """Scan and odometry pose of a FLASER line; errors carry no line number."""
    count = number(fields[1], "field 2 (n)") if len(fields) > 1 else 0.0
    if count < 2 or count != int(count):
        raise InputError(f"{count:g} is not a beam count", field="field 2 (n)")
    num_beams = int(count)
    num_other = len(fields) - 2 - num_beams
    if num_other not in (0, 3, 9):
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {num_beams + 11}")
    pose, time = None, math.nan
    if num_other == 9:
        names = {5: "odom_x", 6: "odom_y", 7: "odom_theta"}
        x, y, theta = (
            number(fields[num_beams + i], f"field {num_beams + i + 1} ({name})")
            for i, name in names.items()
        )
        pose = x, y, theta
    if num_other:
        time = number(fields[-3], f"field {len(fields) - 2} (ipc_time)")
    received = robotlaser.logger_time(fields) if num_other else math.nan
    ranges = _parse_ranges(fields[2 : 2 + num_beams])
    lidar = half_circle_lidar(num_beams, DEFAULT_RANGE_MAX)
    geometry = lidar.angle_min, lidar.angle_increment
    return RawScan(time, received, line, LASER_FRAME, *geometry, math.inf, ranges), pose


def _parse_robotlaser(line: int, fields: list[bytes]) -> _Scan:
    """Scan and odometry pose of a ROBOTLASER1 or RAWLASER1 line; errors carry no line number."""
    return robotlaser.parse(line, fields, LASER_FRAME)


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


def _parse_param(fields: list[bytes], params: dict[str, float]) -> None:
    """Add a parameter whose value is a number; others are not needed."""
    try:
        value = float(fields[2])
    except (ValueError, IndexError):
        return
    if math.isfinite(value):
        params[fields[1].decode("utf-8", "replace")] = value


def _mount_transform(params: dict[str, float]) -> dict[tuple[str, str], RawTransform]:
    """Transform from the robot to its front laser, if there are parameters for it."""
    for prefix in _MOUNT_PARAMS:
        names = [f"{prefix}_{name}" for name in ("offset", "side_offset", "angular_offset")]
        if names[0] in params:
            x, y, yaw = (params.get(name, 0.0) for name in names)
            values = (x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
            transform = RawTransform(BASE_FRAME, LASER_FRAME, [(0.0, math.nan, 0)], [values])
            return {(BASE_FRAME, LASER_FRAME): transform}
    return {}


def _with_poses(scans: list[_Scan]) -> tuple[list[_Scan], _Broken]:
    """Scans that have poses, and the others as broken lines; all scans if most have none."""
    without = [scan for scan, pose in scans if pose is None]
    if 2 * len(without) > len(scans):
        return [(scan, None) for scan, _ in scans], {}
    reason = "no odometry: the fields x y theta odom_x odom_y odom_theta are missing"
    broken = {scan.order: (b"FLASER", reason) for scan in without}
    return [(scan, pose) for scan, pose in scans if pose is not None], broken


def _check_broken(path: str | PathLike, broken: _Broken, total: int) -> None:
    """Raise if more of `total` lines are broken than `MAX_BROKEN_FRACTION` allows."""
    if len(broken) <= MAX_BROKEN_FRACTION * total:
        return
    line = min(broken)
    keyword, reason = broken[line]
    problem = f"{reason} ({len(broken)} of {total} lines of scans and odometry are broken)"
    advice = f"repair them, each is: {_FORMS[keyword]}"
    raise InputError(problem, path=path, line=line, advice=advice)


def half_circle_lidar(num_beams: int, range_max: float) -> Lidar:
    """Lidar of a half circle from -90 degrees on; an odd count of beams includes +90 degrees.

    Args:
        num_beams: Number of beams, at least 2.
        range_max: Range [m] from which on a reading counts as no return.
    """
    intervals = num_beams - 1 if num_beams % 2 else num_beams
    return Lidar(num_beams, -math.pi / 2, math.pi / intervals, float(range_max), DEFAULT_RANGE_STD)
