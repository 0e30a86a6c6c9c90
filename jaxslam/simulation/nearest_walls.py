"""The nearest wall along each beam of a scan: among all walls, or by the index of a world.

A beam along unit vector u from p meets the wall a + s (b - a), 0 <= s <= 1, at the distance

    t = (a - p) x (b - a) / (u x (b - a)),    where    s = (a - p) x u / (u x (b - a)).
"""

import math
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import sequential_vmap_on_cpu
from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import cross, unit_vector
from jaxslam.core.types import Array
from jaxslam.frontend.lidar import beam_angles
from jaxslam.simulation.nearest import NONE, nearest_of, search, with_none
from jaxslam.simulation.wall_index import WallIndex

SEAM = 1e-5  # fraction of its length by which a wall is lengthened at either end


class _Lines(NamedTuple):
    """Walls as a scanner sees them.

    Attributes:
        start: x, y (...) [m] of the first end, from the scanner, axes of the world.
        along: x, y (...) [m] from the first end to the second.
        moment: (...) [m^2] start x along.
    """

    start: tuple[Array, Array]
    along: tuple[Array, Array]
    moment: Array


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def nearest_walls(
    lidar: Lidar, pose: Array, walls: Array, index: WallIndex | None
) -> tuple[Array, Array]:
    """Distance to the nearest wall along each beam, and which it is.

    Args:
        lidar: The scanner.
        pose: (3,) [m, m, rad] in the world.
        walls: (S, 4) [m] ends.
        index: Of these walls; None to try all of them.

    Returns:
        Distances (R,) [m], infinite where a beam meets no wall, and walls (R,) int32, there -1.
        Where walls meet at the same distance it is the first. With an index, what lies beyond
        `lidar.range_max` may be missed. The derivative of a distance is that to its wall.
    """
    if index is None:
        beam = unit_vector(pose[2] + beam_angles(lidar))
        return search(_distance, (beam[:, 0], beam[:, 1]), _lines(pose, walls))
    return sequential_vmap_on_cpu(partial(_by_index, lidar))(pose, walls, index)


@nearest_walls.defjvp
def _derivative(lidar: Lidar, primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """Walls and their number do not change with a small step; the distance to each does."""
    pose, walls, index = primals
    distance, wall = nearest_walls(lidar, pose, walls, index)

    def to_same(pose: Array, walls: Array) -> Array:
        beam = unit_vector(pose[2] + beam_angles(lidar))
        lines = _lines(pose, walls[jnp.maximum(wall, 0)])
        slope = cross(beam, jnp.stack(lines.along, axis=-1))
        return lines.moment / jnp.where(wall >= 0, slope, 1.0)

    _, slope = jax.jvp(to_same, (pose, walls), tangents[:2])
    no_tangent = np.zeros(wall.shape, jax.dtypes.float0)
    return (distance, wall), (jnp.where(wall >= 0, slope, 0.0), no_tangent)


def _lines(pose: Array, walls: Array) -> _Lines:
    """Walls (..., 4) as they are from a pose (3,)."""
    start = walls[..., 0] - pose[0], walls[..., 1] - pose[1]
    along = walls[..., 2] - walls[..., 0], walls[..., 3] - walls[..., 1]
    return _Lines(start, along, start[0] * along[1] - start[1] * along[0])


def _distance(beam: tuple[Array, Array], line: _Lines) -> Array:
    """Distances [m] along beams, x and y of unit vectors, to lines; infinite where none is met."""
    slope = beam[0] * line.along[1] - beam[1] * line.along[0]
    crosses = jnp.abs(slope) > 1e-9
    safe = jnp.where(crosses, slope, 1.0)
    distance = line.moment / safe  # t
    fraction = (line.start[0] * beam[1] - line.start[1] * beam[0]) / safe  # s
    met = crosses & (distance > 1e-6) & (jnp.abs(fraction - 0.5) <= 0.5 + SEAM)
    return jnp.where(met, distance, jnp.inf)


def _by_index(lidar: Lidar, pose: Array, walls: Array, index: WallIndex) -> tuple[Array, Array]:
    """`nearest_walls` with an index: all sectors at once, a row of the list of each in each step.

    The beams of a scan that lie in a sector are a column of arrays (W, Q): W is the most that fit
    into a sector, Q the number of sectors that a scan touches at most.
    """
    cells, sectors = index.first.shape
    width = 2 * math.pi / sectors
    num_sectors = int((lidar.num_beams - 1) * lidar.angle_increment / width) + 2  # Q
    most = min(lidar.num_beams, int(width / lidar.angle_increment) + 2)  # W
    begin = pose[2] + lidar.angle_min
    sector = jnp.floor(begin / width) + jnp.arange(num_sectors, dtype=pose.dtype)
    edge = jnp.ceil((sector[1:] * width - begin) / lidar.angle_increment).astype(jnp.int32)
    edge = jnp.clip(edge, 0, lidar.num_beams)  # (Q - 1,) first beam of each sector but the first
    first = jnp.pad(edge, (1, 0))
    last = jnp.pad(edge, (0, 1), constant_values=lidar.num_beams)
    number = first[None] + jnp.arange(most, dtype=jnp.int32)[:, None]  # (W, Q) of the beam
    angle = lidar.angle_min + lidar.angle_increment * number.astype(float)
    x_y = jnp.cos(pose[2] + angle), jnp.sin(pose[2] + angle)

    cell = jnp.floor((pose[:2] - index.origin) / index.cell_size).astype(jnp.int32)
    inside = jnp.all((cell >= 0) & (cell < index.shape))
    cell = jnp.clip(cell[0] * index.shape[1] + cell[1], 0, cells - 1)
    row = index.first[cell, jnp.mod(sector.astype(jnp.int32), sectors)]
    row = jnp.where(inside, row, 0)

    def body(state: tuple) -> tuple:
        best, row, _ = state
        wall = index.walls[row].T  # (ROW, Q)
        lines = lax.optimization_barrier(_lines(pose, walls[wall]))  # gather once, not per beam
        each = [jax.tree.map(itemgetter((k, None)), lines) for k in range(len(wall))]
        distances = [_distance(x_y, line) for line in each]
        best = nearest_of(best, distances, list(wall[:, None]))
        open_ = jnp.minimum(jnp.max(best[0], axis=0), lidar.range_max) > index.horizon[row]
        return best, jnp.where(open_, index.following[row], row), open_

    # Beams that the last sectors of a scan lack count as having met a wall.
    start = jnp.where(number < last[None], jnp.inf, 0.0).astype(x_y[0].dtype)
    none = start, jnp.full(number.shape, NONE)
    state = none, row, jnp.ones(num_sectors, bool)
    best, *_ = lax.while_loop(lambda state: jnp.any(state[2]), body, state)
    distance, wall = with_none(best)

    beam = jnp.arange(lidar.num_beams, dtype=jnp.int32)
    own = jnp.sum(beam[:, None] >= edge[None], axis=1, dtype=jnp.int32)  # its sector
    at = (beam - first[own]) * num_sectors + own
    return distance.reshape(-1)[at], wall.reshape(-1)[at]
