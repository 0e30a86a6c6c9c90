"""Graphs for going places, whoever made them, and the free space in which they are measured."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.se2_np import relative
from jaxslam.core.types import JUNCTION

SPACING = 0.1  # [m] between the points of an arc that are looked at
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))  # to half of the eight neighbours of a cell


class Roadmap(NamedTuple):
    """A graph of N nodes and A arcs, map frame.

    Attributes:
        xy: (N, 2) [m] positions of the nodes.
        ends: (A, 2) int indices of the two nodes of each arc.
        lines: A polylines (n >= 2, 2) [m], from the first node to the second.
        is_open: (N,) bool, ends that lead to unknown space.
    """

    xy: np.ndarray
    ends: np.ndarray
    lines: tuple[np.ndarray, ...]
    is_open: np.ndarray

    @classmethod
    def of_map(cls, graph: TopologicalMap) -> "Roadmap":
        """The junctions and arcs of a topological map, and its open ends if they have ids.

        That is what `map.geojson` holds.
        """
        if not len(graph.frontier_id):
            graph = graph._replace(frontiers=(), frontier_node=np.zeros(0, int))
        nodes = np.flatnonzero(graph.kind == JUNCTION)
        rank = np.full(len(graph.kind), -1)
        rank[nodes] = np.arange(len(nodes))
        first = len(nodes) + np.arange(len(graph.frontiers))
        tips = np.array([line[-1] for line in graph.frontiers]).reshape(-1, 2)
        to_tips = np.column_stack([rank[graph.frontier_node], first])
        return cls(
            xy=np.concatenate([graph.xy[nodes], tips]),
            ends=np.concatenate([rank[graph.arc_ends], to_tips]).astype(int).reshape(-1, 2),
            lines=(*graph.arc_lines, *graph.frontiers),
            is_open=np.repeat([False, True], [len(nodes), len(tips)]),
        )


class Ground(NamedTuple):
    """The free space of an occupancy map of H x W cells, for a robot of some radius.

    Attributes:
        known_free: (H, W) bool.
        clearance: (H, W) [m] from the centre of a cell to that of the nearest occupied one.
        fits: (H, W) bool, where the centre of the robot may be.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0], map frame.
    """

    known_free: np.ndarray
    clearance: np.ndarray
    fits: np.ndarray
    resolution: float
    origin: np.ndarray

    @classmethod
    def of_map(cls, occupancy: OccupancyMap, robot_radius: float) -> "Ground":
        """The ground of an occupancy map."""
        away = ndimage.distance_transform_edt(~occupancy.occupied, sampling=occupancy.resolution)
        fits = occupancy.free & (away > robot_radius)
        return cls(occupancy.free, away, fits, occupancy.resolution, occupancy.origin)

    def cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells (P, 2) int of points (P, 2) [m], those outside moved in; and which are inside."""
        in_grid = relative(self.origin, np.column_stack([points, np.zeros(len(points))]))[:, :2]
        cell = np.floor(in_grid / self.resolution).astype(int)
        inside = ((cell >= 0) & (cell < self.fits.shape)).all(axis=1)
        return np.clip(cell, 0, np.array(self.fits.shape) - 1), inside

    def at(self, field: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Values (P,) of a field (H, W) at points (P, 2) [m]; 0 or False outside of the grid."""
        cell, inside = self.cells(points)
        return np.where(inside, field[tuple(cell.T)], field.dtype.type(0))

    def points(self, cells: np.ndarray) -> np.ndarray:
        """Centres (P, 2) [m] of cells (P, 2), or of fractional indices."""
        cosine, sine = np.cos(self.origin[2]), np.sin(self.origin[2])
        turn = np.array([[cosine, sine], [-sine, cosine]])  # of row vectors
        return (np.asarray(cells, float) + 0.5) * self.resolution @ turn + self.origin[:2]


def without_repeats(roadmap: Roadmap) -> Roadmap:
    """The roadmap, but arcs of the same ends and, to a centimetre, length once."""
    lengths = [round(float(polylines.length(line)), 2) for line in roadmap.lines]
    first: dict[tuple[int, int, float], int] = {}
    for k, (pair, length) in enumerate(zip(roadmap.ends.tolist(), lengths, strict=True)):
        first.setdefault((min(pair), max(pair), length), k)
    kept = list(first.values())
    return roadmap._replace(
        ends=roadmap.ends[kept].reshape(-1, 2), lines=tuple(roadmap.lines[k] for k in kept)
    )


class Chains(NamedTuple):
    """Arcs cut into short edges.

    Attributes:
        xy: (P, 2) [m] the nodes of the roadmap, then points of its arcs.
        edges: (E, 2) int neighbours among them.
        arc: (E,) int the arc of each edge.
        length: (E,) [m].
    """

    xy: np.ndarray
    edges: np.ndarray
    arc: np.ndarray
    length: np.ndarray

    @classmethod
    def of_roadmap(cls, roadmap: Roadmap, spacing: float = SPACING) -> "Chains":
        """The arcs of a roadmap, a point of each at least every `spacing` [m]."""
        points, edges, arcs = [roadmap.xy], [], []
        count = len(roadmap.xy)
        for k, ((start, end), line) in enumerate(
            zip(roadmap.ends.tolist(), roadmap.lines, strict=True)
        ):
            inner = polylines.refine(np.asarray(line, float), spacing)[1:-1]
            chain = np.concatenate([[start], count + np.arange(len(inner)), [end]])
            points.append(inner)
            edges.append(np.column_stack([chain[:-1], chain[1:]]))
            arcs.append(np.full(len(chain) - 1, k))
            count += len(inner)
        xy = np.concatenate(points)
        pairs = np.concatenate([np.zeros((0, 2), int), *edges])
        arc = np.concatenate([np.zeros(0, int), *arcs])
        return cls(xy, pairs, arc, np.hypot(*(xy[pairs[:, 0]] - xy[pairs[:, 1]]).T))

    def middles(self) -> np.ndarray:
        """Middle (E, 2) [m] of each edge."""
        return 0.5 * (self.xy[self.edges[:, 0]] + self.xy[self.edges[:, 1]])

    def matrix(self) -> sparse.csr_array:
        """Adjacency (P, P) [m], the shortest of parallel edges."""
        return shortest_edges(self.edges, self.length, len(self.xy))


def shortest_edges(pairs: np.ndarray, length: np.ndarray, size: int) -> sparse.csr_array:
    """Adjacency (size, size) of undirected edges (E, 2), the shortest of parallel ones, [m].

    Edges of length 0 are a nanometre long, as a sparse matrix holds no zeros.
    """
    pairs = np.sort(pairs, axis=1)
    order = np.argsort(length, kind="stable")
    order = order[np.unique(pairs[order] @ np.array([size, 1]), return_index=True)[1]]
    return sparse.csr_array((length[order] + 1e-9, tuple(pairs[order].T)), shape=(size, size))


def grid_graph(fits: np.ndarray, resolution: float) -> tuple[np.ndarray, sparse.csr_array]:
    """Cells (H, W) bool as a graph of eight neighbours.

    Returns:
        Number (H, W) int of each cell, -1 for those that are False, and adjacency (C, C) [m].
    """
    number = np.full(fits.shape, -1)
    number[fits] = np.arange(np.count_nonzero(fits))
    pairs, lengths = [], []
    for down, right in _STEPS:
        here = number[: fits.shape[0] - down, max(0, -right) : fits.shape[1] - max(0, right)]
        there = number[down:, max(0, right) : fits.shape[1] + min(0, right)]
        both = (here >= 0) & (there >= 0)
        pairs.append(np.column_stack([here[both], there[both]]))
        lengths.append(np.full(len(pairs[-1]), resolution * np.hypot(down, right)))
    count = np.count_nonzero(fits)
    edges = np.concatenate(pairs)
    matrix = sparse.csr_array((np.concatenate(lengths), tuple(edges.T)), shape=(count, count))
    return number, matrix
