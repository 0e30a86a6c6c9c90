"""ROBOTLASER1 lines: scans of the newer CARMEN toolkit, which pose graphs of g2o hold too.

    ROBOTLASER1 type first field step max accuracy remission n r_1 .. r_n m s_1 .. s_m
        laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward side axis
        time host logger_time

n ranges, m remissions, and the poses by odometry.
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


class Laser(NamedTuple):
    """A scan."""

    line: int
    time: float  # [s]
    first: float  # [rad]
    step: float  # [rad]
    reach: float  # [m]
    ranges: np.ndarray  # (R,) float64 [m]
    pose: tuple[float, ...]  # (3,) of the laser [m, m, rad], by odometry


def parse(line: int, fields: list[bytes]) -> Laser:
    """The scan of a line's fields; errors do not know the place.

    Raises:
        InputError: There are too few or too many fields, or one is no number or out of range.
    """
    if len(fields) < 9:
        raise InputError(f"cut or damaged: {len(fields)} fields")
    n = number(fields[8], "field 9 (n)")
    if n < 2 or n != int(n):
        raise InputError(f"{n:g} is no number of beams", field="field 9 (n)")
    n = int(n)
    m = number(fields[9 + n], f"field {10 + n} (m)") if len(fields) > 9 + n else 0.0
    right = 24 + n + m
    if len(fields) != right:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {right:g}")
    first, step, most = (number(fields[i], f"field {i + 1}") for i in (2, 4, 5))
    if not 0.0 < step <= math.pi or not 0.0 < most:
        raise InputError("step or greatest range is not positive", field="fields 5 and 6")
    try:
        ranges = np.array([float(field) for field in fields[9 : 9 + n]])
    except ValueError:
        raise InputError("a range is not a number") from None
    if np.isnan(ranges).any():
        raise InputError("a range is not a number")
    names = ("laser_x", "laser_y", "laser_theta")
    pose = tuple(number(x, name) for x, name in zip(fields[-14:-11], names, strict=True))
    return Laser(line, number(fields[-3], "time"), first, step, most, ranges, pose)


def alike(scans: Mapping[Name, Laser]) -> tuple[dict[Name, Laser], dict[int, str]]:
    """Scans with the most frequent scanner, and what is wrong with the others by line."""
    if not scans:
        return {}, {}
    scanner = lambda one: (one.first, one.step, one.reach, one.ranges.size)
    usual = Counter(map(scanner, scans.values())).most_common(1)[0][0]
    odd = {one.line: "another scanner" for one in scans.values() if scanner(one) != usual}
    return {name: one for name, one in scans.items() if one.line not in odd}, odd
