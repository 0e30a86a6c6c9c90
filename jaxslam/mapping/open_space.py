"""Arcs through open space, where the Voronoi diagram alone serves a planner badly.

The medial axis of a wide hall leaves most of it far from any arc, and routes over it lead around
where straight ahead is free. Two kinds of arcs are filled in:

    spurs       from the nearest arc to free space that is further than `COVER` from all arcs
    shortcuts   straight lines between points of arcs that see each other, where the graph leads
                around (`MAX_DETOUR`); crossings become nodes

           o------.                         o------.
                   '.                      /:       '.
                     o         ->         / :         o        a hall with an arc around its wall
                   .'                    /  :       .'
           o------'                     o---+------'

Where the diagram is dense, in corridors and rooms, neither is needed, and nothing is added.
"""

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from jaxslam.core.polylines import points_along
from jaxslam.mapping.plane_graph import Line, PlaneGraph

COVER = 1.8
"""[m] of free path, the farthest that free space may be from an arc."""

MAX_DETOUR = 1.5, 3.0
"""[-], [m] A shortcut is added if the graph leads around by more than this factor and length."""

REACH = 8.0
"""[m] longest shortcut."""

COMFORT = 0.5
"""[m] clearance of a shortcut; where its ends have less, that, but no less than the robot needs."""

SPACING = 2.0
"""[m] between points of an arc at which shortcuts may begin."""

BLOCK = 0.2
"""[m] side of the cells of free paths."""

MAX_ROUNDS = 8


class FreeSpace:
    """Clearance of the free configurations of a robot, with queries in metres.

    Attributes:
        clearance: (H, W) [m] distance to the nearest obstacle; 0 where the robot cannot be.
        resolution: [m] side of a cell.
        corner: (2,) [m] corner of cell [0, 0]; the axes of the grid are those of the plane.
        robot_radius: [m].
    """

    def __init__(
        self, clearance: np.ndarray, resolution: float, corner: np.ndarray, robot_radius: float
    ) -> None:
        """Free configurations as given."""
        self.clearance, self.resolution = clearance, resolution
        self.corner, self.robot_radius = np.asarray(corner, float), robot_radius

    def at(self, points: np.ndarray) -> np.ndarray:
        """Clearance (N,) [m] at points (N, 2) [m]; 0 beyond the grid."""
        cell = np.floor((points - self.corner) / self.resolution).astype(int)
        inside = ((cell >= 0) & (cell < self.clearance.shape)).all(axis=1)
        value = self.clearance[tuple(np.where(inside[:, None], cell, 0).T)]
        return np.where(inside, value, 0.0)

    def sees(self, start: np.ndarray, end: np.ndarray) -> bool:
        """Whether a straight line between points (2,) [m] is free, with `COMFORT` if it can be."""
        length = float(np.hypot(*(end - start)))
        share = np.linspace(0.0, 1.0, int(2.0 * length / self.resolution) + 2)[:, None]
        along = self.at(start + share * (end - start))
        needed = min(COMFORT, max(self.robot_radius, min(along[0], along[-1])))
        return bool(along.min() >= needed)

    def is_free(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Whether straight lines between points (N, 2) [m] and others are free: (N,) bool."""
        longest = float(np.hypot(*(end - start).T).max(initial=0.0))
        share = np.linspace(0.0, 1.0, int(2.0 * longest / self.resolution) + 2)[:, None]
        along = start[:, None] + share * (end - start)[:, None]
        clear: np.ndarray = self.at(along.reshape(-1, 2)).reshape(along.shape[:2]) > 0.0
        return np.asarray(clear.all(axis=1))

    def straightened(self, line: np.ndarray) -> np.ndarray:
        """A path (n, 2) [m] of as few of its points as see each other in turn."""
        kept, last = [0], len(line) - 1
        while kept[-1] < last:
            k = last
            while k > kept[-1] + 1 and not self.sees(line[kept[-1]], line[k]):
                k -= 1
            kept.append(k)
        return line[kept]


def fill_open_space(graph: PlaneGraph, space: FreeSpace) -> None:
    """Add spurs and shortcuts to a graph, in place.

    Args:
        graph: The graph; all its arcs lie in the free space.
        space: A connected region of free configurations.
    """
    if graph.arcs:
        _add_spurs(graph, space)
        _add_shortcuts(graph, space)


def _points_of(
    graph: PlaneGraph, spacing: float
) -> tuple[np.ndarray, list[tuple[int, int, float]]]:
    """The nodes, and points of arcs.

    Returns:
        Points (P, 2) [m], the nodes first, and pairs of them along the arcs with their distance
        [m].
    """
    points, edges = list(graph.xy), []
    for line in graph.arcs.values():
        steps = np.hypot(*np.diff(line.points, axis=0).T)
        length = float(steps.sum())
        at = np.linspace(0.0, length, int(length / spacing) + 2)
        first = len(points)
        points += list(points_along(line.points, at[1:-1]))
        chain = [line.start, *range(first, len(points)), line.end]
        edges += list(zip(chain, chain[1:], np.diff(at).tolist(), strict=False))
    return np.array(points), edges


def _matrix(edges: list[tuple[int, int, float]], size: int) -> sparse.csr_array:
    """Adjacency of undirected edges, the shortest of parallel ones."""
    table = np.array(edges)
    pairs = np.sort(table[:, :2].astype(int), axis=1)
    order = np.lexsort((table[:, 2], pairs[:, 1], pairs[:, 0]))
    order = order[np.unique(pairs[order] @ [size, 1], return_index=True)[1]]
    return sparse.csr_array((table[order, 2] + 1e-9, tuple(pairs[order].T)), shape=(size, size))


class Approach:
    """Shortest free paths from the arcs of a graph to all free space, in squares of cells.

    Attributes:
        centres: (B, 2) [m] positions of the squares.
        length: (B,) [m] of the paths; infinite where there is none.
    """

    def __init__(self, graph: PlaneGraph, space: FreeSpace) -> None:
        """The paths of a graph as it is now; all its arcs lie in the free space."""
        block = max(1, round(BLOCK / space.resolution))
        matrix, self.centres, self._index = _blocks(space, block)
        self._graph, self._space, self._size = graph, space, block * space.resolution
        sources = np.unique(self._squares(_points_of(graph, SPACING)[0]))
        self.length, self._before, _ = csgraph.dijkstra(
            matrix,
            directed=False,
            indices=sources[sources >= 0],
            min_only=True,
            return_predecessors=True,
        )

    def _squares(self, points: np.ndarray) -> np.ndarray:
        """Squares (N,) int that points (N, 2) [m] lie in, -1 for none."""
        cell = np.floor((points - self._space.corner) / self._size).astype(int)
        return self._index[tuple(np.clip(cell, 0, np.array(self._index.shape) - 1).T)]

    def to(self, point: np.ndarray) -> tuple[int, np.ndarray] | None:
        """The path to a point (2,) [m] of free space; the arc that it begins at is split there.

        Returns:
            The node, and the path (n, 2) [m] from it to the point; one point if that is the node.
            None if there is no path, or it is not free.
        """
        square = int(self._squares(point[None])[0])
        if not np.isfinite(self.length[square]):
            return None
        path = [square]
        while self._before[path[-1]] >= 0:
            path.append(int(self._before[path[-1]]))
        arc, _, along = self._graph.nearest(self.centres[path[-1]])
        start = points_along(self._graph.arcs[arc].points, np.array([along]))[0]
        for middle in path[1:-1], path:
            line = np.vstack([point, self.centres[middle], start])
            if self._space.is_free(line[:-1], line[1:]).all():
                root = self._graph.split(arc, along)
                line = np.vstack([line[:-1], self._graph.xy[root]])
                line = line[np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 0.0])]
                return root, self._space.straightened(line)[::-1]
        return None


def _add_spurs(graph: PlaneGraph, space: FreeSpace) -> None:
    """Join free space that is far from all arcs to the nearest one."""
    while True:
        approach = Approach(graph, space)
        far = np.flatnonzero(np.isfinite(approach.length) & (approach.length > COVER))
        if not len(far):
            return
        far, before = far[np.argsort(-approach.length[far], kind="stable")], len(graph.arcs)
        for end in approach.centres[far[apart(approach.centres[far], 2 * COVER)]]:
            found = approach.to(end)
            if found is not None:
                root, line = found
                graph.add_arc(Line(graph.add_node(end), root, line[::-1], False))
        if len(graph.arcs) == before:
            return


def _blocks(space: FreeSpace, block: int) -> tuple[sparse.csr_array, np.ndarray, np.ndarray]:
    """Free space in squares of cells, as a graph.

    A square is represented by its cell of the largest clearance. Two that touch are joined if the
    straight line between these is free.

    Returns:
        Adjacency (B, B) [m] of free squares, their positions (B, 2) [m], and the number of each
        square (H, W), -1 for none.
    """
    rows, columns = -(-np.array(space.clearance.shape) // block)
    padded = np.zeros((rows * block, columns * block))
    padded[: space.clearance.shape[0], : space.clearance.shape[1]] = space.clearance
    cells = padded.reshape(rows, block, columns, block).swapaxes(1, 2).reshape(rows, columns, -1)
    best = cells.argmax(axis=2)
    free = np.take_along_axis(cells, best[..., None], axis=2)[..., 0] > 0.0
    index = np.full((rows, columns), -1)
    index[free] = np.arange(np.count_nonzero(free))
    cell = np.argwhere(free) * block + np.stack(np.divmod(best[free], block), axis=1)
    centres = (cell + 0.5) * space.resolution + space.corner
    pairs = [
        np.stack([index[a], index[b]], axis=-1).reshape(-1, 2)
        for a, b in (
            (np.s_[:, :-1], np.s_[:, 1:]),
            (np.s_[:-1], np.s_[1:]),
            (np.s_[:-1, :-1], np.s_[1:, 1:]),
            (np.s_[:-1, 1:], np.s_[1:, :-1]),
        )
    ]
    edges = np.concatenate(pairs)
    edges = edges[(edges >= 0).all(axis=1)]
    narrow = ndimage.binary_dilation((cells == 0.0).any(axis=2), np.ones((3, 3)), border_value=1)
    unsure = np.flatnonzero(narrow[free][edges].any(axis=1))
    ends = centres[edges[unsure]]
    edges = np.delete(edges, unsure[~space.is_free(ends[:, 0], ends[:, 1])], axis=0)
    length = np.hypot(*(centres[edges[:, 0]] - centres[edges[:, 1]]).T)
    shape = (len(centres), len(centres))
    return sparse.csr_array((length, tuple(edges.T)), shape=shape), centres, index


def _add_shortcuts(graph: PlaneGraph, space: FreeSpace) -> None:
    """Join points of arcs that see each other where the graph leads around; the worst first."""
    for _ in range(MAX_ROUNDS):
        points, edges = _points_of(graph, SPACING)
        ends = apart(points, SPACING)
        over = csgraph.dijkstra(_matrix(edges, len(points)), directed=False, indices=ends)[:, ends]
        points = points[ends]
        straight = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
        limit = np.maximum(MAX_DETOUR[0] * straight, MAX_DETOUR[1] + straight)
        pairs = np.argwhere(np.triu((straight < REACH) & (over > limit), 1))
        saved = over[tuple(pairs.T)] - straight[tuple(pairs.T)]
        added = []
        for i, j in pairs[np.argsort(-saved, kind="stable")].tolist():
            if over[i, j] <= limit[i, j] or not space.sees(points[i], points[j]):
                continue
            added.append((i, j))
            direct, row, column = straight[i, j], over[[i]], over[[j]]
            over = np.minimum(over, np.minimum(row.T + direct + column, column.T + direct + row))
        if not added:
            return
        for i, j in added:
            graph.add_segment(points[i], points[j])


def apart(points: np.ndarray, distance: float) -> np.ndarray:
    """Indices (K,) of points (N, 2) that are `distance` [m] apart, in order, none left out else."""
    tree, kept = cKDTree(points), np.ones(len(points), bool)
    for k in range(len(points)):
        if kept[k]:
            near = np.array(tree.query_ball_point(points[k], distance))
            kept[near[near > k]] = False
    return np.flatnonzero(kept)
