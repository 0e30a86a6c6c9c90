"""Ray casting of a laser scanner in a world of straight walls, and range noise."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import cross, unit_vector
from jaxslam.core.types import Array, Key, check_array
from jaxslam.frontend.lidar import beam_angles, to_scan
from jaxslam.simulation.discs import Discs, as_discs, nearest_discs
from jaxslam.simulation.nearest_walls import nearest_walls
from jaxslam.simulation.worlds import World


class Hits(NamedTuple):
    """What the beams of one scan meet within the range of the scanner.

    Attributes:
        distance: (R,) [m] infinite where they meet nothing.
        wall: (R,) int32 wall that is met, or -1.
        disc: (R,) int32 disc that is met, or -1; of a beam that meets one, `wall` is -1.
    """

    distance: Array
    wall: Array
    disc: Array


class Leaving(NamedTuple):
    """Shares of beams that meet no wall; a world need not be closed.

    Attributes:
        beyond_range: () [-] of those that meet none within the range of the scanner.
        no_wall: () [-] of those that meet none at any distance: they leave the world.
    """

    beyond_range: Array
    no_wall: Array


def find_hits(lidar: Lidar, world: World, pose: Array, discs: Discs | None = None) -> Hits:
    """What each beam of a noise-free scan meets.

    Args:
        lidar: The scanner.
        world: The walls; with an index (`worlds.with_index`) many walls are fast.
        pose: (3,) [m, m, rad] of the scanner in the world.
        discs: Further things at the time of the scan; None for none.

    Raises:
        ValueError: Walls, pose or discs have another shape or type; while tracing.
    """
    check_array("world.walls", world.walls, ("S", 4), jnp.floating)
    check_array("pose", pose, (3,), jnp.floating)
    distance, wall = nearest_walls(lidar, pose, jnp.asarray(world.walls), world.wall_index)
    disc = jnp.full_like(wall, -1)
    if discs is not None and len(discs.radius):
        nearer, number = nearest_discs(lidar, pose, as_discs(discs))
        in_front = nearer < distance
        distance = jnp.where(in_front, nearer, distance)
        wall, disc = jnp.where(in_front, -1, wall), jnp.where(in_front, number, -1)
    within = distance < lidar.range_max
    return Hits(
        distance=jnp.where(within, distance, jnp.inf),
        wall=jnp.where(within, wall, -1),
        disc=jnp.where(within, disc, -1),
    )


def cast(lidar: Lidar, world: World, pose: Array, discs: Discs | None = None) -> Scan:
    """Noise-free scan of a world from a pose; arguments as those of `find_hits`."""
    return to_scan(lidar, find_hits(lidar, world, pose, discs).distance)


def incidence(
    lidar: Lidar,
    world: World,
    pose: Array,
    *,
    discs: Discs | None = None,
    hits: Hits | None = None,
) -> Array:
    """Angle (R,) [rad] between each beam and the normal of what it meets, 0 to pi / 2.

    Where it meets nothing, it is that of some wall.

    Args:
        lidar: The scanner.
        world: The walls.
        pose: (3,) [m, m, rad] of the scanner in the world.
        discs: Further things, with which the hits were found.
        hits: What the beams meet; None to find it.
    """
    found = find_hits(lidar, world, pose, discs) if hits is None else hits
    beam = unit_vector(pose[2] + beam_angles(lidar))  # (R, 2)
    wall = jnp.asarray(world.walls)[jnp.maximum(found.wall, 0)]  # (R, 4)
    length = jnp.hypot(wall[:, 2] - wall[:, 0], wall[:, 3] - wall[:, 1])
    along = (wall[:, 2:] - wall[:, :2]) / jnp.maximum(length, 1e-9)[:, None]
    sine = jnp.abs(cross(beam, along))  # of the angle to the wall
    angle = jnp.arccos(jnp.minimum(sine, 1.0))
    if discs is None or not len(discs.radius):
        return angle
    own = jnp.maximum(found.disc, 0)
    across = jnp.abs(cross(beam, jnp.asarray(discs.centre)[own] - pose[None, :2]))
    sine = across / jnp.maximum(jnp.asarray(discs.radius)[own], 1e-9)
    return jnp.where(found.disc >= 0, jnp.arcsin(jnp.minimum(sine, 1.0)), angle)


@partial(jax.jit, static_argnums=0)
def share_leaving(lidar: Lidar, world: World, poses: Array) -> Leaving:
    """Shares of the beams of scans from poses (N, 3) that meet no wall.

    Args:
        lidar: The scanner.
        world: The walls.
        poses: (N, 3) [m, m, rad] of the scanner in the world; at least one.
    """
    endless = lidar._replace(range_max=jnp.inf)
    walls = jnp.asarray(world.walls)
    distance = lax.map(lambda pose: nearest_walls(endless, pose, walls, world.wall_index)[0], poses)
    return Leaving(
        beyond_range=jnp.mean(distance >= lidar.range_max, dtype=poses.dtype),
        no_wall=jnp.mean(jnp.isinf(distance), dtype=poses.dtype),
    )


def add_range_noise(
    key: Key,
    lidar: Lidar,
    scan: Scan,
    factors: Array | None = None,
    draws: Array | None = None,
) -> Scan:
    """Add the range noise of the lidar to a scan; ranges beyond the largest become no return.

    Args:
        key: Of the noise.
        lidar: The scanner.
        scan: Without noise.
        factors: (R,) on the standard deviation of each beam; None: 1.
        draws: (R,) standard normals, instead of those of the key.
    """
    if draws is None:
        draws = jax.random.normal(key, scan.ranges.shape, scan.ranges.dtype)
    noise = lidar.range_std * draws
    if factors is not None:
        noise *= factors
    return to_scan(lidar, jnp.where(scan.hit, scan.ranges + noise, jnp.inf))
