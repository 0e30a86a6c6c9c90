"""Records that the readers of logs return: laser logs and landmark logs."""

from typing import NamedTuple

import numpy as np

from jaxslam.lidar import Lidar

NOISE = 0.02
"""Standard deviation [m] of a range; logs do not state it."""

REACH = 20.0
"""Default range_max [m] of an indoor scanner: from here on a reading counts as no return."""

TOLERATED = 0.05
"""Fraction of a log's lines or scans that may be broken; they are skipped and counted."""


class Recording(NamedTuple):
    """A log of T laser scans of R beams with odometry, in file order: times may decrease.

    Poses are by odometry, in the odometry frame (`odom`).

    Attributes:
        times: (T,) float64 [s] of each scan.
        odometry: (T, 3) float64 [m, m, rad] pose by odometry at each scan.
        ranges: (T, R) float32 [m]; inf where there is no return.
        lidar: The scanner.
        skipped: Number of broken lines, or of scans without odometry, left out.
        wheel_times: (N,) float64 [s] of the whole odometry stream.
        wheel_poses: (N, 3) float64 [m, m, rad] of the odometry stream; those of the scans if the
            log has no separate stream.
        source: Topics that were read, for messages; "" where there is no choice.
        mended: Odometry repairs: what was wrong with the odometry and has been corrected.
    """

    times: np.ndarray
    odometry: np.ndarray
    ranges: np.ndarray
    lidar: Lidar
    skipped: int
    wheel_times: np.ndarray
    wheel_poses: np.ndarray
    source: str = ""
    mended: tuple[str, ...] = ()


class Sightings(NamedTuple):
    """A log of landmark measurements: range, bearing and ID, with odometry.

    T steps in order of time, with up to M of the L landmarks each, or none. Measurements of unknown
    IDs are left out, and so is a second one of a landmark at the same time.

    Attributes:
        times: (T,) float64 [s].
        motion: (T, 3) float64 [m, m, rad] odometry increment since the step before, in the frame
            of that step; the first is 0.
        polar: (T, M, 2) float32 range [m] and bearing [rad]; zero for padding.
        valid: (T, M) bool, False marks padding, which comes last.
        which: (T, M) int32 index 0..L-1 of the landmark; -1 for padding.
        truth: (T, 3) float64 [m, m, rad] reference pose, world frame; zero where there is none.
        referenced: (T,) bool, where there is a reference pose.
        places: (L, 2) float64 [m] reference positions of the landmarks, world frame.
        names: (L,) int32 IDs of the landmarks in the log.
        skipped: Number of measurements left out.
    """

    times: np.ndarray
    motion: np.ndarray
    polar: np.ndarray
    valid: np.ndarray
    which: np.ndarray
    truth: np.ndarray
    referenced: np.ndarray
    places: np.ndarray
    names: np.ndarray
    skipped: int


def no_return(ranges: np.ndarray, reach: float) -> np.ndarray:
    """Mark readings that are no return.

    Args:
        ranges: Any shape [m].
        reach: range_max [m].

    Returns:
        The ranges as float32, infinite where they are not above zero or not below `reach`.
    """
    ranges = ranges.copy()
    ranges[~((ranges > 0.0) & (ranges < np.float32(reach)))] = np.inf
    ranges = ranges.astype(np.float32)
    ranges[ranges >= np.float32(reach)] = np.inf
    return ranges
