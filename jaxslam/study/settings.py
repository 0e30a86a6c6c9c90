"""What can be set in a study: names, units and limits of all settings."""

import difflib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxslam.io import life_file
from jaxslam.io.errors import InputError
from jaxslam.io.quantities import Table

TEXTS = {
    "world": "name or file of the building",
    "path": "file of waypoints",
    "drive": "patrol or route",
    "unit": "unit of a drawing",
    "layers": "names of the layers of a drawing whose lines are walls, parted by commas",
    "robot": "file of the robot",
    "scanner": "name of a scanner",
    "noise": "file of the noise parameters of the filter",
    "life": "file of what goes wrong, or typical, as of `jaxslam simulate --life`",
    "odometry": "scan (matching, fused with the wheels) or wheels",
    "landmarks": "all or junctions",
    "labels": "segments or codes",
}
NUMBERS = {  # kind of `quantities`, least and most, and what it is
    "resolution": ("length", 0.0, 100.0, "of a pixel"),
    "max_speed": ("speed", 0.0, 50.0, "of the robot"),
    "max_turn_rate": ("turn rate", 0.0, 50.0, "of the robot"),
    "encoder_noise": ("length over a metre", 0.0, 1.0, "of the robot"),
    "scan_period": ("time", 0.0, 100.0, "of the robot"),
    "time_offset": ("time", -10.0, 10.0, "of the robot"),
    "wheel_base_scale": ("ratio", 0.0, 5.0, "of the robot"),
    "odometry_factor": ("ratio", 1e-3, 1e3, "on the standard deviations of Q"),
    "sensor_factor": ("ratio", 1e-3, 1e3, "on the standard deviations of R"),
    "max_landmarks": ("number", 1.0, 1e4, "capacity of the filter"),
}
LIFE = {f"life.{key}": key for key in life_file.SETTINGS}
SETTINGS = (*TEXTS, *NUMBERS, *LIFE)
"""Names of all that can be set."""

CHOICES = {
    "drive": ("patrol", "route"),
    "odometry": ("scan", "wheels"),
    "landmarks": ("all", "junctions"),
    "labels": ("segments", "codes"),
}
FILES = ("path", "robot", "noise", "life")
WHOLE = {"max_landmarks", *(f"life.{key}" for key in life_file.WHOLE)}

Settings = dict[str, Any]
"""Values by the names of settings, numbers in SI units."""


def value_of(path: Path, where: str, name: str, given: Any) -> Any:
    """The value of a setting.

    Args:
        path: File of the study.
        where: Its table, for the message.
        name: One of `SETTINGS`.
        given: What the file has.

    Raises:
        InputError: It is not of its kind, or not possible.
    """
    if name == "unit" and isinstance(given, int | float) and not isinstance(given, bool):
        given = f"{given!r}"  # metres of a unit
    if name in TEXTS:
        if not isinstance(given, str) or given not in CHOICES.get(name, (given,)):
            field = f"{where}.{name}"
            raise InputError(f"is {given!r}, not {TEXTS[name]}", path=path, field=field)
        return given
    if name in LIFE:
        return life_file.number(Table(path, f"{where}.life", {}), LIFE[name], given)
    kind, least, most, _ = NUMBERS[name]
    table = Table(path, where, {})
    found = table.checked(name, given, kind, least, most)
    if found is None or (name in WHOLE and found != int(found)):
        raise table.error(name, f"{given!r} is no whole number")
    return int(found) if name in WHOLE else found


def number(
    path: Path, field: str, given: Any, least: float, most: float, *, whole: bool = False
) -> float:
    """A finite number of a file, in [least, most]; InputError if it is none."""
    is_number = isinstance(given, int | float) and not isinstance(given, bool)
    if not is_number or not math.isfinite(given) or (whole and given != int(given)):
        wanted = "whole number" if whole else "number"
        raise InputError(f"is {given!r}, not a {wanted}", path=path, field=field)
    if not least <= given <= most:
        limits = f"{least:g} or more" if math.isinf(most) else f"between {least:.9g} and {most:.9g}"
        raise InputError(f"is {given}, not {limits}", path=path, field=field)
    return int(given) if whole else float(given)


def settings_of(path: Path, where: str, given: Any) -> Settings:
    """Settings of a table, checked one by one; nested tables are names with dots."""
    return {
        name: value_of(path, where, name, x) for name, x in flattened(path, where, given).items()
    }


def flattened(path: Path, where: str, given: Any) -> Settings:
    """Values of a table by the names of settings, which are known."""
    if not isinstance(given, dict):
        raise InputError("is no table", path=path, field=where)
    found: Settings = {}
    for key, value in given.items():
        nested = isinstance(value, dict)
        own = {f"{key}.{k}": x for k, x in value.items()} if nested else {key: value}
        for name, x in own.items():
            if name not in SETTINGS:
                raise unknown(path, name, SETTINGS, where)
            found[name] = x
    return found


def unknown(path: Path, name: str, known: Sequence[str], field: str | None = None) -> InputError:
    """The error of a name that is not known, with the one that is meant, perhaps."""
    near = difflib.get_close_matches(name, known, 1)
    advice = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
    return InputError(f"{name} is not known", path=path, field=field, advice=advice)


def text_of(name: str, value: Any) -> str:
    """A setting as part of the name of a variant."""
    shown = f"{value:g}" if isinstance(value, int | float) else str(value)
    return shown if name in ("scanner", "world") else f"{name.removeprefix('life.')} {shown}"


def with_life(settings: Mapping[str, Any], folder: Path) -> Settings:
    """Settings whose file `life` is read; what they set themselves counts.

    Raises:
        InputError: The file is not possible.
    """
    own = {key: x for key, x in settings.items() if key != "life"}
    if "life" not in settings:
        return own
    given = settings["life"]
    file = given if given == life_file.TYPICAL else folder / given
    return {f"life.{k}": x for k, x in life_file.read(file).items()} | own


def files_of(settings: Mapping[str, Any], folder: Path) -> Settings:
    """Settings whose files are named relative to the current folder, not to that of the study."""
    found = dict(settings)
    for name in (*FILES, "world"):
        given = found.get(name)
        if given is not None and (name != "world" or Path(folder / given).is_file()):
            found[name] = str(folder / given)
    return found
