"""Search for the empty circles of junctions, from the junction cells of the diagram.

A junction cell leads to a circle through the walls nearest to it; the circles next to that one are
searched as well. `junctions` fits them to the walls, and says which are landmarks.
"""

import math
from collections.abc import Sequence
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.ranking import first_true, sorted_three, stable_order
from jaxslam.core.types import Array
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import GridSpec, centre_of, grid_origin
from jaxslam.frontend.pyramid import Level
from jaxslam.frontend.segments import MAX_SEGMENTS
from jaxslam.frontend.tangent_circles import (
    TangentCircles,
    WallSegments,
    nearest_three_walls,
    tangent_circles,
)

BLOCK = 3
"""Side [cells] of the square blocks of the grid, each of which starts one circle at most."""

CELLS_PER_START = 3
"""Junction cells that are looked at for each circle that may start: most are of one junction."""

SAME_START = 0.4
"""[m] Of two cells nearer to each other than this, with the same nearest walls, one starts. It
grows with the cells."""


def _nearest_cells(cells: Array, spec: GridSpec, count: int) -> tuple[Array, Array, Array]:
    """The marked cells nearest to the robot, one of each block of `BLOCK` x `BLOCK` at most.

    Cells are ranked by nearness once, in NumPy; the largest rank of each block is left to sort.

    Args:
        cells: (H, W) bool, the marked cells.
        spec: Their grid.
        count: Number of cells wanted.

    Returns:
        Centres x and y (count,) [m, robot frame] of the cells, nearest first, and whether there is
        one: (count,) bool.
    """
    height, width = spec.shape
    distance = np.hypot(
        *((np.indices((height, width)) + 0.5) * spec.cell_size + grid_origin(spec)[:, None, None])
    )
    nearest_last = np.argsort(-distance, axis=None, kind="stable").astype(np.int32)
    rank = np.empty(height * width, np.min_scalar_type(-(height * width + 1)))
    rank[nearest_last] = np.arange(1, height * width + 1)
    key = jnp.where(cells, jnp.asarray(rank.reshape(height, width)), jnp.zeros((), rank.dtype))
    key = _largest_of_blocks(key).astype(jnp.float32)
    top, _ = lax.top_k(key, min(count, key.size))
    top = jnp.pad(top, (0, count - top.size))
    flat = jnp.asarray(nearest_last)[jnp.maximum(top, 1.0).astype(jnp.int32) - 1]
    xy = centre_of(spec, jnp.stack([flat // width, flat % width], axis=-1))
    return xy[:, 0], xy[:, 1], top > 0.0


def _largest_of_blocks(key: Array) -> Array:
    """Largest of each block of `BLOCK` x `BLOCK` cells (H, W), of those cut off at the ends too."""
    height, width = (size - size % BLOCK for size in key.shape)
    found = []
    for rows in (key[:height].reshape(-1, BLOCK, key.shape[1]), key[None, height:]):
        if rows.size:
            largest = jnp.max(rows, axis=1)  # a reduction: XLA does not compute it once a column
            every = (largest[:, k:width:BLOCK] for k in range(BLOCK))
            found += [reduce(jnp.maximum, every)] if width else []
            if width < key.shape[1]:
                found.append(jnp.max(largest[:, width:], axis=1, keepdims=True))
    return jnp.concatenate([x.reshape(-1) for x in found])


def best_apart(score: Array, xy: Array, min_distance: float, count: int) -> tuple[Array, Array]:
    """The best of N points at least `min_distance` from each other: non-maximum suppression.

    A point is suppressed by a better one nearer than `min_distance`.

    Args:
        score: (N,) larger is better; 0 or less excludes a point.
        xy: (N, 2) [m].
        min_distance: [m].
        count: Number of points wanted.

    Returns:
        Index (count,) of the points, best first, and whether there is one: (count,) bool.
    """
    order = stable_order(-score)
    x, y, good = xy[order, 0], xy[order, 1], score[order] > 0.0
    dx, dy = x[:, None] - x[None], y[:, None] - y[None]
    near = dx * dx + dy * dy < min_distance**2
    good &= ~jnp.any(jnp.triu(near, 1) & good[:, None], axis=0)  # by a better one
    best, found = first_true(good, count)
    return order[best], found


def _neighbours(circle: TangentCircles) -> tuple[Array, Array, Array]:
    """Where to search for the junctions next to N circles, three for each.

    The fourth wall of a circle (a, b, c) replaces each of its three walls in turn:

        (a, b, c), d  ->  (d, b, c), (a, d, c), (a, b, d)

    Returns:
        Initial centres x and y (3 N,) [m], and walls (3, 3 N) int32.
    """
    is_replaced = jnp.tile(jnp.eye(3, dtype=bool), len(circle.x))  # (3, 3 N)
    fourth = jnp.repeat(circle.fourth_wall, 3)[None]
    three = jnp.where(is_replaced, fourth, jnp.repeat(circle.walls, 3, axis=1))
    return jnp.repeat(circle.x, 3), jnp.repeat(circle.y, 3), three


_Start = tuple[Array, Array, Array, Array]
"""Initial centres x and y (C,), walls (3, C), and whether there is one (C,), of C circles."""


def _starts(
    cells: Array, walls: WallSegments, level: Level, count: int, spec: FeatureSpec, dtype: jnp.dtype
) -> _Start:
    """Where to search for junctions: `count` cells of a level, each with its nearest walls.

    A junction marks several cells, and in clutter most junctions are too close to walls. Of the
    nearest `CELLS_PER_START` times as many cells, those are left out whose clearance is out of
    limits by more than a cell, and those with the three nearest walls of a cell close by. The
    largest clearance, and what is close by, grow with the cells.
    """
    x, y, found = _nearest_cells(cells, level.grid, CELLS_PER_START * count)
    x, y = x.astype(dtype), y.astype(dtype)
    three, clearance = nearest_three_walls(x, y, walls, math.cos(0.7 * spec.min_foot_angle))
    found &= clearance > spec.min_clearance - level.grid.cell_size
    found &= clearance < spec.max_clearance * level.scale + level.grid.cell_size
    a, b, c = sorted_three(three)
    walls_of = (a * MAX_SEGMENTS + b) * MAX_SEGMENTS + c
    same = walls_of[:, None] == walls_of[None]
    dx, dy = x[:, None] - x[None], y[:, None] - y[None]
    same &= dx * dx + dy * dy < (SAME_START * level.scale) ** 2
    # `same` is symmetric: over the first axis the reduction is vectorised.
    found &= ~jnp.any(jnp.triu(same, 1) & found[:, None], axis=0)
    first, found = first_true(found, count)
    return x[first], y[first], three[:, first], found


def _search(
    start: _Start, walls: WallSegments, spec: FeatureSpec, scale: float
) -> tuple[TangentCircles, Array]:
    """Empty circles through three walls each, and their scores (C,): 0 for none.

    Solve and exchange walls (`tangent_circles`); drop circles that a wall cuts, whose feet are
    close together, or that moved by more than ten cells. The score is the smallest angle between
    two feet.

    Args:
        start: Where to search.
        walls: The walls.
        spec: Limits.
        scale: Side of the cells in those of the finest level.
    """
    x, y, three, found = start
    circle = tangent_circles(x, y, three, walls, swaps=3, max_step=0.4 * scale)
    moved = jnp.hypot(circle.x - x, circle.y - y)
    good = (
        found
        & (circle.penetration < 0.05)
        & (circle.min_angle > 0.7 * spec.min_foot_angle)
        & (moved < 1.0 * scale)
    )
    return circle, jnp.where(good, circle.min_angle, 0.0)


def _tangent_circles(
    cells: Array, walls: WallSegments, level: Level, spec: FeatureSpec, dtype: jnp.dtype
) -> tuple[TangentCircles, Array]:
    """Empty circles through three walls each, found from the junction cells in two rounds.

        round 1:  centre and walls = `_starts`: a junction cell, the three nearest walls in
                  different directions
        round 2:  centre and walls = `_neighbours` of the best circles of round 1
        each:     `_search`;  suppress duplicates

    Both rounds have C = 3 N circles, N = `spec.max_junctions`, so they are one scanned program.

    Returns:
        The best 2 N circles of both rounds, best first, and whether there is one: (2 N,) bool.
    """

    def search(start: _Start, _: None) -> tuple[_Start, tuple[TangentCircles, Array]]:
        circle, score = _search(start, walls, spec, level.scale)
        xy = jnp.stack([circle.x, circle.y], axis=1)
        best, found = best_apart(score, xy, spec.min_separation, spec.max_junctions)
        x, y, three = _neighbours(jax.tree.map(lambda a: a[..., best], circle))
        return (x, y, three, jnp.repeat(found, 3)), (circle, score)

    start = _starts(cells, walls, level, spec.num_candidates, spec, dtype)
    _, (rounds, score) = lax.scan(search, start, length=2)
    circle = jax.tree.map(lambda a: jnp.concatenate([a[0], a[1]], axis=-1), rounds)
    xy = jnp.stack([circle.x, circle.y], axis=1)
    best, found = best_apart(score.reshape(-1), xy, spec.min_separation, 2 * spec.max_junctions)
    return jax.tree.map(lambda a: a[..., best], circle), found


def find_circles(
    cells: Sequence[Array],
    walls: WallSegments,
    levels: Sequence[Level],
    spec: FeatureSpec,
    dtype: jnp.dtype,
) -> tuple[TangentCircles, Array, np.ndarray]:
    """Empty circles of all levels: those of `_tangent_circles`, and of one round on coarser ones.

    Args:
        cells: (H, W) bool of each level, its junction cells.
        walls: The walls.
        levels: The levels, the finest first.
        spec: Capacities and limits.
        dtype: Of the result.

    Returns:
        The circles, whether there is one (C,) bool, and the level (C,) of each, static.
    """
    circle, found = _tangent_circles(cells[0], walls, levels[0], spec, dtype)
    parts, of_level = [(circle, found)], [0] * len(found)
    for k, (own, level) in enumerate(zip(cells[1:], levels[1:], strict=True), 1):
        start = _starts(own, walls, level, spec.max_coarse_candidates, spec, dtype)
        circle, score = _search(start, walls, spec, level.scale)
        parts.append((circle, score > 0.0))
        of_level += [k] * len(score)
    circle, found = jax.tree.map(lambda *part: jnp.concatenate(part, axis=-1), *parts)
    return circle, found, np.array(of_level)
