"""Reader of a `map.geojson` that users annotated: their properties, their own features.

Ours are the Points whose `metadata.kind` is one of `KINDS`, and the lines with a `metadata.arc`;
all other features are the user's. Of ours the keys that `geojson.write` writes are ours, all other
keys, also those in `metadata` and `operations`, are the user's; so is what `nav2_metadata` writes,
where it is not as written there. Editors may write numbers as "12"
or 12.0, nested objects as strings of JSON, missing values as null, and ids as members of features.
"""

import math
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.maps import MAX_COORDINATE
from jaxslam.io import strict_json
from jaxslam.io.errors import InputError
from jaxslam.io.geojson import COUNTERS, KINDS
from jaxslam.io.nav2_metadata import users_metadata, users_operations

MAX_ID = 2**31 - 2  # ids are int32, also the one after it

LINES = ("LineString", "MultiLineString")
GRAPH_TYPES = ("Point", *LINES)
"""Geometry types that nav2_route reads: ids of such features differ."""
NODE_KEYS = ("id", "frame")
EDGE_KEYS = ("id", "startid", "endid", "cost", "overridable")
NODE_METADATA = ("kind", "clearance")
EDGE_METADATA = ("arc", "length", "clearance", "filled")
_AGAIN = "correct it, or remove the file to start without annotations"


class OldNode(NamedTuple):
    """A node of the file.

    Attributes:
        id: Landmark id.
        kind: Kind of landmark.
        properties: Those of the user.
        xy: [m, map frame], NaN if the file has no such numbers.
        clearance: [m], NaN if the file has none.
    """

    id: int
    kind: str
    properties: Mapping[str, Any]
    xy: tuple[float, float] = (math.nan, math.nan)
    clearance: float = math.nan


class OldEdge(NamedTuple):
    """One direction of an arc.

    Attributes:
        id: Of its feature.
        start: Id of a node.
        end: Id of a node.
        length: [m], NaN if the file has none.
        line: (n >= 2, 2) [m, map frame] from start to end; None if the file has none, as one that
            nav2_route saved.
        properties: Those of the user.
        clearance: [m], NaN if the file has none.
    """

    id: int
    start: int
    end: int
    length: float
    line: np.ndarray | None
    properties: Mapping[str, Any]
    clearance: float = math.nan


class OldArc(NamedTuple):
    """An arc of the file: its id, and one or two opposite directions."""

    id: int
    edges: tuple[OldEdge, ...]


class AnnotatedMap(NamedTuple):
    """A map.geojson, without what is written anew.

    Attributes:
        nodes: The nodes.
        arcs: The arcs.
        features: Features of the user, as they are in the file.
        members: Members of the file itself, as `name` and `crs`; none of ours.
        next_id: No node, edge or feature of the user has had this id or a higher one. New landmarks
            that are numbered from here leave all ids of edges as they are.
        next_arc: No arc has had this id or a higher one.
    """

    nodes: tuple[OldNode, ...]
    arcs: tuple[OldArc, ...]
    features: tuple[Mapping[str, Any], ...]
    members: Mapping[str, Any]
    next_id: int
    next_arc: int


def read(path: str | PathLike, advice: str = _AGAIN) -> AnnotatedMap | None:
    """Read a map that `geojson.write` wrote and a user may have edited.

    Args:
        path: The file.
        advice: What to do with a file that is refused.

    Returns:
        The map, or None if there is no such file.

    Raises:
        InputError: The file cannot be read, is too large, too deeply nested or no JSON as RFC 8259
            has it, NaN and repeated keys included; is no FeatureCollection; or a feature of ours
            has no id or ends, two features have the same id, two edges of an arc are not its two
            directions, or properties are no object.
    """
    content = strict_json.read(path, advice)
    if content is None:
        return None
    if not isinstance(content, dict) or content.get("type") != "FeatureCollection":
        raise InputError("is no FeatureCollection", path=path, field="type", advice=advice)
    if not isinstance(content.get("features"), list):
        raise InputError("missing or no array", path=path, field="features", advice=advice)
    nodes: list[OldNode] = []
    edges: dict[int, list[OldEdge]] = {}
    own: list[Mapping[str, Any]] = []
    ids: dict[int, int] = {}
    for number, feature in enumerate(content["features"]):
        where = _Place(path, number, advice)
        geometry, properties = _checked(where, feature)
        metadata = _as_object(properties.get("metadata"))
        node_id: int | None = None
        if geometry.get("type") == "Point" and metadata.get("kind") in KINDS:
            node_id = _id(where, feature, properties)
            own_properties = _of_user(properties, NODE_KEYS, NODE_METADATA)
            xy, clearance = position(geometry), _length(metadata.get("clearance"))
            nodes.append(OldNode(node_id, metadata["kind"], own_properties, xy, clearance))
        elif geometry.get("type") in (*LINES, None) and metadata.get("arc") is not None:
            node_id = _id(where, feature, properties)
            arc = _number(where, "properties.metadata.arc", metadata["arc"])
            edge = _edge(where, node_id, geometry, properties, metadata)
            edges.setdefault(arc, []).append(edge)
        else:
            own.append(feature)
            if geometry.get("type") in GRAPH_TYPES:
                node_id = whole(properties.get("id"))
        if node_id is not None and ids.setdefault(node_id, number) != number:
            problem = f"{node_id} is also that of features[{ids[node_id]}]"
            raise where.error("properties.id", problem, "give each feature an id of its own")
    _check_arcs(path, edges, ids)
    if not nodes and any(_looks_like_a_node(feature) for feature in own):
        advice = "an editor dropped it: take the file as it was before"
        raise InputError("no Point has metadata.kind", path=path, field="features", advice=advice)
    counters = _counters(path, content.get(COUNTERS, {}))
    others = {"type", "features", "bbox", COUNTERS}  # a bbox is of the old features
    return AnnotatedMap(
        nodes=tuple(nodes),
        arcs=tuple(OldArc(arc, tuple(pair)) for arc, pair in edges.items()),
        features=tuple(own),
        members={key: value for key, value in content.items() if key not in others},
        next_id=max([counters["next_id"], *(known + 1 for known in ids)]),
        next_arc=max([counters["next_arc"], *(arc + 1 for arc in edges)]),
    )


def whole(value: Any) -> int | None:
    """A whole number from 0 to `MAX_ID`, also as "12" or 12.0; None for anything else."""
    if isinstance(value, str) and re.fullmatch(r"[0-9]{1,10}(\.0{1,9})?", value.strip()):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or value % 1 != 0:
        return None
    return int(value) if 0 <= value <= MAX_ID else None


class _Place(NamedTuple):
    """A feature in a file, counted from 0, as errors name it."""

    path: str | PathLike
    number: int
    advice: str = _AGAIN

    def error(self, field: str, problem: str, advice: str | None = None) -> InputError:
        """Error in a field of the feature; the field may be empty."""
        name = f"features[{self.number}]" + (f".{field}" if field else "")
        return InputError(problem, path=self.path, field=name, advice=advice or self.advice)


def _checked(where: _Place, feature: Any) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Geometry and properties of a feature, empty for null."""
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise where.error("", "is no Feature")
    for name in ("geometry", "properties"):
        if not isinstance(feature.get(name), dict | None):
            problem = f"is {type(feature[name]).__name__}, not an object"
            raise where.error(name, problem)
    return feature.get("geometry") or {}, feature.get("properties") or {}


def _as_object(value: Any) -> Mapping[str, Any]:
    """A nested object, also one that an editor made a string of; empty for anything else."""
    if isinstance(value, str) and value.lstrip().startswith("{"):
        try:
            value = strict_json.parse(value)
        except (ValueError, RecursionError):
            return {}
    return value if isinstance(value, dict) else {}


def _of_user(
    properties: Mapping[str, Any], own: tuple[str, ...], own_metadata: tuple[str, ...]
) -> dict[str, Any]:
    """Properties of one of our features without ours."""
    kept = {key: value for key, value in properties.items() if key not in own}
    for key in (*NODE_KEYS, *EDGE_KEYS):  # null: an editor's table has all keys in all rows
        if kept.get(key, 0) is None:
            del kept[key]
    metadata = _as_object(kept.pop("metadata", None))
    metadata = users_metadata(metadata, _length(metadata.get("clearance")))
    metadata = {key: value for key, value in metadata.items() if key not in own_metadata}
    operations = kept.pop("operations", None)
    operations = users_operations(_as_object(operations) or operations)
    if metadata:
        kept["metadata"] = metadata
    if operations and operations != "{}":
        kept["operations"] = operations
    return kept


def _id(where: _Place, feature: Mapping[str, Any], properties: Mapping[str, Any]) -> int:
    """Id of one of our features: of its properties, else its own."""
    value = properties.get("id")
    return _number(where, "properties.id", feature.get("id") if value is None else value)


def _number(where: _Place, field: str, value: Any) -> int:
    """A whole number."""
    number = whole(value)
    if number is None:
        advice = "write the number that jaxslam gave it, or delete the feature"
        problem = "missing" if value is None else f"{value!r:.40} is no whole number up to {MAX_ID}"
        raise where.error(field, problem, advice)
    return number


def _edge(
    where: _Place,
    edge_id: int,
    geometry: Mapping[str, Any],
    properties: Mapping[str, Any],
    metadata: Mapping[str, Any],
) -> OldEdge:
    """One direction of an arc."""
    try:
        line = line_points(geometry)
    except ValueError as error:
        raise where.error("geometry.coordinates", str(error)) from None
    return OldEdge(
        id=edge_id,
        start=_number(where, "properties.startid", properties.get("startid")),
        end=_number(where, "properties.endid", properties.get("endid")),
        length=_length(metadata.get("length")),
        line=line,
        properties=_of_user(properties, EDGE_KEYS, EDGE_METADATA),
        clearance=_length(metadata.get("clearance")),
    )


def _length(value: Any) -> float:
    """A length [m] of the metadata, NaN if it is no number."""
    known = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if known else math.nan


def position(geometry: Mapping[str, Any]) -> tuple[float, float]:
    """Position [m] of a Point, NaN if it has no such numbers."""
    try:
        x, y = (float(value) for value in geometry["coordinates"][:2])
    except (TypeError, ValueError, KeyError, OverflowError):
        return math.nan, math.nan
    return (x, y) if max(abs(x), abs(y)) <= MAX_COORDINATE else (math.nan, math.nan)


def line_points(geometry: Mapping[str, Any]) -> np.ndarray | None:
    """Points (n, 2) [m] of a line or of lines one after the other, None without any.

    Raises:
        ValueError: They are no points.
    """
    lines = geometry.get("coordinates")
    if not lines:
        return None
    lines = [lines] if geometry.get("type") == "LineString" else lines
    try:
        line = np.array([[float(p[0]), float(p[1])] for line in lines for p in line])
    except (TypeError, ValueError, KeyError, IndexError, OverflowError):
        line = np.zeros(0)
    if len(line) < 2 or not (np.abs(line) <= MAX_COORDINATE).all():
        raise ValueError(f"are no points of a line, within {MAX_COORDINATE:g} m of 0, 0")
    return line


def _check_arcs(
    path: str | PathLike, arcs: Mapping[int, Sequence[OldEdge]], ids: Mapping[int, int]
) -> None:
    """Raise InputError unless each arc has one edge, or one in each direction.

    Args:
        path: The file.
        arcs: The edges of each arc.
        ids: Number of the feature of each id.
    """
    others = ids.keys() - {edge.id for edges in arcs.values() for edge in edges}
    for arc, (first, *more) in arcs.items():
        if not more or len(more) == 1 and (first.end, first.start) == (more[0].start, more[0].end):
            continue
        for edge in (first, *more):
            for field, end in (("startid", edge.start), ("endid", edge.end)):
                if end not in others:
                    advice = "write that of the node where the edge begins or ends"
                    where = _Place(path, ids[edge.id])
                    raise where.error(f"properties.{field}", f"{end} is the id of no node", advice)
        before = " and ".join(f"features[{ids[edge.id]}]" for edge in (first, *more[:-1]))
        problem = f"{arc} is also that of {before}, and an arc has one edge there and one back"
        advice = "remove metadata.arc from edges of your own, or correct startid and endid"
        raise _Place(path, ids[more[-1].id]).error("properties.metadata.arc", problem, advice)


def _looks_like_a_node(feature: Mapping[str, Any]) -> bool:
    """Whether a feature has what our nodes have, but for their metadata."""
    is_point = (feature.get("geometry") or {}).get("type") == "Point"
    return is_point and {"id", "frame"} <= (feature.get("properties") or {}).keys()


def _counters(path: str | PathLike, value: Any) -> dict[str, int]:
    """The member `COUNTERS` of a file, zeros if it has none."""
    counts = value if isinstance(value, dict) else {}
    found = {name: whole(counts.get(name, 0)) for name in ("next_id", "next_arc")}
    if not isinstance(value, dict) or None in found.values():
        problem = "is not an object of next_id and next_arc"
        raise InputError(problem, path=path, field=COUNTERS, advice="remove it")
    return {name: count or 0 for name, count in found.items()}
