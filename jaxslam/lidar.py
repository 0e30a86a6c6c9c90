"""Laser scanner: its parameters, and simulated scans by ray casting."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.geometry import cross, unit
from jaxslam.types import Array, Key, expect
from jaxslam.world import World

SEAM = 1e-5  # fraction of its length by which a wall is lengthened at either end


class Lidar(NamedTuple):
    """A 2-D laser scanner at the origin of the robot frame; static under jit.

    Attributes:
        beams: Number of beams R.
        first: [rad] angle of beam 0 in the robot frame; `angle_min` of `sensor_msgs/LaserScan`.
        step: [rad] from one beam to the next; `angle_increment`.
        reach: [m] largest range, beyond which nothing returns; `range_max`.
        noise: [m] standard deviation of a range.
    """

    beams: int = 361
    first: float = -math.pi / 2
    step: float = math.pi / 360
    reach: float = 10.0
    noise: float = 0.01


class Scan(NamedTuple):
    """One scan.

    Attributes:
        ranges: (R,) [m]; the largest range of the lidar where nothing was hit.
        hit: (R,) bool, False where nothing returned.
    """

    ranges: Array
    hit: Array


def bearings(lidar: Lidar) -> Array:
    """Angles (R,) [rad] of the beams in the robot frame."""
    return lidar.first + lidar.step * jnp.arange(lidar.beams, dtype=float)


def points(scan: Scan, lidar: Lidar) -> Array:
    """Ends (R, 2) [m] of the beams in the robot frame.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    expect("scan.ranges", scan.ranges, (lidar.beams,), jnp.floating)
    return scan.ranges[:, None] * unit(bearings(lidar))


def before_ends(places: Array, ranges: Array, lidar: Lidar) -> Array:
    """Whether points lie before the ends of the two beams on either side: in the visible region.

    Args:
        places: (..., 2) [m] points, robot frame.
        ranges: (R,) [m] of the beams.
        lidar: The scanner; points outside its field of view are not visible.

    Returns:
        (...) bool.
    """
    beam = (jnp.arctan2(places[..., 1], places[..., 0]) - lidar.first) / lidar.step
    low = jnp.clip(jnp.floor(beam).astype(jnp.int32), 0, lidar.beams - 2)
    within = (beam > -0.5) & (beam < lidar.beams - 0.5)
    return within & (jnp.linalg.norm(places, axis=-1) < jnp.minimum(ranges[low], ranges[low + 1]))


def cast(world: World, pose: Array, lidar: Lidar) -> Scan:
    """Noise-free scan of `world` from `pose` (3,).

    A beam along unit vector u from p meets the wall a + s (b - a), 0 <= s <= 1, at the distance
    t = (a - p) x (b - a) / (u x (b - a)). Walls are lengthened by `SEAM`, so that no beam passes
    between two that share a corner.

    Args:
        world: The walls.
        pose: (3,) [m, m, rad] of the lidar in the world.
        lidar: The scanner.

    Raises:
        ValueError: Walls or pose have another shape or type; while tracing.
    """
    expect("world.walls", world.walls, ("S", 4), jnp.floating)
    expect("pose", pose, (3,), jnp.floating)
    beam = unit(pose[2] + bearings(lidar))[:, None, :]  # (R, 1, 2)
    start = (world.walls[:, :2] - pose[None, :2])[None]  # (1, S, 2)
    along = (world.walls[:, 2:] - world.walls[:, :2])[None]  # (1, S, 2)
    slope = cross(beam, along)  # (R, S)
    crosses = jnp.abs(slope) > 1e-9
    safe = jnp.where(crosses, slope, 1.0)
    distance = cross(start, along) / safe  # t
    fraction = cross(start, beam) / safe  # s
    met = crosses & (distance > 1e-6) & (jnp.abs(fraction - 0.5) <= 0.5 + SEAM)
    ranges = jnp.min(jnp.where(met, distance, jnp.inf), axis=1)
    return limit(ranges, lidar)


def limit(ranges: Array, lidar: Lidar) -> Scan:
    """Scans of raw ranges (..., R) [m]; NaN, infinite or beyond the largest range is no return.

    Raises:
        ValueError: The ranges are not those of this lidar's beams; while tracing.
    """
    expect("ranges", ranges, (..., lidar.beams), jnp.floating)
    hit = (ranges > 0.0) & (ranges < lidar.reach)  # NaN compares false
    return Scan(ranges=jnp.where(hit, ranges, lidar.reach), hit=hit)


def disturb(key: Key, scan: Scan, lidar: Lidar) -> Scan:
    """Add the range noise of the lidar to a scan; ranges beyond the largest become no return."""
    noise = lidar.noise * jax.random.normal(key, scan.ranges.shape, scan.ranges.dtype)
    return limit(jnp.where(scan.hit, scan.ranges + noise, jnp.inf), lidar)
