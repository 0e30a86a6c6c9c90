"""Global topological map: the Voronoi diagram of all scans at their poses, with landmarks as nodes.

`topological_map.build_map` merges the diagrams of single scans, as the paper does. Each of them
sees a part of the space, and so arcs stay open where no scan saw both of their ends, and wide
space, where no scan has a diagram, has none. Here all scans are drawn into one grid at their
estimated poses, and the diagram is that of the whole:

    free cells of all scans -> medial axis of the space that the robot reaches (`medial_axis`)
    -> landmarks that lie on it are its nodes (`landmark_nodes`) -> arcs through open space
    (`open_space`) -> open ends (`open_ends`) -> ids

When the smoother moves poses, the map is made anew from them, and is still the same graph: a node
that is a landmark has its id, and any other that of the node of the map before that lies there
after it has moved with the scans around it (`landmark_nodes.kept_ids`).
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap, TopologicalMap, check_occupancy
from jaxslam.core.se2_np import compose, relative, transform
from jaxslam.core.types import CORNER, JUNCTION, as_count, as_float64, as_size, check_type
from jaxslam.mapping import grid_topology, medial_axis
from jaxslam.mapping.diagram_junctions import corner_junctions
from jaxslam.mapping.landmark_nodes import kept_ids, place_landmarks
from jaxslam.mapping.medial_axis import FreeConfigurations
from jaxslam.mapping.open_ends import find_open_ends
from jaxslam.mapping.open_space import FreeSpace, fill_open_space

RESOLUTION = 0.05
"""[m] side of the cells of the grid."""

MIN_SHARE = 0.01
"""Of the poses: a region of free space with fewer of them is not mapped."""

STEP = 1.0
"""[m] The robot drove straight between two poses that are no further apart than this."""


class GlobalMap(NamedTuple):
    """A topological map and where it was made.

    Attributes:
        graph: The map.
        occupancy: The grid; free where the robot drove.
        next_id: Id of the next node.
    """

    graph: TopologicalMap
    occupancy: OccupancyMap
    next_id: int


def build_global_map(
    occupancy: OccupancyMap,
    poses: np.ndarray,
    merged: TopologicalMap,
    next_id: int,
    *,
    previous: TopologicalMap | None = None,
    robot_radius: float = 0.2,
    with_corner_junctions: bool = False,
) -> GlobalMap:
    """The topological map of a grid that scans were drawn into.

    Args:
        occupancy: The grid, not turned against the map frame.
        poses: (T, 3) [m, m, rad] trajectory, map frame; NaN between two drives.
        merged: The landmarks and corners, as `topological_map.build_map` has them.
        next_id: Id of the next node, >= 0.
        previous: An earlier map of the same place, its nodes moved with the poses; nodes that are
            still there keep their ids.
        robot_radius: [m] >= 0; space narrower than twice this has no arcs, but where the robot
            drove.
        with_corner_junctions: Whether junctions with a branch into a corner are nodes too, as in
            the paper; landmarks elsewhere are then none. A planner does not need them.

    Returns:
        The map. Where no pose lies in free space, `merged` as it is.

    Raises:
        ValueError: An argument is of another type, shape or range, a row of `poses` is neither
            finite nor NaN, or `occupancy` is turned against the map frame.
    """
    occupancy = check_occupancy(occupancy)
    if occupancy.origin[2] != 0.0:
        raise ValueError(f"occupancy.origin is turned by {occupancy.origin[2]:g} rad, not by 0")
    poses = as_float64("poses", poses, ("T", 3))
    fits = np.isfinite(poses).all(axis=1) | np.isnan(poses).all(axis=1)
    if not fits.all():
        raise ValueError(f"poses[{np.argmin(fits)}] is neither finite nor NaN")
    check_type("merged", merged, TopologicalMap)
    if previous is not None:
        check_type("previous", previous, TopologicalMap)
    next_id = as_count("next_id", next_id, least=0)
    robot_radius = as_size("robot_radius", robot_radius)
    occupancy, driven = _with_driven_cells(occupancy, poses)
    resolution, corner = occupancy.resolution, occupancy.origin[:2]
    free = medial_axis.free_space(
        occupancy.occupied,
        occupancy.free,
        min_obstacle_size=0.0,
        min_unknown_size=2 * robot_radius / resolution,
    )
    space = medial_axis.free_configurations(
        free, clearance=robot_radius / resolution, also_free=driven
    )
    reached = _reached(space, occupancy, poses)
    if not reached.any():
        return GlobalMap(merged, occupancy, next_id)
    find = None
    if with_corner_junctions:
        find = partial(corner_junctions, occupancy, free, space)
    cell_graph, kept = grid_topology.trace_medial_axis(
        space, occupancy.occupied, reached, find_junctions=find
    )
    graph = grid_topology.to_plane(cell_graph, resolution, corner)
    place = FreeSpace(space.distance * resolution * reached, resolution, corner, robot_radius)
    junctions = np.flatnonzero(merged.kind == JUNCTION)
    known = None
    if with_corner_junctions:
        known = [n for n, node in enumerate(cell_graph.nodes) if node in kept]
    landmarks = place_landmarks(
        graph, merged.xy[junctions], merged.clearance[junctions], place, known
    )
    fill_open_space(graph, place)
    frontiers, frontier_node = find_open_ends(graph, place, occupancy)
    xy = np.array(graph.xy)
    ids = np.full(len(xy), -1)
    ids[list(landmarks)] = merged.id[junctions[list(landmarks.values())]]
    corners = np.flatnonzero(merged.kind == CORNER)
    ids, next_id = kept_ids(ids, xy, _without(previous, merged.id[corners]), next_id)
    lines = tuple(line.points for line in graph.arcs.values())
    result = TopologicalMap(
        id=np.concatenate([ids, merged.id[corners]]),
        xy=np.concatenate([xy, merged.xy[corners]]),
        kind=np.repeat([JUNCTION, CORNER], [len(xy), len(corners)]),
        clearance=np.concatenate([place.at(xy), np.zeros(len(corners))]),
        arc_ends=np.array([[a.start, a.end] for a in graph.arcs.values()], int).reshape(-1, 2),
        arc_length=np.array([polylines.length(line) for line in lines], float),
        arc_clearance=grid_topology.line_clearances(lines, space, resolution, corner),
        arc_lines=lines,
        arc_filled=np.array([not line.is_branch for line in graph.arcs.values()], bool),
    )
    open_ids, next_id = _open_end_ids(frontiers, result, previous, next_id)
    result = result._replace(frontiers=frontiers, frontier_node=frontier_node, frontier_id=open_ids)
    return GlobalMap(result, occupancy, next_id)


def moved_with_poses(graph: TopologicalMap, before: np.ndarray, now: np.ndarray) -> TopologicalMap:
    """A map whose nodes and open ends have moved with the nearest of some poses.

    Args:
        graph: The map, of poses `before`.
        before: (K, 3) [m, m, rad] map frame.
        now: (K, 3) the same poses as they are estimated now.
    """
    tree, frames = cKDTree(before[:, :2]), compose(now, relative(before, np.zeros(3)))

    def moved(points: np.ndarray) -> np.ndarray:
        return transform(frames[tree.query(points)[1]], points)

    return graph._replace(
        xy=moved(graph.xy) if len(graph.xy) else graph.xy,
        frontiers=tuple(moved(line) for line in graph.frontiers),
    )


def _with_driven_cells(
    occupancy: OccupancyMap, poses: np.ndarray
) -> tuple[OccupancyMap, np.ndarray]:
    """The grid, free where the robot drove, and these cells (H, W) bool."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    spacing = 0.5 * occupancy.resolution
    parts = [poses[np.isfinite(poses[:, 0]), :2]]
    for k in np.flatnonzero(steps <= STEP).tolist():
        share = np.arange(0.0, 1.0, spacing / max(float(steps[k]), spacing))[:, None]
        parts.append(poses[k, :2] + share * (poses[k + 1, :2] - poses[k, :2]))
    cell = np.floor((np.concatenate(parts) - occupancy.origin[:2]) / occupancy.resolution)
    index = tuple(cell.astype(int)[((cell >= 0) & (cell < occupancy.free.shape)).all(axis=1)].T)
    driven = np.zeros(occupancy.free.shape, bool)
    driven[index] = True
    return occupancy._replace(
        free=occupancy.free | driven, occupied=occupancy.occupied & ~driven
    ), driven


def _reached(space: FreeConfigurations, occupancy: OccupancyMap, poses: np.ndarray) -> np.ndarray:
    """Cells (H, W) bool of the regions that the robot was in."""
    xy = poses[np.isfinite(poses[:, 0]), :2]
    cell = np.floor((xy - occupancy.origin[:2]) / occupancy.resolution).astype(int)
    cell = np.clip(cell, 0, np.array(space.region.shape) - 1)
    counts = np.bincount(space.region[tuple(cell.T)], minlength=int(space.region.max()) + 1)
    counts[0] = 0
    return (counts >= max(1.0, MIN_SHARE * len(xy)))[space.region]


def _without(previous: TopologicalMap | None, ids: np.ndarray) -> TopologicalMap | None:
    """The nodes of an earlier map that are no corners and have none of some ids."""
    if previous is None:
        return None
    kept = (previous.kind == JUNCTION) & ~np.isin(previous.id, ids)
    return previous._replace(id=previous.id[kept], xy=previous.xy[kept])


def _open_end_ids(
    lines: tuple[np.ndarray, ...],
    graph: TopologicalMap,
    previous: TopologicalMap | None,
    next_id: int,
) -> tuple[np.ndarray, int]:
    """Ids of open ends, those of the map before where they are still open; and the next id."""
    ends = np.array([line[-1] for line in lines]).reshape(-1, 2)
    none = np.full(len(ends), -1)
    if previous is None or len(previous.frontier_id) != len(previous.frontiers):
        return kept_ids(none, ends, None, next_id)
    old = np.array([line[-1] for line in previous.frontiers]).reshape(-1, 2)
    still = ~np.isin(previous.frontier_id, graph.id)
    before = graph._replace(id=previous.frontier_id[still], xy=old[still])
    return kept_ids(none, ends, before, next_id)
