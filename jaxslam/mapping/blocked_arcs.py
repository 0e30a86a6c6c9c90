"""Arcs of a map where there is an obstacle now: what the last scans that looked there saw.

Each point of an arc is looked at by scans, in the order of time: it is free if a scan sees walls
beyond it alone, and blocked if the scan sees a wall on it. Of its last `LOOKS` looks nearly all
have to agree, so that somebody who walks by blocks nothing, and a door that was opened again is
open.
"""

import numpy as np
from scipy.spatial import cKDTree

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import inverse_transform
from jaxslam.matching.scan_agreement import PosedScans, posed_scans

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
    ranges, hit = np.asarray(scans.ranges, float), np.asarray(scans.hit)
    posed = posed_scans(lidar, poses, ranges, hit)
    pieces = [_points(line) for line in lines]
    points, arc = np.concatenate(pieces), np.repeat(np.arange(len(lines)), list(map(len, pieces)))
    width = np.fmin(ON_ARC, 0.5 * clearance)[arc]
    looks = [_looks(posed, k, points, near, width) for k, near in _near(posed, points)]
    point = np.concatenate([number for number, _ in looks])
    is_blocked = np.concatenate([state for _, state in looks])
    order = np.argsort(point, kind="stable")[::-1]  # of each point the last look first
    point, is_blocked = point[order], is_blocked[order]
    first = np.flatnonzero(np.diff(point, prepend=-1))
    rank = np.arange(len(point)) - np.repeat(first, np.diff(np.append(first, len(point))))
    count = np.bincount(point[(rank < LOOKS) & is_blocked], minlength=len(points))
    blocked[arc[count >= MIN_BLOCKED]] = True
    return blocked


def _points(line: np.ndarray) -> np.ndarray:
    """Points (N, 2) on a polyline (n, 2), `SPACING` apart or less."""
    step = np.hypot(*np.diff(line, axis=0).T)
    along = np.append(0.0, np.cumsum(step))
    at = np.linspace(0.0, along[-1], int(np.ceil(along[-1] / SPACING)) + 1)
    return np.column_stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)])


def _near(posed: PosedScans, points: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Scans in the order of time, and the points that are near each."""
    near = cKDTree(points).query_ball_point(posed.poses[:, :2], REACH)
    return [(k, np.array(some, int)) for k, some in enumerate(near)]


def _looks(
    posed: PosedScans, scan: int, points: np.ndarray, near: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (N,) of the points that one scan looks at, and whether it sees a wall there.

    Args:
        posed: All scans.
        scan: Number of the scan.
        points: (P, 2) [m] of all arcs.
        near: Numbers of those near the scan.
        width: (P,) [m] from a point within which a wall blocks it.
    """
    local = inverse_transform(posed.poses[scan], points[near])
    bearing = np.arctan2(local[:, 1], local[:, 0]) - posed.angles[0]
    beam = np.mod(bearing, 2 * np.pi) / (posed.angles[1] - posed.angles[0])
    within = beam < len(posed.angles) - 1
    left = np.where(within, beam, 0.0).astype(int)
    both = np.stack([left, left + 1])
    ranges, distance = posed.ranges[scan, both], np.hypot(local[:, 0], local[:, 1])
    within &= np.isfinite(ranges).all(axis=0)
    gap = np.linalg.norm(posed.ends[scan, both] - points[near][None], axis=-1)
    blocked = within & (gap.min(axis=0) < width[near])
    free = within & ~blocked & (ranges.min(axis=0) > distance + BEYOND)
    seen = blocked | free
    return near[seen], blocked[seen]
