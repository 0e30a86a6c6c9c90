"""Levels of grids of one scan, from the finest to the coarsest, and what each of them holds.

The finest grid ends some metres from the robot, and its fronts after a fixed number of steps. A
coarser one reaches as many times farther as its cells are larger, at the same number of steps:

    +-----------------------------------+
    |  level 1: cells of 40 cm          |       A junction belongs to the finest level that can
    |       +-----------------+         |       hold it: the square around its circle ends before
    |       |  level 0: 10 cm |         |       the grid does, and its fronts get that far.
    |       |        R        |         |
    +-------+-----------------+---------+
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.core.types import Array
from jaxslam.frontend.grid import GridSpec, grid_origin


class Level(NamedTuple):
    """One level of the pyramid; static under jit.

    Attributes:
        grid: Its grid.
        reach: [m] largest clearance that it can hold: so far do its fronts get.
        scale: Side of its cells in those of the finest level.
    """

    grid: GridSpec
    reach: float
    scale: float


def make_level(grid: GridSpec, finest: GridSpec, max_clearance: float, steps: int) -> Level:
    """A level of the pyramid.

    Args:
        grid: Its grid.
        finest: That of the finest level.
        max_clearance: [m] largest clearance on the finest level; grows with the cells.
        steps: Number of steps of the automaton.
    """
    scale = grid.cell_size / finest.cell_size
    return Level(grid, min(max_clearance * scale, steps * grid.cell_size), scale)


def fit_to_range(lidar: Lidar, spec: GridSpec) -> GridSpec:
    """The grid without the rows and columns of cells that are out of the scanner's range.

    Args:
        lidar: The scanner.
        spec: The grid.
    """
    size = spec.cell_size
    farthest = math.ceil(lidar.range_max / size) * size
    return spec._replace(
        x_max=min(spec.x_max, farthest),
        x_min=max(spec.x_min, -farthest),
        y_half=min(spec.y_half, farthest),
    )


def largest_radius(x: Array, y: Array, level: Level, coarser: Level) -> Array:
    """Largest radius (...) [m] of a circle that a level can hold, by the centre of the circle.

    It is the reach of the level, or the distance to the edge of the grid if that is less; below 0
    outside. An edge counts only where the next level reaches farther, by two cells of this level.

    Args:
        x: (...) [m] of the centre, robot frame.
        y: (...) [m] of the centre, robot frame.
        level: The level.
        coarser: The next level.
    """
    own, wider = level.grid, coarser.grid
    least = 2 * own.cell_size
    radius = jnp.full_like(x, level.reach)
    if wider.x_max > own.x_max + least:
        radius = jnp.minimum(radius, own.x_max - x)
    if wider.x_min < own.x_min - least:
        radius = jnp.minimum(radius, x - own.x_min)
    if wider.y_half > own.y_half + least:
        radius = jnp.minimum(radius, own.y_half - jnp.abs(y))
    return radius


def beyond_finer(arrival: Array, level: Level, finer: Level) -> Array:
    """Cells (H, W) bool of a level whose largest empty circle the finer level may not hold.

    Args:
        arrival: (H, W) unsigned step at which the first front arrived at each cell.
        level: The level.
        finer: The level before.
    """
    grid = level.grid
    with jax.ensure_compile_time_eval():
        x, y = (np.indices(grid.shape) + 0.5) * grid.cell_size + grid_origin(grid)[:, None, None]
        radius = largest_radius(jnp.asarray(x), jnp.asarray(y), finer, level)
        # Fronts advance by up to 1.12 cells in a step, and start from the cell of a wall.
        steps = jnp.maximum(jnp.floor(0.9 * radius / grid.cell_size) - 1.0, -1.0)
        steps = steps.astype(jnp.int16)
    return arrival.astype(jnp.int16) > steps
