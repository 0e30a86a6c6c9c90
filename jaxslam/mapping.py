"""Results for other programs: an occupancy map of the scans, a pose graph for optimisers."""

from functools import partial

import jax
import numpy as np

from jaxslam import programs, slam
from jaxslam.io.occupancy import CELLS, Occupancy
from jaxslam.io.posegraph import PoseGraph
from jaxslam.lidar import Lidar, Scan, bearings
from jaxslam.noise import Noise, sensor_noise
from jaxslam.online import Survey
from jaxslam.slam import Config, Inputs
from jaxslam.types import WALL, Array

OCCUPIED = 0.25  # a cell is occupied if more than this fraction of the beams at it end in it
MARGIN = 0.5  # [m] of unknown cells around the map
STANDSTILL = 1e-4  # [m], [rad] std added to each motion: a robot that stands still has none


def occupancy(poses: np.ndarray, scans: Scan, lidar: Lidar, *, resolution: float) -> Occupancy:
    """Occupancy map from scans at known poses, by counting.

    A beam that hit something is sampled every half cell. It counts as a pass once in each cell that
    it crosses (but for corners that it cuts by less than half a cell) and as a hit in the cell
    where it ends. A cell is occupied if

        hits > OCCUPIED (passes + hits)

    free if it was passed and is not occupied, else unknown. Beams without a return are not used:
    they may have passed glass.

    Args:
        poses: (T, 3) [m, m, rad] of the scanner, map frame; those that are not finite are left out.
        scans: [T].
        lidar: The scanner.
        resolution: [m] side of a cell; doubled until the map has no more than `CELLS` cells.

    Raises:
        ValueError: The resolution is not positive, or no pose is finite.
    """
    poses = np.asarray(poses, np.float64)
    finite = np.isfinite(poses).all(axis=1)
    if not resolution > 0.0:
        raise ValueError(f"resolution of {resolution} m")
    if not finite.any():
        raise ValueError("no pose is finite")
    poses = poses[finite]
    ranges, hit = np.asarray(scans.ranges, np.float64)[finite], np.asarray(scans.hit)[finite]
    angle = poses[:, 2:] + np.asarray(bearings(lidar), np.float64)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (T, R, 2)
    ends = poses[:, None, :2] + ranges[..., None] * directions
    low, size, resolution = _extent(np.concatenate([ends[hit], poses[:, :2]]), resolution)
    passes, hits = np.zeros(np.prod(size), np.int32), np.zeros(np.prod(size), np.int32)

    def cell_of(points: np.ndarray) -> np.ndarray:
        """Flat indices (N,) of the cells of points (N, 2)."""
        return np.floor((points - low) / resolution).astype(int) @ [size[1], 1]

    for t in range(len(poses)):
        end_cell = cell_of(ends[t, hit[t]])
        num_samples = np.ceil(2.0 * ranges[t, hit[t]] / resolution).astype(int)
        beam = np.repeat(np.arange(len(num_samples)), num_samples)  # of each sample
        sample = np.arange(beam.size) - np.repeat(np.cumsum(num_samples) - num_samples, num_samples)
        step = 0.5 * resolution * sample[:, None] * directions[t, hit[t]][beam]
        cell = cell_of(poses[t, :2] + step)
        # Samples of one beam in one cell follow each other: the first of them counts.
        first = np.append(True, (cell[1:] != cell[:-1]) | (beam[1:] != beam[:-1]))[: cell.size]
        np.add.at(passes, cell[first & (cell != end_cell[beam])], 1)
        np.add.at(hits, end_cell, 1)
    occupied = hits > OCCUPIED * (passes + hits)
    free = (passes > 0) & ~occupied
    return Occupancy(occupied.reshape(size), free.reshape(size), resolution, np.append(low, 0.0))


def _extent(points: np.ndarray, resolution: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Grid around points (N, 2) [m]: its corner (2,) [m], its size (2,) in cells, its resolution.

    The corner is a multiple of the resolution, which is doubled until there are at most `CELLS`.
    """
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    while np.prod(np.ceil((high - low) / resolution) + 1.0) > CELLS:
        resolution *= 2.0
    low = np.floor(low / resolution) * resolution
    return low, np.ceil((high - low) / resolution).astype(int), resolution


@partial(programs.jit, static_argnames="config")
def _noise_model(config: Config, noise: Noise, inputs: Inputs) -> tuple[Array, Array, Array]:
    """Motions (T, 3), their covariances (T, 3, 3), and those of features (T, M, 2, 2)."""

    def of_scan(now: Inputs) -> tuple[Array, Array, Array]:
        motion, q = slam.moved(noise, now)
        return motion, q, sensor_noise(noise, now.nodes, doubt=config.doubt)

    return jax.vmap(of_scan)(inputs)


def pose_graph(config: Config, noise: Noise, survey: Survey, inputs: Inputs) -> PoseGraph:
    """Pose graph of a filtered log: measurements with information matrices, estimates as guess.

    Landmarks are the confirmed junctions and corners. Features are measured in polar form (range
    r, bearing b) with covariance R, and written in Cartesian form (x, y) with covariance J R J^T,

        J = d(x, y) / d(r, b) = [ x / r   -y ]
                                [ y / r    x ]

    Args:
        config: Of the filter.
        noise: Noise parameters of the filter.
        survey: Result of the filter.
        inputs: [T] measurements that it was given.
    """
    belief, info = survey.belief, survey.info
    kept = np.asarray(slam.confirmed(config, belief) & (belief.kind != WALL))
    landmark_ids, feature_ids = np.asarray(belief.id)[kept], np.asarray(info.id)
    scan, feature = np.nonzero(np.isin(feature_ids, landmark_ids) & (feature_ids >= 0))
    index = {landmark: k for k, landmark in enumerate(landmark_ids.tolist())}
    motion, q, r = _noise_model(config, noise, inputs)
    q = np.asarray(q, np.float64) + STANDSTILL**2 * np.eye(3)
    r = np.asarray(r, np.float64)[scan, feature]
    xy = np.asarray(survey.nodes.xy, np.float64)[scan, feature]
    by_bearing = np.stack([-xy[:, 1], xy[:, 0]], axis=-1)
    by_range = xy / np.linalg.norm(xy, axis=1, keepdims=True)
    from_polar = np.stack([by_range, by_bearing], axis=-1)
    graph = PoseGraph(
        poses=survey.poses,
        places=np.asarray(belief.places, np.float64)[kept],
        motion=np.asarray(motion, np.float64)[1:],
        motion_information=np.linalg.inv(q[1:]),
        seen_by=scan,
        which=np.array([index[landmark] for landmark in feature_ids[scan, feature].tolist()], int),
        seen=xy,
        seen_information=np.linalg.inv(from_polar @ r @ from_polar.transpose(0, 2, 1)),
    )
    loop_closures = survey.closures
    if loop_closures is None:
        return graph
    return graph._replace(
        closed=np.stack([loop_closures.first, loop_closures.second], axis=1),
        closure=loop_closures.motion,
        closure_information=loop_closures.information,
    )
