"""Numbers with units in files: `0.25 m`, `3 deg`, `10 Hz`; a number alone has the SI unit."""

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxslam.io.errors import InputError

DEGREE = math.pi / 180
INCH = 0.0254

UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "length": {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": INCH, "ft": 12 * INCH},
        "angle": {"rad": 1.0, "mrad": 0.001, "deg": DEGREE, "°": DEGREE},
        "time": {"s": 1.0, "ms": 0.001, "us": 1e-6},
        "rate": {"Hz": 1.0, "1/s": 1.0, "rpm": 1 / 60},
        "speed": {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001, "km/h": 1 / 3.6},
        "turn rate": {"rad/s": 1.0, "deg/s": DEGREE, "°/s": DEGREE, "rpm": math.pi / 30},
        "length over a metre": {
            **{"m": 1.0, "cm": 0.01, "mm": 0.001},
            **{"m/sqrt(m)": 1.0, "cm/sqrt(m)": 0.01, "mm/sqrt(m)": 0.001},
        },
        "angle over a metre": {
            **{"rad": 1.0, "deg": DEGREE, "mrad": 0.001},
            **{"rad/sqrt(m)": 1.0, "deg/sqrt(m)": DEGREE, "mrad/sqrt(m)": 0.001},
        },
        "angle of a metre": {
            **{"rad": 1.0, "deg": DEGREE, "mrad": 0.001},
            **{"rad sqrt(m)": 1.0, "deg sqrt(m)": DEGREE, "mrad sqrt(m)": 0.001},
        },
        "angle over a length": {"rad/m": 1.0, "mrad/m": 0.001, "deg/m": DEGREE},
        "per angle": {"1/rad": 1.0, "1/deg": 1 / DEGREE},
        "ratio": {"": 1.0, "%": 0.01},
        "number": {"": 1.0},
    }
)
"""Units of each kind of quantity, in the SI unit of the kind, which is the first."""

_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


def parse(value: Any, kind: str) -> float:
    """A quantity in the SI unit of its kind.

    Args:
        value: A number, of the SI unit, or a text of a number and a unit.
        kind: One of `UNITS`.

    Raises:
        InputError: It is no number, not finite, or of no unit of this kind. It names no field.
    """
    units = UNITS[kind]
    first, *_ = units
    example = f'write "1.5 {first}"' if first else "write 1.5"
    known = ", ".join(unit for unit in units if unit) or "none"
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(f"{value!r} is no {kind}"[:200], advice=f"{example}; units are {known}")
    if isinstance(value, str):
        match = _NUMBER.fullmatch(value)
        if match is None:
            raise InputError(f"{value[:80]!r} is no {kind}", advice=f"{example}; units are {known}")
        text, unit = match.groups()
        if unit not in units:
            given = f"has the unit {unit[:20]!r}" if unit else "has no unit"
            raise InputError(f"{value[:80]!r} {given}", advice=f"units are {known}")
        number = float(text) * units[unit]
    else:
        number = float(value) if abs(value) < 1e300 else math.inf
    if not math.isfinite(number):
        raise InputError(f"{value!r} is not finite"[:200], advice=example)
    return number


class Table(NamedTuple):
    """A section of a file, whose errors name file and key.

    Attributes:
        path: The file.
        name: Of the section.
        content: Its keys and values.
    """

    path: str | PathLike
    name: str
    content: dict[str, Any]

    def error(self, key: str, problem: str, advice: str | None = None) -> InputError:
        """An error of the value of a key."""
        field = f"{self.name}.{key}" if key else self.name
        return InputError(problem, path=self.path, field=field, advice=advice)

    def check_keys(self, known: Sequence[str]) -> None:
        """Raise InputError if there is a key that is not known."""
        for key in self.content:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                advice = f"did you mean {near[0]}" if near else f"keys are {', '.join(known)}"
                raise self.error(key[:40], "is an unknown key", advice)

    def quantity(self, key: str, kind: str, low: float, high: float) -> float | None:
        """A quantity in the SI unit of its kind, None if it is not there.

        Raises:
            InputError: It is none, or not in [low, high].
        """
        return self.checked(key, self.content.get(key), kind, low, high)

    def checked(self, key: str, value: Any, kind: str, low: float, high: float) -> float | None:
        """A value of a key in the SI unit of its kind, None if it is None; raise as `quantity`."""
        if value is None:
            return None
        try:
            number = parse(value, kind)
        except InputError as error:
            problem, _, advice = str(error).partition("; ")
            raise self.error(key, problem, advice) from None
        if not low <= number <= high:
            unit = next(iter(UNITS[kind]))
            limits = f"{low:g} and {high:g} {unit}".rstrip()
            raise self.error(key, f"{value!r} is not between {limits}"[:200], "check its unit")
        return number

    def required(self, key: str, kind: str, low: float, high: float) -> float:
        """A quantity as `quantity`, that must be there."""
        found = self.quantity(key, kind, low, high)
        if found is None:
            unit = next(iter(UNITS[kind]))
            advice = f"add {key}, {kind}" + (f" [{unit}]" if unit else "")
            raise self.error(key, "is missing", advice)
        return found

    def text(self, key: str) -> str | None:
        """A text of one line, None if it is not there.

        Raises:
            InputError: It is none.
        """
        value = self.content.get(key)
        if value is None:
            return None
        if not isinstance(value, str) or not value.strip() or not value.isprintable():
            raise self.error(key, f"{value!r} is no text of one line"[:200], "write it in quotes")
        return value.strip()
