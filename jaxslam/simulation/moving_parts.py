"""Doors and loose furniture of a world: what may move in it, found by its walls."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, csgraph
from scipy.spatial import cKDTree

from jaxslam.core.maps import OccupancyMap
from jaxslam.core.types import as_float64
from jaxslam.mapping.rooms import find_regions
from jaxslam.simulation import buildings, named_worlds
from jaxslam.simulation.wall_grid import choose_region, wall_grid

ROBOT_RADIUS = 0.25  # [m] of a robot that goes through doors
DOOR_WIDTH = 0.6, 2.0  # [m] of a door with a leaf
MAX_PIECE = 2.0  # [m] longest side of the box around a loose piece of furniture
MAX_TURN = 0.5  # [rad] by which a piece is turned where it is moved
KEEP = 0.1  # [m] of a moved piece from all walls, at least
FROM_PATH = 0.5  # [m] of a moved piece from the drive, at least
TRIES = 40  # places that are tried for a piece
_SPACING = 0.05  # [m] of samples of walls


class Moves(NamedTuple):
    """How much of the loose furniture is moved: pieces that touch nothing else.

    Attributes:
        moved: [-] share of the pieces.
        moved_by: [m] how far each is moved, to any side; it is turned a little, too.
    """

    moved: Any = 0.0
    moved_by: Any = 0.5


class MovedWalls(NamedTuple):
    """Walls of a world whose furniture is moved.

    Attributes:
        fixed: (S, 4) [m] of all that stays.
        before: (P, 4) [m] of what is moved.
        after: (P, 4) [m] the same afterwards.
        pieces: Number of pieces that are moved.
    """

    fixed: np.ndarray
    before: np.ndarray
    after: np.ndarray
    pieces: int


def doors_of_building(name: str) -> np.ndarray:
    """Closed doors (D, 4) [m] of a random building: lines in the middle of its openings.

    Raises:
        ValueError: There is no building of this name.
    """
    boxes = np.asarray(buildings.named_building(name).doors, float).reshape(-1, 4)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    half = (boxes[:, 2:] - boxes[:, :2]) / 2
    along = np.where((half[:, 0] >= half[:, 1])[:, None], half * [1, 0], half * [0, 1])
    return np.hstack([middle - along, middle + along])


def find_doors(walls: Any, occupancy: OccupancyMap | None = None) -> np.ndarray:
    """Closed doors (D, 4) [m] of any world: the narrow places between its rooms.

    Args:
        walls: (S, 4) [m] of the world.
        occupancy: The map that the walls were made of, if there is one.

    Raises:
        ValueError: The walls are not possible, or enclose no space.
    """
    segments = as_float64("walls", walls, ("S", 4))
    grid = wall_grid(segments, ROBOT_RADIUS, None, occupancy)
    chosen = choose_region(grid, None)[0]
    # All that is open from where the robot can be: it reaches up to the walls.
    label, _ = ndimage.label(~grid.occupied)
    free = label == np.bincount(label[chosen]).argmax()
    found = find_regions(
        ~free,
        free,
        resolution=grid.resolution,
        origin=np.append(grid.corner, 0.0),
        robot_radius=ROBOT_RADIUS,
    )
    low, high = DOOR_WIDTH
    leaves = np.array([door.jambs for door in found.doors if low <= door.width <= high])
    if not len(leaves):
        return np.zeros((0, 4))
    # Jambs are centres of cells: a leaf goes on into both.
    along = leaves[:, 1] - leaves[:, 0]
    along *= grid.resolution / np.hypot(*along.T)[:, None]
    return np.hstack([leaves[:, 0] - along, leaves[:, 1] + along])


def loose_pieces(walls: Any) -> np.ndarray:
    """Number (S,) int of the loose piece of furniture that each wall (S, 4) is of; -1: of none.

    A piece is a closed outline of at most `MAX_PIECE` that shares no point with another wall.
    """
    segments = as_float64("walls", walls, ("S", 4))
    ends = segments.reshape(-1, 2)
    _, point = np.unique(np.round(ends, 4), axis=0, return_inverse=True)
    pairs = point.reshape(-1, 2)
    count = int(point.max(initial=-1)) + 1
    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    outline = csgraph.connected_components(graph, directed=False)[1][pairs[:, 0]]
    degree = np.bincount(point.ravel(), minlength=count)
    number = np.full(len(segments), -1)
    found = 0
    for own in (np.flatnonzero(outline == k) for k in np.unique(outline)):
        box = ends.reshape(-1, 2, 2)[own].reshape(-1, 2)
        size = float(np.max(np.ptp(box, axis=0)))
        closed = (degree[pairs[own]] == 2).all()
        if len(own) >= 3 and closed and 0.0 < size <= MAX_PIECE and _is_alone(segments, own):
            number[own] = found
            found += 1
    return number


def _is_alone(segments: np.ndarray, own: np.ndarray) -> bool:
    """Whether no other wall comes near those with the numbers `own`."""
    box = segments[own].reshape(-1, 2)
    low, high = box.min(axis=0) - 1e-3, box.max(axis=0) + 1e-3
    others = np.delete(segments, own, axis=0)
    near = (np.minimum(others[:, :2], others[:, 2:]) <= high).all(axis=1)
    near &= (np.maximum(others[:, :2], others[:, 2:]) >= low).all(axis=1)
    if not near.any():
        return True
    gap = cKDTree(_samples(others[near])).query(_samples(segments[own]))[0].min()
    return bool(gap > _SPACING)


def move_furniture(walls: Any, path: Any, moves: Moves, seed: int) -> MovedWalls:
    """Furniture of a world before and after it is moved.

    No piece is moved to where it touches something, or stands in the drive; one for which no other
    place is found stays. The same pieces are moved whatever the share of others.

    Args:
        walls: (S, 4) [m] of the world.
        path: (N, 2) [m] of the drive.
        moves: Which share is moved, and how far.
        seed: Of what is random.

    Raises:
        ValueError: The walls or the path are not possible.
    """
    segments = as_float64("walls", walls, ("S", 4))
    drive = cKDTree(as_float64("path", path, ("N", 2)))
    piece = loose_pieces(segments)
    after = segments.copy()
    for number in range(int(piece.max(initial=-1)) + 1):
        rng = np.random.default_rng([seed, number])
        if rng.uniform() >= float(moves.moved):
            continue
        own = piece == number
        around = cKDTree(_samples(np.concatenate([segments[~own], after[~own]])))
        for _ in range(TRIES):
            placed = _moved(segments[own], rng, float(moves.moved_by))
            points = _samples(placed)
            if around.query(points)[0].min() > KEEP and drive.query(points)[0].min() > FROM_PATH:
                after[own] = placed
                break
    changed = (after != segments).any(axis=1)
    pieces = len(np.unique(piece[changed]))
    return MovedWalls(segments[~changed], segments[changed], after[changed], pieces)


def _moved(piece: np.ndarray, rng: np.random.Generator, distance: float) -> np.ndarray:
    """Walls (K, 4) of a piece at another place."""
    points = piece.reshape(-1, 2)
    middle = points.mean(axis=0)
    angle, turn = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-MAX_TURN, MAX_TURN)
    step = distance * np.array([np.cos(angle), np.sin(angle)])
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return np.asarray((middle + step + (points - middle) @ rotation).reshape(-1, 4))


def _samples(segments: np.ndarray) -> np.ndarray:
    """Points (P, 2) [m] on walls (K, 4), `_SPACING` apart or nearer, their ends among them."""
    step = segments[:, 2:] - segments[:, :2]
    count = np.maximum(np.ceil(np.hypot(*step.T) / _SPACING).astype(int) + 1, 2)
    wall = np.repeat(np.arange(len(segments)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    share = (np.arange(len(wall)) - first) / (count[wall] - 1)
    return np.asarray(segments[wall, :2] + share[:, None] * step[wall])


@lru_cache(maxsize=8)
def doors_by_name(name: str) -> np.ndarray:
    """Closed doors (D, 4) [m] of a world with a name, not to be changed.

    Raises:
        ValueError: There is no world of this name, or its doors are not known.
    """
    if name.startswith(buildings.PREFIX):
        found = doors_of_building(name)
    else:
        found = find_doors(named_worlds.named(name).walls)
    found.setflags(write=False)
    return found
