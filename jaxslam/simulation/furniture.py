"""Furniture of random buildings: shelves, tables, boxes at angles, round columns.

What stands in a room never keeps a robot out of a part of it: each piece touches a wall all along
its back, or is `PASSAGE` away from it; any two pieces are as far apart, and `DOOR_SPACE` in front
of each door stays free. By boxes around the pieces, so that the distances hold at any angle.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from jaxslam.simulation.worlds import Box

PASSAGE = 0.75  # [m] between pieces, and between a piece and a wall that it does not touch
DOOR_SPACE = 0.9  # [m] in front of a door without furniture
SAGITTA = 0.002  # [m] of the sides of the polygons that stand for circles, at most
TRIES = 12  # places that are tried for a piece
COLUMN_SPACING = 4.0  # [m] between the columns of a hall, about
MIN_FURNISHED_CORRIDOR = 2.2  # [m] width of a corridor with cupboards
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


class Frame(NamedTuple):
    """A frame whose axes are those of the world, turned by quarter turns.

    Attributes:
        origin: x, y [m].
        u: x, y of its first axis; the second is 90 degrees to the left.
    """

    origin: tuple[float, float]
    u: tuple[int, int]

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 2) [m] of the frame in the world."""
        turn = np.array([self.u, (-self.u[1], self.u[0])], float)
        return np.asarray(self.origin) + points @ turn

    def box(self, box: Box) -> Box:
        """A box of the frame in the world."""
        ends = self.points(np.array(box).reshape(2, 2)).round(6)
        (x0, y0), (x1, y1) = ends.min(axis=0).tolist(), ends.max(axis=0).tolist()
        return x0, y0, x1, y1

    def moved(self, along: float, away: float) -> "Frame":
        """The frame with its origin at (along, away) [m] of this one."""
        x, y = self.points(np.array([[along, away]]))[0].round(6).tolist()
        return Frame((x, y), self.u)


class Furniture(NamedTuple):
    """Solid pieces.

    Attributes:
        shelves: Boxes x0, y0, x1, y1 [m] whose backs are at walls.
        polygons: (n, 2) [m] corners of boxes and of the legs of tables, counter-clockwise.
        columns: x, y and radius [m] of round columns.
    """

    shelves: list[Box]
    polygons: list[np.ndarray]
    columns: list[tuple[float, float, float]]

    def moved(self, frame: Frame) -> "Furniture":
        """The pieces, given in a frame, in the world."""
        middles = [frame.points(np.array([column[:2]]))[0].tolist() for column in self.columns]
        return Furniture(
            [frame.box(box) for box in self.shelves],
            [frame.points(polygon) for polygon in self.polygons],
            [(x, y, c[2]) for (x, y), c in zip(middles, self.columns, strict=True)],
        )

    def outlines(self) -> list[np.ndarray]:
        """Corners (n, 2) [m] of the pieces that are no shelves, counter-clockwise."""
        return [*self.polygons, *(circle(*column) for column in self.columns)]


class _Space(NamedTuple):
    """A room while it is furnished.

    Attributes:
        size: [m]; its corner is the origin.
        taken: Boxes that are no longer free, with the distance [m] that pieces keep from each.
        found: The pieces so far; changed in place.
    """

    size: tuple[float, float]
    taken: list[tuple[Box, float]]
    found: Furniture

    def take(self, low: np.ndarray, high: np.ndarray) -> Box | None:
        """A box with corners (2,), if a piece may stand there; it is then taken."""
        box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        for k in range(2):
            gaps = (box[k], self.size[k] - box[k + 2])
            narrow = any(1e-9 < gap < PASSAGE for gap in gaps)
            if narrow or min(gaps) < -1e-9 or max(gaps) < PASSAGE:
                return None
        for other, gap in self.taken:
            if max(max(other[k] - box[k + 2], box[k] - other[k + 2]) for k in range(2)) < gap:
                return None
        self.taken.append((box, PASSAGE))
        return box


def random_mm(rng: np.random.Generator, low: float, high: float) -> float:
    """A random length from `low` to `high` [m], in whole millimetres."""
    return round(float(rng.uniform(low, high)), 3)


def join(pieces: Sequence[Furniture]) -> Furniture:
    """The pieces of several rooms."""
    return Furniture(
        [x for some in pieces for x in some.shelves],
        [x for some in pieces for x in some.polygons],
        [x for some in pieces for x in some.columns],
    )


def circle(x: float, y: float, radius: float) -> np.ndarray:
    """Corners (n, 2) [m] on a circle, so many that no side is further than `SAGITTA` from it."""
    count = max(8, int(np.ceil(np.pi / np.arccos(1.0 - SAGITTA / radius))))
    angle = 2 * np.pi * np.arange(count) / count
    return np.array([x, y]) + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def furnish(
    rng: np.random.Generator,
    size: tuple[float, float],
    openings: Sequence[Box],
    *,
    empty: bool = True,
) -> Furniture:
    """Furniture of a room.

    Args:
        rng: Generator of the random numbers.
        size: [m] of the room, whose corner is the origin.
        openings: Boxes [m] beyond its sides: the doors.
        empty: Whether it may be without furniture; a small room may be in any case.
    """
    area = size[0] * size[1]
    for _ in range(1 if empty else TRIES):
        space = _space(size, openings)
        _add_shelves(rng, space, int(rng.integers(0, 3)), 0.55)
        for _ in range(rng.poisson(min(area / 15.0, 3.0))):
            _add_table(rng, space)
        for _ in range(rng.poisson(min(area / 20.0, 2.0))):
            _add_box(rng, space)
        if area > 20.0:
            _add_columns(rng, space, int(rng.integers(0, 2)), in_line=False)
        if any(space.found):
            break
    return space.found


def furnish_corridor(
    rng: np.random.Generator, size: tuple[float, float], openings: Sequence[Box]
) -> Furniture:
    """Cupboards and columns of a corridor, which is wide enough or has none.

    Args:
        rng: Generator of the random numbers.
        size: [m] of the corridor, whose corner is the origin.
        openings: Boxes [m]: doors, and the corridors that it meets.
    """
    space = _space(size, openings)
    if min(size) >= MIN_FURNISHED_CORRIDOR:
        _add_shelves(rng, space, int(rng.poisson(0.08 * max(size))), 0.4)
        _add_columns(rng, space, int(rng.poisson(0.06 * max(size))), in_line=True)
    return space.found


def furnish_hall(
    rng: np.random.Generator, size: tuple[float, float], openings: Sequence[Box]
) -> Furniture:
    """Furniture of a hall: rows of columns, and tables between them; arguments as of `furnish`."""
    space = _space(size, openings)
    radius = random_mm(rng, 0.2, 0.35)
    places = [
        [round(side * n / k, 3) for n in range(1, k)]
        for side in size
        for k in (max(2, round(side / COLUMN_SPACING)),)
    ]
    for middle in product(*places):
        if space.take(np.array(middle) - radius, np.array(middle) + radius):
            space.found.columns.append((middle[0], middle[1], radius))
    for _ in range(rng.integers(1, 5)):
        _add_table(rng, space)
    return space.found


def _space(size: tuple[float, float], openings: Sequence[Box]) -> _Space:
    """A room without furniture, with the space in front of its openings taken."""
    taken: list[tuple[Box, float]] = []
    for opening in openings:
        low = [max(opening[k] - DOOR_SPACE, 0.0) for k in range(2)]
        high = [min(opening[k + 2] + DOOR_SPACE, size[k]) for k in range(2)]
        for k in range(2):  # as wide as the door
            if opening[k] >= 0.0 and opening[k + 2] <= size[k]:
                low[k], high[k] = opening[k], opening[k + 2]
        taken.append(((low[0], low[1], high[0], high[1]), 0.0))
    return _Space(size, taken, Furniture([], [], []))


def _add_shelves(rng: np.random.Generator, space: _Space, count: int, depth: float) -> None:
    """Shelves along walls, some of them in corners, at most `depth` [m] deep."""
    for _ in range(count * TRIES):
        if len(space.found.shelves) == count:
            return
        along, beyond = int(rng.integers(2)), bool(rng.integers(2))
        length, deep = random_mm(rng, 0.8, 2.0), random_mm(rng, 0.25, depth)
        in_corner, share = rng.random() < 0.3, rng.random()
        spare = space.size[along] - length - 2 * PASSAGE
        if spare < 0.0:
            continue
        low, high = np.zeros(2), np.zeros(2)
        low[along] = 0.0 if in_corner else round(PASSAGE + share * spare, 3)
        high[along] = round(low[along] + length, 3)
        side = space.size[1 - along]
        low[1 - along], high[1 - along] = (round(side - deep, 3), side) if beyond else (0.0, deep)
        box = space.take(low, high)
        if box is not None:
            space.found.shelves.append(box)


def _place(
    rng: np.random.Generator, space: _Space, half: np.ndarray, angle: float
) -> np.ndarray | None:
    """Middle (2,) [m] of a rectangle with half sides (2,) [m] that stands free; None if nowhere."""
    reach = np.abs(_turned(_CORNERS * half, angle)).max(axis=0)
    low, high = PASSAGE + reach, np.array(space.size) - PASSAGE - reach
    if (low > high).any():
        return None
    for _ in range(TRIES):
        middle: np.ndarray = rng.uniform(low, high).round(3)
        if space.take(middle - reach, middle + reach):
            return middle
    return None


def _turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Points (N, 2) turned counter-clockwise by an angle [rad] about the origin."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]))


def _add_table(rng: np.random.Generator, space: _Space) -> None:
    """A table, of which a scanner sees the four legs; half of them at an angle."""
    half = np.array([random_mm(rng, 0.6, 0.9), random_mm(rng, 0.35, 0.45)])
    angle = float(rng.choice([0.0, 0.5 * np.pi, *rng.uniform(-np.pi, np.pi, 2)]))
    middle = _place(rng, space, half, angle)
    if middle is not None:
        leg = random_mm(rng, 0.02, 0.04)  # half of its side
        for corner in _CORNERS * (half - leg):
            space.found.polygons.append(middle + _turned(corner + leg * _CORNERS, angle))


def _add_box(rng: np.random.Generator, space: _Space) -> None:
    """A box at an angle."""
    half = np.array([random_mm(rng, 0.15, 0.45), random_mm(rng, 0.15, 0.45)])
    angle = float(rng.uniform(-np.pi, np.pi))
    middle = _place(rng, space, half, angle)
    if middle is not None:
        space.found.polygons.append(middle + _turned(half * _CORNERS, angle))


def _add_columns(rng: np.random.Generator, space: _Space, count: int, *, in_line: bool) -> None:
    """Round columns, anywhere or along the middle of a corridor."""
    for _ in range(count):
        radius = random_mm(rng, 0.12, 0.25)
        low, high = np.full(2, PASSAGE + radius), np.array(space.size) - PASSAGE - radius
        if (low > high).any():
            continue
        middle: np.ndarray = rng.uniform(low, high).round(3)
        if in_line:
            across = int(np.argmin(space.size))
            middle[across] = round(space.size[across] / 2, 3)
        if space.take(middle - radius, middle + radius):
            x, y = middle.tolist()
            space.found.columns.append((x, y, radius))
