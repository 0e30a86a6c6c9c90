"""Buildings to simulate, from files: maps, pictures of plans, and drawings of lines."""

from collections import Counter
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.core.maps import MAX_COORDINATE, MAX_RESOLUTION, MIN_RESOLUTION, OccupancyMap
from jaxslam.io import pictures, ros_map, world_dxf, world_grid, world_lines, world_svg
from jaxslam.io.drawing import Drawing
from jaxslam.io.errors import InputError
from jaxslam.simulation.worlds import World

MAPS = (".yaml", ".yml")
GEOJSON = (".geojson", ".json")
TABLES = (".csv", ".txt")
SUFFIXES = (*MAPS, *pictures.SUFFIXES, *GEOJSON, *TABLES, ".svg", ".dxf")
"""Endings of the files that are read."""

MIN_WALL = 1e-4  # [m] shorter ones have no length
MIN_SIZE, MAX_SIZE = 1.0, 1e4  # [m] width or height of a building
MAX_ASSUMED = 2000.0  # [m] the same, of a drawing whose unit the user has not given
FAR = 2000.0  # [m] coordinates beyond it are moved, as single precision has a millimetre at 8 km
MAX_WALLS = 10**6
KINDS = (
    "a ROS map (.yaml), a picture (.png, .pgm, ...) with --resolution, GeoJSON, a CSV of "
    "x1,y1,x2,y2, .svg or .dxf"
)


class WorldFile(NamedTuple):
    """A building that was read from a file.

    Attributes:
        world: Its walls.
        notes: What was assumed or left out, one line each.
        origin: (2,) [m] the origin of the world in the coordinates of the file, 0, 0 unless these
            are far from it: a point of the file less `origin` is one of the world.
        occupancy: The grid that the walls are the outline of, in the world's frame; None for a
            drawing.
    """

    world: World
    notes: tuple[str, ...]
    origin: np.ndarray
    occupancy: OccupancyMap | None = None


def is_world_file(name: str) -> bool:
    """Whether a text names a file and no built-in world: it has a suffix, a folder, or exists."""
    return bool(Path(name).suffix) or "/" in name or "\\" in name or Path(name).is_file()


def read_world(
    path: str | PathLike,
    *,
    resolution: float | None = None,
    unit: str | float | None = None,
    layers: Sequence[str] = (),
) -> WorldFile:
    """Read a building.

    Of a grid, map or picture, the walls are the outline of the occupied cells, with both faces; of
    drawings they are the lines, and the outlines of what has a width or is filled.

    Args:
        path: One of the `SUFFIXES`.
        resolution: [m] side of a pixel of a picture, which is not scaled down.
        unit: Of drawings: a name of `drawing.UNITS`, or the metres of a unit; by default that of
            the file, which must state one, but CSV and GeoJSON are in metres.
        layers: Of drawings: names of layers to read; empty for all that are visible.

    Raises:
        InputError: The file cannot be read; it needs an argument or has no use for one; or it holds
            no walls, too many, or a building smaller than `MIN_SIZE` or larger than `MAX_SIZE`, or
            than `MAX_ASSUMED` by a unit that is not given.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    _check_options(path, resolution, unit, layers)
    occupancy = None
    if suffix in MAPS or pictures.is_picture(path):
        if resolution is None:
            occupancy = ros_map.read(path)
        else:
            occupancy = ros_map.read_picture(path, resolution)
        walls, found = world_grid.walls(occupancy)
        drawing = Drawing(walls, {}, found)
        if not occupancy.occupied.any():
            raise InputError("has no occupied cell, so no wall", path=path)
    elif suffix in GEOJSON:
        drawing = world_lines.read_geojson(path, unit, layers)
    elif suffix in TABLES:
        drawing = world_lines.read_csv(path, unit)
    elif suffix == ".svg":
        drawing = world_svg.read(path, unit, layers)
    else:
        drawing = world_dxf.read(path, unit, layers)
    if not np.abs(drawing.walls).max(initial=0.0) <= MAX_COORDINATE:  # nor finite
        problem = f"has coordinates beyond {MAX_COORDINATE:g} m"
        raise InputError(problem, path=path, advice="give another --unit, or correct it")
    walls, left_out = _distinct(drawing.walls)
    left_out = Counter(drawing.left_out) + left_out
    notes = [*drawing.notes]
    if left_out:
        notes.append("left out: " + ", ".join(f"{what} ({n})" for what, n in left_out.items()))
    _check_size(path, walls, notes, MAX_ASSUMED if unit is occupancy is None else MAX_SIZE)
    origin = np.zeros(2)
    if np.abs(walls).max() > FAR:
        origin = np.floor(walls.reshape(-1, 2).min(axis=0))
        walls = walls - [*origin, *origin]
        x, y = origin
        notes.append(f"the origin of the world is x {x:.0f}, y {y:.0f} m of the file")
        if occupancy is not None:
            moved = occupancy.origin - [*origin, 0.0]
            occupancy = occupancy._replace(origin=moved)
    return WorldFile(World(walls), tuple(notes), origin, occupancy)


def _check_options(
    path: Path, resolution: float | None, unit: str | float | None, layers: Sequence[str]
) -> None:
    """Raise InputError for a file of another kind, or options that do not go with it."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        advice = "save it as DXF in your CAD program" if suffix == ".dwg" else f"name {KINDS}"
        what = f"ends in {suffix}, which is not read" if suffix else "has no ending"
        raise InputError(what, path=path, advice=advice)
    picture = pictures.is_picture(path)
    if picture and resolution is None:
        advice = "add --resolution METRES, the side of a pixel, or name the YAML file of the map"
        raise InputError("is a picture, which has no scale", path=path, advice=advice)
    if resolution is not None and not picture:
        advice = f"leave it out: {path} is none"
        raise InputError("is for a picture alone", field="--resolution", advice=advice)
    if resolution is not None and not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        problem = f"{resolution} is not between {MIN_RESOLUTION} and {MAX_RESOLUTION}"
        raise InputError(problem, field="--resolution", advice="give the metres of a pixel")
    is_grid = picture or suffix in MAPS
    if unit is not None and is_grid:
        advice = f"leave it out: {path} has a resolution in metres"
        raise InputError("is for drawings alone", field="--unit", advice=advice)
    if layers and (is_grid or suffix in TABLES):
        advice = f"leave it out: {path} has no layers"
        raise InputError("is for SVG, DXF and GeoJSON", field="--layers", advice=advice)


def _distinct(walls: np.ndarray) -> tuple[np.ndarray, Counter[str]]:
    """Walls (S, 4) [m] without those of no length and those there twice, and how many these are."""
    length = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    kept = walls[length >= MIN_WALL]
    left_out = Counter({"lines of no length": len(walls) - len(kept)})
    ends = np.round(kept / MIN_WALL).astype(np.int64).reshape(-1, 2, 2)
    swap = (ends[:, 0] > ends[:, 1]).any(axis=1) & ~(ends[:, 0] < ends[:, 1])[:, 0]
    ends[swap] = ends[swap, ::-1]
    _, first = np.unique(ends.reshape(-1, 4), axis=0, return_index=True)
    left_out["duplicates"] = len(kept) - len(first)
    return kept[np.sort(first)], +left_out


def _check_size(path: Path, walls: np.ndarray, notes: Sequence[str], most: float) -> None:
    """Raise InputError if there are no walls, too many, or they are smaller or larger than `most`.

    The largest size is in metres; so are the walls.
    """
    if not len(walls):
        reason = notes[-1] if notes and notes[-1].startswith("left out") else None
        raise InputError("holds no wall", path=path, advice=reason)
    if len(walls) > MAX_WALLS:
        problem = f"holds {len(walls)} walls, more than {MAX_WALLS}"
        raise InputError(problem, path=path, advice="cut it into parts, or pick --layers")
    size = np.ptp(walls.reshape(-1, 2), axis=0)
    if not MIN_SIZE <= size.max() <= most:
        problem = f"is {size[0]:.3g} m x {size[1]:.3g} m, not the size of a building"
        advice = "give the side of a pixel by --resolution, or the unit of a drawing by --unit, in "
        advice += "metres: --unit 0.1 for a drawing of 1:100 in mm"
        raise InputError(problem, path=path, advice=advice)
