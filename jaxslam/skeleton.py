"""Topological map of an occupancy grid: the medial cells of free space as a graph.

Nodes are the junctions and dead ends of the medial cells, arcs the paths of cells between them.
Two nodes may be joined by several arcs, and a ring without a junction is one node with a loop.

    medial cells (`medial`) -> trace into a graph of cells -> clean up: drop short spurs, join arcs
    through nodes of degree 2, merge close junctions -> polylines in the map frame
"""

from collections import defaultdict
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from jaxslam import medial, ways
from jaxslam.topomap import Graph
from jaxslam.types import NODE

ANGLE = np.radians(120.0)  # obstacles seen under a larger angle make dead ends; corners do not
CORNER = 1.6  # a spur into a right corner is 1.41 times as long as its clearance decreases
MERGE = 0.5  # junctions closer than this fraction of the smaller of their clearances are merged
STAGES = ("distances", "thinning", "graph")
WALL = 2  # [cells] unknown cells this close to an occupied one are part of the wall

_TOLERANCE = 0.4  # [cells] of the simplification of polylines


class Survey(NamedTuple):
    """Topological map of an occupancy grid.

    Attributes:
        graph: The map, in the frame of the grid's map.
        regions: Number of connected regions of free configurations in it.
        reached: [m^2] their area: where the centre of the robot can be.
        left_out: [m^2] area of the regions that are not in it.
    """

    graph: Graph
    regions: int
    reached: float
    left_out: float


class _Arc(NamedTuple):
    """A path of cells between two nodes.

    Attributes:
        ends: Names of the first and the last node.
        cells: (n >= 2, 2) int indices of the cells, neighbours touch.
        line: (m >= 2, 2) [cells] the path, smoothed and simplified.
        length: [cells] length of `line`.
    """

    ends: tuple[int, int]
    cells: np.ndarray
    line: np.ndarray
    length: float


class _CellGraph(NamedTuple):
    """A graph of cells; changed in place.

    Attributes:
        nodes: Cell index (2,) of each node, by name.
        arcs: The arcs, by name.
    """

    nodes: dict[int, np.ndarray]
    arcs: dict[int, _Arc]


def survey(
    occupied: np.ndarray,
    free: np.ndarray,
    *,
    resolution: float,
    origin: np.ndarray,
    clearance: float,
    speck: float = 0.1,
    area: float | None = None,
    watch: Callable[[str], object] = str,
) -> Survey:
    """Topological map of the free space that a robot can reach.

    Every region in which the robot's centre can move becomes one connected graph with a cycle
    around each obstacle that it can drive around. A spur (an arc with a dead end) is kept if it is
    longer than the clearance at its root. Unknown cells keep the robot out, but are no walls: they
    alone make no dead end, and islands of them smaller than the robot are filled.

    Args:
        occupied: (H, W) bool; i grows with x, j with y.
        free: (H, W) bool; a cell that is neither is unknown.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
        clearance: [m] radius of the robot. Nodes keep this distance from what is not free; so do
            arcs, but for less than a cell where the simplified polyline cuts a bend.
            `arc_clearance` is that of the polyline.
        speck: [m] obstacles in free space no wider than this are noise.
        area: [m^2] smallest region that is mapped; None for the largest region alone.
        watch: Callback, called with the name of each of the `STAGES` as it begins.

    Raises:
        ValueError: The robot fits nowhere.
    """
    watch(STAGES[0])
    free = medial.free_space(
        occupied, free, speck=speck / resolution, gap=2 * clearance / resolution
    )
    space = medial.places(free, clearance=clearance / resolution)
    areas = space.sizes * resolution**2
    if not areas.size:
        raise ValueError(f"has no free space for a robot with a clearance of {clearance:g} m")
    count = 1 if area is None else max(1, int(np.sum(areas >= area)))
    chosen = (space.inside > 0) & (space.inside <= count)
    wall = ndimage.binary_dilation(occupied, structure=np.ones((3, 3)), iterations=WALL)
    anchors = medial.facing(space, wall, angle=ANGLE) & chosen
    watch(STAGES[1])
    cells = medial.medial(space, chosen, anchors)
    watch(STAGES[2])
    cell_graph = _trace(cells, space.room)
    _clean_up(cell_graph, space.room)
    graph = _to_map(cell_graph, space, resolution, np.asarray(origin, float))
    return Survey(graph, count, float(areas[:count].sum()), float(areas[count:].sum()))


# Trace thin cells into a graph.


def _trace(cells: np.ndarray, clearance: np.ndarray) -> _CellGraph:
    """Graph of thin cells.

    Every cell whose number of neighbours is not two belongs to a node. From each neighbour of a
    node a path is walked, cell by cell, until it comes to a node. Cells that no walk has visited
    form rings; each becomes a loop at its cell of the largest clearance.

        # . . . #
        . # . # .          5 nodes: 4 dead ends and 1 junction
        . . # . .          4 arcs
        . # . # .
        # . . . #

    Args:
        cells: (H, W) bool, one cell thin.
        clearance: (H, W) [cells] distance to the nearest obstacle.
    """
    index = np.argwhere(cells)
    number = np.full(np.add(cells.shape, 2), -1)  # of each cell, -1 for none; padded
    number[tuple(index.T + 1)] = np.arange(len(index))
    height = clearance[tuple(index.T)]
    neighbours = _neighbours(number)
    node_of = _node_cells(number, neighbours, height)
    cell_graph = _CellGraph({node: index[node] for node in node_of.values()}, {})
    visited: set[int] = set()

    def walk(start: int, second: int) -> None:
        """Follow cells from a cell of a node to the next node, and add the arc."""
        path = [start, second]
        while path[-1] not in node_of:
            visited.add(path[-1])
            path.append(next(cell for cell in neighbours[path[-1]] if cell != path[-2]))
        ends = node_of[path[0]], node_of[path[-1]]
        # The path begins and ends at the cells that stand for the nodes.
        before = [ends[0]] if ends[0] != path[0] else []
        after = [ends[1]] if ends[1] != path[-1] else []
        cell_graph.arcs[len(cell_graph.arcs)] = _arc(ends, index[[*before, *path, *after]])

    for cell in list(node_of):
        for neighbour in neighbours[cell]:
            if neighbour in node_of and (node_of[cell] == node_of[neighbour] or cell > neighbour):
                continue  # within one node, or walked from the other side
            if neighbour not in visited:
                walk(cell, neighbour)
    for cell in np.argsort(-height, kind="stable").tolist():  # what is left are rings
        if cell not in visited and cell not in node_of:
            node_of[cell] = cell
            cell_graph.nodes[cell] = index[cell]
            walk(cell, neighbours[cell][0])
    return cell_graph


def _shifted(number: np.ndarray, row: int, column: int) -> np.ndarray:
    """Number (H, W) of the cell `row` rows and `column` columns on, from the padded numbers."""
    height, width = number.shape
    return number[1 + row : height - 1 + row, 1 + column : width - 1 + column]


def _neighbours(number: np.ndarray) -> dict[int, list[int]]:
    """Neighbours of each cell: those at a side, and across a corner where no cell is at both sides.

        a #        a and b are neighbours through #, not across the corner
        . b

    Args:
        number: (H + 2, W + 2) number of each cell, -1 for none.
    """
    here, below, right = _shifted(number, 0, 0), _shifted(number, 1, 0), _shifted(number, 0, 1)
    left = _shifted(number, 0, -1)
    everywhere = np.ones(here.shape, bool)
    pairs = (
        (below, everywhere),
        (right, everywhere),
        (_shifted(number, 1, 1), (below < 0) & (right < 0)),
        (_shifted(number, 1, -1), (below < 0) & (left < 0)),
    )
    neighbours: dict[int, list[int]] = defaultdict(list)
    for other, joined in pairs:
        joined = joined & (here >= 0) & (other >= 0)
        for a, b in zip(here[joined].tolist(), other[joined].tolist(), strict=True):
            neighbours[a].append(b)
            neighbours[b].append(a)
    return neighbours


def _node_cells(
    number: np.ndarray, neighbours: dict[int, list[int]], height: np.ndarray
) -> dict[int, int]:
    """Cells that belong to nodes, each with the cell that stands for its node.

    These are the cells whose number of neighbours is not two, and squares of four cells: there is
    no hole between the four, so they are one node, together with all nodes that they touch. The
    cell with the largest clearance stands for it.

    Args:
        number: (H + 2, W + 2) number of each cell, -1 for none.
        neighbours: Numbers of the neighbours of each cell.
        height: (C,) clearance of each cell.
    """
    node_of = {cell: cell for cell in range(len(height)) if len(neighbours[cell]) != 2}
    corners = [_shifted(number, row, column) for row, column in ((0, 0), (1, 0), (0, 1), (1, 1))]
    block = np.stack(corners, axis=-1)
    for square in block[(block >= 0).all(axis=-1)].tolist():
        united = {node_of.get(cell, cell) for cell in square}
        best = max(united, key=lambda cell: (height[cell], -cell))
        members = [cell for cell, node in node_of.items() if node in united]
        node_of |= dict.fromkeys([*square, *members], best)
    return node_of


def _arc(ends: tuple[int, int], cells: np.ndarray) -> _Arc:
    """Arc along a path of cells (n, 2)."""
    line = _simplified(_smoothed(cells))
    return _Arc(ends, cells, line, float(ways.size(line)))


def _smoothed(cells: np.ndarray) -> np.ndarray:
    """Polyline (n, 2) without the staircase of a path of cells (n, 2); the ends stay."""
    line = cells.astype(float)
    for _ in range(4):
        line[1:-1] = 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:]
    return line


def _simplified(line: np.ndarray) -> np.ndarray:
    """Polyline (m, 2) of fewer points, at most `_TOLERANCE` from the given one (n, 2).

    A piece is split at its point furthest from the chord, as long as that is too far.

    References:
        Douglas, Peucker (1973), Algorithms for the reduction of the number of points required to
        represent a digitized line or its caricature.
    """
    kept, pieces = {0, len(line) - 1}, [(0, len(line) - 1)]
    while pieces:
        first, last = pieces.pop()
        distance = ways.beside(line[first + 1 : last], line[[first, last]])[0]
        if distance.size and distance.max() > _TOLERANCE:
            furthest = first + 1 + int(distance.argmax())
            kept.add(furthest)
            pieces += [(first, furthest), (furthest, last)]
    return line[sorted(kept)]


# Clean up the graph.


def _ends(cell_graph: _CellGraph) -> dict[int, list[int]]:
    """Names of the arcs at each node; a loop is there twice."""
    arcs_at: dict[int, list[int]] = {node: [] for node in cell_graph.nodes}
    for k, arc in cell_graph.arcs.items():
        for node in arc.ends:
            arcs_at[node].append(k)
    return arcs_at


def _clean_up(cell_graph: _CellGraph, clearance: np.ndarray) -> None:
    """Drop short spurs, join arcs through nodes of degree 2, merge junctions; until all is stable.

        repeat
            drop spurs:   o---+---o   ->   o---+---o      (a spur hangs from +)
                              '
            join arcs:    o---+---o   ->   o-------o
            merge:        >o-o<       ->   >o<
        until the number of arcs stays

    Dropping a spur may leave a node of degree 2, and joining there may leave a new spur at the
    next junction, so these two alternate first.
    """
    before = None
    while before != len(cell_graph.arcs):
        before = len(cell_graph.arcs)
        while _drop_spurs(cell_graph, clearance):
            _join_through(cell_graph)
        _join_through(cell_graph)
        _merge_junctions(cell_graph, clearance)


def _drop_spurs(cell_graph: _CellGraph, clearance: np.ndarray) -> bool:
    """Drop spurs no longer than the clearance at their root, or into a corner; was any dropped?

    A spur into a corner loses clearance at a constant rate along its length: it is no longer than
    `CORNER` times the difference between root and tip. All spurs are dropped at once, so that of
    the two spurs into the corners of a dead end neither becomes its end.
    """
    arcs_at = _ends(cell_graph)
    short: dict[int, int] = {}  # tip of each short spur

    def height(node: int) -> float:
        return clearance[tuple(cell_graph.nodes[node])]

    for k, arc in cell_graph.arcs.items():
        root, tip = sorted(
            arc.ends, key=lambda node: (len(arcs_at[node]) > 1, height(node)), reverse=True
        )
        limit = max(height(root), CORNER * (height(root) - height(tip)))
        if root != tip and len(arcs_at[tip]) == 1 and arc.length <= limit:
            short[k] = tip
    for k, tip in short.items():
        del cell_graph.arcs[k], cell_graph.nodes[tip]
    return bool(short)


def _join_through(cell_graph: _CellGraph) -> None:
    """Replace the two arcs at each node of degree 2 by one; loops stay."""
    arcs_at = _ends(cell_graph)
    for node, at_node in arcs_at.items():
        if len(at_node) != 2 or at_node[0] == at_node[1]:
            continue
        first, second = at_node
        to_node = _ending_at(cell_graph.arcs[first], node)
        from_node = _starting_at(cell_graph.arcs[second], node)
        ends = to_node.ends[0], from_node.ends[1]
        path = np.concatenate([to_node.cells, from_node.cells[1:]])
        cell_graph.arcs[first] = _arc(ends, path)
        arcs_at[ends[1]] = [first if k == second else k for k in arcs_at[ends[1]]]
        del cell_graph.arcs[second], cell_graph.nodes[node]


def _merge_junctions(cell_graph: _CellGraph, clearance: np.ndarray) -> None:
    """Merge junctions joined by an arc much shorter than their clearances.

    The junction with the larger clearance is kept; the other arcs of the lost one are extended to
    it along the short arc, which is removed.

          a             b               a           b
           '.         .'                 '.       .'
             lost---kept         ->        '---kept
           .'         '.                 .---'    '.
          c             d               c           d
    """
    arcs_at = _ends(cell_graph)

    def height(node: int) -> float:
        return clearance[tuple(cell_graph.nodes[node])]

    for k in sorted(cell_graph.arcs, key=lambda k: (cell_graph.arcs[k].length, k)):
        arc = cell_graph.arcs[k]
        lost, kept = sorted(arc.ends, key=lambda node: (height(node), -node))
        if lost == kept or arc.length > MERGE * height(lost):
            continue
        if len(arcs_at[lost]) < 3 or len(arcs_at[kept]) < 3:
            continue
        extension = _ending_at(arc, lost).cells  # from the kept node to the lost one
        arcs_at[lost].remove(k)
        arcs_at[kept].remove(k)
        for other in arcs_at[lost]:  # a loop comes twice, and is extended at both ends
            from_lost = _starting_at(cell_graph.arcs[other], lost)
            path = np.concatenate([extension, from_lost.cells[1:]])
            cell_graph.arcs[other] = _arc((kept, from_lost.ends[1]), path)
        arcs_at[kept] += arcs_at.pop(lost)
        del cell_graph.arcs[k], cell_graph.nodes[lost]


def _reversed(arc: _Arc) -> _Arc:
    """The arc from its last end to its first."""
    return _Arc(arc.ends[::-1], arc.cells[::-1], arc.line[::-1], arc.length)


def _starting_at(arc: _Arc, node: int) -> _Arc:
    """The arc, reversed if need be so that it starts at a node."""
    return arc if arc.ends[0] == node else _reversed(arc)


def _ending_at(arc: _Arc, node: int) -> _Arc:
    """The arc, reversed if need be so that it ends at a node."""
    return arc if arc.ends[1] == node else _reversed(arc)


# From cells to the map frame.


def _to_map(
    cell_graph: _CellGraph, space: medial.Places, resolution: float, origin: np.ndarray
) -> Graph:
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
    return Graph(
        id=np.arange(len(names)),
        xy=to_map(cells),
        kind=np.full(len(names), NODE),
        clearance=space.room[tuple(cells.T)] * resolution,
        pairs=np.array([[index[node] for node in arc.ends] for arc in arcs], int).reshape(-1, 2),
        length=np.array([ways.size(line) for line in lines], float),
        arc_clearance=np.array([_smallest_clearance(arc.line, space.foot) for arc in arcs])
        * resolution,
        lines=lines,
    )


def _smallest_clearance(line: np.ndarray, foot: np.ndarray) -> float:
    """Smallest distance [cells] from a polyline to the edge of an obstacle.

    The polyline is sampled every quarter of a cell. The nearest obstacle of a sample is taken to be
    one of those of the four cells around it.

    Args:
        line: (n, 2) [cells].
        foot: (2, H, W) index of the nearest obstacle of each cell.
    """
    at_point = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    wanted = np.unique(np.concatenate([at_point, np.arange(0.0, at_point[-1], 0.25)]))
    samples = np.stack([np.interp(wanted, at_point, line[:, axis]) for axis in range(2)])
    row, column = np.floor(samples).astype(int)
    row, column = row + np.array([[0], [0], [1], [1]]), column + np.array([[0], [1], [0], [1]])
    row, column = np.minimum(row, foot.shape[1] - 1), np.minimum(column, foot.shape[2] - 1)
    return float(np.hypot(*(foot[:, row, column] - samples[:, None])).min()) - 0.5
