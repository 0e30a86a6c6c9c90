"""Calibration of the logs of `jaxslam run`: of a file, or found by the log itself."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxslam.cli.options import name_errors
from jaxslam.cli.run_evaluation import RecordedDrive
from jaxslam.core.calibration import Calibration, calibrate_odometry
from jaxslam.core.logs import LaserLog
from jaxslam.core.se2_np import compose, dead_reckoning, increments
from jaxslam.core.types import Metrics
from jaxslam.evaluation import log_errors
from jaxslam.io import calibration_file
from jaxslam.io.calibration_file import RobotCalibration
from jaxslam.io.errors import InputError
from jaxslam.pipeline import log_input, motion_spans, self_calibration
from jaxslam.pipeline.log_input import LogInput
from jaxslam.smoothing.odometry_calibration import (
    NAMES,
    CalibrationEstimate,
    MotionSpans,
    contradicted,
    default_prior_std,
    flat,
    unflat,
)
from jaxslam.tuning import calibration_model

CHANGED_SINCE = 0.1
"""Standard deviation, of that of a robot never calibrated, by which a calibration may have changed
since it was written."""

FAR_OFF = 3.0
"""Such standard deviations by which a number is far from that of usual robots."""

NOTED_CONTRADICTIONS = 0.2
"""Share of the spans, from which it is noted that calibrated wheels move otherwise than scans."""

UNITS = ("", "", "rad/m", "m", "m", "deg", "s")
"""Of the numbers of a calibration, as they are printed."""


def read_calibrations(files: Sequence[Path], logs: Sequence[Path]) -> list[RobotCalibration | None]:
    """The calibration of each log; one file is that of all.

    Raises:
        InputError: A file is no calibration, or there are not as many as logs.
    """
    if len(files) not in (0, 1, len(logs)):
        problem = f"is given {len(files)} times for {len(logs)} logs"
        advice = "give it once for all, or once for each log"
        raise InputError(problem, field="--calibration", advice=advice)
    found = [calibration_file.read(path) for path in files]
    return [*found] if len(found) == len(logs) else [found[0] if found else None] * len(logs)


def check_calibration(
    path: Path, log: LaserLog, given: LogInput, file: Path | None, known: RobotCalibration | None
) -> None:
    """Raise InputError unless the wheels of a log can be calibrated, or this calibration be used.

    Args:
        path: The log.
        log: Its content.
        given: The same as input of SLAM.
        file: Of the calibration, for messages; None without one.
        known: The calibration of the file.
    """
    if file is not None and known is not None:
        calibration_file.check_robot(file, known, log, str(path))
    with name_errors(str(path)):
        self_calibration.require_wheels(log, given.odometry_source)


def calibrated(
    drives: Sequence[RecordedDrive],
    inputs: Sequence[LogInput],
    robots: Sequence[RobotCalibration | None],
    out_dir: Path,
    *,
    calibrate: bool,
) -> tuple[list[RecordedDrive], list[LogInput], list[Metrics]]:
    """Drives and their inputs with calibrated odometry, and numbers about each calibration.

    Args:
        drives: The logs.
        inputs: Their inputs of SLAM.
        robots: The calibration of each, if it is known.
        out_dir: Folder for calibration.json, or calibration.1.json and so on.
        calibrate: Whether each log is calibrated by itself.

    Returns:
        The same as they were, and no numbers, if no calibration is known and none asked for.
    """
    moved: list[tuple[RecordedDrive, LogInput]] = []
    numbers: list[Metrics] = []
    for number, (drive, given, known) in enumerate(zip(drives, inputs, robots, strict=True), 1):
        robot = known
        about: Metrics = {}
        if calibrate:
            robot, about = find_calibration(drive.path, drive.log, given, known)
            suffix = f".{number}" if len(drives) > 1 else ""
            calibration_file.write(out_dir / f"calibration{suffix}.json", robot)
        if robot is None:
            moved.append((drive, given))
            continue
        log, own = use_calibration(drive.path, drive.log, given, robot)
        about = metrics_of(robot) | about
        if drive.reference is not None or drive.relations is not None:
            about["dead_reckoning"] = log_errors.errors_against(
                log, own.odom_poses, drive.reference, drive.relations
            )
        numbers.append(about)
        moved.append((drive._replace(log=log), own))
    return [drive for drive, _ in moved], [given for _, given in moved], numbers


def find_calibration(
    path: Path, log: LaserLog, given: LogInput, known: RobotCalibration | None
) -> tuple[RobotCalibration, Metrics]:
    """The calibration of a log by itself, and numbers about it; prints what is found.

    Args:
        path: The log.
        log: Its content.
        given: The same as input of SLAM.
        known: An earlier calibration, which is the prior; None without one.
    """
    mean = prior_std = mount = None
    if known is not None:
        mean, mount = known.calibration, known.wheels
        since = CHANGED_SINCE * flat(default_prior_std())
        prior_std = unflat(np.hypot(flat(known.standard_errors), since))
    print(f"{path}: calibrating its wheels by its scans ...", flush=True)
    with name_errors(str(path)):
        found = self_calibration.calibrate_log(log, given, mean, prior_std, mount=mount)
    calibration_file.require_possible(path, found.estimate.calibration)
    robot = _robot_of(log, found.estimate, found.mount)
    num_spans = found.estimate.num_spans
    counts = f"{num_spans} spans, scans matched {found.num_rounds} times"
    print_calibration(robot, f"calibration of {path}, by {counts}:")
    if not found.is_settled:
        print("note: the calibration still changed when the scans were matched last")
    num_off = print_contradictions(path, found.estimate.calibration, found.spans)
    about = {
        "spans": num_spans,
        "contradicted_spans": num_off,
        "rounds": found.num_rounds,
        "settled": found.is_settled,
    }
    return robot, about


def tune_calibration(
    paths: Sequence[Path], logs: Sequence[LaserLog], num_train: int
) -> tuple[RobotCalibration, list[LaserLog]]:
    """The calibration of one robot by several logs together, and all logs with it; prints it.

    Args:
        paths: The logs.
        logs: What they hold.
        num_train: How many of them, the first ones, it is found from.
    """
    found, mount = [], None
    inputs = [log_input.from_laser_log(log) for log in logs]
    for path, log, given in list(zip(paths, logs, inputs, strict=True))[:num_train]:
        print(f"{path}: calibrating its wheels by its scans ...", flush=True)
        with name_errors(str(path)):
            found.append(self_calibration.calibrate_log(log, given, mount=mount))
        mount = found[0].mount
    first = max(found, key=lambda one: one.estimate.num_spans)
    with name_errors(str(paths[0])):
        tuned = calibration_model.tune_calibration([x.spans for x in found], first.estimate)
    for path, one in zip(paths, found, strict=False):
        with name_errors(str(path)):
            self_calibration.require_agreement(tuned.calibration, one.spans)
    calibration_file.require_possible(paths[0], tuned.calibration)
    robot = _robot_of(logs[0], tuned, first.mount)
    print_calibration(robot, f"calibration of the robot, by {tuned.num_spans} spans:")
    for path, one in zip(paths, found, strict=False):
        print_contradictions(path, tuned.calibration, one.spans)
    moved = []
    for path, log, given in zip(paths, logs, inputs, strict=True):
        own, calibrated_input = use_calibration(path, log, given, robot)
        for note in calibrated_input.notes[len(given.notes) :]:
            print(f"{path}: note: {note}", flush=True)
        moved.append(own._replace(odometry_guessed=calibrated_input.guessed))
    return robot, moved


def check_same_robot(paths: Sequence[Path], logs: Sequence[LaserLog]) -> None:
    """Raise InputError unless all logs have wheels, and may be of one robot."""
    for path, log in zip(paths, logs, strict=True):
        with name_errors(str(path)):
            self_calibration.require_wheels(log)
    first = RobotCalibration(
        Calibration.identity(),
        Calibration.identity(),
        (),
        logs[0].mount,
        logs[0].mount,
        logs[0].frames,
        logs[0].lidar,
    )
    for path, log in zip(paths[1:], logs[1:], strict=True):
        try:
            calibration_file.check_robot(paths[0], first, log, str(path))
        except InputError as error:
            problem = str(error).partition(";")[0]
            advice = "only logs of one robot are calibrated together"
            raise InputError(problem, field="--calibrate", advice=advice) from None


def _robot_of(log: LaserLog, found: CalibrationEstimate, wheels: np.ndarray) -> RobotCalibration:
    """A calibration with the robot of a log."""
    return RobotCalibration(
        found.calibration,
        found.standard_errors,
        found.not_determined,
        np.asarray(log.mount, float),
        wheels,
        log.frames,
        log.lidar,
    )


def print_calibration(robot: RobotCalibration, title: str) -> None:
    """Print the numbers of a calibration."""
    print(title)
    for line in calibration_lines(robot):
        print(f"  {line}")


def print_contradictions(path: Path, calibration: Calibration, spans: MotionSpans) -> int:
    """Print where calibrated wheels move otherwise than the scans show, if that is often.

    Args:
        path: The log.
        calibration: Of its robot.
        spans: Of its drive.

    Returns:
        At how many spans they do.
    """
    num_off, count = int(contradicted(calibration, spans).sum()), int(spans.usable.sum())
    if num_off > NOTED_CONTRADICTIONS * count:
        print(
            f"WARNING: {path}: calibrated wheels do not move as the scans show at {num_off} of "
            f"{count} spans, so the calibration may be off by more than its standard errors"
        )
    return num_off


def use_calibration(
    path: Path, log: LaserLog, given: LogInput, robot: RobotCalibration
) -> tuple[LaserLog, LogInput]:
    """The log and its input of SLAM with calibrated odometry and mount; prints that they are."""
    times = motion_spans.usable_times(log.odom_stream_times)
    with name_errors(str(path)):
        moved = self_calibration.calibrated(log, given, robot.calibration, robot.wheels)
    stream = calibrate_odometry(
        robot.calibration, increments(log.odom_stream_poses), times=times, mount=robot.wheels
    )
    mount = compose(np.asarray(log.mount, float), np.asarray(robot.calibration.mount))
    texts = [" ".join(f"{number:.4f}" for number in pose) for pose in (robot.mount, mount)]
    unsure = f"; not determined: {', '.join(robot.not_determined)}" if robot.not_determined else ""
    print(
        f"odometry of {path} is calibrated, on top of the scanner's mount {texts[0]}, which "
        f"becomes {texts[1]}{unsure}",
        flush=True,
    )
    log = log._replace(
        odom_poses=moved.odom_poses,
        odom_stream_poses=dead_reckoning(moved.odom_poses[0], stream),
        mount=mount,
    )
    return log, moved


def calibration_lines(robot: RobotCalibration) -> list[str]:
    """Each number of a calibration, with its standard error, or that the drive said little of it.

    Args:
        robot: The calibration.
    """
    numbers, errors = flat(robot.calibration), flat(robot.standard_errors)
    off = np.abs(numbers - flat(Calibration.identity())) / flat(default_prior_std())
    far = dict(zip(NAMES, off > FAR_OFF, strict=True))
    lines = []
    for name, number, error, unit in zip(NAMES, numbers, errors, UNITS, strict=True):
        if unit == "deg":
            number, error = np.degrees(number), np.degrees(error)
        text = f"{name:20}{number:10.4f} +- {error:.4f} {unit}".rstrip()
        if name in robot.not_determined:
            text += "   not determined by this drive"
        if far[name]:
            text += "   far from that of usual robots: check it"
        lines.append(text)
    return lines


def metrics_of(robot: RobotCalibration) -> Metrics:
    """Block `calibration` of metrics.json."""
    return calibration_file.to_keys(robot.calibration) | {
        "standard_errors": calibration_file.to_keys(robot.standard_errors),
        "not_determined": list(robot.not_determined),
        "on_top_of_mount": np.asarray(robot.mount).tolist(),
    }
