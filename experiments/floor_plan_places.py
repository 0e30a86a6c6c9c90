"""Place recognition in random floor plans with look-alike rooms, by what makes it hard.

A plan is a corridor with offices on both sides. Offices are of few kinds, so several are the same
but for where they are, and those across the corridor after half a turn. The map is of a drive along
the corridor and into each office. Queries are scans near the drive; one factor is varied at a time:
range noise, offset and heading of the viewpoint, beams that return nothing, people who stand about.
A scan of an office alone cannot be placed: it must not be accepted, so recall has a limit.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import ground_truth
from experiments.common import Numbers
from experiments.map_warnings import wilson_interval
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, relative
from jaxslam.core.types import Array, Key
from jaxslam.frontend.lidar import beam_angles
from jaxslam.matching.place_index import PlaceIndex, PlaceSpec, build_index
from jaxslam.matching.place_recognition import find_places, make_query
from jaxslam.simulation import path_following, ray_casting
from jaxslam.simulation.worlds import Box, World, outline

LIDAR = Lidar(num_beams=181, angle_increment=np.pi / 180, range_max=15.0, range_std=0.01)
SPEC = PlaceSpec()
MAX_WALLS = 512
CORRIDOR, DOOR, WALL = 2.0, 1.0, 0.15  # [m] width of the corridor and of doors, thickness of walls
KINDS = 3  # of offices in a plan
STEP = 0.5  # [m] between two keyframes
PERSON = 0.25  # [m] radius
RIGHT = (0.5, np.radians(10.0))  # [m], [rad] from the truth


class Conditions(NamedTuple):
    """Of queries: one field differs from these in each row of the results.

    Attributes:
        range_std: [m] noise of a range.
        offset: [m] of the viewpoint from the drive.
        heading: [rad] of the viewpoint to the drive, to either side.
        missing: Share of the beams that return nothing.
        people: Number of people within 3 m, in sight or not.
    """

    range_std: float = 0.01
    offset: float = 0.2
    heading: float = 0.3
    missing: float = 0.0
    people: int = 0


LEVELS = {
    "range_std": (0.01, 0.03, 0.06, 0.1),
    "offset": (0.0, 0.3, 0.6, 0.9),
    "heading": (0.0, np.pi / 4, np.pi / 2, np.pi),
    "missing": (0.0, 0.2, 0.4, 0.6),
    "people": (0, 2, 4, 8),
}
"""Values of each factor."""


class Plan(NamedTuple):
    """A floor plan, and the drive through it: walls (S, 4) [m], poses (K, 3), scans [K]."""

    walls: np.ndarray
    poses: np.ndarray
    scans: Scan


def offices(rng: np.random.Generator, num_rooms: int) -> tuple[np.ndarray, np.ndarray]:
    """Walls (S, 4) and waypoints (N, 2) [m] of a corridor with offices on both sides."""
    kinds = [
        {
            "width": rng.uniform(3.0, 4.5),
            "depth": rng.uniform(3.5, 5.0),
            "door": rng.uniform(0.3, 1.5),
            "desk": rng.uniform([0.3, 2.2], [1.0, 2.6]),
        }
        for _ in range(KINDS)
    ]
    free: list[Box] = []
    solid: list[Box] = []
    visits = []
    for side in (1, -1):
        x = 0.0
        for kind in rng.integers(KINDS, size=num_rooms):
            width, depth, door, desk = kinds[kind].values()
            if side < 0:  # turned by half a turn, not mirrored: it looks the same from inside
                door, desk_x = width - door - DOOR, width - desk[0] - 0.8
            else:
                desk_x = desk[0]
            room = (x, WALL, x + width, WALL + depth)
            opening = (x + door, 0.0, x + door + DOOR, WALL)
            table = (x + desk_x, WALL + desk[1], x + desk_x + 0.8, WALL + desk[1] + 0.6)
            free += [_at_side(box, side) for box in (room, opening)]
            solid.append(_at_side(table, side))
            middle = x + door + DOOR / 2
            visits.append((middle, side, WALL + 1.3))
            x += width + WALL
    ends = max(box[2] for box in free)
    corridor = (-1.5, -CORRIDOR / 2, ends + rng.uniform(0.5, 3.0), CORRIDOR / 2)
    path = [(-0.8, 0.0)]
    for middle, side, depth in sorted(visits):
        path += [(middle, 0.0), (middle, side * (CORRIDOR / 2 + depth)), (middle, 0.0)]
    path.append((corridor[2] - 0.8, 0.0))
    return outline([*free, corridor], solid), np.array(path)


def _at_side(box: Box, side: int) -> Box:
    """A box that is given from the wall of the corridor on, at its left or right side."""
    x0, y0, x1, y1 = box
    low, high = sorted((side * (CORRIDOR / 2 + y0), side * (CORRIDOR / 2 + y1)))
    return x0, low, x1, high


def make_plan(rng: np.random.Generator, num_rooms: int = 6) -> Plan:
    """A random plan with `num_rooms` offices on either side, and its drive."""
    walls, path = offices(rng, num_rooms)
    poses = path_following.poses_along(path, STEP, look_ahead=0.1)
    key = jax.random.key(int(rng.integers(2**31)))
    return Plan(walls, poses, scans_of(rng, key, walls, poses, Conditions()))


def scans_of(
    rng: np.random.Generator, key: Key, walls: np.ndarray, poses: np.ndarray, how: Conditions
) -> Scan:
    """Scans [N] from poses (N, 3) under conditions."""
    padded = np.pad(walls, ((0, MAX_WALLS - len(walls)), (0, 0)))
    lidar = LIDAR._replace(range_std=how.range_std)
    ranges = np.array(_ranges(jnp.asarray(padded, float), jnp.asarray(poses, float)), float)
    for row in ranges:
        for _ in range(how.people):
            row[:] = np.minimum(row, _person(*rng.uniform(-3.0, 3.0, 2)))
    hit = (ranges < lidar.range_max) & (rng.random(ranges.shape) >= how.missing)
    clean = Scan(jnp.asarray(np.where(hit, ranges, lidar.range_max), float), jnp.asarray(hit))
    keys = jax.random.split(key, len(poses))
    return jax.vmap(lambda k, scan: ray_casting.add_range_noise(k, lidar, scan))(keys, clean)


@jax.jit
def _ranges(walls: Array, poses: Array) -> Array:
    scan = jax.vmap(partial(ray_casting.cast, LIDAR, World(walls)))(poses)
    return jnp.where(scan.hit, scan.ranges, jnp.inf)


def _person(x: float, y: float) -> np.ndarray:
    """Ranges (R,) [m] to a person at (x, y) in the frame of the scanner; infinite elsewhere."""
    distance = max(np.hypot(x, y), 0.5 + PERSON)
    off = np.asarray(beam_angles(LIDAR)) - np.arctan2(y, x)
    across = distance * np.sin(off)
    meets = (np.abs(across) < PERSON) & (np.cos(off) > 0.0)
    half = np.sqrt(np.maximum(PERSON**2 - across**2, 0.0))
    return np.where(meets, distance * np.cos(off) - half, np.inf)


def viewpoints(rng: np.random.Generator, plan: Plan, number: int, how: Conditions) -> np.ndarray:
    """Poses (number, 3) beside the drive, from where the drive is in sight."""
    found: list[np.ndarray] = []
    while len(found) < number:
        at = plan.poses[rng.integers(len(plan.poses))]
        side = how.offset * np.array([np.cos(turn := rng.uniform(-np.pi, np.pi)), np.sin(turn)])
        pose = compose(at, np.array([*side, how.heading * rng.choice([-1, 1])]))
        clear = ground_truth.clearance(pose[None, :2], plan.walls)[0] > 0.3
        seen = ground_truth.in_sight(pose[None, :2], at[None, None, :2] + 1e-6, plan.walls)
        if clear and seen.all():
            found.append(pose)
    return np.array(found)


_queries = jax.jit(jax.vmap(partial(make_query, SPEC, LIDAR), in_axes=(0, None)))
_places = jax.jit(jax.vmap(partial(find_places, SPEC), in_axes=(None, 0)))


def run(seed: int, num_plans: int, num_queries: int) -> Numbers:
    """A row for each factor, value, plan and query; a summary for each factor and value."""
    rows = []
    total = num_plans * sum(map(len, LEVELS.values()))
    with tqdm(total=total, desc="floor plans", unit="set") as bar:
        for number in range(num_plans):
            rng = np.random.default_rng([seed, number])
            plan = make_plan(rng)
            index = build_index(SPEC, LIDAR, plan.poses, plan.scans)
            for factor, values in LEVELS.items():
                for value in values:
                    how = Conditions()._replace(**{factor: value})
                    for row in _answers(rng, plan, index, num_queries, how):
                        rows.append({"factor": factor, "value": value, "plan": number} | row)
                    bar.update()
    return {"rows": rows, "summary": summary(rows)}


def summary(rows: list[Numbers]) -> list[Numbers]:
    """For each factor and value: precision, recall, and the share of best places that are right."""
    found = []
    for factor, values in LEVELS.items():
        for value in values:
            some = [r for r in rows if (r["factor"], r["value"]) == (factor, value)]
            accepted = [r for r in some if r["accepted"]]
            right = sum(r["right"] for r in accepted)
            low, high = wilson_interval(right, len(accepted))
            found.append(
                {
                    "factor": factor,
                    "value": value,
                    "queries": len(some),
                    "accepted": len(accepted),
                    "precision": right / len(accepted) if accepted else None,
                    "precision_low": low,
                    "precision_high": high,
                    "recall": right / len(some),
                    "best_right": sum(r["right"] for r in some) / len(some),
                }
            )
    return found


def _answers(
    rng: np.random.Generator, plan: Plan, index: PlaceIndex, number: int, how: Conditions
) -> list[Numbers]:
    """A row for each of `number` queries in a plan under conditions."""
    poses = viewpoints(rng, plan, number, how)
    key = jax.random.key(int(rng.integers(2**31)))
    scans = scans_of(rng, key, plan.walls, poses, how)
    given = _queries(jax.tree.map(lambda x: x[:, None], scans), jnp.zeros((1, 3)))
    found = jax.tree.map(np.asarray, _places(index, given))
    off = relative(poses, found.poses[:, 0].astype(float))
    right = (np.hypot(off[:, 0], off[:, 1]) < RIGHT[0]) & (np.abs(off[:, 2]) < RIGHT[1])
    fields = zip(right, found.accepted, found.score[:, 0], found.margin, strict=True)
    return [
        {"right": bool(r), "accepted": bool(a), "score": float(s), "margin": float(m)}
        for r, a, s, m in fields
    ]
