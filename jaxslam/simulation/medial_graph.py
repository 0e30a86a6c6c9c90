"""Stops in rooms, and the medial axis of free space as a graph between them."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph, csr_array
from scipy.spatial import cKDTree

from jaxslam.mapping import medial_axis
from jaxslam.mapping.cell_graph import trace_cells
from jaxslam.mapping.rooms import FURNITURE_SIZE, find_regions
from jaxslam.simulation.wall_grid import WallGrid

DOOR_WIDTH = 1.3  # [m] of the widest opening that divides rooms, whatever they look like


class MedialGraph(NamedTuple):
    """The medial axis of where a robot fits, as far as it joins some stops.

    Attributes:
        nodes: (N, 2) int cells of its nodes.
        stops: (K,) int node at, or next to, each stop.
        arcs: (n, 2) int cells of the shortest arc between two nodes, from the first to the second.
        length: (K, N) [cells] of the shortest path from each stop to each node.
        previous: (K, N) int node before each one on these paths, negative at the first.
    """

    nodes: np.ndarray
    stops: np.ndarray
    arcs: dict[tuple[int, int], np.ndarray]
    length: np.ndarray
    previous: np.ndarray

    def path(self, stop: int, other: int) -> np.ndarray:
        """Cells (n, 2) of the shortest path between two stops, without the first one's."""
        nodes = [int(self.stops[other])]
        while nodes[-1] != self.stops[stop]:
            nodes.append(int(self.previous[stop, nodes[-1]]))
        legs = [self.arcs[pair][1:] for pair in pairwise(nodes[::-1])]
        return np.concatenate([np.zeros((0, 2), int), *legs])


def room_stops(grid: WallGrid, free: np.ndarray) -> np.ndarray:
    """The cell (K, 2) of the largest clearance in each room.

    Rooms are the regions of `mapping.rooms`, and whatever openings of up to `DOOR_WIDTH` cut off
    from all of these.

    Args:
        grid: The walls.
        free: (H, W) bool, the cells of the robot's centre.
    """
    part, _ = ndimage.label(~grid.occupied)
    inside = np.isin(part, np.unique(part[free]))
    found = find_regions(
        grid.occupied | ~inside,
        inside,
        resolution=grid.resolution,
        origin=np.zeros(3),
        robot_radius=grid.robot_radius,
    )
    small = FURNITURE_SIZE / grid.resolution
    empty = medial_axis.free_space(~inside, inside, min_obstacle_size=small, min_unknown_size=small)
    wide = medial_axis.nearest_obstacles(empty)[0] > 0.5 * DOOR_WIDTH / grid.resolution
    part, _ = ndimage.label(wide, structure=np.ones((3, 3)))
    stops = _widest(grid, np.where(free, found.label, 0))
    reached = np.unique(part[tuple(stops.T)])
    return np.concatenate([stops, _widest(grid, np.where(free & ~np.isin(part, reached), part, 0))])


def _widest(grid: WallGrid, label: np.ndarray) -> np.ndarray:
    """The cell (K, 2) of the largest clearance of each label of cells (H, W); 0 is none."""
    names = np.unique(label[label > 0])
    found = ndimage.maximum_position(grid.clearance, label, names) if len(names) else []
    return np.array(found, int).reshape(-1, 2)


def medial_graph(grid: WallGrid, free: np.ndarray, stops: np.ndarray) -> MedialGraph:
    """The medial axis through some stops.

    Args:
        grid: The walls.
        free: (H, W) bool, the cells of the robot's centre, connected.
        stops: (K, 2) int cells among them, which no two share.
    """
    space = medial_axis.FreeConfigurations(
        distance=grid.clearance / grid.resolution,
        nearest_obstacle=grid.nearest_wall,
        region=free.astype(np.int32),
        region_sizes=np.array([free.sum()]),
    )
    kept = np.zeros(free.shape, bool)
    kept[tuple(stops.T)] = True
    cells = medial_axis.medial_cells(space, free, kept)
    axis = np.argwhere(cells)
    also = np.zeros(free.shape, bool)  # the second pass of the thinning may take the stop itself
    also[tuple(axis[cKDTree(axis).query(stops)[1]].T)] = True
    traced = trace_cells(cells, grid.clearance, also)
    rank = {name: n for n, name in enumerate(traced.nodes)}
    nodes = np.array(list(traced.nodes.values()))
    arcs: dict[tuple[int, int], np.ndarray] = {}
    shortest: dict[tuple[int, int], float] = {}
    for arc in traced.arcs.values():
        a, b = (rank[name] for name in arc.ends)
        if a != b and arc.length < shortest.get((a, b), np.inf):
            shortest[a, b] = shortest[b, a] = arc.length
            arcs[a, b], arcs[b, a] = arc.cells, arc.cells[::-1]
    pairs = np.array(list(shortest), int).reshape(-1, 2)
    values = np.array(list(shortest.values()), float)
    matrix = csr_array((values, tuple(pairs.T)), shape=(len(nodes), len(nodes)))
    near = cKDTree(nodes).query(stops)[1]
    at_stop = near[np.sort(np.unique(near, return_index=True)[1])]
    length, previous = csgraph.dijkstra(matrix, indices=at_stop, return_predecessors=True)
    return MedialGraph(nodes, at_stop, arcs, length, previous)
