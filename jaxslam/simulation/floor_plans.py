"""Random floor plans: rooms, doors, blocks and slanting walls."""

import jax
import numpy as np

from jaxslam.core.types import Key
from jaxslam.simulation.worlds import Box, World, outline, polyline

PLAN_WALLS = 160
"""Number of walls S of every random floor plan, padding included."""

MIN_ROOM_SIDE = 2.0  # [m] shortest side of a room


def _find_door(
    rng: np.random.Generator, rooms: list[Box], box: Box, axis: int, cut: float, thick: float
) -> list[Box]:
    """A door through the wall from `cut` to `cut` + `thick` along `axis`; none after 50 tries.

    A single room must lie behind the whole width of the door on either side, 0.1 m wider.
    """
    across = 1 - axis
    width = rng.uniform(0.85, 1.5)

    def opens_into(room: Box, side: int, position: float, start: float) -> bool:
        return (
            bool(np.isclose(room[side], position))
            and room[across] <= start - 0.1
            and start + width + 0.1 <= room[across + 2]
        )

    sides = ((axis + 2, cut), (axis, cut + thick))
    for _ in range(50):
        start = rng.uniform(box[across] + 0.2, box[across + 2] - 0.2 - width)
        if all(any(opens_into(room, *side, start) for room in rooms) for side in sides):
            along, beside = (cut, cut + thick), (start, start + width)
            (x0, x1), (y0, y1) = (along, beside) if axis == 0 else (beside, along)
            return [(x0, y0, x1, y1)]
    return []


def _rooms(rng: np.random.Generator, box: Box, thick: float) -> tuple[list[Box], list[Box]]:
    """Rooms of a box and the doors between them: binary space partitioning.

    Args:
        rng: Generator of the random cuts.
        box: [m] the space to divide.
        thick: [m] thickness of the walls.
    """
    x0, y0, x1, y1 = box
    size = np.array([x1 - x0, y1 - y0])
    axis = int(rng.random() < size[1] / size.sum())  # the longer side is cut more often
    if size[axis] < 2 * MIN_ROOM_SIDE + thick or size.prod() < rng.uniform(8.0, 22.0):
        return [box], []
    cut = rng.uniform(box[axis] + MIN_ROOM_SIDE, box[axis + 2] - MIN_ROOM_SIDE - thick)
    low = (x0, y0, cut, y1) if axis == 0 else (x0, y0, x1, cut)
    high = (cut + thick, y0, x1, y1) if axis == 0 else (x0, cut + thick, x1, y1)
    halves = [_rooms(rng, half, thick) for half in (low, high)]
    rooms, doors = (halves[0][k] + halves[1][k] for k in range(2))
    return rooms, [*doors, *_find_door(rng, rooms, box, axis, cut, thick)]


def _turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Points (N, 2) turned counter-clockwise by an angle [rad] about the origin."""
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def _block(rng: np.random.Generator, room: Box) -> list[np.ndarray]:
    """A box in a room, half of the time at an angle; none in a room that is too small for it."""
    x0, y0, x1, y1 = room
    half = rng.uniform(0.15, 0.4, 2)
    margin = np.hypot(*half) + 0.75
    if min(x1 - x0, y1 - y0) <= 2 * margin:
        return []
    middle = rng.uniform([x0 + margin, y0 + margin], [x1 - margin, y1 - margin])
    angle = rng.choice([0.0, rng.uniform(-0.8, 0.8)])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
    return [polyline(middle + _turned(corners, angle))]


def _chamfer(rng: np.random.Generator, room: Box, doors: list[Box]) -> list[np.ndarray]:
    """A slanting wall across a corner of a room; none where it would block a door."""
    x0, y0, x1, y1 = room
    legs = rng.uniform(0.6, 1.4, 2)
    x, y = (x0, x1)[int(rng.integers(2))], (y0, y1)[int(rng.integers(2))]
    first = (x + (legs[0] if x == x0 else -legs[0]), y)
    second = (x, y + (legs[1] if y == y0 else -legs[1]))
    low, high = np.minimum(first, second) - 0.1, np.maximum(first, second) + 0.1
    blocks_door = any(
        door[2] >= low[0] and door[0] <= high[0] and door[3] >= low[1] and door[1] <= high[1]
        for door in doors
    )
    return [] if blocks_door else [np.array([[*first, *second]])]


def _furniture(rng: np.random.Generator, rooms: list[Box], doors: list[Box]) -> list[np.ndarray]:
    """Walls of boxes in 45 % of the rooms, and of chamfered corners in 30 %."""
    pieces = []
    for room in rooms:
        kind = rng.random()
        if kind < 0.45:
            pieces += _block(rng, room)
        elif kind < 0.75:
            pieces += _chamfer(rng, room, doors)
    return pieces


def floor_plan(key: Key, *, size: tuple[float, float] = (13.0, 10.0)) -> World:
    """Random floor plan of rooms joined by doors, with boxes and chamfered corners in some rooms.

    Args:
        key: Key of the random numbers.
        size: Length and width [m]; from about 5 x 5 m on.

    Returns:
        `PLAN_WALLS` walls, the last ones of zero length: invisible padding. The plan is turned by a
        random angle about its first corner.

    Raises:
        ValueError: The plan needs more walls than that.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    rooms, doors = _rooms(rng, (0.0, 0.0, *size), 0.15)
    walls = np.vstack([outline(rooms + doors), *_furniture(rng, rooms, doors)])
    if len(walls) > PLAN_WALLS:
        raise ValueError(f"size {size}: {len(walls)} walls, {PLAN_WALLS} at most; ask for less")
    walls = _turned(walls.reshape(-1, 2), rng.uniform(-np.pi, np.pi)).reshape(-1, 4)
    return World(walls=np.pad(walls, ((0, PLAN_WALLS - len(walls)), (0, 0))))
