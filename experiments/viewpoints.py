"""Pairs of viewpoints in a drawn world or in a map of cells, and who sees what from them."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay

from experiments import truth
from jaxslam.core.batching import map_batches
from jaxslam.core.scan import Lidar
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.frontend import extract
from jaxslam.mapping import medial_axis
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting
from jaxslam.simulation.floor_plans import PLAN_WALLS
from jaxslam.simulation.worlds import World

ROOM = 0.35  # [m] from a viewpoint to the nearest wall
BEAMS = 5  # on each wall of a visible corner
RIM = np.linspace(-np.pi, np.pi, 36, endpoint=False)
POINTS = 5  # that stand for a side of a cell
DISTINCT = 0.4  # [rad] as `truth.DISTINCT`, for walls with steps; less than trusted nodes ask
SPECK, GAP = 0.1, 0.5  # [m] as `jaxslam map` has them: things no wider are noise


class Drawn:
    """A world of walls."""

    known_from = "exact, from the walls"
    kinds = {"node": JUNCTION, "corner": CORNER}

    def __init__(self, walls: np.ndarray):
        """Work out what is true of walls (S, 4) [m]."""
        self.max_walls = truth.solid(walls)
        self.free = truth.Free(self.max_walls)
        self.junctions = truth.junctions(self.max_walls, self.free).xy
        self.max_corners = truth.max_corners(self.max_walls)
        ends = self.max_walls.reshape(-1, 2)
        self.box = ends.min(axis=0), ends.max(axis=0)

    def holds(self, places: np.ndarray) -> np.ndarray:
        """Whether a robot fits at places (N, 2) [m]."""
        return self.free.holds(places) & (truth.clearance(places, self.max_walls) > ROOM)

    def in_sight(self, eyes: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Whether places (N, K, 2) are in sight of eyes (N, 2): (N, K) bool."""
        return truth.in_sight(eyes, places, self.max_walls)

    def ranges(self, poses: np.ndarray, scanner: Lidar) -> np.ndarray:
        """Exact ranges (N, R) [m] of scans from poses (N, 3)."""
        walls = np.pad(self.max_walls, ((0, PLAN_WALLS - len(self.max_walls)), (0, 0)))
        return np.asarray(_cast(jnp.asarray(walls, float), jnp.asarray(poses, float), scanner))


@partial(jax.jit, static_argnames="scanner")
def _cast(walls, poses, scanner: Lidar):
    one = lambda pose: ray_casting.cast(scanner, World(walls), pose).ranges
    return map_batches(one, poses, batch_size=extract.SCAN_BATCH)


class Cells:
    """A map of cells, in the frame of its first corner: what is not free is solid."""

    known_from = f"Voronoi diagram of {POINTS} points on each side of a solid cell"
    kinds = {"node": JUNCTION}  # its steps have corners, but none that one should see

    def __init__(self, occupied: np.ndarray, free: np.ndarray, resolution: float):
        """Work out what is true of cells (H, W) bool of a side of `resolution` [m]."""
        self.cell_size = resolution
        self.free = medial_axis.free_space(
            occupied, free, min_obstacle_size=SPECK / resolution, min_unknown_size=GAP / resolution
        )
        self.region = (
            medial_axis.free_configurations(self.free, clearance=ROOM / resolution).region == 1
        )
        self.junctions = _junctions(self.free) * resolution
        self.box = np.zeros(2), resolution * np.array(free.shape)

    def _at(self, cells: np.ndarray, places: np.ndarray) -> np.ndarray:
        index = np.floor(places / self.cell_size).astype(int)
        inside = np.all((index >= 0) & (index < cells.shape), axis=-1)
        return inside & cells[tuple(np.where(inside[..., None], index, 0).T)].T

    def holds(self, places: np.ndarray) -> np.ndarray:
        """Whether a robot fits at places (N, 2) [m] and can come from everywhere else."""
        return self._at(self.region, places)

    def in_sight(self, eyes: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Whether places (N, K, 2) are in sight of eyes (N, 2): (N, K) bool."""
        offset = places - eyes[:, None]
        away = np.hypot(*np.moveaxis(offset, -1, 0))
        beams = offset / np.maximum(away, 1e-9)[..., None]
        return away < self.reach(np.broadcast_to(eyes[:, None], beams.shape), beams)

    def ranges(self, poses: np.ndarray, scanner: Lidar) -> np.ndarray:
        """Exact ranges (N, R) [m] of scans from poses (N, 3)."""
        turn = (
            poses[:, 2:]
            + scanner.angle_min
            + scanner.angle_increment * np.arange(scanner.num_beams)
        )
        beams = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return self.reach(np.broadcast_to(poses[:, None, :2], beams.shape), beams)

    def reach(self, eyes: np.ndarray, beams: np.ndarray) -> np.ndarray:
        """How far (...) [m] beams, unit vectors (..., 2), get from eyes (..., 2); inf if out.

        They go from cell to cell, to the border of the first that is not free.

        References:
            Amanatides, Woo (1987), A fast voxel traversal algorithm for ray tracing.
        """
        eye, beam = eyes.reshape(-1, 2) / self.cell_size, beams.reshape(-1, 2)
        beam = np.where(np.abs(beam) < 1e-12, 1e-12, beam)
        index = np.floor(eye).astype(int)
        due = (index + (beam > 0) - eye) / beam  # [cells] of way to the next border, by axis
        every, step = np.abs(1 / beam), np.sign(beam).astype(int)
        result, left = np.full(len(eye), np.inf), np.arange(len(eye))
        while left.size:
            axis = np.argmin(due, axis=1)
            row = np.arange(len(left))
            way = due[row, axis]
            due[row, axis] += every[row, axis]
            index[row, axis] += step[row, axis]
            inside = np.all((index >= 0) & (index < self.free.shape), axis=1)
            open = inside & self.free[tuple(np.where(inside[:, None], index, 0).T)]
            result[left[inside & ~open]] = way[inside & ~open]
            left, due, index, every, step = (x[open] for x in (left, due, index, every, step))
        return self.cell_size * result.reshape(eyes.shape[:-1])


def _junctions(free: np.ndarray) -> np.ndarray:
    """Places (N, 2) [cells] in free cells (H, W) with three nearest points on borders of them."""
    solid = np.pad(~free, 1, constant_values=True)
    part = (np.arange(POINTS) + 0.5) / POINTS
    points = []
    for axis in (0, 1):
        index = np.argwhere(np.diff(solid, axis=axis))  # the border is beyond this cell
        side = np.zeros((len(index), POINTS, 2))
        side[..., axis], side[..., 1 - axis] = 1.0, part
        points.append((index[:, None] + side - 1.0).reshape(-1, 2))
    points = np.concatenate(points)
    a, b, c = np.moveaxis(points[Delaunay(points).simplices], 1, 0)
    cross = lambda p, q: p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    b, c = b - a, c - a
    size = 2.0 * cross(b, c)
    use = np.abs(size) > 1e-9
    a, b, c, size = a[use], b[use], c[use], size[use]
    bb, cc = np.sum(b**2, axis=1), np.sum(c**2, axis=1)
    centre = np.column_stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb])
    centre /= size[:, None]
    turn = [np.arctan2(*np.moveaxis(foot - centre, -1, 0)) for foot in (np.zeros(2), b, c)]
    gap = lambda p, q: np.abs((p - q + np.pi) % (2 * np.pi) - np.pi)
    spread = np.min([gap(turn[k], turn[k - 1]) for k in range(3)], axis=0)
    place = a + centre
    index = np.floor(place).astype(int)
    inside = np.all((index >= 0) & (index < free.shape), axis=1)
    inside &= free[tuple(np.where(inside[:, None], index, 0).T)]
    return place[inside & (spread > DISTINCT)]


class Scene(NamedTuple):
    """Viewpoints in a place, and what is seen from them."""

    place: Drawn | Cells
    poses: np.ndarray  # (2 N, 3): the first N and the second N are pairs
    ranges: np.ndarray  # (2 N, R) [m] exact
    corners: np.ndarray  # (2 N, C) bool, which of the corners of the place

    def take(self, pairs: np.ndarray) -> "Scene":
        """The scene of some pairs (N,) bool alone."""
        both = np.tile(pairs, 2)
        return Scene(self.place, self.poses[both], self.ranges[both], self.max_corners[both])


def scene(
    place: Drawn | Cells, rng: np.random.Generator, pairs: int, apart: float, config: Config
) -> Scene:
    """Pairs of viewpoints of any heading in a place, at most `apart` [m] from each other."""
    kept = np.zeros((0, 4))
    while len(kept) < pairs:
        first = rng.uniform(*place.box, (8 * pairs, 2))
        turn, part = rng.uniform(-np.pi, np.pi, 8 * pairs), rng.uniform(0, 1, 8 * pairs)
        away = np.column_stack([np.cos(turn), np.sin(turn)]) * apart * np.sqrt(part)[:, None]
        second = first + away
        good = place.holds(first) & place.holds(second)
        good[good] = place.in_sight(first[good], second[good][:, None])[:, 0]
        kept = np.vstack([kept, np.hstack([first, second])[good]])
    places = kept[:pairs].reshape(pairs, 2, 2).transpose(1, 0, 2).reshape(-1, 2)
    poses = np.column_stack([places, rng.uniform(-np.pi, np.pi, 2 * pairs)])
    corners = np.zeros((2 * pairs, 0), bool)
    if "corner" in place.filter.landmark_kinds:
        corners = visible_corners(place, poses, config)
    return Scene(place, poses, place.ranges(poses, config.frontend.lidar), corners)


def _turns(poses: np.ndarray) -> np.ndarray:
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1)


def to_world(poses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Places (N, M, 2) of the frames of poses (N, 3) in the world."""
    return np.einsum("nij,nmj->nmi", _turns(poses), places) + poses[:, None, :2]


def turned(poses: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Covariances (N, M, 2, 2) of the frames of poses (N, 3) in the world."""
    turn = _turns(poses)
    return np.einsum("nij,nmjk,nlk->nmil", turn, cov, turn)


def in_view(poses: np.ndarray, places: np.ndarray, config: Config) -> np.ndarray:
    """Whether places (N, K, 2) [m, world] are in the view of poses (N, 3), and on their grid."""
    offset = places - poses[:, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, None, 2]
    bearing = (bearing - config.frontend.lidar.angle_min) % (2 * np.pi)
    away = np.hypot(offset[..., 0], offset[..., 1])
    reach = min(
        config.frontend.lidar.range_max, config.frontend.grid.x_max, config.frontend.grid.y_half
    )
    return (
        bearing <= (config.frontend.lidar.num_beams - 1) * config.frontend.lidar.angle_increment
    ) & (away < reach)


def visible_circles(place, poses, centres, radii, config: Config) -> np.ndarray:
    """Whether circles, centres (N, 2) and radii (N,), are wholly in view of poses (N, 3)."""
    rim = np.stack([np.cos(RIM), np.sin(RIM)], axis=-1)
    rim = centres[:, None] + 0.95 * radii[:, None, None] * rim
    seen = in_view(poses, rim, config).all(axis=-1)
    seen[seen] = place.in_sight(poses[seen, :2], rim[seen]).all(axis=-1)
    return seen


def visible_corners(place: Drawn, poses: np.ndarray, config: Config) -> np.ndarray:
    """Whether poses (N, 3) see corners, and either wall of them with five beams: (N, C) bool."""
    turn = config.frontend.lidar.angle_min + config.frontend.lidar.angle_increment * np.arange(
        config.frontend.lidar.num_beams
    )
    corner, along = place.max_corners
    result = np.zeros((len(poses), len(corner)), bool)
    for n, pose in enumerate(poses):
        near = corner + 1e-6 * (pose[:2] - corner)
        seen = place.in_sight(pose[None, :2], near[None])
        seen = np.flatnonzero((seen & in_view(pose[None], near[None], config))[0])
        ends = truth.hits(pose[:2], pose[2] + turn, place.max_walls)
        offset = (ends[:, None] - corner[seen])[:, :, None]  # (R, C, 1, 2)
        ahead = np.sum(offset * along[seen], axis=-1)
        across = np.sum(offset * along[seen][..., ::-1] * [1, -1], axis=-1)
        on = (ahead > 0) & (ahead < 1.0) & (np.abs(across) < 1e-4)
        result[n, seen] = np.all(on.sum(axis=0) >= BEAMS, axis=-1)
    return result
