"""What goes wrong in life, in a file: TOML or JSON, for `jaxslam simulate --life FILE`.

A value is a number in the SI unit, or a text with its unit ("0.8 m/s", "10 %"); an unknown key is
an error. In a study (`study.study_file`) the same keys are called `life.KEY`. What is not there
does not happen. `typical` instead of a file is what recorded drives show on average
(`simulation.life_defaults`).

    people            number of them, walking to and fro along the drive
    people_per_metre  or this many on each square metre that the drive passes
      speed, standing, carts, distance       of people: mean speed, share of the time and of them
    closed            share of the time in which each door is closed
      door_period     after which a door may change
    moved             share of the loose furniture that is moved, by `moved_by`, at `moved_at`
    missing           probability that a beam does not return
    black, glass      share of the walls: `black_range` and `glass_angle` in which they are seen
    std_scale, std_per_range, std_by_incidence, resolution, spot     errors of ranges
      shared_std, shared_angle               that beams share with their neighbours
    slip, carpet      of wheels: probability with `slip_share`, share of the floor and `carpet_turn`
    lost              probability that odometry fails, for `lost_scans`, `latched` or standing
    dropped           probability that a scan is lost
    carried           probability that the robot is carried once, `carry` along its path

`simulation`'s `RangeErrors`, `Traffic`, `WheelFaults` and `Moves` say what each is exactly.
"""

import math
from collections.abc import Iterable, Mapping
from os import PathLike
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxslam.io import toml_or_json
from jaxslam.io.errors import InputError
from jaxslam.io.quantities import Table
from jaxslam.simulation.life import AT_LEAST_ONE, POSITIVE, PROBABILITIES
from jaxslam.simulation.life_defaults import people_on, typical_settings
from jaxslam.simulation.moving_parts import Moves
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.simulation.traffic import Traffic
from jaxslam.simulation.wheel_faults import WheelFaults

EXAMPLE = """\
people = 5
speed = "0.8 m/s"
missing = "5 %"          # of the beams
closed = 0.2             # of the time, each door
slip = 0.01
"""

TYPICAL = "typical"
"""Name of `life_defaults.typical_settings`, instead of a file."""


class Crowding(NamedTuple):
    """How many people there are, where `people` is not given.

    Attributes:
        people_per_metre: [1 / m] on each square metre that the drive passes.
    """

    people_per_metre: float = 0.0


PARTS: Mapping[str, Any] = MappingProxyType(
    {
        "ranges": RangeErrors,
        "traffic": Traffic,
        "wheels": WheelFaults,
        "furniture": Moves,
        "crowding": Crowding,
    }
)
"""The records whose fields are the keys."""

SETTINGS: Mapping[str, str] = MappingProxyType(
    {field: part for part, record in PARTS.items() for field in record._fields}
)
"""Each key, and the part of life that it is of."""

WHOLE = frozenset({"people"})
"""Keys of whole numbers."""

KINDS = {
    **dict.fromkeys(
        ("resolution", "black_range", "distance", "carry", "moved_by", "shared_std"), "length"
    ),
    **dict.fromkeys(("spot", "glass_angle", "shared_angle"), "angle"),
    **dict.fromkeys(("door_period", "moved_at"), "time"),
    **{"speed": "speed", "std_by_incidence": "per angle", "carpet_turn": "angle over a length"},
    **dict.fromkeys(("people", "people_per_metre", "lost_scans"), "number"),
}
"""Kinds of `quantities`, of those keys that are no ratios."""

NEEDS = {
    **dict.fromkeys(("speed", "standing", "carts", "distance"), "people"),
    **{"door_period": "closed", "moved_by": "moved", "moved_at": "moved", "moved": "moved_at"},
    **{"black_range": "black", "glass_angle": "glass", "slip_share": "slip"},
    **{"carpet_turn": "carpet", "lost_scans": "lost", "latched": "lost", "carry": "carried"},
    "shared_angle": "shared_std",
}
"""Keys that say nothing without another one."""

SIZES = {"slip": "slip_share", "carpet": "carpet_turn", "carried": "carry", "moved": "moved_by"}
"""Keys of what happens, and how much then; by default not 0."""

MOST = {
    **{"std_scale": 100.0, "std_per_range": 1.0, "std_by_incidence": 10.0, "shared_std": 1.0},
    **{"shared_angle": 2 * math.pi, "resolution": 1.0, "spot": 0.5, "glass_angle": math.pi / 2},
    **{"black_range": 1e3, "people": 1e4, "people_per_metre": 100.0, "speed": 20.0},
    **{"missing": 0.99, "dropped": 0.99},  # else there is nothing to be mapped
    **{"distance": 20.0, "moved_by": 20.0, "slip_share": 10.0, "carpet_turn": 10.0, "carry": 1e3},
}
"""Largest values in SI units; beyond them the unit is another one."""
_MOST = 1e6


def read(path: str | PathLike) -> dict[str, float]:
    """Read what goes wrong.

    Args:
        path: TOML or JSON file, as above, or `TYPICAL`.

    Returns:
        Numbers in SI units by their keys, as they are in the file.

    Raises:
        InputError: The file cannot be read, is neither, or asks for nothing; a key is unknown, or
            says nothing without another one; a value is not possible, or has an unknown unit.
    """
    if str(path) == TYPICAL:
        return typical_settings()
    advice = "write KEY = NUMBER; jaxslam.io.life_file has the keys"
    content = toml_or_json.read(path, advice)
    table = Table(path, "life", content)
    table.check_keys(tuple(SETTINGS))
    found = {key: number(table, key, given) for key, given in content.items()}
    if not found:
        raise InputError("asks for nothing", path=path, advice=advice)
    if "people" in found and "people_per_metre" in found:
        raise table.error("people_per_metre", "says nothing beside people", "leave one of both out")
    wrong = unused([found])
    if wrong is not None:
        raise table.error(*wrong)
    return found


def number(table: Table, key: str, given: Any) -> float:
    """The value of a key in its SI unit.

    Args:
        table: Where it is, for the message.
        key: One of `SETTINGS`.
        given: A number, or a text with a unit.

    Raises:
        InputError: It is no such quantity, or not possible.
    """
    part = SETTINGS[key]
    is_share = key in (*PROBABILITIES.get(part, ()), "moved")
    low, high = 0.0, MOST.get(key, 1.0 if is_share else _MOST)
    if key in POSITIVE.get(part, ()):
        low = 1e-6
    elif key in AT_LEAST_ONE.get(part, ()):
        low = 1.0
    elif key == "std_by_incidence":
        low = -high
    found = table.checked(key, given, KINDS.get(key, "ratio"), low, high)
    if found is None or (key in WHOLE and found != int(found)):
        raise table.error(key, f"{given!r} is no whole number")
    return int(found) if key in WHOLE else found


def unused(
    all_settings: Iterable[Mapping[str, float]], prefix: str = ""
) -> tuple[str, str, str] | None:
    """A key that says nothing in any of these settings; None if there is none.

    Returns:
        The key, what is wrong with it, and what to do; names of other keys have the prefix.
    """
    everywhere = list(all_settings)
    for key, other in NEEDS.items():
        given = [own for own in everywhere if key in own]
        if given and all(key in silent(own) for own in given):
            name = f"{prefix}{other}"
            if any(other in own for own in given):
                return key, f"says nothing where {name} is 0", f"give {name} above 0"
            return key, f"says nothing without {name}", f"add {name}"
    for key, size in SIZES.items():
        given = [own for own in everywhere if own.get(key)]
        if given and not any(own.get(size, 1.0) for own in given):
            name = f"{prefix}{size}"
            return key, f"says nothing where {name} is 0", f"give {name} above 0"
    return None


def silent(settings: Mapping[str, float]) -> set[str]:
    """Keys that say nothing beside the other ones, as `speed` where `people` is 0."""
    found = set()
    for key, other in NEEDS.items():
        others = (other, "people_per_metre") if other == "people" else (other,)
        if key in settings and not any(settings.get(name) for name in others):
            found.add(key)
    return found


def number_of_people(settings: Mapping[str, float], path: Any) -> int:
    """How many people there are along a drive (N, 2) [m]: `people`, if it is given."""
    if "people" in settings:
        return int(settings["people"])
    return people_on(path, settings.get("people_per_metre", 0.0))


def parts(settings: Mapping[str, float]) -> dict[str, Any]:
    """The records of `PARTS` by their names, with these settings."""
    return {
        part: record(**{key: settings[key] for key in record._fields if key in settings})
        for part, record in PARTS.items()
    }


def describe(settings: Mapping[str, float]) -> str:
    """What goes wrong, in a line."""
    hidden = "people_per_metre" if "people" in settings else None
    return ", ".join(f"{key} {value:g}" for key, value in settings.items() if key != hidden)
