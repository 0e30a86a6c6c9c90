"""The command `jaxslam route MAP --from X Y --to X Y|room_12`."""

import math
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import tyro

from jaxslam.cli import summaries
from jaxslam.cli.options import OutFolder, check_range, require_other_folder
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.regions import Regions
from jaxslam.core.types import Metrics
from jaxslam.io.errors import InputError
from jaxslam.io.map_folder import MapFolder, read_map_folder
from jaxslam.io.output import folder, write_json
from jaxslam.mapping.planning import PlannedRoute, route
from jaxslam.mapping.route_legs import describe

OPTIONS = {"start": "--from", "goal": "--to"}
"""Options whose values the library names otherwise."""


def plan_route(
    map: Annotated[  # noqa: A002
        tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")
    ],
    start: Annotated[
        tuple[str, ...], tyro.conf.arg(name="from", metavar="X Y", help_behavior_hint="(required)")
    ],
    goal: Annotated[
        tuple[str, ...],
        tyro.conf.arg(name="to", metavar="X Y|ROOM", help_behavior_hint="(required)"),
    ],
    robot_radius: float = 0.25,
    out: OutFolder = Path("route"),
) -> None:
    """Find the shortest route over a saved map, to a point or a room.

    The route leads through free space to an arc of the topological map, over arcs on which the
    robot fits, and to the goal; directly, where start and goal see each other. An arc of which one
    edge was deleted from map.geojson is driven in the other direction alone. Writes route.json, the
    polyline and the legs of the route; route.png; and metrics.json.

    Args:
        map: Output folder of `jaxslam run` or `jaxslam map`.
        start: Start [m m] in the map frame.
        goal: Goal [m m] in the map frame, or the name of a room, as in room_12: the route ends on
            an arc inside, 1 m from its doors if it is that large, also if it begins in the room; in
            a room without arcs for the robot, in its middle.
        robot_radius: Robot radius [m]: least distance to obstacles, to within a cell.
        out: Folder for the results, not that of the map.
    """
    check_range("--robot-radius", robot_radius, 0.0, 100.0)
    first = _point("--from", start)
    name = goal[0] if len(goal) == 1 and not _is_number(goal[0].split(",")[0]) else None
    last = _point("--to", goal) if name is None else name
    require_other_folder(out, map)
    known = read_map_folder(map)
    for note in known.notes:
        print(f"note: {note}", flush=True)
    begin = perf_counter()
    try:
        planned = route(
            known.graph,
            first,
            last,
            occupancy=known.occupancy,
            regions=known.regions,
            robot_radius=robot_radius,
            directed=known.directed,
        )
    except ValueError as error:
        raise _named(str(error), map) from None
    seconds = {"run": perf_counter() - begin}
    where = "the goal" if name is None else name
    legs = describe(planned.legs, where)
    numbers = _metrics(planned) | {"robot_radius_m": robot_radius, "seconds": seconds}
    with folder(out) as out_dir:
        content = _content(planned, known, legs) | {"goal_region": name}
        write_json(out_dir / "route.json", content | {"robot_radius_m": robot_radius})
        write_json(out_dir / "metrics.json", numbers)
        draw_route(
            out_dir / "route.png",
            known.graph,
            planned,
            occupancy=known.occupancy,
            regions=known.regions,
        )
    title = f"{map}: from {first[0]:g} {first[1]:g} to {where}, robot radius {robot_radius:g} m"
    summaries.print_route_summary(numbers, title, legs, out)


def draw_route(
    path: Path,
    graph: TopologicalMap,
    planned: PlannedRoute,
    *,
    occupancy: OccupancyMap | None = None,
    regions: Regions | None = None,
) -> None:
    """Draw a route over a topological map, and over the occupancy map and the rooms if known."""
    # Imported here, because matplotlib is slow to import.
    from jaxslam.viz import canvas, maps, rooms, routes

    corners = np.zeros((0, 2)) if occupancy is None else maps.known_corners(occupancy)
    figure, axis = canvas.map_canvas(*canvas.extent(corners, graph.xy, planned.line))
    if occupancy is not None:
        maps.draw_occupancy(axis, occupancy)
    if regions is not None:
        rooms.draw_rooms(axis, regions)
    maps.draw_arcs(axis, graph)
    routes.draw_route(axis, planned)
    maps.draw_start_and_end(axis, np.pad(planned.line, ((0, 0), (0, 1))))
    canvas.legend(figure)
    canvas.save(figure, path)


def _point(option: str, words: tuple[str, ...]) -> np.ndarray:
    """The point (2,) [m] that an option names by two numbers, also as `1,2`.

    Raises:
        InputError: It does not.
    """
    parts = " ".join(words).replace(",", " ").split()
    advice = "give x y [m], as in 1.5 -2" + (", or a room" if option == "--to" else "")
    for part in parts:
        if not _is_number(part):
            raise InputError(f"{part!r:.40} is not a number", field=option, advice=advice)
    if len(parts) != 2:
        count = "one number" if len(parts) == 1 else f"{len(parts)} numbers"
        raise InputError(f"has {count}, not two", field=option, advice=advice)
    values = np.array([float(part) for part in parts])
    if not np.isfinite(values).all():
        raise InputError(f"{' '.join(parts)} is not finite", field=option, advice=advice)
    return values


def _is_number(text: str) -> bool:
    """Whether a text is a number, NaN and infinity among them."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _named(message: str, path: Path) -> InputError:
    """The error of a message that begins with the name of an argument, by its option."""
    name, _, rest = message.partition(" ")
    if name in OPTIONS:
        return InputError(rest.removeprefix("is "), field=OPTIONS[name])
    return InputError(message, path=path)


def _metrics(planned: PlannedRoute) -> Metrics:
    """Numbers of a route."""
    return {
        "length_m": planned.length,
        "straight_m": math.dist(planned.line[0], planned.line[-1]),
        "narrowest_m": planned.clearance,
        "legs": len(planned.legs),
        "doors": sum(leg.door is not None for leg in planned.legs),
    }


def _content(planned: PlannedRoute, known: MapFolder, legs: list[str]) -> dict[str, Any]:
    """The content of route.json."""
    return {
        "frame": "map",
        "start": planned.line[0],
        "goal": planned.line[-1],
        "length_m": planned.length,
        "narrowest_m": planned.clearance,
        "legs": [
            {
                "text": text,
                "from": leg.line[0],
                "to": leg.line[-1],
                "length_m": leg.length,
                "narrowest_m": leg.clearance,
                "heading_deg": math.degrees(leg.heading),
                "turn_deg": math.degrees(leg.turn),
                "region": leg.region,
                "region_kind": leg.region_kind,
                "door": leg.door,
                "door_width_m": leg.door_width,
                "arcs": known.arc_id[list(leg.arcs)],
            }
            for text, leg in zip(legs, planned.legs, strict=True)
        ],
        "polyline": planned.line,
    }
