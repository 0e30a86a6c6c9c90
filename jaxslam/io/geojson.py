"""Topological maps as GeoJSON route graphs, in the format that ROS's nav2_route reads.

A node is a Point; an arc, which the robot may drive in both directions, is two directed
MultiLineStrings.
"""

import math
from collections.abc import Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from jaxslam.io.output import write_json


class Node(NamedTuple):
    """A node of the map.

    Attributes:
        id: Not negative.
        x: [m] map frame.
        y: [m] map frame.
        kind: Kind of landmark.
        clearance: [m] to the nearest wall; left out of the file unless finite.
    """

    id: int
    x: float
    y: float
    kind: str
    clearance: float


class Arc(NamedTuple):
    """An arc (edge) between two nodes.

    Attributes:
        id: Not negative; counted apart from the ids of nodes.
        start: Id of a node.
        end: Id of a node.
        length: [m].
        clearance: [m] at its narrowest point; left out of the file unless finite.
        points: (k, 2) [m, map frame] polyline from start to end.
    """

    id: int
    start: int
    end: int
    length: float
    clearance: float
    points: np.ndarray


def write(
    path: str | PathLike, nodes: Sequence[Node], arcs: Sequence[Arc], frame: str = "map"
) -> None:
    """Write a map; edge ids follow the highest node id, as nav2_route has one set of ids.

    Args:
        path: File to write, atomically.
        nodes: Their ids are distinct.
        arcs: Arcs between them.
        frame: Name of the frame of the coordinates.

    Raises:
        ValueError: Something is no `Node` or `Arc`, an id occurs twice or is negative, an arc ends
            at no node, or a coordinate or length is not finite.
        InputError: The file cannot be written.
    """
    _check(nodes, arcs)
    first_edge = 1 + max((int(node.id) for node in nodes), default=-1)
    features = [_node_feature(node, frame) for node in nodes]
    for arc in arcs:
        points = np.asarray(arc.points, np.float64)
        edge = first_edge + 2 * int(arc.id)
        features.append(_edge_feature(edge, arc.start, arc.end, arc, points))
        features.append(_edge_feature(edge + 1, arc.end, arc.start, arc, points[::-1]))
    write_json(path, {"type": "FeatureCollection", "name": "graph", "features": features})


def _check(nodes: Sequence[Node], arcs: Sequence[Arc]) -> None:
    """Raise ValueError unless nodes and arcs are a valid graph."""
    for what, items, kind in (("nodes", nodes, Node), ("arcs", arcs, Arc)):
        for index, item in enumerate(items):
            if not isinstance(item, kind):
                raise ValueError(f"{what}[{index}] is {type(item).__name__}, not {kind.__name__}")
    node_ids = [int(node.id) for node in nodes]
    for what, ids in (("node", node_ids), ("arc", [int(arc.id) for arc in arcs])):
        if len(set(ids)) != len(ids) or min(ids, default=0) < 0:
            raise ValueError(f"{what} ids must differ and not be negative: {sorted(ids)}")
    for node in nodes:
        if not (math.isfinite(node.x) and math.isfinite(node.y)):
            raise ValueError(f"node {node.id} is at ({node.x}, {node.y})")
    for arc in arcs:
        points = np.asarray(arc.points)
        if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != 2:
            raise ValueError(f"arc {arc.id} has points {points.shape}, not (k >= 2, 2)")
        if not np.isfinite(points).all() or not math.isfinite(arc.length):
            raise ValueError(f"arc {arc.id} has a point or length that is not finite")
        if not {int(arc.start), int(arc.end)} <= set(node_ids):
            raise ValueError(f"arc {arc.id} joins {arc.start} and {arc.end}, not both nodes")


def _node_feature(node: Node, frame: str) -> dict[str, Any]:
    """GeoJSON of a node."""
    properties = {
        "id": int(node.id),
        "frame": frame,
        "metadata": {"kind": node.kind} | _clearance(node.clearance),
        "operations": {},
    }
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "Point", "coordinates": [float(node.x), float(node.y)]},
    }


def _edge_feature(
    edge_id: int, start: int, end: int, arc: Arc, points: np.ndarray
) -> dict[str, Any]:
    """GeoJSON of one direction of an arc."""
    length = float(arc.length)
    return {
        "type": "Feature",
        "properties": {
            "id": edge_id,
            "startid": int(start),
            "endid": int(end),
            "cost": length,
            "overridable": True,
            "metadata": {"arc": int(arc.id), "length": length} | _clearance(arc.clearance),
        },
        "geometry": {"type": "MultiLineString", "coordinates": [points.tolist()]},
    }


def _clearance(value: float) -> dict[str, float]:
    """Metadata entry of a clearance [m], none if it is not finite: nav2_route refuses null."""
    return {"clearance": float(value)} if math.isfinite(value) else {}
