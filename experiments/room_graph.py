"""The Voronoi graph of a whole room, from its walls alone: the reference for a map of it.

The walls are sampled densely and SciPy's Voronoi diagram of the samples is labelled by wall; its
junctions are then refined to the exact circles that touch their walls.
"""

from collections import deque
from itertools import combinations

import numpy as np
from scipy.optimize import root
from scipy.spatial import Voronoi

from experiments.common import Numbers
from jaxslam.frontend.features import FeatureSpec

NEAR = 0.1  # [m] vertices this close are one junction
SPACING = 0.02  # [m] between the sample points of a wall
MIN_BRANCH_ANGLE = 0.3  # [rad] between the two foot points of a branch


def inside(points: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Whether points (N, 2) are in free space: a ray to the right meets an odd number of walls."""
    low, high = np.sort(walls[:, [1, 3]], axis=1).T
    upright = low < high  # all other walls of the room are parallel to the ray
    crossed = (low <= points[:, 1:]) & (points[:, 1:] < high) & (points[:, :1] < walls[:, 0])
    return np.sum(crossed & upright, axis=1) % 2 == 1


def foot_offsets(point: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Offsets (S, 2) [m] from a point (2,) to the nearest point of each wall."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    fraction = np.sum((point - start) * along, axis=1) / np.sum(along**2, axis=1)
    return start + np.clip(fraction, 0.0, 1.0)[:, None] * along - point


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle (...) [rad] between vectors (..., 2)."""
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.abs(np.arctan2(cross, np.sum(a * b, axis=-1)))


def branch_graph(walls: np.ndarray) -> tuple[np.ndarray, dict[int, list[int]]]:
    """Vertices (N, 2) of the Voronoi diagram of the walls, and which are joined by a branch.

    The walls are sampled; walls that share a corner share a sample. Ridges between neighbours on
    one wall are no branches: their two foot points lie in nearly the same direction.
    """
    sizes = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    parts = [np.linspace(0, 1, round(size / SPACING) + 1)[:, None] for size in sizes]
    samples = [w[:2] + part * (w[2:] - w[:2]) for w, part in zip(walls, parts, strict=True)]
    samples = np.unique(np.concatenate(samples).round(6), axis=0)
    diagram = Voronoi(samples)
    vertices, free = diagram.vertices, inside(diagram.vertices, walls)
    joined: dict[int, list[int]] = {}
    for pair, (a, b) in zip(diagram.ridge_points, diagram.ridge_vertices, strict=True):
        if a < 0 or b < 0 or not (free[a] and free[b]):
            continue
        first, second = samples[pair] - (vertices[a] + vertices[b]) / 2
        if angle(first, second) > MIN_BRANCH_ANGLE:
            joined.setdefault(a, []).append(b)
            joined.setdefault(b, []).append(a)
    return vertices, joined


def refine(vertex: np.ndarray, walls: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Centre (2,) of the circle that touches three walls near `vertex` (2,) and cuts none.

    Of the walls that are nearest, up to two samples, the three that differ most in direction.

    Returns:
        The centre, its clearance [m], and the smallest angle [rad] between its foot points.
    """
    distance = np.hypot(*foot_offsets(vertex, walls).T)
    best = vertex, 0.0, 0.0
    for three in combinations(np.flatnonzero(distance < distance.min() + 2 * SPACING), 3):
        solved = root(_gaps, [*vertex, distance.min()], args=(walls[list(three)],), tol=1e-10)
        offset = foot_offsets(solved.x[:2], walls)
        spread = min(angle(offset[a], offset[b]) for a, b in combinations(three, 2))
        empty = np.hypot(*offset.T).min() > solved.x[2] - 1e-6
        if solved.success and empty and spread > best[2] + 1e-6:
            best = solved.x[:2], float(solved.x[2]), float(spread)
    return best


def _gaps(circle: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Distances (S,) [m] between a circle (x, y, radius) and walls."""
    return np.hypot(*foot_offsets(circle[:2], walls).T) - circle[2]


def reference(walls: np.ndarray) -> Numbers:
    """Junctions of the room that can be nodes of a map, and the branches that join them."""
    vertices, joined = branch_graph(walls)
    spec, junctions = FeatureSpec(), []
    for vertex in (v for v, others in joined.items() if len(others) >= 3):
        centre, clearance, spread = refine(vertices[vertex], walls)
        known = any(np.hypot(*(centre - j["xy"])) < NEAR for j in junctions)
        fits = spec.min_clearance < clearance < spec.max_clearance
        if fits and spread > spec.min_foot_angle and not known:
            junctions.append({"xy": centre, "clearance_m": clearance, "spread_rad": spread})
    junctions.sort(key=lambda j: tuple(j["xy"].round(3)))
    xy = np.array([j["xy"] for j in junctions])

    # Follow the branches from each junction until they reach another.
    owner = {}
    for vertex in joined:
        distance = np.hypot(*(xy - vertices[vertex]).T)
        if distance.min() < NEAR / 2:
            owner[vertex] = int(np.argmin(distance))
    arcs = {}
    for junction in range(len(xy)):
        came_from = {vertex: None for vertex, k in owner.items() if k == junction}
        queue = deque(came_from)
        while queue:
            vertex = queue.popleft()
            end = owner.get(vertex, junction)
            if end > junction:
                arcs.setdefault((junction, end), trace(vertex, came_from))
            if end != junction:
                continue
            for neighbour in joined[vertex]:
                if neighbour not in came_from:
                    came_from[neighbour] = vertex
                    queue.append(neighbour)
    lines = [
        xy[[a]].tolist() + vertices[path[::2]].tolist() + xy[[b]].tolist()
        for (a, b), path in arcs.items()
    ]
    return {
        "junctions": junctions,
        "arcs": [list(pair) for pair in arcs],
        "lines": [np.round(line, 3) for line in lines],
    }


def trace(vertex: int, came_from: dict[int, int | None]) -> list[int]:
    """Vertices of the path to `vertex`, from its start on."""
    path = []
    while vertex is not None:
        path.append(vertex)
        vertex = came_from[vertex]
    return path[::-1]
