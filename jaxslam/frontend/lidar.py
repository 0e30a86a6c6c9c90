"""Geometry of a laser scan: directions and end points of the beams, what they see to be free."""

import math

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.arguments import as_float
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.se2 import unit_vector
from jaxslam.core.types import Array

ARCTAN = (
    0.999999886,
    -0.33332597,
    0.199859066,
    -0.141612284,
    0.104989435,
    -0.0723485249,
    0.0397811704,
    -0.0144013272,
    0.0024567173,
)
"""Coefficients of arctan(r) / r in r^2, of least largest error of r times it on 0 <= r <= 1."""


def beam_angles(lidar: Lidar) -> Array:
    """Angles (R,) [rad] of the beams in the robot frame."""
    return lidar.angle_min + lidar.angle_increment * jnp.arange(lidar.num_beams, dtype=float)


def beam_ends(lidar: Lidar, scan: Scan) -> Array:
    """Ends (R, 2) [m] of the beams in the robot frame.

    Args:
        lidar: The scanner.
        scan: One of its scans; NumPy arrays, lists or JAX arrays.

    Raises:
        ValueError: The scanner is impossible, or the ranges are not those of one of its scans;
            while tracing.
    """
    check_lidar(lidar)
    ranges = as_float("scan.ranges", scan.ranges, (lidar.num_beams,))
    return ranges[:, None] * unit_vector(beam_angles(lidar))


def bearing(x: Array, y: Array) -> Array:
    """Bearing (...) [rad] of points (...), -pi to pi; without derivatives.

    `jnp.arctan2(y, x)` to rounding, 2e-7 rad in single precision. On a CPU that calls a function
    for each number; this is a polynomial in the ratio of the smaller coordinate to the larger one.
    """
    if x.dtype != jnp.float32:
        return jnp.arctan2(y, x)
    x, y = lax.stop_gradient((x, y))
    size_x, size_y = jnp.abs(x), jnp.abs(y)
    steep = size_y > size_x
    larger = jnp.where(steep, size_y, size_x)
    ratio = jnp.where(steep, size_x, size_y) / jnp.maximum(larger, np.finfo(np.float32).tiny)
    square = ratio * ratio
    value = jnp.full_like(square, ARCTAN[-1])
    for coefficient in ARCTAN[-2::-1]:
        value = value * square + coefficient
    angle = value * ratio
    angle = jnp.where(steep, 0.5 * jnp.pi - angle, angle)
    angle = jnp.where(x < 0.0, jnp.pi - angle, angle)
    return jnp.where(y < 0.0, -angle, angle)


def in_free_view(lidar: Lidar, points: Array, ranges: Array) -> Array:
    """Whether points lie before the ends of the two beams on either side: in the visible region.

    Args:
        lidar: The scanner; points outside its field of view are not visible.
        points: (..., 2) [m] points, robot frame.
        ranges: (R,) [m] of the beams.

    Returns:
        (...) bool.
    """
    return is_free_view(lidar, points[..., 0], points[..., 1], ranges)


def is_free_view(lidar: Lidar, x: Array, y: Array, ranges: Array) -> Array:
    """`in_free_view` of points with coordinates x and y (...) [m], robot frame."""
    beam = (bearing(x, y) - lidar.angle_min) / lidar.angle_increment
    beam = jnp.where(beam < -0.5, beam + 2 * jnp.pi / lidar.angle_increment, beam)
    low = jnp.clip(jnp.floor(beam).astype(jnp.int32), 0, lidar.num_beams - 2)
    within = (beam > -0.5) & (beam < lidar.num_beams - 0.5)
    nearer = jnp.minimum(ranges[:-1], ranges[1:])
    return within & (jnp.sqrt(x * x + y * y) < nearer[low])


def begin_behind(lidar: Lidar, scan: Scan) -> tuple[Lidar, Scan]:
    """The scanner and a scan with beam 0 behind the robot, if the beams go all around it.

    Where the first beam is, walls end: so results would depend on it. Other scanners and their
    scans are returned as they are.

    Args:
        lidar: The scanner.
        scan: One of its scans.
    """
    beams_around = 2.0 * math.pi / lidar.angle_increment
    if abs(lidar.num_beams - beams_around) > 0.5:
        return lidar, scan
    first = math.ceil((-math.pi - lidar.angle_min) / lidar.angle_increment - 1e-6)
    angle_min = lidar.angle_min + first * lidar.angle_increment
    rolled = Scan._make(jnp.roll(x, -first) for x in scan)
    return lidar._replace(angle_min=angle_min), rolled


def to_scan(lidar: Lidar, ranges: Array) -> Scan:
    """A scan, or scans, of raw ranges.

    Args:
        lidar: The scanner.
        ranges: (..., R) [m], a NumPy array, list or JAX array; what is NaN, infinite, not above
            zero or not below `lidar.range_max` is no return.

    Raises:
        ValueError: The scanner is impossible, or the ranges are not those of its beams; while
            tracing.
    """
    check_lidar(lidar)
    ranges = as_float("ranges", ranges, (..., lidar.num_beams))
    hit = (ranges > 0.0) & (ranges < lidar.range_max)  # NaN compares false
    return Scan(ranges=jnp.where(hit, ranges, lidar.range_max), hit=hit)


def field_of_view(lidar: Lidar) -> tuple[float, float]:
    """Directions [rad] of the first and the last beam, robot frame."""
    return lidar.angle_min, lidar.angle_min + lidar.angle_increment * (lidar.num_beams - 1)
