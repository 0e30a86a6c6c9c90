"""Walls on a grid of cells: how far each cell is from them, and where a robot can be.

    walls -> samples -> occupied cells -> distances (`mapping.medial_axis`), by the samples
    themselves where it matters -> cells where the robot fits -> connected regions

The distances are never larger than the true ones where these decide, so a path from cell to cell
keeps the robot's radius from every wall; the inside of a thick wall is a region of its own, or
none.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxslam.core.maps import OccupancyMap, check_occupancy
from jaxslam.core.se2_np import inverse_transform, transform
from jaxslam.core.types import as_float64, as_size
from jaxslam.mapping import medial_axis

RESOLUTION = 0.05  # [m] side of a cell, at most a quarter of the robot's radius
MAX_CELLS = 4_000_000  # of a grid; larger worlds have larger cells
MAX_RESOLUTION = 0.75  # [robot_radius] side of a cell, at most
PATH_SPACING = 0.02  # [m] between points of a path: pure pursuit looks for the nearest of 40
SNAP = 3.0  # [cells] from a given point to the cell that stands for it, at most
_EIGHT = np.ones((3, 3), bool)


class WallGrid(NamedTuple):
    """Walls on H x W cells; i grows with x, j with y.

    Attributes:
        occupied: (H, W) bool, cells that a wall passes through; those not free in a map, too.
        clearance: (H, W) [m] distance from the centre of a cell to the nearest wall.
        nearest_wall: (2, H, W) int index of the occupied cell that is nearest.
        region: (H, W) int connected region of the cells where the robot fits; 0: it does not fit.
        outside: Numbers of the regions around all walls, or at the border of a map.
        samples: Points of the walls.
        spacing: [m] between two samples of a wall, at most.
        resolution: [m] side of a cell.
        corner: (2,) [m, world] of cell [0, 0].
        robot_radius: [m].
    """

    occupied: np.ndarray
    clearance: np.ndarray
    nearest_wall: np.ndarray
    region: np.ndarray
    outside: np.ndarray
    samples: cKDTree
    spacing: float
    resolution: float
    corner: np.ndarray
    robot_radius: float

    def to_world(self, cells: np.ndarray) -> np.ndarray:
        """Centres (N, 2) [m] of cells (N, 2)."""
        return (cells + 0.5) * self.resolution + self.corner

    def clearances(self, points: np.ndarray) -> np.ndarray:
        """Distance (N,) [m] of points (N, 2) from the walls, never more than it is."""
        distance = self.samples.query(points)[0]
        return np.sqrt(np.maximum(distance**2 - (0.5 * self.spacing) ** 2, 0.0))


def wall_grid(
    walls: ArrayLike,
    robot_radius: float,
    resolution: float | None = None,
    occupancy: OccupancyMap | None = None,
) -> WallGrid:
    """The grid of a world.

    Args:
        walls: (S, 4) [m] ends x1, y1, x2, y2; those without a length count for nothing.
        robot_radius: [m], above 0.
        resolution: [m] side of a cell; None: `RESOLUTION`, less for a small robot, more for a world
            of more than `MAX_CELLS` such cells.
        occupancy: Map in the frame of the walls: the robot is where it is free, but for unknown
            islands smaller than the robot. None: it may be anywhere.

    Raises:
        ValueError: There is no wall, or an argument has another type, shape or range, or the world
            is too large for cells as small as the robot needs.
    """
    segments = as_float64("walls", walls, ("S", 4))
    if not np.isfinite(segments).all():
        raise ValueError("walls holds numbers that are not finite")
    segments = segments[np.hypot(*(segments[:, 2:] - segments[:, :2]).T) > 1e-9]
    if not len(segments):
        raise ValueError("walls holds no wall with a length")
    radius = as_size("robot_radius", robot_radius, positive=True)
    free = None if occupancy is None else _free_map(check_occupancy(occupancy), radius)
    edge = np.zeros((0, 2)) if free is None else _edge(free)
    ends = np.concatenate([segments.reshape(-1, 2), edge])
    low, high = ends.min(axis=0), ends.max(axis=0)
    size = _cell_size(high - low, radius, resolution)
    need = np.sqrt(radius**2 + 0.5 * size**2 + (0.5 * PATH_SPACING) ** 2)
    margin = need + 3 * size
    shape = np.ceil((high - low + 2 * margin) / size).astype(int)
    points = np.concatenate([_sampled(segments, 0.5 * size), edge])
    corner = low - margin
    occupied = np.zeros(shape, bool)
    occupied[tuple(np.floor((points - corner) / size).astype(int).T)] = True
    distance, nearest = medial_axis.nearest_obstacles(~occupied)
    grid = WallGrid(
        occupied=occupied,
        clearance=distance * size,
        nearest_wall=nearest,
        region=np.zeros(0, int),
        outside=np.zeros(0, int),
        samples=cKDTree(points),
        spacing=0.5 * size,
        resolution=size,
        corner=corner,
        robot_radius=radius,
    )
    # A wall is up to 0.71 cells from the centre of its cell: nearer than that, by the samples.
    near = np.nonzero(np.abs(grid.clearance - need) < 0.75 * size)
    grid.clearance[near] = grid.clearances(grid.to_world(np.column_stack(near)))
    if free is None:
        region, _ = ndimage.label(grid.clearance >= need, structure=_EIGHT)
        return grid._replace(region=region, outside=region[:1, 0])
    kind = _kinds(free, grid.to_world(np.indices(shape).reshape(2, -1).T)).reshape(shape)
    grid.clearance[kind == 0] = 0.0
    region, _ = ndimage.label(grid.clearance >= need, structure=_EIGHT)
    at_border = np.unique(region[kind == 2])
    enclosed = np.setdiff1d(region, [0, *at_border])
    outside = at_border if len(enclosed) else np.zeros(0, int)
    return grid._replace(occupied=occupied | (kind == 0), region=region, outside=outside)


def _free_map(occupancy: OccupancyMap, radius: float) -> OccupancyMap:
    """A map whose unknown islands smaller than a robot of a radius [m] are free."""
    free = medial_axis.free_space(
        occupancy.occupied,
        occupancy.free,
        min_obstacle_size=0.0,
        min_unknown_size=2 * radius / occupancy.resolution,
    )
    return occupancy._replace(free=free)


def _edge(free: OccupancyMap) -> np.ndarray:
    """Centres (P, 2) [m] of the cells beside the free ones of a map, beyond its border, too."""
    cells = np.pad(free.free, 2)
    cells = np.argwhere(ndimage.binary_dilation(cells, _EIGHT) & ~cells)
    return transform(free.origin, (cells - 1.5) * free.resolution)


def _kinds(free: OccupancyMap, points: np.ndarray) -> np.ndarray:
    """For points (N, 2) [m]: 1 where a map is free, 2 where it is at its border, 0 where not."""
    at = np.floor(inverse_transform(free.origin, points) / free.resolution).astype(int)
    last = np.array(free.free.shape) - 1
    inside = np.all((at >= 0) & (at <= last), axis=1)
    border = np.any((at <= 1) | (at >= last - 1), axis=1)
    is_free = inside & free.free[tuple(np.clip(at, 0, last).T)]
    return is_free * np.where(border, 2, 1)


def _cell_size(extent: np.ndarray, radius: float, resolution: float | None) -> float:
    """Side [m] of a cell; ValueError where the cells are too many or too large for the robot."""
    smallest = float(np.sqrt(np.prod(extent + 4 * radius) / MAX_CELLS))
    if resolution is None:
        size = max(min(RESOLUTION, 0.25 * radius), smallest)
    else:
        size = as_size("resolution", resolution, positive=True)
    if size < 0.999 * smallest or size > MAX_RESOLUTION * radius:
        raise ValueError(
            f"walls span {extent[0]:.4g} x {extent[1]:.4g} m; with cells of {size:.2g} m these are "
            f"more than {MAX_CELLS} cells, or too large ones for robot_radius = {radius:g} m: give "
            f"a part of the walls, or another resolution from {smallest:.2g} m on"
        )
    return size


def _sampled(walls: np.ndarray, spacing: float) -> np.ndarray:
    """Points (P, 2) [m] of walls (S, 4), their ends among them."""
    length = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    count = np.ceil(length / spacing).astype(int) + 1
    wall = np.repeat(np.arange(len(walls)), count)
    number = np.arange(len(wall)) - np.repeat(np.cumsum(count) - count, count)
    fraction = (number / (count[wall] - 1))[:, None]
    return np.asarray(walls[wall, :2] + fraction * (walls[wall, 2:] - walls[wall, :2]))


def choose_region(grid: WallGrid, start: np.ndarray | None) -> tuple[np.ndarray, tuple[str, ...]]:
    """The cells (H, W) bool where the robot is, and notes on what was chosen.

    Args:
        grid: The walls.
        start: (2,) [m] where it starts; None: in an enclosed region, the one with the most space
            and walls. The inside of a large block has more space, but fewer walls, than the rooms
            around it; the inside of a thick wall has more walls, but less space.

    Raises:
        ValueError: It does not fit at the start, or, without one, in no enclosed region.
    """
    area = np.bincount(grid.region.ravel()) * grid.resolution**2
    area[0] = 0.0
    enclosed = area.copy()
    enclosed[grid.outside] = 0.0
    if start is None:
        chosen = int((np.sqrt(enclosed) * _walls_beside(grid)).argmax())
        if not enclosed[chosen]:
            raise ValueError(
                "walls enclose no free space in which a robot with robot_radius = "
                f"{grid.robot_radius:g} m fits; give start = (x, y) where it begins"
            )
        note = f"chosen: the main region that the walls enclose, {area[chosen]:.1f} m^2"
    else:
        chosen = int(grid.region[tuple(cell_at(grid, start, "start"))])
        kind = "not enclosed by walls" if chosen in grid.outside else "enclosed by walls"
        note = f"chosen: the region of the given point, {area[chosen]:.1f} m^2, {kind}"
    notes = [f"{note}, for the centre of a robot of {grid.robot_radius:g} m radius"]
    left = np.delete(enclosed, [0, chosen])
    if left.max(initial=0.0) >= 1.0:
        count = int(np.sum(left >= 1.0))
        regions = "region" if count == 1 else "regions"
        notes.append(
            f"left out: {count} more enclosed {regions} of 1 m^2 or more, the largest of "
            f"{left.max():.1f} m^2"
        )
    if grid.resolution > RESOLUTION:
        notes.append(f"cells of {grid.resolution:.2g} m: narrow passages may be missed")
    return grid.region == chosen, tuple(notes)


def _walls_beside(grid: WallGrid) -> np.ndarray:
    """Length (K + 1,) [m] of the walls beside each region, by the cells that they pass through."""
    reach = grid.robot_radius + 3 * grid.resolution
    near = (grid.region > 0) & (grid.clearance < reach)
    i, j = grid.nearest_wall[:, near]
    cell = i.astype(np.int64) * grid.region.shape[1] + j
    pairs = np.unique(grid.region[near] * np.int64(grid.region.size) + cell)
    count = np.bincount(pairs // grid.region.size, minlength=int(grid.region.max()) + 1)
    return np.asarray(count * grid.resolution)


def cell_at(grid: WallGrid, point: np.ndarray, name: str) -> np.ndarray:
    """The cell (2,) where the robot fits that stands for a point (2,) [m].

    Raises:
        ValueError: The point is outside of the grid, or too near to a wall; `name` is its name.
    """
    where = f"{name} ({point[0]:g}, {point[1]:g})"
    at = (point - grid.corner) / grid.resolution
    if (at < 0).any() or (at >= grid.region.shape).any():
        raise ValueError(f"{where} is not within the walls' bounding box")
    clearance = float(grid.clearances(point[None])[0])
    low = np.maximum(np.floor(at - SNAP), 0).astype(int)
    high = np.floor(at + SNAP + 1).astype(int)
    cells = np.argwhere(grid.region[low[0] : high[0], low[1] : high[1]]) + low
    gap = np.hypot(*(cells + 0.5 - at).T)
    if clearance < grid.robot_radius or gap.min(initial=np.inf) > SNAP:
        raise ValueError(
            f"{where} is in a wall or {clearance:.2f} m from one; a robot with robot_radius = "
            f"{grid.robot_radius:g} m does not fit there"
        )
    return np.asarray(cells[gap.argmin()])
