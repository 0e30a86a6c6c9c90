"""Whether a path can be driven in a world: it crosses no wall, and does not leave the building."""

from typing import NamedTuple

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.types import as_float64
from jaxslam.simulation.nearest_walls import SEAM
from jaxslam.simulation.worlds import World

TOUCH = 1e-3  # [m] from a wall: corners of drawings are as far apart, and beams of float32 pass
BEND = 0.01  # [m] by which the line of what was driven may be simplified
OPEN = 0.5  # of the directions around a point that meet no wall: it is outside
NUM_POINTS, NUM_BEAMS = 100, 60  # that are tried along a path
_BLOCK = 2**20  # pairs of legs and walls at once


class PathCheck(NamedTuple):
    """What was found along a path.

    Attributes:
        clearance: [m] between the path and the nearest wall.
        leg: Number of the leg that comes so near, from 0.
        open_share: Share of the beams around the path that meet no wall, whatever their range.
        seen: (2,) [m] width and height of the box around all that these beams meet.
    """

    clearance: float
    leg: int
    open_share: float
    seen: np.ndarray


def check_path_in_world(path: np.ndarray, world: World) -> PathCheck:
    """Check that a path can be driven by a robot without a size.

    Outside is where half of all directions or more meet no wall: so it is beyond the walls, as all
    of them are on one side there.

    Args:
        path: (K >= 2, 2) [m, world frame] waypoints that straight lines join.
        world: The building.

    Raises:
        ValueError: A leg of the path meets a wall, or a point of it is outside; the message says
            where.
    """
    path, walls = as_float64("path", path, ("K", 2)), as_float64("walls", world.walls, ("S", 4))
    count = max(2, min(NUM_POINTS, int(np.ceil(float(polylines.length(path))))))
    points = polylines.resample(path, count)
    around = [_meets(walls, point) for point in points]
    share = np.array([1.0 - len(met) / NUM_BEAMS for met in around])
    if share[0] >= OPEN:
        raise ValueError(f"path starts {_outside(points[0], share[0])}")
    nearest = _nearest(path, walls)
    if nearest.crossing is not None:
        x, y = nearest.crossing
        raise ValueError(
            f"path goes through a wall at x {x:.2f}, y {y:.2f} m, from waypoint "
            f"{nearest.leg + 1} to {nearest.leg + 2}"
        )
    if (share >= OPEN).any():
        first = int((share >= OPEN).argmax())
        raise ValueError(f"path leaves the building {_outside(points[first], share[first])}")
    seen = np.ptp(np.concatenate(around), axis=0)
    return PathCheck(nearest.distance, nearest.leg, float(share.mean()), seen)


def check_line_in_world(points: np.ndarray, world: World, what: str) -> None:
    """Check that a line met no wall: a path, or what was driven along it, which cuts its bends.

    Args:
        points: (T >= 2, 2) [m, world frame] of the line.
        world: The building.
        what: What it is, for the message.

    Raises:
        ValueError: It went through a wall; the message says where.
    """
    line, walls = as_float64("points", points, ("T", 2)), as_float64("walls", world.walls, ("S", 4))
    line = polylines.simplify(line, BEND)
    legs, block = np.hstack([line[:-1], line[1:]]), max(1, _BLOCK // max(1, len(walls)))
    for top in range(0, len(legs), block):
        own = legs[top : top + block]
        leg, wall = np.nonzero(_boxes_touch(own[:, None], walls[None]))
        meets, _ = _legs_and_walls(own[leg], walls[wall])
        if meets.any():
            first = leg[meets].min()
            x, y = _first_crossing(own[first], walls[wall[meets & (leg == first)]])
            raise ValueError(
                f"{what} goes through a wall at x {x:.2f}, y {y:.2f} m; "
                "keep the path further from walls"
            )


def _boxes_touch(legs: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Whether the boxes around legs and walls (..., 4) are within `TOUCH` of each other."""
    found: np.ndarray | bool = True
    for axis in (slice(0, None, 2), slice(1, None, 2)):
        a, b = legs[..., axis], walls[..., axis]
        found = found & (a.min(axis=-1) - TOUCH <= b.max(axis=-1))
        found = found & (b.min(axis=-1) - TOUCH <= a.max(axis=-1))
    return np.asarray(found)


class _Nearest(NamedTuple):
    """Where a path comes nearest to walls: its distance [m] and leg; crossing (2,), if it does."""

    distance: float
    leg: int
    crossing: np.ndarray | None = None


def _nearest(path: np.ndarray, walls: np.ndarray) -> _Nearest:
    """Where a path (K, 2) first crosses walls (S, 4) or is within `TOUCH`, else is nearest."""
    found = _Nearest(np.inf, 0)
    if not len(walls):
        return found
    block = max(1, _BLOCK // len(walls))
    for top in range(0, len(path) - 1, block):
        legs = np.hstack([path[:-1], path[1:]])[top : top + block]
        crosses, distance = _legs_and_walls(legs[:, None], walls[None])
        if crosses.any():
            first = int(crosses.any(axis=1).argmax())
            at = _first_crossing(legs[first], walls[crosses[first]])
            return _Nearest(0.0, top + first, at)
        if distance.min() < found.distance:
            leg = top + int(distance.min(axis=1).argmin())
            found = _Nearest(float(distance.min()), leg)
    return found


def _outside(point: np.ndarray, share: float) -> str:
    """Where a point (2,) is, and why it is outside."""
    x, y = point
    place = f"at x {x:.2f}, y {y:.2f} m, which is outside"
    return f"{place}: {share:.0%} of all directions meet no wall"


def _meets(walls: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Points (M, 2) in which those of the beams around a point (2,) that meet a wall first do."""
    angle = 2.0 * np.pi / NUM_BEAMS * (np.arange(NUM_BEAMS) + 0.5)
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    start, along = walls[:, :2] - point, walls[:, 2:] - walls[:, :2]
    slope = _cross(beam[:, None], along)
    safe = np.where(np.abs(slope) > 1e-12, slope, 1.0)
    fraction, distance = _cross(start, beam[:, None]) / safe, _cross(start, along) / safe
    met = (np.abs(slope) > 1e-12) & (distance > 0.0) & (np.abs(fraction - 0.5) <= 0.5 + SEAM)
    nearest = np.where(met, distance, np.inf).min(axis=1, initial=np.inf)
    found = np.isfinite(nearest)
    return np.asarray(point + nearest[found, None] * beam[found])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product (...) of vectors (..., 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _legs_and_walls(legs: np.ndarray, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether legs and walls (..., 4) meet, (...), and the distance between them."""
    a, b = legs[..., :2], legs[..., 2:]
    c, d = walls[..., :2], walls[..., 2:]
    sides = _cross(b - a, c - a) * _cross(b - a, d - a), _cross(d - c, a - c) * _cross(d - c, b - c)
    ends = (_distance(a, c, d), _distance(b, c, d), _distance(c, a, b), _distance(d, a, b))
    distance = np.minimum(np.minimum(ends[0], ends[1]), np.minimum(ends[2], ends[3]))
    return ((sides[0] < 0.0) & (sides[1] < 0.0)) | (distance <= TOUCH), distance


def _distance(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance (...) of points from segments."""
    step = end - start
    share = ((point - start) * step).sum(axis=-1) / np.maximum((step**2).sum(axis=-1), 1e-18)
    near = start + np.clip(share, 0.0, 1.0)[..., None] * step
    return np.asarray(np.hypot(*np.moveaxis(point - near, -1, 0)))


def _first_crossing(leg: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Point (2,) nearest to the start of a leg (4,) where it meets walls (S, 4), which it does."""
    along, across = leg[2:] - leg[:2], walls[:, 2:] - walls[:, :2]
    slope = _cross(along[None], across)
    safe = np.where(slope != 0.0, slope, 1.0)
    ends = (walls.reshape(-1, 2, 2) - leg[:2]) @ along / max(float(along @ along), 1e-18)
    share = np.where(slope != 0.0, _cross(walls[:, :2] - leg[:2], across) / safe, ends.min(axis=1))
    return np.asarray(leg[:2] + np.clip(share.min(), 0.0, 1.0) * along)
