"""Topological maps as GraphML, for networkx, igraph, Gephi; needs the extra `[graph]`."""

import math
from collections.abc import Mapping
from importlib.util import find_spec
from os import PathLike
from typing import Any

import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text


def require() -> None:
    """Raise InputError unless networkx is installed."""
    if find_spec("networkx") is None:
        advice = "pip install 'jaxslam[graph]'"
        raise InputError("networkx is needed to write map.graphml", advice=advice)


def write(path: str | PathLike, graph: TopologicalMap) -> None:
    """Write a map as an undirected multigraph.

    Nodes have `x`, `y` and `clearance`, edges `length` and `clearance`, all [m], and `line`, the
    polyline in well-known text from `source` to `target`. Values that are not finite are left out.

    Args:
        path: File to write, atomically.
        graph: The map.

    Raises:
        InputError: networkx is not installed, or the file cannot be written.
    """
    require()
    import networkx

    multigraph = networkx.MultiGraph()
    for node, (x, y), clearance in zip(graph.id, graph.xy, graph.clearance, strict=True):
        attributes = {"x": float(x), "y": float(y)} | _finite({"clearance": clearance})
        multigraph.add_nodes_from([(int(node), attributes)])
    for index, (start, end) in enumerate(graph.arc_ends):
        numbers = {"length": graph.arc_length[index], "clearance": graph.arc_clearance[index]}
        attributes = {"line": _well_known_text(graph.arc_lines[index])} | _finite(numbers)
        source, target = int(graph.id[start]), int(graph.id[end])
        multigraph.add_edges_from([(source, target, index, attributes)])
    write_text(path, "\n".join(networkx.generate_graphml(multigraph)) + "\n")


def _finite(values: Mapping[str, Any]) -> dict[str, float]:
    """Those of the values that are finite."""
    return {name: float(value) for name, value in values.items() if math.isfinite(value)}


def _well_known_text(line: np.ndarray) -> str:
    """A polyline (n, 2) as well-known text."""
    return "LINESTRING (" + ", ".join(f"{x!r} {y!r}" for x, y in line.tolist()) + ")"
