"""Shortest routes over a topological map."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import csgraph

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.types import as_float64, check_array


class Route(NamedTuple):
    """A path over a topological map.

    Attributes:
        nodes: Indices of its nodes, in order.
        arcs: Indices of the arcs between them, in order.
        line: (n, 2) [m] polyline, map frame.
        length: [m].
    """

    nodes: list[int]
    arcs: list[int]
    line: np.ndarray
    length: float


def find_route(
    topological_map: TopologicalMap, start: int, goal: int, *, min_clearance: float = 0.0
) -> Route:
    """Shortest path over a topological map.

    Args:
        topological_map: The map.
        start: Index of the first node.
        goal: Index of the last node.
        min_clearance: [m] that each arc must have; above 0, arcs without a known one are not used.

    Raises:
        ValueError: No arcs of that clearance lead from `start` to `goal`, there is no such node,
            or an argument is of another type.
    """
    if not isinstance(topological_map, TopologicalMap):
        given = type(topological_map).__name__
        raise ValueError(f"topological_map is of type {given}, not TopologicalMap")
    if not np.isfinite(min_clearance):
        raise ValueError(f"min_clearance is {min_clearance}, not a finite number of metres")
    # A clearance that is not known, NaN, compares false.
    usable = (min_clearance <= 0.0) | (topological_map.arc_clearance >= min_clearance)
    lengths = np.where(usable, topological_map.arc_length, np.inf)
    arcs = shortest_path(
        topological_map.arc_ends, lengths, start, goal, num_nodes=len(topological_map.xy)
    )
    nodes, line = join_arcs(topological_map.arc_lines, topological_map.arc_ends, arcs, int(start))
    line = line if arcs else topological_map.xy[[int(start)]]
    return Route(nodes, arcs, line, float(np.sum(topological_map.arc_length[arcs])))


def shortest_path(
    pairs: ArrayLike, lengths: ArrayLike, start: int, goal: int, *, num_nodes: int
) -> list[int]:
    """Arcs of the shortest path from node `start` to node `goal`, in order (Dijkstra).

    Args:
        pairs: (A, 2) int, the two nodes that each arc joins; undirected, loops and parallel arcs
            are allowed.
        lengths: (A,) [m], not negative; infinite for arcs that must not be used.
        start: Index of the first node.
        goal: Index of the last node.
        num_nodes: N, number of nodes.

    Returns:
        Indices of the arcs; empty if `start` is `goal`.

    Raises:
        ValueError: No arcs lead from `start` to `goal`, there is no such node, or a length is
            negative, NaN or missing.
    """
    for name, node in (("start", start), ("goal", goal)):
        check_array(name, np.asarray(node), (), np.integer)
        if not 0 <= node < num_nodes:
            raise ValueError(f"{name} is {node}, not a node 0 to {num_nodes - 1}")
    lengths = as_float64("lengths", lengths, ("A",))
    pairs = _checked_pairs(pairs, len(lengths), num_nodes)
    if np.any(lengths < 0) or np.any(np.isnan(lengths)):
        raise ValueError("lengths holds numbers that are negative or NaN")
    path = find_path(pairs, lengths, int(start), int(goal), num_nodes=num_nodes)
    if path is None:
        raise ValueError(f"no route leads from node {start} to node {goal}")
    return path


def find_path(
    pairs: np.ndarray, lengths: np.ndarray, start: int, goal: int, *, num_nodes: int
) -> list[int] | None:
    """As `shortest_path`, without checks; None if no arcs lead from `start` to `goal`."""
    # The shortest of parallel arcs; the sparse matrix would add them up.
    ends = np.sort(pairs, axis=1)
    order = np.argsort(lengths, kind="stable")[: np.count_nonzero(lengths < np.inf)]
    order = order[np.unique(ends[order] @ [num_nodes, 1], return_index=True)[1]]
    adjacency = sparse.csr_array((lengths[order], ends[order].T), shape=(num_nodes, num_nodes))
    predecessor = csgraph.dijkstra(
        adjacency, directed=False, indices=start, return_predecessors=True
    )[1]
    path: list[int] = []
    node = goal
    while node != start:
        previous = int(predecessor[node])
        if previous < 0:
            return None
        parallel = np.flatnonzero(np.all(ends == sorted((previous, node)), axis=1))
        path.append(int(parallel[np.argmin(lengths[parallel])]))
        node = previous
    return path[::-1]


def _checked_pairs(pairs: ArrayLike, count: int, num_nodes: int) -> np.ndarray:
    """Pairs (A, 2) int of nodes as an array; ValueError if they are no such pairs."""
    pairs = np.asarray(pairs)
    if pairs.size == 0:
        pairs = np.zeros((0, 2), int)
    check_array("pairs", pairs, (count, 2), np.integer)
    if pairs.size and not (0 <= pairs.min() and pairs.max() < num_nodes):
        raise ValueError(f"pairs holds nodes {pairs.min()} to {pairs.max()} of {num_nodes}")
    return pairs


def join_arcs(
    lines: Sequence[np.ndarray], pairs: np.ndarray, arcs: Sequence[int], start: int
) -> tuple[list[int], np.ndarray]:
    """The nodes and the polyline of a path.

    Args:
        lines: A polylines (n >= 2, 2) [m] of all arcs.
        pairs: (A, 2) int, the two nodes that each arc joins, in the direction of its polyline.
        arcs: Indices of the arcs of the path, in order.
        start: Index of the first node.

    Returns:
        Indices of the nodes, in order, and the polyline (n, 2) [m]; (0, 2) without arcs.
    """
    node, nodes = start, [start]
    pieces: list[np.ndarray] = []
    for k in arcs:
        a, b = (int(end) for end in pairs[k])
        pieces.append(lines[k] if a == node else lines[k][::-1])
        node = b if a == node else a
        nodes.append(node)
    return nodes, np.concatenate(pieces) if pieces else np.zeros((0, 2))
