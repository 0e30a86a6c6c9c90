"""Shortest paths of a disc-shaped robot through free space, from a point to many others."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from jaxslam.mapping.arc_points import ArcPoints
from jaxslam.mapping.clearance import ClearanceField

SAMPLES = 2  # points of a line that are checked, per cell
AT_ONCE = 2**20  # such points that are checked together
BACKWARDS = -0.1  # cosine to the direction of a one-way arc below which a step goes against it
NEAR_ARC = 0.5  # [m] from a one-way arc, at least, where its direction holds


class FreeSpace(NamedTuple):
    """Where the centre of a robot may be.

    Attributes:
        free: (H, W) bool.
        field: Distances to obstacles on these cells.
        directions: Directions of one-way arcs, if there are any.
    """

    free: np.ndarray
    field: ClearanceField
    directions: "Directions | None"


class Directions(NamedTuple):
    """Directions of travel near arcs; beside an arc for both directions there is none.

    Attributes:
        tree: Of the middles of the E edges of the arcs.
        unit: (E, 2) direction of travel, map frame; zero on arcs for both.
        width: (E,) [m] distance from the arc within which it holds.
    """

    tree: cKDTree
    unit: np.ndarray
    width: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """Directions (N, 2) at points (N, 2) [m]; zero where there is none."""
        distance, edge = self.tree.query(points)
        return np.where((distance <= self.width[edge])[:, None], self.unit[edge], 0.0)


def free_space(field: ClearanceField, points: ArcPoints, robot_radius: float) -> FreeSpace:
    """Where a robot may be, and the direction in which it may go there."""
    directions = None
    if points.directed.any():
        start, end = points.xy[points.edges[:, 0]], points.xy[points.edges[:, 1]]
        unit = (end - start) / np.maximum(points.length, 1e-9)[:, None]
        directions = Directions(
            tree=cKDTree(0.5 * (start + end)),
            unit=np.where(points.directed[:, None], unit, 0.0),
            width=np.fmax(NEAR_ARC, np.minimum(points.width, 1e3)),
        )
    return FreeSpace(field.free & (field.distance >= robot_radius - 1e-9), field, directions)


def component_at(space: FreeSpace, points: np.ndarray) -> np.ndarray:
    """Connected component (N,) of free space that points (N, 2) [m] lie in, 0 for none."""
    label, _ = ndimage.label(space.free)  # by sides, as steps do not cut corners
    cells = np.floor(space.field.to_cells(points)).astype(int)
    inside = space.field.contains(points)
    return np.where(inside, label[tuple(np.where(inside[:, None], cells, 0).T)], 0)


class FreePaths(NamedTuple):
    """Shortest paths between one point and K others.

    Attributes:
        length: (K,) [m], of a straight line where it is free; infinite where no path was found.
        straight: (K,) bool, whether it is free.
        cell: (K,) int of the window that each of the others lies in.
        previous: Cells of the window: the one before each on its path, negative at the first.
        corner: (2,) cell [i, j] of the grid in the corner of the window.
        columns: Number of columns of the window.
        sign: 1 if the paths lead from the one point, -1 if they lead to it.
    """

    length: np.ndarray
    straight: np.ndarray
    cell: np.ndarray
    previous: np.ndarray
    corner: np.ndarray
    columns: int
    sign: int


def find_paths(
    space: FreeSpace, point: np.ndarray, others: np.ndarray, *, reach: float, sign: int
) -> FreePaths:
    """Shortest paths between one point and others, in a window around it.

    Args:
        space: Where the robot may be.
        point: (2,) [m, map frame] in it.
        others: (K, 2) [m, map frame].
        reach: [m] half the side of the window.
        sign: 1 for paths from the one point, -1 for paths to it.
    """
    field = space.field
    at = np.floor(field.to_cells(point[None])[0]).astype(int)
    half = int(np.ceil(reach / field.resolution))
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, space.free.shape)
    window = space.free[low[0] : high[0], low[1] : high[1]]
    graph = _grid_graph(space, window, low, sign)
    first = int((at - low) @ [window.shape[1], 1])
    length, previous = csgraph.dijkstra(graph, indices=first, return_predecessors=True)
    cells = np.floor(field.to_cells(others)).astype(int)
    inside = np.all((cells >= low) & (cells < high), axis=1)
    cell = np.where(inside, (cells - low) @ [window.shape[1], 1], 0)
    length = np.where(inside, length[cell], np.inf)
    straight = np.zeros(len(others), bool)
    known = np.flatnonzero(np.isfinite(length))
    straight[known] = is_free(space, point, others[known], sign)
    direct = np.hypot(*(others - point).T)
    length = np.where(straight, direct, np.maximum(length, direct))
    return FreePaths(length, straight, cell, previous, low, window.shape[1], sign)


def path_to(
    space: FreeSpace, paths: FreePaths, point: np.ndarray, others: np.ndarray, k: int
) -> np.ndarray:
    """Polyline (n, 2) [m] of the path to other k, in the direction of travel, made taut."""
    line = [others[k], point]
    if not paths.straight[k]:
        cells, cell = [], int(paths.cell[k])
        while cell >= 0:
            cells.append(divmod(cell, paths.columns))
            cell = int(paths.previous[cell])
        middle = space.field.to_map(np.array(cells[1:-1]).reshape(-1, 2) + paths.corner + 0.5)
        line = _taut(space, np.concatenate([others[k][None], middle, point[None]]), -paths.sign)
    return np.array(line[::-1] if paths.sign > 0 else line)


def _taut(space: FreeSpace, line: np.ndarray, sign: int) -> list[np.ndarray]:
    """The points of a path (n, 2) that are left when it is pulled straight."""
    kept = [line[0]]
    for point, following in zip(line[1:-1], line[2:], strict=True):
        if not is_free(space, kept[-1], following[None], sign)[0]:
            kept.append(point)
    return [*kept, line[-1]]


def is_free(space: FreeSpace, point: np.ndarray, others: np.ndarray, sign: int) -> np.ndarray:
    """Whether the straight lines between a point and others (K, 2) [m] are free: (K,) bool."""
    start, ends = space.field.to_cells(point[None])[0], space.field.to_cells(others)
    free = np.zeros(len(others), bool)
    longest = np.abs(ends - start).max(initial=1.0)
    count = 2 + int(np.ceil(SAMPLES * longest))
    fraction = np.linspace(0.0, 1.0, count)[:, None, None]
    chunk = max(1, AT_ONCE // count)
    for first in range(0, len(others), chunk):
        samples = start + fraction * (ends[first : first + chunk] - start)
        cells = np.floor(samples).astype(int)
        inside = np.all((cells >= 0) & (cells < space.free.shape), axis=2)
        cells = np.where(inside[..., None], cells, 0)
        i, j = cells[..., 0], cells[..., 1]
        allowed = inside & space.free[i, j]
        # Not between two cells that touch at a corner.
        allowed[1:] &= space.free[i[1:], j[:-1]] & space.free[i[:-1], j[1:]]
        if space.directions is not None:
            step = sign * (others[first : first + chunk] - point)
            step /= np.maximum(np.hypot(*step.T), 1e-9)[:, None]
            here = space.field.to_map(samples.reshape(-1, 2))
            unit = space.directions.at(here).reshape(samples.shape)
            allowed &= np.sum(unit * step, axis=2) >= BACKWARDS
        free[first : first + chunk] = allowed.all(axis=0)
    return free


def _grid_graph(
    space: FreeSpace, window: np.ndarray, corner: np.ndarray, sign: int
) -> sparse.csr_array:
    """Steps [m] between the eight neighbours of the free cells of a window (h, w)."""
    h, w = window.shape
    index = np.arange(h * w).reshape(h, w)
    sources, targets, lengths = [], [], []
    units = _directions(space, window, corner)
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = np.s_[: h - i, max(0, -j) : w - max(0, j)]
        b = np.s_[i:, max(0, j) : w + min(0, j)]
        allowed = window[a] & window[b]
        if i and j:  # not between two cells that touch at a corner
            beside = np.s_[i:, a[1]], np.s_[: h - i, b[1]]
            allowed &= window[beside[0]] & window[beside[1]]
        size = float(np.hypot(i, j))
        for one, two, step in ((a, b, (i, j)), (b, a, (-i, -j))):
            may = allowed
            if units is not None:
                forward = sign * np.stack([units[one] @ step, units[two] @ step])
                may = may & (forward.min(axis=0) >= BACKWARDS * size)
            sources.append(index[one][may])
            targets.append(index[two][may])
            lengths.append(np.full(sources[-1].size, size * space.field.resolution))
    pairs = np.concatenate(sources), np.concatenate(targets)
    return sparse.csr_array((np.concatenate(lengths), pairs), shape=(h * w, h * w))


def _directions(space: FreeSpace, window: np.ndarray, corner: np.ndarray) -> np.ndarray | None:
    """Directions of travel (h, w, 2) on the cells of a window, in the axes of the grid."""
    if space.directions is None:
        return None
    cells = np.indices(window.shape).reshape(2, -1).T + corner + 0.5
    units = space.directions.at(space.field.to_map(cells))
    cos, sin = np.cos(space.field.origin[2]), np.sin(space.field.origin[2])
    return (units @ np.array([[cos, -sin], [sin, cos]])).reshape(*window.shape, 2)
