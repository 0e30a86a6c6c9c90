"""Regions, doors and speed limits as metadata and operations of a nav2_route graph.

    metadata.region       name of the region                              nodes, edges
    metadata.class        room, corridor, hall, or door                   nodes, edges
    metadata.door         names of the doors on an edge, with commas      edges
    metadata.speed_limit  [%] of the full speed, by clearance             edges
    operations            `OpenDoor` for each door up to 1.5 m wide       edges

These keys a user may set too: a value that is not as it is written here is the user's, and stays.
Of nav2_route, `AdjustSpeedLimit` takes `speed_limit` as a percentage and `DistanceScorer` divides
the length by it, so that all edges have one; both take a number with a decimal point only. Route
tracking ends with an error at an operation that its parameters do not have:

    operations: ["AdjustSpeedLimit", "ReroutingService", "OpenDoor"]
    OpenDoor: {plugin: "nav2_route::TriggerEvent"}

The plugin calls the service `door_3/open` (std_srvs/Trigger) of a door when the robot enters an
edge that passes through it.
"""

import re
from collections.abc import Mapping
from typing import Any

from jaxslam.core.regions import REGION_KINDS
from jaxslam.io.route_labels import DOOR, Label, speed_fraction

OPEN_DOOR = "OpenDoor"
"""Name of the operation in the parameters of nav2_route, such as `nav2_route::TriggerEvent`."""
_REGION, _DOOR = r"room_\d+", r"door_\d+"


def node_metadata(label: Label) -> dict[str, Any]:
    """Metadata of a node, without what is empty."""
    return {k: v for k, v in {"region": label.region, "class": label.kind}.items() if v}


def edge_metadata(label: Label, speed: float) -> dict[str, Any]:
    """Metadata of an edge on which this fraction of the full speed may be driven."""
    door = {"door": ",".join(label.doors)} if label.doors else {}
    return node_metadata(label) | door | {"speed_limit": _percent(speed)}


def speed_limit(clearance: float) -> float:
    """Speed limit [%] of an edge of this clearance [m], to 0.1 %."""
    return _percent(speed_fraction(clearance))


def _percent(speed: float) -> float:
    """A fraction of the full speed [%], to 0.1 %."""
    return round(100.0 * speed, 1)


def door_operations(label: Label) -> dict[str, Any]:
    """Operations of an edge: doors that may have a leaf are opened when the robot enters it."""
    return {f"open_{name}": _open(name) for name in label.leaves}


def users_metadata(metadata: Mapping[str, Any], clearance: float) -> dict[str, Any]:
    """Metadata that is not as it is written here for this clearance [m], NaN for unknown."""
    written = {"region": _REGION, "door": f"{_DOOR}(,{_DOOR})*"}
    ours = {key for key, form in written.items() if _matches(form, metadata.get(key))}
    if ours and metadata.get("class") in (*REGION_KINDS, DOOR):
        ours.add("class")
    limit = metadata.get("speed_limit")
    if isinstance(limit, int | float) and abs(limit - speed_limit(clearance)) < 0.01:
        ours.add("speed_limit")
    return {key: value for key, value in metadata.items() if key not in ours}


def users_operations(operations: Any) -> Any:
    """Operations, an object or an array, without those that are written here."""
    if isinstance(operations, Mapping):
        return {key: value for key, value in operations.items() if not _is_ours(value)}
    if isinstance(operations, list):
        return [value for value in operations if not _is_ours(value)]
    return operations


def _open(name: str) -> dict[str, Any]:
    """Operation that opens a door by the service `door_3/open`."""
    metadata = {"door": name, "service_name": f"{name}/open"}
    return {"type": OPEN_DOOR, "trigger": "ON_ENTER", "metadata": metadata}


def _is_ours(operation: Any) -> bool:
    """Whether an operation is as it is written here for some door."""
    metadata = operation.get("metadata") if isinstance(operation, Mapping) else None
    name = metadata.get("door") if isinstance(metadata, Mapping) else None
    return _matches(_DOOR, name) and operation == _open(str(name))


def _matches(form: str, value: Any) -> bool:
    """Whether a value is a string of this form."""
    return isinstance(value, str) and re.fullmatch(form, value) is not None
