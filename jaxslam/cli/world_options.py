"""The building and the drive of `jaxslam simulate`, from its options."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.cli.options import name_errors
from jaxslam.core import polylines
from jaxslam.core.batching import on_device
from jaxslam.core.maps import OccupancyMap
from jaxslam.core.se2_np import inverse_transform
from jaxslam.core.types import Array
from jaxslam.io import path_file, world_files
from jaxslam.io.drawing import size_of_unit
from jaxslam.io.errors import InputError
from jaxslam.io.world_files import WorldFile
from jaxslam.simulation import named_worlds, path_checks, path_following, worlds
from jaxslam.simulation.buildings import NAME_FORM, PREFIX
from jaxslam.simulation.wall_directions import direction_std
from jaxslam.simulation.worlds import World

NEAR = 0.2  # [m] of a wall, where many robots do not fit
NOT_PARALLEL = math.radians(0.05)  # standard deviation from which on it is said
PART = 0.25  # of a building: a drive that sees no more may be inside of a column or a cabinet
BEND = 0.01  # [m] by which waypoints are off the path that is driven


class Building(NamedTuple):
    """What is driven through, and where.

    Attributes:
        world: Walls, in JAX's precision.
        path: (N, 2) [m, world frame] points of the drive.
        notes: What was assumed, left out or found.
        name: Of the world, or its file.
        occupancy: The map that the walls are the outline of; None if there is none.
    """

    world: World
    path: Array
    notes: tuple[str, ...]
    name: str = ""
    occupancy: OccupancyMap | None = None


def read_building(
    world: str,
    path: Path | None = None,
    *,
    drive: str | None = None,
    resolution: float | None = None,
    unit: str | None = None,
    layers: tuple[str, ...] = (),
    robot_radius: float = 0.0,
) -> Building:
    """The building of `--world` and the drive of `--path`.

    Args:
        world: Name of a built-in world, or a file that `world_files.read_world` reads.
        path: File of waypoints that `path_file.read` reads, in the coordinates of the world's file;
            None for the drive of a built-in world.
        drive: A drive that is found, of `named_worlds.DRIVES`; None for that of the world.
        resolution: [m] of a pixel, of a picture.
        unit: Of a drawing.
        layers: Of a drawing that are read; empty for all.
        robot_radius: [m] of the circle around the robot; 0: not known.

    Raises:
        InputError: There is no such world, a file or option is bad, there is no drive, or it leads
            through walls or out of the building, or so near to walls that the robot does not fit.
    """
    if path is not None and drive is not None:
        raise InputError("is not for a drive that --path gives", field="--drive")
    is_random = world.startswith(PREFIX)
    if is_random or world in worlds.NAMES or not world_files.is_world_file(world):
        if resolution is not None or unit is not None or layers:
            names = ("--resolution", "--unit", "--layers")
            given = (resolution is not None, unit is not None, bool(layers))
            field = next(name for name, is_given in zip(names, given, strict=True) if is_given)
            raise InputError(f"is for files; {world!r:.40} is none", field=field)
        with name_errors("--world"):
            if not is_random and world not in worlds.NAMES:
                known = ", ".join([*worlds.NAMES, NAME_FORM])
                raise ValueError(f"no world named {world!r:.40}; there are {known}, and files")
            building = WorldFile(named_worlds.named(world), (), np.zeros(2))
            if is_random and path is None:
                drive = drive or "patrol"
            points = worlds.waypoints(world) if path is None and drive is None else None
    else:
        building = world_files.read_world(world, resolution=resolution, unit=unit, layers=layers)
        points = None
    notes = [*building.notes]
    spread = direction_std(building.world.walls)
    if spread > NOT_PARALLEL:
        notes.append(
            f"long walls are parallel to {math.degrees(spread):.1f} deg (standard deviation), "
            "which R of a wall's direction has, too"
        )
    if path is not None:
        points = path_file.read(path) - building.origin
        stated = unit is None and Path(world).suffix.lower() in (".svg", ".dxf")
        if stated or (unit is not None and size_of_unit(unit) != 1.0):
            notes.append(f"waypoints of {path} are in metres, whatever the unit of {world}")
        points = polylines.simplify(points, BEND)
        notes += _check(path, points, building, robot_radius)
    elif drive is not None:
        with name_errors("--drive"):
            found = named_worlds.found_drive(
                building.world, drive, building.occupancy, robot_radius=robot_radius
            )
        walls = World(on_device(building.world.walls))
        notes += [f"{drive} of {found.length:.0f} m, {len(found.stops)} stops", *found.notes]
        driven = on_device(found.path)
        return Building(walls, driven, tuple(notes), world, building.occupancy)
    elif points is None:
        advice = "add --drive patrol, or --path FILE, CSV of x,y [m] or GeoJSON of one LineString"
        raise InputError("is a file, which has no drive of its own", path=world, advice=advice)
    elif robot_radius:
        with name_errors(f"the drive of {world}"):
            _check_room(points, building.world, robot_radius)
    walls = World(on_device(building.world.walls))
    driven = on_device(path_following.densify(points))
    return Building(walls, driven, tuple(notes), world, building.occupancy)


def _check(file: Path, points: np.ndarray, building: WorldFile, robot_radius: float) -> list[str]:
    """Notes on a drive along waypoints (K, 2) [m, world frame]; InputError if there can be none."""
    x, y = building.origin
    about = f"{file}" if not building.origin.any() else f"{file} (less x {x:.0f}, y {y:.0f} m)"
    if building.occupancy is not None:
        kind = _kind_of_cell(building.occupancy, points[0])
        if kind != "free":
            x, y = points[0]
            problem = f"starts at x {x:.2f}, y {y:.2f} m, where the map is {kind}"
            raise InputError(problem, path=about, advice="start in free space")
    with name_errors(about):
        found = _check_room(points, building.world, robot_radius)
    notes = []
    whole = np.ptp(np.reshape(building.world.walls, (-1, 2)), axis=0)
    if found.seen.prod() < PART * whole.prod():
        (width, height), (x, y) = found.seen, whole
        notes.append(
            f"around the path walls enclose {width:.1f} m x {height:.1f} m of {x:.1f} m x {y:.1f} m"
        )
    if found.clearance < NEAR:
        notes.append(f"the path comes within {found.clearance:.2f} m of a wall")
    if building.occupancy is not None:
        even = path_following.densify(points)
        unknown = [_kind_of_cell(building.occupancy, at) != "free" for at in even]
        metres = np.mean(unknown) * polylines.length(points)
        if metres >= 0.05:
            notes.append(f"{metres:.1f} m of the path are where the map is unknown")
    return notes


def _check_room(points: np.ndarray, world: World, robot_radius: float) -> path_checks.PathCheck:
    """What was found along waypoints (K, 2) [m]; ValueError if a robot does not fit there."""
    found = path_checks.check_path_in_world(points, world)
    if found.clearance < robot_radius:
        raise ValueError(
            f"path comes within {found.clearance:.2f} m of a wall, from waypoint {found.leg + 1} "
            f"to {found.leg + 2}, and the robot's [body] reaches {robot_radius:.2f} m from its "
            "middle"
        )
    return found


def _kind_of_cell(occupancy: OccupancyMap, point: np.ndarray) -> str:
    """What a map has at a point (2,): free, occupied, unknown, or nothing outside of it."""
    cell = np.floor(inverse_transform(occupancy.origin, point) / occupancy.resolution).astype(int)
    if (cell < 0).any() or (cell >= occupancy.free.shape).any():
        return "left"
    if occupancy.occupied[tuple(cell)]:
        return "occupied"
    return "free" if occupancy.free[tuple(cell)] else "unknown"
