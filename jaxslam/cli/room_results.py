"""Rooms and doors of a map as results of a command."""

from pathlib import Path

from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.regions import PlannerData, Regions
from jaxslam.io import rooms_file
from jaxslam.io.errors import InputError
from jaxslam.mapping.rooms import find_regions

ROBOT_RADIUS = 0.25  # [m]
MAX_NAMES = 8  # of rooms in a note


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


def without_arcs(regions: Regions, graph: TopologicalMap, planner: PlannerData) -> str:
    """A note that names the regions that no arc of a map leads into, empty if there are none.

    Args:
        regions: Rooms and doors of the map.
        graph: The map.
        planner: Where its nodes and arcs lie.
    """
    served = {*planner.arc_region.tolist(), *planner.node_region[graph.arc_ends].ravel().tolist()}
    for doors in planner.arc_doors:
        served.update(index for door in doors for index in regions.doors[door].regions)
    names = [region.name for k, region in enumerate(regions.regions) if k not in served]
    if len(names) > MAX_NAMES:
        names = [*names[:MAX_NAMES], f"{len(names) - MAX_NAMES} more"]
    return f"rooms without an arc: {', '.join(names)}" if names else ""


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
