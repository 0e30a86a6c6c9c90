"""The sections of a robot's drive in its file (`robot_file`): kinematics, odometry, limits."""

import math
from typing import Any

from jaxslam.io.quantities import Table
from jaxslam.simulation.kinematics import KINEMATICS, turning_radius
from jaxslam.simulation.robot import Robot

NOT_OF = {
    "differential": ("max_steering", "min_turning_radius", "steering_noise", "steering_offset"),
    "holonomic": ("max_steering", "min_turning_radius", "steering_noise", "steering_offset"),
}
"""Keys of another drive, for those that have `encoder_noise` or `slip_noise` alone."""


def read_drive(kinematics: Table, odometry: Table) -> dict[str, Any]:
    """Fields of `Robot`: its drive, its noise and its systematic errors.

    Args:
        kinematics: The section, whose keys are known ones.
        odometry: Likewise.

    Raises:
        InputError: A value is not possible, is missing, or is of another drive.
    """
    drive = kinematics.text("type")
    if drive not in KINEMATICS:
        problem = "is missing" if drive is None else f"{drive!r} is unknown"
        raise kinematics.error("type", problem, f"types are {', '.join(KINEMATICS)}")
    foreign = NOT_OF.get(drive, ()) + (
        ("encoder_noise",) if drive == "holonomic" else ("slip_noise",)
    )
    for table in (kinematics, odometry):
        for key in foreign:
            if key in table.content:
                raise table.error(key, f"is not of a drive that is {drive}", "leave it out")
    fields: dict[str, Any] = {
        "kinematics": drive,
        "wheel_base": kinematics.required("wheel_base", "length", 0.01, 20.0),
        "wheel_scales": _wheel_scales(odometry, drive),
    }
    if drive == "ackermann":
        fields |= _steering(kinematics, odometry, fields["wheel_base"])
    if drive == "holonomic":
        fields["slip_noise"] = _slip_noise(odometry)
    else:
        fields["encoder_noise"] = odometry.required(
            "encoder_noise", "length over a metre", 1e-6, 1.0
        )
    optional = {
        "wheel_base_scale": odometry.quantity("wheel_base_scale", "ratio", 0.2, 5.0),
        "odometry_rate": odometry.quantity("rate", "rate", 0.1, 1e5),
    }
    return fields | {key: value for key, value in optional.items() if value is not None}


def _steering(kinematics: Table, odometry: Table, wheel_base: float) -> dict[str, Any]:
    """Fields of an Ackermann drive's steering."""
    angle = kinematics.quantity("max_steering", "angle", 0.01, 1.5)
    radius = kinematics.quantity("min_turning_radius", "length", 0.01, 100.0)
    if angle is None and radius is None:
        raise kinematics.error("max_steering", "is missing", "give it, or min_turning_radius")
    if angle is not None and radius is not None:
        steered = wheel_base / math.tan(angle)
        if radius < 0.98 * steered:
            problem = f"{radius:g} m contradicts max_steering and wheel_base"
            raise kinematics.error(
                "min_turning_radius", problem, f"these turn on {steered:.2f} m at least"
            )
    noise = odometry.required("steering_noise", "angle of a metre", 1e-6, 0.5)
    offset = odometry.quantity("steering_offset", "angle", -0.5, 0.5)
    return {
        "max_steering": angle or 0.0,
        "min_turning_radius": radius or 0.0,
        "steering_noise": noise,
        "steering_offset": offset or 0.0,
    }


def _slip_noise(odometry: Table) -> tuple[float, ...]:
    """Standard deviations ahead, left and of the heading over a metre."""
    value = odometry.content.get("slip_noise")
    if not isinstance(value, list) or len(value) != 3:
        problem = "is missing" if value is None else f"{value!r} is no list of three"[:200]
        raise odometry.error("slip_noise", problem, 'write ["5 mm", "8 mm", "1 deg"]')
    kinds = "length over a metre", "length over a metre", "angle over a metre"
    numbers = (
        odometry.checked("slip_noise", x, kind, 1e-6, 1.0)
        for x, kind in zip(value, kinds, strict=True)
    )
    return tuple(x or 0.0 for x in numbers)


def _wheel_scales(odometry: Table, drive: str) -> tuple[float, float]:
    """Scales of the left and right wheel; of another drive than two wheels one number."""
    value = odometry.content.get("wheel_scales", 1.0)
    both = value if isinstance(value, list) else [value, value]
    if len(both) != 2 or (isinstance(value, list) and drive != "differential"):
        wanted = "two numbers, left and right" if drive == "differential" else "one number"
        raise odometry.error("wheel_scales", f"{value!r} is not {wanted}"[:200])
    left, right = (odometry.checked("wheel_scales", x, "ratio", 0.2, 5.0) or 1.0 for x in both)
    return left, right


def read_limits(limits: Table, fields: dict[str, Any]) -> dict[str, float]:
    """Fields of `Robot`: largest speed and turn rate.

    The turn rate of an Ackermann drive is by default that on its smallest circle.

    Args:
        limits: The section, whose keys are known ones.
        fields: Of `read_drive`.

    Raises:
        InputError: A value is not possible, or is missing.
    """
    speed = limits.required("max_speed", "speed", 0.001, 50.0)
    if fields["kinematics"] != "ackermann":
        return {
            "max_speed": speed,
            "max_turn_rate": limits.required("max_turn_rate", "turn rate", 0.001, 50.0),
        }
    rate = limits.quantity("max_turn_rate", "turn rate", 0.001, 50.0)
    return {
        "max_speed": speed,
        "max_turn_rate": speed / turning_radius(Robot(**fields)) if rate is None else rate,
    }
