"""Topological maps as GeoJSON route graphs, in the format that ROS's nav2_route reads.

A node is a Point; an arc, which the robot may drive in both directions, is two directed
MultiLineStrings. `annotated_map` reads what users add to such a file, and `carry_over` takes it and
the ids of arcs to the next map.
"""

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxslam.io.output import write_json_rows

FRONTIER = "frontier"
KINDS = ("node", "corner", "wall", FRONTIER)
"""Kinds of nodes in the file: junction, corner, wall direction, open end."""
COUNTERS = "jaxslam"
"""Member of the file: no edge or arc has had an id as high as `next_id` or `next_arc`; absent where
the features in the file show as much."""
NOTHING: Mapping[str, Any] = MappingProxyType({})


class Node(NamedTuple):
    """A node of the map.

    Attributes:
        id: Not negative.
        x: [m] map frame.
        y: [m] map frame.
        kind: Kind of landmark.
        clearance: [m] to the nearest wall; left out of the file unless finite.
        properties: More properties, of the user; ours win.
        metadata: More metadata of ours; the user's win.
    """

    id: int
    x: float
    y: float
    kind: str
    clearance: float
    properties: Mapping[str, Any] = NOTHING
    metadata: Mapping[str, Any] = NOTHING


class Arc(NamedTuple):
    """An arc (edge) between two nodes.

    Attributes:
        id: Not negative; counted apart from the ids of nodes.
        start: Id of a node.
        end: Id of a node.
        length: [m].
        clearance: [m] at its narrowest point; left out of the file unless finite.
        points: (k, 2) [m, map frame] polyline from start to end.
        edges: Ids of the edges from start to end and back; None for those after the highest node.
        properties: More properties of these two edges, of the user; ours win.
        metadata: More metadata of both edges, of ours; the user's win.
        operations: Operations of both edges, of ours; the user's win.
    """

    id: int
    start: int
    end: int
    length: float
    clearance: float
    points: np.ndarray
    edges: tuple[int, int] | None = None
    properties: tuple[Mapping[str, Any], Mapping[str, Any]] = (NOTHING, NOTHING)
    metadata: Mapping[str, Any] = NOTHING
    operations: Mapping[str, Any] = NOTHING


def write(
    path: str | PathLike,
    nodes: Sequence[Node],
    arcs: Sequence[Arc],
    frame: str = "map",
    *,
    next_id: int = 0,
    features: Sequence[Mapping[str, Any]] = (),
    members: Mapping[str, Any] = NOTHING,
) -> None:
    """Write a map; edge ids follow those of all nodes, as nav2_route has one set of ids.

    Args:
        path: File to write, atomically.
        nodes: Their ids are distinct.
        arcs: Arcs between them.
        frame: Name of the frame of the coordinates.
        next_id: No landmark has had this id or a higher one, also those that are no nodes yet.
        features: More features, of the user.
        members: More members of the file, of the user; `name` replaces ours.

    Raises:
        ValueError: Something is no `Node` or `Arc`, an id occurs twice or is negative, an arc ends
            at no node, or a coordinate or length is not finite.
        InputError: The file cannot be written.
    """
    _check(nodes, arcs)
    first_edge = max(next_id, 1 + max((int(node.id) for node in nodes), default=-1))
    written = [_node_feature(node, frame) for node in nodes]
    for arc in arcs:
        points = np.asarray(arc.points, np.float64)
        edge = first_edge + 2 * int(arc.id)
        there, back = (edge, edge + 1) if arc.edges is None else arc.edges
        own, own_back = arc.properties
        written.append(_edge_feature(there, arc.start, arc.end, arc, points, own))
        written.append(_edge_feature(back, arc.end, arc.start, arc, points[::-1], own_back))
    _check_ids(written)
    content = {"type": "FeatureCollection", "name": "graph"} | dict(members)
    write_json_rows(path, content | {"features": [*written, *features]})


def _check_ids(features: Sequence[Mapping[str, Any]]) -> None:
    """Raise ValueError if an id of a node or edge occurs twice."""
    ids = [feature["properties"]["id"] for feature in features]
    if len(set(ids)) != len(ids):
        raise ValueError(f"ids of nodes and edges must differ: {sorted(ids)}")


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
    known = set(node_ids)
    for node in nodes:
        if not (math.isfinite(node.x) and math.isfinite(node.y)):
            raise ValueError(f"node {node.id} is at ({node.x}, {node.y})")
    for arc in arcs:
        points = np.asarray(arc.points)
        if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != 2:
            raise ValueError(f"arc {arc.id} has points {points.shape}, not (k >= 2, 2)")
        if not np.isfinite(points).all() or not math.isfinite(arc.length):
            raise ValueError(f"arc {arc.id} has a point or length that is not finite")
        if not {int(arc.start), int(arc.end)} <= known:
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
        "properties": _merged(properties, _added(node.properties, node.metadata)),
        "geometry": {"type": "Point", "coordinates": [float(node.x), float(node.y)]},
    }


def _edge_feature(
    edge_id: int, start: int, end: int, arc: Arc, points: np.ndarray, own: Mapping[str, Any]
) -> dict[str, Any]:
    """GeoJSON of one direction of an arc, with the user's own properties."""
    length = float(arc.length)
    properties = {
        "id": int(edge_id),
        "startid": int(start),
        "endid": int(end),
        "cost": length,
        "overridable": True,
        "metadata": {"arc": int(arc.id), "length": length} | _clearance(arc.clearance),
    }
    return {
        "type": "Feature",
        "properties": _merged(properties, _added(own, arc.metadata, arc.operations)),
        "geometry": {"type": "MultiLineString", "coordinates": [points]},
    }


def _added(
    own: Mapping[str, Any], metadata: Mapping[str, Any], operations: Mapping[str, Any] = NOTHING
) -> Mapping[str, Any]:
    """The user's properties with metadata and operations of ours, where the user has no others."""
    added = dict(own)
    if metadata:
        theirs = own.get("metadata")
        added["metadata"] = dict(metadata) | dict(theirs if isinstance(theirs, Mapping) else {})
    if operations:
        theirs = own.get("operations") or {}
        if isinstance(theirs, Mapping):
            added["operations"] = dict(operations) | dict(theirs)
        elif isinstance(theirs, list):
            added["operations"] = [*operations.values(), *theirs]
    return added


def _merged(ours: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Our properties with the user's own, objects merged; of other values ours win."""
    merged = dict(ours) | {key: value for key, value in own.items() if key not in ours}
    for key in ours.keys() & own.keys():
        if ours[key] == {}:
            merged[key] = own[key]
        elif isinstance(ours[key], Mapping) and isinstance(own[key], Mapping):
            merged[key] = _merged(ours[key], own[key])
    return merged


def _clearance(value: float) -> dict[str, float]:
    """Metadata entry of a clearance [m], none if it is not finite: nav2_route refuses null."""
    return {"clearance": float(value)} if math.isfinite(value) else {}
