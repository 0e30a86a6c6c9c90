"""Smooth paths for a robot from paths of cells, which stay clear of walls.

An elastic band: every point is drawn to the middle between two others of the path, first far ones,
then near ones, and pushed away from walls nearer than the clearance that is preferred. It moves
only to where the robot fits. What does not keep the robot's radius from the walls in the end is
put back, and what is around it.

References:
    Quinlan, Khatib (1993), Elastic bands: connecting path planning and control, ICRA.
"""

import numpy as np
from scipy import ndimage

from jaxslam.core import polylines
from jaxslam.simulation.wall_grid import PATH_SPACING, WallGrid

PREFERRED = 0.25  # [m] of clearance beyond the robot's radius, where there is as much
KEPT = 0.1  # [m] of it that smoothing never takes away: a robot cuts the corners of a path
REACHES = (0.8, 0.4, 0.2, 0.1, 0.1)  # [m] along the path to the points that draw
ROUNDS = 25  # of each
CHECK_SPACING = 0.02  # [m] of the points at which the result is checked


def smooth(grid: WallGrid, line: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Path (M, 2) [m], points `PATH_SPACING` apart or less, that keeps the robot's radius.

    Args:
        grid: The walls.
        line: (N, 2) [m] from cell to cell where the robot fits, the same point never twice in
            succession.
        fixed: (N,) bool, points that stay, the two ends among them.

    Raises:
        ValueError: The line itself comes too near to a wall.
    """
    moved = _relaxed(grid, line, fixed)
    reach = 2
    while True:
        path, at_point = _resampled(moved)
        bad = _too_near(grid, path, at_point)
        if not bad.any():
            return path
        if reach > 2 * len(line):
            break
        bad = ndimage.binary_dilation(bad, iterations=reach)
        moved, reach = np.where(bad[:, None], line, moved), 2 * reach
    raise ValueError(
        f"path comes nearer to a wall than robot_radius = {grid.robot_radius:g} m at its start or "
        "its end; move these away from the wall"
    )


def _relaxed(grid: WallGrid, line: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """The points of a path (N, 2) [m] after all rounds of smoothing."""
    field = np.stack([grid.clearance, *np.gradient(grid.clearance, grid.resolution)])
    index = np.arange(len(line))
    before = np.maximum.accumulate(np.where(fixed, index, 0))
    after = np.minimum.accumulate(np.where(fixed, index, len(line))[::-1])[::-1]
    least = np.hypot(grid.robot_radius, grid.resolution)
    least = np.clip(_values(grid, field[:1], line)[0], least, grid.robot_radius + KEPT)
    step = np.hypot(*np.diff(line, axis=0).T).mean()
    points = line.copy()
    for reach in REACHES:
        half = np.minimum(max(1, round(reach / step)), np.minimum(index - before, after - index))
        for _ in range(ROUNDS):
            clearance, *slope = _values(grid, field, points)
            away = np.clip(grid.robot_radius + PREFERRED - clearance, 0.0, grid.resolution)
            move = 0.5 * (points[index - half] + points[index + half]) - points
            move = 0.5 * (move + away[:, None] * np.stack(slope, axis=1))
            size = np.hypot(*move.T)
            move *= (np.minimum(size, grid.robot_radius) / np.maximum(size, 1e-9))[:, None]
            fits = (_values(grid, field[:1], points + move)[0] >= least) & (half > 0)
            points = np.where(fits[:, None], points + move, points)
    return points


def _values(grid: WallGrid, field: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values (K, N) of fields (K, H, W) at points (N, 2) [m], linear between cells."""
    cells = ((points - grid.corner) / grid.resolution - 0.5).T
    return np.stack([ndimage.map_coordinates(f, cells, order=1, mode="nearest") for f in field])


def _resampled(line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 2) [m] at equal distances along a path, and the length (N,) [m] at its points."""
    at_point = polylines.cumulative_lengths(line)
    count = int(np.ceil(at_point[-1] / PATH_SPACING)) + 1
    return polylines.resample(line, count), at_point


def _too_near(grid: WallGrid, path: np.ndarray, at_point: np.ndarray) -> np.ndarray:
    """Points (N,) bool of a line near which the path made of it comes too near to a wall.

    Args:
        grid: The walls.
        path: (M, 2) [m].
        at_point: (N,) [m] length of the line at its points.
    """
    checked = polylines.refine(path, CHECK_SPACING)
    clearance = grid.clearances(checked)
    gap = np.hypot(*np.diff(checked, axis=0).T).max(initial=0.0)
    limit = np.hypot(grid.robot_radius, 0.5 * gap)
    limit = np.full(len(checked), limit)
    limit[[0, -1]] = grid.robot_radius
    along = polylines.cumulative_lengths(checked)
    bad = along[clearance < limit]
    near = np.searchsorted(at_point, bad * (at_point[-1] / max(along[-1], 1e-9)))
    found = np.zeros(len(at_point), bool)
    found[np.clip(near, 0, len(at_point) - 1)] = True
    found[np.clip(near - 1, 0, len(at_point) - 1)] = True
    return found
