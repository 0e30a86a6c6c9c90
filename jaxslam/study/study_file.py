"""Files of studies: a base and what is varied, in TOML, or the same tree in JSON.

    trials = 200               # of each variant
    seed = 0
    success_m = 0.5            # a trial succeeds if its position is never further off

    [base]                     # of all variants
    world = "random:7"         # as of `jaxslam simulate --world`
    drive = "patrol"
    robot = "robot.toml"
    life.people = 5

    [vary]                     # every combination of these
    scanner = ["LDS-01", "RPLidar A1"]
    life.missing = [0.0, 0.1]

or instead of `[vary]`

    [[variant]]                # one by one
    name = "slow"
    max_speed = 0.3

    [sample]                   # points that fill a box evenly
    method = "sobol"           # or "latin"
    count = 16
    life.missing = [0.0, 0.4]  # from, to

Files are named relative to the file of the study. `SETTINGS` lists what can be set.
"""

import difflib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc

from jaxslam.io import toml_or_json
from jaxslam.io.errors import InputError
from jaxslam.simulation.life import PROBABILITIES
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.simulation.traffic import Traffic
from jaxslam.simulation.wheel_faults import WheelFaults

MAX_VARIANTS = 1000
MAX_TRIALS = 10**6
PARTS: dict[str, Any] = {"ranges": RangeErrors, "traffic": Traffic, "wheels": WheelFaults}
"""The parts of `Life`; their fields are the settings `life.FIELD`."""

TEXTS = {
    "world": "name or file of the building",
    "path": "file of waypoints",
    "drive": "patrol or route",
    "unit": "unit of a drawing",
    "robot": "file of the robot",
    "scanner": "name of a scanner",
    "noise": "file of the noise parameters of the filter",
    "landmarks": "all or junctions",
    "labels": "segments or codes",
}
NUMBERS = {
    "resolution": "[m] of a pixel",
    "max_speed": "[m/s] of the robot",
    "max_turn_rate": "[rad/s] of the robot",
    "encoder_noise": "[m / sqrt(m)] of the robot",
    "scan_period": "[s] of the robot",
    "time_offset": "[s] of the robot",
    "wheel_base_scale": "[-] of the robot",
    "odometry_factor": "[-] on the standard deviations of Q",
    "sensor_factor": "[-] on the standard deviations of R",
    "max_landmarks": "capacity of the filter",
}
LIFE = {f"life.{field}": part for part, record in PARTS.items() for field in record._fields}
SETTINGS = (*TEXTS, *NUMBERS, *LIFE)
"""Names of all that can be set."""

CHOICES = {
    "drive": ("patrol", "route"),
    "landmarks": ("all", "junctions"),
    "labels": ("segments", "codes"),
}
PROBABILITY_SETTINGS = {f"life.{field}" for fields in PROBABILITIES.values() for field in fields}
WHOLE = {"life.people", "max_landmarks"}

Settings = dict[str, Any]
"""Values by the names of settings."""


class StudyFile(NamedTuple):
    """What a file of a study asks for.

    Attributes:
        path: The file.
        num_trials: Of each variant.
        seed: Of all that is random.
        success_distance: [m] a trial succeeds if its position is never further off.
        variants: Name and settings of each, those of the base included.
        varied: Names of the settings in which variants differ.
    """

    path: Path
    num_trials: int
    seed: int
    success_distance: float
    variants: tuple[tuple[str, Settings], ...]
    varied: tuple[str, ...]


def read(path: str | PathLike) -> StudyFile:
    """Read a study.

    Raises:
        InputError: It cannot be read, holds something else, or asks for what is not possible.
    """
    path = Path(path)
    given = toml_or_json.read(path, "see jaxslam.study.study_file")
    known = ("trials", "seed", "success_m", "base", "vary", "variant", "sample")
    for key in given:
        if key not in known:
            raise _unknown(path, key, known)
    base = _settings(path, "base", given.get("base", {}))
    kinds = [key for key in ("vary", "variant", "sample") if key in given]
    if len(kinds) > 1:
        problem = f"and {kinds[1]} are both there"
        raise InputError(problem, path=path, field=kinds[0], advice="write one of them")
    trials = _number(path, "trials", given.get("trials", 100), 1, MAX_TRIALS, whole=True)
    seed = _number(path, "seed", given.get("seed", 0), 0, 2**32 - 1, whole=True)
    success = _number(path, "success_m", given.get("success_m", 0.5), 1e-6, 1e6)
    make: Callable[..., list[tuple[str, Settings]]]
    make = (
        {"vary": _combinations, "variant": _listed, "sample": _sampled}[kinds[0]] if kinds else _one
    )
    variants = make(path, given[kinds[0]] if kinds else None, base, int(seed))
    _check_distinct(path, variants)
    names = list(dict.fromkeys(name for _, own in variants for name in own))
    first = variants[0][1]
    varied = [n for n in names if any(own.get(n) != first.get(n) for _, own in variants)]
    return StudyFile(path, int(trials), int(seed), success, tuple(variants), tuple(varied))


def _one(path: Path, given: Any, base: Settings, seed: int) -> list[tuple[str, Settings]]:
    return [("base", base)]


def _combinations(path: Path, given: Any, base: Settings, seed: int) -> list[tuple[str, Settings]]:
    """Every combination of the values of some settings."""
    values = _lists(path, "vary", given)
    checked = {
        name: [_value(path, f"vary.{name}", name, x) for x in own] for name, own in values.items()
    }
    count = math.prod(len(own) for own in checked.values())
    if count > MAX_VARIANTS:
        raise InputError(f"asks for {count} variants, more than {MAX_VARIANTS}", path=path)
    found = []
    for chosen in itertools.product(*checked.values()):
        own = dict(zip(checked, chosen, strict=True))
        found.append((", ".join(_text(name, x) for name, x in own.items()), base | own))
    return found


def _listed(path: Path, given: Any, base: Settings, seed: int) -> list[tuple[str, Settings]]:
    """Variants one by one."""
    if not isinstance(given, list) or not all(isinstance(one, dict) for one in given):
        raise InputError("is no [[variant]]", path=path, field="variant")
    found = []
    for number, one in enumerate(given):
        field = f"variant {number + 1}"
        name = one.get("name")
        own = _settings(path, field, {k: x for k, x in one.items() if k != "name"})
        if name is not None and not isinstance(name, str):
            raise InputError("is no text", path=path, field=f"{field}: name")
        text = ", ".join(_text(k, x) for k, x in own.items())
        found.append((name or text or "base", base | own))
    return found


def _sampled(path: Path, given: Any, base: Settings, seed: int) -> list[tuple[str, Settings]]:
    """Points of a box, by Sobol's sequence or as a Latin hypercube."""
    if not isinstance(given, dict):
        raise InputError("is no table", path=path, field="sample")
    rest = {key: x for key, x in given.items() if key not in ("method", "count")}
    method = given.get("method", "sobol")
    if method not in ("sobol", "latin"):
        raise InputError(f"is {method!r}, not sobol or latin", path=path, field="sample.method")
    count = int(_number(path, "sample.count", given.get("count", 16), 1, MAX_VARIANTS, whole=True))
    limits = _lists(path, "sample", rest)
    for name, pair in limits.items():
        field = f"sample.{name}"
        if name in TEXTS or len(pair) != 2:
            raise InputError("is not [from, to] of a number", path=path, field=field)
        low, high = (_value(path, field, name, x) for x in pair)
        if not low < high:
            raise InputError(f"goes from {low} to {high}", path=path, field=field)
    low, high = (np.array([float(pair[k]) for pair in limits.values()]) for k in (0, 1))
    sampler = qmc.Sobol if method == "sobol" else qmc.LatinHypercube
    engine = sampler(len(limits), seed=seed)
    if method == "sobol":  # the first points of a power of two fill the box evenly
        points = engine.random_base2(math.ceil(math.log2(count)))[:count]
    else:
        points = engine.random(count)
    found = []
    for number, point in enumerate(low + (high - low) * points):
        own = {k: round(x) if k in WHOLE else float(x) for k, x in zip(limits, point, strict=True)}
        found.append((f"{number}", base | own))
    return found


def _settings(path: Path, field: str, given: Any) -> Settings:
    """Settings of a table, checked one by one; nested tables are names with dots."""
    return {
        name: _value(path, f"{field}: {name}", name, x)
        for name, x in _flat(path, field, given).items()
    }


def _flat(path: Path, field: str, given: Any) -> Settings:
    """Values of a table by the names of settings, which are known."""
    if not isinstance(given, dict):
        raise InputError("is no table", path=path, field=field)
    found: Settings = {}
    for key, value in given.items():
        nested = isinstance(value, dict)
        own = {f"{key}.{k}": x for k, x in value.items()} if nested else {key: value}
        for name, x in own.items():
            if name not in SETTINGS:
                raise _unknown(path, name, SETTINGS, field)
            found[name] = x
    return found


def _lists(path: Path, field: str, given: Any) -> dict[str, list]:
    """Lists of values by the names of settings; there is one at least, and none is empty."""
    found = _flat(path, field, given)
    if not found:
        raise InputError("is empty", path=path, field=field, advice="name a setting and its values")
    for name, values in found.items():
        if not isinstance(values, list) or not values:
            raise InputError("is no list of values", path=path, field=f"{field}.{name}")
    return found


def _value(path: Path, field: str, name: str, given: Any) -> Any:
    """The value of a setting; InputError unless it is of its kind and possible."""
    if name in TEXTS:
        if not isinstance(given, str):
            raise InputError(f"is {given!r}, not {TEXTS[name]}", path=path, field=field)
        if name in CHOICES and given not in CHOICES[name]:
            raise InputError(f"is {given!r}, not {TEXTS[name]}", path=path, field=field)
        return given
    most = 1.0 if name in PROBABILITY_SETTINGS else math.inf
    signed = name in ("life.std_by_incidence", "time_offset")
    least = -math.inf if signed else 0.0
    return _number(path, field, given, least, most, whole=name in WHOLE)


def _number(
    path: Path, field: str, given: Any, least: float, most: float, *, whole: bool = False
) -> float:
    """A number of a file, in [least, most]."""
    is_number = isinstance(given, int | float) and not isinstance(given, bool)
    if not is_number or math.isnan(given) or (whole and given != int(given)):
        wanted = "whole number" if whole else "number"
        raise InputError(f"is {given!r}, not a {wanted}", path=path, field=field)
    if not least <= given <= most:
        limits = f"{least:g} or more" if math.isinf(most) else f"between {least:.9g} and {most:.9g}"
        raise InputError(f"is {given}, not {limits}", path=path, field=field)
    return int(given) if whole else float(given)


def _check_distinct(path: Path, variants: Sequence[tuple[str, Settings]]) -> None:
    """Raise InputError if two variants are the same, or have the same name."""
    seen: dict[str, str] = {}
    names: set[str] = set()
    for name, own in variants:
        key = repr(sorted(own.items()))
        if key in seen:
            problem = f"{seen[key]!r} and {name!r} are the same"
            raise InputError(problem, path=path, field="variants", advice="remove one of them")
        if name in names:
            raise InputError(f"two are called {name!r}", path=path, field="variants")
        seen[key] = name
        names.add(name)


def _unknown(path: Path, name: str, known: Sequence[str], field: str | None = None) -> InputError:
    """The error of a name that is not known, with the one that is meant, perhaps."""
    near = difflib.get_close_matches(name, known, 1)
    advice = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
    return InputError(f"{name} is not known", path=path, field=field, advice=advice)


def _text(name: str, value: Any) -> str:
    """A setting as part of the name of a variant."""
    shown = f"{value:g}" if isinstance(value, int | float) else str(value)
    return shown if name in ("scanner", "world") else f"{name.removeprefix('life.')} {shown}"


def files_of(settings: Mapping[str, Any], folder: Path) -> Settings:
    """Settings whose files are named relative to the current folder, not to that of the study."""
    found = dict(settings)
    for name in ("path", "robot", "noise", "world"):
        value = found.get(name)
        if value is not None and (name != "world" or Path(folder / value).is_file()):
            found[name] = str(folder / value)
    return found
