"""Round things that a scanner meets besides walls: people, carts, columns."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import cross, dot, unit_vector
from jaxslam.core.types import AnyArray, Array, check_array
from jaxslam.frontend.lidar import beam_angles
from jaxslam.simulation.nearest import Beams, search

GRAZING = 1e-4  # [m] half of the shortest chord with which derivatives are taken


class Discs(NamedTuple):
    """Circles, at one moment; like walls they have no inside: from within, a beam meets the rim.

    Attributes:
        centre: (K, 2) [m] world frame.
        radius: (K,) [m]; those not above 0 are padding, and are not met.
    """

    centre: AnyArray
    radius: AnyArray


class _Seen(NamedTuple):
    """Discs as a scanner sees them.

    Attributes:
        x: (...) [m] centre, from the scanner, axes of the world.
        y: (...) [m] likewise.
        radius: (...) [m].
    """

    x: Array
    y: Array
    radius: Array


def _distance(beams: Beams, disc: _Seen) -> Array:
    """Distances [m] along beams to discs; infinite where they are not met.

    With c = centre - p and w = u x c, the beam meets the circle at u . c -/+ sqrt(r^2 - w^2).
    """
    across = beams[0] * disc.y - beams[1] * disc.x
    along = beams[0] * disc.x + beams[1] * disc.y
    squared = disc.radius * disc.radius - across * across
    half = jnp.sqrt(jnp.maximum(squared, 0.0))
    distance = jnp.where(along - half > 1e-6, along - half, along + half)
    met = (squared >= 0.0) & (disc.radius > 0.0) & (distance > 1e-6)
    return jnp.where(met, distance, jnp.inf)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def nearest_discs(lidar: Lidar, pose: Array, discs: Discs) -> tuple[Array, Array]:
    """Distance to the nearest disc along each beam, and which it is.

    Args:
        lidar: The scanner; its range does not matter.
        pose: (3,) [m, m, rad] in the world.
        discs: At least one.

    Returns:
        Distances (R,) [m], infinite where a beam meets none, and discs (R,) int32, there -1. The
        derivative of a distance is that to its disc; at a grazing beam, where it has none, a
        finite one is taken (`GRAZING`).
    """
    beam = unit_vector(pose[2] + beam_angles(lidar))
    x, y = discs.centre[:, 0] - pose[0], discs.centre[:, 1] - pose[1]
    return search(
        _distance, (beam[:, 0], beam[:, 1]), _Seen(*map(jnp.asarray, (x, y, discs.radius)))
    )


@nearest_discs.defjvp
def _derivative(lidar: Lidar, primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """Discs do not change with a small step; the distance to each does."""
    distance, disc = nearest_discs(lidar, *primals)
    met = disc >= 0

    def to_same(pose: Array, discs: Discs) -> Array:
        beam = unit_vector(pose[2] + beam_angles(lidar))
        to = discs.centre[jnp.maximum(disc, 0)] - pose[None, :2]
        squared = discs.radius[jnp.maximum(disc, 0)] ** 2 - cross(beam, to) ** 2
        half = jnp.sqrt(jnp.where(met & (squared > GRAZING**2), squared, GRAZING**2))
        along = dot(beam, to)
        return jnp.where(distance < along, along - half, along + half)

    _, slope = jax.jvp(to_same, primals, tangents)
    no_tangent = np.zeros(disc.shape, jax.dtypes.float0)
    return (distance, disc), (jnp.where(met, slope, 0.0), no_tangent)


def as_discs(discs: Discs) -> Discs:
    """The same as JAX arrays; raise ValueError, while tracing, if their shapes or types differ."""
    check_array("discs.centre", discs.centre, ("K", 2), jnp.floating)
    check_array("discs.radius", discs.radius, (len(discs.centre),), jnp.floating)
    return Discs(*map(jnp.asarray, discs))
