"""Simulated environments: those of the paper's figures, an office, and random floor plans."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import AnyArray
from jaxslam.simulation.wall_index import WallIndex, index_walls

UNINDEXED = 192  # walls; as many are tried in the time that an index takes

T = TypeVar("T")
Box = tuple[float, float, float, float]
"""Axis-aligned rectangle x0, y0, x1, y1 [m], with x0 < x1 and y0 < y1."""

Point = tuple[float, float]
"""A point x, y [m]."""


class World(NamedTuple):
    """An environment of straight walls without thickness.

    Attributes:
        walls: (S, 4) [m] ends x1, y1, x2, y2, world frame.
        wall_index: Of the walls, for fast ray casting among many; None to try all of them.
    """

    walls: AnyArray
    wall_index: WallIndex | None = None


def with_index(world: World, range_max: float) -> World:
    """A world with an index of its walls, if they are more than `UNINDEXED`.

    Args:
        world: The walls; not traced. None of them may be moved later.
        range_max: [m] range of the scanner.

    Raises:
        ValueError: Walls or range are not possible.
    """
    if len(world.walls) <= UNINDEXED:
        return World(world.walls)
    dtype = jnp.asarray(world.walls).dtype
    walls = np.asarray(world.walls, float)
    return World(world.walls, _indexed(walls.tobytes(), float(range_max), np.dtype(dtype)))


@lru_cache(maxsize=4)
def _indexed(walls: bytes, range_max: float, dtype: np.dtype) -> WallIndex:
    """Index of walls, given as the bytes of their numbers, whose floats have a type."""
    index = index_walls(np.frombuffer(walls).reshape(-1, 4), range_max)
    return jax.tree.map(lambda x: jnp.asarray(x, None if x.dtype == np.int32 else dtype), index)


def covers(boxes: Sequence[Box], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Which points of a grid are in a box: (len(x), len(y)) bool, of ascending x and y."""
    inside = np.zeros((len(x), len(y)), bool)
    for x0, y0, x1, y1 in boxes:
        columns = slice(np.searchsorted(x, x0, "right"), np.searchsorted(x, x1, "left"))
        rows = slice(np.searchsorted(y, y0, "right"), np.searchsorted(y, y1, "left"))
        inside[columns, rows] = True
    return inside


def strokes(edge: np.ndarray, ends: np.ndarray) -> list[Point]:
    """First and last coordinate of each interval of True in `edge` (n,), given `ends` (n + 1,)."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], edge, [False]]).astype(int)))
    return [(ends[first], ends[last]) for first, last in change.reshape(-1, 2)]


def outline(free: Sequence[Box], solid: Sequence[Box] = ()) -> np.ndarray:
    """Walls (S, 4) [m] around the union of the boxes `free`, less the boxes `solid`.

    The sides of the boxes cut the plane into cells that are free or not. Walls separate the two,
    and every boundary is closed.
    """
    boxes = np.array([*free, *solid])
    x, y = np.unique(boxes[:, [0, 2]]), np.unique(boxes[:, [1, 3]])
    middle_x, middle_y = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
    inside = covers(free, middle_x, middle_y) & ~covers(solid, middle_x, middle_y)
    change_x = np.diff(np.pad(inside, 1).astype(np.int8), axis=0)[:, 1:-1]  # across the lines x
    change_y = np.diff(np.pad(inside, 1).astype(np.int8), axis=1)[1:-1]  # across the lines y
    walls = []
    for sign in (1, -1):
        for at, change in zip(x, change_x, strict=True):
            walls += [(at, low, at, high) for low, high in strokes(change == sign, y)]
        for at, change in zip(y, change_y.T, strict=True):
            walls += [(low, at, high, at) for low, high in strokes(change == sign, x)]
    return np.array(walls)


def polyline(points: Sequence[Point] | np.ndarray) -> np.ndarray:
    """Walls (N - 1, 4) [m] that join N points in order."""
    joints = np.array(points)
    return np.hstack([joints[:-1], joints[1:]])


def object_ahead() -> np.ndarray:
    """Fig. 4: a box in a room, of which a sensor at the origin sees two perpendicular faces."""
    return outline([(-0.5, -2.0, 3.0, 2.0)], [(1.4, 0.3, 2.0, 0.9)])


def corridor(left: Sequence[Point] = (), right: Sequence[Point] = ()) -> np.ndarray:
    """Fig. 6: walls 2.4 m apart from x = -0.5 to 6 m, with given points between their ends."""
    return np.vstack(
        [
            polyline([(-0.5, 1.2), *left, (6.0, 1.2)]),
            polyline([(-0.5, -1.2), *right, (6.0, -1.2)]),
        ]
    )


def opening() -> np.ndarray:
    """Fig. 6 (b): 1.6 m of the right wall open into an alcove."""
    return corridor(right=[(2.2, -1.2), (2.2, -2.0), (3.8, -2.0), (3.8, -1.2)])


def column() -> np.ndarray:
    """Fig. 6 (c): a square column on the left wall."""
    return corridor(left=[(2.5, 1.2), (2.5, 0.7), (3.0, 0.7), (3.0, 1.2)])


def stairs(x: list[float], levels: list[float]) -> list[Point]:
    """Points of a wall with steps at x (N,) [m], between levels y (N + 1,) [m]."""
    steps = zip(levels[:-1], levels[1:], strict=True)
    return [(at, y) for at, before_after in zip(x, steps, strict=True) for y in before_after]


def uneven() -> np.ndarray:
    """Fig. 6 (d): both walls have steps of at most 3 cm."""
    left = [1.2, 1.22, 1.19, 1.205, 1.18, 1.21, 1.2, 1.225, 1.2]
    right = [-1.2, -1.185, -1.21, -1.195, -1.22, -1.19, -1.215, -1.2]
    return corridor(
        left=stairs([0.5, 1.1, 1.6, 2.4, 2.9, 3.7, 4.3, 5.2], left),
        right=stairs([0.2, 0.9, 1.8, 2.5, 3.3, 4.0, 4.9], right),
    )


def room() -> np.ndarray:
    """Fig. 7: 6 m x 5 m, divided by a wall with an opening, with a screen and a block."""
    inner = [
        (3.0, 0.0, 3.15, 1.5),  # the dividing wall
        (3.0, 2.7, 3.15, 5.0),
        (0.0, 2.75, 1.5, 2.9),  # the screen
        (4.2, 2.2, 5.0, 3.2),  # the block
    ]
    return outline([(0.0, 0.0, 6.0, 5.0)], inner)


def office() -> np.ndarray:
    """Nine rooms in four blocks, between a ring of corridors and two that cross it."""
    corridors = [
        (0.0, 0.0, 2.0, 15.0),  # west
        (18.1, 0.0, 20.0, 15.0),  # east
        (0.0, 0.0, 20.0, 1.8),  # south
        (0.0, 13.0, 20.0, 15.0),  # north
        (9.3, 0.0, 11.4, 15.0),  # middle
        (0.0, 6.4, 9.3, 8.4),  # west to middle
        (11.4, 7.0, 20.0, 8.8),  # middle to east
        (20.0, 3.0, 20.5, 4.2),  # alcoves
        (6.0, -0.45, 7.3, 0.0),
        (2.6, 15.0, 4.2, 15.5),
    ]
    rooms = [
        (2.15, 1.95, 5.1, 6.25),
        (5.25, 1.95, 9.15, 6.25),
        (2.15, 8.55, 6.5, 12.85),
        (6.65, 8.55, 9.15, 10.6),
        (6.65, 10.75, 9.15, 12.85),
        (11.55, 1.95, 15.9, 6.85),
        (16.05, 1.95, 17.95, 6.85),
        (11.55, 8.95, 14.2, 12.85),
        (14.35, 8.95, 17.95, 12.85),
    ]
    doors = [
        (3.0, 1.8, 4.0, 1.95),
        (5.1, 4.5, 5.25, 5.5),
        (7.6, 6.25, 8.65, 6.4),
        (2.0, 9.3, 2.15, 10.3),
        (4.8, 12.85, 5.9, 13.0),
        (7.2, 8.4, 8.15, 8.55),
        (9.15, 11.4, 9.3, 12.35),
        (11.4, 2.7, 11.55, 3.8),
        (13.9, 6.85, 14.9, 7.0),
        (17.95, 5.2, 18.1, 6.15),
        (11.4, 9.6, 11.55, 10.65),
        (14.2, 11.2, 14.35, 12.25),
        (17.95, 9.5, 18.1, 10.6),
    ]
    columns = [
        (12.9, 4.5, 13.3, 4.9),
        (14.6, 2.8, 15.0, 3.2),
        (4.6, 10.0, 5.1, 10.5),
        (0.0, 3.6, 0.3, 4.0),
        (14.0, 0.0, 14.4, 0.3),
        (12.4, 13.0, 12.8, 13.3),
        (5.2, 8.1, 5.5, 8.4),
    ]
    oblique = [
        (14.35, 10.0, 16.17, 8.95),  # 30 degrees across a corner of a room
        (18.8, 15.0, 20.0, 13.8),  # chamfered corner of the ring
        (0.0, 14.3, 0.9, 15.0),
    ]
    return np.vstack([outline(corridors + rooms + doors, columns), oblique])


BUILDERS: dict[str, Callable[[], np.ndarray]] = {
    "fig04": object_ahead,
    "fig06a": corridor,
    "fig06b": opening,
    "fig06c": column,
    "fig06d": uneven,
    "fig07": room,
    "office": office,
}
"""Functions that make the walls (S, 4) of each world."""

NAMES = tuple(BUILDERS)
"""Names of the worlds."""

WAYPOINTS = {
    "office": [
        (1.0, 0.9),  # start
        (3.5, 0.9),
        (3.5, 3.6),
        (4.5, 5.0),
        (8.1, 5.0),
        (8.1, 7.4),
        (10.35, 7.4),
        (10.35, 3.25),
        (13.4, 3.25),
        (14.4, 5.2),
        (14.4, 7.9),
        (10.35, 7.9),
        (10.35, 10.1),
        (12.8, 10.1),
        (13.2, 11.7),
        (16.2, 11.7),
        (16.8, 10.05),
        (19.05, 10.05),
        (19.05, 13.2),
        (18.2, 14.1),
        (10.35, 14.1),
        (10.35, 7.4),
        (1.0, 7.4),
        (1.0, 9.8),
        (3.4, 9.8),  # finish
    ],
}
"""Waypoints [m] of a drive through some worlds."""

SCAN_POSES = {
    "fig07": [
        (0.7, 1.3, -0.39),
        (2.1, 1.5, 1.18),
        (2.3, 2.9, 2.36),
        (2.7, 1.9, 3.14),
        (3.9, 1.9, -0.79),
        (3.9, 1.1, 1.18),
        (5.1, 1.5, 1.18),
        (5.5, 2.7, 2.75),
        (5.1, 3.9, 2.75),
        (3.9, 4.5, 0.39),
    ],
}
"""Poses [m, m, rad] from which some worlds are scanned."""


def lookup(table: Mapping[str, T], name: str, what: str) -> T:
    """Entry `name` of a table.

    Args:
        table: Entries by name.
        name: The entry wanted.
        what: What the entries are, for the message.

    Raises:
        ValueError: There is no such entry; the message lists those that exist.
    """
    if name not in table:
        raise ValueError(f"no {what} named {name!r}; there are: {', '.join(table)}")
    return table[name]


def named(name: str) -> World:
    """World with one of the names `NAMES`.

    Raises:
        ValueError: There is no world of this name.
    """
    return World(walls=lookup(BUILDERS, name, "world")())


def waypoints(name: str) -> np.ndarray:
    """Waypoints (N, 2) [m, world frame] of the drive through a world; straight lines join them.

    Raises:
        ValueError: There is no drive through a world of this name.
    """
    return np.array(lookup(WAYPOINTS, name, "drive"))


def scan_poses(name: str) -> np.ndarray:
    """Poses (N, 3) [m, m, rad, world frame] from which a world is scanned.

    Raises:
        ValueError: There are none for a world of this name.
    """
    return np.array(lookup(SCAN_POSES, name, "list of scan poses"))
