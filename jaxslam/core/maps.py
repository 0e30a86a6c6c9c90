"""Maps that are handed on: an occupancy map, a topological map."""

from typing import NamedTuple

import numpy as np

from jaxslam.core.types import as_float64, as_numpy, as_size, check_array, check_type

MAX_CELLS = 2**26  # most cells of a map
MIN_RESOLUTION, MAX_RESOLUTION = 0.001, 100.0  # [m] of a map
MAX_COORDINATE = 1e7  # [m] of any point of a map in a file


class OccupancyMap(NamedTuple):
    """An occupancy grid of H x W square cells [i, j]; i grows with x, j with y.

    A cell that is neither occupied nor free is unknown.

    Attributes:
        occupied: (H, W) bool.
        free: (H, W) bool.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
        notes: What is not as the file of the map has it.
    """

    occupied: np.ndarray
    free: np.ndarray
    resolution: float
    origin: np.ndarray
    notes: tuple[str, ...] = ()


def check_occupancy(occupancy: OccupancyMap, name: str = "occupancy") -> OccupancyMap:
    """An occupancy map whose fields are checked, with arrays of NumPy; cells are not copied.

    Args:
        occupancy: The map; its fields may be of anything array-like.
        name: Name of `occupancy`, for the message; empty if its fields are arguments themselves.

    Raises:
        ValueError: It is no occupancy map, `occupied` and `free` are no bools of one shape (H, W)
            with a cell at least, `origin` is not (3,) or not finite, or `resolution` is no number
            from `MIN_RESOLUTION` to `MAX_RESOLUTION`; the message names the field.
    """
    check_type(name, occupancy, OccupancyMap)
    prefix = f"{name}." if name else ""
    occupied = as_numpy(f"{prefix}occupied", occupancy.occupied)
    free = as_numpy(f"{prefix}free", occupancy.free)
    check_array(f"{prefix}occupied", occupied, ("H", "W"), np.bool_)
    check_array(f"{prefix}free", free, occupied.shape, np.bool_)
    if not occupied.size:
        raise ValueError(f"{prefix}occupied is bool {occupied.shape}, without a cell")
    resolution = as_size(
        f"{prefix}resolution", occupancy.resolution, least=MIN_RESOLUTION, most=MAX_RESOLUTION
    )
    origin = as_float64(f"{prefix}origin", occupancy.origin, (3,))
    if not np.isfinite(origin).all():
        raise ValueError(f"{prefix}origin is {origin.tolist()}, not finite")
    return occupancy._replace(occupied=occupied, free=free, resolution=resolution, origin=origin)


class TopologicalMap(NamedTuple):
    """Topological map as a graph: NumPy arrays without padding, map frame.

    Attributes:
        id: (N,) int landmark ids of the nodes.
        xy: (N, 2) [m] positions of the nodes.
        kind: (N,) int `JUNCTION` or `CORNER`; arcs join nodes of kind `JUNCTION` only.
        clearance: (N,) [m] distance to the nearest obstacle, 0 for a corner.
        arc_ends: (A, 2) int indices of the two ends of each arc; (i, i) is a loop, and two arcs may
            have the same pair.
        arc_length: (A,) [m] length of each arc.
        arc_clearance: (A,) [m] smallest distance to an obstacle along each arc; NaN for an arc
            that was driven but not observed.
        arc_lines: A polylines (n >= 2, 2) [m], from the first end of the arc to the second.
        arc_filled: (A,) bool, arcs through open space that are no branches of a Voronoi diagram;
            empty where there are none.
        frontiers: F polylines (n >= 2, 2) [m], from a node to where the field of view ended.
        frontier_node: (F,) int index of that node.
        frontier_id: (F,) int ids of the open ends, which count with those of the nodes; empty where
            they have none.
    """

    id: np.ndarray
    xy: np.ndarray
    kind: np.ndarray
    clearance: np.ndarray
    arc_ends: np.ndarray
    arc_length: np.ndarray
    arc_clearance: np.ndarray
    arc_lines: tuple[np.ndarray, ...]
    arc_filled: np.ndarray = np.zeros(0, bool)
    frontiers: tuple[np.ndarray, ...] = ()
    frontier_node: np.ndarray = np.zeros(0, int)
    frontier_id: np.ndarray = np.zeros(0, int)


def without_arcs(graph: TopologicalMap, gone: np.ndarray) -> TopologicalMap:
    """The map without the arcs (A,) that are True; their nodes stay."""
    kept = np.flatnonzero(~gone)
    return graph._replace(
        arc_ends=graph.arc_ends[kept],
        arc_length=graph.arc_length[kept],
        arc_clearance=graph.arc_clearance[kept],
        arc_lines=tuple(graph.arc_lines[k] for k in kept.tolist()),
        arc_filled=graph.arc_filled[kept] if len(graph.arc_filled) else graph.arc_filled,
    )
