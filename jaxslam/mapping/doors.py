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
REACH = 1.0  # [m] to each side of a gap in which space widens: walls are thinner
WALL = 0.4  # [m] to each side of a door that may belong to its frame
MAX_WIDTH = 6.0  # [m] of an opening between two regions
HALL_RATIO = 2.5  # width of a hall, at least, relative to a corridor that ends there
HALL_RANGE = 2.5  # widths of the corridor within which the hall is so wide
_HALL_RAYS = np.radians(np.arange(-75.0, 76.0, 15.0))
_STEP = 0.7  # [cells] along lines


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
    passages = Passages(find_gaps(free, distance, nearest))
    widths = passages.gaps.width
    tried = narrowest(passages, max_width=MAX_WIDTH / resolution, wall=WALL / resolution).tolist()
    search = _Search(free, passages, resolution)
    doors = []
    for k in tried:
        if all(search.widens(k)):
            search.close(k)
            doors.append(k)
    for k in sorted(doors, key=lambda k: (-widths[k], k)):
        search.open(k)  # it may have widened through a door that was found later
        if all(search.widens(k)):
            search.close(k)
        else:
            doors.remove(k)
    for k in sorted(set(tried) - set(doors), key=lambda k: (widths[k], k)):
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
        self._obstacles = (~free).astype(np.int16)  # number of obstacles in each cell
        self._wall = WALL / resolution
        self._ahead = np.arange(1.0, REACH / resolution + 0.5)  # [cells]
        self._frames: dict[int, np.ndarray] = {}

    def close(self, k: int) -> None:
        """Fill the gap k and its door frame."""
        self._obstacles[self._frame(k)] += 1

    def open(self, k: int) -> None:
        """Undo `close`."""
        self._obstacles[self._frame(k)] -= 1

    def _frame(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Cells of a gap and of those beside it in the same passage, as an index."""
        if k not in self._frames:
            beside = self._passages.beside(k, self._wall)
            lines = [line_cells(self._gaps.feet[other]) for other in beside]
            self._frames[k] = np.unique(np.concatenate(lines), axis=0).T
        row, column = self._frames[k]
        return row, column

    def _is_free(self, points: np.ndarray) -> np.ndarray:
        """Whether points (..., 2) [cells] are free: bool (...)."""
        cells = np.clip(np.rint(points).astype(np.int64), 0, np.array(self._obstacles.shape) - 1)
        return self._obstacles[cells[..., 0], cells[..., 1]] == 0

    def widens(self, k: int) -> list[bool]:
        """Whether free space is wider than gap k on its two sides, in the direction of its normal.

        It is if for half of the distances within `REACH`, the line at that distance parallel to the
        gap is at least `WIDENING` times as long.
        """
        gaps, ahead = self._gaps, self._ahead
        middle, along, normal = gaps.middle[k], gaps.along[k], gaps.normal[k]
        needed = WIDENING * gaps.width[k]
        steps = np.arange(0.0, needed + 1.0, _STEP)[:, None]
        answer = []
        for forward in (normal, -normal):
            centres = middle + ahead[:, None] * forward
            centres = centres[np.logical_and.accumulate(self._is_free(centres))]
            length = np.zeros(len(centres))
            for sideways in (along, -along):
                is_free = self._is_free(centres[:, None] + steps * sideways)
                length += _STEP * np.logical_and.accumulate(is_free, axis=1).sum(axis=1)
            answer.append(bool(np.sum(length >= needed) >= 0.5 * len(ahead)))
        return answer

    def hall_end(self, k: int, distance: np.ndarray) -> int | None:
        """The gap where the corridor of gap k ends in a hall, or None if it does not end there.

        Free space widens on one side only, where a circle of `HALL_RATIO` times the width fits; on
        the other side the corridor goes on for its own width.
        """
        gaps = self._gaps
        ahead_side, back_side = self.widens(k)
        if ahead_side == back_side:
            return None
        middle, width = gaps.middle[k], gaps.width[k]
        normal = gaps.normal[k] if ahead_side else -gaps.normal[k]
        back = np.arange(1.0, width + 1.0)[:, None]
        if not self._is_free(middle - back * normal).all():
            return None
        rays = np.cos(_HALL_RAYS)[:, None] * normal + np.sin(_HALL_RAYS)[:, None] * gaps.along[k]
        points = middle + np.arange(1.0, HALL_RANGE * width + 1.0)[:, None] * rays[:, None]
        seen = np.logical_and.accumulate(self._is_free(points), axis=1)
        cells = np.rint(points[seen]).astype(np.int64)
        if 2.0 * distance[tuple(cells.T)].max(initial=0.0) < HALL_RATIO * width:
            return None
        beside = self._passages.beside(k, 0.5 * width)
        return int(beside[((gaps.middle[beside] - middle) @ normal).argmax()])
