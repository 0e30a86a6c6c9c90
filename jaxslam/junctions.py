"""Junctions of the Voronoi diagram of one scan as landmarks.

A junction is the centre of a circle that touches three or more walls. The automaton finds the
cells; the circle is then fitted to the line fits of the runs, which gives it sub-cell accuracy,
and a covariance from theirs.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.circles import feet, fit, nearest_three, touch, walls_of
from jaxslam.edges import Runs
from jaxslam.geometry import unit
from jaxslam.grid import GridSpec, centre_of, corner
from jaxslam.lidar import Lidar, Scan, before_ends, points
from jaxslam.nodes import Nodes, NodeSpec, blank
from jaxslam.types import NODE, Array

BLOCK = 3  # [cells] a square of so many leads to one circle


def _nearest_cells(cells: Array, spec: GridSpec, count: int) -> tuple[Array, Array]:
    """Index (count, 2) of the marked cells of (H, W) bool that are nearest to the robot.

    One in every block of cells at most. Also whether there is one.
    """
    h, w = spec.shape
    away = np.hypot(*((np.indices((h, w)) + 0.5) * spec.cell + corner(spec)[:, None, None]))
    nearest_last = np.argsort(-away, axis=None, kind="stable").astype(np.int32)
    rank = np.empty(h * w, np.float32)
    rank[nearest_last] = np.arange(1, h * w + 1)
    key = jnp.where(cells, jnp.asarray(rank.reshape(h, w)), jnp.float32(0.0))
    key = jnp.pad(key, ((0, -h % BLOCK), (0, -w % BLOCK)))
    key = jnp.max(key.reshape(key.shape[0] // BLOCK, BLOCK, -1), axis=1)
    key = jnp.max(key.reshape(len(key), -1, BLOCK), axis=2)
    top, _ = lax.top_k(key.reshape(-1), count)
    flat = jnp.asarray(nearest_last)[jnp.maximum(top, 1.0).astype(jnp.int32) - 1]
    return jnp.stack([flat // w, flat % w], axis=-1), top > 0.0


def _part_seen(centre: Array, radius: Array, scan: Scan, lidar: Lidar) -> tuple[Array, Array]:
    """Part (C,) of the area of circles that was seen, and whether the whole rim was.

    What a scan sees is star-shaped around the robot, so it contains a disc if it contains the
    rim; five per cent of slack for where it touches the walls.
    """
    turn = jnp.linspace(-jnp.pi, jnp.pi, 24, endpoint=False, dtype=scan.ranges.dtype)
    rings = jnp.array([0.3, 0.6, 0.8, 0.95], turn.dtype)  # their weight is their radius
    offset = rings[:, None, None] * unit(turn)[None]
    places = centre[:, None, None] + radius[:, None, None, None] * offset[None]
    seen = before_ends(places, scan.ranges, lidar)  # (C, 4, 24)
    area = jnp.sum(seen.mean(axis=2, dtype=rings.dtype) * rings[None], axis=1) / jnp.sum(rings)
    return area, jnp.all(seen[:, -1], axis=1)


def _first(worth: Array, xy: Array, apart: float, count: int) -> tuple[Array, Array]:
    """Index (count,) of the places (N, 2) of greatest worth (N,), `apart` [m] from each other.

    Also whether there is one; nothing is worth 0.
    """
    order = jnp.argsort(-worth, stable=True)
    xy, good = xy[order], worth[order] > 0.0
    gap = jnp.linalg.norm(xy[:, None] - xy[None], axis=2)
    earlier = jnp.tril(jnp.ones(gap.shape, bool), -1)
    good &= ~jnp.any(earlier & good[None, :] & (gap < apart), axis=1)
    first = jnp.argsort(~good, stable=True)[:count]
    return order[first], good[first]


def find_junctions(
    cells: Array,
    scan: Scan,
    runs: Runs,
    lidar: Lidar,
    grid: GridSpec,
    spec: NodeSpec,
) -> Nodes:
    """Junctions of a Voronoi diagram as landmarks, the most trustworthy first.

    A cell of the diagram leads to the circle that touches the walls nearest to it. Where a fourth
    wall all but touches that circle too, there is another junction close by, which may lie in the
    same cells: the circles in which it takes the place of one of the three are looked at as well.

    A junction is kept when its circle is empty, touches at least three walls in directions that
    differ, and every foot is real: no foot is an end made by occlusion or by the field of view.

    Args:
        cells: (H, W) bool, the junction cells.
        scan: The scan.
        runs: Its straight runs.
        lidar: The scanner.
        grid: The grid of `cells`.
        spec: Capacities and limits.
    """
    walls = walls_of(runs)
    index, found = _nearest_cells(cells, grid, spec.candidates)
    place = centre_of(index, grid).astype(scan.ranges.dtype)
    x, y = place[:, 0], place[:, 1]
    alike = math.cos(0.7 * spec.apart)
    three = nearest_three(feet(x, y, walls), alike)

    def pursue(start: tuple[Array, Array, Array, Array], _: None):
        x, y, three, found = start
        circle = touch(x, y, three, walls, swaps=3)
        away = jnp.hypot(circle.x - x, circle.y - y)
        good = found & (circle.depth < 0.05) & (circle.spread > 0.7 * spec.apart) & (away < 1.0)
        worth = jnp.where(good, circle.spread, 0.0)
        at = jnp.stack([circle.x, circle.y], axis=1)
        first, found = _first(worth, at, spec.distinct, spec.nodes)
        some = jax.tree.map(lambda x: x[..., first], circle)
        thrice = lambda x: jnp.repeat(x, 3)
        swapped = jnp.tile(jnp.eye(3, dtype=bool), spec.nodes)  # (3, C)
        three = jnp.where(swapped, thrice(some.fourth)[None], jnp.repeat(some.three, 3, axis=1))
        return (thrice(some.x), thrice(some.y), three, thrice(found)), (circle, worth)

    _, (circle, worth) = lax.scan(pursue, (x, y, three, found), length=2)
    both = jax.tree.map(lambda x: jnp.concatenate([x[0], x[1]], axis=-1), circle)
    at = jnp.stack([both.x, both.y], axis=1)
    first, found = _first(worth.reshape(-1), at, spec.distinct, 2 * spec.nodes)
    both = jax.tree.map(lambda x: x[..., first], both)

    circle = fit(both, runs, within=spec.touch, thick=spec.thick)
    size = jnp.trace(circle.cov, axis1=1, axis2=2)
    good = found & circle.real & (circle.depth < 0.05) & (size < 0.02)
    good &= (circle.radius > spec.least) & (circle.radius < spec.most)
    hits = points(scan, lidar)
    offset = jnp.linalg.norm(circle.centre[:, None] - hits[None], axis=2)
    clearance = jnp.min(jnp.where(scan.hit[None], offset, jnp.inf), axis=1)
    good &= clearance > circle.radius - max(0.05, 4 * lidar.noise)
    good &= before_ends(circle.centre, scan.ranges, lidar)
    area, certified = _part_seen(circle.centre, circle.radius, scan, lidar)
    trusted = good & (area > spec.seen) & (both.spread > spec.apart) & (size < 0.005)
    trusted &= (circle.radius > 1.2 * spec.least) & (circle.hidden < spec.hidden)
    worths = jnp.where(good, jnp.where(trusted, 4.0, 0.0) + both.spread, 0.0)
    first, good = _first(worths.astype(place.dtype), circle.centre, spec.distinct, spec.nodes)
    zero = jnp.zeros(spec.nodes, place.dtype)
    return blank(
        Nodes(
            kind=jnp.full(spec.nodes, NODE, jnp.int32),
            xy=circle.centre[first],
            cov=circle.cov[first],
            direction=zero,
            variance=zero,
            shape=circle.radius[first],
            degree=circle.touched.sum(axis=0, dtype=jnp.int32)[first],
            certified=certified[first],
            trusted=trusted[first],
            valid=good,
        )
    )
