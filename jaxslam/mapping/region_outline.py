"""Boundaries of labelled cells, as polygons with holes."""

import numpy as np
from scipy import ndimage

from jaxslam.core import polylines

TOLERANCE = 1.0  # [cells] of a polygon
APART = 0.1  # [cells] between two sides of polygons, more than
MOVES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
"""Steps (4, 2) [cells] along the sides of a cell, each turned left from the one before."""
POCKET = 2  # [cells] width and height of a hole between cells that meet in a corner, left out
_PINCH = 0.25  # [cells] by which a hole ends before a corner that it would share
_BLOCK = 256  # sides that are compared at once


def outlines(label: np.ndarray, count: int) -> list[list[np.ndarray]]:
    """Boundaries (n, 2) [cells] of each of the labels 1 to `count`.

    The first of a label is its outer one, counter-clockwise; others are those of its holes,
    clockwise. If it has several parts, they are those of the largest. Cell [i, j] is the square
    from (i, j) to (i + 1, j + 1). They are a valid polygon: no boundary meets itself or another
    one, and the holes lie beside each other in the outer boundary.

    Args:
        label: (H, W) int.
        count: Number of labels; each has a cell.
    """
    found = []
    for k, box in enumerate(ndimage.find_objects(label, count), start=1):
        corner = np.array([side.start for side in box])
        cells, parts = ndimage.label(np.pad(label[box] == k, 1))
        largest = np.bincount(cells.ravel())[1:].argmax() + 1 if parts > 1 else 1
        found.append([ring + corner - 1.0 for ring in _simplified(_boundaries(cells == largest))])
    return found


def boundary_edges(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sides of cells (H, W) bool whose neighbour is not set; the border is not set.

    Each has its cell on its left. Where two cells meet in a corner alone, sides follow each other
    from the one cell to the other.

    Returns:
        Of each of E sides its direction (E,), an index of `MOVES`, ascending; the corner (E, 2)
        where it starts; and the index (E,) of the side that follows it.
    """
    beside = ((0, -1), (1, 0), (0, 1), (-1, 0))  # neighbour on the right of each edge
    starts = ((0, 0), (1, 0), (1, 1), (0, 1))  # corner of the cell where it begins
    edges = []
    for turn, ((i, j), (row, column)) in enumerate(zip(beside, starts, strict=True)):
        neighbour = cells[1 + i : cells.shape[0] - 1 + i, 1 + j : cells.shape[1] - 1 + j]
        here = np.argwhere(cells[1:-1, 1:-1] & ~neighbour) + [1 + row, 1 + column]
        edges.append(np.column_stack([np.full(len(here), turn), here]))
    turns, rows, columns = np.concatenate(edges).T
    shape = (4, cells.shape[0] + 1, cells.shape[1] + 1)
    key = np.ravel_multi_index((turns, rows, columns), shape)  # ascending

    def number(turn: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Number of each edge, -1 where there is none."""
        wanted = np.ravel_multi_index((turn, row, column), shape)
        found = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[found] == wanted, found, -1)

    ends = np.stack([rows, columns], axis=1) + MOVES[turns]
    follower = np.full(len(turns), -1)
    for change in (1, 0, -1):  # left, straight on, right: the last one found is taken
        nxt = number((turns + change) % 4, *ends.T)
        follower = np.where(nxt >= 0, nxt, follower)
    return turns, np.stack([rows, columns], axis=1), follower


def _boundaries(cells: np.ndarray) -> list[np.ndarray]:
    """Corners (n, 2) of the boundaries of connected cells (H, W) bool; the border is not set.

    The first is the outer one. Each side of a cell whose neighbour is not set is an edge with the
    cell on its left. Where two cells meet in a corner alone, boundaries pass between them, so that
    none meets itself, and holes end `_PINCH` before that corner:

        # .         a turn to the right wherever there is a choice
        . #
    """
    turns, starts, follower = boundary_edges(cells)
    start = int(np.searchsorted(turns, 3))  # of the first cell, which has no neighbour before it
    corners = starts.astype(float)
    following = follower.tolist()
    corner = np.ravel_multi_index(tuple(starts.T), (cells.shape[0] + 1, cells.shape[1] + 1))
    is_pinch = np.bincount(corner)[corner] > 1
    waiting = dict.fromkeys([start, *range(len(turns))])
    found: list[np.ndarray] = []
    while waiting:
        loop, edge = [], next(iter(waiting))
        while edge in waiting:
            del waiting[edge]
            loop.append(edge)
            edge = following[edge]
        before = np.roll(turns[loop], 1)
        is_corner = turns[loop] != before
        ring, pinched = corners[loop], is_pinch[loop]
        if found and pinched.any():
            if np.ptp(ring, axis=0).max() <= POCKET:
                continue
            ring = ring + _PINCH * pinched[:, None] * (MOVES[turns[loop]] - MOVES[before])
        found.append(ring[is_corner])
    return found


def _simplified(rings: list[np.ndarray]) -> list[np.ndarray]:
    """Rings of fewer corners, at most `TOLERANCE` from the given ones, that make a valid polygon.

    Where sides meet, or rings lie in each other otherwise than before, corners are put back.

    Args:
        rings: (n, 2) [cells] the outer ring, and those of holes; no two of their sides meet.

    References:
        Saalfeld (1999), Topologically consistent line simplification with the Douglas-Peucker
        algorithm.
    """
    masks = [_needed(ring) for ring in rings]
    if all(mask.all() for mask in masks):
        return rings
    corners, kept = np.concatenate(rings), np.concatenate(masks)
    number = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    while True:
        index = np.flatnonzero(kept)
        ring = number[index]
        following = _following(ring)
        start = corners[index]
        end = start[following]
        meets = _meets(start, end)
        if not meets.any():
            meets = _misplaced(corners, number, index)
        changed = False
        for side in np.flatnonzero(meets).tolist():
            first, last = int(index[side]), int(index[following[side]])
            stop = last if last > first else int(np.searchsorted(number, ring[side], "right"))
            between = np.arange(first + 1, stop)
            if last <= first:
                between = np.append(between, np.arange(np.searchsorted(number, ring[side]), last))
            if len(between):
                kept[between[_offset(corners[between], start[side], end[side]).argmax()]] = True
                changed = True
        if not changed:
            return [corners[index[ring == k]] for k in range(len(rings))]


def _needed(ring: np.ndarray) -> np.ndarray:
    """Which corners (n,) of a ring (n, 2) are needed for `TOLERANCE`; three at least."""
    if len(ring) <= 4:
        return np.ones(len(ring), bool)
    first = int(np.lexsort(ring.T[::-1])[0])
    loop = np.roll(ring, -first, axis=0)
    loop = np.concatenate([loop, loop[:1]])
    middle = int(np.hypot(*(loop - loop[0]).T).argmax())
    halves = loop[: middle + 1], loop[middle:]
    fewer = np.concatenate([polylines.simplify(half, TOLERANCE)[:-1] for half in halves])
    if len(fewer) < 3:
        return np.ones(len(ring), bool)
    as_number = np.array([1.0, 1.0j])
    return np.isin(ring @ as_number, fewer @ as_number)


def _following(ring: np.ndarray) -> np.ndarray:
    """Index (S,) of the corner after each, where those of a ring follow each other.

    Args:
        ring: (S,) int of each corner, ascending.
    """
    following = np.arange(1, len(ring) + 1)
    is_last = np.append(ring[1:] != ring[:-1], True)
    following[is_last] = np.flatnonzero(np.append(True, ring[1:] != ring[:-1]))
    return following


def _offset(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance (n,) of points (n, 2) from the side between two corners (2,)."""
    step, offset = end - start, points - start
    share = np.clip(offset @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
    return np.hypot(*(offset - share[:, None] * step).T)


def _meets(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Which sides (S,), from corners (S, 2) to (S, 2), meet another one otherwise than in a corner.

    Those nearer to each other than `APART` count as well.
    """
    low, high = np.minimum(start, end) - APART, np.maximum(start, end)
    order = np.argsort(low[:, 0], kind="stable")
    last = np.searchsorted(low[order, 0], high[order, 0], "right")
    meets = np.zeros(len(start), bool)
    for top in range(0, len(order), _BLOCK):
        here = np.arange(top, min(top + _BLOCK, len(order)))
        count = np.maximum(last[here] - here - 1, 0)
        begin = np.cumsum(count) - count
        other = np.arange(count.sum()) - np.repeat(begin - here - 1, count)
        i, j = order[np.repeat(here, count)], order[other]
        near = (low[i, 1] <= high[j, 1]) & (low[j, 1] <= high[i, 1])
        i, j = i[near], j[near]
        found = _pairs_meet(start[i], end[i], start[j], end[j])
        meets[i[found]] = meets[j[found]] = True
    return meets


def _pairs_meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Whether sides a b and c d meet, or cover each other if they share a corner; all (n, 2)."""
    shares = (b == c).all(axis=1) | (a == d).all(axis=1)

    def side(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Sign of the side of a line that a point lies on, 0 within `APART` of it."""
        step, offset = end - start, point - start
        across = step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0]
        return np.where(np.abs(across) <= APART * np.hypot(*step.T), 0.0, np.sign(across))

    crosses = (side(a, b, c) * side(a, b, d) <= 0.0) & (side(c, d, a) * side(c, d, b) <= 0.0)
    back = ((b - a) * (d - c)).sum(axis=1) < 0.0
    across = (b - a)[:, 0] * (d - c)[:, 1] - (b - a)[:, 1] * (d - c)[:, 0]
    return np.where(shares, back & (across == 0.0), crosses)


def _misplaced(corners: np.ndarray, number: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Which sides (S,) put a hole outside the outer ring or in another hole, or turn a ring over.

    Args:
        corners: (n, 2) [cells] of all rings.
        number: (n,) int ring of each, ascending.
        index: (S,) those that are kept, the starts of the sides.
    """
    ring = number[index]
    start = corners[index]
    end = start[_following(ring)]
    x, y = (start - start[0]).T
    x_end, y_end = (end - start[0]).T
    count = int(ring[-1]) + 1
    area = np.bincount(ring, x * y_end - x_end * y)
    misplaced = (area * np.where(np.arange(count) == 0, 1.0, -1.0) <= 0.0)[ring]
    for k in range(1, count):
        point = start[np.searchsorted(ring, k)]
        spans = (start[:, 1] <= point[1]) != (end[:, 1] <= point[1])
        (a, b), (c, d) = start[spans].T, end[spans].T
        crossed = ring[spans][a + (c - a) * (point[1] - b) / (d - b) > point[0]]
        is_wrong = np.bincount(crossed, minlength=count) % 2 != (np.arange(count) == 0)
        is_wrong[k] = False
        if is_wrong.any():
            low = np.minimum.reduceat(corners, index)  # of the corners that a side replaces
            high = np.maximum.reduceat(corners, index)
            low, high = np.minimum(low, end), np.maximum(high, end)
            misplaced |= is_wrong[ring] & ((low <= point) & (point <= high)).all(axis=1)
    return np.asarray(misplaced)
