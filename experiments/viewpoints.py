"""Pairs of viewpoints in a world of walls or in a map of cells, and visibility from them."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay

from experiments import ground_truth
from jaxslam.core.batching import map_batches
from jaxslam.core.scan import Lidar
from jaxslam.core.types import CORNER, JUNCTION, Array
from jaxslam.frontend import extract
from jaxslam.frontend.config import FrontendConfig
from jaxslam.mapping import medial_axis
from jaxslam.simulation import ray_casting
from jaxslam.simulation.floor_plans import PLAN_WALLS
from jaxslam.simulation.worlds import World

MIN_CLEARANCE = 0.35  # [m] from a viewpoint to the nearest wall
BEAMS = 5  # on each wall of a visible corner
RIM = np.linspace(-np.pi, np.pi, 36, endpoint=False)
POINTS = 5  # samples of a side of a cell
MIN_FOOT_ANGLE = 0.4  # [rad] as in `ground_truth`, for walls with steps
# [m] as in `jaxslam map`: smaller obstacles and unknown areas are noise.
MIN_OBSTACLE_SIZE, MIN_UNKNOWN_SIZE = 0.1, 0.5


class WallWorld:
    """A world of walls."""

    known_from = "exact, from the walls"
    kinds = {"node": JUNCTION, "corner": CORNER}

    def __init__(self, walls: np.ndarray):
        """Compute the ground truth of walls (S, 4) [m]."""
        self.walls = ground_truth.without_padding(walls)
        self.free = ground_truth.FreeSpace(self.walls)
        self.junctions = ground_truth.junctions(self.walls, self.free).xy
        self.corners = ground_truth.corners(self.walls)
        ends = self.walls.reshape(-1, 2)
        self.box = ends.min(axis=0), ends.max(axis=0)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether a robot fits at points (N, 2) [m]."""
        clearance = ground_truth.clearance(points, self.walls)
        return self.free.contains(points) & (clearance > MIN_CLEARANCE)

    def in_sight(self, eyes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Whether points (N, K, 2) are in sight of eyes (N, 2): (N, K) bool."""
        return ground_truth.in_sight(eyes, points, self.walls)

    def ranges(self, poses: np.ndarray, lidar: Lidar) -> np.ndarray:
        """Exact ranges (N, R) [m] of scans from poses (N, 3)."""
        walls = np.pad(self.walls, ((0, PLAN_WALLS - len(self.walls)), (0, 0)))
        return np.asarray(_cast(lidar, jnp.asarray(walls, float), jnp.asarray(poses, float)))


@partial(jax.jit, static_argnames="lidar")
def _cast(lidar: Lidar, walls: Array, poses: Array) -> Array:
    def ranges(pose: Array) -> Array:
        return ray_casting.cast(lidar, World(walls), pose).ranges

    return map_batches(ranges, poses, batch_size=extract.SCAN_BATCH)


class CellWorld:
    """A map of cells, in the frame of its first corner: cells that are not free are solid."""

    known_from = f"Voronoi diagram of {POINTS} points on each side of a solid cell"
    kinds = {"node": JUNCTION}  # corners of its steps are no landmarks

    def __init__(self, occupied: np.ndarray, free: np.ndarray, resolution: float):
        """Compute the ground truth of cells (H, W) bool of side `resolution` [m]."""
        self.cell_size = resolution
        self.free = medial_axis.free_space(
            occupied,
            free,
            min_obstacle_size=MIN_OBSTACLE_SIZE / resolution,
            min_unknown_size=MIN_UNKNOWN_SIZE / resolution,
        )
        configurations = medial_axis.free_configurations(
            self.free, clearance=MIN_CLEARANCE / resolution
        )
        self.region = configurations.region == 1
        self.junctions = _junctions(self.free) * resolution
        self.box = np.zeros(2), resolution * np.array(free.shape)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether a robot fits at points (N, 2) [m] and can get there from everywhere else."""
        index = np.floor(points / self.cell_size).astype(int)
        inside = np.all((index >= 0) & (index < self.region.shape), axis=-1)
        return inside & self.region[tuple(np.where(inside[:, None], index, 0).T)]

    def in_sight(self, eyes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Whether points (N, K, 2) are in sight of eyes (N, 2): (N, K) bool."""
        offset = points - eyes[:, None]
        away = np.hypot(*np.moveaxis(offset, -1, 0))
        beams = offset / np.maximum(away, 1e-9)[..., None]
        return away < self.distance_along(np.broadcast_to(eyes[:, None], beams.shape), beams)

    def ranges(self, poses: np.ndarray, lidar: Lidar) -> np.ndarray:
        """Exact ranges (N, R) [m] of scans from poses (N, 3)."""
        steps = lidar.angle_increment * np.arange(lidar.num_beams)
        angles = poses[:, 2:] + lidar.angle_min + steps
        beams = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return self.distance_along(np.broadcast_to(poses[:, None, :2], beams.shape), beams)

    def distance_along(self, eyes: np.ndarray, beams: np.ndarray) -> np.ndarray:
        """Length (...) [m] of beams, unit vectors (..., 2), from eyes (..., 2); inf if they leave.

        They go from cell to cell, to the border of the first that is not free.

        References:
            Amanatides, Woo (1987), A fast voxel traversal algorithm for ray tracing.
        """
        eye, beam = eyes.reshape(-1, 2) / self.cell_size, beams.reshape(-1, 2)
        beam = np.where(np.abs(beam) < 1e-12, 1e-12, beam)
        index = np.floor(eye).astype(int)
        due = (index + (beam > 0) - eye) / beam  # [cells] distance to the next border, by axis
        spacing, step = np.abs(1 / beam), np.sign(beam).astype(int)
        result, active = np.full(len(eye), np.inf), np.arange(len(eye))
        while active.size:
            axis = np.argmin(due, axis=1)
            row = np.arange(len(active))
            distance = due[row, axis]
            due[row, axis] += spacing[row, axis]
            index[row, axis] += step[row, axis]
            inside = np.all((index >= 0) & (index < self.free.shape), axis=1)
            is_free = inside & self.free[tuple(np.where(inside[:, None], index, 0).T)]
            blocked = inside & ~is_free
            result[active[blocked]] = distance[blocked]
            active, due, index = active[is_free], due[is_free], index[is_free]
            spacing, step = spacing[is_free], step[is_free]
        return self.cell_size * result.reshape(eyes.shape[:-1])


def _junctions(free: np.ndarray) -> np.ndarray:
    """Points (N, 2) [cells] in free cells (H, W) with three nearest points on their borders."""
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
    b, c = b - a, c - a
    size = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    use = np.abs(size) > 1e-9
    a, b, c, size = a[use], b[use], c[use], size[use]
    bb, cc = np.sum(b**2, axis=1), np.sum(c**2, axis=1)
    centre = np.column_stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb])
    centre /= size[:, None]
    angles = [np.arctan2(*np.moveaxis(foot - centre, -1, 0)) for foot in (np.zeros(2), b, c)]
    gaps = [np.abs(wrap_angle(angles[k] - angles[k - 1])) for k in range(3)]
    vertices = a + centre
    index = np.floor(vertices).astype(int)
    inside = np.all((index >= 0) & (index < free.shape), axis=1)
    inside &= free[tuple(np.where(inside[:, None], index, 0).T)]
    return vertices[inside & (np.min(gaps, axis=0) > MIN_FOOT_ANGLE)]


AnyWorld = WallWorld | CellWorld


class Viewpoints(NamedTuple):
    """Pairs of viewpoints in a world, and their exact scans.

    Attributes:
        world: The world.
        poses: (2 N, 3) the first N and the second N are pairs.
        ranges: (2 N, R) [m] exact.
        corners: (2 N, C) bool, visible corners of the world.
    """

    world: AnyWorld
    poses: np.ndarray
    ranges: np.ndarray
    corners: np.ndarray

    def take(self, pairs: np.ndarray) -> "Viewpoints":
        """Some pairs (N,) bool alone."""
        both = np.tile(pairs, 2)
        return Viewpoints(self.world, self.poses[both], self.ranges[both], self.corners[both])


def sample_viewpoints(
    config: FrontendConfig,
    world: AnyWorld,
    rng: np.random.Generator,
    pairs: int,
    max_distance: float,
) -> Viewpoints:
    """Pairs of viewpoints of any heading, at most `max_distance` [m] from each other."""
    kept = np.zeros((0, 4))
    while len(kept) < pairs:
        first = rng.uniform(*world.box, (8 * pairs, 2))
        angle, area = rng.uniform(-np.pi, np.pi, 8 * pairs), rng.uniform(0, 1, 8 * pairs)
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        second = first + direction * max_distance * np.sqrt(area)[:, None]
        good = world.contains(first) & world.contains(second)
        good[good] = world.in_sight(first[good], second[good][:, None])[:, 0]
        kept = np.vstack([kept, np.hstack([first, second])[good]])
    xy = kept[:pairs].reshape(pairs, 2, 2).transpose(1, 0, 2).reshape(-1, 2)
    poses = np.column_stack([xy, rng.uniform(-np.pi, np.pi, 2 * pairs)])
    corners = np.zeros((2 * pairs, 0), bool)
    if "corner" in world.kinds:
        corners = visible_corners(config, world, poses)
    return Viewpoints(world, poses, world.ranges(poses, config.lidar), corners)


def _rotations(poses: np.ndarray) -> np.ndarray:
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1)


def rotate_cov(poses: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Covariances (N, M, 2, 2) of the base_link frames of poses (N, 3), in the world frame."""
    rotation = _rotations(poses)
    return np.einsum("nij,nmjk,nlk->nmil", rotation, cov, rotation)


def transform_points(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, M, 2) of the base_link frames of poses (N, 3), in the world frame."""
    return np.einsum("nij,nmj->nmi", _rotations(poses), points) + poses[:, None, :2]


def in_view(config: FrontendConfig, poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (N, K, 2) [m, world] are in the field of view of poses (N, 3), on the grid."""
    lidar, grid = config.lidar, config.grid
    offset = points - poses[:, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, None, 2]
    bearing = (bearing - lidar.angle_min) % (2 * np.pi)
    distance = np.hypot(offset[..., 0], offset[..., 1])
    in_range = distance < min(lidar.range_max, grid.x_max, grid.y_half)
    return (bearing <= (lidar.num_beams - 1) * lidar.angle_increment) & in_range


def visible_circles(
    config: FrontendConfig,
    world: AnyWorld,
    poses: np.ndarray,
    centres: np.ndarray,
    radii: np.ndarray,
) -> np.ndarray:
    """Whether circles, centres (N, 2) and radii (N,), are wholly visible from poses (N, 3)."""
    rim = np.stack([np.cos(RIM), np.sin(RIM)], axis=-1)
    rim = centres[:, None] + 0.95 * radii[:, None, None] * rim
    visible = in_view(config, poses, rim).all(axis=-1)
    visible[visible] = world.in_sight(poses[visible, :2], rim[visible]).all(axis=-1)
    return visible


def visible_corners(config: FrontendConfig, world: WallWorld, poses: np.ndarray) -> np.ndarray:
    """Whether poses (N, 3) see corners, and both walls of them with five beams: (N, C) bool."""
    angles = beam_angles(config.lidar)
    corner, directions = world.corners
    result = np.zeros((len(poses), len(corner)), bool)
    for n, pose in enumerate(poses):
        near = corner + 1e-6 * (pose[:2] - corner)
        visible = world.in_sight(pose[None, :2], near[None])
        visible = np.flatnonzero((visible & in_view(config, pose[None], near[None]))[0])
        ends = ground_truth.hits(pose[:2], pose[2] + angles, world.walls)
        offset = (ends[:, None] - corner[visible])[:, :, None]  # (R, C, 1, 2)
        along = np.sum(offset * directions[visible], axis=-1)
        across = np.sum(offset * directions[visible][..., ::-1] * [1, -1], axis=-1)
        on_wall = (along > 0) & (along < 1.0) & (np.abs(across) < 1e-4)
        result[n, visible] = np.all(on_wall.sum(axis=0) >= BEAMS, axis=-1)
    return result


def beam_angles(lidar: Lidar) -> np.ndarray:
    """Directions (R,) [rad] of the beams, base_link frame, float64."""
    return lidar.angle_min + lidar.angle_increment * np.arange(lidar.num_beams)


def wrap_angle(angle: np.ndarray) -> np.ndarray:
    """The same angle [rad] in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
