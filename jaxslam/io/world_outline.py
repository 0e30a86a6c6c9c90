"""Outlines of occupied cells as polygons of few sides: a slanting wall is one side, no staircase.

cells -> rings of corners -> pieces that are straight, by splitting and merging -> polygons
"""

import math
from typing import NamedTuple

import numpy as np

from jaxslam.mapping.region_outline import boundary_edges

TOLERANCE = 0.75  # [cells] by which a corner of a cell is off the line fitted to its piece
MAX_SHIFT = 1.0  # [cells] by which a corner of a cell is off the polygon
THIN = 2  # [cells] a wall that ends with a side as short keeps its corners
MAX_BACK = 1.5  # [cells] by which a piece may turn back along its line
MIN_SIDE = 1e-3  # [cells] shorter sides are left out
MIN_SINE = 0.2  # of the angle between two lines that are extended to the corner where they meet


def rings(cells: np.ndarray) -> list[np.ndarray]:
    """Corners (n, 2) int [cells] of the outlines of cells (H, W) bool.

    Cell [i, j] is the square from (i, j) to (i + 1, j + 1). Outlines have the cells on their left,
    those of cells that meet in a corner alone are joined there.
    """
    if not cells.any():
        return []
    turns, starts, follower = boundary_edges(np.pad(cells, 1))
    before = np.empty_like(follower)
    before[follower] = np.arange(len(follower))
    is_corner = (turns != turns[before]).tolist()
    following = follower.tolist()
    is_left = bytearray(b"\1") * len(following)
    found = []
    for first in np.flatnonzero(is_corner).tolist():
        ring, edge = [], first
        while is_left[edge]:
            is_left[edge] = 0
            if is_corner[edge]:
                ring.append(edge)
            edge = following[edge]
        if ring:
            found.append(starts[ring] - 1)
    return found


def straight_sides(ring: np.ndarray) -> np.ndarray:
    """Polygon (m, 2) [cells] of few sides along a ring (n, 2) of corners of cells.

    A piece of the ring becomes one side if all its corners are within `TOLERANCE` of the line
    fitted to it by least squares, weighted by length. So far off are those of a straight line that
    is drawn in cells: at 45 degrees half a diagonal, 0.71 of a cell. Sides meet where their lines
    cross. No corner of the ring is further than `MAX_SHIFT` from the polygon, and a wall of one or
    two cells' thickness keeps its ends, so that its two faces do not become one.

    References:
        Pavlidis, Horowitz (1974), Segmentation of plane curves.
    """
    count = len(ring)
    if count <= 4:
        return ring.astype(float)
    hard = _ends_of_thin_walls(ring)
    breaks = sorted(hard) or [0]
    if len(breaks) < 2:
        offset = ring - ring[breaks[0]]
        breaks = sorted({breaks[0], int((offset**2).sum(axis=1).argmax())})
    moments = _moments(ring)
    breaks = _split(moments, breaks)
    breaks = _merge(moments, breaks, hard)
    while True:
        polygon, wrong = _polygon(moments, breaks)
        if not wrong:
            length = np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T)
            return polygon[length > MIN_SIDE]
        breaks = sorted({*breaks, *wrong})


def _ends_of_thin_walls(ring: np.ndarray) -> set[int]:
    """Corners of a ring (n, 2) at the ends of its short sides between two turns to one side.

    A step of one cell out of a straight wall and back into it is none.
    """
    step = np.roll(ring, -1, axis=0) - ring
    length = np.abs(step).sum(axis=1)
    back = np.roll(step, 1, axis=0)
    turn = np.sign(back[:, 0] * step[:, 1] - back[:, 1] * step[:, 0])  # at the start of each side
    is_end = (turn == np.roll(turn, -1)) & (length <= THIN)
    is_step = (np.roll(length, 1) == 1) & (np.roll(length, -1) == 1)
    is_step &= (np.roll(turn, 1) == -turn) & (np.roll(turn, -2) == -turn)
    ends = np.flatnonzero(is_end & ~is_step)
    return {*ends.tolist(), *((ends + 1) % len(ring)).tolist()}


class _Moments(NamedTuple):
    """A ring of n corners twice over, so that a piece from one to another is a slice.

    Attributes:
        corners: (2 n + 1, 2) [cells].
        sums: 2 n + 1 of the length of the sides before each corner, and of the integrals along them
            of x, y, x x, x y and y y.
    """

    corners: np.ndarray
    sums: list[tuple[float, ...]]

    @property
    def num_corners(self) -> int:
        """Number n of corners of the ring."""
        return len(self.corners) // 2


def _moments(ring: np.ndarray) -> _Moments:
    """Moments of the sides of a ring (n, 2)."""
    corners = np.concatenate([ring, ring, ring[:1]]).astype(float)
    step = np.diff(corners, axis=0)
    length = np.abs(step).sum(axis=1)
    (x, y), (dx, dy) = (corners[:-1] + 0.5 * step).T, step.T
    squares = [x * x + dx * dx / 12.0, x * y + dx * dy / 12.0, y * y + dy * dy / 12.0]
    terms = length * np.array([np.ones_like(x), x, y, *squares])
    sums = np.concatenate([np.zeros((1, 6)), np.cumsum(terms, axis=1).T])
    return _Moments(corners, list(map(tuple, sums.tolist())))


def _line(moments: _Moments, first: int, last: int) -> tuple[float, float, float, float]:
    """Mean x, y and direction cos, sin of the line fitted to a piece, from first to last corner."""
    low, high = moments.sums[first], moments.sums[last]
    length, x, y, xx, xy, yy = (b - a for a, b in zip(low, high, strict=True))
    x, y = x / length, y / length
    xx, xy, yy = xx / length - x * x, xy / length - x * y, yy / length - y * y
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    cos, sin = math.cos(angle), math.sin(angle)
    step = moments.corners[last] - moments.corners[first]
    return (x, y, cos, sin) if step[0] * cos + step[1] * sin >= 0.0 else (x, y, -cos, -sin)


def _is_straight(moments: _Moments, first: int, last: int) -> bool:
    """Whether a piece can be one side."""
    if last - first == 1:
        return True
    x, y, cos, sin = _line(moments, first, last)
    dx, dy = (moments.corners[first : last + 1] - (x, y)).T
    if np.abs(cos * dy - sin * dx).max() > TOLERANCE:
        return False
    along = cos * dx + sin * dy
    return bool((np.maximum.accumulate(along) - along).max() <= MAX_BACK)


def _split(moments: _Moments, breaks: list[int]) -> list[int]:
    """Breaks, ascending, and more of them, so that each piece between two is straight."""
    found = set(breaks)
    pieces = [*zip(breaks, [*breaks[1:], breaks[0] + moments.num_corners], strict=True)]
    while pieces:
        first, last = pieces.pop()
        if not _is_straight(moments, first, last):
            corners = moments.corners[first : last + 1]
            middle = first + _furthest(corners, corners[0], corners[-1])[0]
            found.add(middle % moments.num_corners)
            pieces += [(first, middle), (middle, last)]
    return sorted(found)


def _furthest(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[int, float]:
    """Which of the points (n, 2) but the first and last is furthest from a side, and how far."""
    step, offset = end - start, points[1:-1] - start
    share = offset @ step / max(float(step @ step), 1e-12)
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    distance = np.hypot(*(offset - share[:, None] * step).T)
    furthest = int(distance.argmax())
    return 1 + furthest, float(distance[furthest])


def _merge(moments: _Moments, breaks: list[int], hard: set[int]) -> list[int]:
    """Breaks, ascending, without those between two pieces that are straight as one.

    Three are left at least, and those that are `hard`.
    """
    count = moments.num_corners
    before = len(breaks) + 1
    while len(breaks) < before:
        before = len(breaks)
        left, kept = before, breaks[:1]
        for here, end in zip(breaks[1:], [*breaks[2:], breaks[0] + count], strict=True):
            if here in hard or left <= 3 or not _is_straight(moments, kept[-1], end):
                kept.append(here)
            else:
                left -= 1
        first, last = kept[0], kept[-1]
        if left > 3 and first not in hard and _is_straight(moments, last, kept[1] + count):
            kept = kept[1:]
        breaks = kept
    return breaks


def _polygon(moments: _Moments, breaks: list[int]) -> tuple[np.ndarray, list[int]]:
    """Polygon (m, 2) [cells] whose sides are the pieces between breaks.

    Returns:
        The polygon, and corners at which pieces are to be split as they are too far from their
        sides.
    """
    count = moments.num_corners
    ends = [*breaks[1:], breaks[0] + count]
    lines = [_line(moments, first, last) for first, last in zip(breaks, ends, strict=True)]
    corners = moments.corners[breaks]
    polygon = np.array([*map(_meeting, [lines[-1], *lines[:-1]], lines, corners)])
    wrong = []
    following = np.roll(polygon, -1, axis=0)
    for first, last, start, end in zip(breaks, ends, polygon, following, strict=True):
        if last - first > 1:
            middle, distance = _furthest(moments.corners[first : last + 1], start, end)
            if distance > MAX_SHIFT:
                wrong.append((first + middle) % count)
    return polygon, wrong


def _meeting(
    before: tuple[float, ...], after: tuple[float, ...], corner: np.ndarray
) -> tuple[float, float]:
    """Where two lines meet near a corner; if they do not, the middle between their nearest points.

    Args:
        before: Point x, y and direction cos, sin of a line.
        after: The same of the other one.
        corner: (2,) where the one piece ends and the other begins.
    """
    (x, y, cos, sin), (x_after, y_after, cos_after, sin_after) = before, after
    sine = cos * sin_after - sin * cos_after
    if abs(sine) > MIN_SINE:
        along = ((x_after - x) * sin_after - (y_after - y) * cos_after) / sine
        meeting = x + along * cos, y + along * sin
        if math.dist(meeting, corner) <= MAX_SHIFT:
            return meeting
    near = (x, y, cos, sin), (x_after, y_after, cos_after, sin_after)
    points = []
    for a, b, c, s in near:
        along = (corner[0] - a) * c + (corner[1] - b) * s
        points.append((a + along * c, b + along * s))
    return 0.5 * (points[0][0] + points[1][0]), 0.5 * (points[0][1] + points[1][1])
