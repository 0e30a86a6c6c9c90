"""Worlds and drives by name: those of `worlds`, random buildings, and drives that are found."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from jaxslam.core.maps import OccupancyMap
from jaxslam.simulation import patrols, worlds
from jaxslam.simulation.buildings import NAME_FORM, PREFIX, named_building
from jaxslam.simulation.path_following import densify
from jaxslam.simulation.patrols import FoundDrive
from jaxslam.simulation.worlds import World

DRIVES: dict[str, Callable[..., FoundDrive]] = {"patrol": patrols.patrol, "route": patrols.route}
"""What finds a drive in any world, by name."""


def named(name: str) -> World:
    """The world of a name: one of `worlds.NAMES`, or a random building.

    Raises:
        ValueError: There is no world of this name.
    """
    if name.startswith(PREFIX):
        return named_building(name).world
    if name not in worlds.NAMES:
        known = ", ".join(worlds.NAMES)
        raise ValueError(f"no world named {name!r:.40}; there are: {known}, {NAME_FORM}")
    return worlds.named(name)


def named_path(name: str) -> np.ndarray:
    """Points (N, 2) [m] of the drive of a world: its own one, or the patrol of a random building.

    Raises:
        ValueError: There is no world of this name, or it has no drive of its own.
    """
    if name.startswith(PREFIX):
        return _patrol_of(name)
    return densify(worlds.waypoints(name))


@lru_cache(maxsize=8)
def _patrol_of(name: str) -> np.ndarray:
    """The path (N, 2) [m] of a patrol through a random building; not to be changed."""
    path = patrols.patrol(named_building(name).world.walls).path
    path.setflags(write=False)
    return path


def found_drive(
    world: World,
    kind: str,
    occupancy: OccupancyMap | None = None,
    *,
    robot_radius: float = 0.0,
) -> FoundDrive:
    """A drive of one of the `DRIVES` in a world, and in the map that it was made of, if there is.

    Args:
        world: The walls.
        kind: Of the drive.
        occupancy: The map that the walls were made of, if there is one.
        robot_radius: [m] that it keeps from all walls; 0: not known, as `patrols` assume it.

    Raises:
        ValueError: There is no such kind, or no such drive.
    """
    find = worlds.lookup(DRIVES, kind, "kind of drive")
    size = {"robot_radius": robot_radius} if robot_radius else {}
    return find(np.asarray(world.walls, float), occupancy=occupancy, **size)
