"""The graph of a one-cell-thin skeleton: nodes, and arcs as paths of cells."""

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from jaxslam.core import polylines

_TOLERANCE = 0.4  # [cells] of the simplification of polylines


class CellArc(NamedTuple):
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


class CellGraph(NamedTuple):
    """A graph of cells; changed in place.

    Attributes:
        nodes: Cell index (2,) of each node, by name.
        arcs: The arcs, by name.
    """

    nodes: dict[int, np.ndarray]
    arcs: dict[int, CellArc]


def trace_cells(
    cells: np.ndarray, clearance: np.ndarray, also: np.ndarray | None = None
) -> CellGraph:
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
        also: (H, W) bool, cells that are nodes too.
    """
    index = np.argwhere(cells)
    number = np.full(np.add(cells.shape, 2), -1)  # of each cell, -1 for none; padded
    number[tuple(index.T + 1)] = np.arange(len(index))
    height = clearance[tuple(index.T)]
    neighbours = _neighbours(number, index)
    node_of = _node_cells(number, index, neighbours, height)
    if also is not None:
        for cell in np.flatnonzero(also[tuple(index.T)]).tolist():
            node_of.setdefault(cell, cell)
    cell_graph = CellGraph({node: index[node] for node in node_of.values()}, {})
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
        cell_graph.arcs[len(cell_graph.arcs)] = make_arc(ends, index[[*before, *path, *after]])

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


def _beside(number: np.ndarray, index: np.ndarray, row: int, column: int) -> np.ndarray:
    """Number (C,) of the cell `row` rows and `column` columns on from cells (C, 2)."""
    return number[index[:, 0] + 1 + row, index[:, 1] + 1 + column]


def _neighbours(number: np.ndarray, index: np.ndarray) -> dict[int, list[int]]:
    """Neighbours of each cell: those at a side, and across a corner where no cell is at both sides.

        a #        a and b are neighbours through #, not across the corner
        . b

    Args:
        number: (H + 2, W + 2) number of each cell, -1 for none.
        index: (C, 2) the cells by their numbers.
    """
    below, right, left = (_beside(number, index, *to) for to in ((1, 0), (0, 1), (0, -1)))
    everywhere = np.ones(len(index), bool)
    pairs = (
        (below, everywhere),
        (right, everywhere),
        (_beside(number, index, 1, 1), (below < 0) & (right < 0)),
        (_beside(number, index, 1, -1), (below < 0) & (left < 0)),
    )
    neighbours: dict[int, list[int]] = defaultdict(list)
    for other, joined in pairs:
        here = np.flatnonzero(joined & (other >= 0))
        for a, b in zip(here.tolist(), other[here].tolist(), strict=True):
            neighbours[a].append(b)
            neighbours[b].append(a)
    return neighbours


def _node_cells(
    number: np.ndarray, index: np.ndarray, neighbours: dict[int, list[int]], height: np.ndarray
) -> dict[int, int]:
    """Cells that belong to nodes, each with the cell that stands for its node.

    These are the cells whose number of neighbours is not two, and squares of four cells: there is
    no hole between the four, so they are one node, together with all nodes that they touch. The
    cell with the largest clearance stands for it.

    Args:
        number: (H + 2, W + 2) number of each cell, -1 for none.
        index: (C, 2) the cells by their numbers.
        neighbours: Numbers of the neighbours of each cell.
        height: (C,) clearance of each cell.
    """
    node_of = {cell: cell for cell in range(len(height)) if len(neighbours[cell]) != 2}
    block = np.stack(
        [_beside(number, index, *to) for to in ((0, 0), (1, 0), (0, 1), (1, 1))], axis=-1
    )
    members = {cell: [cell] for cell in node_of}  # of each node
    for square in block[(block >= 0).all(axis=-1)].tolist():
        united = {node_of.get(cell, cell) for cell in square}
        best = max(united, key=lambda cell: (height[cell], -cell))
        cells = dict.fromkeys(square) | {c: None for node in united for c in members.pop(node, ())}
        members[best] = list(cells)
        node_of |= dict.fromkeys(cells, best)
    return node_of


def make_arc(ends: tuple[int, int], cells: np.ndarray) -> CellArc:
    """Arc along a path of cells (n, 2)."""
    line = polylines.simplify(_smoothed(cells), _TOLERANCE)
    return CellArc(ends, cells, line, float(polylines.length(line)))


def _smoothed(cells: np.ndarray) -> np.ndarray:
    """Polyline (n, 2) without the staircase of a path of cells (n, 2); the ends stay."""
    line = cells.astype(float)
    for _ in range(4):
        line[1:-1] = 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:]
    return line
