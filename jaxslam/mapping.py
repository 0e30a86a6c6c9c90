"""What a run leaves for other programs: an occupancy map of its scans, a graph for optimisers."""

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

OCCUPIED = 0.25  # part of the beams at a cell that must end in it, for it to be occupied
MARGIN = 0.5  # [m] of unknown cells around
STANDSTILL = 1e-4  # [m], [rad] std added to each motion: a robot that stands still has none


def occupancy(poses: np.ndarray, scans: Scan, lidar: Lidar, *, resolution: float) -> Occupancy:
    """Occupancy map of what scans saw.

    Each beam counts once in each cell that it passes, but for corners that it cuts by less than
    half a cell, and once in that where it ends. Nothing is said of cells that no beam reached.

    Args:
        poses: (T, 3) [m, m, rad] of the scanner; those that are not finite are left out.
        scans: [T].
        lidar: The scanner.
        resolution: Side of a cell [m]; doubled until the map has no more than `CELLS` cells.

    Raises:
        ValueError: The resolution is not positive, or no pose is finite.
    """
    poses = np.asarray(poses, np.float64)
    good = np.isfinite(poses).all(axis=1)
    if not resolution > 0.0:
        raise ValueError(f"resolution of {resolution} m")
    if not good.any():
        raise ValueError("no pose is finite")
    poses = poses[good]
    ranges, hit = np.asarray(scans.ranges, np.float64)[good], np.asarray(scans.hit)[good]
    angle = poses[:, 2:] + np.asarray(bearings(lidar), np.float64)
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (T, R, 2)
    ends = poses[:, None, :2] + ranges[..., None] * beam
    shown = np.concatenate([ends[hit], poses[:, :2]])
    low, high = shown.min(axis=0) - MARGIN, shown.max(axis=0) + MARGIN
    while np.prod(np.ceil((high - low) / resolution) + 1.0) > CELLS:
        resolution *= 2.0
    low = np.floor(low / resolution) * resolution
    size = np.ceil((high - low) / resolution).astype(int)
    passed, ended = np.zeros(np.prod(size), np.int32), np.zeros(np.prod(size), np.int32)

    def cells(points: np.ndarray) -> np.ndarray:
        """Flat indices (N,) of the cells of points (N, 2)."""
        return np.floor((points - low) / resolution).astype(int) @ [size[1], 1]

    for pose, last, way, length, hits in zip(poses, ends, beam, ranges, hit, strict=True):
        # A beam that nothing returned tells nothing: what it passed may be glass.
        goal = cells(last[hits])
        count = np.ceil(2.0 * length[hits] / resolution).astype(int)
        which = np.repeat(np.arange(len(count)), count)
        number = np.arange(which.size) - np.repeat(np.cumsum(count) - count, count)
        at = cells(pose[:2] + 0.5 * resolution * number[:, None] * way[hits][which])
        # The points of a beam in one cell follow each other.
        new = np.append(True, (at[1:] != at[:-1]) | (which[1:] != which[:-1]))[: at.size]
        np.add.at(passed, at[new & (at != goal[which])], 1)
        np.add.at(ended, goal, 1)
    occupied = ended > OCCUPIED * (passed + ended)
    free = (passed > 0) & ~occupied
    grids = occupied.reshape(size), free.reshape(size)
    return Occupancy(*grids, resolution, np.append(low, 0.0))


@partial(programs.jit, static_argnames="config")
def _assumed(config: Config, noise: Noise, inputs: Inputs) -> tuple[Array, Array, Array]:
    """Motions (T, 3), their covariances (T, 3, 3), and those of features (T, M, 2, 2)."""

    def of(now: Inputs) -> tuple[Array, Array, Array]:
        return *slam.moved(noise, now), sensor_noise(noise, now.nodes, doubt=config.doubt)

    return jax.vmap(of)(inputs)


def pose_graph(config: Config, noise: Noise, survey: Survey, inputs: Inputs) -> PoseGraph:
    """What a run of the filter was told, with its estimates: poses, nodes, corners.

    Only landmarks that count at the end are in it.

    Args:
        config: Of the filter.
        noise: What it assumed.
        survey: The run.
        inputs: [T] it was given.
    """
    belief, info = survey.belief, survey.info
    kept = slam.confirmed(config, belief) & (belief.kind != WALL)
    names = np.asarray(belief.id)[np.asarray(kept)]
    seen_by, feature = np.nonzero(np.isin(np.asarray(info.id), names) & (np.asarray(info.id) >= 0))
    rank = {name: k for k, name in enumerate(names.tolist())}
    motion, q, r = _assumed(config, noise, inputs)
    q = np.asarray(q, np.float64) + STANDSTILL**2 * np.eye(3)
    at = seen_by, feature
    r = np.asarray(r, np.float64)[at]
    seen = np.asarray(survey.nodes.xy, np.float64)[at]
    turn = np.stack([-seen[:, 1], seen[:, 0]], axis=-1)  # what a radian of bearing moves
    ray = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    from_polar = np.stack([ray, turn], axis=-1)
    graph = PoseGraph(
        poses=survey.poses,
        places=np.asarray(belief.places, np.float64)[np.asarray(kept)],
        motion=np.asarray(motion, np.float64)[1:],
        motion_information=np.linalg.inv(q[1:]),
        seen_by=seen_by,
        which=np.array([rank[name] for name in np.asarray(info.id)[at].tolist()], int),
        seen=seen,
        seen_information=np.linalg.inv(from_polar @ r @ from_polar.transpose(0, 2, 1)),
    )
    ties = survey.closures
    if ties is None:
        return graph
    return graph._replace(
        closed=np.stack([ties.first, ties.second], axis=1),
        closure=ties.motion,
        closure_information=ties.information,
    )
