"""What every reader of recorded logs returns."""

from typing import NamedTuple

import numpy as np

from jaxslam.lidar import Lidar


class Recording(NamedTuple):
    """A recorded drive of T scans of R beams, in file order: time stamps may run backwards.

    Poses are those the wheels report, in the frame of the wheel odometry.
    """

    times: np.ndarray  # (T,) float64 [s] of each scan
    odometry: np.ndarray  # (T, 3) float64 [m, m, rad] wheel pose of each scan
    ranges: np.ndarray  # (T, R) float32 [m]; inf where nothing returned
    lidar: Lidar
    skipped: int  # broken lines left out
    wheel_times: np.ndarray  # (N,) float64 [s] of the whole stream of wheel poses
    wheel_poses: np.ndarray  # (N, 3) float64 [m, m, rad]; the scans' own if there is no stream
