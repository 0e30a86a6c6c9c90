"""Topological maps as GraphML, for networkx, igraph, Gephi; needs the extra `[graph]`.

All that identifies a node or arc is an attribute too. networkx takes the ids of nodes and edges
from the file, igraph 1.0 gives the ids of nodes to its edges: `name`, `arc`, `start` and `end` are
the same for all readers.
"""

import math
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from os import PathLike
from typing import Any

import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import PlannerData, Regions
from jaxslam.core.types import as_float64
from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text
from jaxslam.io.route_graph import route_graph


def require() -> None:
    """Raise InputError unless networkx is installed."""
    if find_spec("networkx") is None:
        advice = "pip install 'jaxslam[graph]'"
        raise InputError("networkx is needed to write map.graphml", advice=advice)


def write(
    path: str | PathLike,
    graph: TopologicalMap,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
    *,
    arc_ids: Sequence[int] | None = None,
) -> None:
    """Write a map as an undirected multigraph.

    A node has `name`, its id, `kind`, `x`, `y` and `clearance`, an edge its number `arc`, the names
    `start` and `end` of its nodes, `length` and `clearance`, all [m], and `line`, the polyline in
    well-known text from `start` to `end`. Both have their `region` and `class`, an edge its `door`,
    `speed_limit` [%], `filled`, as in map.geojson, and `widths`, the clearances [m] evenly along
    `line`, with commas. Values that are not finite, or empty, are left out; of `widths` they are
    `nan`. Open ends that have ids are nodes of kind `frontier`, with the edges to them.

    Args:
        path: File to write, atomically.
        graph: The map.
        regions: Its rooms and doors.
        planner: Where its nodes and arcs lie.
        arc_ids: Of the arcs and open ends; by default their indices.

    Raises:
        ValueError: A field of the map is not numbers of its shape, an arc ends at no node, or
            `planner` is of another map.
        InputError: networkx is not installed, or the file cannot be written.
    """
    require()
    import networkx

    graph = _checked(graph)
    nodes, arcs = route_graph(graph, regions, planner)
    multigraph = networkx.MultiGraph()
    for node in nodes:
        attributes: dict[str, Any] = {"name": str(node.id), "kind": node.kind}
        attributes |= {"x": node.x, "y": node.y} | _finite({"clearance": node.clearance})
        multigraph.add_nodes_from([(node.id, attributes | dict(node.metadata))])
    for index, arc in enumerate(arcs):
        arc_id = arc.id if arc_ids is None else int(arc_ids[index])
        attributes = {"arc": arc_id, "start": str(arc.start), "end": str(arc.end)}
        attributes |= {"line": _well_known_text(np.asarray(arc.points, np.float64))}
        attributes |= _finite({"length": arc.length, "clearance": arc.clearance})
        if planner is not None and index < len(planner.arc_widths):
            attributes["widths"] = ",".join(f"{width:.3f}" for width in planner.arc_widths[index])
        multigraph.add_edges_from([(arc.start, arc.end, arc_id, attributes | dict(arc.metadata))])
    write_text(path, "\n".join(networkx.generate_graphml(multigraph)) + "\n")


def _checked(graph: TopologicalMap) -> TopologicalMap:
    """The map with NumPy arrays in what is written; raise ValueError if a field is wrong."""
    xy = as_float64("xy", graph.xy, ("N", 2))
    ends = as_float64("arc_ends", graph.arc_ends, ("A", 2)).astype(int)
    num_nodes, num_arcs = len(xy), len(ends)
    if ends.size and not (0 <= ends.min() and ends.max() < num_nodes):
        raise ValueError(f"arc_ends has indices {ends.min()} to {ends.max()} of {num_nodes} nodes")
    if len(graph.arc_lines) != num_arcs:
        raise ValueError(f"arc_lines has {len(graph.arc_lines)} lines, arc_ends {num_arcs} arcs")
    return graph._replace(
        id=as_float64("id", graph.id, (num_nodes,)).astype(int),
        xy=xy,
        kind=as_float64("kind", graph.kind, (num_nodes,)).astype(int),
        clearance=as_float64("clearance", graph.clearance, (num_nodes,)),
        arc_ends=ends,
        arc_length=as_float64("arc_length", graph.arc_length, (num_arcs,)),
        arc_clearance=as_float64("arc_clearance", graph.arc_clearance, (num_arcs,)),
        arc_lines=tuple(
            as_float64(f"arc_lines[{index}]", line, ("n", 2))
            for index, line in enumerate(graph.arc_lines)
        ),
    )


def _finite(values: Mapping[str, Any]) -> dict[str, float]:
    """Those of the values that are finite."""
    return {name: float(value) for name, value in values.items() if math.isfinite(value)}


def _well_known_text(line: np.ndarray) -> str:
    """A polyline (n, 2) as well-known text."""
    return "LINESTRING (" + ", ".join(f"{x!r} {y!r}" for x, y in line.tolist()) + ")"
