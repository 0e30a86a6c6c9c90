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

from jaxslam import alignment, programs
from jaxslam.alignment import AlignSpec, LocalMap
from jaxslam.batches import pad
from jaxslam.lidar import Lidar, Scan, points
from jaxslam.poses import seen_from
from jaxslam.types import Array, expect

BATCH = 8  # pairs that one call of the compiled program registers
LIKELY = 0.02  # inlier fraction that a position 1 std off the guess must have in addition
FAINT = 1e-4  # factor on the guess's information in the refinement: keeps what scans do not show


class ClosureSpec(NamedTuple):
    """Which pairs of scans are registered, and when the result is accepted; static under jit.

    Attributes:
        every: [m] driven from one later scan that is tried to the next.
        away: [m] driven between two visits, at least.
        near: [m] between the two poses, at most.
        turned: [m] distance that a radian between two headings counts as.
        scans: K, scans of the submap.
        apart: [m] driven between two of them.
        few: Every how many of them the coarse search uses one.
        aside: [m] offset of the initial guesses, in four directions.
        unsure: [m], [rad] std of the guess.
        explained: Least inlier fraction of an accepted loop closure.
        other: [m] distance from which another position is a different one.
        margin: Least difference of the inlier fractions of the best and of any other position.
        floor: [m], [rad] std of the poses of the submap relative to each other.
        tilt: [rad] std of the directions of normals, which makes a bare wall seem to constrain the
            position along it.
    """

    every: float = 2.0
    away: float = 15.0
    near: float = 2.0
    turned: float = 0.5
    scans: int = 13
    apart: float = 0.6
    few: int = 2
    aside: float = 0.7
    unsure: tuple[float, float] = (1.0, 0.1)
    explained: float = 0.8
    other: float = 0.3
    margin: float = 0.05
    floor: tuple[float, float] = (0.02, 0.004)
    tilt: float = 0.1


class Closures(NamedTuple):
    """Loop closures: relative-pose factors between poses of one trajectory; NumPy.

    Attributes:
        first: (C,) int index of the pose of the earlier visit.
        second: (C,) int index of the pose of the later visit.
        motion: (C, 3) [m, m, rad] pose of the second in the frame of the first.
        information: (C, 3, 3) its inverse covariance, in the same frame.
    """

    first: np.ndarray
    second: np.ndarray
    motion: np.ndarray
    information: np.ndarray


def find(
    spec: ClosureSpec,
    align: AlignSpec,
    lidar: Lidar,
    poses: np.ndarray,
    scans: Scan,
    *,
    scale: float = 1.0,
) -> Closures:
    """Accepted loop closures of a trajectory.

        1. Select candidate pairs: a pose, and the nearest pose of a visit long before.
        2. Register the scan of each later pose against a submap around the earlier one.
        3. Accept results with many inliers and without another position that is almost as good.
        4. Correct the information for the errors of normals and of the submap's poses.

    Args:
        spec: Which pairs are tried, and which results accepted.
        align: Options of scan matching.
        lidar: The scanner.
        poses: (T, 3) world frame, with relative errors below a metre between the two visits of a
            loop. If one is not finite, there are no loop closures.
        scans: [T].
        scale: Factor on the standard deviation that scan matching reports.

    Raises:
        ValueError: Poses or ranges have another shape or type.
    """
    expect("poses", poses, ("T", 3), jnp.floating)
    expect("scans.ranges", scans.ranges, (len(poses), lidar.beams), jnp.floating)
    poses, scans = np.asarray(poses, np.float64), jax.tree.map(np.asarray, scans)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    first, second = candidates(spec, poses, driven)
    steps = spec.apart * (np.arange(spec.scans) - spec.scans // 2)
    submap = np.searchsorted(driven, driven[first][:, None] + steps[None])
    submap = submap.clip(0, len(driven) - 1)  # (C, K) indices of scans
    guess = seen_from(poses[first], poses[second])
    submap_poses = seen_from(poses[first][:, None], poses[submap])
    batches = []
    for start in range(0, len(first), BATCH):
        some = slice(start, start + BATCH)
        submap_scans, later_scans = _take(scans, submap[some]), _take(scans, second[some])
        pairs = pad((submap_scans, submap_poses[some], later_scans, guess[some]), to=BATCH)
        batches.append(_register_batch(spec, align, lidar, jax.tree.map(_on_device, pairs)))
    if not batches:
        return Closures(first, second, guess, np.zeros((0, 3, 3)))
    motion, information, inliers, margin = (
        np.concatenate(x)[: len(first)].astype(float) for x in zip(*batches, strict=True)
    )
    accepted = (inliers >= spec.explained) & (margin >= spec.margin)
    information = _corrected(spec, information[accepted] / scale**2)
    return Closures(first[accepted], second[accepted], motion[accepted], information)


def _take(scans: Scan, index: np.ndarray) -> Scan:
    """Scans [...] at indices (...)."""
    return jax.tree.map(lambda x: x[index], scans)


def _on_device(x: np.ndarray) -> Array:
    """A JAX array, of JAX's default precision if its numbers are real."""
    return jnp.asarray(x, float if x.dtype.kind == "f" else None)


def _corrected(spec: ClosureSpec, information: np.ndarray) -> np.ndarray:
    """Information (C, 3, 3) H of registrations, corrected for what point-to-line ICP leaves out.

    Normals have errors of std `tilt` [rad]. They turn information across a wall into some along
    it, about tilt^2 times as much, which over many points seems a real constraint. As much,
    tilt^2 (H_xx + H_yy), is subtracted from H_xx and from H_yy, and negative eigenvalues are set to
    zero. Then the covariance F of the submap's own poses is added:

        (H^-1 + F)^-1 = (I + H F)^-1 H,    where H may be singular
    """
    spurious = spec.tilt**2 * np.trace(information[:, :2, :2], axis1=1, axis2=2)
    information = information - spurious[:, None, None] * np.diag([1.0, 1.0, 0.0])
    eigenvalues, axes = np.linalg.eigh(information)
    information = (axes * np.maximum(eigenvalues, 0.0)[:, None]) @ axes.swapaxes(1, 2)
    floor = np.diag([spec.floor[0], spec.floor[0], spec.floor[1]]) ** 2
    information = np.linalg.solve(np.eye(3) + information @ floor, information)
    return (information + information.swapaxes(1, 2)) / 2


def candidates(
    spec: ClosureSpec, poses: np.ndarray, along: np.ndarray
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
    for later in np.unique(np.floor(along / spec.every), return_index=True)[1]:
        before = np.searchsorted(along, along[later] - spec.away)
        relative = seen_from(poses[later], poses[:before])
        distance = np.hypot(relative[:, 0], relative[:, 1])
        cost = distance + spec.turned * np.abs(relative[:, 2])
        cost = np.where(distance < spec.near, cost, np.inf)
        if np.min(cost, initial=np.inf) < np.inf:
            pairs.append((np.argmin(cost), later))
    first, second = np.array(pairs, int).reshape(-1, 2).T
    return first, second


def lay(
    spec: ClosureSpec,
    align: AlignSpec,
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
        align: Options of scan matching.
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
    surfaces = jax.vmap(partial(alignment.surfaces, lidar=lidar))(visit)
    surfaces = jax.vmap(alignment.laid)(surfaces, around)
    submap = LocalMap(surfaces, around, jnp.int32(spec.scans), guess)
    every = -(-lidar.beams // align.beams)
    own, hit = points(scan, lidar)[::every], scan.hit[::every]
    std = jnp.array([spec.unsure[0], spec.unsure[0], spec.unsure[1]])
    guess_information = jnp.diag(1.0 / std**2)
    icp = partial(alignment.descend, align, lidar)

    few_surfaces, few_poses = jax.tree.map(lambda x: x[:: spec.few], (surfaces, around))
    coarse_submap = submap._replace(surfaces=few_surfaces, poses=few_poses)
    thinned = slice(None, None, align.thin)

    def search(start: Array) -> tuple[Array, Array, Array]:
        prior = guess, guess_information
        return icp(
            coarse_submap, own[thinned], hit[thinned], start, prior, align.far, align.kernel[0]
        )

    sides = jnp.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    found, _, inliers = jax.vmap(search)(guess[None] + spec.aside * sides)
    distance = jnp.sum(((found - guess[None]) / std[None])[:, :2] ** 2, axis=1)
    score = inliers - LIKELY * distance
    best = jnp.argmax(score)
    elsewhere = jnp.linalg.norm((found - found[best][None])[:, :2], axis=1) > spec.other
    margin = score[best] - jnp.max(jnp.where(elsewhere, score, -jnp.inf))

    facing = _same_side(surfaces, around, found[best])
    submap = submap._replace(surfaces=surfaces._replace(valid=surfaces.valid & facing))
    prior = guess, FAINT * guess_information
    pose, information, inliers = icp(
        submap, own, hit, found[best], prior, align.near, align.kernel[1]
    )
    finite = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(information))
    inliers = jnp.where(finite & jnp.isfinite(inliers), inliers, 0.0)
    return jnp.where(finite, pose, guess), jnp.where(finite, information, 0.0), inliers, margin


def _same_side(surfaces: alignment.Surfaces, poses: Array, pose: Array) -> Array:
    """Whether surfaces [K] face a pose (3,), as they do those (K, 3) that saw them: (K, R)."""

    def side(position: Array) -> Array:
        return jnp.sum(surfaces.normal * (position - surfaces.points), axis=-1)

    return side(poses[:, None, :2]) * side(pose[None, None, :2]) > 0.0


@partial(programs.jit, static_argnames=("spec", "align", "lidar"))
def _register_batch(
    spec: ClosureSpec, align: AlignSpec, lidar: Lidar, pairs: tuple[Scan | Array, ...]
) -> tuple[Array, Array, Array, Array]:
    """`lay` of a batch, one after the other: the data of one fits the cache of the processor."""

    def register(pair: tuple[Scan | Array, ...]) -> tuple[Array, Array, Array, Array]:
        submap_scans, submap_poses, scan, guess = pair
        return lay(spec, align, lidar, submap_scans, submap_poses, scan, guess)

    return lax.map(register, pairs)


def residuals(closures: Closures, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals of loop closures at poses (T, 3), and their derivatives.

    With W^T W the information, the residual is W ((x_first^-1 x_second) - motion), its angle
    wrapped.

    Returns:
        Residuals (C, 3); derivatives (C, 3, 3) with respect to the first poses and to the second.
    """
    first, second = poses[closures.first], poses[closures.second]
    relative = seen_from(first, second)
    error = relative - closures.motion
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
