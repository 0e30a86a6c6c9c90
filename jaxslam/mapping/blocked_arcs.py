"""Arcs of a map where there is an obstacle now: what the last scans that looked there saw.

Each point of an arc is looked at by scans, in the order of time: it is free if a scan sees walls
beyond it alone, and blocked if the scan sees a wall on it. Of its last `LOOKS` looks nearly all
have to agree, so that somebody who walks by blocks nothing, and a door that was opened again is
open.
"""

import numpy as np
from scipy.spatial import cKDTree

from jaxslam.core import polylines
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import inverse_transform
from jaxslam.matching.scan_agreement import moved

LOOKS, MIN_BLOCKED = 6, 5
"""Last looks at a point that count, and how many of them have to find it blocked."""

ON_ARC = 0.15
"""[m] from an arc, or half of its clearance if that is less, within which a wall blocks it."""

BEYOND = 0.3
"""[m] behind a point from which walls show that it is free."""

SPACING = 0.1
"""[m] between two points of an arc."""

REACH = 8.0
"""[m] from a scan up to which it says anything of an arc."""


def blocked_arcs(
    lidar: Lidar,
    poses: np.ndarray,
    scans: Scan,
    lines: tuple[np.ndarray, ...],
    clearance: np.ndarray,
) -> np.ndarray:
    """Whether each arc (A,) has a point where the last scans see an obstacle.

    Args:
        lidar: The scanner.
        poses: (K, 3) [m, m, rad] finite poses of the scans in the order of time, map frame.
        scans: [K].
        lines: A polylines (n >= 2, 2) [m], map frame.
        clearance: (A,) [m] least clearance of each; NaN where it is not known.
    """
    blocked = np.zeros(len(lines), bool)
    if not len(lines) or not len(poses):
        return blocked
    pieces = [_points(line) for line in lines]
    points, arc = np.concatenate(pieces), np.repeat(np.arange(len(lines)), list(map(len, pieces)))
    width, tree = np.fmin(ON_ARC, 0.5 * clearance)[arc], cKDTree(points)
    ranges = np.where(np.asarray(scans.hit), np.asarray(scans.ranges, float), np.nan)
    num_looks, num_blocked = np.zeros((2, len(points)), int)
    for number in moved(poses)[::-1].tolist():
        near = np.array(tree.query_ball_point(poses[number, :2], REACH), int)
        near = near[num_looks[near] < LOOKS]
        local = inverse_transform(poses[number], points[near])
        free, on_wall = _look(lidar, ranges[number], local, width[near])
        num_looks[near] += free | on_wall
        num_blocked[near] += on_wall
    blocked[arc[num_blocked >= MIN_BLOCKED]] = True
    return blocked


def _points(line: np.ndarray) -> np.ndarray:
    """Points (N, 2) on a polyline (n, 2), `SPACING` apart or less."""
    return polylines.resample(line, int(np.ceil(polylines.length(line) / SPACING)) + 1)


def _look(
    lidar: Lidar, ranges: np.ndarray, points: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether points (N, 2) are free, or on a wall, by the two beams of a scan beside each.

    Args:
        lidar: The scanner.
        ranges: (R,) [m]; NaN without a return, which shows nothing.
        points: (N, 2) [m] robot frame.
        width: (N,) [m] from a point within which a wall is on it.
    """
    bearing, distance = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    beam = np.mod(bearing - lidar.angle_min, 2 * np.pi) / lidar.angle_increment
    count = lidar.num_beams
    is_full_turn = (count + 0.5) * lidar.angle_increment > 2 * np.pi
    left = np.minimum(beam.astype(int), count - 1)
    both = np.stack([left, (left + 1) % count])
    angle, depth = lidar.angle_min + lidar.angle_increment * both, ranges[both]
    seen = np.isfinite(depth).all(axis=0) & ((beam < count - 1) | is_full_turn)
    gap = np.hypot(depth * np.cos(angle) - points[:, 0], depth * np.sin(angle) - points[:, 1])
    on_wall = seen & (gap.min(axis=0) < width)
    return seen & ~on_wall & (depth.min(axis=0) > distance + BEYOND), on_wall
