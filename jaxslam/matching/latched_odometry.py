"""Latched odometry: the same pose for some scans, then the whole motion at once.

A driver that is behind reports an old pose again, and makes up for it later. Between scans far
apart, the leap is further than scan matching can look. So it is shared out evenly over the scans
that had no motion, where the scans say that there was some. It needs the scans after: it is for
whole logs, before SLAM.
"""

import numpy as np

from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import motion_size

MAX_LATCHED = 6
"""Increments without motion that a leap is shared out over, at most."""

NEIGHBOURS = 10
"""Increments with motion on either side, whose median is the usual one."""

MIN_SHARE = 0.25
"""Least size of a share, of the usual increment's: after a stop a robot starts slowly."""

MIN_LEAP = 1.5
"""Size of a leap, of the usual increment's, that is one whatever the scans show."""

CHANGED_RANGE = 0.1
"""[m] difference of a beam's range in two scans from which it has changed."""

MIN_CHANGED = 0.3
"""Fraction of the beams that changes where a robot moves; less where only people do."""


def share_out_leaps(
    odometry: np.ndarray, scans: Scan, unknown: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, int]:
    """Share out the leaps of latched odometry over the scans before them.

    A leap is an increment after up to `MAX_LATCHED` increments of no motion at all, if its share is
    like the increments around it, and either it is too large for one increment, or the scans have
    changed while there was none.

    Args:
        odometry: (T, 3) [m, m, rad] increments.
        scans: [T], NumPy.
        unknown: (T,) bool, before which scans the robot may have been carried: no leap makes up for
            that; none by default.

    Returns:
        Increments (T, 3) with the same poses after each leap; (T,) bool, which of them are shares
        of one; and the number of leaps.
    """
    size = motion_size(odometry)
    moving = [int(k) for k in np.flatnonzero(size > 1e-6)]
    shared, is_share, num_leaps = odometry.copy(), np.zeros(len(odometry), bool), 0
    for at, leap in enumerate(moving):
        first = moving[at - 1] + 1 if at else 1
        count = leap - first + 1
        carried = unknown is not None and unknown[first : leap + 1].any()
        if carried or not 2 <= count <= MAX_LATCHED + 1:
            continue
        around = moving[max(at - NEIGHBOURS, 0) : at] + moving[at + 1 : at + 1 + NEIGHBOURS]
        usual = np.median(size[around]) if around else np.inf
        if size[leap] < MIN_SHARE * count * usual:
            continue
        too_large = size[leap] > MIN_LEAP * usual
        if too_large or _changed_fraction(scans, first - 1, leap - 1) > MIN_CHANGED:
            shared[first : leap + 1] = equal_increments(odometry[leap], count)
            is_share[first : leap + 1] = True
            num_leaps += 1
    return shared, is_share, num_leaps


def equal_increments(motion: np.ndarray, count: int) -> np.ndarray:
    """`count` equal increments (3,) that make up a motion (3,) [m, m, rad].

    With the turn a = turn / count of each, t + R(a) t + R(2 a) t + ... is the whole translation; in
    complex numbers a product of t with the sum of e^(i k a).
    """
    turn = motion[2] / count
    step = complex(motion[0], motion[1]) / np.exp(1j * turn * np.arange(count)).sum()
    return np.array([step.real, step.imag, turn])


def _changed_fraction(scans: Scan, first: int, second: int) -> float:
    """Fraction of the beams that hit in both of two scans, and whose range has changed."""
    both = np.asarray(scans.hit[first]) & np.asarray(scans.hit[second])
    change = np.abs(np.asarray(scans.ranges[first]) - np.asarray(scans.ranges[second]))
    return float(np.mean(change[both] > CHANGED_RANGE)) if both.any() else 0.0
