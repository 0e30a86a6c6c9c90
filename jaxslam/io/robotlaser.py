"""ROBOTLASER1 and RAWLASER1 lines: scans of newer CARMEN logs, also used in g2o pose graphs.

    ROBOTLASER1 type first field step max accuracy remission n r_1 .. r_n m s_1 .. s_m
        laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward side axis
        time host logger_time
    RAWLASER1 type first field step max accuracy remission n r_1 .. r_n m s_1 .. s_m
        time host logger_time

n ranges, m remissions; the poses are by odometry.
"""

import math

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.raw_log import RawScan
from jaxslam.io.text import number

_SCAN = "type first field step max accuracy remission n r_1 .. r_n m s_1 .. s_m"
_TAIL = "time host logger_time"
FORM = (
    f"ROBOTLASER1 {_SCAN}, 3 numbers of the laser's pose, 3 of the robot's, tv rv forward side "
    f"axis {_TAIL}"
)
RAW_FORM = f"RAWLASER1 {_SCAN} {_TAIL}"


def parse(
    line: int, fields: list[bytes], frame: str
) -> tuple[RawScan, tuple[float, float, float] | None]:
    """The scan of a line, and the pose of the laser by odometry; None in RAWLASER1.

    Args:
        line: Number of the line.
        fields: Its fields.
        frame: Name for the scanner.

    Raises:
        InputError: There are too few or too many fields, or one is no number or out of range. It
            carries no line number.
    """
    if len(fields) < 9:
        raise InputError(f"cut or damaged: {len(fields)} fields")
    count = number(fields[8], "field 9 (n)")
    if count < 2 or count != int(count):
        raise InputError(f"{count:g} is not a beam count", field="field 9 (n)")
    num_beams = int(count)
    end = 9 + num_beams
    remissions = number(fields[end], f"field {end + 1} (m)") if len(fields) > end else 0.0
    has_pose = fields[0] != b"RAWLASER1"
    num_fields = (24 if has_pose else 13) + num_beams + remissions
    if len(fields) != num_fields:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {num_fields:g}")
    angle_min, step, range_max = (number(fields[i], f"field {i + 1}") for i in (2, 4, 5))
    if not 0.0 < step <= math.pi or not 0.0 < range_max:
        raise InputError("step or maximum range is not positive", field="fields 5 and 6")
    try:
        ranges = np.array([float(field) for field in fields[9:end]])
    except ValueError:
        raise InputError("a range is not a number") from None
    if np.isnan(ranges).any():
        raise InputError("a range is not a number")
    time = number(fields[-3], "time")
    received = logger_time(fields)
    scan = RawScan(time, received, line, frame, angle_min, step, range_max, ranges)
    return scan, _pose(fields) if has_pose else None


def logger_time(fields: list[bytes]) -> float:
    """Time [s] at which a line of CARMEN was logged, its last field; NaN if that is no number."""
    try:
        return float(fields[-1])
    except ValueError:
        return math.nan


def _pose(fields: list[bytes]) -> tuple[float, float, float]:
    """Pose [m, m, rad] of the laser in a ROBOTLASER1 line."""
    names = ("laser_x", "laser_y", "laser_theta")
    x, y, theta = (number(field, name) for field, name in zip(fields[-14:-11], names, strict=True))
    return x, y, theta
