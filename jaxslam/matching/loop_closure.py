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

from typing import NamedTuple

import jax
import numpy as np

from jaxslam.core import se2_np
from jaxslam.core.batching import on_device, pad_to
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.types import AnyArray, as_float64
from jaxslam.matching import checks
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.registration import (
    LoopClosureSpec,
    check_loop_closure_spec,
    register_batch,
)

BATCH = 8
"""Pairs that one call of the compiled program registers; results do not depend on it."""


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
    poses: AnyArray,
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
        poses: (T, 3) [m, m, rad] map frame, with relative errors below a metre between the two
            visits of a loop. If one is not finite, there are no loop closures.
        scans: [T]. T may be any number, from 0.
        std_scale: Factor on the standard deviation that scan matching reports.

    Raises:
        ValueError: An option is out of range, or poses and scans are not T each, those of this
            lidar.
    """
    check_loop_closure_spec(spec)
    checks.check_scan_match_spec(scan_matching, "scan_matching")
    check_lidar(lidar)
    checks.check_positive("std_scale", std_scale)
    poses = as_float64("poses", poses, ("T", 3))
    scans = jax.tree.map(np.asarray, checks.as_scans("scans", lidar, scans, (len(poses),)))
    step = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    driven = np.append(0.0, np.cumsum(step))[: len(poses)]
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
        pairs = pad_to((submap_scans, submap_poses[some], guess[some], later_scans), to=BATCH)
        batches.append(register_batch(spec, scan_matching, lidar, on_device(pairs)))
    if not batches:
        return LoopClosures(first, second, guess, np.zeros((0, 3, 3)))
    relative_pose, information, inliers, margin = (
        np.concatenate(x)[: len(first)].astype(float) for x in zip(*batches, strict=True)
    )
    accepted = (inliers >= spec.min_inlier_fraction) & (margin >= spec.min_margin)
    information = _corrected(spec, information[accepted] / std_scale**2)
    return LoopClosures(first[accepted], second[accepted], relative_pose[accepted], information)


def _take(scans: Scan, index: np.ndarray) -> Scan:
    """Scans [...] at indices (...)."""
    return jax.tree.map(lambda x: x[index], scans)


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
    spec: LoopClosureSpec, poses: np.ndarray, driven: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Candidate pairs: at regular distances a pose, and the nearest pose of long before.

    Args:
        spec: Which count as near, and as long before.
        poses: (T, 3) [m, m, rad] map frame.
        driven: (T,) [m] distance driven up to each pose.

    Returns:
        Indices (C,) of the earlier poses, and (C,) of the later ones, which ascend.
    """
    pairs = []
    if not np.isfinite(poses).all():
        driven = driven[:0]
    for later in np.unique(np.floor(driven / spec.query_spacing), return_index=True)[1]:
        before = np.searchsorted(driven, driven[later] - spec.min_path_between)
        relative = se2_np.relative(poses[later], poses[:before])
        distance = np.hypot(relative[:, 0], relative[:, 1])
        cost = distance + spec.heading_weight * np.abs(relative[:, 2])
        cost = np.where(distance < spec.max_distance, cost, np.inf)
        if np.min(cost, initial=np.inf) < np.inf:
            pairs.append((np.argmin(cost), later))
    first, second = np.array(pairs, int).reshape(-1, 2).T
    return first, second
