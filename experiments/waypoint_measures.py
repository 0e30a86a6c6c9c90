"""The measures by which SWAGGER, a generator of waypoint graphs, evaluates its graphs.

Its nodes are joined by straight edges; here the points of a polyline are waypoints, too. Routes
lead from node to node.

References:
    NVIDIA (2025), SWAGGER: Sparse WAypoint Graph Generation for Efficient Routing,
    github.com/nvidia-isaac/SWAGGER, docs/evaluation.md.
"""

import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from experiments.common import Numbers
from experiments.roadmaps import Chains, Ground, Roadmap, shortest_edges
from jaxslam.core import polylines


def measure(rng: np.random.Generator, ground: Ground, roadmap: Roadmap, num_routes: int) -> Numbers:
    """Coverage, routes between random nodes, and validity of a graph.

    Returns:
        Numbers by name. `coverage`: share of the known free space that is in a region with a node.
        `node_distance_m`, `worst_node_distance_m`: from free cells of these regions to the nearest
        node, straight. `path_success`: share of random pairs of nodes that are joined; of their
        routes, means of `path_length_m`, `path_clearance_m` and `path_smoothness`, 1 for straight
        on and 0 for turning back at every waypoint. `collision_free`: share of arcs on which the
        robot fits everywhere; `valid_nodes`: of nodes where it fits. `connected`, `subgraphs`.
    """
    if not len(roadmap.lines):
        return {"coverage": 0.0, "path_success": 0.0}
    chains = Chains.of_roadmap(roadmap)
    free_arc = np.ones(len(roadmap.lines), bool)
    free_arc[chains.arc[~ground.at(ground.fits, chains.middles())]] = False
    matrix = shortest_edges(roadmap.ends, _lengths(roadmap), len(roadmap.xy))
    subgraphs, part = csgraph.connected_components(matrix, directed=False)
    pairs = rng.integers(len(roadmap.xy), size=(num_routes, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    joined = part[pairs[:, 0]] == part[pairs[:, 1]]
    return {
        **_coverage(ground, roadmap),
        "mean_degree": 2 * len(roadmap.lines) / len(roadmap.xy),
        "mean_arc_length_m": float(_lengths(roadmap).mean()),
        "path_success": float(joined.mean()),
        **_paths(ground, roadmap, matrix, pairs[joined]),
        "collision_free": float(free_arc.mean()),
        "valid_nodes": float(ground.at(ground.fits, roadmap.xy).mean()),
        "connected": bool(subgraphs == 1),
        "subgraphs": int(subgraphs),
    }


def _lengths(roadmap: Roadmap) -> np.ndarray:
    """Length (A,) [m] of each arc."""
    return np.array([polylines.length(line) for line in roadmap.lines], float)


def _coverage(ground: Ground, roadmap: Roadmap) -> Numbers:
    region, count = ndimage.label(ground.known_free, np.ones((3, 3)))
    has_node = np.zeros(count + 1, bool)
    has_node[ground.at(region, roadmap.xy)] = True
    has_node[0] = False
    near = has_node[region]
    away = cKDTree(roadmap.xy).query(ground.points(np.argwhere(near)))[0]
    return {
        "coverage": float(near.sum() / ground.known_free.sum()),
        "node_distance_m": float(away.mean()) if away.size else None,
        "worst_node_distance_m": float(away.max()) if away.size else None,
    }


def _paths(ground: Ground, roadmap: Roadmap, matrix, pairs: np.ndarray) -> Numbers:
    """Means over the shortest routes between pairs (M, 2) of nodes."""
    shortest: dict[tuple[int, int], int] = {}
    lengths = _lengths(roadmap)
    for k in np.argsort(-lengths, kind="stable").tolist():
        a, b = roadmap.ends[k].tolist()
        shortest[a, b] = shortest[b, a] = k
    found: list[tuple[float, float, float]] = []
    starts, back = np.unique(pairs[:, 0], return_inverse=True)
    _, before = csgraph.dijkstra(matrix, directed=False, indices=starts, return_predecessors=True)
    for row, goal in zip(back.tolist(), pairs[:, 1].tolist(), strict=True):
        parts, node, start = [], goal, int(starts[row])
        while node != start:
            previous = int(before[row, node])
            k = shortest[previous, node]
            line = roadmap.lines[k]
            parts.append(line[::-1] if roadmap.ends[k, 1] == node else line)
            node = previous
        path = np.concatenate(parts)
        dense = polylines.refine(path, ground.resolution)
        clearance = float(ground.at(ground.clearance, dense).mean())
        found.append((float(polylines.length(path)), clearance, smoothness(path)))
    mean = np.mean(found, axis=0).tolist() if found else [None] * 3
    names = ("path_length_m", "path_clearance_m", "path_smoothness")
    return dict(zip(names, mean, strict=True))


def smoothness(path: np.ndarray) -> float:
    """One less the mean turn at the points of a path (n, 2), of half a turn each."""
    steps = np.diff(path, axis=0)
    steps = steps[np.hypot(*steps.T) > 1e-9]
    if len(steps) < 2:
        return 1.0
    course = np.arctan2(steps[:, 1], steps[:, 0])
    turn = np.abs((np.diff(course) + np.pi) % (2 * np.pi) - np.pi)
    return float(1.0 - turn.mean() / np.pi)
