"""Ground truth of a world: its free space, Voronoi junctions, corners, and visibility.

Computed from the walls alone, in double precision, without the front end that is evaluated by it.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import Voronoi, cKDTree

SPACING = 0.02  # [m] between the sample points of a wall
CELL_SIZE = 0.05  # [m] of the grid that separates inside from outside
MIN_FOOT_ANGLE = 0.2  # [rad] between the foot points of a junction, seen from it
SAME_JUNCTION = 0.001  # [m] junctions this close are one


class Junctions(NamedTuple):
    """Points with three or more nearest points on the walls.

    Attributes:
        xy: (N, 2) [m].
        clearance: (N,) [m] distance from the walls.
        min_angle: (N,) [rad] smallest angle between the three foot points that differ most.
    """

    xy: np.ndarray
    clearance: np.ndarray
    min_angle: np.ndarray


class Corners(NamedTuple):
    """Points in which two walls end.

    Attributes:
        xy: (N, 2) [m].
        directions: (N, 2, 2) unit vectors along the two walls, away from the corner.
    """

    xy: np.ndarray
    directions: np.ndarray


def without_padding(walls: np.ndarray) -> np.ndarray:
    """The walls (S, 4) that have a length."""
    walls = np.asarray(walls, float)
    return walls[np.hypot(*(walls[:, 2:] - walls[:, :2]).T) > 1e-9]


def foot_offsets(points: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Offsets (N, S, 2) [m] from points (N, 2) to the nearest point of each wall (S, 4)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = points[:, None] - start
    fraction = np.clip(np.sum(offset * along, -1) / np.sum(along**2, -1), 0.0, 1.0)
    return fraction[..., None] * along - offset


def clearance(points: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Distance (N,) [m] of points (N, 2) from the nearest wall."""
    return np.hypot(*np.moveaxis(foot_offsets(points, walls), -1, 0)).min(axis=1)


def sample(walls: np.ndarray, spacing: float) -> np.ndarray:
    """Sample points (P, 2) [m] of the walls, including their ends."""
    sizes = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    parts = [np.linspace(0, 1, int(np.ceil(size / spacing)) + 1)[:, None] for size in sizes]
    points = [w[:2] + part * (w[2:] - w[:2]) for w, part in zip(walls, parts, strict=True)]
    return np.unique(np.concatenate(points).round(6), axis=0)


class FreeSpace:
    """The largest region that the walls enclose."""

    def __init__(self, walls: np.ndarray):
        """Label the regions of a grid on which the walls are drawn."""
        self.origin = walls.reshape(-1, 2).min(axis=0) - 3 * CELL_SIZE
        index = np.floor((sample(walls, CELL_SIZE / 2) - self.origin) / CELL_SIZE).astype(int)
        drawn = np.zeros(index.max(axis=0) + 4, bool)
        drawn[tuple(index.T)] = True
        drawn = ndimage.binary_dilation(drawn)
        region, count = ndimage.label(~drawn)
        size = np.bincount(region.ravel(), minlength=count + 1)
        size[[0, region[0, 0]]] = 0
        self.region = ndimage.binary_dilation(region == np.argmax(size))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (N, 2) [m] are inside."""
        index = np.floor((points - self.origin) / CELL_SIZE).astype(int)
        inside = np.all((index >= 0) & (index < self.region.shape), axis=1)
        index = np.where(inside[:, None], index, 0)
        return inside & self.region[tuple(index.T)]


def _min_angle(offset: np.ndarray) -> float:
    """Smallest angle [rad] between the three of some directions (K, 2) that differ most."""
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    gap = np.abs((angle[:, None] - angle + np.pi) % (2 * np.pi) - np.pi)
    pairs = combinations(range(len(angle)), 3)
    return max((min(gap[a, b], gap[b, c], gap[a, c]) for a, b, c in pairs), default=0.0)


def _tangent_circle(near: np.ndarray, three: np.ndarray) -> np.ndarray:
    """Circle (x, y, radius) near a point (2,) that touches three walls (3, 4)."""
    circle = np.array([*near, np.hypot(*foot_offsets(near[None], three)[0].T).mean()])
    for _ in range(20):
        offset = foot_offsets(circle[None, :2], three)[0]
        distance = np.maximum(np.hypot(*offset.T), 1e-9)
        rows = np.column_stack([-offset / distance[:, None], -np.ones(3)])
        step = np.linalg.lstsq(rows, distance - circle[2], rcond=None)[0]
        circle = circle - step
        if np.abs(step).max() < 1e-12:
            break
    return circle


def junctions(walls: np.ndarray, free: FreeSpace) -> Junctions:
    """All junctions of the Voronoi diagram of the walls (S, 4) in free space, exact.

    The walls are sampled. Where samples in three directions are nearest to a vertex of SciPy's
    Voronoi diagram there may be a junction, and Newton's method finds the circles that touch three
    of the walls themselves; those that no wall cuts are junctions.
    """
    diagram = Voronoi(sample(walls, SPACING))
    vertices = diagram.vertices[free.contains(diagram.vertices)]
    vertices = vertices[cKDTree(diagram.points).query(vertices)[0] > 0.1]
    found, tried = [], set()
    for vertex in vertices:
        offset = foot_offsets(vertex[None], walls)[0]
        distance = np.hypot(*offset.T)
        near = np.flatnonzero(distance < distance.min() + SPACING)
        if _min_angle(offset[near]) < MIN_FOOT_ANGLE:
            continue
        for three in map(list, combinations(near, 3)):
            name = (*three, *np.round(vertex / 0.3).astype(int))
            if name in tried or _min_angle(offset[three]) < MIN_FOOT_ANGLE:
                continue
            tried.add(name)
            circle = _tangent_circle(vertex, walls[three])
            radius = circle[2]
            offsets = foot_offsets(circle[None, :2], walls)[0]
            distances = np.hypot(*offsets.T)
            angle = _min_angle(offsets[distances < radius + 1e-6])
            good = distances.min() > radius - 1e-6 and angle > MIN_FOOT_ANGLE
            good = good and np.hypot(*(circle[:2] - vertex)) < 0.1
            if good and all(np.hypot(*(circle[:2] - f[0])) > SAME_JUNCTION for f in found):
                found.append((circle[:2], radius, angle))
    return Junctions(*(np.array(x) for x in zip(*found, strict=True)))


def corners(walls: np.ndarray) -> Corners:
    """Corners of walls (S, 4): ends that two walls share and that bend by more than a little."""
    ends = walls.reshape(-1, 2)
    wall = np.repeat(np.arange(len(walls)), 2)
    tree, xy, directions = cKDTree(ends), [], []
    for a, b in tree.query_pairs(1e-6):
        arms = [ends[e ^ 1] - ends[e] for e in (a, b)]
        arms = [arm / np.hypot(*arm) for arm in arms]
        if wall[a] != wall[b] and abs(arms[0] @ arms[1]) < 0.98:
            xy.append(ends[a])
            directions.append(arms)
    # Walls that end on another.
    for end, (k, arm) in zip(
        ends,
        ((k, s * (walls[k, 2:] - walls[k, :2])) for k in range(len(walls)) for s in (1, -1)),
        strict=True,
    ):
        gap = np.hypot(*foot_offsets(end[None], walls)[0].T)
        for other in np.flatnonzero(gap < 1e-6):
            line = walls[other, 2:] - walls[other, :2]
            inner = min(np.hypot(*(end - walls[other, :2])), np.hypot(*(end - walls[other, 2:])))
            if other != k and inner > 1e-6:
                unit = arm / np.hypot(*arm)
                for sign in (1, -1):
                    xy.append(end)
                    directions.append([unit, sign * line / np.hypot(*line)])
    return Corners(np.array(xy), np.array(directions))


def in_sight(eyes: np.ndarray, points: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Whether no wall (S, 4) lies between eyes (N, 2) and points (N, K, 2): (N, K) bool."""
    beams = (points - eyes[:, None])[:, :, None]  # (N, K, 1, 2)
    distance = _distance_along(eyes[:, None, None], beams, walls)
    return ~((distance > 1e-9) & (distance < 1.0)).any(axis=-1)


def hits(eye: np.ndarray, bearings: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Where beams from `eye` (2,) in directions (R,) [rad, world] end: (R, 2) [m], or infinity."""
    beams = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)[:, None]
    distance = _distance_along(eye, beams, walls)
    nearest = np.where(distance > 1e-9, distance, np.inf).min(axis=1)
    return eye + nearest[:, None] * beams[:, 0]


def _distance_along(eyes: np.ndarray, beams: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Distance, in lengths of the beams, to where they cross walls (S, 4): (..., S), NaN for none.

    Args:
        eyes: (..., 1, 2) or (2,) where the beams start.
        beams: (..., 1, 2) vectors.
        walls: (S, 4) [m].
    """
    start, along = walls[:, :2] - eyes, walls[:, 2:] - walls[:, :2]
    slope = _cross(beams, along)
    slope = np.where(np.abs(slope) < 1e-12, np.nan, slope)
    distance, fraction = _cross(start, along) / slope, _cross(start, beams) / slope
    return np.where((fraction >= -1e-9) & (fraction <= 1 + 1e-9), distance, np.nan)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
