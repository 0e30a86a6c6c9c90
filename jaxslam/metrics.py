"""Errors of trajectories, and whether a filter's covariance is as large as its errors.

The first part is JAX, for batches of simulated runs; the second is NumPy in float64, for logs.
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

    P is eliminated row by row in array operations, which is quick on any device for small k. Over
    many runs of a consistent filter it is chi-square distributed with k degrees of freedom.

    Args:
        error: (..., k).
        cov: (..., k, k) symmetric P; its lower triangle is read.

    Returns:
        (...), inf where P is not positive definite or anything is NaN or infinite; gradients are
        0 there.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications, section 5.4.
    """
    size = error.shape[-1]
    good = jnp.isfinite(error).all(axis=-1) & jnp.isfinite(cov).all(axis=(-2, -1))
    rest = [jnp.where(good, error[..., i], 0.0) for i in range(size)]
    a = [
        [jnp.where(good, cov[..., i, j], float(i == j)) for j in range(i + 1)] for i in range(size)
    ]
    total = jnp.zeros_like(rest[0])
    for j in range(size):
        positive = a[j][j] > 0.0
        good = good & positive
        pivot = jnp.where(positive, a[j][j], 1.0)
        total = total + rest[j] ** 2 / pivot
        for i in range(j + 1, size):
            factor = a[i][j] / pivot
            rest[i] = rest[i] - factor * rest[j]
            for m in range(j + 1, i + 1):
                a[i][m] = a[i][m] - factor * a[m][j]
    return jnp.where(good, total, jnp.inf)


def rmse(values: Array, mask: Array) -> Array:
    """Root mean square () of those of `values` (...) whose `mask` (...) is True.

    What the mask leaves out may be NaN. It is NaN if nothing is left; the gradient is 0 then, and
    also where the error is exactly 0.
    """
    count = jnp.sum(mask, dtype=values.dtype)
    square = jnp.sum(jnp.where(mask, values, 0.0) ** 2) / jnp.maximum(count, 1.0)
    above = square > 0.0
    root = jnp.where(above, jnp.sqrt(jnp.where(above, square, 1.0)), 0.0)
    return jnp.where(count > 0.0, root, jnp.nan)


def chi_square_bounds(dof: int, count: int, probability: float = 0.95) -> tuple[float, float]:
    """Range that holds the mean of `count` independent chi-square values with the probability.

    Args:
        dof: Degrees of freedom of each value: 3 for the NEES of a pose.
        count: How many are averaged.
        probability: Of the two-sided range.

    Returns:
        Lower and upper bound of the mean, on either side of `dof`.
    """
    tail = (1.0 - probability) / 2.0
    low, high = (float(chdtri(dof * count, p)) / count for p in (1.0 - tail, tail))
    return low, high


def align(estimate: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Rigid motion (3,) [m, m, rad] that best carries one set of points onto another.

    Args:
        estimate: (N, 2) [m].
        reference: (N, 2) [m], point by point the same.

    Returns:
        The pose of the frame of `estimate` in that of `reference`, by least squares.

    Raises:
        ValueError: The shapes differ, or there is no point.

    References:
        Umeyama (1991), without the scale.
    """
    estimate, reference = np.asarray(estimate, np.float64), np.asarray(reference, np.float64)
    if estimate.shape != reference.shape or estimate.ndim != 2 or estimate.size == 0:
        raise ValueError(f"points {estimate.shape} and {reference.shape} are not both (N >= 1, 2)")
    centre, goal = estimate.mean(axis=0), reference.mean(axis=0)
    a, b = estimate - centre, reference - goal
    angle = np.arctan2(
        np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
    )
    turned = composed(np.array([0.0, 0.0, angle]), np.append(centre, 0.0))
    return np.append(goal - turned[:2], angle)


def match_times(
    times: np.ndarray, reference_times: np.ndarray, tolerance: float = 0.05
) -> np.ndarray:
    """Pairs (K, 2) of indices of nearest times; each index occurs once at most.

    Args:
        times: (N,) [s], in any order.
        reference_times: (M,) [s], in any order.
        tolerance: Largest difference [s] of a pair.

    Returns:
        (K, 2) int, in the order of `times`.
    """
    times, reference_times = np.asarray(times, np.float64), np.asarray(reference_times, np.float64)
    if times.size == 0 or reference_times.size == 0:
        return np.zeros((0, 2), np.int64)
    order = np.argsort(reference_times, kind="stable")
    ahead = np.searchsorted(reference_times[order], times).clip(0, order.size - 1)
    near = np.stack([order[(ahead - 1).clip(0)], order[ahead]])  # (2, N)
    gaps = np.abs(reference_times[near] - times)
    side = np.argmin(gaps, axis=0)
    gap, partner = gaps[side, np.arange(times.size)], near[side, np.arange(times.size)]
    closest_first = np.argsort(gap, kind="stable")
    closest_first = closest_first[gap[closest_first] <= tolerance]
    chosen = closest_first[np.unique(partner[closest_first], return_index=True)[1]]
    chosen.sort()
    return np.stack([chosen, partner[chosen]], axis=1)


def ate(
    times: np.ndarray,
    poses: np.ndarray,
    ref_times: np.ndarray,
    ref_poses: np.ndarray,
    tolerance: float = 0.05,
) -> dict[str, float | int]:
    """Absolute trajectory error: of positions, after rigid alignment.

    Args:
        times: (N,) [s] of the estimate.
        poses: (N, 3) [m, m, rad].
        ref_times: (M,) [s] of the reference, same clock.
        ref_poses: (M, 3) [m, m, rad], any frame.
        tolerance: Largest difference [s] of times that belong together.

    Returns:
        `ate_rmse_m`, and `matched`: how many poses were compared.

    Raises:
        ValueError: Fewer than two times belong together.
    """
    pairs = match_times(times, ref_times, tolerance)
    if len(pairs) < 2:
        raise ValueError(f"{len(pairs)} times agree within {tolerance} s; are the clocks the same?")
    points = np.asarray(poses, np.float64)[pairs[:, 0]]
    goals = np.asarray(ref_poses, np.float64)[pairs[:, 1], :2]
    moved = composed(align(points[:, :2], goals), points)
    distance = np.linalg.norm(moved[:, :2] - goals, axis=1)
    return {"ate_rmse_m": float(np.sqrt(np.mean(distance**2))), "matched": len(pairs)}


def rpe(
    times: np.ndarray,
    poses: np.ndarray,
    ref_times: np.ndarray,
    ref_poses: np.ndarray,
    tolerance: float = 0.05,
    apart: float = 1.0,
) -> dict[str, float | None]:
    """Relative pose error: of the motions between poses of the reference some way apart.

    Each motion begins where the one before it has ended, `apart` or more along the reference.

    Args:
        times: (N,) [s] of the estimate.
        poses: (N, 3) [m, m, rad].
        ref_times: (M,) [s] of the reference, same clock.
        ref_poses: (M, 3) [m, m, rad], any frame.
        tolerance: Largest difference [s] of times that belong together.
        apart: Way [m] along the reference from one end of a motion to the other.

    Returns:
        `rpe_translation_rmse_m` and `rpe_rotation_rmse_deg`; None where the way is shorter.

    Raises:
        ValueError: `apart` is not positive.

    References:
        Sturm et al. (2012), A benchmark for the evaluation of RGB-D SLAM systems, section IV.
    """
    if not apart > 0.0:
        raise ValueError(f"motions {apart} m apart")
    i, j = match_times(times, ref_times, tolerance).T
    own, goal = np.asarray(poses, np.float64)[i], np.asarray(ref_poses, np.float64)[j]
    ends, way = [0], 0.0
    for k, part in enumerate(np.hypot(*np.diff(goal[:, :2], axis=0).T), start=1):
        way += part
        if way >= apart:
            ends.append(k)
            way = 0.0
    if len(ends) < 2:
        return {"rpe_translation_rmse_m": None, "rpe_rotation_rmse_deg": None}
    moved, wanted = (seen_from(x[ends[:-1]], x[ends[1:]]) for x in (own, goal))
    error = seen_from(wanted, moved)
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
    """How well a trajectory obeys verified relative poses.

    The pose at a relation's time is the last estimated one, moved on by the wheels since.

    Args:
        times: (T,) [s] of the estimate, in any order.
        poses: (T, 3) [m, m, rad].
        wheel_times: (N,) [s] of the wheel odometry, in any order.
        wheel_poses: (N, 3) [m, m, rad], read linearly between times.
        relations: Times t1 (K,) and t2 (K,) [s], and the pose (K, 3) at t2 in the frame at t1.

    Returns:
        `translation_mean_m`, `translation_std_m`, `rotation_mean_deg`, `rotation_std_deg` of the
        absolute errors, and `used`: relations within the time span of the estimate.

    Raises:
        ValueError: None is.

    References:
        Kuemmerle et al. (2009), On measuring the accuracy of SLAM algorithms.
    """
    t1, t2, motion = (np.asarray(part, np.float64) for part in relations)
    slack = 1e-5  # [s] for the rounding of written times
    first = np.min(times) - slack
    last = max(np.max(times), np.max(wheel_times)) + slack
    used = (np.minimum(t1, t2) >= first) & (np.maximum(t1, t2) <= last)
    if not used.any():
        raise ValueError(f"no relation lies within the trajectory's times {first} to {last} s")
    start, end = (
        _pose_at(t[used], slack, times, poses, wheel_times, wheel_poses) for t in (t1, t2)
    )
    error = seen_from(motion[used], seen_from(start, end))
    distance = np.hypot(error[:, 0], error[:, 1])
    turn = np.degrees(np.abs(error[:, 2]))
    return {
        "translation_mean_m": float(distance.mean()),
        "translation_std_m": float(distance.std()),
        "rotation_mean_deg": float(turn.mean()),
        "rotation_std_deg": float(turn.std()),
        "used": int(used.sum()),
    }


def _pose_at(
    wanted: np.ndarray,
    slack: float,
    times: np.ndarray,
    poses: np.ndarray,
    wheel_times: np.ndarray,
    wheel_poses: np.ndarray,
) -> np.ndarray:
    """Poses (K, 3) at times (K,) [s]: the last estimate before, moved on by the wheels."""
    times, poses = by_time(times, poses)
    last = np.searchsorted(times, wanted + slack, side="right") - 1
    wheels = by_time(wheel_times, wheel_poses)
    moved = seen_from(interpolate(times[last], *wheels), interpolate(wanted, *wheels))
    return composed(poses[last], moved)
