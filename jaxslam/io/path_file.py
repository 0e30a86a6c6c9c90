"""Waypoints of a drive: CSV of x, y, or a line of GeoJSON."""

from os import PathLike
from pathlib import Path

import numpy as np

from jaxslam.core.maps import MAX_COORDINATE
from jaxslam.io import strict_json, text
from jaxslam.io.errors import InputError
from jaxslam.io.world_lines import geometries, lines_of, numbers_of, split_fields, unit_of

COLUMNS = ("x", "y")
MIN_LENGTH = 0.5  # [m] of a path
ADVICE = "name CSV of x,y [m], or GeoJSON of one LineString"


def read(path: str | PathLike) -> np.ndarray:
    """Read waypoints (K, 2) [m], in the coordinates of the file of the world.

    Args:
        path: Text of two columns x, y [m] parted by commas, semicolons, tabs or spaces, `#` starts
            a comment line; or GeoJSON (`.geojson`, `.json`) that has one LineString, in metres.

    Raises:
        InputError: It cannot be read; a line has not the columns or no finite numbers; coordinates
            are degrees; or the path is shorter than `MIN_LENGTH`.
    """
    path = Path(path)
    is_geojson = path.suffix.lower() in (".geojson", ".json")
    points = _geojson(path) if is_geojson else _csv(path)
    if not np.abs(points).max(initial=0.0) <= MAX_COORDINATE:
        problem = f"has coordinates beyond {MAX_COORDINATE:g} m"
        raise InputError(problem, path=path, advice="give it in metres")
    if not np.hypot(*np.diff(points, axis=0).T).sum() >= MIN_LENGTH:
        problem = f"is a path shorter than {MIN_LENGTH} m"
        raise InputError(problem, path=path, advice="give two waypoints at least, in metres")
    return points


def _csv(path: Path) -> np.ndarray:
    """Waypoints (K, 2) [m] of a table."""
    points: list[list[float]] = []
    is_first = True
    for number, line in text.lines(path):
        fields = split_fields(line)
        if not fields or fields[0].startswith(b"#"):
            continue
        names = [field.decode("utf-8", "replace").strip("\"' ").lower() for field in fields]
        if is_first and names == [*COLUMNS]:
            is_first = False
            continue
        is_first = False
        points.append(numbers_of(path, number, fields, COLUMNS, ADVICE))
    return np.array(points).reshape(-1, 2)


def _geojson(path: Path) -> np.ndarray:
    """Waypoints (K, 2) [m] of the only line of a file."""
    content = strict_json.read(path, ADVICE)
    if content is None:
        raise InputError("does not exist", path=path, advice="check the name")
    found = [
        line
        for where, _, geometry in geometries(path, content)
        if geometry is not None and geometry.get("type") == "LineString"
        for line in lines_of(path, where, geometry.get("coordinates"), 1)
    ]
    if len(found) != 1:
        raise InputError(f"has {len(found)} LineStrings, not one", path=path, advice=ADVICE)
    size, _ = unit_of(path, content, found[0], None, has_option=False)
    return size * found[0]
