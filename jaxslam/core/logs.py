"""Recorded logs, as the readers return them: laser scans, landmark measurements, relations."""

from typing import Any, NamedTuple, Self

import numpy as np

from jaxslam.core.scan import Lidar, check_lidar
from jaxslam.core.types import as_float64

DEFAULT_RANGE_STD = 0.02
"""Standard deviation [m] of a range; logs do not state it."""

DEFAULT_RANGE_MAX = 20.0
"""Range [m] of an indoor scanner from which on a reading counts as no return, by default."""

MAX_BROKEN_FRACTION = 0.05
"""Fraction of a log's lines or scans that may be broken; they are skipped and counted."""


class LaserLog(NamedTuple):
    """A log of T laser scans of R beams with odometry, in file order: times may decrease.

    Poses are by odometry, in the odometry frame (`odom`).

    Attributes:
        times: (T,) float64 [s] of each scan.
        odom_poses: (T, 3) float64 [m, m, rad] pose by odometry at each scan.
        ranges: (T, R) float32 [m]; inf where there is no return.
        lidar: The scanner.
        num_skipped: Number of broken lines, or of scans without odometry, left out.
        odom_stream_times: (N,) float64 [s] of the whole odometry stream.
        odom_stream_poses: (N, 3) float64 [m, m, rad] of the odometry stream; those of the scans if
            the log has no separate stream.
        source: Topics that were read, for messages; "" where there is no choice.
        notes: What was wrong with the log and has been corrected, or had to be assumed.
        has_odometry: Whether there is odometry at all; if not, its poses stand still.
        odometry_guessed: (T,) bool, whether the increment of the odometry to a scan is not to be
            trusted: it was lost or interpolated; None if all are to be.
        mount: (3,) [m, m, rad] pose of the scanner in the robot frame (`base_link`), as far as it
            is known; the identity if not.
        frames: Names of the robot's frame and of the scanner's, as far as the log has them.
    """

    times: np.ndarray
    odom_poses: np.ndarray
    ranges: np.ndarray
    lidar: Lidar
    num_skipped: int
    odom_stream_times: np.ndarray
    odom_stream_poses: np.ndarray
    source: str = ""
    notes: tuple[str, ...] = ()
    has_odometry: bool = True
    odometry_guessed: np.ndarray | None = None
    mount: np.ndarray = np.zeros(3)
    frames: tuple[str, str] = ("", "")

    @classmethod
    def from_arrays(
        cls,
        times: Any,
        odom_poses: Any,
        ranges: Any,
        lidar: Lidar,
        *,
        odom_stream_times: Any = None,
        odom_stream_poses: Any = None,
    ) -> Self:
        """A log made of arrays, lists or JAX arrays, which are checked and copied.

        Args:
            times: (T,) [s] of each scan, T >= 1.
            odom_poses: (T, 3) [m, m, rad] pose of the scanner by odometry at each scan.
            ranges: (T, R) [m]; NaN, infinite, not above 0 or not below `lidar.range_max` where
                there is no return.
            lidar: The scanner, of R >= 2 beams.
            odom_stream_times: (N,) [s] of the whole odometry stream, if there is more of it than
                the poses of the scans.
            odom_stream_poses: (N, 3) [m, m, rad] of the odometry stream.

        Raises:
            ValueError: An argument has another shape, is not numbers or not finite; the scanner is
                impossible; or one of the last two arguments is given without the other.
        """
        check_lidar(lidar)
        times = _finite("times", times, ("T",))
        if not times.size:
            raise ValueError("times is empty: a log has at least one scan")
        odom_poses = _finite("odom_poses", odom_poses, (times.size, 3))
        ranges = as_float64("ranges", ranges, (times.size, lidar.num_beams))
        if (odom_stream_times is None) != (odom_stream_poses is None):
            raise ValueError("odom_stream_times and odom_stream_poses: give both or neither")
        if odom_stream_times is None:
            odom_stream_times, odom_stream_poses = times, odom_poses
        odom_stream_times = _finite("odom_stream_times", odom_stream_times, ("N",))
        odom_stream_poses = _finite(
            "odom_stream_poses", odom_stream_poses, (odom_stream_times.size, 3)
        )
        return cls(
            times=times,
            odom_poses=odom_poses,
            ranges=mark_no_return(ranges, lidar.range_max),
            lidar=lidar,
            num_skipped=0,
            odom_stream_times=odom_stream_times,
            odom_stream_poses=odom_stream_poses,
            odometry_guessed=np.zeros(times.size, bool),
        )


class LandmarkLog(NamedTuple):
    """A log of landmark measurements: range, bearing and ID, with odometry.

    T steps in order of time, with up to M of the L landmarks each, or none. Measurements of unknown
    IDs are left out, and so is a second one of a landmark at the same time.

    Attributes:
        times: (T,) float64 [s].
        odometry: (T, 3) float64 [m, m, rad] odometry increment since the step before, in the frame
            of that step; the first is 0.
        range_bearing: (T, M, 2) float32 range [m] and bearing [rad]; zero for padding.
        valid: (T, M) bool, False marks padding, which comes last.
        landmark_index: (T, M) int32 index 0..L-1 of the landmark; -1 for padding.
        truth: (T, 3) float64 [m, m, rad] reference pose, world frame; zero where there is none.
        truth_mask: (T,) bool, where there is a reference pose.
        landmark_positions: (L, 2) float64 [m] reference positions of the landmarks, world frame.
        landmark_names: (L,) int32 IDs of the landmarks in the log.
        num_skipped: Number of measurements left out.
    """

    times: np.ndarray
    odometry: np.ndarray
    range_bearing: np.ndarray
    valid: np.ndarray
    landmark_index: np.ndarray
    truth: np.ndarray
    truth_mask: np.ndarray
    landmark_positions: np.ndarray
    landmark_names: np.ndarray
    num_skipped: int


class Relations(NamedTuple):
    """N relative poses between two times of a log.

    Attributes:
        t1: (N,) [s].
        t2: (N,) [s].
        relative_pose: (N, 3) [m, m, rad] pose at t2 in the robot frame at t1.

    References:
        Kuemmerle et al. (2009), On measuring the accuracy of SLAM algorithms.
    """

    t1: np.ndarray
    t2: np.ndarray
    relative_pose: np.ndarray


def mark_no_return(ranges: np.ndarray, range_max: float) -> np.ndarray:
    """Mark readings that are no return.

    Args:
        ranges: Floats of any shape [m].
        range_max: Range [m] from which on a reading counts as no return.

    Returns:
        The ranges as float32, infinite where they are not above zero or not below `range_max`.
    """
    ranges = ranges.copy()
    ranges[~((ranges > 0.0) & (ranges < np.float32(range_max)))] = np.inf
    ranges = ranges.astype(np.float32)
    ranges[ranges >= np.float32(range_max)] = np.inf
    return ranges


def _finite(name: str, x: Any, shape: tuple[Any, ...]) -> np.ndarray:
    """A copy of numbers as float64 of this shape; raise ValueError if one is not finite."""
    numbers = as_float64(name, x, shape).copy()
    if not np.isfinite(numbers).all():
        index = tuple(np.argwhere(~np.isfinite(numbers))[0].tolist())
        raise ValueError(f"{name}{list(index)} is {numbers[index]}, not a finite number")
    return numbers
