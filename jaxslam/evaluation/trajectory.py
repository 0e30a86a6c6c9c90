"""Errors of trajectories against references: ATE, RPE, relations; NumPy, float64."""

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.se2_np import compose, relative
from jaxslam.core.time_series import interpolate_poses, match_times, sort_by_time
from jaxslam.core.types import as_float64


def align_trajectory(estimate: ArrayLike, reference: ArrayLike) -> np.ndarray:
    """Rigid transform (3,) [m, m, rad] that best aligns one set of points with another.

    With a_i, b_i the points of the estimate and the reference, each relative to its mean, the
    rotation that minimises sum_i |b_i - R a_i|^2 has the angle

        atan2(sum_i a_i x b_i, sum_i a_i . b_i)

    Args:
        estimate: (N, 2) [m].
        reference: (N, 2) [m], the corresponding points.

    Returns:
        The pose of the frame of `estimate` in that of `reference`, by least squares.

    Raises:
        ValueError: The shapes differ, or there is no point.

    References:
        Umeyama (1991), Least-squares estimation of transformation parameters, without the scale.
    """
    estimate = as_float64("estimate", estimate, ("N", 2))
    reference = as_float64("reference", reference, estimate.shape)
    if not estimate.size:
        raise ValueError("estimate is empty: (0, 2)")
    estimate_mean, reference_mean = estimate.mean(axis=0), reference.mean(axis=0)
    a, b = estimate - estimate_mean, reference - reference_mean
    angle = np.arctan2(
        np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
    )
    rotated_mean = compose(np.array([0.0, 0.0, angle]), np.append(estimate_mean, 0.0))
    return np.append(reference_mean - rotated_mean[:2], angle)


def ate(
    times: ArrayLike,
    poses: ArrayLike,
    ref_times: ArrayLike,
    ref_poses: ArrayLike,
    tolerance: float = 0.05,
) -> dict[str, float | int]:
    """Absolute trajectory error (ATE) of positions, after rigid alignment.

    Args:
        times: (N,) [s] of the estimate.
        poses: (N, 3) [m, m, rad].
        ref_times: (M,) [s] of the reference, same clock.
        ref_poses: (M, 3) [m, m, rad], any frame.
        tolerance: Largest difference [s] of associated times.

    Returns:
        `ate_rmse_m`, and `matched`: number of poses that were compared.

    Raises:
        ValueError: Fewer than two times can be associated, or an argument does not fit.

    References:
        Sturm et al. (2012), A benchmark for the evaluation of RGB-D SLAM systems, section IV.
    """
    times, poses, ref_times, ref_poses = _checked(times, poses, ref_times, ref_poses, tolerance)
    pairs = match_times(times, ref_times, tolerance)
    if len(pairs) < 2:
        found = f"{len(pairs)} times agree with ref_times within {tolerance} s"
        raise ValueError(f"{found}; are the clocks the same?")
    estimate, reference = poses[pairs[:, 0]], ref_poses[pairs[:, 1], :2]
    aligned = compose(align_trajectory(estimate[:, :2], reference), estimate)
    distance = np.linalg.norm(aligned[:, :2] - reference, axis=1)
    return {"ate_rmse_m": float(np.sqrt(np.mean(distance**2))), "matched": len(pairs)}


def rpe(
    times: ArrayLike,
    poses: ArrayLike,
    ref_times: ArrayLike,
    ref_poses: ArrayLike,
    tolerance: float = 0.05,
    delta: float = 1.0,
) -> dict[str, float | None]:
    """Relative pose error (RPE) over motions of a fixed length, evo's `delta` in metres.

    The reference is cut into consecutive motions, each as short as possible and `delta` or longer
    along the reference trajectory; the error of each is the relative pose of the reference's
    motion and the estimate's.

    Args:
        times: (N,) [s] of the estimate.
        poses: (N, 3) [m, m, rad].
        ref_times: (M,) [s] of the reference, same clock.
        ref_poses: (M, 3) [m, m, rad], any frame.
        tolerance: Largest difference [s] of associated times.
        delta: Length [m] of a motion along the reference trajectory.

    Returns:
        `rpe_translation_rmse_m` and `rpe_rotation_rmse_deg`; None if the trajectory is shorter.

    Raises:
        ValueError: `delta` is not positive, or an argument does not fit.

    References:
        Sturm et al. (2012), A benchmark for the evaluation of RGB-D SLAM systems, section IV.
    """
    times, poses, ref_times, ref_poses = _checked(times, poses, ref_times, ref_poses, tolerance)
    if not delta > 0.0:
        raise ValueError(f"delta is {delta}, not a positive number of metres")
    i, j = match_times(times, ref_times, tolerance).T
    estimate, reference = poses[i], ref_poses[j]
    ends, length = [0], 0.0
    for k, distance in enumerate(np.hypot(*np.diff(reference[:, :2], axis=0).T), start=1):
        length += distance
        if length >= delta:
            ends.append(k)
            length = 0.0
    if len(ends) < 2:
        return {"rpe_translation_rmse_m": None, "rpe_rotation_rmse_deg": None}
    estimated, true = (relative(x[ends[:-1]], x[ends[1:]]) for x in (estimate, reference))
    error = relative(true, estimated)
    return {
        "rpe_translation_rmse_m": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        "rpe_rotation_rmse_deg": float(np.degrees(np.sqrt(np.mean(error[:, 2] ** 2)))),
    }


def relation_errors(
    times: ArrayLike,
    poses: ArrayLike,
    odom_times: ArrayLike,
    odom_poses: ArrayLike,
    relations: tuple[ArrayLike, ArrayLike, ArrayLike],
) -> dict[str, float | int]:
    """Relation error: relative poses of a trajectory beside verified ones.

    The pose at a relation's time is the last estimated one, extended by odometry.

    Args:
        times: (T,) [s] of the estimate, in any order.
        poses: (T, 3) [m, m, rad].
        odom_times: (N,) [s] of the odometry, in any order.
        odom_poses: (N, 3) [m, m, rad] of the odometry, interpolated linearly.
        relations: Times t1 (K,) and t2 (K,) [s], and the pose (K, 3) at t2 in the frame at t1.

    Returns:
        `translation_mean_m`, `translation_std_m`, `translation_max_m`, `rotation_mean_deg`,
        `rotation_std_deg` of the absolute errors, and `used`: number of relations within the time
        span of the estimate.

    Raises:
        ValueError: No relation is within that time span, or an argument does not fit.

    References:
        Kuemmerle et al. (2009), On measuring the accuracy of SLAM algorithms.
    """
    times, poses = _checked_trajectory("", times, poses)
    odom_times, odom_poses = _checked_trajectory("odom_", odom_times, odom_poses)
    t1, t2, verified = _checked_relations(relations)
    slack = 1e-5  # [s] for the rounding of written times
    first = np.min(times) - slack
    last = max(np.max(times), np.max(odom_times)) + slack
    used = (np.minimum(t1, t2) >= first) & (np.maximum(t1, t2) <= last)
    if not used.any():
        raise ValueError(f"no relation lies within the trajectory's times {first} to {last} s")
    start, end = (_pose_at(t[used], slack, times, poses, odom_times, odom_poses) for t in (t1, t2))
    error = relative(verified[used], relative(start, end))
    translation = np.hypot(error[:, 0], error[:, 1])
    rotation = np.degrees(np.abs(error[:, 2]))
    return {
        "translation_mean_m": float(translation.mean()),
        "translation_std_m": float(translation.std()),
        "translation_max_m": float(translation.max()),
        "rotation_mean_deg": float(rotation.mean()),
        "rotation_std_deg": float(rotation.std()),
        "used": int(used.sum()),
    }


def _pose_at(
    wanted: np.ndarray,
    slack: float,
    times: np.ndarray,
    poses: np.ndarray,
    odom_times: np.ndarray,
    odom_poses: np.ndarray,
) -> np.ndarray:
    """Poses (K, 3) at times (K,) [s]: the last estimate before each, extended by odometry."""
    times, poses = sort_by_time(times, poses)
    last = np.searchsorted(times, wanted + slack, side="right") - 1
    odometry = sort_by_time(odom_times, odom_poses)
    increment = relative(
        interpolate_poses(times[last], *odometry), interpolate_poses(wanted, *odometry)
    )
    return compose(poses[last], increment)


def _checked(
    times: ArrayLike,
    poses: ArrayLike,
    ref_times: ArrayLike,
    ref_poses: ArrayLike,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two trajectories in float64; ValueError if they are none, or if the tolerance is none."""
    if not tolerance >= 0.0:
        raise ValueError(f"tolerance is {tolerance}, not a number of seconds >= 0")
    estimate = _checked_trajectory("", times, poses)
    return *estimate, *_checked_trajectory("ref_", ref_times, ref_poses)


def _checked_trajectory(
    prefix: str, times: ArrayLike, poses: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) and poses (N, 3) in float64, called `prefix` times and poses in messages."""
    times = as_float64(f"{prefix}times", times, ("N",))
    if not times.size:
        raise ValueError(f"{prefix}times is empty")
    return times, as_float64(f"{prefix}poses", poses, (len(times), 3))


def _checked_relations(
    relations: tuple[ArrayLike, ArrayLike, ArrayLike],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Relations in float64; ValueError if they are not three arrays that fit, or none."""
    if not isinstance(relations, tuple | list) or len(relations) != 3:
        raise ValueError("relations is not a tuple of t1, t2 and relative poses")
    t1 = as_float64("relations t1", relations[0], ("K",))
    if not t1.size:
        raise ValueError("relations is empty")
    t2 = as_float64("relations t2", relations[1], (len(t1),))
    return t1, t2, as_float64("relations relative_pose", relations[2], (len(t1), 3))
