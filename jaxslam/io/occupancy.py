"""Occupancy maps of ROS: a map_server YAML file and its image.

To read the YAML needs the extra `[ros]`; images are read by Pillow, which matplotlib brings along.
"""

import math
import warnings
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.output import replace, write_text
from jaxslam.io.text import lines

CELLS = 2**26  # most cells of a map
TEXT = 2**16  # [bytes] of the longest YAML file
FORMATS = ("PPM", "PNG", "BMP")  # PPM stands for all of PBM, PGM and PPM
MODES = ("trinary", "scale", "raw")
FIELDS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


class Occupancy(NamedTuple):
    """A map of H x W cells; cell [i, j] covers a square, i grows with x, j with y.

    Where both are False the cell is unknown.
    """

    occupied: np.ndarray  # (H, W) bool
    free: np.ndarray  # (H, W) bool
    resolution: float  # [m] side of a cell
    origin: np.ndarray  # (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame


def read(path: str | PathLike) -> Occupancy:
    """Read a map.

    A cell whose shade exceeds `occupied_thresh` is occupied, one below `free_thresh` free, as
    map_server has it; transparent pixels are unknown. The modes trinary and scale differ only in
    what lies between, which is unknown here.

    Args:
        path: YAML file with the fields in `FIELDS`, and perhaps `mode`.

    Raises:
        InputError: PyYAML is not installed; the file is no YAML or lacks a field; a field is of
            the wrong type or out of range; the image lies outside the map's folder, cannot be
            read, or has no cells or more than `CELLS`.

    References:
        https://docs.nav2.org/configuration/packages/configuring-map-server.html
    """
    path = Path(path)
    fields = _load(path)
    for name in FIELDS:
        if name not in fields:
            raise InputError("missing", path=path, field=name, advice="add it")
    resolution = _number(path, "resolution", fields["resolution"])
    if resolution <= 0.0:
        advice = "give the side of a cell in metres"
        raise InputError(
            f"{resolution} is not positive", path=path, field="resolution", advice=advice
        )
    origin = fields["origin"]
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError("is not a list of three numbers", path=path, field="origin")
    origin = np.array([_number(path, "origin", value) for value in origin])
    negate = fields["negate"]
    if not isinstance(negate, int) or negate not in (0, 1):
        raise InputError(f"{_shown(negate)} is neither 0 nor 1", path=path, field="negate")
    mode = fields.get("mode", "trinary")
    if mode not in MODES:
        advice = f"the modes are {', '.join(MODES)}"
        raise InputError(f"unknown mode {_shown(mode)}", path=path, field="mode", advice=advice)
    low, high = (_number(path, name, fields[name]) for name in ("free_thresh", "occupied_thresh"))
    for name, value in (("free_thresh", low), ("occupied_thresh", high)):
        if not 0.0 <= value <= 1.0:
            raise InputError(f"{value} is not between 0 and 1", path=path, field=name)
    if low >= high:
        problem = f"{low} is not below the occupied_thresh of {high}"
        raise InputError(problem, path=path, field="free_thresh")
    shade, known = _image(_image_path(path, fields["image"]))
    chance = _chance(shade, mode, bool(negate))
    known &= np.isfinite(chance)
    turned = lambda cells: np.ascontiguousarray(cells[::-1].T)  # rows of an image go down
    occupied, free = turned(known & (chance > high)), turned(known & (chance < low))
    return Occupancy(occupied, free, resolution, origin)


def write(path: str | PathLike, occupancy: Occupancy) -> None:
    """Write a map: the YAML file and, beside it, its image of the same name.

    Args:
        path: YAML file to write, all of it or nothing, after the image.
        occupancy: The map.

    Raises:
        InputError: A file cannot be written.
    """
    path = Path(path)
    shade = np.where(occupancy.occupied, 0, np.where(occupancy.free, 254, 205)).astype(np.uint8)
    rows = np.ascontiguousarray(shade.T[::-1])
    image = path.with_suffix(".pgm")
    with replace(image) as file:
        file.write(b"P5\n%d %d\n255\n" % rows.shape[::-1] + rows.tobytes())
    x, y, turn = (float(value) for value in occupancy.origin)
    fields = {
        "image": image.name,
        "mode": "trinary",
        "resolution": f"{occupancy.resolution!r}",
        "origin": f"[{x!r}, {y!r}, {turn!r}]",
        "negate": "0",
        "occupied_thresh": "0.65",
        "free_thresh": "0.196",  # the shade 205 of unknown cells lies just above
    }
    write_text(path, "".join(f"{name}: {value}\n" for name, value in fields.items()))


def _chance(shade: np.ndarray, mode: str, negate: bool) -> np.ndarray:
    """Chance (H, W) that a cell is occupied, of its shade in 0..1; NaN where it is unknown."""
    if mode != "raw":
        return shade if negate else 1.0 - shade
    percent = np.round(255.0 * shade)
    return np.where(percent <= 100.0, percent / 100.0, np.nan)


def _load(path: Path) -> Mapping[str, Any]:
    """The fields of a map's YAML file, not yet checked."""
    try:
        import yaml
    except ImportError:
        advice = "pip install 'jaxslam[ros]'"
        raise InputError("PyYAML is needed to read it", path=path, advice=advice) from None
    advice = "name the YAML file of a map, as map_saver writes it"
    text = b""
    for _, line in lines(path):
        text += line
        if len(text) > TEXT:
            raise InputError(f"is longer than {TEXT} bytes", path=path, advice=advice)
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
    """A finite number; text that is one counts, as YAML 1.1 takes 5e-2 for text."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{_shown(value)} is not a finite number", path=path, field=field)
    return number


def _shown(value: Any) -> str:
    """A value as errors show it."""
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _image_path(path: Path, name: Any) -> Path:
    """Path of the image that a map names; it lies in the map's folder or below."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(f"{_shown(name)} is no file name", path=path, field="image")
    image = path.parent / name
    homes = {path.parent.resolve(), path.resolve().parent}
    if Path(name).is_absolute() or not any(image.resolve().is_relative_to(x) for x in homes):
        advice = "put the image beside the YAML file and name it without its folder"
        raise InputError(
            f"{_shown(name)} lies outside the map's folder", path=path, field="image", advice=advice
        )
    return image


def _image(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Shade (H, W) float32 from 0, black, to 1, and whether the pixel is opaque (H, W) bool."""
    from PIL import Image, UnidentifiedImageError

    advice = "name a PGM, PNG or BMP image"
    try:
        with warnings.catch_warnings():
            # Pillow's own limit warns first; ours stands below.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as image:
                width, height = image.size
                if not 0 < width * height <= CELLS:
                    problem = f"{width} x {height} cells are not between 1 and {CELLS}"
                    raise InputError(problem, path=path, advice="cut the map into parts")
                return _pixels(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check the field image") from None
    except Image.DecompressionBombError:
        raise InputError(f"has more than {CELLS} cells", path=path) from None
    except UnidentifiedImageError:
        raise InputError("is no image that can be read", path=path, advice=advice) from None
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read ({reason})", path=path, advice=advice) from None


def _pixels(image: Any) -> tuple[np.ndarray, np.ndarray]:
    """Shade and opacity of an open Pillow image."""
    if image.mode == "I" or image.mode.startswith("I;16"):  # 16 bits a pixel
        shade = np.asarray(image).astype(np.float32) / np.float32(65535)
        return shade, np.ones(shade.shape, bool)
    values = np.asarray(image.convert("RGBA"))
    shade = values[..., :3].mean(axis=2, dtype=np.float32) / np.float32(255)
    return shade, values[..., 3] > 127
