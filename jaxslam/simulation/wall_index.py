"""Index of many walls: for each cell of the floor and each sector of directions, walls in order.

A beam from any point p of a cell into any direction of a sector can meet only walls that touch

    (cell + cone of the sector),     and none of these before its distance from the cell.

So the walls of a cell and a sector are listed in the order of their distances from the cell, in
rows of `ROW`; a beam that has met a wall needs no row whose walls are all farther than that one.

                    sector a: all the beams of a scan in it are cast together
       +------+ ' - _
       | cell |        ' - _      first[cell, a] -> row 7: walls 31, 8, 90, ...   horizon 1.2 m
       |   p  |  31     8    90                     row 8: walls 12, 4, ...       horizon 3.4 m
       +------+ _ - '                               ...   range_max, then all walls of the world

The lists are made once, on the host, from exact distances and angles with margins above rounding,
so nothing is approximate. They hold indices only: a wall may vanish later, when its ends are made
equal (an open door), but no wall may move.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxslam.core.types import AnyArray, as_float64, as_size

ROW = 8  # walls that are tried together
SECTORS = 32
ANGLE_MARGIN = 1e-3  # [rad] above the rounding of directions
MAX_ENTRIES = 2_000_000  # of all the lists, about; cells are larger where it would be more
PAIRS = 400_000  # of a cell and a wall whose distances are found together


class WallIndex(NamedTuple):
    """Walls by cell and sector; N rows of `ROW` walls, of C cells and A sectors.

    Sector a holds the directions from 2 pi a / A to 2 pi (a + 1) / A, world frame.

    Attributes:
        origin: (2,) [m] lower left corner of cell 0.
        cell_size: () [m] side of a cell.
        shape: (2,) int32 number of cells along x and y; cell (i, j) has number i * shape[1] + j.
        first: (C, A) int32 first row of each list; row 0 begins the list of all walls.
        walls: (N, ROW) int32 indices of walls; the last one is repeated to the end of a row.
        horizon: (N,) [m] what is not in the list up to this row is farther than this; below 0
            where nothing is known, infinite at the end of the list of all walls.
        following: (N,) int32 the row after this one.
    """

    origin: AnyArray
    cell_size: AnyArray
    shape: AnyArray
    first: AnyArray
    walls: AnyArray
    horizon: AnyArray
    following: AnyArray


def index_walls(walls: AnyArray, range_max: float) -> WallIndex:
    """Index the walls of a world; in NumPy.

    Args:
        walls: (S, 4) [m] at least one; those whose ends are equal are never met, and left out.
        range_max: [m] range of the scanner. Beams are exact beyond it, too, but slow.

    Raises:
        ValueError: Walls or range are not possible.
    """
    segments = as_float64("walls", walls, ("S", 4))
    if not len(segments) or not np.isfinite(segments).all():
        raise ValueError(f"walls is {segments.shape}, not at least one wall of finite numbers")
    reach = as_size("range_max", range_max, positive=True)
    present = np.flatnonzero((segments[:, :2] != segments[:, 2:]).any(axis=1))
    segments = segments[present]
    margin = 1e-3 + 1e-6 * np.abs(segments).max(initial=0.0)  # [m] above the rounding of float32
    along = segments[:, 2:] - segments[:, :2]
    segments = segments + 2e-5 * np.hstack([-along, along])  # `nearest_walls.SEAM`, and more
    corners = segments.reshape(-1, 2) if len(present) else np.zeros((1, 2))
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    side = _cell_size(segments, high - low, reach)
    shape = np.maximum(1, np.ceil((high - low) / side)).astype(int)

    number = np.arange(shape.prod())
    centres = low + (np.stack(np.divmod(number, shape[1]), axis=1) + 0.5) * side
    parts: list[tuple[np.ndarray, ...]] = [_list_of_all(len(walls), reach)]
    first, count = [], len(parts[0][0])
    empty = count - 1
    for own in np.array_split(centres, -(-len(centres) * len(walls) // PAIRS)):
        lists, wall, distance = _lists(segments, own, side / math.sqrt(2.0) + margin, reach)
        wall = present[wall]
        begin, *part = _rows(lists, wall, distance, len(own) * SECTORS, reach)
        first.append(np.where(begin < 0, empty, begin + count))
        part[2] = np.where(part[2] > 0, part[2] + count, 0)
        parts.append(tuple(part))
        count += len(part[0])
    rows, horizon, following = (np.concatenate(column) for column in zip(*parts, strict=True))
    return WallIndex(
        origin=low,
        cell_size=np.array(side),
        shape=shape.astype(np.int32),
        first=np.concatenate(first).reshape(-1, SECTORS).astype(np.int32),
        walls=rows.astype(np.int32),
        horizon=horizon,
        following=following.astype(np.int32),
    )


def _cell_size(segments: np.ndarray, extent: np.ndarray, reach: float) -> float:
    """Side [m] of cells with which the lists have about `MAX_ENTRIES` entries."""
    area = float(np.prod(np.maximum(extent, 1.0)))
    length = np.hypot(*(segments[:, 2:] - segments[:, :2]).T)
    within = np.minimum(np.pi * reach**2 + 2 * reach * length, area)  # [m^2] of cells that list it
    per_sector = 1.5  # a wall is in more than one
    budget = per_sector * within.sum() / MAX_ENTRIES
    return math.sqrt(max(budget, area / max(1, len(segments))))


def _list_of_all(count: int, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, horizons and following rows of the list of all walls, and of an empty list after it."""
    rows = np.minimum(np.arange(-(-count // ROW) * ROW + ROW), count - 1).reshape(-1, ROW)
    horizon = np.full(len(rows), -1.0)
    horizon[-2:] = np.inf, reach
    following = np.arange(1, len(rows) + 1)
    following[-2:] = len(rows) - 2, 0
    return rows, horizon, following


def _lists(
    segments: np.ndarray, centres: np.ndarray, radius: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List (number of the cell times A, plus sector), wall and distance [m] of each entry.

    Args:
        segments: (S, 4) [m] walls.
        centres: (C, 2) [m] of cells.
        radius: [m] of a circle around a cell.
        reach: [m] walls farther than this from the circle are left out.
    """
    ends = segments.reshape(-1, 2, 2)
    around = centres.min(axis=0) - radius - reach, centres.max(axis=0) + radius + reach
    near = (ends.max(axis=1) >= around[0]).all(axis=1) & (ends.min(axis=1) <= around[1]).all(axis=1)
    near = np.flatnonzero(near)
    along = segments[near, 2:] - segments[near, :2]
    to = segments[near, :2] - centres[:, None]  # (C, K, 2)
    part = np.clip(-np.sum(to * along, axis=2) / np.sum(along**2, axis=1), 0.0, 1.0)
    distance = np.linalg.norm(to + part[..., None] * along, axis=2) - radius
    cell, wall = np.nonzero(distance <= reach)
    distance = np.maximum(distance[cell, wall], 0.0)

    # Directions to a wall from all points of a circle, also to lines that touch it and an end.
    x, y = np.moveaxis(ends[near[wall]] - centres[cell][:, None], 2, 0)  # (E, 2) of its ends
    angle, far = np.arctan2(y, x), np.hypot(x, y)
    angle[:, 1] = angle[:, 0] + (angle[:, 1] - angle[:, 0] + np.pi) % (2 * np.pi) - np.pi
    spread = np.arcsin(np.minimum(radius / np.maximum(far, radius), 1.0)) + ANGLE_MARGIN
    width = 2 * np.pi / SECTORS
    low = np.floor((angle - spread).min(axis=1) / width).astype(int)
    high = np.floor((angle + spread).max(axis=1) / width).astype(int)
    all_around = (distance == 0.0) | (high - low >= SECTORS)
    number = np.where(all_around, SECTORS, high - low + 1)  # of sectors, from `low` on
    entry = np.repeat(np.arange(len(cell)), number)
    sector = low[entry] + np.arange(len(entry)) - np.repeat(np.cumsum(number) - number, number)
    return cell[entry] * SECTORS + sector % SECTORS, near[wall[entry]], distance[entry]


def _rows(
    lists: np.ndarray, wall: np.ndarray, distance: np.ndarray, num: int, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First row (num,) of each list, -1 of empty ones, and the rows: walls, horizon, following row.

    Args:
        lists: (E,) list of each entry.
        wall: (E,) its wall.
        distance: (E,) [m] its distance.
        num: Number of lists.
        reach: [m] horizon at the end of a list, which 0 follows.
    """
    order = np.lexsort((distance, lists))
    wall, distance = wall[order], distance[order]
    count = np.bincount(lists, minlength=num)
    height = -(-count // ROW)
    begin, entry = np.cumsum(height) - height, np.cumsum(count) - count
    total = height.sum()
    own = np.repeat(np.arange(num), height)  # list of each row
    start = entry[own] + ROW * (np.arange(total) - begin[own])
    last = (entry + count - 1)[own]
    rows = wall[np.minimum(start[:, None] + np.arange(ROW), last[:, None])]
    ends = start + ROW > last
    following = np.where(ends, 0, np.arange(1, total + 1))
    horizon = np.where(ends, reach, distance[np.where(ends, 0, start + ROW)])
    return np.where(height > 0, begin, -1), rows, horizon, following
