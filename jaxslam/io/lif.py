"""Topological maps in the Layout Interchange Format (LIF) 1.0.0 of VDMA, for VDA 5050 fleets.

The points of `straight_lanes` are nodes, and each lane is two straight, directed edges. The vehicle
drives forwards along an edge, and turns at nodes only. An edge of full speed has no limit;
the others have it by clearance. Doors and regions are in descriptions, as LIF has no field for
them: what opens a door is between the operator and the vehicles. There are no stations.
"""

from datetime import UTC, datetime
from os import PathLike
from typing import Any

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import PlannerData, Regions
from jaxslam.io.output import write_json_rows
from jaxslam.io.route_labels import Label
from jaxslam.io.straight_lanes import Lane, StraightLanes, straight_lanes

VERSION = "1.0.0"  # of the format
DIGITS = 4  # of a position [m] or speed [m/s]


def write(
    path: str | PathLike,
    graph: TopologicalMap,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
    *,
    lanes: StraightLanes | None = None,
    max_speed: float = 1.0,
    vehicle_type: str = "robot",
    project: str = "map",
    time: datetime | None = None,
) -> None:
    """Write a map as a layout.

    Args:
        path: File to write, atomically.
        graph: The map.
        regions: Its rooms and doors.
        planner: Where its nodes and arcs lie.
        lanes: As `straight_lanes` gives them for these; None to have them computed.
        max_speed: [m/s] full speed.
        vehicle_type: `vehicleTypeId` of the vehicles that may drive there.
        project: Name of the project, of the layout and of the map.
        time: Of the export, with a time zone; None for now.

    Raises:
        ValueError: The map has no numbers of its shapes, or `planner` is of another map.
        InputError: The file cannot be written.
    """
    layout = straight_lanes(graph, regions, planner) if lanes is None else lanes
    stamp = (datetime.now(UTC) if time is None else time.astimezone(UTC)).replace(tzinfo=None)
    content = {
        "metaInformation": {
            "projectIdentification": project,
            "creator": "jaxslam",
            "exportTimestamp": stamp.isoformat(timespec="milliseconds") + "Z",
            "lifVersion": VERSION,
        },
        "layouts": [
            {
                "layoutId": project,
                "layoutVersion": "1",
                "nodes": _nodes(layout, vehicle_type, project),
                "edges": [
                    edge
                    for lane in layout.lanes
                    for edge in _edges(layout, lane, vehicle_type, max_speed)
                ],
                "stations": [],
            }
        ],
    }
    write_json_rows(path, content)


def _nodes(layout: StraightLanes, vehicle_type: str, map_id: str) -> list[dict[str, Any]]:
    """All nodes of a layout."""
    return [
        {"nodeId": name}
        | _description("nodeDescription", label)
        | {
            "mapId": map_id,
            "nodePosition": {"x": round(float(x), DIGITS), "y": round(float(y), DIGITS)},
            "vehicleTypeNodeProperties": [{"vehicleTypeId": vehicle_type}],
        }
        for name, (x, y), label in zip(layout.names, layout.xy, layout.labels, strict=True)
    ]


def _edges(
    layout: StraightLanes, lane: Lane, vehicle_type: str, max_speed: float
) -> list[dict[str, Any]]:
    """The two edges of a lane, `arc12_0_there` and `arc12_0_back` for the first of arc 12."""
    limit = {"maxSpeed": round(lane.speed * max_speed, DIGITS)} if lane.speed < 1.0 else {}
    vehicle = {
        "vehicleTypeId": vehicle_type,
        "vehicleOrientation": 0.0,
        "orientationType": "TANGENTIAL",
        "rotationAllowed": False,
        "rotationAtStartNodeAllowed": "BOTH",
        "rotationAtEndNodeAllowed": "BOTH",
    }
    ends = layout.names[lane.start], layout.names[lane.end]
    return [
        {"edgeId": f"arc{lane.arc}_{lane.number}_{direction}"}
        | _description("edgeDescription", lane.label)
        | {
            "startNodeId": start,
            "endNodeId": end,
            "vehicleTypeEdgeProperties": [vehicle | limit],
        }
        for direction, (start, end) in (("there", ends), ("back", ends[::-1]))
    ]


def _description(key: str, label: Label) -> dict[str, str]:
    """Region and door of a node or edge, such as `room_2, door_3`; nothing for an empty label."""
    words = [word for word in (label.region, *label.doors) if word]
    return {key: ", ".join(words)} if words else {}
