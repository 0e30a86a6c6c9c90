"""What a planner needs of nodes and arcs: their regions, the doors on arcs, width profiles."""

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.regions import Door, PlannerData, Regions
from jaxslam.core.se2_np import inverse_transform
from jaxslam.mapping.clearance import clearance_at, clearance_field

SPACING = 0.05  # [m] between the places of an arc that are looked at, or half a cell if larger
DOOR_MARGIN = 0.1  # [m] by which a door's line is longer than its jambs are apart, at either end


def planner_data(
    graph: TopologicalMap, occupancy: OccupancyMap, regions: Regions | None = None
) -> PlannerData:
    """Regions, doors and width profiles of the nodes and arcs of a map.

    Args:
        graph: The map.
        occupancy: Occupancy map in the same frame.
        regions: Rooms and doors in the same frame; without them there are none.

    Raises:
        ValueError: An argument is of another type.
    """
    check_types(graph, occupancy, regions)
    lines = graph.arc_lines
    spacing = max(SPACING, 0.5 * occupancy.resolution)
    places = [polylines.resample(line, 2 + int(polylines.length(line) / spacing)) for line in lines]
    widths = clearance_at(clearance_field(occupancy), np.concatenate([np.zeros((0, 2)), *places]))
    last = np.cumsum([len(along) for along in places], dtype=int)
    node_region, arc_region = np.full(len(graph.xy), -1), np.full(len(lines), -1)
    arc_doors: list[tuple[int, ...]] = [()] * len(lines)
    if regions is not None:
        node_region = region_at(regions, graph.xy)
        for k, (line, along) in enumerate(zip(lines, places, strict=True)):
            arc_region[k] = most_common(region_at(regions, along))
            arc_doors[k] = tuple(door for _, door in doors_crossed(regions.doors, line))
    return PlannerData(
        node_region=node_region,
        arc_region=arc_region,
        arc_doors=tuple(arc_doors),
        arc_widths=tuple(np.split(widths, last[:-1])) if lines else (),
    )


def check_types(
    graph: TopologicalMap, occupancy: OccupancyMap | None, regions: Regions | None
) -> None:
    """Raise ValueError if an argument is of another type."""
    for name, value, kind in (
        ("topological_map", graph, TopologicalMap),
        ("occupancy", occupancy, OccupancyMap),
        ("regions", regions, Regions),
    ):
        if not isinstance(value, kind) and not (value is None and kind is not TopologicalMap):
            raise ValueError(f"{name} is of type {type(value).__name__}, not {kind.__name__}")


def most_common(region: np.ndarray) -> int:
    """The most common of region indices (N,), without -1; -1 if there is no other."""
    count = np.bincount(region[region >= 0])
    return int(count.argmax()) if count.size else -1


def region_at(regions: Regions, points: np.ndarray) -> np.ndarray:
    """Index (N,) of the region that points (N, 2) [m, map frame] lie in, -1 for none.

    By the cells of the map; by the polygons if there are none, the smallest that holds the point.
    """
    found = np.full(len(points), -1)
    if regions.label.size:
        cell = np.floor(inverse_transform(regions.origin, points) / regions.resolution).astype(int)
        inside = np.all((cell >= 0) & (cell < regions.label.shape), axis=1)
        found[inside] = regions.label[tuple(cell[inside].T)] - 1
        return found
    order = sorted(range(len(regions.regions)), key=lambda k: -regions.regions[k].area)
    for k in order:
        found[_in_polygon(regions.regions[k].polygon, points)] = k
    return found


def _in_polygon(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 2) lie in a polygon (n, 2): a ray from them crosses it an odd number."""
    (x, y), (next_x, next_y) = polygon.T, np.roll(polygon, -1, axis=0).T
    spans = (y > points[:, 1:]) != (next_y > points[:, 1:])
    slope = (next_x - x) / np.where(next_y == y, 1.0, next_y - y)
    right = points[:, :1] < x + slope * (points[:, 1:] - y)
    return np.count_nonzero(spans & right, axis=1) % 2 == 1


def doors_crossed(doors: tuple[Door, ...], line: np.ndarray) -> list[tuple[int, int]]:
    """Doors that a polyline (n, 2) [m, map frame] crosses, in its direction.

    Returns:
        For each, the index of the polyline's segment and that of the door.
    """
    if not doors:
        return []
    low, high = np.array([door.jambs for door in doors], float).swapaxes(0, 1)  # each (D, 2)
    width = np.hypot(*(high - low).T)[:, None]
    across = DOOR_MARGIN * (high - low) / np.maximum(width, 1e-9)
    low, high = low - across, high + across
    start, step = line[:-1, None], np.diff(line, axis=0)[:, None]  # (n - 1, 1, 2)
    # start + s step = low + t (high - low)
    cross = _cross(step, high - low)
    parallel = np.abs(cross) < 1e-12
    cross = np.where(parallel, 1.0, cross)
    s, t = _cross(low - start, high - low) / cross, _cross(low - start, step) / cross
    segment, door = np.nonzero(~parallel & (s >= 0) & (s < 1) & (t >= 0) & (t <= 1))
    order = np.lexsort((door, segment + s[segment, door]))
    return [(int(segment[k]), int(door[k])) for k in order]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of vectors (..., 2) in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
