"""The automaton on the complete global grid, with which the paper compares its local diagrams.

The whole world is known: every cell is free or occupied. The automaton expands the twelve edge
codes of such a grid (`frontend.global_edge_codes`) until nothing changes. There is no robot and no
filter; what is compared is the time, and the junctions with those of the exact Voronoi diagram.

References:
    Paper, section 2.2.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from experiments import common, ground_truth
from experiments.timing import fastest
from jaxslam.core.batching import map_batches
from jaxslam.core.scan import Scan
from jaxslam.frontend import extract
from jaxslam.frontend.automaton import Diagram
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.global_edge_codes import global_edge_code_bits, global_edge_codes
from jaxslam.frontend.tiled_automaton import expand_tiled
from jaxslam.frontend.voronoi import junction_cells
from jaxslam.simulation import drives, worlds

NAME = "global_automaton"
MATCH_DISTANCE = 0.2  # [m] within which a junction agrees with an exact one
MARGIN = 4  # cells around the walls
REPEATS = 3


class GlobalGrid(NamedTuple):
    """A complete occupancy grid: what is not free is occupied.

    Attributes:
        free: (H, W) bool; rows grow with x, columns with y.
        origin: (2,) [m] outer corner of cell [0, 0].
        cell_size: [m].
    """

    free: np.ndarray
    origin: np.ndarray
    cell_size: float

    def centres(self, index: np.ndarray) -> np.ndarray:
        """Centres (N, 2) [m] of cells (N, 2), or of fractional indices."""
        return self.origin + (index + 0.5) * self.cell_size


def rasterise(walls: np.ndarray, start: np.ndarray, cell_size: float) -> GlobalGrid:
    """Complete grid of walls (S, 4) [m], seen from all points that can be reached from `start`.

    Walls are two cells thick, as in the local grid: with one cell both sides of a wall between
    two corridors would have the same edge code. Borders of cells are on multiples of `cell_size`.

    Args:
        walls: (S, 4) [m].
        start: (2,) [m] a point in free space.
        cell_size: [m].

    Raises:
        ValueError: `start` is on a wall or outside of the grid.
    """
    ends = walls.reshape(-1, 2)
    low = np.floor(ends.min(axis=0) / cell_size) - MARGIN
    shape = (np.ceil(ends.max(axis=0) / cell_size) + MARGIN - low).astype(int)
    grid = GlobalGrid(np.zeros(shape, bool), low * cell_size, cell_size)
    centres = grid.centres(np.stack(np.indices(shape), axis=-1).reshape(-1, 2))
    off_walls = (ground_truth.clearance(centres, walls) >= cell_size - 1e-9).reshape(shape)
    region, _ = ndimage.label(off_walls)
    cell = np.floor((np.asarray(start) - grid.origin) / cell_size).astype(int)
    if np.any((cell < 0) | (cell >= shape)) or not off_walls[tuple(cell)]:
        raise ValueError(f"start {start} is on a wall or outside of the grid")
    return grid._replace(free=region == region[tuple(cell)])


def global_diagram(free: np.ndarray) -> Diagram:
    """Voronoi diagram (H, W) of a complete grid by the automaton, until nothing changes."""
    labels = global_edge_code_bits(global_edge_codes(jnp.asarray(~free)))
    return expand_tiled(labels, free)


def junctions_of(grid: GlobalGrid, diagram: Diagram) -> np.ndarray:
    """Centres (J, 2) [m] of the clusters of junction cells."""
    cells = np.asarray(junction_cells(diagram, jnp.asarray(~grid.free)))
    clusters, count = ndimage.label(cells, np.ones((3, 3)))
    centres = ndimage.center_of_mass(cells, clusters, np.arange(1, count + 1))
    return grid.centres(np.array(centres).reshape(-1, 2))


def agreement(found: np.ndarray, true: np.ndarray) -> common.Numbers:
    """Numbers of junctions, and of those within `MATCH_DISTANCE` of one of the other set."""
    correct = cKDTree(true).query(found)[0] <= MATCH_DISTANCE
    seen = cKDTree(found).query(true)[0] <= MATCH_DISTANCE
    return {
        "junctions": len(found),
        "junctions_correct": int(np.sum(correct)),
        "true_junctions": len(true),
        "true_junctions_found": int(np.sum(seen)),
    }


@partial(jax.jit, static_argnames="config")
def _local_diagrams(config: FrontendConfig, scans: Scan) -> Diagram:
    def diagram(scan: Scan) -> Diagram:
        return extract.extract_diagram(config, scan)[1]  # the features are not compiled

    return map_batches(diagram, scans, batch_size=extract.SCAN_BATCH)


def compute(seed: int, world: str = "office") -> common.Numbers:
    """Row of the table: no filter errors, but times, and agreement of the junctions."""
    config = FrontendConfig(labels="codes")
    walls = ground_truth.without_padding(np.asarray(worlds.named(world).walls))
    own, robot, path, num_scans = common.drive_in(world)
    grid = rasterise(walls, np.asarray(path[0]), config.grid.cell_size)
    _, _, scans = drives.simulate_scans(
        jax.random.key(seed), config.lidar, robot, own, path, num_scans=num_scans
    )
    calls = {"grid": (global_diagram, grid.free), "local": (_local_diagrams, config, scans)}
    seconds = fastest(calls, repeats=REPEATS)
    true = ground_truth.junctions(walls, ground_truth.FreeSpace(walls)).xy
    return {
        "name": NAME,
        **dict.fromkeys(("position_rmse_m", "heading_rmse_deg", "nees", "diverged", "runs")),
        "cells": list(grid.free.shape),
        "seconds_per_grid": seconds["grid"],
        "scans": num_scans,
        "seconds_of_local_diagrams": seconds["local"],
        "match_m": MATCH_DISTANCE,
        **agreement(junctions_of(grid, global_diagram(grid.free)), true),
    }
