"""Registration of one scan against a submap of an earlier visit, from a rough guess of its pose.

Point-to-line ICP (`icp`) from several positions around the guess finds the pose; the ambiguity
margin says how much worse the best other position is. `loop_closure` decides what to accept.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.types import Array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching import checks
from jaxslam.matching.icp import (
    MatchedPose,
    PosePrior,
    ScanMatchSpec,
    Submap,
    fine_icp,
    icp,
)
from jaxslam.matching.motion_prior import first_history
from jaxslam.matching.oriented_points import OrientedPoints, oriented_points, transform_points

GUESS_PENALTY = 0.02
"""Inlier fraction that a position 1 std off the guess must have in addition."""

WEAK_PRIOR = 1e-4
"""Factor on the guess's information in the refinement: keeps what scans do not show."""


class LoopClosureSpec(NamedTuple):
    """Which pairs of scans are registered, and when the result is accepted; static under jit.

    Attributes:
        query_spacing: [m] driven from one later scan that is tried to the next.
        min_path_between: [m] driven between two visits, at least.
        max_distance: [m] between the two poses, at most.
        heading_weight: [m] distance that a radian between two headings counts as.
        submap_scans: K, scans of the submap.
        submap_spacing: [m] driven between two of them.
        coarse_stride: Every how many of them the coarse search uses one.
        guess_offset: [m] offset of the initial guesses, in four directions.
        guess_std: [m], [rad] std of the guess.
        min_inlier_fraction: Least inlier fraction of an accepted loop closure.
        distinct_distance: [m] distance from which another position is a different one.
        min_margin: Least difference of the inlier fractions of the best and of any other position.
        pose_std_floor: [m], [rad] std of the poses of the submap relative to each other.
        surface_tilt_std: [rad] std of the directions of normals, which makes a bare wall seem to
            constrain the position along it.
    """

    query_spacing: float = 2.0
    min_path_between: float = 15.0
    max_distance: float = 2.0
    heading_weight: float = 0.5
    submap_scans: int = 13
    submap_spacing: float = 0.6
    coarse_stride: int = 2
    guess_offset: float = 0.7
    guess_std: tuple[float, float] = (1.0, 0.1)
    min_inlier_fraction: float = 0.8
    distinct_distance: float = 0.3
    min_margin: float = 0.05
    pose_std_floor: tuple[float, float] = (0.02, 0.004)
    surface_tilt_std: float = 0.1


class Registration(NamedTuple):
    """Result of registering a scan against a submap, in whose frame the pose is.

    Attributes:
        pose: (3,) [m, m, rad].
        information: (3, 3) its inverse covariance, from the scan alone.
        inlier_fraction: () part of the points that lie on a surface of the submap.
        margin: () score of the position less that of the best other one; infinite without any.
    """

    pose: Array
    information: Array
    inlier_fraction: Array
    margin: Array


def check_loop_closure_spec(spec: LoopClosureSpec) -> None:
    """Check the options of loop closures.

    Raises:
        ValueError: One is out of range; the message names it.
    """
    checks.check_static("spec", spec, LoopClosureSpec)
    for field in ("query_spacing", "submap_spacing", "max_distance"):
        checks.check_positive(f"spec.{field}", getattr(spec, field))
    for field in ("submap_scans", "coarse_stride"):
        checks.check_at_least(f"spec.{field}", getattr(spec, field), 1)
    for std in spec.guess_std:
        checks.check_positive("spec.guess_std", std)


def register_scan(
    spec: LoopClosureSpec,
    scan_matching: ScanMatchSpec,
    lidar: Lidar,
    submap_scans: Scan,
    submap_poses: Array,
    guess: Array,
    scan: Scan,
) -> Registration:
    """Register a scan against a submap of an earlier visit; all poses are in the submap's frame.

        1. Coarse search: ICP from the guess and from four positions around it.
        2. Score each result: its inlier fraction, less a penalty on the distance from the guess.
           The best is taken; the margin is its score less the best score further than
           `spec.distinct_distance` from it: small in a corridor, where every position along it
           fits.
        3. Refine, against the submap's surfaces that face the position found: a thin wall has two
           sides, and the scan sees only one of them.

    Call it by `jax.jit(register_scan, static_argnums=(0, 1, 2))`.

    Args:
        spec: Options of the coarse search.
        scan_matching: Options of scan matching.
        lidar: The scanner.
        submap_scans: [K] scans of the submap.
        submap_poses: (K, 3) [m, m, rad] their poses.
        guess: (3,) [m, m, rad] pose of the scan.
        scan: One scan of the later visit.

    Returns:
        The registration; where ICP fails the guess, without information and inliers.

    Raises:
        ValueError: An option is out of range; poses, guess or scans are not of the shapes above.
    """
    check_loop_closure_spec(spec)
    checks.check_scan_match_spec(scan_matching, "scan_matching")
    check_lidar(lidar)
    submap_poses = checks.as_default_float("submap_poses", submap_poses, ("K", 3))
    guess = checks.as_default_float("guess", guess, (3,))
    submap_scans = checks.as_scans("submap_scans", lidar, submap_scans, submap_poses.shape[:1])
    scan = checks.as_scans("scan", lidar, scan)

    surfaces = jax.vmap(partial(oriented_points, lidar))(submap_scans)
    surfaces = jax.vmap(transform_points)(submap_poses, surfaces)
    submap = Submap(surfaces, submap_poses, jnp.int32(spec.submap_scans), guess, first_history())
    every = -(-lidar.num_beams // scan_matching.max_beams)
    points, hit = beam_ends(lidar, scan)[::every], scan.hit[::every]
    std = jnp.array([spec.guess_std[0], spec.guess_std[0], spec.guess_std[1]])
    guess_information = jnp.diag(1.0 / std**2)

    coarse_surfaces, coarse_poses = jax.tree.map(
        lambda x: x[:: spec.coarse_stride], (surfaces, submap_poses)
    )
    coarse_submap = submap._replace(oriented_points=coarse_surfaces, poses=coarse_poses)
    thinned = slice(None, None, scan_matching.coarse_stride)

    def search(start: Array) -> MatchedPose:
        return icp(
            scan_matching,
            lidar,
            coarse_submap,
            PosePrior(guess, guess_information),
            start,
            points[thinned],
            hit[thinned],
            gates=scan_matching.coarse_gates,
            kernels=(scan_matching.kernel_scales[0],) * len(scan_matching.coarse_gates),
        )

    sides = jnp.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    found, _, inliers = jax.vmap(search)(guess[None] + spec.guess_offset * sides)
    distance = jnp.sum(((found - guess[None]) / std[None])[:, :2] ** 2, axis=1)
    score = inliers - GUESS_PENALTY * distance
    best = jnp.argmax(score)
    elsewhere = jnp.linalg.norm((found - found[best][None])[:, :2], axis=1) > spec.distinct_distance
    margin = score[best] - jnp.max(jnp.where(elsewhere, score, -jnp.inf))

    facing = _same_side(submap_poses, found[best], surfaces)
    facing_surfaces = surfaces._replace(valid=surfaces.valid & facing)
    pose, information, inliers = fine_icp(
        scan_matching,
        lidar,
        submap._replace(oriented_points=facing_surfaces),
        PosePrior(guess, WEAK_PRIOR * guess_information),
        found[best],
        points,
        hit,
    )
    finite = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(information))
    return Registration(
        pose=jnp.where(finite, pose, guess),
        information=jnp.where(finite, information, 0.0),
        inlier_fraction=jnp.where(finite & jnp.isfinite(inliers), inliers, 0.0),
        margin=margin,
    )


def _same_side(poses: Array, pose: Array, surfaces: OrientedPoints) -> Array:
    """Whether surfaces [K] face a pose (3,), as they do those (K, 3) that saw them: (K, R)."""

    def side(position: Array) -> Array:
        return jnp.sum(surfaces.normal * (position - surfaces.points), axis=-1)

    return side(poses[:, None, :2]) * side(pose[None, None, :2]) > 0.0


@partial(trace_cache.jit, static_argnames=("spec", "scan_matching", "lidar"), compile_quickly=True)
def register_batch(
    spec: LoopClosureSpec,
    scan_matching: ScanMatchSpec,
    lidar: Lidar,
    pairs: tuple[Scan, Array, Array, Scan],
) -> Registration:
    """`register_scan` of pairs [B], given as its last four arguments.

    One after the other: the data of one fits the cache of the processor.
    """

    def register(pair: tuple[Scan, Array, Array, Scan]) -> Registration:
        return register_scan(spec, scan_matching, lidar, *pair)

    return lax.map(register, pairs)
