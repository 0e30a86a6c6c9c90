"""Where a drive is broken: from one scan to the next the robot was moved, and none knows how far.

A robot that was carried, or whose log lacks scans, is found out by its first scan after that.
After a pause of the scanner, this contradicts the wheels, or explains little. Without a pause,
hardly any of it is explained, though a wide window was searched, or little, and the wheels were
contradicted as well. What comes after a break is a
piece of its own, with a trajectory and walls in its own frame; `pieces` joins them.
"""

import numpy as np

from jaxslam.core.measurement import ScanMatch
from jaxslam.core.types import as_float64

PAUSE = (5.0, 2.0)
"""Least interval between two scans that is a pause: of the median interval, and [s]."""

PAUSE_INLIERS = 0.3
"""Inlier fraction below which the first scan after a pause shows another place."""

BREAK_INLIERS = 0.2
"""The same for any scan."""

BOTH_FAIL = (0.4, 0.8)
"""Inlier fraction, and weight of the wheels, below both of which neither of them says anything."""

MAX_UNKNOWN_MOTION = (0.3, 0.3)
"""[m], [rad] of motion during a pause, where no wheels say that there was any."""

MIN_RETURNS = 20
"""Beams with a return, fewer of which show no place at all."""


def pauses(times: np.ndarray) -> np.ndarray:
    """Whether each scan (T,) follows a pause.

    Args:
        times: (T,) [s] in the order of the scans.

    Raises:
        ValueError: They are not finite numbers.
    """
    times = as_float64("times", times, ("T",))
    if not np.isfinite(times).all():
        raise ValueError(f"times[{int(np.argmin(np.isfinite(times)))}] is not a finite number")
    interval = np.diff(times, prepend=times[:1])
    usual = np.median(interval[1:]) if len(times) > 1 else 0.0
    return interval > max(PAUSE[0] * usual, PAUSE[1])


def first_break(
    matches: ScanMatch, num_returns: np.ndarray, after_pause: np.ndarray, *, use_odometry: bool
) -> int | None:
    """Index of the first of N successive scans that begins another piece; None if none does.

    Args:
        matches: [N], NumPy.
        num_returns: (N,) int beams of each scan with a return.
        after_pause: (N,) bool, which scans follow a pause.
        use_odometry: Whether the matches are expected where the wheels have them.
    """
    inliers, moved = np.asarray(matches.inlier_fraction), np.abs(np.asarray(matches.increment))
    broken = inliers < BREAK_INLIERS
    if use_odometry:
        weight = np.asarray(matches.odometry_weight)
        broken |= (inliers < BOTH_FAIL[0]) & (weight < BOTH_FAIL[1])
        contradicts = weight < 0.5
    else:
        contradicts = np.hypot(moved[:, 0], moved[:, 1]) > MAX_UNKNOWN_MOTION[0]
        contradicts |= moved[:, 2] > MAX_UNKNOWN_MOTION[1]
    broken |= after_pause & (contradicts | (inliers < PAUSE_INLIERS))
    found = np.flatnonzero(broken & (num_returns >= MIN_RETURNS))
    return int(found[0]) if found.size else None
