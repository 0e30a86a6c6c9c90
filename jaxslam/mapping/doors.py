"""Doors: gaps that are narrow for the space on both their sides, and the ends of corridors.

Gaps are tried from the narrowest on, and a door that is found is closed for those after it: in a
corridor, space does not widen through the doors beside it.

       room
    ------.   .------    <- a gap is a door if free space widens on both sides: for most of the
       corridor             first metre, lines parallel to it are longer
    -----------------
"""

import numpy as np

from jaxslam.mapping.gaps import Gaps, Passages, find_gaps, line_cells, narrowest, take

WIDENING = 1.25  # of free space beside a door, at least, relative to the width of the door
MIN_WIDENING = 2.5  # [cells] at least: walls at an angle to the grid have steps, on both sides
REACH = 1.0  # [m] to each side of a gap in which space widens: walls are thinner
WALL = 0.4  # [m] to each side of a door that may belong to its frame
MAX_WIDTH = 6.0  # [m] of an opening between two regions
MIN_CORRIDOR = 0.6  # [m] width of a corridor
HALL_RATIO = 2.5  # width of a hall, at least, relative to a corridor that ends there
HALL_RANGE = 2.5  # widths of the corridor within which the hall is so wide
_HALL_RAYS = np.radians(np.arange(-75.0, 76.0, 15.0))
_STEP = 0.7  # [cells] along lines
_BATCH = 64  # gaps that are looked at together, at most
_POINTS = 2e6  # that are looked up for them


def find_doors(
    free: np.ndarray, distance: np.ndarray, nearest: np.ndarray, *, resolution: float
) -> Gaps:
    """Gaps that bound regions: doors, openings, ends of corridors in halls.

    Args:
        free: (H, W) bool free space; cells at the border of the grid are not free.
        distance: (H, W) [cells] to the edge of the nearest obstacle.
        nearest: (2, H, W) int index of that obstacle.
        resolution: [m] side of a cell.
    """
    passages = Passages(find_gaps(free, distance, nearest), WALL / resolution)
    widths = passages.gaps.width
    tried = narrowest(passages, max_width=MAX_WIDTH / resolution)
    search = _Search(free, passages, resolution)
    # Closing doors makes space narrower: what does not widen now never does.
    widens = search.widens(tried)
    tried = tried[widens.any(axis=1)]
    doors = []
    for k in tried[widens[widens.any(axis=1)].all(axis=1)].tolist():
        if search.is_door(k):
            search.close(k)
            doors.append(k)
    for k in sorted(doors, key=lambda k: (-widths[k], k)):
        search.open(k)  # it may have widened through a door that was found later
        if search.is_door(k):
            search.close(k)
        else:
            doors.remove(k)
    tried = tried[~np.isin(tried, doors) & (widths[tried] >= MIN_CORRIDOR / resolution)]
    for k in tried[search.widens(tried).any(axis=1)].tolist():
        end = search.hall_end(k, distance)
        if end is not None:
            search.close(k)
            doors.append(end)
    return take(passages.gaps, np.array(doors, int))


class _Search:
    """Free space in which the doors found so far are closed."""

    def __init__(self, free: np.ndarray, passages: Passages, resolution: float):
        """Begin with all doors open."""
        self._passages = passages
        self._gaps = passages.gaps
        self._normal = passages.gaps.normal
        self._ahead = np.arange(1.0, REACH / resolution + 0.5)  # [cells]
        # The margin holds all points that are looked up.
        self._margin = int(HALL_RANGE * MAX_WIDTH / resolution) + 6
        # Number of obstacles in each cell, doors included.
        self._obstacles = np.pad((~free).astype(np.int16), self._margin, constant_values=1)
        self._frames: dict[int, np.ndarray] = {}

    def close(self, k: int) -> None:
        """Fill the gap k and its door frame."""
        self._obstacles.reshape(-1)[self._frame(k)] += 1

    def open(self, k: int) -> None:
        """Undo `close`."""
        self._obstacles.reshape(-1)[self._frame(k)] -= 1

    def _frame(self, k: int) -> np.ndarray:
        """Cells (n,) of a gap and of those beside it in the same passage, as flat indices."""
        if k not in self._frames:
            lines = [line_cells(self._gaps.feet[other]) for other in self._passages.frame(k)]
            row, column = np.concatenate(lines).T + self._margin
            self._frames[k] = np.unique(row * self._obstacles.shape[1] + column)
        return self._frames[k]

    def _is_free(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Whether points [cells] are free."""
        rows = np.rint(row).astype(np.int64) + self._margin
        columns = np.rint(column).astype(np.int64) + self._margin
        return self._obstacles.reshape(-1)[rows * self._obstacles.shape[1] + columns] == 0

    def is_door(self, k: int) -> bool:
        """Whether free space is wider than gap k on both its sides."""
        return bool(self._widens(np.array([k])).all())

    def widens(self, chosen: np.ndarray) -> np.ndarray:
        """Whether free space is wider than gaps on their two sides.

        It is if for half of the distances within `REACH`, the line at that distance parallel to the
        gap is at least `WIDENING` times as long, and longer by `MIN_WIDENING`.

        Args:
            chosen: (n,) indices of gaps, narrow ones first.

        Returns:
            (n, 2) bool, in front of the normals and behind them.
        """
        found = [np.zeros((0, 2), bool)]
        points = 4.0 * len(self._ahead) * (WIDENING * self._gaps.width[chosen] / _STEP + 3.0)
        first = 0
        while first < len(chosen):
            widest = points[min(first + _BATCH, len(chosen)) - 1]
            last = first + int(np.clip(_POINTS / widest, 1, _BATCH))
            found.append(self._widens(chosen[first:last]))
            first = last
        return np.concatenate(found)

    def _widens(self, chosen: np.ndarray) -> np.ndarray:
        """As `widens`, for few gaps of similar width."""
        gaps, ahead = self._gaps, self._ahead
        width = gaps.width[chosen]
        needed = np.maximum(WIDENING * width, width + MIN_WIDENING)
        steps = np.arange(0.0, needed.max() + 1.0, _STEP)
        # axes: gap, side, distance ahead, direction along the gap, step
        forward = self._normal[chosen][:, None] * np.array([1.0, -1.0])[:, None]
        centre = gaps.middle[chosen][:, None, None] + ahead[:, None] * forward[:, :, None]
        along = gaps.along[chosen][:, None] * np.array([1.0, -1.0])[:, None]
        offset = along[:, None, None, :, None] * steps[:, None]
        row, column = (centre[..., None, None, axis] + offset[..., axis] for axis in range(2))
        is_free = self._is_free(row, column)
        reached = np.logical_and.accumulate(is_free[..., 0, 0], axis=2)
        blocked = ~is_free
        count = np.where(blocked.any(axis=-1), blocked.argmax(axis=-1), len(steps))
        wide = _STEP * count.sum(axis=-1) >= needed[:, None, None]
        return (wide & reached).sum(axis=2) >= 0.5 * len(ahead)

    def hall_end(self, k: int, distance: np.ndarray) -> int | None:
        """The gap where the corridor of gap k ends in a hall, or None if it does not end there.

        Free space widens on one side only, where a circle of `HALL_RATIO` times the width fits; on
        the other side the corridor goes on for its own width.
        """
        gaps = self._gaps
        in_front, behind = self._widens(np.array([k]))[0]
        if in_front == behind:
            return None
        middle, width = gaps.middle[k], gaps.width[k]
        normal = self._normal[k] if in_front else -self._normal[k]
        back = middle - np.arange(1.0, width + 1.0)[:, None] * normal
        if not self._is_free(*back.T).all():
            return None
        rays = np.cos(_HALL_RAYS)[:, None] * normal + np.sin(_HALL_RAYS)[:, None] * gaps.along[k]
        points = middle + np.arange(1.0, HALL_RANGE * width + 1.0)[:, None] * rays[:, None]
        seen = np.logical_and.accumulate(self._is_free(points[..., 0], points[..., 1]), axis=1)
        cells = np.rint(points[seen]).astype(np.int64)
        if 2.0 * distance[tuple(cells.T)].max(initial=0.0) < HALL_RATIO * width:
            return None
        beside = self._passages.beside(k, 0.5 * width)
        beside = beside[gaps.width[beside] <= width + 1.0]  # others are askew
        return int(beside[((gaps.middle[beside] - middle) @ normal).argmax()])
