"""Which nodes of a diagram are which landmarks, and the ids of all nodes."""

from collections.abc import Collection

import numpy as np
from scipy.spatial import cKDTree

from jaxslam.core import polylines
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.pairing import one_to_one
from jaxslam.mapping.open_space import FreeSpace
from jaxslam.mapping.plane_graph import Line, PlaneGraph

SAME_PLACE = 0.2
"""[m] or half of the clearance, if that is less, within which node and landmark are the same.

What is farther off is another junction, perhaps of a branch into a corner, which the diagram does
not have.
"""

ACCURACY = 0.1
"""[m] of the nodes of a diagram, two cells: none is moved farther, as it would be another place."""

SAME_NODE = 0.5
"""[m] within which nodes of two maps are the same."""

CONTRADICTED = 0.5
"""A landmark with less than this share of its clearance left has an obstacle in its circle."""


def place_landmarks(
    graph: PlaneGraph,
    xy: np.ndarray,
    clearance: np.ndarray,
    space: FreeSpace,
    junctions: Collection[int] | None = None,
) -> dict[int, int]:
    """Make landmarks nodes of a diagram, in place.

        o  junction or dead end of the diagram:   it is the landmark; within `ACCURACY`, it moves
        -  an arc passes the landmark:            it is split there
           the arc is within the circle:          a spur leads to the landmark, inside its circle
           none of these:                         the landmark is no node: space is otherwise there

    A node or an arc is moved onto the landmark if the arcs stay free there.

    Args:
        graph: The diagram.
        xy: (L, 2) [m] landmarks, in the order of their ids.
        clearance: (L,) [m] radii of their circles.
        space: Free configurations, in which the diagram lies.
        junctions: Numbers of nodes that are junctions though they join two arcs. If given, these
            are all there are: a landmark that is at no node is no node.

    Returns:
        Landmark, by the number of its node.
    """
    names: dict[int, int] = {}
    left = space.at(xy) if len(xy) else np.zeros(0)
    usable = np.flatnonzero((left > 0.0) & (left >= CONTRADICTED * clearance))
    radius = np.minimum(SAME_PLACE, 0.5 * clearance)
    ends = np.union1d(np.flatnonzero(graph.degrees() != 2), list(junctions or ())).astype(int)
    nodes = np.array(graph.xy).reshape(-1, 2)[ends]
    placed = set()
    for chosen, end in _nearest_pairs(xy[usable], nodes, radius[usable]).items():
        k, node = int(usable[chosen]), int(ends[end])
        names[node] = k
        placed.add(k)
        if np.hypot(*(nodes[end] - xy[k])) <= ACCURACY:
            _move(graph, node, xy[k], space)
    for k in usable.tolist() if junctions is None else ():
        if k in placed:
            continue
        arc, distance, along = graph.nearest(xy[k], float(clearance[k]))
        if arc < 0:
            continue
        node = graph.split(arc, along)
        if distance < radius[k] and node not in names:
            _move(graph, node, xy[k], space)
        elif distance > radius[k] or node in names:
            if np.hypot(*(graph.xy[node] - xy[k])) < radius[k]:
                continue  # another landmark stands for this place
            root, node = node, graph.add_node(xy[k])
            line = np.array([graph.xy[root], xy[k]])
            graph.add_arc(Line(root, node, line, False))
        names[node] = k
    return names


def _nearest_pairs(
    first: np.ndarray, second: np.ndarray, radius: float | np.ndarray
) -> dict[int, int]:
    """Indices of partners, by those of points (N, 2) [m] of which they (M, 2) lie in a radius."""
    if not len(first) or not len(second):
        return {}
    near = cKDTree(second).query_ball_point(first, radius)
    pairs = np.array([(a, b) for a, others in enumerate(near) for b in others], int).reshape(-1, 2)
    return one_to_one(pairs, np.hypot(*(second[pairs[:, 1]] - first[pairs[:, 0]]).T))


def _move(graph: PlaneGraph, node: int, xy: np.ndarray, space: FreeSpace) -> None:
    """Move a node to (2,) [m] if its arcs stay free."""
    before = graph.xy[node]
    least = _clearance_at(graph, node, space)
    graph.move(node, xy)
    if _clearance_at(graph, node, space) < min(least, space.robot_radius):
        graph.move(node, before)


def _clearance_at(graph: PlaneGraph, node: int, space: FreeSpace) -> float:
    """Least clearance [m] of the arcs of a node; 0 where the robot cannot be."""
    least = float(space.at(graph.xy[node][None])[0])
    for line in graph.arcs.values():
        if node in (line.start, line.end):
            count = int(2 * polylines.length(line.points) / space.resolution) + 2
            least = min(least, float(space.at(polylines.resample(line.points, count)).min()))
    return least


def kept_ids(
    ids: np.ndarray, xy: np.ndarray, previous: TopologicalMap | None, next_id: int
) -> tuple[np.ndarray, int]:
    """Ids of nodes, those of an earlier map where they are at the same place.

    So a node that was no landmark keeps its id when it becomes one.

    Args:
        ids: (N,) int of the nodes that are landmarks; -1 for others.
        xy: (N, 2) [m].
        previous: The earlier map, in the same frame.
        next_id: Id of the next new node.

    Returns:
        Ids (N,), all different, and the id of the next new node.
    """
    ids = ids.copy()
    if previous is not None and len(previous.id):
        old = np.flatnonzero(~np.isin(previous.id, ids))
        new = np.flatnonzero(~np.isin(ids, previous.id))
        for k, n in _nearest_pairs(previous.xy[old], xy[new], SAME_NODE).items():
            ids[new[n]] = previous.id[old[k]]
    fresh = np.flatnonzero(ids < 0)
    ids[fresh] = next_id + np.arange(len(fresh))
    return ids, next_id + len(fresh)
