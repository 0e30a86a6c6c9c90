"""Ray casting of a laser scanner in a world of straight walls, and range noise."""

import jax
import jax.numpy as jnp

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import cross, unit_vector
from jaxslam.core.types import Array, Key, check_array
from jaxslam.frontend.lidar import beam_angles, to_scan
from jaxslam.simulation.worlds import World

SEAM = 1e-5  # fraction of its length by which a wall is lengthened at either end


def cast(lidar: Lidar, world: World, pose: Array) -> Scan:
    """Noise-free scan of a world from a pose.

    A beam along unit vector u from p meets the wall a + s (b - a), 0 <= s <= 1, at the distance
    t = (a - p) x (b - a) / (u x (b - a)). Walls are lengthened by `SEAM`, so that no beam passes
    between two that share a corner.

    Args:
        lidar: The scanner.
        world: The walls.
        pose: (3,) [m, m, rad] of the scanner in the world.

    Raises:
        ValueError: Walls or pose have another shape or type; while tracing.
    """
    check_array("world.walls", world.walls, ("S", 4), jnp.floating)
    check_array("pose", pose, (3,), jnp.floating)
    return to_scan(lidar, jnp.min(_distances(lidar, world, pose), axis=1))


def _distances(lidar: Lidar, world: World, pose: Array) -> Array:
    """Distances (R, S) [m] along each beam to each wall, infinite where it does not meet it."""
    beam = unit_vector(pose[2] + beam_angles(lidar))[:, None, :]  # (R, 1, 2)
    walls = jnp.asarray(world.walls)
    start = (walls[:, :2] - pose[None, :2])[None]  # (1, S, 2)
    along = (walls[:, 2:] - walls[:, :2])[None]  # (1, S, 2)
    slope = cross(beam, along)  # (R, S)
    crosses = jnp.abs(slope) > 1e-9
    safe = jnp.where(crosses, slope, 1.0)
    distance = cross(start, along) / safe  # t
    fraction = cross(start, beam) / safe  # s
    met = crosses & (distance > 1e-6) & (jnp.abs(fraction - 0.5) <= 0.5 + SEAM)
    return jnp.where(met, distance, jnp.inf)


def incidence(lidar: Lidar, world: World, pose: Array) -> Array:
    """Angle (R,) [rad] between each beam and the normal of the wall that it meets, 0 to pi / 2.

    Where it meets none, it is that of some wall.
    """
    beam = unit_vector(pose[2] + beam_angles(lidar))  # (R, 2)
    walls = jnp.asarray(world.walls)
    length = jnp.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
    along = (walls[:, 2:] - walls[:, :2]) / jnp.maximum(length, 1e-9)[:, None]
    grazing = jnp.abs(cross(beam[:, None], along[None]))  # (R, S) sine of the angle to the wall
    nearest = jnp.argmin(_distances(lidar, world, pose), axis=1)
    sine = jnp.take_along_axis(grazing, nearest[:, None], axis=1)[:, 0]
    return jnp.arccos(jnp.minimum(sine, 1.0))


def add_range_noise(key: Key, lidar: Lidar, scan: Scan, factors: Array | None = None) -> Scan:
    """Add the range noise of the lidar to a scan; ranges beyond the largest become no return.

    Args:
        key: Of the noise.
        lidar: The scanner.
        scan: Without noise.
        factors: (R,) on the standard deviation of each beam; None: 1.
    """
    noise = lidar.range_std * jax.random.normal(key, scan.ranges.shape, scan.ranges.dtype)
    if factors is not None:
        noise *= factors
    return to_scan(lidar, jnp.where(scan.hit, scan.ranges + noise, jnp.inf))
