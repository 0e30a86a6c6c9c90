"""The laser scanner and its scans: the records, and their checks."""

import math
from typing import NamedTuple

from jaxslam.core.arguments import as_bool, as_float
from jaxslam.core.types import Array, as_float64


class Lidar(NamedTuple):
    """A 2-D laser scanner at the origin of the robot frame; static under jit.

    The first four fields are those of `sensor_msgs/LaserScan` in ROS.

    Attributes:
        num_beams: Number of beams R, at least 2.
        angle_min: [rad] angle of beam 0 in the robot frame.
        angle_increment: [rad] from one beam to the next, above 0: counter-clockwise.
        range_max: [m] largest range, above 0; nothing returns from beyond it.
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


def check_lidar(lidar: Lidar) -> None:
    """Raise ValueError, naming the field, unless the record is that of a possible scanner."""
    if not isinstance(lidar, Lidar):
        raise ValueError(f"lidar is a {type(lidar).__name__}, not a Lidar")
    for name, value in lidar._asdict().items():
        if not math.isfinite(as_float64(f"lidar.{name}", value, ())):
            raise ValueError(f"lidar.{name} is {value}, not a finite number")
    if lidar.num_beams < 2 or lidar.num_beams != int(lidar.num_beams):
        raise ValueError(f"lidar.num_beams is {lidar.num_beams}, not an integer of at least 2")
    for name in ("angle_increment", "range_max"):
        if not getattr(lidar, name) > 0.0:
            raise ValueError(f"lidar.{name} is {getattr(lidar, name)}, not above 0")
    if lidar.range_std < 0.0:
        raise ValueError(f"lidar.range_std is {lidar.range_std}, which is below 0")


def as_scan(lidar: Lidar, scan: Scan) -> Scan:
    """A scan of this lidar as JAX arrays, checked.

    Args:
        lidar: The scanner.
        scan: NumPy arrays, lists or JAX arrays.

    Raises:
        ValueError: The scanner is impossible, or ranges or hits are not those of one of its scans.
    """
    check_lidar(lidar)
    if not isinstance(scan, Scan):
        raise ValueError(f"scan is a {type(scan).__name__}, not a Scan: see `to_scan`")
    return Scan(
        ranges=as_float("scan.ranges", scan.ranges, (lidar.num_beams,)),
        hit=as_bool("scan.hit", scan.hit, (lidar.num_beams,)),
    )
