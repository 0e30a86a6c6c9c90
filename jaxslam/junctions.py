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
from jaxslam.geometry import dot, unit, wrap_angle
from jaxslam.grid import GridSpec, centre_of, corner
from jaxslam.lidar import Lidar, Scan, before_ends, points
from jaxslam.nodes import Nodes, NodeSpec, blank
from jaxslam.types import NODE, Array


class Feet(NamedTuple):
    """Nearest point of each run, seen from one place."""

    distance: Array  # (K,) [m] to the run
    toward: Array  # (K, 2) unit vector to the foot
    along: Array  # (K,) [m] where the foot lies on the line, from its centre
    end: Array  # (K,) int32: 0 or 1 where the foot is that end of the run, 2 inside it


def feet(place: Array, runs: Runs) -> Feet:
    """Feet of all runs seen from `place` (2,) [m, robot frame]."""
    line = runs.along
    along = dot(place[None] - runs.centre, line)
    low = dot(runs.ends[:, 0] - runs.centre, line)
    high = dot(runs.ends[:, 1] - runs.centre, line)
    end = jnp.where(along < low, 0, jnp.where(along > high, 1, 2))
    inside = runs.centre + along[:, None] * line
    foot = jnp.where(
        (end == 2)[:, None],
        inside,
        jnp.where((end == 0)[:, None], runs.ends[:, 0], runs.ends[:, 1]),
    )
    offset = foot - place[None]
    near = jnp.sum(offset**2, axis=1) < 1e-8
    distance = jnp.sqrt(jnp.where(near, 1e-8, jnp.sum(offset**2, axis=1)))
    toward = jnp.where(near[:, None], runs.normal, offset / distance[:, None])
    return Feet(
        distance=jnp.where(runs.valid, distance, jnp.inf), toward=toward, along=along, end=end
    )


def solve3(a: Array, b: Array) -> Array:
    """Solution (3, n) of a x = b, a (3, 3) and b (3, n), by the adjugate: no LAPACK in a batch."""
    rows = jnp.stack([jnp.cross(a[1], a[2]), jnp.cross(a[2], a[0]), jnp.cross(a[0], a[1])])
    determinant = jnp.sum(a[0] * rows[0])
    safe = jnp.where(jnp.abs(determinant) > 1e-9, determinant, 1.0)
    return jnp.where(jnp.abs(determinant) > 1e-9, (rows.T / safe) @ b, 1e3)


class Circle(NamedTuple):
    """A circle that touches walls."""

    centre: Array  # (2,) [m] robot frame
    radius: Array  # () [m]
    cov: Array  # (2, 2) [m^2] of the centre
    error: Array  # () [m] largest distance of a touched wall from the circle
    spread: Array  # () [rad] smallest angle between the three feet that differ most
    touched: Array  # (K,) bool
    real: Array  # () bool, every foot is one


def tangent_circle(place: Array, runs: Runs, spec: NodeSpec) -> Circle:
    """Fit the circle that touches the walls nearest to `place` (2,) [m, robot frame].

    Gauss-Newton on distance_k(c) - r = 0 over the runs k that are near the circle; how near is
    asked more strictly from step to step. By the implicit function theorem the error of the
    centre is A^+ times that of the feet, A having the rows (toward the foot, 1).
    """

    def step(now, tolerance):
        centre, radius = now
        f = feet(centre, runs)
        radius = jnp.where(jnp.isfinite(radius), radius, jnp.min(f.distance))
        touched = jnp.abs(f.distance - radius) < tolerance
        w = touched.astype(place.dtype)
        rows = jnp.concatenate([f.toward, jnp.ones_like(w)[:, None]], axis=1)
        residual = jnp.where(touched, f.distance - radius, 0.0)
        normal = (rows * w[:, None]).T @ rows + 1e-4 * jnp.eye(3, dtype=place.dtype)
        move = solve3(normal, (rows * w[:, None]).T @ residual[:, None])[:, 0]
        move = jnp.clip(move, -0.3, 0.3)
        return (centre + move[:2], radius + move[2]), None

    tolerances = spec.touch * jnp.array([4.0, 3.0, 2.0, 1.5, 1.0, 1.0, 1.0, 1.0], place.dtype)
    start = (place, jnp.asarray(jnp.inf, place.dtype))
    (centre, radius), _ = lax.scan(step, start, tolerances)

    f = feet(centre, runs)
    touched = jnp.abs(f.distance - radius) < spec.touch
    w = touched.astype(place.dtype)
    at_end = jnp.clip(f.end, 0, 1)[:, None]
    of_end = jnp.take_along_axis(runs.end_variance, at_end, axis=1)[:, 0]
    variance = jnp.where(f.end == 2, runs.line_variance(f.along), of_end)
    rows = jnp.concatenate([f.toward, jnp.ones_like(w)[:, None]], axis=1) * w[:, None]
    gain = solve3(rows.T @ rows + 1e-6 * jnp.eye(3, dtype=place.dtype), rows.T)[:2]
    real = jnp.take_along_axis(runs.real, at_end, axis=1)[:, 0] | (f.end == 2)
    return Circle(
        centre=centre,
        radius=radius,
        cov=(gain * jnp.where(touched, variance, 0.0)[None]) @ gain.T,
        error=jnp.max(jnp.where(touched, jnp.abs(f.distance - radius), 0.0)),
        spread=_spread(f.toward, touched),
        touched=touched,
        real=jnp.all(real | ~touched),
    )


def _spread(toward: Array, touched: Array) -> Array:
    """Smallest angle [rad] between three feet chosen to differ as much as they can."""
    angle = jnp.arctan2(toward[:, 1], toward[:, 0])
    apart = jnp.abs(wrap_angle(angle[:, None] - angle[None, :]))  # (K, K)
    a = jnp.argmax(touched)
    from_a = jnp.where(touched, apart[a], -1.0)
    b = jnp.argmax(from_a)
    from_both = jnp.where(touched, jnp.minimum(apart[a], apart[b]), -1.0)
    return jnp.minimum(jnp.max(from_both), apart[a, b])


def _peaks(cells: Array, spec: GridSpec, count: int) -> tuple[Array, Array]:
    """Places (count, 2) [m] of groups of cells (H, W) bool, the nearest to the robot first.

    Of marked cells within two or three cells of each other, the nearest stands for all.
    """
    h, w = cells.shape
    away = np.hypot(*((np.indices(spec.shape) + 0.5) * spec.cell + corner(spec)[:, None, None]))
    by_rank = np.argsort(-away, axis=None, kind="stable")
    rank = np.empty(h * w, np.float32)
    rank[by_rank] = np.arange(1, h * w + 1)
    key = jnp.where(cells, jnp.asarray(rank.reshape(h, w)), jnp.float32(0.0))
    pairs = _halve(key)
    p = jnp.pad(pairs, 1)
    rows = jnp.maximum(jnp.maximum(p[:-2], p[2:]), p[1:-1])
    best = jnp.maximum(jnp.maximum(rows[:, :-2], rows[:, 2:]), rows[:, 1:-1])
    peaks = _halve(jnp.where(pairs == best, pairs, 0.0))  # one at most in every 2 x 2
    top, _ = lax.top_k(peaks.reshape(-1), count)
    flat = jnp.asarray(by_rank.astype(np.int32))[jnp.maximum(top, 1.0).astype(jnp.int32) - 1]
    return centre_of(jnp.stack([flat // w, flat % w], axis=-1), spec), top > 0.0


def _halve(x: Array) -> Array:
    """Largest value of each 2 x 2 block of (H, W)."""
    x = jnp.pad(x, ((0, x.shape[0] % 2), (0, x.shape[1] % 2)))
    x = jnp.maximum(x[::2], x[1::2])
    return jnp.maximum(x[:, ::2], x[:, 1::2])


def _rim_seen(circle: Circle, scan: Scan, lidar: Lidar) -> Array:
    """Whether a circle lies within what was seen.

    What a scan sees is star-shaped around the robot, so it contains the disc if it contains the
    rim; half a cell of slack for where it touches the walls.
    """
    turn = jnp.linspace(-jnp.pi, jnp.pi, 24, endpoint=False, dtype=scan.ranges.dtype)
    rim = circle.centre[None] + 0.95 * circle.radius * unit(turn)
    return jnp.all(before_ends(rim, scan.ranges, lidar))


def find_junctions(
    cells: Array, scan: Scan, runs: Runs, lidar: Lidar, grid: GridSpec, spec: NodeSpec
) -> Nodes:
    """Junctions of a Voronoi diagram as landmarks, the most trustworthy first.

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
    place, found = _peaks(cells, grid, spec.candidates)
    circle = jax.vmap(tangent_circle, in_axes=(0, None, None))(place, runs, spec)
    hits = points(scan, lidar)
    offset = jnp.linalg.norm(circle.centre[:, None] - hits[None], axis=2)
    clearance = jnp.min(jnp.where(scan.hit, offset, jnp.inf), axis=1)
    size = jnp.trace(circle.cov, axis1=1, axis2=2)
    good = found & circle.real & (circle.spread > spec.apart)
    good &= (circle.radius > spec.least) & (circle.radius < spec.most)
    good &= clearance > circle.radius - spec.touch
    good &= jnp.linalg.norm(circle.centre - place, axis=1) < 0.6
    good &= (size < 0.04) & before_ends(circle.centre, scan.ranges, lidar)
    certified = jax.vmap(_rim_seen, in_axes=(0, None, None))(circle, scan, lidar)
    # Several cells may lead to one circle.
    worth = 1.0 + certified.astype(place.dtype) + 0.1 * circle.radius
    order = jnp.argsort(-jnp.where(good, worth, 0.0), stable=True)
    centre, good = circle.centre[order], good[order]
    gap = jnp.linalg.norm(centre[:, None] - centre[None], axis=2)
    earlier = jnp.tril(jnp.ones(gap.shape, bool), -1)
    good &= ~jnp.any(earlier & good[None, :] & (gap < 0.25), axis=1)
    first = jnp.argsort(~good, stable=True)[: spec.nodes]
    order, good = order[first], good[first]
    zero = jnp.zeros(spec.nodes, place.dtype)
    return blank(
        Nodes(
            kind=jnp.full(spec.nodes, NODE, jnp.int32),
            xy=circle.centre[order],
            cov=circle.cov[order],
            direction=zero,
            variance=zero,
            shape=circle.radius[order],
            degree=circle.touched.sum(axis=1, dtype=jnp.int32)[order],
            certified=certified[order],
            valid=good,
        )
    )
