"""Calibration of a recorded log by itself: its wheels against its own scans, without any truth.

Scan matching expects a scan where the wheels have it. Where the scans show little, as along a
corridor, it stays there, and wheels that are wrong would confirm themselves; where they show much,
a little of that is left. So the scans are matched again with calibrated wheels, until the
calibration stays the same:

    repeat:
        match all scans, with odometry as calibrated so far
        cut the drive into spans between keyframes; leave out those with guessed or lost odometry
        estimate the calibration from the matched motion of the spans (`odometry_calibration`)
        begin the next round where the last two rounds point to, number by number (secant method)

Then SLAM is run with calibrated odometry. Which systematic error turns a robot about which point
depends on where its wheels are. A robot on two wheels does not move sideways in the frame between
them: the poses of a log are those of that frame if they do not, and else it is found from how they
do (`motion_spans.wheel_frame`). How far apart they are, no log says; what is found is of the point
of their axle that a turn does not move ahead, between wheels of equal size the middle
(`Calibration.without_base`).
"""

from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.calibration import Calibration, calibrate_odometry
from jaxslam.core.logs import LaserLog
from jaxslam.core.se2_np import dead_reckoning, wrap_angle
from jaxslam.core.types import AnyArray
from jaxslam.pipeline import motion_spans, odometry_notes, online
from jaxslam.pipeline.log_input import LogInput, OdometrySource
from jaxslam.smoothing.odometry_calibration import (
    CalibrationEstimate,
    MotionSpans,
    contradicted,
    estimate_calibration,
    flat,
    unflat,
)

MAX_ROUNDS = 6
"""Times that all scans are matched, at most."""

CONVERGED = 0.2
"""Standard errors by which no number changes any more in the last round, or by more rounds."""

LEAST_GONE = 0.2
"""Share of its error that a round is taken to remove from a number, at least."""

MAX_CONTRADICTED = 0.5
"""Share of the spans over which wheels may move otherwise than the scans show, at most."""


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
            as of `motion_spans.wheel_frame`.

    Raises:
        ValueError: The log has no odometry, or it is not used; or its wheels move otherwise than
            its scans show.
    """
    require_wheels(log, given.odometry_source)
    odometry, is_share, _ = _shared(given)
    guessed = _guessed(given) | is_share
    if mount is None:
        mount = motion_spans.wheel_frame(odometry, log.mount, ~guessed)
    taken, times = np.asarray(mount), motion_spans.usable_times(log.times)
    start = flat(Calibration.identity() if mean is None else mean)
    rounds: list[tuple[np.ndarray, np.ndarray]] = []
    is_settled = False
    while len(rounds) < MAX_ROUNDS and not is_settled:
        moved = calibrate_odometry(unflat(start), odometry, times=times, mount=taken)
        matches = online.match_log(given.config, moved, given.scans, odometry_guessed=guessed)
        spans = motion_spans.between_keyframes(given, odometry, matches, guessed, times, taken)
        estimate = estimate_calibration(spans, mean, prior_std)
        change = flat(estimate.calibration) - start
        change[5] = wrap_angle(change[5])
        rounds.append((start, change))
        left = left_over(rounds)
        limit = CONVERGED * flat(estimate.standard_errors)
        is_settled = bool(np.all(np.maximum(np.abs(change), np.abs(left)) <= limit))
        start = flat(estimate.calibration) + left
    require_agreement(estimate.calibration, spans)
    return LogCalibration(estimate, taken, len(rounds), spans, is_settled)


def left_over(rounds: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """How far (K,) each number is from its limit after the last round, by the last two.

    A round takes a number from x to x + f(x), and leaves a share r of its error. By two of them,

        1 - r = -(f1 - f0) / (x1 - x0),    left over after x1 + f1:  f1 r / (1 - r)

    Args:
        rounds: Of each, where it began (K,) and by how much it changed that (K,).
    """
    if len(rounds) < 2:
        return np.zeros_like(rounds[-1][1])
    (x0, f0), (x1, f1) = rounds[-2:]
    gone = np.where(x1 == x0, 1.0, (f0 - f1) / np.where(x1 == x0, 1.0, x1 - x0))
    gone = np.clip(gone, LEAST_GONE, 1.0)
    return f1 * (1.0 - gone) / gone


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
    times = motion_spans.usable_times(log.times)
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


def _guessed(given: LogInput) -> np.ndarray:
    """Which increments (T,) are guesses of the reader."""
    return np.zeros(len(given.increments), bool) if given.guessed is None else given.guessed


def _shared(given: LogInput) -> Any:
    """As of `odometry_notes.share_out`."""
    return odometry_notes.share_out(
        given.increments, given.scans, given.after_pause | given.new_drive
    )
