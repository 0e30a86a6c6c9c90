"""Topological map of an occupancy grid: the medial cells of free space as a graph.

Its nodes are the junctions and dead ends of the medial cells, its arcs the paths of cells between.
Two nodes may be joined by several arcs, and a ring without a junction is one node with a loop.

    medial cells (`medial_axis`) -> trace into a graph of cells (`cell_graph`)
    -> clean up: drop short spurs, join arcs through nodes of degree 2, merge close junctions
       (`cell_graph_cleanup`) -> polylines in the map frame
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap, TopologicalMap, check_occupancy
from jaxslam.core.types import JUNCTION, as_size
from jaxslam.mapping import medial_axis
from jaxslam.mapping.cell_graph import CellGraph, trace_cells
from jaxslam.mapping.cell_graph_cleanup import clean_up
from jaxslam.mapping.clearance import obstacle_distance
from jaxslam.mapping.medial_axis import FreeConfigurations
from jaxslam.mapping.plane_graph import Line, PlaneGraph

# Obstacles seen under a larger angle make dead ends; corners do not.
DEAD_END_ANGLE = np.radians(120.0)
STAGES = ("distances", "thinning", "graph")
UNKNOWN_MARGIN = 2  # [cells] unknown cells this close to an occupied one are part of the wall


class GridTopology(NamedTuple):
    """Topological map of an occupancy grid.

    Attributes:
        graph: The map, in the frame of the grid's map.
        num_regions: Number of connected regions of free configurations in it.
        reached_area: [m^2] their area: where the centre of the robot can be.
        unreached_area: [m^2] area of the regions that are not in it.
    """

    graph: TopologicalMap
    num_regions: int
    reached_area: float
    unreached_area: float


def extract_topology(
    occupied: ArrayLike,
    free: ArrayLike,
    *,
    resolution: float,
    origin: ArrayLike,
    robot_radius: float,
    min_obstacle_size: float = 0.1,
    min_region_area: float | None = None,
    callback: Callable[[str], object] = str,
) -> GridTopology:
    """Topological map of the free space that a robot can reach.

    Every region in which the robot's centre can move becomes one connected graph with a cycle
    around each obstacle that it can drive around. A spur (an arc with a dead end) is kept if it is
    longer than the clearance at its root. Unknown cells keep the robot out, but are no walls: they
    alone make no dead end, and islands of them smaller than the robot are filled.

    Args:
        occupied: (H, W) bool; i grows with x, j with y.
        free: (H, W) bool; a cell that is neither is unknown.
        resolution: [m] side of a cell, from `MIN_RESOLUTION` to `MAX_RESOLUTION` of `core.maps`.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
        robot_radius: [m] The nodes keep this distance from what is not free; so do arcs, but for
            less than a cell where the simplified polyline cuts a bend. `arc_clearance` is that of
            the polyline.
        min_obstacle_size: [m] obstacles in free space no wider than this are noise.
        min_region_area: [m^2] smallest region that is mapped; None for the largest region alone.
        callback: Callback, called with the name of each of the `STAGES` as it begins.

    Raises:
        ValueError: The robot fits nowhere, or an argument has another type, shape or range.
    """
    given: Any = occupied, free, resolution, origin
    occupied, free, resolution, origin, _ = check_occupancy(OccupancyMap(*given), name="")
    robot_radius = as_size("robot_radius", robot_radius)
    min_obstacle_size = as_size("min_obstacle_size", min_obstacle_size)
    if min_region_area is not None:
        min_region_area = as_size("min_region_area", min_region_area, unit="square metres")
    callback(STAGES[0])
    free = medial_axis.free_space(
        occupied,
        free,
        min_obstacle_size=min_obstacle_size / resolution,
        min_unknown_size=2 * robot_radius / resolution,
    )
    space = medial_axis.free_configurations(free, clearance=robot_radius / resolution)
    areas = space.region_sizes * resolution**2
    if not areas.size:
        raise ValueError(f"has no free space for a robot with robot_radius = {robot_radius:g} m")
    count = 1 if min_region_area is None else max(1, int(np.sum(areas >= min_region_area)))
    chosen = (space.region > 0) & (space.region <= count)
    cell_graph, _ = trace_medial_axis(space, occupied, chosen, callback)
    graph = _to_map(cell_graph, space, resolution, origin)
    return GridTopology(graph, count, float(areas[:count].sum()), float(areas[count:].sum()))


def trace_medial_axis(
    space: FreeConfigurations,
    occupied: np.ndarray,
    chosen: np.ndarray,
    callback: Callable[[str], object] = str,
    find_junctions: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[CellGraph, set[int]]:
    """The medial cells of some regions as a graph, cleaned up.

    Args:
        space: Free configurations.
        occupied: (H, W) bool.
        chosen: (H, W) bool, the cells of the regions.
        callback: As of `extract_topology`; called with the last two of the `STAGES`.
        find_junctions: From medial cells (H, W) bool to those (H, W) that are nodes in any case;
            by default, none.

    Returns:
        The graph, and its nodes at such cells.
    """
    wall = ndimage.binary_dilation(occupied, structure=np.ones((3, 3)), iterations=UNKNOWN_MARGIN)
    anchors = medial_axis.between_walls(space, wall, angle=DEAD_END_ANGLE) & chosen
    callback(STAGES[1])
    cells = medial_axis.medial_cells(space, chosen, anchors)
    callback(STAGES[2])
    also = None if find_junctions is None else find_junctions(cells)
    cell_graph = trace_cells(cells, space.distance, also)
    kept = set()
    if also is not None:
        kept = {node for node, cell in cell_graph.nodes.items() if also[tuple(cell)]}
    clean_up(cell_graph, space.distance, kept)
    return cell_graph, kept & cell_graph.nodes.keys()


def to_plane(cell_graph: CellGraph, resolution: float, corner: np.ndarray) -> PlaneGraph:
    """The graph in metres; `corner` (2,) [m] is that of cell [0, 0], whose axes stay."""
    index = {node: n for n, node in enumerate(cell_graph.nodes)}
    cells = np.array(list(cell_graph.nodes.values())).reshape(-1, 2)
    lines = [
        Line(index[start], index[end], (arc.line + 0.5) * resolution + corner, True)
        for arc in cell_graph.arcs.values()
        for start, end in (arc.ends,)
    ]
    return PlaneGraph((cells + 0.5) * resolution + corner, lines)


def line_clearances(
    lines: Sequence[np.ndarray], space: FreeConfigurations, resolution: float, corner: np.ndarray
) -> np.ndarray:
    """Smallest distance (A,) [m] from polylines (n, 2) [m] to the edge of an obstacle."""
    in_cells = [(line - corner) / resolution - 0.5 for line in lines]
    return resolution * _smallest_clearances(in_cells, space.nearest_obstacle)


def _to_map(
    cell_graph: CellGraph, space: FreeConfigurations, resolution: float, origin: np.ndarray
) -> TopologicalMap:
    """The graph in the map frame [m]; `origin` (3,) is the pose of the grid's corner."""
    names = list(cell_graph.nodes)
    index = {node: n for n, node in enumerate(names)}
    cells = np.array([cell_graph.nodes[node] for node in names])
    cosine, sine = np.cos(origin[2]), np.sin(origin[2])
    rotation = np.array([[cosine, sine], [-sine, cosine]])  # of row vectors

    def to_map(points: np.ndarray) -> np.ndarray:
        return (points + 0.5) * resolution @ rotation + origin[:2]

    arcs = list(cell_graph.arcs.values())
    lines = tuple(to_map(arc.line) for arc in arcs)
    clearances = _smallest_clearances([arc.line for arc in arcs], space.nearest_obstacle)
    return TopologicalMap(
        id=np.arange(len(names)),
        xy=to_map(cells),
        kind=np.full(len(names), JUNCTION),
        clearance=space.distance[tuple(cells.T)] * resolution,
        arc_ends=np.array([[index[node] for node in arc.ends] for arc in arcs], int).reshape(-1, 2),
        arc_length=np.array([polylines.length(line) for line in lines], float),
        arc_clearance=resolution * clearances,
        arc_lines=lines,
    )


def _smallest_clearances(lines: Sequence[np.ndarray], foot: np.ndarray) -> np.ndarray:
    """Smallest distance (A,) [cells] from polylines to the edge of an obstacle.

    The polylines are sampled every quarter of a cell.

    Args:
        lines: A polylines (n, 2) [cells].
        foot: (2, H, W) index of the nearest obstacle of each cell.
    """
    if not lines:
        return np.zeros(0)
    samples = [_sampled(line) for line in lines]
    first = np.cumsum([0, *map(len, samples[:-1])])
    return np.minimum.reduceat(obstacle_distance(np.concatenate(samples), foot), first)


def _sampled(line: np.ndarray) -> np.ndarray:
    """Points (m, 2) of a polyline (n, 2) [cells], those every quarter of a cell among them."""
    at_point = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    wanted = np.unique(np.concatenate([at_point, np.arange(0.0, at_point[-1], 0.25)]))
    return np.column_stack([np.interp(wanted, at_point, line[:, axis]) for axis in range(2)])
