"""A topological map as points joined by straight lanes, for fleets that know no polylines.

Where an arc bends, points are added to it (Douglas-Peucker), so that no lane is farther from the
arc than a tolerance, less where the robot has less than that beside it. Before and behind a door
points are added too: a lane through a door is short. Corners, at walls and without arcs, and open
ends are no points.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.regions import Door, PlannerData, Regions
from jaxslam.core.types import JUNCTION, as_float64
from jaxslam.io.route_labels import DOOR, Label, arc_clearances, has_leaf, labels, speed_fraction

TOLERANCE = 0.1  # [m] largest distance of a lane from its arc
LEAST_TOLERANCE = 0.02  # [m] of lanes where the robot just fits
DOOR_MARGIN = 1.0  # [m] of an arc on either side of a door that its lanes open the door for
LEAST_LANE = 0.2  # [m] doors add no shorter lanes


class Lane(NamedTuple):
    """A straight lane, to be driven in both directions.

    Attributes:
        start: Index of a point.
        end: Index of a point.
        arc: Id of its arc.
        number: Lanes of the arc before it.
        door: Name of the door that it passes through, empty for none.
        label: Of its arc, with its own door alone.
        speed: Fraction of the full speed, by the narrowest place of the arc.
    """

    start: int
    end: int
    arc: int
    number: int
    door: str
    label: Label
    speed: float


class StraightLanes(NamedTuple):
    """Points and lanes.

    Attributes:
        names: Of the P points: the id of a node, or `arc12_3`, the third point added to arc 12.
        xy: (P, 2) [m] map frame.
        labels: P labels; empty ones of points on arcs.
        lanes: The lanes, arc by arc.
    """

    names: tuple[str, ...]
    xy: np.ndarray
    labels: tuple[Label, ...]
    lanes: tuple[Lane, ...]


def straight_lanes(
    graph: TopologicalMap,
    regions: Regions | None = None,
    planner: PlannerData | None = None,
    *,
    tolerance: float = TOLERANCE,
    robot_radius: float = 0.0,
    arc_ids: Sequence[int] | None = None,
) -> StraightLanes:
    """Points and straight lanes of a map.

    Args:
        graph: The map.
        regions: Its rooms and doors.
        planner: Where its nodes and arcs lie.
        tolerance: [m] largest distance of a lane from its arc.
        robot_radius: [m] that lanes keep from obstacles, as far as their arcs do.
        arc_ids: Of the arcs; by default their indices.

    Raises:
        ValueError: `planner` is of another map, a line is no polyline, or a number is not finite.
    """
    of_nodes, of_arcs = labels(graph, regions, planner)
    kinds = {} if regions is None else {region.name: region.kind for region in regions.regions}
    clearances = arc_clearances(graph, planner)
    xy = as_float64("xy", graph.xy, ("N", 2))
    ends = np.asarray(graph.arc_ends, int).reshape(-1, 2)
    drivable = (np.asarray(graph.kind) == JUNCTION) | np.isin(np.arange(len(xy)), ends)
    names = [str(int(node)) for node in np.asarray(graph.id)[drivable]]
    points = list(xy[drivable])
    point_labels = [of_nodes[node] for node in np.flatnonzero(drivable)]
    index = np.cumsum(drivable) - 1
    lanes: list[Lane] = []
    for arc, (start, end) in enumerate(ends.tolist()):
        arc_id = arc if arc_ids is None else int(arc_ids[arc])
        line = as_float64(f"arc_lines[{arc}]", graph.arc_lines[arc], ("n", 2)).copy()
        line[0], line[-1] = xy[start], xy[end]
        numbers = () if regions is None or planner is None else planner.arc_doors[arc]
        found = [] if regions is None else [regions.doors[k] for k in dict.fromkeys(numbers)]
        found = [door for door in found if has_leaf(door)]
        beside = np.fmax(LEAST_TOLERANCE, clearances[arc] - robot_radius)
        line = polylines.simplify(line, float(min(tolerance, beside)))
        line, doors = _with_doors(line, found)
        if len(line) == 2 and start == end:
            continue  # a loop within the tolerance
        more = range(len(points), len(points) + len(line) - 2)
        names += [f"arc{arc_id}_{k}" for k in range(1, len(line) - 1)]
        points += list(line[1:-1])
        point_labels += (len(line) - 2) * [Label()]
        stops = [int(index[start]), *more, int(index[end])]
        speed = speed_fraction(float(clearances[arc]))
        lanes += [
            Lane(
                stops[k], stops[k + 1], arc_id, k, door, _of_lane(of_arcs[arc], door, kinds), speed
            )
            for k, door in enumerate(doors)
        ]
    positions = np.reshape(points, (-1, 2))
    if not np.isfinite(positions).all():
        raise ValueError("the map has a position that is not finite")
    return StraightLanes(tuple(names), positions, tuple(point_labels), tuple(lanes))


def _of_lane(label: Label, door: str, kinds: Mapping[str, str]) -> Label:
    """Label of a lane that passes through a door, empty for none, of an arc with a label."""
    doors = (door,) if door else ()
    kind = kinds.get(label.region, "") if label.kind == DOOR and not door else label.kind
    return label._replace(kind=kind, doors=doors, leaves=doors)


def _along(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Nearest points of the segment a b to points (n, 2), as fractions (n,) of it."""
    square = float((b - a) @ (b - a))
    fraction: np.ndarray = np.clip((points - a) @ (b - a) / max(square, 1e-12), 0.0, 1.0)
    return fraction


def _with_doors(line: np.ndarray, doors: Iterable[Door]) -> tuple[np.ndarray, list[str]]:
    """The line (m, 2) with points about its doors, and the door's name of each of its segments."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    length = float(along[-1])
    passed = sorted((s, door.name) for door in doors for s in _crossings(line, along, door))
    middles = [(a + b) / 2 for (a, _), (b, _) in zip(passed[:-1], passed[1:], strict=True)]
    zones = [
        (max(before, s - DOOR_MARGIN), min(after, s + DOOR_MARGIN))
        for (s, _), before, after in zip(passed, [0.0, *middles], [*middles, length], strict=False)
    ]
    stops = along.tolist()
    for cut in (cut for zone in zones for cut in zone):
        if min(abs(cut - stop) for stop in stops) >= LEAST_LANE:
            stops.append(cut)
    stops = sorted(stops)
    names = ["" for _ in stops[1:]]
    for (position, name), (first, last) in zip(passed, zones, strict=True):
        for k, (a, b) in enumerate(zip(stops[:-1], stops[1:], strict=True)):
            if first <= (a + b) / 2 <= last or (a <= position <= b and not names[k]):
                names[k] = name
    return np.stack([np.interp(stops, along, line[:, axis]) for axis in (0, 1)], axis=1), names


def _crossings(line: np.ndarray, along: np.ndarray, door: Door) -> list[float]:
    """Lengths [m] along a line at which it crosses a door, or is nearest if it passes beside it."""
    nearest, crossed = (np.inf, 0.0), []
    for k, (a, b) in enumerate(zip(line[:-1], line[1:], strict=True)):
        fraction = float(_along(door.xy[None], a, b)[0])
        gap = float(np.linalg.norm(a + fraction * (b - a) - door.xy))
        nearest = min(nearest, (gap, along[k] + fraction * (along[k + 1] - along[k])))
        across = np.stack([b - a, door.jambs[0] - door.jambs[1]], axis=1)
        if abs(np.linalg.det(across)) > 1e-9:
            t, u = np.linalg.solve(across, door.jambs[0] - a)
            if 0.0 <= t <= 1.0 and 0.0 <= u <= 1.0:
                crossed.append(float(along[k] + t * (along[k + 1] - along[k])))
    return crossed or [float(nearest[1])]
