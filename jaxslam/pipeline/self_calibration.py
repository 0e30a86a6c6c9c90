"""Calibration of a recorded log by itself: its wheels against its own scans, without any truth.

Scan matching expects a scan where the wheels have it. Where the scans show little, as along a
corridor, it stays there, and wheels that are wrong would confirm themselves; where they show much,
a little of that is left. So the scans are matched again with calibrated wheels, until the
calibration stays the same:

    repeat:
        match all scans, with odometry as calibrated so far
        cut the drive into spans between keyframes; leave out those with guessed or lost odometry
        estimate the calibration from the matched motion of the spans (`odometry_calibration`)

Then SLAM is run with calibrated odometry. Which systematic error turns a robot about which point
depends on where its wheels are. A robot on two wheels does not move sideways in the frame between
them: the poses of a log are those of that frame if they do not, and else it is found from how they
do (`wheel_frame`).
"""

from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.calibration import Calibration, along_arc, calibrate_odometry
from jaxslam.core.logs import LaserLog
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.se2_np import compose, dead_reckoning, relative, wrap_angle
from jaxslam.core.types import AnyArray
from jaxslam.pipeline import breaks, keyframes, odometry_notes, online
from jaxslam.pipeline.log_input import LogInput, OdometrySource
from jaxslam.smoothing.odometry_calibration import (
    CalibrationEstimate,
    MotionSpans,
    contradicted,
    estimate_calibration,
    flat,
)

MAX_ROUNDS = 6
"""Times that all scans are matched, at most."""

CONVERGED = 0.2
"""Standard errors by which no number changes any more in the last round."""

MATCH_STD_SCALE = 0.3
"""Factor on the standard deviation that scan matching states, as of `NoiseParams`."""

MAX_TIMES_BACK = 0.01
"""Fraction of the time stamps that may run backwards, for the others to be trusted."""

LEAST_INTERVAL = 1e-6
"""[s] between two scans."""

MIN_INTERVAL = 0.1
"""Interval between two scans, of the median one, below which their stamps are those of a queue."""

IRLS_ITERATIONS = 30

MAX_CONTRADICTED = 0.5
"""Share of the spans over which wheels may move otherwise than the scans show, at most."""

MAINLY_SIDEWAYS = 2.0
"""Motion to the side, of that ahead, from which the frame of the odometry is a quarter turn off."""

LEFT_SIDEWAYS = 0.5
"""Share of the median sideways motion that may be left in the frame between the wheels."""


class LogCalibration(NamedTuple):
    """Calibration of a log.

    Attributes:
        estimate: The calibration, and how sure it is.
        mount: (3,) [m, m, rad] where the scanner was taken to be, in the frame between the wheels.
        num_rounds: How often all scans were matched.
        spans: Of the drive, as they were matched last.
        is_settled: Whether the calibration has come to rest in these rounds.
    """

    estimate: CalibrationEstimate
    mount: np.ndarray
    num_rounds: int
    spans: MotionSpans
    is_settled: bool


def calibrate_log(
    log: LaserLog,
    given: LogInput,
    mean: Calibration | None = None,
    prior_std: Calibration | None = None,
    *,
    mount: AnyArray | None = None,
) -> LogCalibration:
    """Calibrate the odometry of a log, and the place of its scanner, by scan matching.

    Args:
        log: The log.
        given: The same as input of SLAM.
        mean: As of `estimate_calibration`; the calibration that the first matching begins with.
        prior_std: As of `estimate_calibration`.
        mount: (3,) where the scanner was taken to be, in the frame between the wheels; by default
            as of `wheel_frame`.

    Raises:
        ValueError: The log has no odometry, or it is not used; or its wheels move otherwise than
            its scans show.
    """
    require_wheels(log, given.odometry_source)
    calibration = Calibration.identity() if mean is None else mean
    odometry, is_share, _ = _shared(given)
    guessed = _guessed(given) | is_share
    taken = wheel_frame(odometry, log.mount, ~guessed) if mount is None else np.asarray(mount)
    times, before = usable_times(log.times), flat(calibration)
    num_rounds, change = 0, np.full(len(before), np.inf)
    limit = np.zeros(len(before))
    while num_rounds < MAX_ROUNDS and np.any(change > limit):
        num_rounds += 1
        moved = calibrate_odometry(calibration, odometry, times=times, mount=taken)
        matches = online.match_log(given.config, moved, given.scans, odometry_guessed=guessed)
        spans = motion_spans(given, odometry, matches, guessed, times, taken)
        estimate = estimate_calibration(spans, mean, prior_std)
        calibration = estimate.calibration
        change, before = flat(calibration) - before, flat(calibration)
        change[5] = wrap_angle(change[5])
        change = np.abs(change)
        limit = CONVERGED * flat(estimate.standard_errors)
    is_settled = bool(np.all(change <= limit))
    require_agreement(calibration, spans)
    return LogCalibration(estimate, taken, num_rounds, spans, is_settled)


def require_agreement(calibration: Calibration, spans: MotionSpans) -> None:
    """Raise unless calibrated wheels move as the scans show, but for some spans.

    Args:
        calibration: Of the robot.
        spans: Of its drive.

    Raises:
        ValueError: There is no usable span, or at most of them the wheels move otherwise, or they
            turn to the other side.
    """
    num_off, count = int(contradicted(calibration, spans).sum()), int(spans.usable.sum())
    if not count:
        raise ValueError("there is no motion to calibrate by: no two scans could be matched")
    if num_off > MAX_CONTRADICTED * count:
        raise ValueError(
            f"its wheels, however calibrated, do not move as its scans show at {num_off} of "
            f"{count} spans; check odometry and scans of the log, or leave out the calibration"
        )
    if calibration.turn_scale < 0.0:
        raise ValueError(
            f"its scans turn against its wheels, turn_scale {calibration.turn_scale:.3f}: one of "
            "both is mirrored; see --upside-down"
        )


def calibrated(
    log: LaserLog, given: LogInput, calibration: Calibration, mount: AnyArray
) -> LogInput:
    """The input of SLAM with calibrated odometry.

    Args:
        log: The log.
        given: The same as input of SLAM.
        calibration: Of the robot.
        mount: (3,) as of `LogCalibration`.

    Raises:
        ValueError: The log has no odometry, or it is not used.
    """
    require_wheels(log, given.odometry_source)
    odometry, is_share, notes = _shared(given)
    times = usable_times(log.times)
    if times is None and calibration.time_offset:
        notes += ("the calibration's time offset is not used: time stamps cannot be trusted",)
    moved = calibrate_odometry(calibration, odometry, times=times, mount=np.asarray(mount))
    return given._replace(
        odom_poses=dead_reckoning(np.zeros(3), moved),
        increments=moved,
        guessed=_guessed(given) | is_share,
        notes=given.notes + notes,
    )


def require_wheels(log: LaserLog, source: OdometrySource = "scan") -> None:
    """Raise unless there are wheels to calibrate.

    Args:
        log: The log.
        source: Where the motion between scans comes from.

    Raises:
        ValueError: The log has no odometry, or it is not used.
    """
    if not log.has_odometry:
        raise ValueError("there is no odometry to calibrate: the log has none that can be used")
    if source == "scans-only":
        raise ValueError("there is no odometry to calibrate where scans alone are matched")


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


def motion_spans(
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


def _guessed(given: LogInput) -> np.ndarray:
    """Which increments (T,) are guesses of the reader."""
    return np.zeros(len(given.increments), bool) if given.guessed is None else given.guessed


def _shared(given: LogInput) -> Any:
    """As of `odometry_notes.share_out`."""
    return odometry_notes.share_out(
        given.increments, given.scans, given.after_pause | given.new_drive
    )
