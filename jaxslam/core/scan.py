"""The laser scanner and its scans: the records."""

import math
from typing import NamedTuple

from jaxslam.core.types import Array


class Lidar(NamedTuple):
    """A 2-D laser scanner at the origin of the robot frame; static under jit.

    Attributes:
        num_beams: Number of beams R.
        angle_min: [rad] angle of beam 0 in the robot frame; `angle_min` of `sensor_msgs/LaserScan`.
        angle_increment: [rad] from one beam to the next; `angle_increment`.
        range_max: [m] largest range, beyond which nothing returns; `range_max`.
        range_std: [m] standard deviation of a range.
    """

    num_beams: int = 361
    angle_min: float = -math.pi / 2
    angle_increment: float = math.pi / 360
    range_max: float = 10.0
    range_std: float = 0.01


class Scan(NamedTuple):
    """One scan.

    Attributes:
        ranges: (R,) [m]; the largest range of the lidar where nothing was hit.
        hit: (R,) bool, False where nothing returned.
    """

    ranges: Array
    hit: Array
