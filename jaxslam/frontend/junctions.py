"""Junctions of the Voronoi diagram of one scan as landmarks.

A junction is the centre of an empty circle that touches three or more walls. The automaton finds
the cells; the circle is then fitted to the line fits of the straight segments, which gives it
sub-cell accuracy, and a covariance from theirs.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.features import Features, zero_padding
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import unit_vector
from jaxslam.core.types import JUNCTION, Array
from jaxslam.frontend.circle_fitting import FittedCircles, fit_circles
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import GridSpec, centre_of, grid_origin
from jaxslam.frontend.lidar import beam_ends, in_free_view
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

CELLS_PER_START = 3
"""Junction cells that are looked at for each circle that may start: most are of one junction."""

MAX_STEP, MAX_TRUSTED_STEP = 0.08, 0.05
"""[m] Beam ends of rough walls may be so far inside the circle of a junction, of a trusted one."""

SAME_START = 0.4
"""[m] Of two cells nearer to each other than this, with the same nearest walls, one starts."""


def _num_blocks(spec: GridSpec) -> int:
    """Number of blocks of a grid."""
    height, width = spec.shape
    return math.ceil(height / BLOCK) * math.ceil(width / BLOCK)


def _nearest_cells(cells: Array, spec: GridSpec, count: int) -> tuple[Array, Array]:
    """The marked cells nearest to the robot, one of each block of `BLOCK` x `BLOCK` at most.

    Cells are ranked by nearness once, in NumPy; the largest rank of each block is left to sort.

    Args:
        cells: (H, W) bool, the marked cells.
        spec: Their grid.
        count: Number of cells wanted.

    Returns:
        Index (count, 2) of the cells, nearest first, and whether there is one: (count,) bool.
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
    top, _ = lax.top_k(key.reshape(-1), count)
    flat = jnp.asarray(nearest_last)[jnp.maximum(top, 1.0).astype(jnp.int32) - 1]
    return jnp.stack([flat // width, flat % width], axis=-1), top > 0.0


def _seen_fraction(lidar: Lidar, centre: Array, radius: Array, scan: Scan) -> tuple[Array, Array]:
    """Fraction (C,) of the area of circles that was seen, and whether (C,) the whole disc was.

    The visible region is star-shaped around the robot, so it contains a disc if it contains the
    rim. The rim is sampled at 95 % of the radius: the circle itself touches the walls.
    """
    turn = jnp.linspace(-jnp.pi, jnp.pi, 24, endpoint=False, dtype=scan.ranges.dtype)
    rings = jnp.array([0.3, 0.6, 0.8, 0.95], turn.dtype)  # fractions of the radius, and weights
    offset = rings[:, None, None] * unit_vector(turn)[None]
    samples = centre[:, None, None] + radius[:, None, None, None] * offset[None]
    seen = in_free_view(lidar, samples, scan.ranges)  # (C, 4, 24)
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
    xy, good = xy[order], score[order] > 0.0
    gap = jnp.linalg.norm(xy[:, None] - xy[None], axis=2)
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


def _starts(
    cells: Array, walls: WallSegments, grid: GridSpec, spec: FeatureSpec, dtype: jnp.dtype
) -> _Start:
    """Where to search for junctions: `spec.num_candidates` cells, each with its nearest walls.

    A junction marks several cells, and in clutter most junctions are too close to walls. Of the
    nearest `CELLS_PER_START` times as many cells, those are left out whose clearance is out of
    limits by more than a cell, and those with the three nearest walls of a cell close by.
    """
    found_cells, blocks = CELLS_PER_START * spec.num_candidates, _num_blocks(grid)
    index, found = _nearest_cells(cells, grid, min(found_cells, blocks))
    xy = centre_of(grid, index).astype(dtype)
    x, y = xy[:, 0], xy[:, 1]
    foot = foot_points(x, y, walls)
    three = nearest_three_walls(foot, math.cos(0.7 * spec.min_foot_angle))
    clearance = jnp.min(foot.distance, axis=0)
    found &= clearance > spec.min_clearance - grid.cell_size
    found &= clearance < spec.max_clearance + grid.cell_size
    walls_of = jnp.sort(three, axis=0)
    same = jnp.all(walls_of[:, :, None] == walls_of[:, None], axis=0)
    same &= jnp.hypot(x[:, None] - x[None], y[:, None] - y[None]) < SAME_START
    found &= ~jnp.any(jnp.tril(same, -1) & found[None], axis=1)
    first = jnp.argsort(~found, stable=True)[: spec.num_candidates]
    return x[first], y[first], three[:, first], found[first]


def _tangent_circles(
    cells: Array, walls: WallSegments, grid: GridSpec, spec: FeatureSpec, dtype: jnp.dtype
) -> tuple[TangentCircles, Array]:
    """Empty circles through three walls each, found from the junction cells in two rounds.

        round 1:  centre and walls = `_starts`: a junction cell, the three nearest walls in
                  different directions
        round 2:  centre and walls = `_neighbours` of the best circles of round 1
        each:     solve and exchange walls (`tangent_circles`);
                  drop circles that a wall cuts, whose feet are close together, or that moved > 1 m;
                  score = smallest angle between two feet;  suppress duplicates

    Both rounds have C = 3 N circles, N = `spec.max_junctions`, so they are one scanned program.

    Returns:
        The best 2 N circles of both rounds, best first, and whether there is one: (2 N,) bool.
    """

    def search(start: _Start, _: None) -> tuple[_Start, tuple[TangentCircles, Array]]:
        x, y, three, found = start
        circle = tangent_circles(x, y, three, walls, swaps=3)
        moved = jnp.hypot(circle.x - x, circle.y - y)
        good = (
            found
            & (circle.penetration < 0.05)
            & (circle.min_angle > 0.7 * spec.min_foot_angle)
            & (moved < 1.0)
        )
        score = jnp.where(good, circle.min_angle, 0.0)
        xy = jnp.stack([circle.x, circle.y], axis=1)
        best, found = _best_apart(score, xy, spec.min_separation, spec.max_junctions)
        x, y, three = _neighbours(jax.tree.map(lambda a: a[..., best], circle))
        return (x, y, three, jnp.repeat(found, 3)), (circle, score)

    start = _starts(cells, walls, grid, spec, dtype)
    _, (rounds, score) = lax.scan(search, start, length=2)
    circle = jax.tree.map(lambda a: jnp.concatenate([a[0], a[1]], axis=-1), rounds)
    xy = jnp.stack([circle.x, circle.y], axis=1)
    best, found = _best_apart(score.reshape(-1), xy, spec.min_separation, 2 * spec.max_junctions)
    return jax.tree.map(lambda a: a[..., best], circle), found


def _intrusion(circle: FittedCircles, scan: Scan, lidar: Lidar) -> Array:
    """Depth (C,) [m] to which beam ends are inside circles; negative if none is."""
    hits = beam_ends(lidar, scan)
    offset = jnp.linalg.norm(circle.centre[:, None] - hits[None], axis=2)
    return circle.radius - jnp.min(jnp.where(scan.hit[None], offset, jnp.inf), axis=1)


def _is_junction(
    circle: FittedCircles,
    trace: Array,
    intrusion: Array,
    scan: Scan,
    lidar: Lidar,
    spec: FeatureSpec,
) -> Array:
    """Whether fitted circles (C,) are junctions that may be observed.

    The circle is empty of walls and, but for the steps of a rough wall, of beam ends (`intrusion`
    (C,) [m]); every foot is real, the radius is within limits, the centre is located well (`trace`
    (C,) [m^2] of its covariance) and in sight.
    """
    good = circle.feet_real & (circle.penetration < 0.05) & (trace < 0.02)
    good &= (circle.radius > spec.min_clearance) & (circle.radius < spec.max_clearance)
    good &= intrusion < max(MAX_STEP, 4 * lidar.range_std)
    return good & in_free_view(lidar, circle.centre, scan.ranges)


def find_junctions(
    lidar: Lidar,
    grid: GridSpec,
    spec: FeatureSpec,
    cells: Array,
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

    Args:
        lidar: The scanner.
        grid: The grid of `cells`.
        spec: Capacities and limits.
        cells: (H, W) bool, the junction cells.
        scan: The scan.
        segments: Its straight segments.

    Returns:
        `spec.max_junctions` features of kind `JUNCTION`, trusted ones first, then those whose
        circle was seen; robot frame.
    """
    dtype = scan.ranges.dtype
    tangent, found = _tangent_circles(cells, wall_segments(segments), grid, spec, dtype)
    circle = fit_circles(tangent, segments, within=spec.tangency_gate, thick=spec.wall_thickness)
    trace = jnp.trace(circle.cov, axis1=1, axis2=2)
    intrusion = _intrusion(circle, scan, lidar)
    good = found & _is_junction(circle, trace, intrusion, scan, lidar, spec)
    area, certified = _seen_fraction(lidar, circle.centre, circle.radius, scan)
    trusted = (
        good
        & (area > spec.min_seen_fraction)
        & (tangent.min_angle > spec.min_foot_angle)
        & (trace < 0.005)
    )
    trusted &= intrusion < max(MAX_TRUSTED_STEP, 4 * lidar.range_std)
    trusted &= (circle.radius > 1.2 * spec.min_clearance) & (
        circle.hidden_depth < spec.max_hidden_depth
    )
    # Angles are below 4: trusted junctions come first, then those that were seen.
    tier = 4.0 * (trusted.astype(dtype) + (area > spec.min_seen_fraction).astype(dtype))
    score = jnp.where(good, tier + tangent.min_angle, 0.0).astype(dtype)
    best, good = _best_apart(score, circle.centre, spec.min_separation, spec.max_junctions)
    zero = jnp.zeros(spec.max_junctions, dtype)
    return zero_padding(
        Features(
            kind=jnp.full(spec.max_junctions, JUNCTION, jnp.int32),
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
