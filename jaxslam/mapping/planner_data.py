"""What a planner needs of nodes and arcs: their regions, the doors on arcs, width profiles."""

import numpy as np
from scipy.spatial import cKDTree

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap, TopologicalMap, check_occupancy
from jaxslam.core.regions import Door, PlannerData, Regions, contains, outer_first
from jaxslam.core.se2_np import inverse_transform
from jaxslam.core.types import check_type
from jaxslam.mapping.clearance import clearance_at, clearance_field

SPACING = 0.05  # [m] between the places of an arc that are looked at, or half a cell if larger
DOOR_MARGIN = 0.1  # [m] by which a door's line is longer than its jambs are apart, at either end
SAME_PLACE = 1e-6  # [m] between what counts as one point: a line this near to a door's reaches it


def planner_data(
    graph: TopologicalMap, occupancy: OccupancyMap, regions: Regions | None = None
) -> PlannerData:
    """Regions, doors and width profiles of the nodes and arcs of a map.

    Args:
        graph: The map.
        occupancy: Occupancy map in the same frame.
        regions: Rooms and doors in the same frame; without them there are none.

    Raises:
        ValueError: An argument is of another type, or a field of `occupancy` of another type,
            shape or range.
    """
    check_types(graph, regions)
    occupancy = check_occupancy(occupancy)
    lines = graph.arc_lines
    spacing = max(SPACING, 0.5 * occupancy.resolution)
    places = [polylines.resample(line, 2 + int(polylines.length(line) / spacing)) for line in lines]
    last = np.cumsum([len(along) for along in places], dtype=int)
    points = np.concatenate([np.zeros((0, 2)), *places])
    widths = np.split(clearance_at(clearance_field(occupancy), points), last[:-1])
    node_region, arc_region = np.full(len(graph.xy), -1), np.full(len(lines), -1)
    arc_doors: list[tuple[int, ...]] = [()] * len(lines)
    if regions is not None and lines:
        found = np.split(region_at(regions, points), last[:-1])
        arc_region = np.array([most_common(part) for part in found])
        segments = _segments(regions.doors)
        for k, (line, near) in enumerate(zip(lines, _doors_near(segments, lines), strict=True)):
            crossed = dict.fromkeys(door for _, door in _crossed(segments[near], line))
            arc_doors[k] = tuple(near[door] for door in crossed)
    frontier_doors: tuple[tuple[int, ...], ...] = ()
    if regions is not None:
        node_region = region_at(regions, graph.xy)
        frontier_doors = tuple(
            tuple(dict.fromkeys(door for _, door in doors_crossed(regions.doors, line)))
            for line in graph.frontiers
        )
    return PlannerData(
        node_region=node_region,
        arc_region=arc_region,
        arc_doors=tuple(arc_doors),
        arc_widths=tuple(widths) if lines else (),
        frontier_doors=frontier_doors,
    )


def check_types(graph: TopologicalMap, regions: Regions | None = None) -> None:
    """Raise ValueError if a map or its regions, where there are any, are of another type."""
    check_type("topological_map", graph, TopologicalMap)
    if regions is not None:
        check_type("regions", regions, Regions)


def most_common(region: np.ndarray) -> int:
    """The most common of region indices (N,), without -1; -1 if there is no other."""
    count = np.bincount(region[region >= 0])
    return int(count.argmax()) if count.size else -1


def region_at(regions: Regions, points: np.ndarray) -> np.ndarray:
    """Index (N,) of the region that points (N, 2) [m, map frame] lie in, -1 for none.

    By the cells of the map, or by the polygons if there are none.
    """
    found = np.full(len(points), -1)
    if regions.label.size:
        cell = np.floor(inverse_transform(regions.origin, points) / regions.resolution).astype(int)
        inside = np.all((cell >= 0) & (cell < regions.label.shape), axis=1)
        found[inside] = regions.label[tuple(cell[inside].T)] - 1
        return found
    for k in outer_first(regions.regions):
        found[contains(regions.regions[k], points)] = k
    return found


def doors_crossed(doors: tuple[Door, ...], line: np.ndarray) -> list[tuple[int, int]]:
    """Doors that a polyline (n, 2) [m, map frame] crosses, or begins or ends at, in its direction.

    Returns:
        For each, the index of the polyline's segment and that of the door.
    """
    return _crossed(_segments(doors), line)


def _segments(doors: tuple[Door, ...]) -> np.ndarray:
    """Ends (D, 2, 2) [m, map frame] of lines across doors, `DOOR_MARGIN` beyond their jambs."""
    low, high = np.array([door.jambs for door in doors], float).reshape(-1, 2, 2).swapaxes(0, 1)
    width = np.hypot(*(high - low).T)[:, None]
    across = DOOR_MARGIN * (high - low) / np.maximum(width, 1e-9)
    return np.stack([low - across, high + across], axis=1)


def _doors_near(segments: np.ndarray, lines: tuple[np.ndarray, ...]) -> list[list[int]]:
    """Numbers of the segments (D, 2, 2) that A polylines (n, 2) may cross, ascending, of each."""
    if not len(segments) or not lines:
        return [[] for _ in lines]
    boxes = np.array([(line.min(axis=0), line.max(axis=0)) for line in lines])
    reach = [0.5 * np.hypot(*(box[:, 1] - box[:, 0]).T) for box in (boxes, segments)]
    found = cKDTree(segments.mean(axis=1)).query_ball_point(
        boxes.mean(axis=1), reach[0] + reach[1].max() + 1e-6, return_sorted=True
    )
    return list(found)


def _crossed(segments: np.ndarray, line: np.ndarray) -> list[tuple[int, int]]:
    """As `doors_crossed`, of segments (D, 2, 2) [m, map frame]."""
    low, high = segments.swapaxes(0, 1)  # each (D, 2)
    start, step = line[:-1, None], np.diff(line, axis=0)[:, None]  # (n - 1, 1, 2)
    # start + s step = low + t (high - low)
    cross = _cross(step, high - low)
    parallel = np.abs(cross) < 1e-12
    cross = np.where(parallel, 1.0, cross)
    s, t = _cross(low - start, high - low) / cross, _cross(low - start, step) / cross
    size = np.hypot(step[..., 0], step[..., 1])  # (n - 1, 1)
    beyond = size * np.maximum(-s, s - 1.0)
    segment, door = np.nonzero(~parallel & (beyond <= SAME_PLACE) & (t >= 0) & (t <= 1))
    along = (np.cumsum(size) - size[:, 0])[segment] + (size * s)[segment, door]
    last: dict[int, float] = {}
    found = []
    for k in np.lexsort((door, segment, along)).tolist():
        here = int(door[k])
        # Where two segments meet on a door's line, both of them reach it.
        if along[k] - last.get(here, -np.inf) > 3 * SAME_PLACE:
            found.append((int(segment[k]), here))
        last[here] = along[k]
    return found


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of vectors (..., 2) in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
