"""Drives that are found: through all rooms of any world, or from S to F.

    walls -> cells where the robot fits (`wall_grid`) -> a stop in each room, and the medial axis
    of the cells through all stops, as a graph (`medial_graph`) -> order of the stops
    (`visiting_order`) -> path over the graph, smoothed (`path_smoothing`)

A route from S to F is the shortest path over the cells, with a small cost of cells near walls.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csgraph, csr_array

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap
from jaxslam.core.types import as_float64
from jaxslam.simulation.medial_graph import medial_graph, room_stops
from jaxslam.simulation.path_smoothing import PREFERRED, smooth
from jaxslam.simulation.visiting_order import visiting_order
from jaxslam.simulation.wall_grid import WallGrid, cell_at, choose_region, wall_grid

NEAR_WALL_COST = 0.15  # of a step along a wall, relative to its length: what a route is longer by
TURN_BACK = -0.5  # cosine between the directions into and out of a stop where the robot turns
DIRECTION_LENGTH = 0.4  # [m] along the path by which these directions are measured


class FoundDrive(NamedTuple):
    """A drive that was found.

    Attributes:
        path: (N, 2) [m, world] as `simulation.arguments.as_path` takes it.
        stops: (K, 2) [m] that it passes by, in order: one in each room, or S and F.
        length: [m].
        notes: What was chosen and what was left out.
    """

    path: np.ndarray
    stops: np.ndarray
    length: float
    notes: tuple[str, ...]


def patrol(
    walls: ArrayLike,
    *,
    start: ArrayLike | None = None,
    occupancy: OccupancyMap | None = None,
    closed: bool = False,
    robot_radius: float = 0.25,
    resolution: float | None = None,
) -> FoundDrive:
    """A short drive through all rooms that a robot can reach.

    It follows the medial axis where free space is narrow, and turns round on the spot in rooms with
    a single door.

    Args:
        walls: (S, 4) [m] ends x1, y1, x2, y2 of any world, closed or not.
        start: (2,) [m] where it begins; None: in a room of the main region that walls enclose.
        occupancy: The map that the walls were made of, if there is one: the robot stays where it
            is free.
        closed: Whether it ends where it begins.
        robot_radius: [m] that it keeps from all walls.
        resolution: [m] as of `wall_grid.wall_grid`.

    Raises:
        ValueError: An argument is not possible, or the robot fits nowhere or not at the start.
    """
    grid = wall_grid(walls, robot_radius, resolution, occupancy)
    first = None if start is None else _point("start", start)
    free, notes = choose_region(grid, first)
    stops = room_stops(grid, free)
    if len(stops) < 2:
        stops = np.stack(_ends(grid, free))
        notes = (*notes, "a single room: a drive between two of its ends, far apart")
    if first is not None:
        stops = np.concatenate([cell_at(grid, first, "start")[None], stops])
    graph = medial_graph(grid, free, stops)
    order = visiting_order(graph.length[:, graph.stops], closed=closed, first=first is not None)
    legs = [graph.nodes[graph.stops[order[:1]]], *(graph.path(*two) for two in pairwise(order))]
    line = grid.to_world(np.concatenate(legs))
    at_stop = np.cumsum([len(leg) for leg in legs]) - 1
    fixed = np.zeros(len(line), bool)
    fixed[at_stop] = _turns_back(line, at_stop, round(DIRECTION_LENGTH / grid.resolution))
    visited = grid.to_world(graph.nodes[graph.stops[order]])
    return _found(grid, line, fixed, [first, first if closed else None], visited, notes)


def route(
    walls: ArrayLike,
    start: ArrayLike | None = None,
    goal: ArrayLike | None = None,
    *,
    occupancy: OccupancyMap | None = None,
    robot_radius: float = 0.25,
    resolution: float | None = None,
) -> FoundDrive:
    """A drive from S to F: at most `NEAR_WALL_COST` longer than the shortest path over the cells.

    Args:
        walls: (S, 4) [m] ends x1, y1, x2, y2 of any world, closed or not.
        start: (2,) [m] S; None: what is furthest from F.
        goal: (2,) [m] F; None: what is furthest from S. Without both, the two are about as far
            apart as any in the main region that walls enclose.
        occupancy: The map that the walls were made of, if there is one: the robot stays where it
            is free.
        robot_radius: [m] that it keeps from all walls.
        resolution: [m] as of `wall_grid.wall_grid`.

    Raises:
        ValueError: An argument is not possible, the robot fits nowhere or not at one of the two
            points, or no path joins them.
    """
    grid = wall_grid(walls, robot_radius, resolution, occupancy)
    ends = [None if x is None else _point(n, x) for n, x in (("start", start), ("goal", goal))]
    free, notes = choose_region(grid, ends[1] if ends[0] is None else ends[0])
    cells = [None if x is None else cell_at(grid, x, n) for n, x in zip(_ENDS, ends, strict=True)]
    if not all(cell is None or free[tuple(cell)] for cell in cells):
        raise ValueError(
            f"goal {_text(ends[1])} cannot be reached from start {_text(ends[0])} by a robot with "
            f"robot_radius = {grid.robot_radius:g} m"
        )
    line = grid.to_world(_shortest(grid, free, *cells))
    fixed = np.zeros(len(line), bool)
    found = [end for end in line[[0, -1]]]
    visited = np.array([own if x is None else x for own, x in zip(found, ends, strict=True)])
    return _found(grid, line, fixed, ends, visited, notes)


_ENDS = ("start", "goal")


def _point(name: str, point: ArrayLike) -> np.ndarray:
    """A point (2,) [m]; ValueError if it is none."""
    xy = as_float64(name, point, (2,))
    if not np.isfinite(xy).all():
        raise ValueError(f"{name} is {xy.tolist()}, not finite")
    return xy


def _text(point: np.ndarray | None) -> str:
    return "" if point is None else f"({point[0]:g}, {point[1]:g})"


def _found(
    grid: WallGrid,
    line: np.ndarray,
    fixed: np.ndarray,
    ends: Sequence[np.ndarray | None],
    stops: np.ndarray,
    notes: tuple[str, ...],
) -> FoundDrive:
    """The drive along a path (N, 2) [m] from cell to cell, which begins and ends at given points.

    Raises:
        ValueError: There is no such path that keeps the robot's radius from the walls.
    """
    for k, end in enumerate(ends):
        if end is not None:
            at = (len(line), 0)[1 - k]
            line, fixed = np.insert(line, at, end, axis=0), np.insert(fixed, at, True)
    distinct = np.append(True, np.hypot(*np.diff(line, axis=0).T) > 1e-9)
    line, fixed = line[distinct], fixed[distinct]
    fixed[[0, -1]] = True
    path = smooth(grid, line, fixed)
    return FoundDrive(path, stops, float(polylines.length(path)), notes)


def _turns_back(line: np.ndarray, index: np.ndarray, reach: int) -> np.ndarray:
    """Whether a path (N, 2) turns back at some of its points (K,), by those `reach` points off."""
    into = line[index] - line[np.maximum(index - reach, 0)]
    out = line[np.minimum(index + reach, len(line) - 1)] - line[index]
    size = np.hypot(*into.T) * np.hypot(*out.T)
    return np.asarray(np.sum(into * out, axis=1) <= TURN_BACK * size)


def _ends(grid: WallGrid, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two cells (2,) far apart, over the cells (H, W) of the robot's centre."""
    cells = _shortest(grid, free, None, None)
    return cells[0], cells[-1]


def _shortest(
    grid: WallGrid, free: np.ndarray, start: np.ndarray | None, goal: np.ndarray | None
) -> np.ndarray:
    """Cells (n, 2) of the shortest path from cell to cell; an end that is None is far away.

    It is the cell furthest from the other end, of those that are not near to walls. Without both
    ends, S is the one furthest from the widest place, and F the one furthest from S.
    """
    steps, number = _grid_graph(grid, free)
    cells, clearance = np.argwhere(free), grid.clearance[free]
    away = clearance >= min(grid.robot_radius + PREFERRED, clearance.max())

    def furthest(source: int) -> int:
        length = csgraph.dijkstra(steps, directed=False, indices=source)
        return int(np.where(away & np.isfinite(length), length, -1.0).argmax())

    first, last = (None if cell is None else int(number[tuple(cell)]) for cell in (start, goal))
    if first is None:
        first = furthest(int(clearance.argmax()) if last is None else last)
    if last is None:
        last = furthest(first)
    _, previous = csgraph.dijkstra(steps, directed=False, indices=last, return_predecessors=True)
    path = [first]
    while path[-1] != last:
        path.append(int(previous[path[-1]]))
    return np.asarray(cells[path])


def _grid_graph(grid: WallGrid, free: np.ndarray) -> tuple[csr_array, np.ndarray]:
    """Costs (C, C) [cells] of steps between the eight neighbours of free cells, numbered (H, W).

    A step costs its length, and `NEAR_WALL_COST` of it more beside a wall.
    """
    number = np.cumsum(free).reshape(free.shape) - 1
    near = np.clip((grid.robot_radius + PREFERRED - grid.clearance) / PREFERRED, 0.0, 1.0)
    h, w = free.shape
    pairs, costs = [], []
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.s_[: h - i, max(0, -j) : w - max(0, j)]
        there = np.s_[i:, max(0, j) : w + min(0, j)]
        joined = free[here] & free[there]
        pairs.append(np.stack([number[here][joined], number[there][joined]]))
        mean = 0.5 * (near[here][joined] + near[there][joined])
        costs.append(np.hypot(i, j) * (1.0 + NEAR_WALL_COST * mean))
    count = int(free.sum())
    steps = csr_array(
        (np.concatenate(costs), tuple(np.concatenate(pairs, axis=1))), shape=(count, count)
    )
    return steps, number
