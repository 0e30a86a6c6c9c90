"""ROS occupancy grids: a map_server YAML file and its image.

Reading the YAML needs the extra `[ros]`.
"""

import math
from collections.abc import Mapping
from os import PathLike
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from jaxslam.core.maps import MAX_COORDINATE, MAX_RESOLUTION, MIN_RESOLUTION, OccupancyMap
from jaxslam.core.se2_np import transform
from jaxslam.core.types import as_float64, check_array
from jaxslam.io import pictures
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace, write_text
from jaxslam.io.text import lines

MAX_YAML_BYTES = 2**16  # [bytes] of the longest YAML file
MODES = ("trinary", "scale", "raw")
UNKNOWN_SHADE, FREE_SHADE = 205, 254  # [0, 255] that map_saver writes; 254 and 255 are free
UNKNOWN_PROBABILITY = 1 - UNKNOWN_SHADE / 255
THRESHOLDS = (0.196, 0.65)  # free below, occupied above; the shade 205 is just above the first
MIN_WIDTH = 0.3  # [m] of the widest free place; below, white on a dark ground is lines
FIELDS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


def read(path: str | PathLike) -> OccupancyMap:
    """Read a map.

    As in map_server, a cell whose occupancy probability exceeds `occupied_thresh` is occupied, one
    below `free_thresh` is free. Transparent pixels are unknown. The modes trinary and scale differ
    only in the values between the thresholds, which are unknown here.

    Args:
        path: YAML file with the fields in `FIELDS`, and optionally `mode`.

    Raises:
        InputError: PyYAML is not installed; the file is no YAML or lacks a field; a field is of
            the wrong type or out of range, or the map reaches beyond `MAX_COORDINATE`; the image
            lies outside the map's folder, cannot be read, or has no cells or more than `MAX_CELLS`.

    References:
        https://docs.nav2.org/configuration/packages/configuring-map-server.html
    """
    path = Path(path)
    fields = _load(path)
    for name in FIELDS:
        if name not in fields:
            raise InputError("missing", path=path, field=name, advice="add it")
    resolution = _number(path, "resolution", fields["resolution"])
    _check_resolution(resolution, path)
    origin = fields["origin"]
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError("is not a list of three numbers", path=path, field="origin")
    origin = np.array([_number(path, "origin", value) for value in origin])
    if abs(origin[2]) > 2.0 * np.pi:
        problem = f"{origin[2]:g} is no yaw in radians"
        raise InputError(problem, path=path, field="origin", advice="90 degrees are 1.5708")
    negate = fields["negate"]
    if not isinstance(negate, int) or negate not in (0, 1):
        raise InputError(f"{_excerpt(negate)} is neither 0 nor 1", path=path, field="negate")
    mode = fields.get("mode", "trinary")
    if mode not in MODES:
        advice = f"the modes are {', '.join(MODES)}"
        raise InputError(f"unknown mode {_excerpt(mode)}", path=path, field="mode", advice=advice)
    free_below = _number(path, "free_thresh", fields["free_thresh"])
    occupied_above = _number(path, "occupied_thresh", fields["occupied_thresh"])
    for name, value in (("free_thresh", free_below), ("occupied_thresh", occupied_above)):
        if not 0.0 <= value <= 1.0:
            raise InputError(f"{value} is not between 0 and 1", path=path, field=name)
    if free_below >= occupied_above:
        problem = f"{free_below} is not below the occupied_thresh of {occupied_above}"
        raise InputError(problem, path=path, field="free_thresh")
    image, notes = _image_path(path, fields["image"])
    shade, known = pictures.read(image)
    if mode == "trinary" and not negate and UNKNOWN_PROBABILITY < free_below:
        is_unknown = _written_as_unknown(shade)
        if is_unknown.any():
            known &= ~is_unknown
            notes.append(
                f"cells of the shade {UNKNOWN_SHADE}, which map_saver writes for unknown, stay "
                f"unknown, although the free_thresh of {free_below:g} would make them free"
            )
    meaning = (mode, bool(negate), free_below, occupied_above)
    found = _to_map(shade, known, resolution, origin, notes, meaning)
    _check_coordinates(found, path, "origin")
    return found


def read_picture(path: str | PathLike, resolution: float) -> OccupancyMap:
    """Read a map from a picture alone: light is free, dark occupied.

    The thresholds are those that map_saver writes where black walls on white paper allow it, else
    `pictures.plan_shades` finds them and what is unknown; what it guesses is in the notes. The
    lower left corner, of the picture as viewers turn it, is the origin.

    Args:
        path: Image of one of `pictures.FORMATS`.
        resolution: [m] side of a cell.

    Raises:
        InputError: The picture cannot be read, or has no cells or more than `MAX_CELLS`; no pixel
            is free, or only lines on a dark ground are; the resolution is out of range, or the map
            reaches beyond `MAX_COORDINATE`.
    """
    _check_resolution(resolution, None)
    path = Path(path)
    shade, known = pictures.read(path, upright=True)
    plan = pictures.plan_shades(shade, known, resolution)
    shade = np.where(plan.walls, np.float32(0.0), shade)
    limits = THRESHOLDS if plan.limit is None else (1.0 - plan.limit, 1.0 - plan.limit)
    meaning = ("trinary", False, *limits)
    found = _to_map(
        shade, known & ~plan.unknown, resolution, np.zeros(3), list(plan.notes), meaning
    )
    _check_coordinates(found, path, None)
    if not found.free.any():
        advice = "invert it if it is light on dark, fill a transparent ground with white, or name "
        advice += "a YAML file with negate: 1"
        raise InputError("no pixel is white enough to be free", path=path, advice=advice)
    if pictures.looks_inverted(found.occupied, found.free):
        advice = "invert it, or name a YAML file with negate: 1"
        width = 2.0 * resolution * pictures.half_width(found.free)
        if width < MIN_WIDTH:
            problem = f"white, which is free, is at most {width:.2g} m wide on a dark ground"
            raise InputError(problem, path=path, advice=advice)
        note = f"white is taken as free: if this plan is inverted, {advice}"
        found = found._replace(notes=(*found.notes, note))
    return found


def files_of(path: str | PathLike) -> tuple[Path, ...]:
    """The files of a map: the YAML file and its image, or a picture alone.

    Raises:
        InputError: The YAML file cannot be read, or names no image that it may name.
    """
    path = Path(path)
    return (
        (path,)
        if pictures.is_picture(path)
        else (path, _image_path(path, _load(path).get("image"))[0])
    )


def _check_resolution(resolution: float, path: Path | None) -> None:
    """Raise InputError if the side of a cell [m] is out of range."""
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        problem = f"{resolution:g} is not between {MIN_RESOLUTION:g} and {MAX_RESOLUTION:g}"
        advice = "give the side of a cell in metres"
        raise InputError(problem, path=path, field="resolution", advice=advice)


def _check_coordinates(found: OccupancyMap, path: str | PathLike, field: str | None) -> None:
    """Raise InputError if a map reaches beyond `MAX_COORDINATE`."""
    rows, columns = found.free.shape
    corners = np.array([[0, 0], [rows, 0], [0, columns], [rows, columns]]) * found.resolution
    numbers = np.abs([*transform(found.origin, corners).ravel(), found.origin[2]])
    if not numbers.max() <= MAX_COORDINATE:
        problem = f"the map has coordinates of {numbers.max():g}, beyond {MAX_COORDINATE:g}"
        raise InputError(
            problem, path=path, field=field, advice="give it in metres, nearer to 0, 0"
        )


def _to_map(
    shade: np.ndarray,
    known: np.ndarray,
    resolution: float,
    origin: np.ndarray,
    notes: list[str],
    meaning: tuple[str, bool, float, float],
) -> OccupancyMap:
    """Map of an image; `meaning` is mode, negate, free_thresh and occupied_thresh."""
    mode, negate, free_below, occupied_above = meaning
    probability = _occupancy_probability(shade, mode, negate)
    known = known & np.isfinite(probability)
    occupied = _image_to_grid(known & (probability > occupied_above))
    free = _image_to_grid(known & (probability < free_below))
    return OccupancyMap(occupied, free, resolution, origin, tuple(notes))


def write(path: str | PathLike, occupancy: OccupancyMap) -> None:
    """Write a map: the YAML file and, beside it, its image of the same name.

    Args:
        path: YAML file to write, atomically, after the image.
        occupancy: The map.

    Raises:
        ValueError: A field of the map is of another shape or type, or not finite.
        InputError: A file cannot be written.
    """
    path = Path(path)
    occupied, free = np.asarray(occupancy.occupied), np.asarray(occupancy.free)
    check_array("occupied", occupied, ("H", "W"), np.bool_)
    check_array("free", free, occupied.shape, np.bool_)
    resolution = float(as_float64("resolution", occupancy.resolution, ()))
    x, y, heading = origin = as_float64("origin", occupancy.origin, (3,)).tolist()
    if not np.isfinite(origin).all() or not 0.0 < resolution < math.inf:
        raise ValueError(f"resolution is {resolution} and origin {origin}, not a size and a pose")
    shade = np.where(occupied, 0, np.where(free, 254, 205)).astype(np.uint8)
    rows = np.ascontiguousarray(shade.T[::-1])
    image = path.with_suffix(".pgm")
    with replace(image) as file:
        file.write(b"P5\n%d %d\n255\n" % rows.shape[::-1] + rows.tobytes())
    fields = {
        "image": image.name,
        "mode": "trinary",
        "resolution": f"{resolution!r}",
        "origin": f"[{x!r}, {y!r}, {heading!r}]",
        "negate": "0",
        "occupied_thresh": f"{THRESHOLDS[1]}",
        "free_thresh": f"{THRESHOLDS[0]}",
    }
    write_text(path, "".join(f"{name}: {value}\n" for name, value in fields.items()))


def _image_to_grid(pixels: np.ndarray) -> np.ndarray:
    """Cells [x, y] of pixels [row, column], whose rows go down."""
    return np.ascontiguousarray(pixels[::-1].T)


def _occupancy_probability(shade: np.ndarray, mode: str, negate: bool) -> np.ndarray:
    """Probability (H, W) that a cell is occupied, from its shade in 0..1; NaN where unknown."""
    if mode != "raw":
        return shade if negate else 1.0 - shade
    percent = np.round(255.0 * shade)
    return np.where(percent <= 100.0, percent / 100.0, np.nan)


def _written_as_unknown(shade: np.ndarray) -> np.ndarray:
    """Cells (H, W) bool of the shade for unknown, if the picture has one for free, too."""
    levels = np.round(255.0 * shade)
    is_unknown = (levels == UNKNOWN_SHADE) & (np.abs(255.0 * shade - levels) < 0.1)
    return is_unknown & bool((levels >= FREE_SHADE).any())


def _load(path: Path) -> Mapping[str, Any]:
    """The fields of a map's YAML file, not yet checked."""
    try:
        import yaml
    except ImportError:
        advice = "pip install 'jaxslam[ros]'"
        raise InputError("PyYAML is needed to read it", path=path, advice=advice) from None
    advice = f"the YAML file of a map has the fields {', '.join(FIELDS)}"
    if path.suffix.lower() not in (".yaml", ".yml"):
        advice += f", a picture ends in {', '.join(pictures.SUFFIXES)}"
    text = b""
    for _, part in lines(path):
        text += part
        if len(text) > MAX_YAML_BYTES:
            raise InputError(f"is longer than {MAX_YAML_BYTES} bytes", path=path, advice=advice)
    try:
        fields = yaml.safe_load(text)
    except yaml.MarkedYAMLError as error:
        line = None if error.problem_mark is None else error.problem_mark.line + 1
        problem = f"is not YAML ({error.problem})"
        raise InputError(problem, path=path, line=line, advice=advice) from None
    except (yaml.YAMLError, RecursionError, ValueError):
        raise InputError("is not YAML", path=path, advice=advice) from None
    if not isinstance(fields, dict):
        raise InputError("holds no fields", path=path, advice=advice)
    return fields


def _number(path: Path, field: str, value: Any) -> float:
    """A finite number, also given as text, because YAML 1.1 reads 5e-2 as text."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{_excerpt(value)} is not a finite number", path=path, field=field)
    return number


def _excerpt(value: Any) -> str:
    """A value as text for an error, shortened."""
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _image_path(path: Path, name: Any) -> tuple[Path, list[str]]:
    """Path of a map's image, which must be in the map's folder or below, and notes.

    An absolute path of another machine stands for the image of that name beside the YAML file.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f"{_excerpt(name)} is no file name", path=path, field="image")
    image, notes = path.parent / name, []
    beside = path.parent / PureWindowsPath(name).name
    if PureWindowsPath(name).is_absolute() or name.startswith("/"):
        if beside.is_file():
            notes = [f"image {_excerpt(name)} is taken to be {beside.name!r} beside the YAML file"]
            image = beside
    folders = {path.parent.resolve(), path.resolve().parent}
    inside = any(image.resolve().is_relative_to(folder) for folder in folders)
    if not inside or image != beside and Path(name).is_absolute():
        problem = f"{_excerpt(name)} is outside the map's folder"
        advice = "put the image beside the YAML file and name it without its folder"
        raise InputError(problem, path=path, field="image", advice=advice)
    return image, notes
