"""What front end, scan matching and filter make of a drive, recorded or simulated, in numbers."""

from functools import partial
from typing import NamedTuple

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
from jaxslam.matching.oriented_points import oriented_points, transform_points
from jaxslam.pipeline import log_input
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult
from jaxslam.simulation.ray_casting import find_hits
from jaxslam.simulation.worlds import World, with_index

KINDS = {"junctions": JUNCTION, "corners": CORNER, "walls": WALL}
PAIR_GATE = 0.3  # [m] to the nearest point of the keyframe before, of a point that is compared
ON_WALL = 0.3  # [m] from the map within which a range is of what the map has


class MeasuredDrive(NamedTuple):
    """A drive, mapped, and what was measured.

    Attributes:
        result: Of SLAM.
        numbers: Measures by name.
        residuals: (N,) [m] of ranges against a map, those of hits alone.
    """

    result: SlamResult
    numbers: Numbers
    residuals: np.ndarray


def run(log: LaserLog) -> tuple[Config, Scan, SlamResult]:
    """Run SLAM on a log as `jaxslam run` does."""
    given = log_input.from_laser_log(log)
    result = log_input.run(given)
    return given.config, jax.tree.map(np.asarray, given.scans), result


def feature_numbers(config: Config, result: SlamResult) -> Numbers:
    """Features and matches a scan, and NIS per degree of freedom, of the keyframes of a result."""
    info, features = result.info, result.features
    valid, kind = np.asarray(features.valid), np.asarray(features.kind)
    numbers: Numbers = {
        "matches": float(info.used.sum(axis=1).mean()),
        "nis": float(info.nis.sum() / max(info.dof.sum(), 1)),
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
    nis, used = _nis_of_features(own, params, init(own, jnp.zeros(3, dtype)), measurements)
    return np.asarray(nis), np.asarray(used)


@partial(jax.jit, static_argnums=0)
def _nis_of_features(
    config: FilterConfig, params: NoiseParams, start: Belief, measurements: Measurement
) -> tuple[Array, Array]:
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
    v = rows.residual
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    both = S[:, 1, 1] * v[:, 0] ** 2 + S[:, 0, 0] * v[:, 1] ** 2 - 2 * S[:, 0, 1] * v[:, 0] * v[:, 1]
    one = v[:, 0] ** 2 / S[:, 0, 0]
    square = jnp.where(degrees(chosen[0]) == 1, one, both / det)
    return jnp.zeros(len(slot), square.dtype).at[order].set(square)


def alignment_numbers(lidar: Lidar, scans: Scan, result: SlamResult) -> Numbers:
    """How well each keyframe lies on the one before, at the estimated poses.

    Points within `PAIR_GATE` of a point of the keyframe before are compared with the line that this
    one lies on; the residual is the distance from the line.
    """
    keyframes = result.keyframes
    own = jax.tree.map(lambda x: jnp.asarray(x[keyframes]), scans)
    surfaces = jax.tree.map(np.asarray, jax.jit(jax.vmap(partial(oriented_points, lidar)))(own))
    ends = np.asarray(jax.jit(jax.vmap(partial(beam_ends, lidar)))(own))
    poses, hit = result.poses[keyframes], np.asarray(own.hit)
    residuals, compared, total = [], 0, 0
    for k in range(1, len(keyframes)):
        valid = surfaces.valid[k - 1]
        if not valid.any() or not hit[k].any():
            continue
        placed = transform_points(jnp.asarray(poses[k - 1]), jax.tree.map(lambda x: x[k - 1][valid], surfaces)) if False else None
        before = transform(poses[k - 1], surfaces.points[k - 1][valid])
        turn = poses[k - 1, 2]
        n = surfaces.normal[k - 1][valid]
        normal = np.stack([np.cos(turn) * n[:, 0] - np.sin(turn) * n[:, 1], np.sin(turn) * n[:, 0] + np.cos(turn) * n[:, 1]], axis=1)
        points = transform(poses[k], ends[k][hit[k]])
        distance, index = cKDTree(before).query(points, distance_upper_bound=PAIR_GATE)
        near = np.isfinite(distance)
        gap = points[near] - before[index[near]]
        residuals.append(np.abs(np.sum(gap * normal[index[near]], axis=1)))
        compared += near.sum()
        total += len(points)
    r = np.concatenate(residuals)
    return {
        "residual_rms_m": float(np.sqrt(np.mean(r**2))),
        "residual_median_m": float(np.median(r)),
        "residual_p90_m": float(np.percentile(r,90)),
        "compared_share": compared / total,
        "inliers": float(np.mean(np.asarray(result.scan_matches.inlier_fraction)[1:])),
    }


@partial(jax.jit, static_argnums=0)
def expected_ranges(lidar: Lidar, world: World, poses: Array) -> Array:
    return lax.map(lambda pose: find_hits(lidar, world, pose).distance, poses)


def range_numbers(lidar: Lidar, scans: Scan, poses: np.ndarray, walls: np.ndarray) -> tuple[Numbers, np.ndarray]:
    """Ranges against a map: noise, what is nearer or further than it has, what does not return."""
    world = with_index(World(jnp.asarray(walls, float)), lidar.range_max)
    expected = np.asarray(expected_ranges(lidar, world, jnp.asarray(poses, float)))
    hit = np.asarray(scans.hit)
    ranges = np.asarray(scans.ranges)
    meets = np.isfinite(expected)
    r = np.where(hit & meets, ranges - np.where(meets, expected, 0.0), np.nan)
    have = r[np.isfinite(r)]
    near = have[np.abs(have) < ON_WALL]
    numbers = {
        "missing": float(1 - hit.mean()),
        "missing_at_wall": float((~hit & meets).sum() / meets.sum()),
        "returns_from_nowhere": float((hit & ~meets).sum() / hit.sum()),
        "short": float((have < -ON_WALL).mean()),
        "long": float((have > ON_WALL).mean()),
        "range_mad_m": float(1.4826 * np.median(np.abs(near - np.median(near)))),
        "range_sd_m": float(near.std()),
    }
    return numbers, r
