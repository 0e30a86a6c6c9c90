"""The calibration of a robot in a file, `calibration.json`.

    {"format": "jaxslam-calibration", "version": 1,
     "calibration": {"distance_scale": ..., "turn_scale": ..., "turn_per_distance": ...,
                     "mount": [x, y, yaw], "time_offset": ...},
     "standard_errors": {the same keys}, "not_determined": ["mount[0]", ...],
     "robot": {"mount": [x, y, yaw], "wheels": [x, y, yaw], "base_frame": "", "scan_frame": "",
               "num_beams": ..., "angle_min": ..., "angle_increment": ..., "range_max": ...}}

The calibration is on top of `robot.mount`, where the log, or its user, had the scanner; `wheels` is
the same in the frame between the wheels. Both, the frames, and the scanner are those of the robot
that it was found on: `check_robot` refuses it for another one.
"""

from collections.abc import Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.calibration import Calibration
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import relative
from jaxslam.io import strict_json
from jaxslam.io.errors import InputError
from jaxslam.io.output import write_json
from jaxslam.smoothing.odometry_calibration import NAMES

FORMAT, VERSION = "jaxslam-calibration", 1

LIMITS = {
    "distance_scale": (0.2, 5.0),
    "turn_scale": (0.2, 5.0),
    "turn_per_distance": (-2.0, 2.0),
    "mount": (-20.0, 20.0),
    "time_offset": (-10.0, 10.0),
}
"""Least and greatest numbers of a robot."""

SAME_MOUNT = 2e-3
"""[m], [rad] up to which two mounts are the same, written with another number of digits."""

SAME_ANGLE = 1e-3
"""[rad] up to which the directions of the first and of the last beam are the same."""

ADVICE = "name a calibration.json written by `jaxslam run --calibrate`"


class RobotCalibration(NamedTuple):
    """A calibration, and the robot that it is of.

    Attributes:
        calibration: Of the robot.
        standard_errors: Of each number, in the same record.
        not_determined: Names of the numbers that the drive said little of.
        mount: (3,) [m, m, rad] where the scanner was taken to be on the robot.
        wheels: (3,) [m, m, rad] the same in the frame between the wheels.
        frames: Names of the robot's frame and of the scanner's; "" if not known.
        lidar: The scanner.
    """

    calibration: Calibration
    standard_errors: Calibration
    not_determined: tuple[str, ...]
    mount: np.ndarray
    wheels: np.ndarray
    frames: tuple[str, str]
    lidar: Lidar


def write(path: str | PathLike, found: RobotCalibration) -> None:
    """Write a calibration.

    Args:
        path: File to write, atomically.
        found: The calibration and its robot.

    Raises:
        InputError: A number is out of its limits, or the file cannot be written.
    """
    lidar = found.lidar
    content = {
        "format": FORMAT,
        "version": VERSION,
        "calibration": to_keys(found.calibration),
        "standard_errors": to_keys(found.standard_errors),
        "not_determined": list(found.not_determined),
        "robot": {
            "mount": np.asarray(found.mount).tolist(),
            "wheels": np.asarray(found.wheels).tolist(),
            "base_frame": found.frames[0],
            "scan_frame": found.frames[1],
            "num_beams": int(lidar.num_beams),
            "angle_min": float(lidar.angle_min),
            "angle_increment": float(lidar.angle_increment),
            "range_max": float(lidar.range_max),
        },
    }
    _parse(path, content)
    write_json(path, content)


def to_keys(calibration: Calibration) -> dict[str, Any]:
    """The numbers of a calibration by their keys in files."""
    return {name: np.asarray(x, float).tolist() for name, x in calibration._asdict().items()}


def read(path: str | PathLike) -> RobotCalibration:
    """Read a calibration.

    Args:
        path: File that `write` wrote.

    Raises:
        InputError: The file cannot be read, is no such file, lacks a key, has an unknown one, or a
            number of it is none or out of its limits.
    """
    content = strict_json.read(path, ADVICE)
    if content is None:
        raise InputError("there is no such file", path=path, advice=ADVICE)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"is no {FORMAT} file", path=path, field="format", advice=ADVICE)
    if content.get("version") != VERSION or isinstance(content["version"], bool):
        problem = f"{content.get('version')!r} instead of {VERSION}"
        raise InputError(problem, path=path, field="version", advice=ADVICE)
    return _parse(path, content)


def require_possible(path: str | PathLike, calibration: Calibration) -> None:
    """Raise unless the numbers of a calibration are those that a file may hold.

    Args:
        path: The log that it was found from, for the message.
        calibration: The calibration.

    Raises:
        InputError: A number is out of its limits.
    """
    advice = "no robot is off by that: check the units of the log, its topics, and --mount"
    for name, value in calibration._asdict().items():
        low, high = LIMITS[name]
        numbers = np.asarray(value, float)
        if not ((numbers >= low) & (numbers <= high)).all():
            problem = f"the calibration is found to be {np.round(numbers, 4).tolist()}, which is "
            problem += f"not between {low:g} and {high:g}"
            raise InputError(problem, path=path, field=name, advice=advice)


def check_robot(
    path: str | PathLike, found: RobotCalibration, log: LaserLog, name: str = "the log"
) -> None:
    """Raise unless a calibration may be that of the robot of a log.

    Args:
        path: The file of the calibration, for the message.
        found: The calibration.
        log: The log.
        name: Of the log, for the message.

    Raises:
        InputError: The log is of another scanner, has other frames, or had its scanner at another
            place before the calibration.
    """

    def refuse(field: str, own: str, other: str, advice: str) -> InputError:
        problem = f"is of another robot: {own}, and {name} has {other}"
        return InputError(problem, path=path, field=field, advice=advice)

    again = "calibrate this robot by --calibrate"
    one, other = found.lidar, log.lidar
    if one.num_beams != other.num_beams:
        beams = f"{one.num_beams} beams", f"{other.num_beams}"
        raise refuse("robot.num_beams", *beams, again)
    for field, beam in (("angle_min", 0), ("angle_increment", one.num_beams - 1)):
        angles = [x.angle_min + beam * x.angle_increment for x in (one, other)]
        if abs(angles[0] - angles[1]) > SAME_ANGLE:
            beam_is = "the last beam" if beam else "the first beam"
            texts = [f"{np.degrees(angle):.2f} degrees" for angle in angles]
            raise refuse(f"robot.{field}", f"{beam_is} at {texts[0]}", texts[1], again)
    for field, known, frame in zip(
        ("base_frame", "scan_frame"), found.frames, log.frames, strict=True
    ):
        if known and frame and known != frame:
            raise refuse(f"robot.{field}", f"frame {known!r}", repr(frame), again)
    off = relative(np.asarray(found.mount, float), np.asarray(log.mount, float))
    if np.abs(off).max() > SAME_MOUNT:
        texts = [np.array2string(np.asarray(x), precision=4) for x in (found.mount, log.mount)]
        advice = "give the --mount that the calibration is on top of, or calibrate again"
        raise refuse("robot.mount", f"scanner taken to be at {texts[0]}", texts[1], advice)


def _parse(path: str | PathLike, content: dict[str, Any]) -> RobotCalibration:
    """A calibration of the content of a file."""
    keys = "format", "version", "calibration", "standard_errors", "not_determined", "robot"
    _check_keys(path, "", content, keys)
    values = _calibration(path, "calibration", content["calibration"], LIMITS)
    positive = {name: (0.0, np.inf) for name in LIMITS}
    errors = _calibration(path, "standard_errors", content["standard_errors"], positive)
    names, robot = content["not_determined"], content["robot"]
    _check_texts(path, "not_determined", names if isinstance(names, list) else [None])
    for name in names:
        if name not in NAMES:
            advice = f"the names are {', '.join(NAMES)}"
            raise InputError(f"{name[:40]!r}", path=path, field="not_determined", advice=advice)
    scanner = "num_beams", "angle_min", "angle_increment", "range_max"
    _check_keys(path, "robot", robot, ("mount", "wheels", "base_frame", "scan_frame", *scanner))
    frames = robot["base_frame"], robot["scan_frame"]
    _check_texts(path, "robot.base_frame, robot.scan_frame", frames)
    limits = ((2, 10**6), (-10.0, 10.0), (1e-6, 4.0), (1e-3, 1e6))
    numbers = [
        float(_numbers(path, f"robot.{key}", robot[key], (), limit))
        for key, limit in zip(scanner, limits, strict=True)
    ]
    if numbers[0] != int(numbers[0]):
        problem = f"{numbers[0]} is no whole number"
        raise InputError(problem, path=path, field="robot.num_beams", advice=ADVICE)
    mount, wheels = (
        _numbers(path, f"robot.{key}", robot[key], (3,), LIMITS["mount"])
        for key in ("mount", "wheels")
    )
    lidar = Lidar(int(numbers[0]), *numbers[1:])
    return RobotCalibration(values, errors, tuple(names), mount, wheels, frames, lidar)


def _calibration(
    path: str | PathLike, field: str, given: Any, limits: dict[str, tuple[float, float]]
) -> Calibration:
    """A record of a calibration's numbers."""
    _check_keys(path, field, given, Calibration._fields)
    return Calibration._make(
        _numbers(path, f"{field}.{name}", given[name], shape, limits[name])
        for name, shape in zip(Calibration._fields, ((), (), (), (3,), ()), strict=True)
    )


def _check_keys(path: str | PathLike, field: str, given: Any, keys: Sequence[str]) -> None:
    """Raise unless an object has these keys and no others."""
    if not isinstance(given, dict):
        raise InputError("is no object", path=path, field=field, advice=ADVICE)
    prefix = f"{field}." if field else ""
    for key in keys:
        if key not in given:
            raise InputError("missing", path=path, field=prefix + key, advice=ADVICE)
    for key in sorted(given.keys() - set(keys)):
        advice = f"the keys are {', '.join(keys)}"
        raise InputError("unknown key", path=path, field=prefix + key[:40], advice=advice)


def _check_texts(path: str | PathLike, field: str, given: Sequence[Any]) -> None:
    """Raise unless all are texts."""
    if not all(isinstance(x, str) for x in given):
        raise InputError("holds something that is no text", path=path, field=field, advice=ADVICE)


def _numbers(
    path: str | PathLike, field: str, given: Any, shape: tuple[int, ...], limits: Sequence[float]
) -> np.ndarray:
    """Numbers of a shape within limits."""
    form = "a number" if not shape else f"{shape[0]} numbers"
    try:
        array = np.array(given)
    except ValueError:  # ragged
        array = np.array(None)
    has_bool = isinstance(given, list) and any(isinstance(x, bool) for x in given)
    if array.dtype.kind not in "fiu" or array.shape != shape or has_bool:
        raise InputError(f"is not {form}", path=path, field=field, advice=ADVICE)
    numbers = array.astype(np.float64)
    low, high = limits
    if not (np.isfinite(numbers) & (numbers >= low) & (numbers <= high)).all():
        problem = f"{numbers.tolist()} is not between {low:g} and {high:g}"
        raise InputError(problem, path=path, field=field, advice=ADVICE)
    return numbers
