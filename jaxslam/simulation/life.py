"""Drives as in life: people, doors, glass, slipping wheels, scans that are lost.

What may go wrong is a record of numbers, `Life`, and of what may move, `Movers`. What happens on
one drive is drawn once, at its start (`Events`); so a scan depends on its time and place alone.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array, csgraph

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import AnyArray, Array, Key, as_float64
from jaxslam.simulation import ray_casting
from jaxslam.simulation.discs import Discs
from jaxslam.simulation.nearest_walls import nearest_walls
from jaxslam.simulation.range_errors import RangeErrors, Returns, measure
from jaxslam.simulation.ray_casting import Hits
from jaxslam.simulation.scan_motion import Seen, look_in_motion
from jaxslam.simulation.scanners import Scanner
from jaxslam.simulation.traffic import (
    Crowd,
    Movers,
    Traffic,
    make_crowd,
    moved_walls,
    people_at,
    walkway,
)
from jaxslam.simulation.wheel_faults import FaultDraws, WheelFaults, draw_faults
from jaxslam.simulation.worlds import World

MAX_WALL = 0.4  # [m] thickness of a wall whose two faces are of the same material
PARALLEL = 0.05  # sine of the angle between them, at most
RANGES, TRAFFIC, WHEELS = RangeErrors(), Traffic(), WheelFaults()  # nothing goes wrong


class Life(NamedTuple):
    """What goes wrong in life; nothing by default, but that ranges have their noise.

    Attributes:
        movers: What may move; see `movers_of`.
        materials: (S,) int32 number of the piece that each wall is of: its material is drawn once.
        ranges: Errors of ranges.
        traffic: People, doors and furniture.
        wheels: Faults of wheels, odometry and scans.
    """

    movers: Movers
    materials: AnyArray
    ranges: RangeErrors = RANGES
    traffic: Traffic = TRAFFIC
    wheels: WheelFaults = WHEELS


class Events(NamedTuple):
    """What happens on one drive.

    Attributes:
        crowd: People and doors.
        faults: Of the wheels.
        glass: (S,) bool, which walls are of glass.
        black: (S,) bool, which are black.
    """

    crowd: Crowd
    faults: FaultDraws
    glass: Array
    black: Array


def life_in(
    world: World,
    path: Any,
    *,
    ranges: RangeErrors = RANGES,
    traffic: Traffic = TRAFFIC,
    wheels: WheelFaults = WHEELS,
    max_people: int | None = None,
    doors: Any = None,
    furniture: tuple[Any, Any] | None = None,
) -> Life:
    """Life in a world, in JAX's precision; what may move has its places.

    Args:
        world: The walls.
        path: (N, 2) [m] along which people walk to and fro, such as that of the robot.
        ranges: Errors of ranges.
        traffic: People, doors and furniture.
        wheels: Faults of wheels, odometry and scans.
        max_people: Slots for people; by default as many as there are. Variants with the same number
            of slots run the same program.
        doors: (D, 4) [m] ends of closed doors; None for none.
        furniture: Walls (P, 4) [m] of what is moved, before and after; none of them in the world.

    Raises:
        ValueError: An argument is not possible.
    """
    none = np.zeros((0, 4))
    closed = none if doors is None else as_float64("doors", doors, ("D", 4))
    before, after = (none, none) if furniture is None else furniture
    before = as_float64("furniture[0]", before, ("P", 4))
    after = as_float64("furniture[1]", after, (len(before), 4))
    slots = int(np.ceil(float(traffic.people))) if max_people is None else max_people
    if slots < float(traffic.people):
        raise ValueError(f"max_people is {slots}, and traffic.people {traffic.people}")
    for name, part in (("ranges", ranges), ("traffic", traffic), ("wheels", wheels)):
        check_numbers_of(name, part)
    movers = Movers(np.arange(slots, dtype=np.int32), walkway(path), closed, before, after)
    found = Life(movers, material_groups(world.walls), ranges, traffic, wheels)

    def in_precision(x: Any) -> Array:
        array = np.asarray(x)
        return jnp.asarray(array, None if array.dtype == np.int32 else float)

    return jax.tree.map(in_precision, found)


PROBABILITIES = {
    "ranges": ("missing", "black", "glass"),
    "traffic": ("standing", "carts", "closed"),
    "wheels": ("slip", "carpet", "lost", "latched", "dropped", "carried"),
}
POSITIVE = {"traffic": ("door_period",), "ranges": ("shared_angle",)}
AT_LEAST_ONE = {"wheels": ("lost_scans",)}
ANY_SIGN = {"ranges": ("std_by_incidence",)}


def check_numbers_of(name: str, part: Any) -> None:
    """Raise ValueError unless the numbers of a part of `Life` are possible."""
    for field, given in part._asdict().items():
        value = float(as_float64(f"{name}.{field}", given, ()))
        wanted = "0 or more"
        good = value >= 0.0
        if field in PROBABILITIES.get(name, ()):
            wanted, good = "between 0 and 1", 0.0 <= value <= 1.0
        elif field in POSITIVE.get(name, ()):
            wanted, good = "above 0", value > 0.0
        elif field in AT_LEAST_ONE.get(name, ()):
            wanted, good = "1 or more", value >= 1.0
        elif field in ANY_SIGN.get(name, ()):
            wanted, good = "finite", np.isfinite(value)
        if not good or (np.isinf(value) and field != "moved_at"):
            raise ValueError(f"{name}.{field} is {given}, not {wanted}")


def material_groups(walls: AnyArray) -> np.ndarray:
    """Number (S,) int32 of the piece that each wall (S, 4) is of.

    The two faces of a wall, parallel and at most `MAX_WALL` apart over half of the shorter one, are
    of the same piece; so are those of all walls that follow from one another like this.
    """
    return _material_groups(np.asarray(walls, np.float64).tobytes())


@lru_cache(maxsize=8)
def _material_groups(walls: bytes) -> np.ndarray:
    """`material_groups` of walls whose numbers are given as bytes; not to be changed."""
    segments = np.frombuffer(walls).reshape(-1, 4)
    along = segments[:, 2:] - segments[:, :2]
    length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)
    unit = along / length[:, None]
    pairs = []
    for k, start in enumerate(segments[:, :2]):
        gap = segments.reshape(-1, 2, 2)[k + 1 :] - start
        ahead = np.sort(gap @ unit[k], axis=1)
        across = unit[k, 0] * gap[..., 1] - unit[k, 1] * gap[..., 0]
        sine = unit[k, 0] * unit[k + 1 :, 1] - unit[k, 1] * unit[k + 1 :, 0]
        shared = np.minimum(ahead[:, 1], length[k]) - np.maximum(ahead[:, 0], 0.0)
        near = (np.abs(across) <= MAX_WALL).all(axis=1) & (np.abs(sine) <= PARALLEL)
        near &= shared >= np.minimum(length[k], length[k + 1 :]) / 2
        pairs += [(k, k + 1 + other) for other in np.flatnonzero(near).tolist()]
    first, second = np.array(pairs or np.zeros((0, 2), int)).T
    shape = len(segments), len(segments)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=shape)
    groups = csgraph.connected_components(graph, directed=False)[1].astype(np.int32)
    groups.setflags(write=False)
    return groups


def draw_events(key: Key, life: Life, num_scans: int) -> Events:
    """Draw what happens on a drive of T scans."""
    of_crowd, of_faults, of_materials = jax.random.split(key, 3)
    points = jnp.asarray(life.movers.walkway)

    def material(number: Array) -> Array:
        own = jax.random.fold_in(of_materials, number)
        return jax.random.uniform(own, (2,), points.dtype)

    glass, black = jax.vmap(material, out_axes=1)(jnp.asarray(life.materials))
    return Events(
        make_crowd(of_crowd, life.traffic, life.movers),
        draw_faults(of_faults, life.wheels, num_scans, points.dtype),
        glass < life.ranges.glass,
        black < life.ranges.black,
    )


def scan_life(
    key: Key,
    lidar: Lidar,
    scanner: Scanner | None,
    world: World,
    life: Life,
    events: Events,
    pose: Array,
    time: Array,
    *,
    draws: Array | None = None,
    velocity: Array | None = None,
) -> Scan:
    """Scan of a world with all that is in it at a time.

    Args:
        key: Of the errors of the ranges.
        lidar: The scanner as the front end knows it.
        scanner: The scanner with its errors; None: of the noise of `lidar`.
        world: The walls.
        life: What may go wrong.
        events: What happens on this drive.
        pose: (3,) [m, m, rad] of the scanner in the world.
        time: () [s] since the first scan.
        draws: (R,) standard normals of the ranges, instead of those of the key.
        velocity: (3,) [m/s, m/s, rad/s] of the scanner in its own frame; None: it stands still.
    """
    traffic, movers, crowd = life.traffic, life.movers, events.crowd
    discs = Discs(*people_at(crowd, traffic, movers, time, pose[:2]))
    moved = World(moved_walls(crowd, traffic, movers, time, pose[:2]))
    walls = jnp.asarray(world.walls)

    def look(world: World, pose: Array) -> Seen:
        """Distance, incidence and surface (R,) of what the beams meet."""
        hits = ray_casting.find_hits(lidar, world, pose, discs)
        angle = ray_casting.incidence(lidar, world, pose, discs=discs, hits=hits)
        surface = jnp.where(hits.disc >= 0, len(walls) + hits.disc, hits.wall)
        if not len(moved.walls):
            return hits.distance, angle, surface
        distance, wall = nearest_walls(lidar, pose, moved.walls, None)
        found = Hits(distance, wall, jnp.full_like(wall, -1))
        nearer = distance < jnp.minimum(hits.distance, lidar.range_max)
        own = ray_casting.incidence(lidar, moved, pose, hits=found)
        return (
            jnp.where(nearer, distance, hits.distance),
            jnp.where(nearer, own, angle),
            jnp.where(nearer, len(walls) + len(discs.radius) + wall, surface),
        )

    def see_through(pose: Array, seen: Seen) -> Seen:
        start = jnp.concatenate([walls[:, :2], walls[:, :2]], axis=1)
        behind = look(world._replace(walls=jnp.where(events.glass[:, None], start, walls)), pose)
        is_wall = (seen[2] >= 0) & (seen[2] < len(walls))
        is_glass = is_wall & events.glass[jnp.clip(seen[2], 0, len(walls) - 1)]
        passes = is_glass & (seen[1] > life.ranges.glass_angle)
        return jax.tree.map(partial(jnp.where, passes), behind, seen)

    def see(pose: Array) -> Seen:
        seen = look(world, pose)
        through = partial(see_through, pose)
        return jax.lax.cond(jnp.any(events.glass), through, lambda seen: seen, seen)

    if velocity is None or scanner is None or scanner.turn_time is None:
        distance, angle, surface = see(pose)
    else:
        distance, angle, surface = look_in_motion(see, scanner, pose, velocity)
    is_wall = (surface >= 0) & (surface < len(walls))
    is_black = is_wall & events.black[jnp.clip(surface, 0, len(walls) - 1)]
    returns = Returns(distance, angle, surface, is_black)
    return measure(key, lidar, life.ranges, returns, scanner=scanner, draws=draws)
