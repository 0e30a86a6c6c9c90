"""Furniture of random buildings: shelves, tables, boxes at angles, round columns.

What stands in a room never keeps a robot out of a part of it: each piece touches a wall all along
its back, or is `PASSAGE` away from it; any two pieces are as far apart, and `DOOR_SPACE` in front
of each door stays free. By boxes around the pieces, so that the distances hold at any angle.
"""

from collections.abc import Sequence
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

    shelves: Sequence[Box]
    polygons: Sequence[np.ndarray]
    columns: Sequence[tuple[float, float, float]]

    def moved(self, frame: Frame) -> "Furniture":
        """The pieces, given in a frame, in the world."""
        middles = [frame.points(np.array([column[:2]]))[0] for column in self.columns]
        return Furniture(
            [frame.box(box) for box in self.shelves],
            [frame.points(polygon) for polygon in self.polygons],
            [(*middle.tolist(), c[2]) for middle, c in zip(middles, self.columns, strict=True)],
        )

    def outlines(self) -> list[np.ndarray]:
        """Corners (n, 2) [m] of the pieces that are no shelves, counter-clockwise."""
        return [*self.polygons, *(circle(*column) for column in self.columns)]


def random_mm(rng: np.random.Generator, low: float, high: float) -> float:
    """A random length from `low` to `high` [m], in whole millimetres."""
    return round(float(rng.uniform(low, high)), 3)


def join(pieces: Sequence[Furniture]) -> Furniture:
    """The pieces of several rooms."""
    return Furniture(*([x for some in pieces for x in some[k]] for k in range(3)))


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
    corridor: bool = False,
) -> Furniture:
    """Furniture of a room, or of a corridor: cupboards, and columns in the middle.

    Args:
        rng: Generator of the random numbers.
        size: [m] of the room, whose corner is the origin.
        openings: Boxes [m] beyond its sides, the doors; or other corridors that it meets.
        corridor: Whether it is one.
    """
    taken = [_space_before(box, size) for box in openings]
    found = Furniture([], [], [])
    area, narrow = size[0] * size[1], min(size)
    if corridor:
        if narrow >= MIN_FURNISHED_CORRIDOR:
            _add_shelves(rng, size, taken, found, rng.poisson(0.08 * max(size)), depth=0.4)
            _add_columns(rng, size, taken, found, rng.poisson(0.06 * max(size)), middle=True)
        return found
    _add_shelves(rng, size, taken, found, rng.integers(0, 3), depth=0.55)
    for _ in range(rng.poisson(min(area / 15.0, 3.0))):
        _add_table(rng, size, taken, found)
    for _ in range(rng.poisson(min(area / 20.0, 2.0))):
        _add_box(rng, size, taken, found)
    if area > 20.0:
        _add_columns(rng, size, taken, found, rng.integers(0, 2), middle=False)
    return found


def furnish_hall(
    rng: np.random.Generator, size: tuple[float, float], openings: Sequence[Box]
) -> Furniture:
    """Furniture of a hall: rows of columns, and tables between them."""
    taken = [_space_before(box, size) for box in openings]
    found = Furniture([], [], [])
    radius = random_mm(rng, 0.2, 0.35)
    counts = [max(1, round(side / COLUMN_SPACING) - 1) for side in size]
    for i in range(1, counts[0] + 1):
        for j in range(1, counts[1] + 1):
            x, y = (
                round(size[k] * n / (counts[k] + 1), 3) for k, n in enumerate((i, j))
            )
            if _is_free((x - radius, y - radius, x + radius, y + radius), size, taken):
                found.columns.append((x, y, radius))
    for _ in range(rng.integers(1, 5)):
        _add_table(rng, size, taken, found)
    return found


def _space_before(opening: Box, size: tuple[float, float]) -> tuple[Box, float]:
    """The space in front of an opening in the border of a room, which stays free.

    Returns:
        Its box, and the distance [m] that pieces keep from it.
    """
    low = [max(opening[k] - DOOR_SPACE, 0.0) for k in range(2)]
    high = [min(opening[k + 2] + DOOR_SPACE, size[k]) for k in range(2)]
    for k in range(2):  # as wide as the door
        if opening[k] >= 0.0 and opening[k + 2] <= size[k]:
            low[k], high[k] = opening[k], opening[k + 2]
    return (low[0], low[1], high[0], high[1]), 0.0


def _is_free(
    box: Box, size: tuple[float, float], taken: list[tuple[Box, float]]
) -> bool:
    """Whether a piece in a box leaves what others and the walls need; it is then taken."""
    for k in range(2):
        gaps = (box[k], size[k] - box[k + 2])
        if any(1e-9 < gap < PASSAGE for gap in gaps) or min(gaps) < -1e-9 or max(gaps) < PASSAGE:
            return False
    for other, gap in taken:
        apart = max(max(other[k] - box[k + 2], box[k] - other[k + 2]) for k in range(2))
        if apart < gap:
            return False
    taken.append((box, PASSAGE))
    return True


def _add_shelves(
    rng: np.random.Generator,
    size: tuple[float, float],
    taken: list[tuple[Box, float]],
    found: Furniture,
    count: int,
    *,
    depth: float,
) -> None:
    """Shelves along walls, some of them in corners, at most `depth` [m] deep."""
    for _ in range(count * TRIES):
        if len(found.shelves) == count:
            return
        along, high = int(rng.integers(2)), bool(rng.integers(2))
        length, deep = random_mm(rng, 0.8, 2.0), random_mm(rng, 0.25, depth)
        spare = size[along] - length
        if spare < 2 * PASSAGE:
            continue
        start = random_mm(rng, PASSAGE, spare - PASSAGE) if rng.random() < 0.7 else 0.0
        across = size[1 - along]
        away = (round(across - deep, 3), across) if high else (0.0, deep)
        span = (start, round(start + length, 3))
        box = (span[0], away[0], span[1], away[1])
        if along == 1:
            box = (away[0], span[0], away[1], span[1])
        if _is_free(box, size, taken):
            found.shelves.append(box)


def _place(
    rng: np.random.Generator,
    size: tuple[float, float],
    taken: list[tuple[Box, float]],
    half: np.ndarray,
    angle: float,
) -> np.ndarray | None:
    """Middle (2,) [m] of a rectangle with half sides (2,) [m] that stands free; None if nowhere."""
    reach = np.abs(_turned(_CORNERS * half, angle)).max(axis=0)
    low, high = PASSAGE + reach, np.array(size) - PASSAGE - reach
    if (low > high).any():
        return None
    for _ in range(TRIES):
        middle = rng.uniform(low, high).round(3)
        ends = [*(middle - reach).tolist(), *(middle + reach).tolist()]
        if _is_free((ends[0], ends[1], ends[2], ends[3]), size, taken):
            return middle
    return None


def _turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Points (N, 2) turned counter-clockwise by an angle [rad] about the origin."""
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def _add_table(
    rng: np.random.Generator,
    size: tuple[float, float],
    taken: list[tuple[Box, float]],
    found: Furniture,
) -> None:
    """A table, of which a scanner sees the four legs; half of them at an angle."""
    half = np.array([random_mm(rng, 0.6, 0.9), random_mm(rng, 0.35, 0.45)])
    angle = float(rng.choice([0.0, 0.5 * np.pi, *rng.uniform(-np.pi, np.pi, 2)]))
    middle = _place(rng, size, taken, half, angle)
    if middle is not None:
        leg = random_mm(rng, 0.02, 0.04)  # half of its side
        for corner in _CORNERS * (half - leg):
            found.polygons.append(middle + _turned(corner + leg * _CORNERS, angle))


def _add_box(
    rng: np.random.Generator,
    size: tuple[float, float],
    taken: list[tuple[Box, float]],
    found: Furniture,
) -> None:
    """A box at an angle."""
    half = np.array([random_mm(rng, 0.15, 0.45), random_mm(rng, 0.15, 0.45)])
    angle = float(rng.uniform(-np.pi, np.pi))
    middle = _place(rng, size, taken, half, angle)
    if middle is not None:
        found.polygons.append(middle + _turned(half * _CORNERS, angle))


def _add_columns(
    rng: np.random.Generator,
    size: tuple[float, float],
    taken: list[tuple[Box, float]],
    found: Furniture,
    count: int,
    *,
    middle: bool,
) -> None:
    """Round columns, anywhere or in the middle of the shorter side."""
    for _ in range(count):
        radius = random_mm(rng, 0.12, 0.25)
        low = np.full(2, PASSAGE + radius)
        high = np.array(size) - low
        if (low > high).any():
            return
        x, y = rng.uniform(low, high).round(3).tolist()
        if middle:
            x, y = (x, size[1] / 2) if size[0] > size[1] else (size[0] / 2, y)
        if _is_free((x - radius, y - radius, x + radius, y + radius), size, taken):
            found.columns.append((x, y, radius))
