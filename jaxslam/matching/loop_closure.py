"""Loop closures: scans of a later visit to a place, registered against those of an earlier visit.

The filter closes a loop where it observes a landmark again and associates it. Where it does not, a
corridor that was driven twice appears twice in the map, as far apart as dead reckoning has drifted.
Here both visits are taken from the smoothed trajectory, so there is a good initial guess. For each
pair of poses the scan of the later one is registered, by point-to-line ICP, against a submap of
scans around the earlier one. A loop closure is accepted if most points of the scan are inliers and
if no other position explains the scan almost as well (the ambiguity margin).

References:
    Lu, Milios (1997), Globally consistent range scan alignment for environment mapping. Olson
    (2009), Recognizing places using spectrally clustered local matches: ambiguity of a match.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import se2_np, trace_cache
from jaxslam.core.batching import pad_to
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import Array, check_array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching import icp as icp_module
from jaxslam.matching import oriented_points
from jaxslam.matching.icp import ScanMatchSpec, Submap
from jaxslam.matching.oriented_points import OrientedPoints

BATCH = 8  # pairs that one call of the compiled program registers
GUESS_PENALTY = 0.02  # inlier fraction that a position 1 std off the guess must have in addition
WEAK_PRIOR = (
    1e-4  # factor on the guess's information in the refinement: keeps what scans do not show
)


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
        surface_tilt_std: [rad] std of the directions of normals, which makes a bare wall seem to constrain the
            position along it.
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


class LoopClosures(NamedTuple):
    """Loop closures: relative-pose factors between poses of one trajectory; NumPy.

    Attributes:
        first: (C,) int index of the pose of the earlier visit.
        second: (C,) int index of the pose of the later visit.
        relative_pose: (C, 3) [m, m, rad] pose of the second in the frame of the first.
        information: (C, 3, 3) its inverse covariance, in the same frame.
    """

    first: np.ndarray
    second: np.ndarray
    relative_pose: np.ndarray
    information: np.ndarray


def find_loop_closures(
    spec: LoopClosureSpec,
    scan_matching: ScanMatchSpec,
    lidar: Lidar,
    poses: np.ndarray,
    scans: Scan,
    *,
    std_scale: float = 1.0,
) -> LoopClosures:
    """Accepted loop closures of a trajectory.

        1. Select candidate pairs: a pose, and the nearest pose of a visit long before.
        2. Register the scan of each later pose against a submap around the earlier one.
        3. Accept results with many inliers and without another position that is almost as good.
        4. Correct the information for the errors of normals and of the submap's poses.

    Args:
        spec: Which pairs are tried, and which results accepted.
        scan_matching: Options of scan matching.
        lidar: The scanner.
        poses: (T, 3) world frame, with relative errors below a metre between the two visits of a
            loop. If one is not finite, there are no loop closures.
        scans: [T].
        std_scale: Factor on the standard deviation that scan matching reports.

    Raises:
        ValueError: Poses or ranges have another shape or type.
    """
    check_array("poses", poses, ("T", 3), jnp.floating)
    check_array("scans.ranges", scans.ranges, (len(poses), lidar.num_beams), jnp.floating)
    poses, scans = np.asarray(poses, np.float64), jax.tree.map(np.asarray, scans)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    first, second = closure_candidates(spec, poses, driven)
    steps = spec.submap_spacing * (np.arange(spec.submap_scans) - spec.submap_scans // 2)
    submap = np.searchsorted(driven, driven[first][:, None] + steps[None])
    submap = submap.clip(0, len(driven) - 1)  # (C, K) indices of scans
    guess = se2_np.relative(poses[first], poses[second])
    submap_poses = se2_np.relative(poses[first][:, None], poses[submap])
    batches = []
    for start in range(0, len(first), BATCH):
        some = slice(start, start + BATCH)
        submap_scans, later_scans = _take(scans, submap[some]), _take(scans, second[some])
        pairs = pad_to((submap_scans, submap_poses[some], later_scans, guess[some]), to=BATCH)
        batches.append(_register_batch(spec, scan_matching, lidar, jax.tree.map(_on_device, pairs)))
    if not batches:
        return LoopClosures(first, second, guess, np.zeros((0, 3, 3)))
    motion, information, inliers, margin = (
        np.concatenate(x)[: len(first)].astype(float) for x in zip(*batches, strict=True)
    )
    accepted = (inliers >= spec.min_inlier_fraction) & (margin >= spec.min_margin)
    information = _corrected(spec, information[accepted] / std_scale**2)
    return LoopClosures(first[accepted], second[accepted], motion[accepted], information)


def _take(scans: Scan, index: np.ndarray) -> Scan:
    """Scans [...] at indices (...)."""
    return jax.tree.map(lambda x: x[index], scans)


def _on_device(x: np.ndarray) -> Array:
    """A JAX array, of JAX's default precision if its numbers are real."""
    return jnp.asarray(x, float if x.dtype.kind == "f" else None)


def _corrected(spec: LoopClosureSpec, information: np.ndarray) -> np.ndarray:
    """Information (C, 3, 3) H of registrations, corrected for what point-to-line ICP leaves out.

    Normals have errors of std `tilt` [rad]. They turn information across a wall into some along
    it, about tilt^2 times as much, which over many points seems a real constraint. As much,
    tilt^2 (H_xx + H_yy), is subtracted from H_xx and from H_yy, and negative eigenvalues are set to
    zero. Then the covariance F of the submap's own poses is added:

        (H^-1 + F)^-1 = (I + H F)^-1 H,    where H may be singular
    """
    spurious = spec.surface_tilt_std**2 * np.trace(information[:, :2, :2], axis1=1, axis2=2)
    information = information - spurious[:, None, None] * np.diag([1.0, 1.0, 0.0])
    eigenvalues, axes = np.linalg.eigh(information)
    information = (axes * np.maximum(eigenvalues, 0.0)[:, None]) @ axes.swapaxes(1, 2)
    floor = np.diag([spec.pose_std_floor[0], spec.pose_std_floor[0], spec.pose_std_floor[1]]) ** 2
    information = np.linalg.solve(np.eye(3) + information @ floor, information)
    return (information + information.swapaxes(1, 2)) / 2


def closure_candidates(
    spec: LoopClosureSpec, poses: np.ndarray, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Candidate pairs: at regular distances a pose, and the nearest pose of long before.

    Args:
        spec: Which count as near, and as long before.
        poses: (T, 3) world frame.
        along: (T,) [m] distance driven up to each pose.

    Returns:
        Indices (C,) of the earlier poses, and (C,) of the later ones, which ascend.
    """
    pairs = []
    if not np.isfinite(poses).all():
        along = along[:0]
    for later in np.unique(np.floor(along / spec.query_spacing), return_index=True)[1]:
        before = np.searchsorted(along, along[later] - spec.min_path_between)
        relative = se2_np.relative(poses[later], poses[:before])
        distance = np.hypot(relative[:, 0], relative[:, 1])
        cost = distance + spec.heading_weight * np.abs(relative[:, 2])
        cost = np.where(distance < spec.max_distance, cost, np.inf)
        if np.min(cost, initial=np.inf) < np.inf:
            pairs.append((np.argmin(cost), later))
    first, second = np.array(pairs, int).reshape(-1, 2).T
    return first, second


def register_scan(
    spec: LoopClosureSpec,
    scan_matching: ScanMatchSpec,
    lidar: Lidar,
    visit: Scan,
    around: Array,
    scan: Scan,
    guess: Array,
) -> tuple[Array, Array, Array, Array]:
    """Register a scan against a submap of an earlier visit; all poses are in the submap's frame.

        1. Coarse search: ICP from the guess and from four positions around it.
        2. Score each result: its inlier fraction, less a penalty on the distance from the guess.
           The best is taken; the margin is its score less the best score further than `spec.other`
           from it: small in a corridor, where every position along it fits.
        3. Refine, against the submap's surfaces that face the position found: a thin wall has two
           sides, and the scan sees only one of them.

    Args:
        spec: Options of the coarse search.
        scan_matching: Options of scan matching.
        lidar: The scanner.
        visit: [K] scans of the submap.
        around: (K, 3) their poses.
        scan: One scan of the later visit.
        guess: (3,) its pose.

    Returns:
        Pose (3,); its information (3, 3), from the scan alone; inlier fraction (); margin ().
        Where ICP fails, the guess, without information and inliers.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    surfaces = jax.vmap(partial(oriented_points.oriented_points, lidar=lidar))(visit)
    surfaces = jax.vmap(oriented_points.transform_points)(surfaces, around)
    submap = Submap(surfaces, around, jnp.int32(spec.submap_scans), guess)
    every = -(-lidar.num_beams // scan_matching.max_beams)
    own, hit = beam_ends(lidar, scan)[::every], scan.hit[::every]
    std = jnp.array([spec.guess_std[0], spec.guess_std[0], spec.guess_std[1]])
    guess_information = jnp.diag(1.0 / std**2)
    icp = partial(icp_module.icp, scan_matching, lidar)

    few_surfaces, few_poses = jax.tree.map(lambda x: x[:: spec.coarse_stride], (surfaces, around))
    coarse_submap = submap._replace(oriented_points=few_surfaces, poses=few_poses)
    thinned = slice(None, None, scan_matching.coarse_stride)

    def search(start: Array) -> tuple[Array, Array, Array]:
        prior = guess, guess_information
        return icp(
            coarse_submap,
            own[thinned],
            hit[thinned],
            start,
            prior,
            scan_matching.coarse_gates,
            scan_matching.kernel_scales[0],
        )

    sides = jnp.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    found, _, inliers = jax.vmap(search)(guess[None] + spec.guess_offset * sides)
    distance = jnp.sum(((found - guess[None]) / std[None])[:, :2] ** 2, axis=1)
    score = inliers - GUESS_PENALTY * distance
    best = jnp.argmax(score)
    elsewhere = jnp.linalg.norm((found - found[best][None])[:, :2], axis=1) > spec.distinct_distance
    margin = score[best] - jnp.max(jnp.where(elsewhere, score, -jnp.inf))

    facing = _same_side(surfaces, around, found[best])
    submap = submap._replace(oriented_points=surfaces._replace(valid=surfaces.valid & facing))
    prior = guess, WEAK_PRIOR * guess_information
    pose, information, inliers = icp(
        submap,
        own,
        hit,
        found[best],
        prior,
        scan_matching.fine_gates,
        scan_matching.kernel_scales[1],
    )
    finite = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(information))
    inliers = jnp.where(finite & jnp.isfinite(inliers), inliers, 0.0)
    return jnp.where(finite, pose, guess), jnp.where(finite, information, 0.0), inliers, margin


def _same_side(surfaces: OrientedPoints, poses: Array, pose: Array) -> Array:
    """Whether surfaces [K] face a pose (3,), as they do those (K, 3) that saw them: (K, R)."""

    def side(position: Array) -> Array:
        return jnp.sum(surfaces.normal * (position - surfaces.points), axis=-1)

    return side(poses[:, None, :2]) * side(pose[None, None, :2]) > 0.0


@partial(trace_cache.jit, static_argnames=("spec", "align", "lidar"))
def _register_batch(
    spec: LoopClosureSpec, align: ScanMatchSpec, lidar: Lidar, pairs: tuple[Scan | Array, ...]
) -> tuple[Array, Array, Array, Array]:
    """`register_scan` of a batch, one after the other: the data of one fits the cache of the processor."""

    def register(pair: tuple[Scan | Array, ...]) -> tuple[Array, Array, Array, Array]:
        submap_scans, submap_poses, scan, guess = pair
        return register_scan(spec, align, lidar, submap_scans, submap_poses, scan, guess)

    return lax.map(register, pairs)


def closure_residuals(
    closures: LoopClosures, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals of loop closures at poses (T, 3), and their derivatives.

    With W^T W the information, the residual is W ((x_first^-1 x_second) - motion), its angle
    wrapped.

    Returns:
        Residuals (C, 3); derivatives (C, 3, 3) with respect to the first poses and to the second.
    """
    first, second = poses[closures.first], poses[closures.second]
    relative = se2_np.relative(first, second)
    error = relative - closures.relative_pose
    error[:, 2] -= 2 * np.pi * np.round(error[:, 2] / (2 * np.pi))
    by_first, by_second = np.zeros((2, len(first), 3, 3))
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    by_second[:, :2, :2] = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    by_first[:, :2, :2] = -by_second[:, :2, :2]
    by_first[:, :2, 2] = np.stack([relative[:, 1], -relative[:, 0]], axis=-1)
    by_first[:, 2, 2], by_second[:, 2, 2] = -1.0, 1.0
    eigenvalues, axes = np.linalg.eigh(closures.information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[..., None] * axes.swapaxes(1, 2)
    return (root @ error[..., None])[..., 0], root @ by_first, root @ by_second
