"""Drives that see all of a floor plan, recorded and mapped as a log is."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph, csr_array

from experiments import ground_truth
from jaxslam.core.scan import Lidar, Scan
from jaxslam.evaluation.trajectory import align_trajectory
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.config import MappingSpec
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.offline import run_slam
from jaxslam.pipeline.results import SlamResult
from jaxslam.simulation import drives, path_following
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

CELL = 0.15  # [m] of the grid on which paths are found
CLEARANCE = 0.3  # [m] of the robot's centre from the walls
LIDAR = Lidar(num_beams=541, angle_min=-0.75 * np.pi, angle_increment=np.pi / 360, range_max=30.0)
_WIDTH = 5  # points over which a path is smoothed


class PlanLog(NamedTuple):
    """A recorded drive of T scans.

    Attributes:
        truth: (T, 3) [m, m, rad] true poses.
        odometry: (T, 3) [m, m, rad] increments of the wheels, zero at the first.
        scans: [T] of `LIDAR`, with noise.
    """

    truth: np.ndarray
    odometry: np.ndarray
    scans: Scan


def tour(walls: np.ndarray, spacing: float) -> np.ndarray:
    """A path (N, 2) [m] from which all that can be reached is seen, from `spacing` [m] or nearer.

    It visits places that are `spacing` apart or hidden from each other, each time the nearest one
    that is left.

    Args:
        walls: (S, 4) [m] without padding.
        spacing: [m].
    """
    points, matrix = _path_grid(walls)
    rng = np.random.default_rng(0)
    part = csgraph.connected_components(matrix, directed=False)[1]
    own = np.flatnonzero(part == np.bincount(part).argmax())
    goals: list[int] = []
    left = rng.permutation(own)
    while left.size:
        goals.append(int(left[0]))
        here = points[left[:1]]
        near = np.hypot(*(points[left] - here).T) <= spacing
        near[near] = ground_truth.in_sight(here, points[None, left[near]], walls)[0]
        left = left[~near & (left != goals[-1])]
    length, before = csgraph.dijkstra(
        matrix, directed=False, indices=goals, return_predecessors=True
    )
    at, ahead, path = 0, set(range(1, len(goals))), [goals[0]]
    while ahead:
        following = min(ahead, key=lambda n: length[at, goals[n]])
        leg = [goals[following]]
        while leg[-1] != goals[at]:
            leg.append(int(before[at, leg[-1]]))
        path += leg[::-1][1:]
        ahead.remove(following)
        at = following
    line = ndimage.uniform_filter1d(points[path], _WIDTH, axis=0, mode="nearest")
    return path_following.densify(line)


def _path_grid(walls: np.ndarray) -> tuple[np.ndarray, csr_array]:
    """Points (P, 2) [m] of a grid in free space, and costs (P, P) of steps between neighbours.

    Steps near walls cost more.
    """
    ends = walls.reshape(-1, 2)
    axes = [np.arange(a, b, CELL) for a, b in zip(ends.min(axis=0), ends.max(axis=0), strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 2)
    away = ground_truth.clearance(flat, walls)
    away *= ground_truth.FreeSpace(walls).contains(flat)
    away = away.reshape(points.shape[:2])
    number = np.arange(away.size).reshape(away.shape)
    pairs, costs = [], []
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.s_[: len(away) - i, max(0, -j) : away.shape[1] - max(0, j)]
        there = np.s_[i:, max(0, j) : away.shape[1] + min(0, j)]
        least = np.minimum(away[here], away[there])
        free = least > CLEARANCE
        pairs.append(np.column_stack([number[here][free], number[there][free]]))
        costs.append(CELL * np.hypot(i, j) * (1.0 + 0.2 / least[free]))
    shape = (away.size, away.size)
    edges = tuple(np.concatenate(pairs).T)
    return flat, csr_array((np.concatenate(costs), edges), shape=shape)


@partial(jax.jit, static_argnames="num_scans")
def _simulated(key: jax.Array, walls: jax.Array, path: jax.Array, *, num_scans: int):
    world = World(walls)
    return drives.simulate_scans(key, LIDAR, Robot(), world, path, num_scans=num_scans)


def drive(seed: int, walls: np.ndarray, *, spacing: float) -> PlanLog:
    """Drive along the `tour` of a floor plan, with noise of the wheels and of the scanner.

    Args:
        seed: Of the noise.
        walls: (S, 4) [m] without padding.
        spacing: [m] of the tour.
    """
    path = jnp.asarray(tour(walls, spacing), float)
    num_scans = drives.num_scans_of_drive(Robot(), path)
    key = jax.random.key(seed)
    truth, odometry, scans = _simulated(key, jnp.asarray(walls, float), path, num_scans=num_scans)
    return PlanLog(np.asarray(truth, float), np.asarray(odometry, float), scans)


def mapped(log: PlanLog) -> tuple[Config, SlamResult]:
    """SLAM with the presets for logs, from the true first pose, and its configuration.

    The topological map is the merged one; `mapping_stage.with_maps` makes that of the grid of it.
    """
    config = Config.for_laser_log(LIDAR)._replace(mapping=MappingSpec("merged"))
    params = NoiseParams.for_laser_log(match_scans=True)
    return config, run_slam(config, params, log.odometry, log.scans, start=log.truth[0])


def to_world(log: PlanLog, result: SlamResult) -> np.ndarray:
    """Pose (3,) of the map frame in the world, by which the trajectories fit best."""
    known = np.isfinite(result.poses[:, 0])
    return align_trajectory(result.poses[known, :2], log.truth[known, :2])
