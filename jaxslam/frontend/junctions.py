"""Junctions of the Voronoi diagram of one scan as landmarks.

A junction is the centre of an empty circle that touches three or more walls. The automaton finds
the cells; the circle is then fitted to the line fits of the straight segments, which gives it
sub-cell accuracy, and a covariance from theirs.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.features import Features, zero_padding
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import FAR_JUNCTION, JUNCTION, Array
from jaxslam.frontend.circle_fitting import FittedCircles, fit_circles
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import GridSpec, centre_of, grid_origin
from jaxslam.frontend.lidar import beam_ends, in_free_view, is_free_view
from jaxslam.frontend.pyramid import Level, largest_radius
from jaxslam.frontend.segments import Segments
from jaxslam.frontend.tangent_circles import (
    TangentCircles,
    WallSegments,
    foot_points,
    nearest_three_walls,
    tangent_circles,
    wall_segments,
)

BLOCK = 3
"""Side [cells] of the square blocks of the grid, each of which starts one circle at most."""


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
    rank = np.empty(height * width, np.float32)
    rank[nearest_last] = np.arange(1, height * width + 1)
    key = jnp.where(cells, jnp.asarray(rank.reshape(height, width)), jnp.float32(0.0))
    key = jnp.pad(key, ((0, -height % BLOCK), (0, -width % BLOCK)))
    key = jnp.max(key.reshape(key.shape[0] // BLOCK, BLOCK, -1), axis=1)
    key = jnp.max(key.reshape(len(key), -1, BLOCK), axis=2)
    top, _ = lax.top_k(key.reshape(-1), min(count, key.size))
    top = jnp.pad(top, (0, count - top.size))
    flat = jnp.asarray(nearest_last)[jnp.maximum(top, 1.0).astype(jnp.int32) - 1]
    xy = centre_of(spec, jnp.stack([flat // width, flat % width], axis=-1))
    return xy[:, 0], xy[:, 1], top > 0.0


def _seen_fraction(lidar: Lidar, centre: Array, radius: Array, scan: Scan) -> tuple[Array, Array]:
    """Fraction (C,) of the area of circles that was seen, and whether (C,) the whole disc was.

    The visible region is star-shaped around the robot, so it contains a disc if it contains the
    rim. The rim is sampled at 95 % of the radius: the circle itself touches the walls.
    """
    turn = jnp.linspace(-jnp.pi, jnp.pi, 24, endpoint=False, dtype=scan.ranges.dtype)
    rings = jnp.array([0.3, 0.6, 0.8, 0.95], turn.dtype)  # fractions of the radius, and weights
    offset = radius[:, None] * rings[None]  # (C, 4)
    x = centre[:, :1, None] + offset[:, :, None] * jnp.cos(turn)[None, None]  # (C, 4, 24)
    y = centre[:, 1:, None] + offset[:, :, None] * jnp.sin(turn)[None, None]
    seen = is_free_view(lidar, x, y, scan.ranges)
    area = jnp.sum(seen.mean(axis=2, dtype=rings.dtype) * rings[None], axis=1) / jnp.sum(rings)
    return area, jnp.all(seen[:, -1], axis=1)


def _best_apart(score: Array, xy: Array, min_distance: float, count: int) -> tuple[Array, Array]:
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
    order = jnp.argsort(-score, stable=True)
    x, y, good = xy[order, 0], xy[order, 1], score[order] > 0.0
    dx, dy = x[:, None] - x[None], y[:, None] - y[None]
    gap = jnp.sqrt(dx * dx + dy * dy)
    better = jnp.tril(jnp.ones(gap.shape, bool), -1)
    good &= ~jnp.any(better & good[None, :] & (gap < min_distance), axis=1)
    best = jnp.argsort(~good, stable=True)[:count]
    return order[best], good[best]


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


def _start(
    cells: Array, level: Level, count: int, walls: WallSegments, spec: FeatureSpec, dtype: jnp.dtype
) -> _Start:
    """Start at the marked cells with the three nearest walls in different directions."""
    x, y, found = _nearest_cells(cells, level.grid, count)
    x, y = x.astype(dtype), y.astype(dtype)
    max_cosine = math.cos(0.7 * spec.min_foot_angle)
    return x, y, nearest_three_walls(foot_points(x, y, walls), max_cosine), found


def _tangent_circles(
    cells: Array, walls: WallSegments, level: Level, spec: FeatureSpec, dtype: jnp.dtype
) -> tuple[TangentCircles, Array]:
    """Empty circles through three walls each, found from the junction cells in two rounds.

        round 1:  centre = a junction cell;  walls = the three nearest in different directions
        round 2:  centre and walls = `_neighbours` of the best circles of round 1
        each:     `_search`;  suppress duplicates

    Both rounds have C = 3 N circles, N = `spec.max_junctions`, so they are one scanned program.

    Returns:
        The best 2 N circles of both rounds, best first, and whether there is one: (2 N,) bool.
    """

    def search(start: _Start, _: None) -> tuple[_Start, tuple[TangentCircles, Array]]:
        circle, score = _search(start, walls, spec, level.scale)
        xy = jnp.stack([circle.x, circle.y], axis=1)
        best, found = _best_apart(score, xy, spec.min_separation, spec.max_junctions)
        x, y, three = _neighbours(jax.tree.map(lambda a: a[..., best], circle))
        return (x, y, three, jnp.repeat(found, 3)), (circle, score)

    start = _start(cells, level, spec.num_candidates, walls, spec, dtype)
    _, (rounds, score) = lax.scan(search, start, length=2)
    circle = jax.tree.map(lambda a: jnp.concatenate([a[0], a[1]], axis=-1), rounds)
    xy = jnp.stack([circle.x, circle.y], axis=1)
    best, found = _best_apart(score.reshape(-1), xy, spec.min_separation, 2 * spec.max_junctions)
    return jax.tree.map(lambda a: a[..., best], circle), found


def _circles_of_levels(
    cells: Sequence[Array],
    walls: WallSegments,
    levels: Sequence[Level],
    spec: FeatureSpec,
    dtype: jnp.dtype,
) -> tuple[TangentCircles, Array, np.ndarray]:
    """Empty circles of all levels: those of `_tangent_circles`, and of one round on coarser ones.

    Returns:
        The circles, whether there is one (C,) bool, and the level (C,) of each, static.
    """
    circle, found = _tangent_circles(cells[0], walls, levels[0], spec, dtype)
    parts, of_level = [(circle, found)], [0] * len(found)
    for k, (own, level) in enumerate(zip(cells[1:], levels[1:], strict=True), 1):
        start = _start(own, level, spec.max_coarse_candidates, walls, spec, dtype)
        circle, score = _search(start, walls, spec, level.scale)
        parts.append((circle, score > 0.0))
        of_level += [k] * len(score)
    circle, found = jax.tree.map(lambda *part: jnp.concatenate(part, axis=-1), *parts)
    return circle, found, np.array(of_level)


def _not_of_finer(circle: FittedCircles, levels: Sequence[Level], of_level: np.ndarray) -> Array:
    """Whether circles (C,) are beyond what the levels finer than theirs, `of_level`, can hold."""
    good = jnp.ones(circle.radius.shape, bool)
    for k, (finer, level) in enumerate(pairwise(levels)):
        x, y = circle.centre[:, 0], circle.centre[:, 1]
        held = circle.radius <= largest_radius(x, y, finer, level)
        good &= ~(jnp.asarray(of_level > k) & held)
    return good


def _is_junction(
    circle: FittedCircles,
    trace: Array,
    max_radius: Array,
    scan: Scan,
    lidar: Lidar,
    spec: FeatureSpec,
) -> Array:
    """Whether fitted circles (C,) are junctions that may be observed.

    The circle is empty of walls and of beam ends, every foot is real, the radius is within limits
    (up to `max_radius` (C,) [m]), the centre is located well (`trace` (C,) [m^2] of its covariance)
    and in sight.
    """
    good = circle.feet_real & (circle.penetration < 0.05) & (trace < 0.02)
    good &= (circle.radius > spec.min_clearance) & (circle.radius < max_radius)
    hits = jnp.where(scan.hit[:, None], beam_ends(lidar, scan), jnp.inf)
    dx, dy = (circle.centre[:, None, k] - hits[None, :, k] for k in range(2))
    clearance = jnp.sqrt(jnp.min(dx * dx + dy * dy, axis=1))
    good &= clearance > circle.radius - max(0.05, 4 * lidar.range_std)
    return good & in_free_view(lidar, circle.centre, scan.ranges)


def find_junctions(
    lidar: Lidar,
    levels: Sequence[Level],
    spec: FeatureSpec,
    cells: Sequence[Array],
    scan: Scan,
    segments: Segments,
) -> Features:
    """Junctions of a Voronoi diagram as landmarks, the most trustworthy first.

    A junction cell of the diagram leads to the circle that touches the walls nearest to it. Where
    a fourth wall nearly touches that circle too, another junction is close by, which may lie in
    the same cells: the circles in which the fourth wall replaces one of the three are searched as
    well (`_tangent_circles`).

    A junction is kept if its circle is empty, touches at least three walls in directions that
    differ, and every foot is real: no foot is an end made by occlusion or by the field of view.

    A junction belongs to the finest level that can hold it. Those of coarser levels take the slots
    that the finest leaves: they never displace one of it.

    Args:
        lidar: The scanner.
        levels: The levels of the diagram, the finest first.
        spec: Capacities and limits.
        cells: (H, W) bool of each level, its junction cells.
        scan: The scan.
        segments: Its straight segments.

    Returns:
        `spec.max_junctions` features, those of the finest level first, of kind `JUNCTION`, then
        those of coarser ones, `FAR_JUNCTION`; of each level trusted ones first; robot frame.
    """
    dtype = scan.ranges.dtype
    tangent, found, of_level = _circles_of_levels(
        cells, wall_segments(segments), levels, spec, dtype
    )
    circle = fit_circles(tangent, segments, within=spec.tangency_gate, thick=spec.wall_thickness)
    trace = jnp.trace(circle.cov, axis1=1, axis2=2)
    max_radius = spec.max_clearance * np.array([level.scale for level in levels])[of_level]
    good = found & _is_junction(circle, trace, jnp.asarray(max_radius, dtype), scan, lidar, spec)
    good &= _not_of_finer(circle, levels, of_level)
    area, certified = _seen_fraction(lidar, circle.centre, circle.radius, scan)
    trusted = (
        good
        & (area > spec.min_seen_fraction)
        & (tangent.min_angle > spec.min_foot_angle)
        & (trace < 0.005)
    )
    trusted &= (circle.radius > 1.2 * spec.min_clearance) & (
        circle.hidden_depth < spec.max_hidden_depth
    )
    # Angles are below 4: trusted junctions come first, on each level.
    rank = jnp.where(trusted, 4.0, 0.0) + tangent.min_angle
    rank += jnp.asarray(8.0 * (len(levels) - 1 - of_level), dtype)
    score = jnp.where(good, rank, 0.0).astype(dtype)
    best, good = _best_apart(score, circle.centre, spec.min_separation, spec.max_junctions)
    zero = jnp.zeros(spec.max_junctions, dtype)
    far = good & jnp.asarray(of_level > 0)[best]
    return zero_padding(
        Features(
            kind=jnp.where(far, jnp.int32(FAR_JUNCTION), jnp.int32(JUNCTION)),
            xy=circle.centre[best],
            cov=circle.cov[best],
            direction=zero,
            direction_variance=zero,
            descriptor=circle.radius[best],
            degree=circle.touched.sum(axis=0, dtype=jnp.int32)[best],
            certified=certified[best],
            trusted=trusted[best],
            valid=good,
        )
    )
