"""ROBOTLASER1 lines: scans of newer CARMEN logs, also used in g2o pose graphs.

    ROBOTLASER1 type first field step max accuracy remission n r_1 .. r_n m s_1 .. s_m
        laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward side axis
        time host logger_time

n ranges, m remissions; the poses are by odometry.
"""

import math
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.text import number

FORM = (
    "ROBOTLASER1 type first field step max accuracy remission n r_1 .. r_n m s_1 .. s_m, 3 "
    "numbers of the laser's pose, 3 of the robot's, tv rv forward side axis time host logger_time"
)

Name = TypeVar("Name")
"""What scans are numbered or named by."""


class RobotLaser(NamedTuple):
    """A laser scan.

    Attributes:
        line: Number of its line.
        time: [s].
        angle_min: [rad] direction of the first beam.
        angle_increment: [rad] from one beam to the next.
        range_max: [m] largest range.
        ranges: (R,) float64 [m].
        pose: (3,) [m, m, rad] of the laser, by odometry.
    """

    line: int
    time: float
    angle_min: float
    angle_increment: float
    range_max: float
    ranges: np.ndarray
    pose: tuple[float, ...]


def parse(line: int, fields: list[bytes]) -> RobotLaser:
    """The scan of a line.

    Args:
        line: Number of the line.
        fields: Its fields.

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
    num_fields = 24 + num_beams + remissions
    if len(fields) != num_fields:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {num_fields:g}")
    angle_min, angle_increment, range_max = (number(fields[i], f"field {i + 1}") for i in (2, 4, 5))
    if not 0.0 < angle_increment <= math.pi or not 0.0 < range_max:
        raise InputError("step or maximum range is not positive", field="fields 5 and 6")
    try:
        ranges = np.array([float(field) for field in fields[9:end]])
    except ValueError:
        raise InputError("a range is not a number") from None
    if np.isnan(ranges).any():
        raise InputError("a range is not a number")
    names = ("laser_x", "laser_y", "laser_theta")
    pose = tuple(number(field, name) for field, name in zip(fields[-14:-11], names, strict=True))
    time = number(fields[-3], "time")
    return RobotLaser(line, time, angle_min, angle_increment, range_max, ranges, pose)


def same_scanner(scans: Mapping[Name, RobotLaser]) -> tuple[dict[Name, RobotLaser], dict[int, str]]:
    """Select the scans with the most frequent scanner metadata.

    Args:
        scans: Scans by any key.

    Returns:
        The selected scans, and what is wrong with the others by line number.
    """
    if not scans:
        return {}, {}

    def metadata(scan: RobotLaser) -> tuple[float, ...]:
        return scan.angle_min, scan.angle_increment, scan.range_max, scan.ranges.size

    usual = Counter(map(metadata, scans.values())).most_common(1)[0][0]
    others = {scan.line: "another scanner" for scan in scans.values() if metadata(scan) != usual}
    return {name: scan for name, scan in scans.items() if scan.line not in others}, others
