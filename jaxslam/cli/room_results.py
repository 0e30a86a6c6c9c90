"""Rooms and doors of a map as results of a command."""

from pathlib import Path

from jaxslam.core.maps import OccupancyMap
from jaxslam.core.regions import Regions
from jaxslam.io import rooms_file
from jaxslam.io.errors import InputError
from jaxslam.mapping.rooms import find_regions

ROBOT_RADIUS = 0.25  # [m]


def earlier_rooms(out: Path) -> tuple[Regions | None, tuple[str, ...]]:
    """The rooms of an earlier call of a command with the same output folder.

    Args:
        out: The output folder.

    Returns:
        The rooms, None if there are none that can be read, and notes for the user.
    """
    path = out / rooms_file.JSON_NAME
    if not path.is_file():
        return None, ()
    try:
        return rooms_file.read_rooms(path), ()
    except InputError as error:
        return None, (f"rooms and doors get new names: {error}",)


def write_rooms_of(
    out_dir: Path,
    occupancy: OccupancyMap,
    previous: Regions | None = None,
    *,
    robot_radius: float = ROBOT_RADIUS,
) -> Regions:
    """Find the rooms and doors of a map and write rooms.json and rooms.png.

    Args:
        out_dir: Folder to write to.
        occupancy: The map.
        previous: Rooms found earlier, whose names are kept.
        robot_radius: [m]

    Raises:
        InputError: A file cannot be written.
    """
    regions = find_regions(
        occupancy.occupied,
        occupancy.free,
        resolution=occupancy.resolution,
        origin=occupancy.origin,
        robot_radius=robot_radius,
        previous=previous,
    )
    rooms_file.write_rooms(out_dir, regions)
    return regions
