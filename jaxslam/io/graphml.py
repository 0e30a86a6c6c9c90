"""Topological maps as GraphML, for networkx, igraph, Gephi; needs the extra `[graph]`."""

import math
from importlib.util import find_spec
from os import PathLike
from typing import Any

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text
from jaxslam.topomap import Graph


def require() -> None:
    """Raise InputError unless networkx is installed."""
    if find_spec("networkx") is None:
        advice = "pip install 'jaxslam[graph]'"
        raise InputError("networkx is needed to write map.graphml", advice=advice)


def write(path: str | PathLike, graph: Graph) -> None:
    """Write a map as an undirected multigraph.

    Nodes have `x`, `y` and `clearance`, edges `length` and `clearance`, all [m], and `line`, the
    polyline in well-known text from `source` to `target`. What is not finite is left out.

    Args:
        path: File to write, all of it or nothing.
        graph: The map.

    Raises:
        InputError: networkx is not installed, or the file cannot be written.
    """
    require()
    import networkx

    net = networkx.MultiGraph()
    for id, (x, y), clearance in zip(graph.id, graph.xy, graph.clearance, strict=True):
        net.add_node(int(id), x=float(x), y=float(y), **_finite(clearance=clearance))
    for k, (a, b) in enumerate(graph.pairs):
        numbers = _finite(length=graph.length[k], clearance=graph.arc_clearance[k])
        ends = int(graph.id[a]), int(graph.id[b])
        net.add_edge(*ends, key=k, line=_text(graph.lines[k]), **numbers)
    write_text(path, "\n".join(networkx.generate_graphml(net)) + "\n")


def _finite(**values: Any) -> dict[str, float]:
    """Those of the values that are finite."""
    return {name: float(value) for name, value in values.items() if math.isfinite(value)}


def _text(line: np.ndarray) -> str:
    """A polyline (n, 2) as well-known text."""
    return "LINESTRING (" + ", ".join(f"{x!r} {y!r}" for x, y in line.tolist()) + ")"
