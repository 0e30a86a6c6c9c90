"""Time series of poses, in NumPy: sorting, interpolation, association by time stamp."""

import numpy as np


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


def sort_by_time(times: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses in float64, sorted stably by time."""
    order = np.argsort(times, kind="stable")
    return np.asarray(times, np.float64)[order], np.asarray(poses, np.float64)[order]


def interpolate_poses(wanted: np.ndarray, times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (K, 3) at times (K,) [s], linearly between poses (N, 3) at sorted times (N,) [s]."""
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    return np.stack([np.interp(wanted, times, column) for column in columns], axis=-1)
