"""Occupancy map of scans at known poses."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.maps import MAX_CELLS, OccupancyMap
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import as_float64, check_array
from jaxslam.frontend.lidar import beam_angles

# A cell is occupied if more than this fraction of the beams at it end in it.
OCCUPIED_FRACTION = 0.25
MARGIN = 0.5  # [m] of unknown cells around the map


def occupancy_map(
    lidar: Lidar, poses: ArrayLike, scans: Scan, *, resolution: float
) -> OccupancyMap:
    """Occupancy map from scans at known poses, by counting.

    A beam that hit something is sampled every half cell. It counts as a pass once in each cell that
    it crosses (but for corners that it cuts by less than half a cell) and as a hit in the cell
    where it ends. A cell is occupied if

        hits > OCCUPIED_FRACTION (passes + hits)

    free if it was passed and is not occupied, else unknown. Beams without a return are not used:
    they may have passed glass.

    Args:
        lidar: The scanner.
        poses: (T, 3) [m, m, rad] of the scanner, map frame; those that are not finite are left out.
        scans: [T].
        resolution: [m] side of a cell; doubled until the map has no more than `MAX_CELLS` cells.

    Raises:
        ValueError: The resolution is not positive, no pose is finite, or an argument has another
            type or shape.
    """
    for name, record, kind in (("lidar", lidar, Lidar), ("scans", scans, Scan)):
        if not isinstance(record, kind):
            raise ValueError(f"{name} is of type {type(record).__name__}, not {kind.__name__}")
    scan_poses = as_float64("poses", poses, ("T", 3))
    shape = len(scan_poses), lidar.num_beams
    ranges, hit = as_float64("scans.ranges", scans.ranges, shape), np.asarray(scans.hit)
    check_array("scans.hit", hit, shape, jnp.bool_)
    if not 0.0 < resolution < np.inf:
        raise ValueError(f"resolution is {resolution}, not a positive number of metres")
    finite = np.isfinite(scan_poses).all(axis=1)
    if not finite.any():
        raise ValueError("poses: no pose is finite")
    scan_poses = scan_poses[finite]
    ranges, hit = ranges[finite], hit[finite]
    angle = scan_poses[:, 2:] + np.asarray(beam_angles(lidar), np.float64)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (T, R, 2)
    ends = scan_poses[:, None, :2] + ranges[..., None] * directions
    low, size, resolution = _extent(np.concatenate([ends[hit], scan_poses[:, :2]]), resolution)
    passes, hits = np.zeros(np.prod(size), np.int32), np.zeros(np.prod(size), np.int32)

    def cell_of(points: np.ndarray) -> np.ndarray:
        """Flat indices (N,) of the cells of points (N, 2)."""
        return np.floor((points - low) / resolution).astype(int) @ [size[1], 1]

    for t in range(len(scan_poses)):
        end_cell = cell_of(ends[t, hit[t]])
        num_samples = np.ceil(2.0 * ranges[t, hit[t]] / resolution).astype(int)
        beam = np.repeat(np.arange(len(num_samples)), num_samples)  # of each sample
        sample = np.arange(beam.size) - np.repeat(np.cumsum(num_samples) - num_samples, num_samples)
        step = 0.5 * resolution * sample[:, None] * directions[t, hit[t]][beam]
        cell = cell_of(scan_poses[t, :2] + step)
        # Samples of one beam in one cell follow each other: the first of them counts.
        first = np.append(True, (cell[1:] != cell[:-1]) | (beam[1:] != beam[:-1]))[: cell.size]
        np.add.at(passes, cell[first & (cell != end_cell[beam])], 1)
        np.add.at(hits, end_cell, 1)
    occupied = hits > OCCUPIED_FRACTION * (passes + hits)
    free = (passes > 0) & ~occupied
    return OccupancyMap(occupied.reshape(size), free.reshape(size), resolution, np.append(low, 0.0))


def _extent(points: np.ndarray, resolution: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Grid around points (N, 2) [m]: its corner (2,) [m], its size (2,) in cells, its resolution.

    The corner is a multiple of the resolution, which is doubled until there are at most
    `MAX_CELLS`.
    """
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    while np.prod(np.ceil((high - low) / resolution) + 1.0) > MAX_CELLS:
        resolution *= 2.0
    low = np.floor(low / resolution) * resolution
    return low, np.ceil((high - low) / resolution).astype(int), resolution
