"""Occupancy map of scans at known poses."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.maps import MAX_CELLS, OccupancyMap
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import as_float64, check_array
from jaxslam.frontend.lidar import beam_angles

# A cell is occupied if more than this fraction of the beams at it end in it.
OCCUPIED_FRACTION = 0.25
MAX_GAP = 0.2  # [m] between two beams that pass beside a cell, so that it is free
BETWEEN = (-0.25, 0.0, 0.25)  # of the angle between two beams, where space is free between them
BATCH = 128  # scans at a time
MARGIN = 0.5  # [m] of unknown cells around the map

# One program, not one for each of its operations.
_beam_angles = jax.jit(beam_angles, static_argnums=0)


def occupancy_map(
    lidar: Lidar, poses: ArrayLike, scans: Scan, *, resolution: float
) -> OccupancyMap:
    """Occupancy map from scans at known poses, by counting.

    A beam that hit something is sampled every half cell. It counts as a pass once in each cell that
    it crosses (but for corners that it cuts by less than half a cell) and as a hit in the cell
    where it ends. A cell is occupied if

        hits > OCCUPIED_FRACTION (passes + hits)

    free if it was passed and is not occupied, else unknown. A cell that no beam has passed is free
    if it lies between two neighbouring beams, no more than `MAX_GAP` apart there, that both end
    beyond it. Beams without a return are not used: they may have passed glass.

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
    scan_poses, ranges, hit = scan_poses[finite], ranges[finite], hit[finite]
    angle = scan_poses[:, 2:] + np.asarray(_beam_angles(lidar), np.float64)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (T, R, 2)
    ends = scan_poses[:, None, :2] + ranges[..., None] * directions
    low, size, resolution = _extent(np.concatenate([ends[hit], scan_poses[:, :2]]), resolution)
    counts = np.zeros((2, np.prod(size)), np.int64)  # passes, hits
    beside = np.zeros(counts.shape[1], bool)  # passed between two beams
    gap = 2.0 * np.sin(0.5 * lidar.angle_increment)  # between two beams, per metre
    between = 0.5 * (angle[:, 1:] + angle[:, :-1])
    nearer = np.where(hit[:, 1:] & hit[:, :-1], np.minimum(ranges[:, 1:], ranges[:, :-1]), 0.0)
    nearer = np.minimum(nearer, MAX_GAP / gap)
    first = resolution / gap
    for t in range(0, len(scan_poses), BATCH):
        part = slice(t, t + BATCH)
        start = np.broadcast_to((scan_poses[part, None, :2] - low) / resolution, ends[part].shape)
        struck = hit[part]
        length = ranges[part][struck] / resolution
        rays = start[struck], directions[part][struck]
        row, column = np.floor((ends[part][struck] - low) / resolution).astype(np.int32).T
        end_cell = row * np.int32(size[1]) + column
        cell, beam = _passed(size, *rays, length, spacing=0.5)
        # Samples of one beam in one cell follow each other: the first of them counts.
        new = np.append(True, (cell[1:] != cell[:-1]) | (beam[1:] != beam[:-1]))[: cell.size]
        new &= cell != end_cell[beam]
        counts[0] += np.bincount(cell[new], minlength=counts.shape[1])
        counts[1] += np.bincount(end_cell, minlength=counts.shape[1])
        # Between two beams, from where they are a cell apart.
        far = nearer[part] > first
        length = (nearer[part][far] - first) / resolution - 1.0
        for share in BETWEEN:
            turn = between[part][far] + share * lidar.angle_increment
            ahead = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            begin = start[:, :-1][far] + first / resolution * ahead
            beside[_passed(size, begin, ahead, length, spacing=1.0)[0]] = True
    passes, hits = counts
    occupied = hits > OCCUPIED_FRACTION * (passes + hits)
    free = ((passes > 0) | beside) & ~occupied
    return OccupancyMap(occupied.reshape(size), free.reshape(size), resolution, np.append(low, 0.0))


def _passed(
    size: np.ndarray,
    start: np.ndarray,
    direction: np.ndarray,
    length: np.ndarray,
    *,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices (N,) of the cells of samples of rays, in order, and the ray of each.

    Args:
        size: (2,) of the grid.
        start: (B, 2) [cells] where each ray begins.
        direction: (B, 2) of each.
        length: (B,) [cells] of each; below 0, it has no samples.
        spacing: [cells] between samples.
    """
    count = np.maximum(np.ceil(length / spacing), 0).astype(np.int32)
    ray = np.repeat(np.arange(len(count), dtype=np.int32), count)
    first = np.cumsum(count) - count
    number = np.arange(ray.size, dtype=np.int32) - np.repeat(first.astype(np.int32), count)
    along = np.float32(spacing) * number.astype(np.float32)
    row, column = (
        (
            np.repeat(start[:, k].astype(np.float32), count)
            + along * np.repeat(direction[:, k].astype(np.float32), count)
        ).astype(np.int32)
        for k in (0, 1)
    )
    return row * np.int32(size[1]) + column, ray


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
