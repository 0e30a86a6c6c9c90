"""What front end, scan matching and filter make of a drive, recorded or simulated, in numbers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.spatial import cKDTree

from experiments.common import Numbers
from jaxslam.core.features import restrict_features
from jaxslam.core.logs import LaserLog
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import transform
from jaxslam.core.types import CORNER, JUNCTION, WALL, Array
from jaxslam.filtering import ekf, slam_filter
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.kalman import innovation_cov
from jaxslam.filtering.noise import NoiseParams, measurement_cov
from jaxslam.filtering.step_info import StepInfo, degrees
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching.oriented_points import oriented_points
from jaxslam.pipeline import log_input
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult
from jaxslam.simulation.ray_casting import find_hits
from jaxslam.simulation.worlds import World, with_index

KINDS = {"junctions": JUNCTION, "corners": CORNER, "walls": WALL}
PAIR_GATE = 0.3  # [m] to the nearest point of the keyframe before, of a point that is compared
ON_WALL = 0.3  # [m] from the map within which a range is of what the map has
HALF_PIECE = 5  # beams on either side of the middle of a piece of a wall
MAX_ACROSS, MIN_COSINE = 0.08, 0.3  # [m] from its line; of the incidence, on a straight piece


def run(log: LaserLog) -> tuple[Config, Scan, SlamResult]:
    """Run SLAM on a log as `jaxslam run` does; configuration, scans [T] and result."""
    given = log_input.from_laser_log(log)
    return given.config, jax.tree.map(np.asarray, given.scans), log_input.run(given)


def feature_numbers(config: Config, result: SlamResult) -> Numbers:
    """Features and matches a scan, and NIS per degree of freedom, of the keyframes of a result."""
    info, features = result.info, result.features
    valid, kind = np.asarray(features.valid), np.asarray(features.kind)
    numbers: Numbers = {
        "matches": float(info.used.sum(axis=1).mean()),
        "nis": float(info.nis.sum()) / max(int(info.dof.sum()), 1),
    }
    nis, used = nis_of_features(config, result)
    for name, number in KINDS.items():
        own = used & (kind == number)
        numbers[f"{name}_seen"] = float((valid & (kind == number)).sum(axis=1).mean())
        numbers[f"{name}_matched"] = float(own.sum(axis=1).mean())
        dof = (1 if number == WALL else 2) * own.sum()
        numbers[f"{name}_nis"] = float(nis[own].sum() / dof) if dof else None
    return numbers


def nis_of_features(config: Config, result: SlamResult) -> tuple[np.ndarray, np.ndarray]:
    """Normalised square of the innovation of each feature by itself, and which are used.

    The filter is run again over the keyframes; both are (K, M).
    """
    assert result.scan_matches is not None and result.odometry is not None
    own = config.filter._replace(max_landmarks=result.belief.num_seen.size)
    dtype = result.info.pose.dtype
    measurements = Measurement(
        jnp.asarray(result.odometry, dtype), result.features, scan_match=result.scan_matches
    )
    params = NoiseParams.for_laser_log(match_scans=True)
    nis, used = nis_by_feature(own, params, init(own, jnp.zeros(3, dtype)), measurements)
    return np.asarray(nis), np.asarray(used)


@partial(jax.jit, static_argnums=0)
def nis_by_feature(
    config: FilterConfig, params: NoiseParams, start: Belief, measurements: Measurement
) -> tuple[Array, Array]:
    """Run the filter; `own_nis` (T, M) of all steps, and which features were used (T, M)."""

    def body(belief: Belief, now: Measurement) -> tuple[Belief, tuple[Array, Array]]:
        predicted, _ = slam_filter.predict(config, params, belief, now)
        belief, info = slam_filter.unchecked_step(config, params, belief, now)
        return belief, (own_nis(config, params, predicted, now, info), info.used)

    return lax.scan(body, start, measurements)[1]


def own_nis(
    config: FilterConfig, params: NoiseParams, predicted: Belief, now: Measurement, info: StepInfo
) -> Array:
    """Normalised squares (M,) of the innovations of one step, each by its own covariance."""
    kinds = jnp.array(config.landmark_kinds, jnp.int32)
    features = restrict_features(now.features, jnp.isin(now.features.kind, kinds))
    R = measurement_cov(params, features, now, untrusted_inflation=config.untrusted_inflation)
    slot = jnp.where(info.used, info.slot, predicted.num_seen.size)
    order = jnp.argsort(~info.used, stable=True)[: config.max_updates]
    chosen = jax.tree.map(lambda x: x[order], (features, R, slot))
    rows = ekf.linearize(predicted, *chosen, linearisation=config.linearisation)
    S = innovation_cov(ekf.covariance_blocks(predicted), rows)
    S = jnp.stack([S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(order))])
    (x, y), (xx, xy, yy) = rows.residual.T, (S[:, 0, 0], S[:, 0, 1], S[:, 1, 1])
    both = (yy * x**2 + xx * y**2 - 2 * xy * x * y) / (xx * yy - xy**2)
    square = jnp.where(degrees(chosen[0]) == 1, x**2 / xx, both)
    return jnp.zeros(len(slot), square.dtype).at[order].set(square)


def alignment_numbers(lidar: Lidar, scans: Scan, result: SlamResult) -> Numbers:
    """How well each keyframe is on the one before, at the estimated poses.

    Points within `PAIR_GATE` of a point of the keyframe before are compared with the line that this
    one is on: the residual is their distance from it.
    """
    assert result.scan_matches is not None
    own = jax.tree.map(lambda x: jnp.asarray(x[result.keyframes]), scans)
    surfaces = jax.jit(jax.vmap(partial(oriented_points, lidar)))(own)
    ends = np.asarray(jax.jit(jax.vmap(partial(beam_ends, lidar)))(own), np.float64)
    surfaces = jax.tree.map(np.asarray, surfaces)
    poses, hit = result.poses[result.keyframes], np.asarray(own.hit)
    turns = np.column_stack([np.zeros((len(poses), 2)), poses[:, 2]])
    residuals, total = [np.zeros(0)], 0
    for k in range(1, len(poses)):
        valid = surfaces.valid[k - 1]
        if not valid.any() or not hit[k].any():
            continue
        before = transform(poses[k - 1], surfaces.points[k - 1][valid])
        normal = transform(turns[k - 1], surfaces.normal[k - 1][valid])
        points = transform(poses[k], ends[k][hit[k]])
        distance, index = cKDTree(before).query(points, distance_upper_bound=PAIR_GATE)
        near = np.isfinite(distance)
        gap = points[near] - before[index[near]]
        residuals.append(np.abs(np.sum(gap * normal[index[near]], axis=1)))
        total += len(points)
    residual = np.concatenate(residuals)
    return {
        "residual_median_m": float(np.median(residual)),
        "residual_rms_m": float(np.sqrt(np.mean(residual**2))),
        "compared": residual.size / max(total, 1),
        "inliers": float(np.mean(np.asarray(result.scan_matches.inlier_fraction)[1:])),
    }


@partial(jax.jit, static_argnums=0)
def expected_ranges(lidar: Lidar, world: World, poses: Array) -> Array:
    """Ranges (T, R) [m] of a world from poses (T, 3), infinite where beams meet nothing."""
    return lax.map(lambda pose: find_hits(lidar, world, pose).distance, poses)


def range_numbers(lidar: Lidar, scans: Scan, poses: np.ndarray, walls: np.ndarray) -> Numbers:
    """Ranges against the walls (S, 4) [m] of a map: what is missing, nearer or farther than they.

    Args:
        lidar: The scanner.
        scans: [T].
        poses: (T, 3) [m, m, rad] in the map.
        walls: (S, 4) [m].
    """
    world = with_index(World(jnp.asarray(walls, float)), lidar.range_max)
    expected = np.asarray(expected_ranges(lidar, world, jnp.asarray(poses, float)))
    hit, meets = np.asarray(scans.hit), np.isfinite(expected)
    both = hit & meets
    error = (np.asarray(scans.ranges) - np.where(meets, expected, 0.0))[both]
    near = error[np.abs(error) < ON_WALL]
    return {
        "missing": float(1.0 - hit.mean()),
        "missing_at_wall": float((meets & ~hit).sum() / meets.sum()),
        "short": float(np.mean(error < -ON_WALL)),
        "long": float(np.mean(error > ON_WALL)),
        "range_std_m": float(near.std()),
    }


def roughness(lidar: Lidar, ranges: np.ndarray) -> float:
    """Median over straight pieces of walls of the standard deviation [m] of ranges (T, R) on them.

    A piece is of 11 beams, all within 8 cm of their line; deviations are along the beams.
    """
    angles = lidar.angle_min + lidar.angle_increment * np.arange(lidar.num_beams)
    beams = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.where(np.isfinite(ranges), ranges, np.nan).astype(np.float64)[..., None] * beams
    found = []
    for k in range(HALF_PIECE, lidar.num_beams - HALF_PIECE, HALF_PIECE):
        piece = points[:, k - HALF_PIECE : k + HALF_PIECE + 1]
        piece = piece[np.isfinite(piece).all(axis=(1, 2))]
        offset = piece - piece.mean(axis=1, keepdims=True)
        xx, xy, yy = (
            np.mean(offset[..., i] * offset[..., j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1))
        )
        direction = 0.5 * np.arctan2(2 * xy, xx - yy)
        normal = np.stack([-np.sin(direction), np.cos(direction)], axis=-1)
        across = np.einsum("tkj,tj->tk", offset, normal)
        cosine = np.abs(normal @ beams[k])
        good = (np.abs(across).max(axis=1) < MAX_ACROSS) & (cosine > MIN_COSINE)
        std = np.sqrt(np.sum(across**2, axis=1) / (2 * HALF_PIECE - 1))
        found.append(std[good] / cosine[good])
    return float(np.median(np.concatenate(found)))
