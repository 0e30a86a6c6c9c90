"""The search of a route among the points of arcs and the free paths to them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from jaxslam.mapping.arc_points import ArcPoints
from jaxslam.mapping.clearance import ClearanceField
from jaxslam.mapping.free_paths import (
    FreeSpace,
    component_at,
    find_paths,
    free_space,
    is_free,
    path_to,
)
from jaxslam.mapping.route_ends import Goal

REACHES = (5.0, 10.0, 20.0, 40.0, 100.0)
"""[m] from start and goal within which free paths are searched, the next where one fails."""

SAME_PLACE = 1e-9
"""[m] between start and goal, at most, for a route of no length."""


class Access(NamedTuple):
    """Free paths between the start, or the goal, and points of arcs.

    Attributes:
        points: (K,) int indices of the points of arcs; P, their number, for the goal itself.
        length: (K,) [m], infinite where there is no path.
        path: Function from k to a polyline (n, 2) [m] in the direction of travel.
    """

    points: np.ndarray
    length: np.ndarray
    path: Callable[[int], np.ndarray]


def find_line(
    points: ArcPoints,
    field: ClearanceField | None,
    start: np.ndarray,
    goal: Goal,
    robot_radius: float,
) -> tuple[np.ndarray, np.ndarray] | None:
    """The shortest route.

    Args:
        points: Points of the arcs.
        field: Distances to obstacles, if there is an occupancy map.
        start: (2,) [m] map frame, where the robot may be.
        goal: Where it may be, too.
        robot_radius: [m].

    Returns:
        Polyline (n, 2) [m] and, for each of its segments, the index (n - 1,) of the arc that it
        follows, -1 for none; or None if there is no route. Only where it follows no arc but leads
        to a point of one and back, it has segments of no length.
    """
    if goal.xy is not None and np.hypot(*(goal.xy - start)) <= SAME_PLACE:
        return np.stack([start, goal.xy]), np.array([-1])
    if not is_joined(points, field, start, goal, robot_radius):
        return None
    usable = _usable(points, robot_radius)
    if field is None:
        points, first = _straight(points, robot_radius, start, 1)
        if goal.xy is None:
            last = _at_goals(points, goal)
        else:
            points, last = _straight(points, robot_radius, goal.xy, -1)
        found = _solve(points, robot_radius, first, last)
        return None if found is None else _without_stops(*found)
    space = free_space(field, points, robot_radius)
    if goal.xy is not None and is_free(space, start, goal.xy[None], 1)[0]:
        return np.stack([start, goal.xy]), np.array([-1])
    for reach in REACHES:
        first = _through_space(space, points, usable, start, goal.xy, reach, 1)
        if goal.xy is None:
            last = _at_goals(points, goal)
        else:
            last = _through_space(space, points, usable, goal.xy, None, reach, -1)
        found = _solve(points, robot_radius, first, last)
        if found is not None or reach >= max(field.free.shape) * field.resolution:
            return found
    return None


def is_joined(
    points: ArcPoints,
    field: ClearanceField | None,
    start: np.ndarray,
    goal: Goal,
    robot_radius: float,
) -> bool:
    """Whether free space and arcs for a robot join start and goal, in whatever direction."""
    count, usable = len(points.xy), _usable(points, robot_radius)
    edges = points.edges[points.passable(robot_radius)]
    targets = goal.points if goal.xy is None else np.array([count + 1])
    ends = np.stack([start, start if goal.xy is None else goal.xy])
    if field is None:
        if not usable.size:
            return False
        near = [points.edges[_nearest_edge(points, robot_radius, xy)[0], 0] for xy in ends]
        joints = np.column_stack([near, [count, count + 1]])
    else:
        space = free_space(field, points._replace(directed=np.zeros(0, bool)), robot_radius)
        label = component_at(space, np.concatenate([points.xy, ends]))
        inside = np.append(usable, [count, count + 1] if goal.xy is not None else [count])
        inside = inside[label[inside] > 0]
        joints = np.column_stack([inside, count + 1 + label[inside]])
    edges = np.concatenate([edges, joints])
    size = int(edges.max(initial=count + 1)) + 1
    graph = sparse.csr_array((np.ones(len(edges)), edges.T), shape=(size, size))
    part = csgraph.connected_components(graph, directed=False)[1]
    return bool(np.any(part[targets] == part[count]))


def _usable(points: ArcPoints, robot_radius: float) -> np.ndarray:
    """Indices of the points on edges wide enough for a robot."""
    return np.unique(points.edges[points.passable(robot_radius)])


def _straight(
    points: ArcPoints, robot_radius: float, xy: np.ndarray, sign: int
) -> tuple[ArcPoints, Access]:
    """The straight line between a point (2,) [m] and the nearest edge, which is split there.

    Returns:
        The points of arcs with the nearest one as the last, and the line.
    """
    edge, foot = _nearest_edge(points, robot_radius, xy)
    (a, b), new = points.edges[edge], len(points.xy)
    kept = np.append(np.delete(np.arange(len(points.edges)), edge), [edge, edge])
    edges = points.edges[kept]
    edges[-2:] = [a, new], [new, b]
    length = points.length[kept]
    length[-2:] = np.hypot(*(points.xy[[a, b]] - foot).T)
    split = ArcPoints(
        xy=np.concatenate([points.xy, [foot]]),
        edges=edges,
        length=length,
        width=points.width[kept],
        arc=points.arc[kept],
        directed=points.directed[kept],
    )
    distance = np.array([np.hypot(*(foot - xy))])
    return split, Access(np.array([new]), distance, lambda _: np.stack([xy, foot])[::sign])


def _nearest_edge(points: ArcPoints, robot_radius: float, xy: np.ndarray) -> tuple[int, np.ndarray]:
    """The edge nearest to a point (2,) [m], of those wide enough, and its point (2,) there."""
    passable = np.flatnonzero(points.passable(robot_radius))
    edges = points.edges[passable]
    start, step = points.xy[edges[:, 0]], points.xy[edges[:, 1]] - points.xy[edges[:, 0]]
    fraction = np.sum((xy - start) * step, axis=1) / np.maximum(np.sum(step**2, axis=1), 1e-12)
    foot = start + np.clip(fraction, 0.0, 1.0)[:, None] * step
    nearest = int(np.argmin(np.hypot(*(foot - xy).T)))
    return int(passable[nearest]), foot[nearest]


def _without_stops(line: np.ndarray, arc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A route (n, 2) [m] and its arcs (n - 1,) without segments of no length.

    They stay where no arc is left without them.
    """
    moves = np.hypot(*np.diff(line, axis=0).T) > SAME_PLACE
    if not (arc[moves] >= 0).any():
        return line, arc
    return line[np.append(True, moves)], arc[moves]


def _through_space(
    space: FreeSpace,
    points: ArcPoints,
    usable: np.ndarray,
    xy: np.ndarray,
    other: np.ndarray | None,
    reach: float,
    sign: int,
) -> Access:
    """Paths through free space between a point (2,) [m] and points of arcs, or another point."""
    indices, targets = usable, points.xy[usable]
    if other is not None:
        indices = np.append(indices, len(points.xy))
        targets = np.concatenate([targets, [other]])
    paths = find_paths(space, xy, targets, reach=reach, sign=sign)
    return Access(indices, paths.length, lambda k: path_to(space, paths, xy, targets, k))


def _at_goals(points: ArcPoints, goal: Goal) -> Access:
    """Paths of no length from the points of arcs that are goals."""
    targets = points.xy[goal.points]
    return Access(goal.points, np.zeros(len(targets)), lambda k: targets[[k]])


def _solve(
    points: ArcPoints, robot_radius: float, first: Access, last: Access
) -> tuple[np.ndarray, np.ndarray] | None:
    """The shortest path from start to goal, by `first`, edges and `last` (Dijkstra)."""
    count, passable = len(points.xy), points.passable(robot_radius)
    goal, start = count, count + 1
    back = passable & ~points.directed
    entry, exit_ = np.isfinite(first.length), np.isfinite(last.length)
    edges = np.concatenate(
        [
            points.edges[passable],
            points.edges[back][:, ::-1],
            np.column_stack([np.full(entry.sum(), start), first.points[entry]]),
            np.column_stack([last.points[exit_], np.full(exit_.sum(), goal)]),
        ]
    )
    length = np.concatenate(
        [points.length[passable], points.length[back], first.length[entry], last.length[exit_]]
    )
    graph = sparse.csr_array((length, edges.T), shape=(count + 2, count + 2))
    previous = csgraph.dijkstra(graph, indices=start, return_predecessors=True)[1]
    if previous[goal] < 0:
        return None
    chain = [goal]
    while chain[-1] != start:
        chain.append(int(previous[chain[-1]]))
    inner = np.array(chain[-2:0:-1], int)  # points of arcs, none where start and goal are joined
    lines = [first.path(_index(first.points, chain[-2]))]
    if inner.size:
        lines += [points.xy[inner[1:]], last.path(_index(last.points, chain[1]))[1:]]
    arcs = np.concatenate(
        [
            np.full(len(lines[0]) - 1, -1),
            _arcs_between(points, inner),
            np.full(len(lines[-1]) if inner.size else 0, -1),
        ]
    )
    return np.concatenate(lines), arcs


def _index(values: np.ndarray, value: int) -> int:
    """Where a value is in an array (K,)."""
    return int(np.flatnonzero(values == value)[0])


def _arcs_between(points: ArcPoints, chain: np.ndarray) -> np.ndarray:
    """Arcs (n - 1,) of the edges between points (n,) that follow each other."""
    key = np.sort(points.edges, axis=1) @ [len(points.xy), 1]
    wanted = np.sort(np.column_stack([chain[:-1], chain[1:]]), axis=1) @ [len(points.xy), 1]
    order = np.argsort(key)
    return points.arc[order[np.searchsorted(key[order], wanted)]]
