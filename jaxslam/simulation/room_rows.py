"""Rows of rooms in the blocks between the corridors of a building.

A row is divided in its own frame, u along the corridor and v away from it:

    v  +-----------+-----------+-----+
    ^  |  back row, entered through  |      only where no corridor runs behind the block
    |  +---  ------+---  ------+--  -+
    |  |   room    |   room    |     |
    |  +---  ------+---  ------+--  -+
    |       corridor
    +--> u

The frames of the four sides of a block differ by quarter turns, so look-alike rooms on both sides
of a block are equal, not mirrored.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaxslam.simulation.furniture import Frame, Furniture, furnish, furnish_hall, random_mm
from jaxslam.simulation.worlds import Box

DOOR_WIDTH = (0.8, 1.2)  # [m]
BESIDE_DOOR = 0.25  # [m] from a door to the next wall, at least
ROOM_WIDTH = (2.6, 6.5)  # [m] along the corridor
ALIKE_WIDTH = (2.4, 4.2)  # [m] of look-alike rooms
ROW_DEPTH = 7.5  # [m] of a block of one row, at most
MIN_ROW_DEPTH = 2.6  # [m]
HALL_AREA = 45.0  # [m^2] of a block that may be a hall, at least
HALL_SHARE = 0.2  # of these blocks
ALIKE_SHARE = 0.3  # of the blocks with look-alike rooms, beside the one that has them always
EXTRA_DOOR_SHARE = 0.2  # of the walls between rooms, or rooms and corridors, with a second door


class Block(NamedTuple):
    """A part of a building between corridors.

    Attributes:
        box: x0, y0, x1, y1 [m].
        sides: The corridor beyond the wall at each coordinate of `box`; -1 for none.
    """

    box: Box
    sides: tuple[int, ...]


class Plan(NamedTuple):
    """Rooms, doors and furniture; the fields are those of `buildings.Building`."""

    rooms: list[Box]
    doors: list[Box]
    door_sides: list[tuple[int, int]]
    alike: list[int]
    furniture: list[Furniture]


class _Row(NamedTuple):
    """A row of rooms: their frame, their places along it, its depth [m], its corridor or -1."""

    frame: Frame
    places: list[tuple[float, float]]
    depth: float
    corridor: int
    ends: tuple[int, int]  # corridors beyond its first and last room, or -1


def rooms_of_blocks(
    rng: np.random.Generator, blocks: list[Block], corridors: list[Box], thick: float
) -> Plan:
    """Rooms, doors and furniture of all blocks; one block at least has look-alike rooms.

    Args:
        rng: Generator of the random numbers.
        blocks: Blocks, each with a corridor on one side at least.
        corridors: Boxes of the corridors.
        thick: [m] thickness of the walls.
    """
    longest = max(range(len(blocks)), key=lambda k: _length(blocks[k], _front(blocks[k])))
    rows: list[tuple[list[_Row], str]] = []
    for k, block in enumerate(blocks):
        area = (block.box[2] - block.box[0]) * (block.box[3] - block.box[1])
        kind = "alike" if k == longest or rng.random() < ALIKE_SHARE else "other"
        if kind == "other" and area > HALL_AREA and rng.random() < HALL_SHARE:
            kind = "hall"
        rows.append((_rows_of_block(rng, block, thick, kind), kind))
    count = sum(len(row.places) for some, _ in rows for row in some)
    plan = Plan([], [], [], [], [])
    for some, kind in rows:
        if kind == "alike":
            _add_alike(rng, some, thick, count, plan)
        else:
            _add_others(rng, some, thick, count, plan, hall=kind == "hall")
    return plan


def _front(block: Block) -> int:
    """The longest side of a block that a corridor runs along."""
    sides = [k for k in range(4) if block.sides[k] >= 0]
    return max(sides, key=lambda k: _length(block, k))


def _length(block: Block, side: int) -> float:
    """Length [m] of a side of a block."""
    along = 1 - side % 2
    return round(block.box[along + 2] - block.box[along], 3)


def _frame(block: Block, side: int) -> Frame:
    """The frame of a row along one side of a block."""
    x0, y0, x1, y1 = block.box
    origin = ((x0, y1), (x0, y0), (x1, y0), (x1, y1))[side]
    return Frame(origin, ((0, -1), (1, 0), (0, 1), (-1, 0))[side])


def _rows_of_block(rng: np.random.Generator, block: Block, thick: float, kind: str) -> list[_Row]:
    """One or two rows of rooms; the second one has a corridor of its own, or is behind the first.

    Rows of look-alike rooms are equally deep, and so are their rooms' widths.
    """
    front = _front(block)
    back, length = (front + 2) % 4, _length(block, front)
    depth = _length(block, (front + 1) % 4)
    frame, ends = _frame(block, front), (block.sides[(front + 3) % 4], block.sides[(front + 1) % 4])
    own = block.sides[back] >= 0
    spare = round(depth - thick - 2 * MIN_ROW_DEPTH, 3)
    if kind == "hall" or spare < 0.0 or (not own and depth <= ROW_DEPTH):
        places = [(0.0, length)] if kind == "hall" else _places(rng, length, thick, kind)
        return [_Row(frame, places, depth, block.sides[front], ends)]
    share = 0.5 if kind == "alike" else rng.uniform(0.2, 0.8)
    first = round(MIN_ROW_DEPTH + share * spare - 0.0005, 3)
    second = first if kind == "alike" else round(depth - thick - first, 3)
    places = _places(rng, length, thick, kind)
    rows = [_Row(frame, places, first, block.sides[front], ends)]
    if not own:
        rows.append(_Row(frame.moved(0.0, first + thick), places, second, -1, ends))
    else:
        others = places if kind == "alike" else _places(rng, length, thick, kind)
        rows.append(_Row(_frame(block, back), others, second, block.sides[back], ends[::-1]))
    return rows


def _places(
    rng: np.random.Generator, length: float, thick: float, kind: str
) -> list[tuple[float, float]]:
    """First and last coordinate [m] of each room along a row of a length [m]."""
    if kind == "alike":
        count = max(2, int((length + thick) / (random_mm(rng, *ALIKE_WIDTH) + thick)))
        width = np.floor(1000 * (length - (count - 1) * thick) / count) / 1000
        starts = [k * (width + thick) for k in range(count)]
        return [(round(start, 3), round(start + width, 3)) for start in starts]
    ends: list[tuple[float, float]] = []
    start = 0.0
    while True:
        left = length - start
        widest = left - thick - ROOM_WIDTH[0]
        if widest < ROOM_WIDTH[0] or (left < ROOM_WIDTH[1] and rng.random() < 0.5):
            return [*ends, (start, length)]
        end = round(start + random_mm(rng, ROOM_WIDTH[0], min(widest, ROOM_WIDTH[1])), 3)
        ends.append((start, end))
        start = round(end + thick, 3)


def _door(rng: np.random.Generator, start: float, end: float) -> tuple[float, float]:
    """A door [m] somewhere in a wall that begins and ends at given coordinates [m]."""
    width = random_mm(rng, *DOOR_WIDTH)
    first = random_mm(rng, start + BESIDE_DOOR, end - BESIDE_DOOR - width)
    return first, round(first + width, 3)


def _add_door(plan: Plan, door: Box, one: int, other: int) -> None:
    """Add a door, in the world frame, to a plan."""
    plan.doors.append(door)
    plan.door_sides.append((one, other))


def _add_alike(
    rng: np.random.Generator, rows: list[_Row], thick: float, rooms: int, plan: Plan
) -> None:
    """Add rows of look-alike rooms to a plan; those with a corridor are equal among each other."""
    group = max(plan.alike, default=-1) + 1
    width = rows[0].places[0][1]
    first = len(plan.rooms)
    into_back = _door(rng, 0.0, width) if rows[-1].corridor < 0 else None
    entry, found = _door(rng, 0.0, width), Furniture([], [], [])
    for number, row in enumerate(rows):
        in_back = number == 1 and into_back is not None
        if in_back:
            entry, group = into_back or entry, group + 1
        if number == 0 or in_back:
            openings = [(entry[0], -thick, entry[1], 0.0)]
            if into_back is not None and not in_back:
                openings.append((into_back[0], row.depth, into_back[1], row.depth + thick))
            found = furnish(rng, (width, row.depth), openings, empty=False)
        for k, (start, _) in enumerate(row.places):
            frame, name = row.frame.moved(start, 0.0), len(plan.rooms)
            plan.rooms.append(frame.box((0.0, 0.0, width, row.depth)))
            plan.alike.append(group)
            plan.furniture.append(found.moved(frame))
            other = first + k if in_back else rooms + row.corridor
            _add_door(plan, frame.box((entry[0], -thick, entry[1], 0.0)), name, other)


def _add_others(
    rng: np.random.Generator, rows: list[_Row], thick: float, rooms: int, plan: Plan, *, hall: bool
) -> None:
    """Add rows of rooms to a plan, each with a door to its corridor or to the room before it."""
    first = len(plan.rooms)
    places = [(row, n) for row in rows for n in range(len(row.places))]
    openings: list[list[Box]] = [[] for _ in places]  # in the frames of the rows

    def add(k: int, door: Box, other: int) -> None:
        openings[k].append(door)
        _add_door(plan, places[k][0].frame.box(door), first + k, other)

    for k, (row, n) in enumerate(places):
        start, end = row.places[n]
        cuts = np.linspace(start, end, 3 if hall and end - start > 6.0 else 2).round(3).tolist()
        for low, high in pairwise(cuts):
            door = _door(rng, low, high)
            behind = row.corridor < 0
            add(k, (door[0], -thick, door[1], 0.0), first + n if behind else rooms + row.corridor)
            if behind:  # the same opening, in the frame of the row before it
                depth = rows[0].depth
                openings[n].append((door[0], depth, door[1], depth + thick))
        last = n == len(row.places) - 1
        if (not last or row.ends[1] >= 0) and rng.random() < EXTRA_DOOR_SHARE:
            low, high = _door(rng, 0.0, row.depth)
            add(k, (end, low, end + thick, high), rooms + row.ends[1] if last else first + k + 1)
            if not last:
                openings[k + 1].append(openings[k][-1])
        if n == 0 and row.ends[0] >= 0 and rng.random() < EXTRA_DOOR_SHARE:
            low, high = _door(rng, 0.0, row.depth)
            add(k, (-thick, low, 0.0, high), rooms + row.ends[0])
    for (row, n), doors in zip(places, openings, strict=True):
        start, end = row.places[n]
        frame, size = row.frame.moved(start, 0.0), (round(end - start, 3), row.depth)
        local = [(u0 - start, v0, u1 - start, v1) for u0, v0, u1, v1 in doors]
        plan.rooms.append(frame.box((0.0, 0.0, *size)))
        plan.alike.append(-1)
        plan.furniture.append((furnish_hall if hall else furnish)(rng, size, local).moved(frame))
