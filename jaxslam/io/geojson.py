"""Topological maps as GeoJSON route graphs, in the form that ROS's nav2_route reads.

A node is a Point; an arc, which the robot may drive both ways, is two directed MultiLineStrings.
"""

import math
from collections.abc import Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from jaxslam.io.output import write_json


class Node(NamedTuple):
    """A place of the map."""

    id: int  # not negative
    x: float  # [m] map frame
    y: float  # [m] map frame
    kind: str
    clearance: float  # [m] to the nearest wall; left out of the file unless finite


class Arc(NamedTuple):
    """A way between two nodes."""

    id: int  # not negative; its own count, apart from the nodes'
    start: int  # id of a node
    end: int  # id of a node
    length: float  # [m]
    clearance: float  # [m] at its narrowest; left out of the file unless finite
    points: np.ndarray  # (k, 2) [m] map frame, from start to end


def write(
    path: str | PathLike, nodes: Sequence[Node], arcs: Sequence[Arc], frame: str = "map"
) -> None:
    """Write a map; the ids of edges follow the highest of the nodes, as they share one count.

    Args:
        path: File to write, all of it or nothing.
        nodes: Places, each id once.
        arcs: Ways between them.
        frame: Name of the frame the coordinates are in.

    Raises:
        ValueError: An id occurs twice or is negative, an arc ends at no node, or a coordinate or
            length is not finite.
        InputError: The file cannot be written.
    """
    _check(nodes, arcs)
    first = 1 + max((int(node.id) for node in nodes), default=-1)
    features = [_node_feature(node, frame) for node in nodes]
    for arc in arcs:
        points = np.asarray(arc.points, np.float64)
        there = first + 2 * int(arc.id)
        features.append(_edge_feature(there, arc.start, arc.end, arc, points))
        features.append(_edge_feature(there + 1, arc.end, arc.start, arc, points[::-1]))
    write_json(path, {"type": "FeatureCollection", "name": "graph", "features": features})


def _check(nodes: Sequence[Node], arcs: Sequence[Arc]) -> None:
    """Raise ValueError where the graph is not one."""
    ids = [int(node.id) for node in nodes]
    for what, all_ids in (("node", ids), ("arc", [int(arc.id) for arc in arcs])):
        if len(set(all_ids)) != len(all_ids) or min(all_ids, default=0) < 0:
            raise ValueError(f"{what} ids must differ and not be negative: {sorted(all_ids)}")
    for node in nodes:
        if not (math.isfinite(node.x) and math.isfinite(node.y)):
            raise ValueError(f"node {node.id} is at ({node.x}, {node.y})")
    for arc in arcs:
        points = np.asarray(arc.points)
        if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != 2:
            raise ValueError(f"arc {arc.id} has points {points.shape}, not (k >= 2, 2)")
        if not np.isfinite(points).all() or not math.isfinite(arc.length):
            raise ValueError(f"arc {arc.id} has a point or length that is not finite")
        if not {int(arc.start), int(arc.end)} <= set(ids):
            raise ValueError(f"arc {arc.id} joins {arc.start} and {arc.end}, not both nodes")


def _node_feature(node: Node, frame: str) -> dict[str, Any]:
    """GeoJSON of a node."""
    properties = {
        "id": int(node.id),
        "frame": frame,
        "metadata": {"kind": node.kind, **_clearance(node.clearance)},
        "operations": {},
    }
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "Point", "coordinates": [float(node.x), float(node.y)]},
    }


def _edge_feature(id: int, start: int, end: int, arc: Arc, points: np.ndarray) -> dict[str, Any]:
    """GeoJSON of one direction of an arc."""
    length = float(arc.length)
    return {
        "type": "Feature",
        "properties": {
            "id": id,
            "startid": int(start),
            "endid": int(end),
            "cost": length,
            "overridable": True,
            "metadata": {"arc": int(arc.id), "length": length, **_clearance(arc.clearance)},
        },
        "geometry": {"type": "MultiLineString", "coordinates": [points.tolist()]},
    }


def _clearance(value: float) -> dict[str, float]:
    """Metadata entry of a clearance [m], none if it is not finite: nav2_route refuses null."""
    return {"clearance": float(value)} if math.isfinite(value) else {}
