"""What is true of a world: its free space, its Voronoi junctions, its corners, who sees what.

Worked out from the walls alone, in double precision, without the front end that is judged by it.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import Voronoi, cKDTree

SPACING = 0.02  # [m] between the points that stand for a wall
CELL = 0.05  # [m] of the grid that tells inside from outside
DISTINCT = 0.2  # [rad] feet of a junction differ by this at least, seen from it
SAME = 0.001  # [m] junctions this close are one


class Junctions(NamedTuple):
    """Places with three nearest points on the walls or more."""

    xy: np.ndarray  # (N, 2) [m]
    clearance: np.ndarray  # (N,) [m]
    spread: np.ndarray  # (N,) [rad] smallest angle between the three feet that differ most


class Corners(NamedTuple):
    """Places in which two walls end."""

    xy: np.ndarray  # (N, 2) [m]
    along: np.ndarray  # (N, 2, 2) unit vectors along the two walls, away from the corner


def solid(walls: np.ndarray) -> np.ndarray:
    """The walls (S, 4) that have a length: no padding."""
    walls = np.asarray(walls, float)
    return walls[np.hypot(*(walls[:, 2:] - walls[:, :2]).T) > 1e-9]


def feet(places: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Offsets (N, S, 2) [m] from places (N, 2) to the nearest point of each wall (S, 4)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = places[:, None] - start
    part = np.clip(np.sum(offset * along, -1) / np.sum(along**2, -1), 0.0, 1.0)
    return part[..., None] * along - offset


def clearance(places: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Distance (N,) [m] of places (N, 2) from the nearest wall."""
    return np.hypot(*np.moveaxis(feet(places, walls), -1, 0)).min(axis=1)


def sample(walls: np.ndarray, spacing: float) -> np.ndarray:
    """Points (P, 2) [m] on the walls, their ends among them."""
    sizes = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    parts = [np.linspace(0, 1, int(np.ceil(size / spacing)) + 1)[:, None] for size in sizes]
    every = [w[:2] + part * (w[2:] - w[:2]) for w, part in zip(walls, parts, strict=True)]
    return np.unique(np.concatenate(every).round(6), axis=0)


class Free:
    """The largest space that the walls enclose."""

    def __init__(self, walls: np.ndarray):
        """Flood a grid on which the walls are drawn."""
        self.origin = walls.reshape(-1, 2).min(axis=0) - 3 * CELL
        index = np.floor((sample(walls, CELL / 2) - self.origin) / CELL).astype(int)
        drawn = np.zeros(index.max(axis=0) + 4, bool)
        drawn[tuple(index.T)] = True
        drawn = ndimage.binary_dilation(drawn)
        region, count = ndimage.label(~drawn)
        size = np.bincount(region.ravel(), minlength=count + 1)
        size[[0, region[0, 0]]] = 0
        self.region = ndimage.binary_dilation(region == np.argmax(size))

    def holds(self, places: np.ndarray) -> np.ndarray:
        """Whether places (N, 2) [m] are inside."""
        index = np.floor((places - self.origin) / CELL).astype(int)
        inside = np.all((index >= 0) & (index < self.region.shape), axis=1)
        at = np.where(inside[:, None], index, 0)
        return inside & self.region[tuple(at.T)]


def _spread(offset: np.ndarray) -> float:
    """Smallest angle [rad] between the three of some directions (K, 2) that differ most."""
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    gap = np.abs((angle[:, None] - angle + np.pi) % (2 * np.pi) - np.pi)
    pairs = combinations(range(len(angle)), 3)
    return max((min(gap[a, b], gap[b, c], gap[a, c]) for a, b, c in pairs), default=0.0)


def _touching(place: np.ndarray, three: np.ndarray) -> np.ndarray:
    """Circle (x, y, radius) near `place` (2,) that touches three walls (3, 4)."""
    circle = np.array([*place, np.hypot(*feet(place[None], three)[0].T).mean()])
    for _ in range(20):
        offset = feet(circle[None, :2], three)[0]
        distance = np.maximum(np.hypot(*offset.T), 1e-9)
        rows = np.column_stack([-offset / distance[:, None], -np.ones(3)])
        move = np.linalg.lstsq(rows, distance - circle[2], rcond=None)[0]
        circle = circle - move
        if np.abs(move).max() < 1e-12:
            break
    return circle


def junctions(walls: np.ndarray, free: Free) -> Junctions:
    """All junctions of the Voronoi diagram of the walls (S, 4) in free space, exact.

    The walls are sampled; where samples in three directions are nearest to a vertex of SciPy's
    Voronoi diagram there may be junctions, and Newton's method finds the circles that touch three
    of the walls themselves; those that no wall cuts are junctions.
    """
    diagram = Voronoi(sample(walls, SPACING))
    place = diagram.vertices[free.holds(diagram.vertices)]
    place = place[cKDTree(diagram.points).query(place)[0] > 0.1]
    found, tried = [], set()
    for at in place:
        offset = feet(at[None], walls)[0]
        distance = np.hypot(*offset.T)
        near = np.flatnonzero(distance < distance.min() + SPACING)
        if _spread(offset[near]) < DISTINCT:
            continue
        for three in map(list, combinations(near, 3)):
            name = (*three, *np.round(at / 0.3).astype(int))
            if name in tried or _spread(offset[three]) < DISTINCT:
                continue
            tried.add(name)
            circle = _touching(at, walls[three])
            radius = circle[2]
            every = feet(circle[None, :2], walls)[0]
            size = np.hypot(*every.T)
            spread = _spread(every[size < radius + 1e-6])
            good = size.min() > radius - 1e-6 and spread > DISTINCT
            good = good and np.hypot(*(circle[:2] - at)) < 0.1
            if good and all(np.hypot(*(circle[:2] - f[0])) > SAME for f in found):
                found.append((circle[:2], radius, spread))
    return Junctions(*(np.array(x) for x in zip(*found, strict=True)))


def corners(walls: np.ndarray) -> Corners:
    """Corners of walls (S, 4): ends that two walls share and that bend by more than a little."""
    ends = walls.reshape(-1, 2)
    wall = np.repeat(np.arange(len(walls)), 2)
    tree, xy, along = cKDTree(ends), [], []
    for a, b in tree.query_pairs(1e-6):
        arms = [ends[e ^ 1] - ends[e] for e in (a, b)]
        arms = [arm / np.hypot(*arm) for arm in arms]
        if wall[a] != wall[b] and abs(arms[0] @ arms[1]) < 0.98:
            xy.append(ends[a])
            along.append(arms)
    # Walls that end on another.
    for end, (k, arm) in zip(
        ends,
        ((k, s * (walls[k, 2:] - walls[k, :2])) for k in range(len(walls)) for s in (1, -1)),
        strict=True,
    ):
        gap = np.hypot(*feet(end[None], walls)[0].T)
        for other in np.flatnonzero(gap < 1e-6):
            line = walls[other, 2:] - walls[other, :2]
            inner = min(np.hypot(*(end - walls[other, :2])), np.hypot(*(end - walls[other, 2:])))
            if other != k and inner > 1e-6:
                unit = arm / np.hypot(*arm)
                for sign in (1, -1):
                    xy.append(end)
                    along.append([unit, sign * line / np.hypot(*line)])
    return Corners(np.array(xy), np.array(along))


def in_sight(eyes: np.ndarray, places: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Whether no wall (S, 4) lies between eyes (N, 2) and places (N, K, 2): (N, K) bool."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    beam = (places - eyes[:, None])[:, :, None]  # (N, K, 1, 2)
    to = (start[None] - eyes[:, None])[:, None]  # (N, 1, S, 2)
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    slope = cross(beam, along)
    slope = np.where(np.abs(slope) < 1e-12, np.nan, slope)
    distance, part = cross(to, along) / slope, cross(to, beam) / slope
    hidden = (distance > 1e-9) & (distance < 1.0) & (part >= -1e-9) & (part <= 1 + 1e-9)
    return ~hidden.any(axis=-1)


def hits(eye: np.ndarray, bearings: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Where beams from `eye` (2,) in directions (R,) [rad, world] end: (R, 2) [m], or infinity."""
    start, along = walls[:, :2] - eye, walls[:, 2:] - walls[:, :2]
    beam = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)[:, None]
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    slope = cross(beam, along)
    slope = np.where(np.abs(slope) < 1e-12, np.nan, slope)
    distance, part = cross(start, along) / slope, cross(start, beam) / slope
    met = (distance > 1e-9) & (part >= -1e-9) & (part <= 1 + 1e-9)
    return eye + np.where(met, distance, np.inf).min(axis=1)[:, None] * beam[:, 0]
