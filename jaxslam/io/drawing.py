"""What the readers of drawings share: walls in metres, what was left out, units."""

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import NamedTuple

import numpy as np

from jaxslam.io.errors import InputError

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length [m] of the units by name."""

CURVE_TOLERANCE = 0.005  # [m] between a curve and the segments that stand for it


class Drawing(NamedTuple):
    """Walls of a file of lines.

    Attributes:
        walls: (S, 4) [m] ends x1, y1, x2, y2; y is up.
        left_out: How many of what was not read, by name in the plural.
        notes: What was assumed.
    """

    walls: np.ndarray
    left_out: Mapping[str, int] = {}
    notes: tuple[str, ...] = ()


def size_of_unit(unit: str | float) -> float:
    """Length [m] of a unit: one of `UNITS`, or a number of metres.

    Raises:
        InputError: It is neither, or not above 0.
    """
    try:
        size = UNITS[unit] if unit in UNITS else float(unit)
    except (TypeError, ValueError):
        size = math.nan
    if not 0.0 < size < math.inf:
        advice = f"write {', '.join(UNITS)}, or the metres of a unit of the drawing: 0.1 is 1:100 "
        advice += "in mm"
        raise InputError(f"{unit!r:.40} is no unit of length", field="--unit", advice=advice)
    return size


def unit_missing(path: str | PathLike, problem: str) -> InputError:
    """The error of a file whose unit is not known."""
    advice = f"add --unit {'|'.join(UNITS)}, or the metres of a unit of the drawing"
    return InputError(problem, path=path, advice=advice)


def no_library(path: str | PathLike, name: str) -> InputError:
    """The error of a reader's library that is not installed."""
    advice = "pip install 'jaxslam[cad]'"
    return InputError(f"{name} is needed to read it", path=path, advice=advice)


def joined(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Segments (S, 4) of polylines (n, 2)."""
    parts = [np.hstack([line[:-1], line[1:]]) for line in lines if len(line) > 1]
    return np.concatenate(parts) if parts else np.zeros((0, 4))


def layers_note(found: Mapping[str, int], layers: Sequence[str], path: str | PathLike) -> str:
    """Note on the layers that walls are from, empty if there is one alone and none was wanted.

    Args:
        found: Number of walls read of each layer.
        layers: Names of those wanted; empty for all.
        path: The file.

    Raises:
        InputError: There is none of a name, or nothing on it.
    """
    for name in layers:
        if name not in found:
            known = ", ".join(repr(key) for key in sorted(found)) or "none"
            problem = f"{name!r} is no layer with lines that can be read"
            raise InputError(problem, path=path, field="--layers", advice=f"there are: {known}")
    if len(found) < 2:
        return ""
    names = sorted(found, key=lambda name: (-found[name], name))
    listed = ", ".join(f"{name!r} ({found[name]})" for name in names[:8])
    more = f" and {len(names) - 8} more" if len(names) > 8 else ""
    return f"walls are all lines of the layers {listed}{more}; --layers picks some of them"
