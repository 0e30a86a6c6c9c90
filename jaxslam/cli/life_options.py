"""What goes wrong in a building, from settings of `jaxslam simulate --life` or of a study."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.cli.world_options import Building
from jaxslam.core import polylines
from jaxslam.core.batching import on_device
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose
from jaxslam.io import life_file
from jaxslam.io.errors import InputError
from jaxslam.simulation import buildings, moving_parts, ray_casting, worlds
from jaxslam.simulation.life import Life, life_in
from jaxslam.simulation.ray_casting import Leaving
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

MATCHED = "wheels may slip, or odometry fail"
"""Why scans are matched by default."""

NOTHING_SEEN = 0.999  # of the beams along a drive that meet no wall: a robot cannot map there
MAX_POSES = 100  # along a drive, from which beams are followed


class LivingWorld(NamedTuple):
    """A building in which things go wrong.

    Attributes:
        world: Walls of what stays where it is.
        life: What goes wrong.
        note: The same in a line.
    """

    world: World
    life: Life
    note: str


def life_of(
    building: Building,
    settings: Mapping[str, float],
    *,
    slots: int | None = None,
    seed: int = 0,
) -> LivingWorld:
    """Life in a building.

    Args:
        building: What is driven through, and where.
        settings: By the keys of `life_file.SETTINGS`.
        slots: For people; by default as many as there are.
        seed: Of which furniture is moved, and where to.

    Raises:
        InputError: There are no doors to close, or no furniture to move.
        ValueError: A number is not possible.
    """
    parts = life_file.parts(settings)
    moves = parts.pop("furniture")
    note = life_file.describe(settings)
    if parts.pop("crowding").people_per_metre and "people" not in settings:
        people = life_file.number_of_people(settings, building.path)
        parts["traffic"] = parts["traffic"]._replace(people=people)
        note += f": people {people}"
    world, doors, furniture = building.world, None, None
    if parts["traffic"].closed:
        doors = _doors(building)
        if not len(doors):
            raise InputError(f"closed needs doors, and none are found in {building.name}")
        note += f"; {len(doors)} doors"
    if moves.moved:
        found = moving_parts.move_furniture(world.walls, building.path, moves, seed)
        if not found.pieces:
            raise InputError(f"moved needs loose furniture; none can be moved in {building.name}")
        world, furniture = World(jnp.asarray(found.fixed, float)), (found.before, found.after)
        note += f"; {found.pieces} pieces of furniture are moved"
    life = life_in(
        world, building.path, max_people=slots, doors=doors, furniture=furniture, **parts
    )
    return LivingWorld(world, life, note)


def check_moved_at(life: Life | None, robot: Robot, num_scans: int) -> None:
    """Raise InputError if furniture is moved only after a drive of T scans has ended."""
    if life is None or not len(life.movers.before):
        return
    moved_at, end = float(life.traffic.moved_at), (num_scans - 1) * robot.scan_period
    if moved_at > end:
        raise InputError(
            f"moved_at is {moved_at:g} s, and the drive ends after {end:.0f} s",
            advice="give an earlier time",
        )


def _doors(building: Building) -> np.ndarray:
    """Closed doors (D, 4) [m] of a building: known ones, or those between its rooms."""
    if building.name in worlds.NAMES or building.name.startswith(buildings.PREFIX):
        return moving_parts.doors_by_name(building.name)
    return moving_parts.find_doors(building.world.walls, building.occupancy)


def leaving(lidar: Lidar, world: World, robot: Robot, path: Any) -> Leaving:
    """Shares of the beams along a drive (N, 2) [m] that meet no wall.

    Raises:
        InputError: Almost all of them meet none: there is nothing to be mapped.
    """
    points = np.asarray(path, float)
    count = int(np.clip(float(polylines.length(points)) / robot.max_speed, 2, MAX_POSES))
    even = polylines.resample(points, count)
    along = np.gradient(even, axis=0)
    poses = np.column_stack([even, np.arctan2(along[:, 1], along[:, 0])])
    for mount in (robot.nominal_mount, robot.mount):
        poses = compose(poses, np.array(mount, float))
    given = on_device(poses)
    found = ray_casting.share_leaving(lidar, world._replace(wall_index=None), given)
    if found.beyond_range > NOTHING_SEEN:
        width, height = np.ptp(np.reshape(world.walls, (-1, 2)), axis=0)
        raise InputError(
            f"no beam along the drive meets a wall within {lidar.range_max:g} m, the walls span "
            f"{width:.4g} m x {height:.4g} m",
            advice="check the unit of the walls, and the scanner's range_max",
        )
    return found


def leaving_note(found: Leaving, range_max: float) -> str:
    """The same in a line."""
    return (
        f"{found.no_wall:.1%} of the beams along the drive leave the building, "
        f"{found.beyond_range:.1%} meet nothing within {range_max:g} m"
    )
