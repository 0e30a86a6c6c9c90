"""A robot in a file, TOML or JSON of the same tree, for `jaxslam simulate --robot FILE`.

A value is a text with its unit ("0.25 m", "3 deg", "10 Hz": units are in `quantities`), or a number
alone in the SI unit. `*` marks what must be there. An unknown key is an error. See `EXAMPLE`.

    name              what the robot is called
    [scanner] *       preset = a name of `scanner_presets`, or all marked keys; both: keys override
      beams *, field_of_view *, angle_increment *   two of these three
      angle_min       of the first beam; by default beams are symmetric, or begin behind
      scan_rate *, range_min *, range_max *
      range_noise *   standard deviation: "10 mm", "1 %", "5 mm + 1 %", or, where it depends on the
                      range, a list in its order: ["10 mm", "3.5 % from 0.5 m"]
      precision, accuracy   bounds +-b of the repeatability, or of the whole error, likewise; either
                      may replace `range_noise` (`scanners` says how)
      range_resolution, beam_divergence, beam_width, name
    [kinematics] *
      type *          "differential", "ackermann" or "holonomic"
      wheel_base *    between the wheels; between the axles; between opposite wheels
      max_steering, min_turning_radius   of an Ackermann drive, one * or both
    [odometry] *
      encoder_noise * standard deviation of a wheel over one metre; not of a holonomic drive
      steering_noise *   of an Ackermann drive: of the mean error of its angle over one metre
      slip_noise *    of a holonomic drive: [ahead, left, heading] over one metre
      wheel_scales    true distance per distance read: [left, right], or one number
      wheel_base_scale   true `wheel_base` per the one above
      steering_offset, rate (of the odometry; by default it comes with each scan)
    [limits] *        max_speed *, max_turn_rate * (an Ackermann drive may do without)
    [mount]           x, y, yaw of the scanner on the robot, as its user knows it
    [mount_error]     x, y, yaw of the true scanner in the frame of the known one
    [timing]          scan_latency, odometry_latency: from a measurement to its stamp;
                      time_offset: by which the clock of the odometry is ahead
    [body]            radius of a circle around the origin, or length and width around it: drives
                      keep the circle from walls, and a path that does not is refused
"""

import math
from os import PathLike
from typing import Any, NamedTuple

from jaxslam.io import toml_or_json
from jaxslam.io.errors import InputError
from jaxslam.io.quantities import Table
from jaxslam.io.robot_drive import read_drive, read_limits
from jaxslam.io.robot_scanner import read_scanner
from jaxslam.simulation.arguments import as_robot
from jaxslam.simulation.kinematics import turning_radius
from jaxslam.simulation.robot import Robot

EXAMPLE = """\
name = "delivery robot"

[scanner]
preset = "RPLidar A2"
scan_rate = "5 Hz"          # every second scan is used
range_noise = ["8 mm", "1 % from 1 m"]

[kinematics]
type = "differential"
wheel_base = "320 mm"

[odometry]
encoder_noise = "4 mm"      # of a wheel, over one metre
wheel_scales = [1.004, 0.998]
wheel_base_scale = "101 %"
rate = "50 Hz"

[limits]
max_speed = "0.8 m/s"
max_turn_rate = "60 deg/s"

[mount]
x = "12 cm"
yaw = "0 deg"

[timing]
scan_latency = "20 ms"

[body]
length = "0.5 m"
width = "0.4 m"
"""
"""A file; `read` takes it."""

SECTIONS = {
    "scanner": (
        "preset name beams field_of_view angle_increment angle_min scan_rate range_min range_max "
        "range_noise precision accuracy range_resolution beam_divergence beam_width"
    ).split(),
    "kinematics": ["type", "wheel_base", "max_steering", "min_turning_radius"],
    "odometry": (
        "encoder_noise steering_noise slip_noise wheel_scales wheel_base_scale steering_offset rate"
    ).split(),
    "limits": ["max_speed", "max_turn_rate"],
    "mount": ["x", "y", "yaw"],
    "mount_error": ["x", "y", "yaw"],
    "timing": ["scan_latency", "odometry_latency", "time_offset"],
    "body": ["radius", "length", "width"],
}
"""Known keys of each section."""

ADVICE = "see the example in the documentation of jaxslam.io.robot_file"


class RobotFile(NamedTuple):
    """A robot of a file.

    Attributes:
        name: What it is called.
        robot: The robot, with its scanner.
        notes: What is assumed of it, because no source says.
    """

    name: str
    robot: Robot
    notes: tuple[str, ...]

    def describe(self) -> str:
        """The robot in one line."""
        robot, scanner = self.robot, self.robot.scanner
        assert scanner is not None  # a file has one
        drive = f"{robot.kinematics}, wheel base {robot.wheel_base:g} m"
        if robot.kinematics == "ackermann":
            drive += f", turning radius {turning_radius(robot):.2f} m"
        at = 3.0 if scanner.range_max > 3.0 else scanner.range_max
        std = 1000 * scanner.lidar().range_std
        return (
            f"robot {self.name}: {drive}, up to {robot.max_speed:g} m/s and "
            f"{math.degrees(robot.max_turn_rate):.0f} deg/s; scanner {scanner.name}: "
            f"{scanner.num_beams} beams over {math.degrees(scanner.field_of_view):.0f} degrees, "
            f"{scanner.scan_rate:g} Hz, {scanner.range_min:g} to {scanner.range_max:g} m, "
            f"noise {std:.1f} mm at {at:g} m"
        )


def read(path: str | PathLike) -> RobotFile:
    """Read a robot.

    Args:
        path: TOML or JSON file, as above.

    Raises:
        InputError: The file cannot be read, or is neither; a key is unknown, missing or of another
            drive; a value is not possible, has an unknown unit, or contradicts another one.
    """
    content = toml_or_json.read(path, ADVICE)
    for key in content:
        if key not in ("name", *SECTIONS):
            known = ", ".join(("name", *SECTIONS))
            raise InputError("is unknown", path=path, field=key[:40], advice=f"there are {known}")
    tables = {}
    for name, keys in SECTIONS.items():
        section = content.get(name, {})
        if not isinstance(section, dict):
            raise InputError("is no section", path=path, field=name, advice=f"write [{name}]")
        if name not in content and name in ("scanner", "kinematics", "odometry", "limits"):
            raise InputError(f"has no section [{name}]", path=path, advice=ADVICE)
        tables[name] = Table(path, name, section)
        tables[name].check_keys(keys)
    scanner = read_scanner(tables["scanner"])
    fields = read_drive(tables["kinematics"], tables["odometry"])
    fields |= read_limits(tables["limits"], fields)
    timing = [
        tables["timing"].quantity(key, "time", low, 10.0) or 0.0
        for key, low in (("time_offset", -10.0), ("odometry_latency", 0.0), ("scan_latency", 0.0))
    ]
    robot = Robot(
        **fields,
        nominal_mount=_mount(tables["mount"]),
        mount=_mount(tables["mount_error"]),
        # A late stamp of the odometry is its clock ahead; one of a scan, its own.
        time_offset=timing[0] + timing[1] - timing[2],
        scan_period=1.0 / scanner.scan_rate,
        radius=_radius(tables["body"]),
        scanner=scanner,
    )
    try:
        robot = as_robot(robot)
    except ValueError as error:
        raise InputError(str(error), path=path) from None
    return RobotFile(_name(path, content), robot, scanner.assumptions())


def _name(path: str | PathLike, content: dict[str, Any]) -> str:
    """What the robot is called."""
    name = content.get("name", "without a name")
    if not isinstance(name, str) or not name.strip() or not name.isprintable():
        problem = f"{name!r} is no text of one line"[:200]
        raise InputError(problem, path=path, field="name", advice="write it in quotes")
    return name.strip()


def _mount(table: Table) -> tuple[float, float, float]:
    """Pose of a scanner; what is not given is 0."""
    x, y = (table.quantity(key, "length", -20.0, 20.0) or 0.0 for key in ("x", "y"))
    return x, y, table.quantity("yaw", "angle", -math.pi, math.pi) or 0.0


def _radius(body: Table) -> float:
    """Radius of the circle around a robot, 0 if it is not known."""
    radius = body.quantity("radius", "length", 0.0, 20.0)
    sides = [body.quantity(key, "length", 0.0, 20.0) for key in ("length", "width")]
    if radius is not None and any(side is not None for side in sides):
        raise body.error("radius", "is given beside length or width", "leave one of both out")
    if any(side is None for side in sides):
        if any(side is not None for side in sides):
            missing = "length" if sides[0] is None else "width"
            raise body.error(missing, "is missing", "give length and width, or radius")
        return radius or 0.0
    return math.hypot(*(side or 0.0 for side in sides)) / 2
