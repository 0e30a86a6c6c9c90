"""Junctions of the Voronoi diagram of one scan as landmarks.

A junction is the centre of a circle that touches three or more walls. The automaton finds the
cell; the circle is then fitted to the line fits of the runs, which gives it sub-cell accuracy,
and a covariance from theirs.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.edges import Runs
from jaxslam.geometry import dot, unit
from jaxslam.grid import GridSpec, centre_of, corner
from jaxslam.lidar import Lidar, Scan, before_ends, points
from jaxslam.nodes import Nodes, NodeSpec, blank
from jaxslam.types import NODE, Array


class Walls(NamedTuple):
    """Runs as line segments, component by component: what feet need; leading axes broadcast."""

    start: tuple[Array, Array]  # (K,), (K,) [m] x and y of the first end
    along: tuple[Array, Array]  # (K,), (K,) unit vector to the second
    size: Array  # (K,) [m]
    valid: Array  # (K,) bool


class Feet(NamedTuple):
    """Nearest point of each wall, seen from one place."""

    distance: Array  # (K,) [m] to the wall, infinite for padding
    toward: tuple[Array, Array]  # (K,), (K,) unit vector to the foot
    part: Array  # (K,) [m] where the foot lies, from the first end


def walls_of(runs: Runs) -> Walls:
    """The segments of runs."""
    start, end = runs.ends[:, 0], runs.ends[:, 1]
    gap = end - start
    size = jnp.sqrt(jnp.maximum(dot(gap, gap), 1e-12))
    along = gap / size[:, None]
    return Walls((start[:, 0], start[:, 1]), (along[:, 0], along[:, 1]), size, runs.valid)


def feet(x: Array, y: Array, walls: Walls) -> Feet:
    """Feet of all walls seen from a place x, y () [m, robot frame]."""
    (sx, sy), (ax, ay) = walls.start, walls.along
    part = jnp.clip((x - sx) * ax + (y - sy) * ay, 0.0, walls.size)
    dx, dy = sx + part * ax - x, sy + part * ay - y
    distance = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-8))
    toward = dx / distance, dy / distance
    return Feet(jnp.where(walls.valid, distance, jnp.inf), toward, part)


class Circle(NamedTuple):
    """A circle that touches walls and cuts none."""

    centre: Array  # (2,) [m] robot frame
    radius: Array  # () [m]
    cov: Array  # (2, 2) [m^2] of the centre
    depth: Array  # () [m] by which the nearest wall reaches into the circle
    spread: Array  # () [rad] smallest angle between the three feet that differ most
    touched: Array  # (K,) bool
    real: Array  # () bool, every foot is one
    hidden: Array  # () [m] by which walls may reach into the circle behind ends in sight


def _three(f: Feet, near: Array) -> tuple[Array, Array]:
    """Indices (3,) of the feet that differ most of those `near` (K,), and the cosine between them.

    The first is the nearest. The cosine () is that of the smallest angle between two of them.
    """
    tx, ty = f.toward
    a = jnp.argmin(jnp.where(near, f.distance, jnp.inf))
    from_a = jnp.where(near, tx * tx[a] + ty * ty[a], 2.0)
    b = jnp.argmin(from_a)
    from_both = jnp.where(near, jnp.maximum(from_a, tx * tx[b] + ty * ty[b]), 2.0)
    c = jnp.argmin(from_both)
    return jnp.stack([a, b, c]), jnp.maximum(from_both[c], from_a[b])


def _touch_three(x: Array, y: Array, three: Walls) -> tuple[Array, Array, Array]:
    """Circle (x, y, radius) that touches three walls, by Newton's method from x, y."""
    for _ in range(4):
        f = feet(x, y, three)
        (tx, ty), d = f.toward, f.distance
        # Moving by (u, v) makes distance k shorter by toward_k . (u, v); all three become equal.
        ux, uy, gap = tx[1:] - tx[0], ty[1:] - ty[0], d[1:] - d[0]
        sine = ux[0] * uy[1] - ux[1] * uy[0]
        sine = jnp.where(jnp.abs(sine) > 1e-4, sine, 1e-4)
        x = x + jnp.clip((gap[0] * uy[1] - gap[1] * uy[0]) / sine, -0.4, 0.4)
        y = y + jnp.clip((ux[0] * gap[1] - ux[1] * gap[0]) / sine, -0.4, 0.4)
    return x, y, jnp.mean(feet(x, y, three).distance)


def _variance(f: Feet, walls: Walls, runs: Runs) -> Array:
    """Variance (K,) [m^2] of the distances to the feet."""
    (tx, ty), (sx, sy), (ax, ay) = f.toward, walls.start, walls.along
    of_end = [
        tx * tx * c[:, 0, 0] + 2 * tx * ty * c[:, 0, 1] + ty * ty * c[:, 1, 1]
        for c in (runs.end_cov[:, 0], runs.end_cov[:, 1])
    ]
    centre = (runs.centre[:, 0] - sx) * ax + (runs.centre[:, 1] - sy) * ay
    inside = runs.line_variance(f.part - centre)
    at_end = jnp.where(f.part <= 0.0, of_end[0], of_end[1])
    return jnp.where((f.part > 0.0) & (f.part < walls.size), inside, at_end) + 4e-6


def _hidden(x: Array, y: Array, radius: Array, runs: Runs, thick: float) -> Array:
    """By how much [m] walls may reach into the circle behind the ends of runs.

    Behind an end that hides what is further away a wall may go on along the line of sight, by its
    thickness.
    """
    ex, ey = runs.ends[..., 0], runs.ends[..., 1]  # (K, 2)
    away = jnp.sqrt(jnp.maximum(ex * ex + ey * ey, 1e-12))
    sx, sy = ex / away, ey / away
    behind = jnp.clip((x - ex) * sx + (y - ey) * sy, 0.0, thick)
    gx, gy = ex + behind * sx - x, ey + behind * sy - y
    nearest = jnp.sqrt(jnp.maximum(gx * gx + gy * gy, 1e-12))
    counts = runs.sharp & runs.valid[:, None]
    return jnp.max(jnp.where(counts, radius - nearest, 0.0))


def tangent_circle(place: Array, near: Array, runs: Runs, spec: NodeSpec) -> Circle:
    """Fit the circle that touches three walls near `place` (2,) [m, robot frame] and cuts none.

    Three of the walls that are `near` (K,), in directions that differ, define the circle; while
    another wall reaches into it, that one takes the place of the one most like it. At last all
    walls that touch this circle within their errors are fitted, weighed by these errors. By the
    implicit function theorem the covariance of centre and radius is then (A^T W A)^-1, A having
    the rows (toward the foot, 1) and W the inverse variances of the distances.
    """
    walls = walls_of(runs)
    x, y = place[0], place[1]
    f = feet(x, y, walls)
    three, cosine = _three(f, near & runs.valid)
    # Two walls that end in one corner are one to the circle: the nearest other joins in.
    tx, ty = f.toward
    like = lambda k: tx * tx[k] + ty * ty[k]
    beside = jnp.maximum(jnp.maximum(like(three[0]), like(three[1])), like(three[2]))
    other = jnp.argmin(jnp.where(runs.valid & (beside < 0.95), f.distance, jnp.inf))
    more = near | ((jnp.arange(near.size) == other) & (cosine > 0.98))
    three = _three(f, more & runs.valid)[0]

    def settle(now, _):
        x, y, _, three = now
        x, y, radius = _touch_three(x, y, jax.tree.map(lambda v: v[three], walls))
        f = feet(x, y, walls)
        index = jnp.arange(near.size)
        chosen = (index == three[0]) | (index == three[1]) | (index == three[2])
        inner = jnp.argmin(jnp.where(chosen, jnp.inf, f.distance))
        tx, ty = f.toward
        alike = jnp.argmax(tx[three] * tx[inner] + ty[three] * ty[inner])
        swap = (jnp.arange(3) == alike) & (f.distance[inner] < radius - 1e-3)
        return (x, y, radius, jnp.where(swap, inner, three)), None

    (x, y, radius, three), _ = lax.scan(settle, (x, y, jnp.zeros_like(x), three), length=4)
    f = feet(x, y, walls)
    index = jnp.arange(near.size)
    chosen = (index == three[0]) | (index == three[1]) | (index == three[2])
    variance = _variance(f, walls, runs)
    touched = chosen | (jnp.abs(f.distance - radius) < spec.touch * jnp.sqrt(variance))
    touched &= runs.valid
    w = lax.stop_gradient(jnp.where(touched, 1.0 / variance, 0.0))
    for _ in range(2):
        (tx, ty), off = f.toward, jnp.where(touched, f.distance - radius, 0.0)
        total = jnp.maximum(jnp.sum(w), 1e-9)
        mean = lambda v, total=total: jnp.sum(w * v) / total
        mx, my, mo = mean(tx), mean(ty), mean(off)
        dx, dy = tx - mx, ty - my
        xx, xy, yy = jnp.sum(w * dx * dx), jnp.sum(w * dx * dy), jnp.sum(w * dy * dy)
        bx, by = jnp.sum(w * dx * (off - mo)), jnp.sum(w * dy * (off - mo))
        area = jnp.maximum(xx * yy - xy * xy, 1e-6 * (xx * xx + yy * yy) + 1e-9)
        u, v = (yy * bx - xy * by) / area, (xx * by - xy * bx) / area
        u, v = jnp.clip(u, -0.3, 0.3), jnp.clip(v, -0.3, 0.3)
        radius = radius + mo - mx * u - my * v
        x, y = x + u, y + v
        f = feet(x, y, walls)
    cov = jnp.stack([jnp.stack([yy, -xy]), jnp.stack([-xy, xx])]) / area
    at_end = jnp.where(f.part <= 0.0, runs.real[:, 0], runs.real[:, 1])
    real = at_end | ((f.part > 0.0) & (f.part < walls.size))
    return Circle(
        centre=jnp.stack([x, y]),
        radius=radius,
        cov=cov,
        depth=radius - jnp.min(f.distance),
        spread=jnp.arccos(jnp.clip(_three(f, touched)[1], -0.9999, 0.9999)),
        touched=touched,
        real=jnp.all(real | ~touched),
        hidden=_hidden(x, y, radius, runs, spec.thick),
    )


def _peaks(cells: Array, spec: GridSpec, count: int) -> tuple[Array, Array]:
    """Index (count, 2) of groups of cells (H, W) bool, the nearest to the robot first.

    Of marked cells next to each other the nearest stands for all.
    """
    h, w = cells.shape
    away = np.hypot(*((np.indices(spec.shape) + 0.5) * spec.cell + corner(spec)[:, None, None]))
    by_rank = np.argsort(-away, axis=None, kind="stable")
    rank = np.empty(h * w, np.float32)
    rank[by_rank] = np.arange(1, h * w + 1)
    key = jnp.where(cells, jnp.asarray(rank.reshape(h, w)), jnp.float32(0.0))
    p = jnp.pad(key, 1)
    rows = jnp.maximum(jnp.maximum(p[:-2], p[2:]), p[1:-1])
    best = jnp.maximum(jnp.maximum(rows[:, :-2], rows[:, 2:]), rows[:, 1:-1])
    peaks = _halve(jnp.where(key == best, key, 0.0))  # one at most in every 2 x 2
    top, _ = lax.top_k(peaks.reshape(-1), count)
    flat = jnp.asarray(by_rank.astype(np.int32))[jnp.maximum(top, 1.0).astype(jnp.int32) - 1]
    return jnp.stack([flat // w, flat % w], axis=-1), top > 0.0


def _halve(x: Array) -> Array:
    """Largest value of each 2 x 2 block of (H, W)."""
    x = jnp.pad(x, ((0, x.shape[0] % 2), (0, x.shape[1] % 2)))
    x = jnp.maximum(x[::2], x[1::2])
    return jnp.maximum(x[:, ::2], x[:, 1::2])


def _part_seen(circle: Circle, scan: Scan, lidar: Lidar) -> tuple[Array, Array]:
    """Part () of the area of a circle that was seen, and whether its whole rim was.

    What a scan sees is star-shaped around the robot, so it contains the disc if it contains the
    rim; five per cent of slack for where it touches the walls.
    """
    turn = jnp.linspace(-jnp.pi, jnp.pi, 24, endpoint=False, dtype=scan.ranges.dtype)
    rings = jnp.array([0.3, 0.6, 0.8, 0.95], turn.dtype)  # their weight is their radius
    offset = circle.radius * rings[:, None, None] * unit(turn)[None]
    places = circle.centre[None] + offset.reshape(-1, 2)
    seen = before_ends(places, scan.ranges, lidar).reshape(len(rings), -1)
    area = jnp.sum(seen.mean(axis=1, dtype=rings.dtype) * rings) / jnp.sum(rings)
    return area, jnp.all(seen[-1])


def find_junctions(
    cells: Array,
    labels: Array | None,
    scan: Scan,
    runs: Runs,
    lidar: Lidar,
    grid: GridSpec,
    spec: NodeSpec,
) -> Nodes:
    """Junctions of a Voronoi diagram as landmarks, the most trustworthy first.

    A junction is kept when its circle is empty, touches at least three walls in directions that
    differ, and every foot is real: no foot is an end made by occlusion or by the field of view.

    Args:
        cells: (H, W) bool, the junction cells.
        labels: (H, W) bit sets, the runs that meet around each cell; None if labels are not runs.
        scan: The scan.
        runs: Its straight runs.
        lidar: The scanner.
        grid: The grid of `cells`.
        spec: Capacities and limits.
    """
    index, found = _peaks(cells, grid, spec.candidates)
    place = centre_of(index, grid)
    if labels is None:
        walls = walls_of(runs)
        away = jax.vmap(lambda at: feet(at[0], at[1], walls).distance)(place)
        near = away < jnp.min(away, axis=1, keepdims=True) + 0.3
    else:
        bits = labels[index[:, 0], index[:, 1]]
        run = jnp.arange(runs.valid.size, dtype=bits.dtype)
        near = (bits[:, None] >> run[None]) & 1 > 0
    circle = jax.vmap(tangent_circle, in_axes=(0, 0, None, None))(place, near, runs, spec)
    size = jnp.trace(circle.cov, axis1=1, axis2=2)
    good = found & circle.real & (circle.spread > 0.7 * spec.apart) & (circle.depth < 0.05)
    good &= (circle.radius > spec.least) & (circle.radius < spec.most) & (size < 0.02)
    good &= jnp.linalg.norm(circle.centre - place, axis=1) < 1.0
    # Several cells may lead to one circle.
    order = jnp.argsort(-jnp.where(good, circle.spread, 0.0), stable=True)
    centre, good = circle.centre[order], good[order]
    gap = jnp.linalg.norm(centre[:, None] - centre[None], axis=2)
    earlier = jnp.tril(jnp.ones(gap.shape, bool), -1)
    good &= ~jnp.any(earlier & good[None, :] & (gap < spec.distinct), axis=1)
    first = jnp.argsort(~good, stable=True)[: spec.nodes]
    order, good = order[first], good[first]
    circle, size = jax.tree.map(lambda x: x[order], (circle, size))
    hits = points(scan, lidar)
    offset = jnp.linalg.norm(circle.centre[:, None] - hits[None], axis=2)
    clearance = jnp.min(jnp.where(scan.hit, offset, jnp.inf), axis=1)
    good &= clearance > circle.radius - max(0.05, 4 * lidar.noise)
    good &= before_ends(circle.centre, scan.ranges, lidar)
    area, certified = jax.vmap(_part_seen, in_axes=(0, None, None))(circle, scan, lidar)
    trusted = good & (area > spec.seen) & (circle.spread > spec.apart) & (size < 0.005)
    trusted &= (circle.radius > 1.2 * spec.least) & (circle.hidden < spec.hidden)
    zero = jnp.zeros(spec.nodes, place.dtype)
    return blank(
        Nodes(
            kind=jnp.full(spec.nodes, NODE, jnp.int32),
            xy=circle.centre,
            cov=circle.cov,
            direction=zero,
            variance=zero,
            shape=circle.radius,
            degree=circle.touched.sum(axis=1, dtype=jnp.int32),
            certified=certified,
            trusted=trusted,
            valid=good,
        )
    )
