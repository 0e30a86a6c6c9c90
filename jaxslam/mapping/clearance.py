"""Distance to the nearest obstacle of an occupancy map, at any point.

Occupied cells are obstacles, but for islands so small that they are noise; so is all that lies
beyond the grid. Unknown cells are none, but a robot's centre stays out of them.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.core.maps import OccupancyMap
from jaxslam.core.se2_np import inverse_transform, transform
from jaxslam.mapping import medial_axis

MIN_OBSTACLE_SIZE = 0.1  # [m] obstacles in free space no wider than this are noise
MIN_UNKNOWN_SIZE = 0.3  # [m] unknown islands in free space no wider than this count as free


class ClearanceField(NamedTuple):
    """Distances to obstacles on the H x W cells of an occupancy map.

    Attributes:
        free: (H, W) bool.
        distance: (H, W) float [m] from the centre of a cell to the nearest obstacle.
        nearest_obstacle: (2, H, W) int index of that cell; it may lie one cell beyond the grid.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
    """

    free: np.ndarray
    distance: np.ndarray
    nearest_obstacle: np.ndarray
    resolution: float
    origin: np.ndarray

    def to_cells(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 2) [m, map frame] in cells; the centre of cell [i, j] is (i + .5, j + .5)."""
        return inverse_transform(self.origin, points) / self.resolution

    def to_map(self, cells: np.ndarray) -> np.ndarray:
        """The inverse of `to_cells`."""
        return transform(self.origin, cells * self.resolution)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (N, 2) [m, map frame] lie on the grid."""
        cells = np.floor(self.to_cells(points))
        return np.all((cells >= 0) & (cells < self.free.shape), axis=1)


def clearance_field(occupancy: OccupancyMap) -> ClearanceField:
    """Distances to the obstacles of an occupancy map, by one distance transform."""
    resolution = float(occupancy.resolution)
    free = medial_axis.free_space(
        occupancy.occupied,
        occupancy.free,
        min_obstacle_size=MIN_OBSTACLE_SIZE / resolution,
        min_unknown_size=MIN_UNKNOWN_SIZE / resolution,
    )
    open_cells = np.pad(free | ~occupancy.occupied, 1)
    to_centre, foot = medial_axis.nearest_obstacles(open_cells)
    return ClearanceField(
        free=free,
        distance=np.maximum(to_centre[1:-1, 1:-1] - 0.5, 0.0) * resolution,
        nearest_obstacle=foot[:, 1:-1, 1:-1] - 1,
        resolution=resolution,
        origin=np.asarray(occupancy.origin, np.float64),
    )


def clearance_at(field: ClearanceField, points: np.ndarray) -> np.ndarray:
    """Distance (N,) [m] of points (N, 2) [m, map frame] to obstacles; NaN beyond the grid."""
    inside = field.contains(points)
    clearance = np.full(len(points), np.nan)
    cells = field.to_cells(points[inside]) - 0.5
    clearance[inside] = field.resolution * obstacle_distance(cells, field.nearest_obstacle)
    return clearance


def widest_near(field: ClearanceField, points: np.ndarray) -> np.ndarray:
    """Largest clearance (N,) [m] within a cell of points (N, 2) [m]; NaN beyond the grid.

    A simplified polyline is up to a cell off the middle of a passage: this is what the passage
    leaves for a robot.
    """
    inside = field.contains(points)
    i, j = np.floor(field.to_cells(points[inside])).astype(int).T
    near = np.arange(-1, 2)
    rows = np.clip(i[:, None, None] + near[:, None], 0, field.free.shape[0] - 1)
    columns = np.clip(j[:, None, None] + near, 0, field.free.shape[1] - 1)
    widest = np.full(len(points), np.nan)
    widest[inside] = field.distance[rows, columns].max(axis=(1, 2))
    return widest


def obstacle_distance(cells: np.ndarray, nearest_obstacle: np.ndarray) -> np.ndarray:
    """Distance (N,) [cells] of points to the edge of the nearest obstacle.

    The nearest obstacle of a point is taken to be one of those of the four cells around it.

    Args:
        cells: (N, 2) [cells], whole numbers at the centres of cells.
        nearest_obstacle: (2, H, W) index of the nearest obstacle of each cell.
    """
    row, column = np.floor(cells).astype(int).T
    row, column = row + np.array([[0], [0], [1], [1]]), column + np.array([[0], [1], [0], [1]])
    row = np.clip(row, 0, nearest_obstacle.shape[1] - 1)
    column = np.clip(column, 0, nearest_obstacle.shape[2] - 1)
    offset = nearest_obstacle[:, row, column] - cells.T[:, None]
    return np.maximum(np.hypot(*offset).min(axis=0) - 0.5, 0.0)
