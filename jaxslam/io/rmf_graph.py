"""Topological maps as navigation graphs of Open-RMF, YAML as `rmf_fleet_adapter` reads it.

Vertices and lanes are those of `straight_lanes`; a lane is for one direction. The vertex of a node
has the node's id as its name, others have none. A lane through a door has `door_name`: the adapter
asks for the door to be opened and waits for it. Where there is no door leaf, delete the name there.
The text is written here; no package is needed.
"""

import json
import math
from os import PathLike

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import PlannerData, Regions
from jaxslam.io.output import write_text
from jaxslam.io.route_labels import has_leaf
from jaxslam.io.straight_lanes import Lane, StraightLanes, straight_lanes


def write(
    path: str | PathLike,
    graph: TopologicalMap,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
    *,
    lanes: StraightLanes | None = None,
    max_speed: float = 1.0,
    building: str = "map",
    level: str = "L1",
) -> None:
    """Write a map as one level of a building, in metres, y up.

    Args:
        path: File to write, atomically.
        graph: The map.
        regions: Its rooms and doors.
        planner: Where its nodes and arcs lie.
        lanes: As `straight_lanes` gives them for these; None to have them computed.
        max_speed: [m/s] full speed; lanes of full speed have no limit.
        building: Name of the building.
        level: Name of the level, which Open-RMF also calls the map.

    Raises:
        ValueError: The map has no numbers of its shapes, or `planner` is of another map.
        InputError: The file cannot be written.
    """
    found = straight_lanes(graph, regions, planner) if lanes is None else lanes
    doors = () if regions is None else tuple(d for d in regions.doors if has_leaf(d))
    text = [f"building_name: {_quoted(building)}"]
    text.append("doors:" if doors else "doors: {}")
    for door in doors:
        ends = ", ".join(_pair(x, y) for x, y in door.jambs)
        text.append(f"  {_quoted(door.name)}: {{endpoints: [{ends}], map: {_quoted(level)}}}")
    text += ["levels:", f"  {_quoted(level)}:"]
    text.append("    lanes:" if found.lanes else "    lanes: []")
    for lane in found.lanes:
        options = _options(lane, max_speed)
        text.append(f"    - [{lane.start}, {lane.end}, {options}]")
        text.append(f"    - [{lane.end}, {lane.start}, {options}]")
    text.append("    vertices:" if found.names else "    vertices: []")
    for name, (x, y) in zip(found.names, found.xy, strict=True):
        name = name if name.isdigit() else ""
        text.append(f"    - [{_number(x)}, {_number(y)}, {{name: {_quoted(name)}}}]")
    text.append("lifts: {}")
    write_text(path, "\n".join(text) + "\n")


def _options(lane: Lane, max_speed: float) -> str:
    """Options of a lane."""
    options = [f"door_name: {_quoted(lane.door)}"] if lane.door else []
    options += [f"speed_limit: {_number(lane.speed * max_speed)}"] if lane.speed < 1.0 else []
    return "{" + ", ".join(options) + "}"


def _pair(x: float, y: float) -> str:
    """Two numbers in a list."""
    return f"[{_number(x)}, {_number(y)}]"


def _number(x: float) -> str:
    """A number to 0.1 mm; raise ValueError unless it is finite."""
    if not math.isfinite(x):
        raise ValueError(f"{x} is not finite")
    return f"{round(float(x), 4) + 0.0:.4f}"  # + 0.0: no -0.0000


def _quoted(text: str) -> str:
    """A string of YAML, which those of JSON are."""
    return json.dumps(text)
