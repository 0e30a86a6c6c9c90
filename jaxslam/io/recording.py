"""What the readers of recorded logs return."""

from typing import NamedTuple

import numpy as np

from jaxslam.lidar import Lidar

NOISE = 0.02
"""Standard deviation [m] of a range; no log says it."""

REACH = 20.0
"""Range [m] from which on a reading of an indoor scanner counts as no return."""

TOLERATED = 0.05
"""Part of a log's lines or scans that may be broken: they are left out and counted."""


class Recording(NamedTuple):
    """A recorded drive of T scans of R beams, in file order: time stamps may run backwards.

    Poses are those the wheels report, in the frame of the wheel odometry.
    """

    times: np.ndarray  # (T,) float64 [s] of each scan
    odometry: np.ndarray  # (T, 3) float64 [m, m, rad] wheel pose of each scan
    ranges: np.ndarray  # (T, R) float32 [m]; inf where nothing returned
    lidar: Lidar
    skipped: int  # broken lines, or scans without odometry, left out
    wheel_times: np.ndarray  # (N,) float64 [s] of the whole stream of wheel poses
    wheel_poses: np.ndarray  # (N, 3) float64 [m, m, rad]; the scans' own if there is no stream
    source: str = ""  # what of the log it is, where there was a choice
    mended: tuple[str, ...] = ()  # what was wrong with the odometry, and is put right here


class Sightings(NamedTuple):
    """A recorded drive of a robot whose sensor tells range, bearing and name of landmarks.

    T steps in order of time, with up to M of the L landmarks each, or none. Motions are in the
    frame of the step before. Left out are measurements of unknown names, and a second one of a
    landmark at the same time.
    """

    times: np.ndarray  # (T,) float64 [s]
    motion: np.ndarray  # (T, 3) float64 [m, m, rad] by odometry since the step before; first: 0
    polar: np.ndarray  # (T, M, 2) float32 range [m] and bearing [rad]; zero for padding
    valid: np.ndarray  # (T, M) bool, False marks padding, which comes last
    which: np.ndarray  # (T, M) int32 number 0..L-1 of the landmark; -1 for padding
    truth: np.ndarray  # (T, 3) float64 [m, m, rad] reference pose, world frame; zero where none
    referenced: np.ndarray  # (T,) bool, where there is one
    places: np.ndarray  # (L, 2) float64 [m] reference positions of the landmarks, world frame
    names: np.ndarray  # (L,) int32 what the recording calls them
    skipped: int  # measurements left out


def no_return(ranges: np.ndarray, reach: float) -> np.ndarray:
    """Ranges [m] as float32, infinite where they are not above zero or not below `reach`."""
    ranges = ranges.copy()
    ranges[~((ranges > 0.0) & (ranges < np.float32(reach)))] = np.inf
    ranges = ranges.astype(np.float32)
    ranges[ranges >= np.float32(reach)] = np.inf
    return ranges
