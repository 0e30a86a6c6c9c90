"""How much of the Voronoi graph of a floor plan is in a map of it, and what else is."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from experiments.plan_graph import PlanGraph
from jaxslam.core import polylines
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.se2_np import transform

NEAR = 0.2  # [m] between a node and the true one
BESIDE = 0.2  # [m] between an arc and the true one, on average


class Agreement(NamedTuple):
    """Which nodes and arcs of two graphs are the same.

    Attributes:
        node: (N,) int node of the map that each true node is, -1 for none.
        arc: (A,) int arc of the map that each true arc is, -1 for none.
        error: (N,) [m] between the two nodes, NaN for none.
    """

    node: np.ndarray
    arc: np.ndarray
    error: np.ndarray


def branches_of(graph: TopologicalMap, frame: np.ndarray) -> PlanGraph:
    """The branches of a map in another frame, without arcs through open space.

    The nodes that only split a branch are passed through; those without a branch are left out.

    Args:
        graph: The map.
        frame: (3,) [m, m, rad] pose of the map frame in the other.
    """
    filled = graph.arc_filled if len(graph.arc_filled) else np.zeros(len(graph.arc_lines), bool)
    arcs = {
        k: (*graph.arc_ends[k].tolist(), np.asarray(graph.arc_lines[k]))
        for k in np.flatnonzero(~filled).tolist()
    }
    at: dict[int, list[int]] = {n: [] for n in range(len(graph.xy))}
    for k, (start, end, _) in arcs.items():
        at[start].append(k)
        at[end].append(k)
    for node, own in at.items():
        if len(own) != 2 or own[0] == own[1]:
            continue
        first, second = (arcs.pop(k) for k in own)
        a, _, to_node = first if first[1] == node else (first[1], first[0], first[2][::-1])
        _, b, onward = second if second[0] == node else (second[1], second[0], second[2][::-1])
        arcs[own[0]] = a, b, np.concatenate([to_node, onward[1:]])
        at[b] = [own[0] if k == own[1] else k for k in at[b]]
    names = sorted({node for start, end, _ in arcs.values() for node in (start, end)})
    rank = {node: n for n, node in enumerate(names)}
    return PlanGraph(
        xy=transform(frame, graph.xy[names].reshape(-1, 2)),
        clearance=graph.clearance[names],
        ends=np.array([[rank[a], rank[b]] for a, b, _ in arcs.values()], int).reshape(-1, 2),
        lines=tuple(transform(frame, line) for _, _, line in arcs.values()),
        junctions=tuple(transform(frame, graph.xy[[name]]) for name in names),
    )


def agreement(true: PlanGraph, found: PlanGraph) -> Agreement:
    """The nodes that lie within `NEAR` of each other, and arcs between these that lie beside.

    A true node that stands for several junctions is where any of them is.
    """
    away = np.array(
        [
            np.hypot(*(places[:, None] - found.xy[None]).transpose(2, 0, 1)).min(axis=0)
            for places in true.junctions
        ]
    ).reshape(len(true.xy), len(found.xy))
    node, error = np.full(len(true.xy), -1), np.full(len(true.xy), np.nan)
    if away.size:
        rows, columns = linear_sum_assignment(np.minimum(away, 2 * NEAR))
        near = away[rows, columns] <= NEAR
        node[rows[near]] = columns[near]
        error[rows[near]] = away[rows, columns][near]
    arc = np.full(len(true.ends), -1)
    pairs = np.sort(found.ends, axis=1)
    for k, (ends, line) in enumerate(zip(true.ends, true.lines, strict=True)):
        wanted = np.sort(node[ends])
        options = np.flatnonzero((pairs == wanted).all(axis=1) & (wanted[0] >= 0))
        options = options[~np.isin(options, arc)]
        gaps = [mean_gap(line, found.lines[n]) for n in options.tolist()]
        if gaps and min(gaps) <= BESIDE:
            arc[k] = options[int(np.argmin(gaps))]
    return Agreement(node, arc, error)


def mean_gap(line: np.ndarray, other: np.ndarray) -> float:
    """Mean distance [m] of a polyline (n, 2) [m] from another."""
    dense = polylines.refine(line, 0.05)
    return float(polylines.project(dense, other)[0].mean())
