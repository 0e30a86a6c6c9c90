"""A recorded drive as `odometry_calibration` takes it: what wheels and scans say of each span.

Here are the checks of what a log says: which of its time stamps can be trusted, in which frame its
poses are, and which spans say nothing.
"""

import numpy as np

from jaxslam.core.calibration import along_arc
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.se2_np import compose, dead_reckoning, relative
from jaxslam.pipeline import breaks, keyframes
from jaxslam.pipeline.log_input import LogInput
from jaxslam.smoothing.odometry_calibration import MotionSpans

MATCH_STD_SCALE = 0.3
"""Factor on the standard deviation that scan matching states, as of `NoiseParams`."""

MAX_TIMES_BACK = 0.01
"""Fraction of the time stamps that may run backwards, for the others to be trusted."""

LEAST_INTERVAL = 1e-6
"""[s] between two scans."""

MIN_INTERVAL = 0.1
"""Interval between two scans, of the median one, below which their stamps are those of a queue."""

IRLS_ITERATIONS = 30

MAINLY_SIDEWAYS = 2.0
"""Motion to the side, of that ahead, from which the frame of the odometry is a quarter turn off."""

LEFT_SIDEWAYS = 0.5
"""Share of the median sideways motion that may be left in the frame between the wheels."""


def usable_times(times: np.ndarray) -> np.ndarray | None:
    """Time stamps (T,) [s] since the first one, increasing; None where they cannot be trusted.

    A stamp that runs backwards, or is as the one before, becomes one just after it.
    """
    times = np.asarray(times, np.float64)
    if len(times) < 2 or np.mean(np.diff(times) < 0.0) > MAX_TIMES_BACK or not np.ptp(times):
        return None
    return np.maximum.accumulate(times - times[0]) + LEAST_INTERVAL * np.arange(len(times))


def wheel_frame(odometry: np.ndarray, mount: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Pose (3,) of the scanner in the frame between the wheels, by how its odometry moves.

    A frame at (a, 0, b) in that between two wheels, which moves by d ahead and turns by t, moves
    sideways by

        s = (a / cos b) t - tan(b) d

    as its poses do that are not those of the wheels. Where this is not how they move sideways, as
    of a robot that can drive to all sides, the poses are taken to be those of the wheels.

    Args:
        odometry: (T, 3) [m, m, rad] increments of the scanner.
        mount: (3,) [m, m, rad] of the scanner in the frame of the robot whose odometry this is.
        usable: (T,) bool, which increments are not guesses.
    """
    taken, zero = np.array(mount, np.float64), np.zeros(3)
    of_robot = compose(compose(taken, odometry), relative(taken, zero))[usable]
    if not len(of_robot):
        return taken
    quarter = np.array([0.0, 0.0, _quarter_turn(of_robot)])
    if quarter[2]:
        taken = compose(relative(quarter, zero), taken)
        of_robot = compose(compose(taken, odometry), relative(taken, zero))[usable]
    turn = of_robot[:, 2]
    ahead, sideways = along_arc(of_robot).T
    by, weight = np.stack([turn, -ahead], axis=1), np.ones(len(turn))
    for _ in range(IRLS_ITERATIONS):  # with the Cauchy kernel
        (lever, tan), *_ = np.linalg.lstsq(by * weight[:, None], weight * sideways, rcond=None)
        left = np.abs(sideways - by @ [lever, tan])
        weight = 1.0 / np.sqrt(1.0 + (left / max(np.median(left), 1e-6)) ** 2)
    if np.median(left) > LEFT_SIDEWAYS * np.median(np.abs(sideways)):
        return taken
    yaw = np.arctan(tan)
    return compose(np.array([lever * np.cos(yaw), 0.0, yaw]), taken)


def _quarter_turn(of_robot: np.ndarray) -> float:
    """Direction [rad] in which a robot with increments (n, 3) drives, if it is to a side; else 0.

    What it moves by as it turns is left out: that is of a frame off the axle.
    """
    turn = of_robot[:, 2:]
    moved = along_arc(of_robot)
    moved = moved - turn * (turn.T @ moved) / max(float(np.sum(turn**2)), 1e-12)
    ahead, sideways = np.median(np.abs(moved), axis=0)
    if sideways <= MAINLY_SIDEWAYS * ahead:
        return 0.0
    return float(np.copysign(np.pi / 2, np.sum(moved[:, 1])))


def between_keyframes(
    given: LogInput,
    odometry: np.ndarray,
    matches: ScanMatch,
    guessed: np.ndarray,
    times: np.ndarray | None,
    mount: np.ndarray,
) -> MotionSpans:
    """The spans of a drive between keyframes.

    Args:
        given: Input of SLAM.
        odometry: (T, 3) [m, m, rad] increments that are not calibrated.
        matches: [T] of scan matching.
        guessed: (T,) bool, which increments of the odometry are guesses.
        times: (T,) [s] as of `usable_times`.
        mount: (3,) as of `LogCalibration`.
    """
    found = np.asarray(matches.increment, np.float64)
    distance = keyframes.distance_for_log(given.config.keyframe_distance, found)
    is_keyframe, _ = keyframes.choose_keyframes(distance, found)
    is_keyframe[-1] = True
    ends = np.flatnonzero(is_keyframe)
    motion = keyframes.compose_matches(matches, is_keyframe)
    inliers = np.asarray(matches.inlier_fraction)
    bad = guessed | given.after_pause | given.new_drive | (inliers < breaks.PAUSE_INLIERS)
    bad |= ~np.asarray(matches.information).any(axis=(1, 2)) | _in_queue(times, len(found))
    num_bad = np.cumsum(bad)
    reported = dead_reckoning(np.zeros(3), odometry)
    first, last = ends[:-1], ends[1:]
    gone = relative(reported[first], reported[last])
    information = np.asarray(motion.information, np.float64)[1:] / MATCH_STD_SCALE**2
    return MotionSpans(
        times=times,
        odometry=odometry,
        mount=mount,
        first=first.astype(np.int32),
        last=last.astype(np.int32),
        increment=np.asarray(motion.increment, np.float64)[1:],
        match_cov=np.linalg.inv(information + keyframes.NO_INFORMATION * np.eye(3)),
        driven=np.stack([np.hypot(gone[:, 0], gone[:, 1]), np.abs(gone[:, 2])], axis=1),
        usable=num_bad[last] == num_bad[first],
    )


def _in_queue(times: np.ndarray | None, count: int) -> np.ndarray:
    """Whether each of `count` scans was stamped at once with another, and not when it was taken.

    By such a stamp, the robot would have driven a whole increment in no time.
    """
    queued = np.zeros(count, bool)
    if times is None:
        return queued
    interval = np.diff(times)
    short = np.flatnonzero(interval < MIN_INTERVAL * np.median(interval))
    for k in (0, 1, 2):  # the increments before, between both, and after
        queued[np.minimum(short + k, count - 1)] = True
    return queued
