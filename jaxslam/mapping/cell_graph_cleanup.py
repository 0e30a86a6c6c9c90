"""Clean-up of a cell graph: spurs dropped, arcs joined, close junctions merged."""

from collections.abc import Collection

import numpy as np

from jaxslam.mapping.cell_graph import CellArc, CellGraph, make_arc

# A spur into a right corner is 1.41 times as long as its clearance decreases.
CORNER_SPUR_FACTOR = 1.6
# Junctions closer than this fraction of the smaller of their clearances are merged.
MERGE_FRACTION = 0.5
SAME_JUNCTION = 4.0  # [cells] to a node that stays, within which a node is the same


def arcs_at_nodes(cell_graph: CellGraph) -> dict[int, list[int]]:
    """Names of the arcs at each node; a loop is there twice."""
    arcs_at: dict[int, list[int]] = {node: [] for node in cell_graph.nodes}
    for k, arc in cell_graph.arcs.items():
        for node in arc.ends:
            arcs_at[node].append(k)
    return arcs_at


def clean_up(cell_graph: CellGraph, clearance: np.ndarray, kept: Collection[int] = ()) -> None:
    """Drop short spurs, join arcs through nodes of degree 2, merge junctions; until all is stable.

        repeat
            drop spurs:   o---+---o   ->   o---+---o      (a spur hangs from +)
                              '
            join arcs:    o---+---o   ->   o-------o
            merge:        >o-o<       ->   >o<
        until the number of arcs stays

    Dropping a spur may leave a node of degree 2, and joining there may leave a new spur at the
    next junction, so these two alternate first.

    Args:
        cell_graph: The graph; changed in place.
        clearance: (H, W) [cells] distance to the nearest obstacle.
        kept: Names of nodes that stay, whatever arcs they have.
    """
    before = None
    while before != len(cell_graph.arcs):
        before = len(cell_graph.arcs)
        while drop_spurs(cell_graph, clearance, kept):
            _join_through(cell_graph, kept)
        _join_through(cell_graph, kept)
        _merge_junctions(cell_graph, clearance, kept)


def drop_spurs(cell_graph: CellGraph, clearance: np.ndarray, kept: Collection[int] = ()) -> bool:
    """Drop spurs no longer than the clearance at their root, or into a corner; was any dropped?

    A spur into a corner loses clearance at a constant rate along its length: it is no longer than
    `CORNER_SPUR_FACTOR` times the difference between root and tip. All spurs are dropped at once,
    so that of the two spurs into the corners of a dead end neither becomes its end.

    Args:
        cell_graph: The graph; changed in place.
        clearance: (H, W) [cells] distance to the nearest obstacle.
        kept: Names of nodes that are no tips of spurs.
    """
    arcs_at = arcs_at_nodes(cell_graph)
    short: dict[int, int] = {}  # tip of each short spur

    def height(node: int) -> float:
        return clearance[tuple(cell_graph.nodes[node])]

    for k, arc in cell_graph.arcs.items():
        root, tip = sorted(
            arc.ends, key=lambda node: (len(arcs_at[node]) > 1, height(node)), reverse=True
        )
        limit = max(height(root), CORNER_SPUR_FACTOR * (height(root) - height(tip)))
        is_spur = root != tip and len(arcs_at[tip]) == 1 and tip not in kept
        if is_spur and arc.length <= limit:
            short[k] = tip
    for k, tip in short.items():
        del cell_graph.arcs[k], cell_graph.nodes[tip]
    return bool(short)


def _join_through(cell_graph: CellGraph, kept: Collection[int]) -> None:
    """Replace the two arcs at each node of degree 2 by one; loops stay."""
    arcs_at = arcs_at_nodes(cell_graph)
    for node, at_node in arcs_at.items():
        if len(at_node) != 2 or at_node[0] == at_node[1] or node in kept:
            continue
        first, second = at_node
        to_node = _ending_at(cell_graph.arcs[first], node)
        from_node = _starting_at(cell_graph.arcs[second], node)
        ends = to_node.ends[0], from_node.ends[1]
        path = np.concatenate([to_node.cells, from_node.cells[1:]])
        cell_graph.arcs[first] = make_arc(ends, path)
        arcs_at[ends[1]] = [first if k == second else k for k in arcs_at[ends[1]]]
        del cell_graph.arcs[second], cell_graph.nodes[node]


def _merge_junctions(cell_graph: CellGraph, clearance: np.ndarray, stay: Collection[int]) -> None:
    """Merge junctions joined by an arc much shorter than their clearances.

    The junction with the larger clearance is kept; the other arcs of the lost one are extended to
    it along the short arc, which is removed.

          a             b               a           b
           '.         .'                 '.       .'
             lost---kept         ->        '---kept
           .'         '.                 .---'    '.
          c             d               c           d
    """
    arcs_at = arcs_at_nodes(cell_graph)

    def height(node: int) -> float:
        return clearance[tuple(cell_graph.nodes[node])]

    for k in sorted(cell_graph.arcs, key=lambda k: (cell_graph.arcs[k].length, k)):
        arc = cell_graph.arcs[k]
        lost, kept = sorted(arc.ends, key=lambda node: (node in stay, height(node), -node))
        if lost == kept or arc.length > MERGE_FRACTION * height(lost):
            continue
        is_same = arc.length <= SAME_JUNCTION and kept in stay
        if not is_same and (lost in stay or len(arcs_at[lost]) < 3 or len(arcs_at[kept]) < 3):
            continue
        extension = _ending_at(arc, lost).cells  # from the kept node to the lost one
        arcs_at[lost].remove(k)
        arcs_at[kept].remove(k)
        for other in arcs_at[lost]:  # a loop comes twice, and is extended at both ends
            from_lost = _starting_at(cell_graph.arcs[other], lost)
            path = np.concatenate([extension, from_lost.cells[1:]])
            cell_graph.arcs[other] = make_arc((kept, from_lost.ends[1]), path)
        arcs_at[kept] += arcs_at.pop(lost)
        del cell_graph.arcs[k], cell_graph.nodes[lost]


def _reversed(arc: CellArc) -> CellArc:
    """The arc from its last end to its first."""
    return CellArc(arc.ends[::-1], arc.cells[::-1], arc.line[::-1], arc.length)


def _starting_at(arc: CellArc, node: int) -> CellArc:
    """The arc, reversed if need be so that it starts at a node."""
    return arc if arc.ends[0] == node else _reversed(arc)


def _ending_at(arc: CellArc, node: int) -> CellArc:
    """The arc, reversed if need be so that it ends at a node."""
    return arc if arc.ends[1] == node else _reversed(arc)
