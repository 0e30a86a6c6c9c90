"""ROS occupancy grids: a map_server YAML file and its image.

Reading the YAML needs the extra `[ros]`; images are read by Pillow, which matplotlib installs.
"""

import math
import warnings
from collections.abc import Mapping
from os import PathLike
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from jaxslam.core.maps import MAX_CELLS, OccupancyMap
from jaxslam.core.types import as_float64, check_array
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace, write_text
from jaxslam.io.text import lines

MAX_YAML_BYTES = 2**16  # [bytes] of the longest YAML file
FORMATS = ("PPM", "PNG", "BMP")  # PPM stands for all of PBM, PGM and PPM
MODES = ("trinary", "scale", "raw")
UNKNOWN_SHADE, FREE_SHADE = 205, 254  # [0, 255] that map_saver writes; 254 and 255 are free
UNKNOWN_PROBABILITY = 1 - UNKNOWN_SHADE / 255
THRESHOLDS = (0.196, 0.65)  # free below, occupied above; the shade 205 is just above the first
PICTURES = tuple(".png .pgm .pbm .ppm .pnm .bmp .jpg .jpeg .gif .tif .tiff".split())
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
            the wrong type or out of range; the image lies outside the map's folder, cannot be
            read, or has no cells or more than `MAX_CELLS`.

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
        problem, advice = f"{resolution} is not positive", "give the side of a cell in metres"
        raise InputError(problem, path=path, field="resolution", advice=advice)
    origin = fields["origin"]
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError("is not a list of three numbers", path=path, field="origin")
    origin = np.array([_number(path, "origin", value) for value in origin])
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
    return _to_map(
        image, resolution, origin, notes, (mode, bool(negate), free_below, occupied_above)
    )


def read_picture(path: str | PathLike, resolution: float) -> OccupancyMap:
    """Read a map from a picture alone: white is free, black occupied.

    The thresholds are those that map_saver writes; the lower left corner is the origin.

    Args:
        path: PGM, PNG or BMP image.
        resolution: [m] side of a cell.

    Raises:
        InputError: The picture cannot be read, or has no cells or more than `MAX_CELLS`; or the
            resolution is not a positive number.
    """
    if not 0.0 < resolution < math.inf:
        problem, advice = f"{resolution} is not positive", "give the side of a cell in metres"
        raise InputError(problem, field="resolution", advice=advice)
    return _to_map(Path(path), resolution, np.zeros(3), [], ("trinary", False, *THRESHOLDS))


def files_of(path: str | PathLike) -> tuple[Path, ...]:
    """The files of a map: the YAML file and its image, or a picture alone.

    Raises:
        InputError: The YAML file cannot be read, or names no image that it may name.
    """
    path = Path(path)
    return (path,) if is_picture(path) else (path, _image_path(path, _load(path).get("image"))[0])


def is_picture(path: str | PathLike) -> bool:
    """Whether a path has the name of a picture, not of a YAML file."""
    return Path(path).suffix.lower() in PICTURES


def _to_map(
    image: Path,
    resolution: float,
    origin: np.ndarray,
    notes: list[str],
    meaning: tuple[str, bool, float, float],
) -> OccupancyMap:
    """Map of an image; `meaning` is mode, negate, free_thresh and occupied_thresh."""
    mode, negate, free_below, occupied_above = meaning
    shade, known = _read_image(image)
    probability = _occupancy_probability(shade, mode, negate)
    known &= np.isfinite(probability)
    if mode == "trinary" and not negate and UNKNOWN_PROBABILITY < free_below:
        is_unknown = _written_as_unknown(shade)
        if is_unknown.any():
            known &= ~is_unknown
            notes.append(
                f"cells of the shade {UNKNOWN_SHADE}, which map_saver writes for unknown, stay "
                f"unknown, although the free_thresh of {free_below:g} would make them free"
            )
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
    advice = "name the YAML file of a map, as map_saver writes it"
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


def _read_image(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Shade (H, W) float32 from 0 (black) to 1 (white), and whether opaque (H, W) bool."""
    from PIL import Image, UnidentifiedImageError

    advice = "name a PGM, PNG or BMP image"
    try:
        with warnings.catch_warnings():
            # Pillow warns of its own limit; ours is checked below.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as image:
                width, height = image.size
                if not 0 < width * height <= MAX_CELLS:
                    problem = f"{width} x {height} cells are not between 1 and {MAX_CELLS}"
                    raise InputError(problem, path=path, advice="cut the map into parts")
                return _pixels(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check its name") from None
    except Image.DecompressionBombError:
        raise InputError(f"has more than {MAX_CELLS} cells", path=path) from None
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
