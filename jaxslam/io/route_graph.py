"""A topological map as nodes and arcs of `geojson`, with regions, doors and open ends."""

from collections.abc import Sequence

import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import PlannerData, Regions
from jaxslam.core.types import JUNCTION
from jaxslam.io.geojson import FRONTIER, KINDS, Arc, Node
from jaxslam.io.nav2_metadata import door_operations, edge_metadata, node_metadata
from jaxslam.io.route_labels import (
    Label,
    arc_clearances,
    frontier_labels,
    labels,
    speed_fraction,
)

FILLED = {"filled": True}
"""Metadata of an arc through open space, which is no branch of the Voronoi diagram."""


def route_graph(
    graph: TopologicalMap,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
    *,
    with_operations: bool = True,
) -> tuple[list[Node], list[Arc]]:
    """All nodes and arcs of a map, numbered as in the map; open ends that have ids come last.

    An open end is a node of kind `frontier` at the last point of its polyline, and an arc from its
    node to there, whose clearance is not known.

    Args:
        graph: The map.
        regions: Its rooms and doors.
        planner: Where its nodes and arcs lie; used with `regions`, but for the widths.
        with_operations: Whether doors are opened by operations.

    Raises:
        ValueError: `planner` is of another map, or the open ends have other numbers of ids or
            nodes than polylines.
    """
    of_nodes, of_arcs = labels(graph, regions, planner)
    clearances = arc_clearances(graph, planner)
    nodes = []
    rows = zip(graph.id, graph.xy, graph.kind, graph.clearance, of_nodes, strict=True)
    for node, (x, y), kind, clearance, label in rows:
        clearance = float(clearance) if kind == JUNCTION else np.nan
        own = node_metadata(label)
        nodes.append(Node(int(node), float(x), float(y), KINDS[kind], clearance, metadata=own))
    arcs, filled = [], set(np.flatnonzero(graph.arc_filled).tolist())
    for index, (start, end) in enumerate(graph.arc_ends):
        label, clearance = of_arcs[index], float(clearances[index])
        arc = Arc(
            index,
            int(graph.id[start]),
            int(graph.id[end]),
            float(graph.arc_length[index]),
            clearance,
            graph.arc_lines[index],
            metadata=edge_metadata(label, speed_fraction(clearance))
            | (FILLED if index in filled else {}),
            operations=door_operations(label) if with_operations else {},
        )
        arcs.append(arc)
    if len(graph.frontier_id):
        of_ends = frontier_labels(graph, regions, planner)
        more_nodes, more_arcs = _open_ends(graph, of_ends, with_operations)
        return nodes + more_nodes, arcs + more_arcs
    return nodes, arcs


def _open_ends(
    graph: TopologicalMap, of_ends: Sequence[Label], with_operations: bool
) -> tuple[list[Node], list[Arc]]:
    """The nodes and arcs of open ends."""
    nodes, arcs = [], []
    rows = zip(graph.frontier_id, graph.frontier_node, graph.frontiers, of_ends, strict=True)
    for index, (frontier, node, line, label) in enumerate(rows, start=len(graph.arc_ends)):
        x, y = np.asarray(line, np.float64)[-1]
        nodes.append(Node(int(frontier), float(x), float(y), FRONTIER, np.nan))
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        start, own = int(graph.id[node]), edge_metadata(label, speed_fraction(np.nan))
        opened = door_operations(label) if with_operations else {}
        arcs.append(
            Arc(
                index,
                start,
                int(frontier),
                length,
                np.nan,
                line,
                metadata=own,
                operations=opened,
            )
        )
    return nodes, arcs
