"""Circles that touch three walls and cut none: what the junctions of a Voronoi diagram are.

All are worked out together: walls lead (K), circles trail (C), so that sums and smallest values
over the walls run along whole rows of circles.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.edges import Runs
from jaxslam.geometry import dot
from jaxslam.types import Array

APART = 0.95  # cosine between feet; above this they may well be of one corner or wall
FLOOR = 4e-6  # [m^2] variance that a foot has besides that of its line: walls are rough by 2 mm


class Walls(NamedTuple):
    """Runs as line segments, component by component: what feet need; K walls, C places or one."""

    start: tuple[Array, Array]  # (K, C), (K, C) [m] x and y of the first end
    along: tuple[Array, Array]  # (K, C), (K, C) unit vector to the second
    size: Array  # (K, C) [m]
    valid: Array  # (K, C) bool

    def of(self, index: Array) -> "Walls":
        """The walls with index (N, C), for each place its own; of walls that are one's for all."""
        return jax.tree.map(lambda x: x[:, 0][index], self)


class Feet(NamedTuple):
    """Nearest point of each wall, seen from each place."""

    distance: Array  # (K, C) [m] to the wall, infinite for padding
    toward: tuple[Array, Array]  # (K, C), (K, C) unit vector to the foot
    part: Array  # (K, C) [m] where the foot lies, from the first end


class Touching(NamedTuple):
    """Circles and the three walls each touches."""

    x: Array  # (C,) [m] centre, robot frame
    y: Array  # (C,) [m]
    radius: Array  # (C,) [m]
    three: Array  # (3, C) int32 the walls
    depth: Array  # (C,) [m] by which the nearest wall reaches into the circle
    spread: Array  # (C,) [rad] smallest angle between two of the three feet
    fourth: Array  # (C,) int32 nearest wall that none of the three stands for


class Circles(NamedTuple):
    """Circles fitted to all walls that they touch."""

    centre: Array  # (C, 2) [m] robot frame
    radius: Array  # (C,) [m]
    cov: Array  # (C, 2, 2) [m^2] of the centre
    depth: Array  # (C,) [m] by which the nearest wall reaches into the circle
    touched: Array  # (K, C) bool
    real: Array  # (C,) bool, every foot is one
    hidden: Array  # (C,) [m] by which walls may reach into the circle behind ends in sight


def walls_of(runs: Runs) -> Walls:
    """The segments of runs, (K, 1)."""
    start, end = runs.ends[:, 0], runs.ends[:, 1]
    gap = end - start
    size = jnp.sqrt(jnp.maximum(dot(gap, gap), 1e-12))
    along = gap / size[:, None]
    own = start[:, :1], start[:, 1:], along[:, :1], along[:, 1:]
    return Walls((own[0], own[1]), (own[2], own[3]), size[:, None], runs.valid[:, None])


def feet(x: Array, y: Array, walls: Walls) -> Feet:
    """Feet of walls (K, C) seen from places x, y (C,) [m, robot frame]."""
    (sx, sy), (ax, ay) = walls.start, walls.along
    x, y = x[None], y[None]
    part = jnp.clip((x - sx) * ax + (y - sy) * ay, 0.0, walls.size)
    dx, dy = sx + part * ax - x, sy + part * ay - y
    distance = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-8))
    toward = dx / distance, dy / distance
    return Feet(jnp.where(walls.valid, distance, jnp.inf), toward, part)


def nearest(distance: Array) -> Array:
    """Index (C,) int32 of the smallest of each column of (K, C), the first of equal ones."""
    index = jnp.arange(len(distance), dtype=jnp.int32)[:, None]
    least = jnp.min(distance, axis=0, keepdims=True)
    return jnp.min(jnp.where(distance <= least, index, len(distance) - 1), axis=0)


def _cosine(toward: tuple[Array, Array], k: Array) -> Array:
    """Cosines (K, C) of the angles to the feet with index k (C,)."""
    tx, ty = toward
    of_k = (jnp.arange(len(tx), dtype=jnp.int32)[:, None] == k[None]).astype(tx.dtype)
    kx, ky = jnp.sum(of_k * tx, axis=0), jnp.sum(of_k * ty, axis=0)
    return tx * kx[None] + ty * ky[None]


def nearest_three(f: Feet, alike: float) -> Array:
    """Index (3, C) of the nearest walls in directions whose cosines are less than `alike`."""
    first = nearest(f.distance)
    near_first = _cosine(f.toward, first)
    second = nearest(jnp.where(near_first < alike, f.distance, jnp.inf))
    near_both = jnp.maximum(near_first, _cosine(f.toward, second))
    third = nearest(jnp.where(near_both < alike, f.distance, jnp.inf))
    return jnp.stack([first, second, third])


def _newton(x: Array, y: Array, three: Walls) -> tuple[Array, Array, Feet]:
    """Centres of the circles that touch three walls (3, C), by Newton's method, and their feet."""
    f = feet(x, y, three)
    for _ in range(4):
        (tx, ty), d = f.toward, f.distance
        # Moving by (u, v) makes distance k shorter by toward_k . (u, v); all three become equal.
        ux, uy, gap = tx[1:] - tx[:1], ty[1:] - ty[:1], d[1:] - d[:1]
        sine = ux[0] * uy[1] - ux[1] * uy[0]
        sine = jnp.where(jnp.abs(sine) > 1e-4, sine, 1e-4)
        x = x + jnp.clip((gap[0] * uy[1] - gap[1] * uy[0]) / sine, -0.4, 0.4)
        y = y + jnp.clip((ux[0] * gap[1] - ux[1] * gap[0]) / sine, -0.4, 0.4)
        f = feet(x, y, three)
    return x, y, f


def touch(x: Array, y: Array, three: Array, walls: Walls, *, swaps: int) -> Touching:
    """Circles near x, y (C,) [m] that touch three walls (3, C) and cut none.

    While another wall reaches into a circle, it takes the place of the one most like it.

    Args:
        x: First guess of the centre, robot frame.
        y: Likewise.
        three: Index of the walls to begin with.
        walls: (K, 1) all walls.
        swaps: How often walls may take the place of others.
    """
    index = jnp.arange(len(walls.size), dtype=jnp.int32)[:, None]

    def step(now: tuple[Array, Array, Array]):
        x, y, three = now
        x, y, own = _newton(x, y, walls.of(three))
        every = feet(x, y, walls)
        radius = jnp.mean(own.distance, axis=0)
        chosen = (index == three[:1]) | (index == three[1:2]) | (index == three[2:])
        rest = jnp.where(chosen, jnp.inf, every.distance)
        inner, depth = nearest(rest), radius - jnp.min(rest, axis=0)
        (tx, ty), (ox, oy) = every.toward, own.toward
        like = [tx * ox[k][None] + ty * oy[k][None] for k in range(3)]  # (K, C) each
        at_inner = index == inner[None]
        of_inner = [jnp.sum(jnp.where(at_inner, cosine, 0.0), axis=0) for cosine in like]
        alike = nearest(-jnp.stack(of_inner))
        swap = (jnp.arange(3, dtype=jnp.int32)[:, None] == alike[None]) & (depth > 1e-3)[None]
        most = jnp.maximum(jnp.maximum(like[0], like[1]), like[2])
        fourth = nearest(jnp.where(most < APART, rest, jnp.inf))
        between = [ox[i] * ox[j] + oy[i] * oy[j] for i, j in ((0, 1), (1, 2), (2, 0))]
        cosine = jnp.maximum(jnp.maximum(between[0], between[1]), between[2])
        done = Touching(x, y, radius, three, depth, cosine, fourth)
        return (x, y, jnp.where(swap, inner[None], three)), done

    zero = jnp.zeros_like(x)
    none = Touching(x, y, zero, three, zero, zero, jnp.zeros_like(three[0]))
    now = (x, y, three), none
    (_, last), _ = lax.scan(lambda now, _: (step(now[0]), None), now, length=swaps + 1)
    return last._replace(spread=jnp.arccos(jnp.clip(last.spread, -0.9999, 0.9999)))


def _variance(f: Feet, walls: Walls, runs: Runs) -> Array:
    """Variance (K, C) [m^2] of the distances to the feet."""
    (tx, ty), (sx, sy), (ax, ay) = f.toward, walls.start, walls.along

    def of_end(cov: Array) -> Array:  # (K, 2, 2)
        xx, xy, yy = cov[:, :1, 0], cov[:, :1, 1], cov[:, 1:, 1]
        return tx * tx * xx + 2 * tx * ty * xy + ty * ty * yy

    centre = (runs.centre[:, :1] - sx) * ax + (runs.centre[:, 1:] - sy) * ay
    inside = runs.offset_variance[:, None] + (f.part - centre) ** 2 * runs.angle_variance[:, None]
    at_start = of_end(runs.end_cov[:, 0])
    at_end = jnp.where(f.part <= 0.0, at_start, of_end(runs.end_cov[:, 1]))
    return jnp.where((f.part > 0.0) & (f.part < walls.size), inside, at_end) + FLOOR


def _hidden(x: Array, y: Array, radius: Array, runs: Runs, thick: float) -> Array:
    """By how much [m] walls may reach into circles (C,) behind the ends of runs.

    Behind an end that hides what is further away a wall may go on along the line of sight, by its
    thickness.
    """
    end = runs.ends.reshape(-1, 2)
    away = jnp.sqrt(jnp.maximum(dot(end, end), 1e-12))[:, None]
    ex, ey = end[:, :1], end[:, 1:]
    sx, sy = ex / away, ey / away
    behind = jnp.clip((x[None] - ex) * sx + (y[None] - ey) * sy, 0.0, thick)
    gx, gy = ex + behind * sx - x[None], ey + behind * sy - y[None]
    away = jnp.sqrt(jnp.maximum(gx * gx + gy * gy, 1e-12))
    counts = (runs.sharp & runs.valid[:, None]).reshape(-1, 1)
    return jnp.max(jnp.where(counts, radius[None] - away, 0.0), axis=0)


def fit(start: Touching, runs: Runs, *, within: float, thick: float) -> Circles:
    """Fit circles to all walls that touch them within their errors, weighed by these.

    By the implicit function theorem the covariance of centre and radius is (A^T W A)^-1, A having
    the rows (toward the foot, 1) and W the inverse variances of the distances.

    Args:
        start: The circles, through three walls each.
        runs: The runs that are the walls.
        within: Standard deviations from the circle within which a wall touches it.
        thick: [m] of walls, as far as they may hide themselves.
    """
    walls, x, y, radius, three = walls_of(runs), start.x, start.y, start.radius, start.three
    f = feet(x, y, walls)
    index = jnp.arange(len(walls.size), dtype=jnp.int32)[:, None]
    variance = _variance(f, walls, runs)
    touched = jnp.abs(f.distance - radius[None]) < within * jnp.sqrt(variance)
    own = [_cosine(f.toward, k) for k in three]
    touched &= jnp.maximum(jnp.maximum(own[0], own[1]), own[2]) < APART
    touched |= (index == three[:1]) | (index == three[1:2]) | (index == three[2:])
    touched &= walls.valid
    w = lax.stop_gradient(jnp.where(touched, 1.0 / variance, 0.0))
    total = jnp.maximum(jnp.sum(w, axis=0), 1e-9)

    def step(now: tuple[Array, Array, Array], _: None):
        x, y, radius = now
        f = feet(x, y, walls)
        (tx, ty), off = f.toward, jnp.where(touched, f.distance - radius[None], 0.0)
        mx, my, mo = (jnp.sum(w * v, axis=0) / total for v in (tx, ty, off))
        dx, dy, do = tx - mx[None], ty - my[None], off - mo[None]
        xx, xy, yy, bx, by = (
            jnp.sum(w * v, axis=0) for v in (dx * dx, dx * dy, dy * dy, dx * do, dy * do)
        )
        area = jnp.maximum(xx * yy - xy * xy, 1e-6 * (xx * xx + yy * yy) + 1e-9)
        u = jnp.clip((yy * bx - xy * by) / area, -0.3, 0.3)
        v = jnp.clip((xx * by - xy * bx) / area, -0.3, 0.3)
        cov = yy / area, -xy / area, xx / area
        return (x + u, y + v, radius + mo - mx * u - my * v), cov

    (x, y, radius), cov = lax.scan(step, (x, y, radius), length=2)
    xx, xy, yy = (c[-1] for c in cov)
    f = feet(x, y, walls)
    at_end = jnp.where(f.part <= 0.0, runs.real[:, :1], runs.real[:, 1:])
    real = at_end | ((f.part > 0.0) & (f.part < walls.size))
    return Circles(
        centre=jnp.stack([x, y], axis=-1),
        radius=radius,
        cov=jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], axis=-1),
        depth=radius - jnp.min(f.distance, axis=0),
        touched=touched,
        real=jnp.all(real | ~touched, axis=0),
        hidden=_hidden(x, y, radius, runs, thick),
    )
