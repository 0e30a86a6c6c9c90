"""Random buildings: rooms along corridors, doors, furniture, round columns, look-alike rooms.

    size -> corridors that divide it into blocks -> rows of rooms in each block (`room_rows`)
         -> furniture (`furniture`) -> walls around what is free

Walls are what the rooms, corridors and doors leave between them, so they have a thickness. All
lengths are whole millimetres, so that look-alike rooms are equal to rounding.
"""

import re
from typing import NamedTuple

import numpy as np

from jaxslam.core.types import as_size
from jaxslam.simulation import room_rows
from jaxslam.simulation.furniture import Frame, Furniture, furnish_corridor, join, random_mm
from jaxslam.simulation.room_rows import Block
from jaxslam.simulation.worlds import Box, World, outline, polyline

DEFAULT_SIZE = (30.0, 20.0)  # [m] of a building
MIN_SIZE = (8.0, 10.0)  # [m] its shorter and its longer side, at least
MAX_SIZE = 200.0  # [m] of a side
MAX_SEED = 2**32 - 1
CORRIDOR_WIDTH = (1.6, 3.0)  # [m]
WALL_THICKNESS = (0.1, 0.25)  # [m]
BLOCK_SIDE = (13.0, 18.0)  # [m] of the longest block that no corridor divides
MIN_BLOCK_SIDE = 5.0  # [m] beside a corridor, but for the first one
MIN_DEPTH = 2.6  # [m] of the two blocks beside the first corridor
PREFIX = "random:"  # of the names of random buildings
NAME = re.compile(PREFIX + r"(\d+)(?::(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?))?")
NAME_FORM = "random:SEED or random:SEED:LENGTHxWIDTH [m], as random:7:40x25"


class Building(NamedTuple):
    """A building and what it holds; its corner is the origin of the world frame.

    Attributes:
        world: Its walls, without padding.
        size: (length, width) [m] inside of the outer walls.
        rooms: (R, 4) [m] boxes x0, y0, x1, y1 between walls.
        corridors: (C, 4) [m] boxes; they overlap where they meet.
        doors: (D, 4) [m] boxes, the openings in the walls.
        door_sides: (D, 2) int what each joins: room k as k, corridor k as R + k.
        alike: (R,) int group of look-alike rooms, equal but for their pose; -1 for none.
        furniture: What stands in rooms and corridors.
    """

    world: World
    size: tuple[float, float]
    rooms: np.ndarray
    corridors: np.ndarray
    doors: np.ndarray
    door_sides: np.ndarray
    alike: np.ndarray
    furniture: Furniture


def building(seed: int, size: tuple[float, float] = DEFAULT_SIZE) -> Building:
    """Random building of rooms along corridors; every room can be reached by a disc of 0.3 m.

    Args:
        seed: Of the random numbers, from 0 to `MAX_SEED`.
        size: Length and width [m] inside of the outer walls: the shorter at least `MIN_SIZE[0]`,
            the longer at least `MIN_SIZE[1]`, both at most `MAX_SIZE`.

    Raises:
        ValueError: The seed or the size is of another type or out of range.
    """
    seed, size = _checked(seed, size)
    rng = np.random.default_rng(seed)
    thick = random_mm(rng, *WALL_THICKNESS)
    corridors: list[Box] = []
    blocks = _divide(rng, Block((0.0, 0.0, *size), (-1, -1, -1, -1)), thick, corridors)
    plan = room_rows.rooms_of_blocks(rng, blocks, corridors, thick)
    pieces = [*plan.furniture]
    pieces += [_in_corridor(rng, k, corridors, plan.doors) for k in range(len(corridors))]
    furniture = join(pieces)
    free = [*plan.rooms, *corridors, *plan.doors]
    closed = [polyline([*piece, piece[0]]) for piece in furniture.outlines()]
    walls = np.concatenate([outline(free, furniture.shelves), *closed])
    return Building(
        world=World(walls),
        size=size,
        rooms=np.array(plan.rooms),
        corridors=np.array(corridors),
        doors=np.array(plan.doors),
        door_sides=np.array(plan.door_sides),
        alike=np.array(plan.alike),
        furniture=furniture,
    )


def named_building(name: str) -> Building:
    """The building of a name of the form `NAME_FORM`.

    Raises:
        ValueError: The name has another form, or its seed or its size is not possible.
    """
    parts = NAME.fullmatch(name)
    if parts is None:
        raise ValueError(f"world {name!r} is not of the form {NAME_FORM}")
    seed, length, width = parts.groups()
    size = DEFAULT_SIZE if length is None else (float(length), float(width))
    return building(int(seed), size)


def _checked(seed: int, size: tuple[float, float]) -> tuple[int, tuple[float, float]]:
    """Seed and size [m, to the millimetre]; ValueError if one is not possible."""
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not whole or not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed is {seed!r}, not a whole number from 0 to {MAX_SEED}")
    if np.shape(size) != (2,):
        raise ValueError(f"size is {size!r}, not length and width in metres")
    length, width = (round(as_size("size", side), 3) for side in size)
    low, high = min(length, width), max(length, width)
    if low < MIN_SIZE[0] or high < MIN_SIZE[1] or high > MAX_SIZE:
        raise ValueError(
            f"size is {length:g} x {width:g} m; a building has at least {MIN_SIZE[1]:g} x "
            f"{MIN_SIZE[0]:g} m and at most {MAX_SIZE:g} x {MAX_SIZE:g} m"
        )
    return int(seed), (length, width)


def _divide(
    rng: np.random.Generator, block: Block, thick: float, corridors: list[Box]
) -> list[Block]:
    """Blocks between corridors: each corridor divides one in two and begins at an earlier one.

    Args:
        rng: Generator of the random numbers.
        block: The block to divide.
        thick: [m] thickness of the walls.
        corridors: Those made so far; new ones are appended.
    """
    box, sides = block
    extent = (box[2] - box[0], box[3] - box[1])
    first = not corridors
    for across in sorted((0, 1), key=lambda axis: extent[axis], reverse=not first):
        along = 1 - across
        reached = first or sides[along] >= 0 or sides[along + 2] >= 0
        if not first and extent[across] < rng.uniform(*BLOCK_SIDE):
            continue
        least = MIN_DEPTH if first else MIN_BLOCK_SIDE
        spare = extent[across] - 2 * thick - 2 * least
        if not reached or spare < CORRIDOR_WIDTH[0]:
            continue
        width = random_mm(rng, CORRIDOR_WIDTH[0], min(CORRIDOR_WIDTH[1], spare))
        spare -= width
        start = round(box[across] + least + thick + spare * rng.uniform(0.15, 0.85), 3)
        end = round(start + width, 3)
        beyond = [thick if sides[k] >= 0 else 0.0 for k in (along, along + 2)]
        corridor = [0.0] * 4
        corridor[across], corridor[across + 2] = start, end
        corridor[along] = round(box[along] - beyond[0], 3)
        corridor[along + 2] = round(box[along + 2] + beyond[1], 3)
        corridors.append((corridor[0], corridor[1], corridor[2], corridor[3]))
        name = len(corridors) - 1
        halves = []
        for side, edge in ((across + 2, start - thick), (across, end + thick)):
            half, around = list(box), list(sides)
            half[side], around[side] = round(edge, 3), name
            halves.append(Block((half[0], half[1], half[2], half[3]), tuple(around)))
        return [part for half in halves for part in _divide(rng, half, thick, corridors)]
    return [block]


def _in_corridor(
    rng: np.random.Generator, k: int, corridors: list[Box], doors: list[Box]
) -> Furniture:
    """Cupboards and columns in corridor k, clear of doors and of where corridors meet."""
    x0, y0, x1, y1 = corridors[k]
    openings = [*doors, *(box for n, box in enumerate(corridors) if n != k)]
    beside = [
        (a0 - x0, b0 - y0, a1 - x0, b1 - y0)
        for a0, b0, a1, b1 in openings
        if a0 <= x1 and a1 >= x0 and b0 <= y1 and b1 >= y0
    ]
    found = furnish_corridor(rng, (round(x1 - x0, 3), round(y1 - y0, 3)), beside)
    return found.moved(Frame((x0, y0), (1, 0)))
