"""Trajectory errors (ATE, RPE, relation error) and filter consistency (NEES).

The first part is JAX, for batches of simulated trials; the second is NumPy in float64, for
recorded trajectories.
"""

import jax.numpy as jnp
import numpy as np
from scipy.special import chdtri

from jaxslam.geometry import wrap_angle
from jaxslam.poses import by_time, composed, interpolate, seen_from
from jaxslam.types import Array


def pose_error(estimate: Array, truth: Array) -> Array:
    """Error (..., 3) [m, m, rad] of poses (..., 3), in the world frame, heading wrapped."""
    error = estimate - truth
    return error.at[..., 2].set(wrap_angle(error[..., 2]))


def nees(error: Array, cov: Array) -> Array:
    """Normalised estimation error squared, e^T P^-1 e.

    Over many trials of a consistent filter it is chi-square distributed with k degrees of freedom;
    it is not divided by k. It is computed by elimination: with P = L D L^T, L unit lower
    triangular, and y = L^-1 e,

        e^T P^-1 e = y^T D^-1 y = sum_j y_j^2 / d_j

    where column j is eliminated from the columns after it,

        y_i -= f y_j,    P_im -= f P_mj,    f = P_ij / d_j,    d_j = P_jj    for j < m <= i

    written out for each element: array operations on whole batches, fast on any device for small k.

    Args:
        error: (..., k).
        cov: (..., k, k) symmetric P; only its lower triangle is read.

    Returns:
        (...), inf where P is not positive definite or anything is NaN or infinite; gradients are
        0 there.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications, section 5.4.
    """
    size = error.shape[-1]
    good = jnp.isfinite(error).all(axis=-1) & jnp.isfinite(cov).all(axis=(-2, -1))
    rest = [jnp.where(good, error[..., i], 0.0) for i in range(size)]  # y
    lower = [
        [jnp.where(good, cov[..., i, j], float(i == j)) for j in range(i + 1)] for i in range(size)
    ]
    total = jnp.zeros_like(rest[0])
    for j in range(size):
        positive = lower[j][j] > 0.0
        good = good & positive
        pivot = jnp.where(positive, lower[j][j], 1.0)
        total = total + rest[j] ** 2 / pivot
        for i in range(j + 1, size):
            factor = lower[i][j] / pivot
            rest[i] = rest[i] - factor * rest[j]
            for m in range(j + 1, i + 1):
                lower[i][m] = lower[i][m] - factor * lower[m][j]
    return jnp.where(good, total, jnp.inf)


def rmse(values: Array, mask: Array) -> Array:
    """Root mean square () of the `values` (...) whose `mask` (...) is True.

    Values outside the mask may be NaN. The result is NaN if the mask is empty; the gradient is 0
    then, and also where the result is exactly 0.
    """
    count = jnp.sum(mask, dtype=values.dtype)
    square = jnp.sum(jnp.where(mask, values, 0.0) ** 2) / jnp.maximum(count, 1.0)
    positive = square > 0.0
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
    return jnp.where(count > 0.0, root, jnp.nan)


def chi_square_bounds(dof: int, count: int, probability: float = 0.95) -> tuple[float, float]:
    """Interval of the mean of `count` independent chi-square values, for consistency tests.

    Args:
        dof: Degrees of freedom of each value: 3 for the NEES of a pose.
        count: Number of values that are averaged.
        probability: That the mean lies in the interval; both tails are equal.

    Returns:
        Lower and upper bound of the mean, on either side of `dof`.
    """
    tail = (1.0 - probability) / 2.0
    lower, upper = (float(chdtri(dof * count, above)) / count for above in (1.0 - tail, tail))
    return lower, upper


def align(estimate: np.ndarray, reference: np.ndarray) -> np.ndarray:
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
    estimate, reference = np.asarray(estimate, np.float64), np.asarray(reference, np.float64)
    if estimate.shape != reference.shape or estimate.ndim != 2 or estimate.size == 0:
        raise ValueError(f"points {estimate.shape} and {reference.shape} are not both (N >= 1, 2)")
    estimate_mean, reference_mean = estimate.mean(axis=0), reference.mean(axis=0)
    a, b = estimate - estimate_mean, reference - reference_mean
    angle = np.arctan2(
        np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
    )
    rotated_mean = composed(np.array([0.0, 0.0, angle]), np.append(estimate_mean, 0.0))
    return np.append(reference_mean - rotated_mean[:2], angle)


def match_times(
    times: np.ndarray, reference_times: np.ndarray, tolerance: float = 0.05
) -> np.ndarray:
    """Associate times with the nearest reference times; each is used at most once.

    Args:
        times: (N,) [s], in any order.
        reference_times: (M,) [s], in any order.
        tolerance: Largest difference [s] of a pair.

    Returns:
        Pairs (K, 2) int of indices into `times` and `reference_times`, in the order of `times`.
        Of several times with the same nearest reference time the closest is paired.
    """
    times, reference_times = np.asarray(times, np.float64), np.asarray(reference_times, np.float64)
    if times.size == 0 or reference_times.size == 0:
        return np.zeros((0, 2), np.int64)
    order = np.argsort(reference_times, kind="stable")
    after = np.searchsorted(reference_times[order], times).clip(0, order.size - 1)
    neighbours = np.stack([order[(after - 1).clip(0)], order[after]])  # (2, N) before and after
    gaps = np.abs(reference_times[neighbours] - times)
    side, each = np.argmin(gaps, axis=0), np.arange(times.size)
    gap, partner = gaps[side, each], neighbours[side, each]
    closest_first = np.argsort(gap, kind="stable")
    closest_first = closest_first[gap[closest_first] <= tolerance]
    paired = closest_first[np.unique(partner[closest_first], return_index=True)[1]]
    paired.sort()
    return np.stack([paired, partner[paired]], axis=1)


def ate(
    times: np.ndarray,
    poses: np.ndarray,
    ref_times: np.ndarray,
    ref_poses: np.ndarray,
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
        ValueError: Fewer than two times can be associated.

    References:
        Sturm et al. (2012), A benchmark for the evaluation of RGB-D SLAM systems, section IV.
    """
    pairs = match_times(times, ref_times, tolerance)
    if len(pairs) < 2:
        raise ValueError(f"{len(pairs)} times agree within {tolerance} s; are the clocks the same?")
    estimate = np.asarray(poses, np.float64)[pairs[:, 0]]
    reference = np.asarray(ref_poses, np.float64)[pairs[:, 1], :2]
    aligned = composed(align(estimate[:, :2], reference), estimate)
    distance = np.linalg.norm(aligned[:, :2] - reference, axis=1)
    return {"ate_rmse_m": float(np.sqrt(np.mean(distance**2))), "matched": len(pairs)}


def rpe(
    times: np.ndarray,
    poses: np.ndarray,
    ref_times: np.ndarray,
    ref_poses: np.ndarray,
    tolerance: float = 0.05,
    apart: float = 1.0,
) -> dict[str, float | None]:
    """Relative pose error (RPE) over motions of a fixed length, evo's `delta` in metres.

    The reference is cut into consecutive motions, each as short as possible and `apart` or longer
    along the reference trajectory; the error of each is the relative pose of the reference's
    motion and the estimate's.

    Args:
        times: (N,) [s] of the estimate.
        poses: (N, 3) [m, m, rad].
        ref_times: (M,) [s] of the reference, same clock.
        ref_poses: (M, 3) [m, m, rad], any frame.
        tolerance: Largest difference [s] of associated times.
        apart: Length [m] of a motion along the reference trajectory.

    Returns:
        `rpe_translation_rmse_m` and `rpe_rotation_rmse_deg`; None if the trajectory is shorter.

    Raises:
        ValueError: `apart` is not positive.

    References:
        Sturm et al. (2012), A benchmark for the evaluation of RGB-D SLAM systems, section IV.
    """
    if not apart > 0.0:
        raise ValueError(f"motions {apart} m apart")
    i, j = match_times(times, ref_times, tolerance).T
    estimate = np.asarray(poses, np.float64)[i]
    reference = np.asarray(ref_poses, np.float64)[j]
    ends, length = [0], 0.0
    for k, distance in enumerate(np.hypot(*np.diff(reference[:, :2], axis=0).T), start=1):
        length += distance
        if length >= apart:
            ends.append(k)
            length = 0.0
    if len(ends) < 2:
        return {"rpe_translation_rmse_m": None, "rpe_rotation_rmse_deg": None}
    estimated, true = (seen_from(x[ends[:-1]], x[ends[1:]]) for x in (estimate, reference))
    error = seen_from(true, estimated)
    return {
        "rpe_translation_rmse_m": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        "rpe_rotation_rmse_deg": float(np.degrees(np.sqrt(np.mean(error[:, 2] ** 2)))),
    }


def relations_error(
    times: np.ndarray,
    poses: np.ndarray,
    wheel_times: np.ndarray,
    wheel_poses: np.ndarray,
    relations: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> dict[str, float | int]:
    """Relation error: relative poses of a trajectory beside verified ones.

    The pose at a relation's time is the last estimated one, extended by odometry.

    Args:
        times: (T,) [s] of the estimate, in any order.
        poses: (T, 3) [m, m, rad].
        wheel_times: (N,) [s] of the odometry, in any order.
        wheel_poses: (N, 3) [m, m, rad] of the odometry, interpolated linearly.
        relations: Times t1 (K,) and t2 (K,) [s], and the pose (K, 3) at t2 in the frame at t1.

    Returns:
        `translation_mean_m`, `translation_std_m`, `rotation_mean_deg`, `rotation_std_deg` of the
        absolute errors, and `used`: number of relations within the time span of the estimate.

    Raises:
        ValueError: No relation is within that time span.

    References:
        Kuemmerle et al. (2009), On measuring the accuracy of SLAM algorithms.
    """
    t1, t2, verified = (np.asarray(column, np.float64) for column in relations)
    slack = 1e-5  # [s] for the rounding of written times
    first = np.min(times) - slack
    last = max(np.max(times), np.max(wheel_times)) + slack
    used = (np.minimum(t1, t2) >= first) & (np.maximum(t1, t2) <= last)
    if not used.any():
        raise ValueError(f"no relation lies within the trajectory's times {first} to {last} s")
    start, end = (
        _pose_at(t[used], slack, times, poses, wheel_times, wheel_poses) for t in (t1, t2)
    )
    error = seen_from(verified[used], seen_from(start, end))
    translation = np.hypot(error[:, 0], error[:, 1])
    rotation = np.degrees(np.abs(error[:, 2]))
    return {
        "translation_mean_m": float(translation.mean()),
        "translation_std_m": float(translation.std()),
        "rotation_mean_deg": float(rotation.mean()),
        "rotation_std_deg": float(rotation.std()),
        "used": int(used.sum()),
    }


def _pose_at(
    wanted: np.ndarray,
    slack: float,
    times: np.ndarray,
    poses: np.ndarray,
    odometry_times: np.ndarray,
    odometry_poses: np.ndarray,
) -> np.ndarray:
    """Poses (K, 3) at times (K,) [s]: the last estimate before each, extended by odometry."""
    times, poses = by_time(times, poses)
    last = np.searchsorted(times, wanted + slack, side="right") - 1
    odometry = by_time(odometry_times, odometry_poses)
    increment = seen_from(interpolate(times[last], *odometry), interpolate(wanted, *odometry))
    return composed(poses[last], increment)
