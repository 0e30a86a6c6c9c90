"""Landmarks of one scan: junctions of the Voronoi diagram, corners, and wall directions.

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
from jaxslam.geometry import cross, dot, unit, wrap_angle, wrap_line
from jaxslam.grid import GridSpec, centre_of, centres, corner
from jaxslam.lidar import Lidar, Scan, points
from jaxslam.types import CORNER, NODE, WALL, Array
from jaxslam.voronoi import Diagram, around, block_union, branches, expand, single

LINK_STEPS = 60  # steps that the ids of two junctions take to meet at most


class Nodes(NamedTuple):
    """Landmarks seen in one scan, of all three kinds, padded to M; robot frame."""

    kind: Array  # (M,) int32: NODE, CORNER or WALL
    xy: Array  # (M, 2) [m] position; zero for a wall direction
    cov: Array  # (M, 2, 2) [m^2] of the position
    direction: Array  # (M,) [rad] corner: towards its free side; wall: of its line; node: 0
    variance: Array  # (M,) [rad^2] of a wall's direction
    shape: Array  # (M,) node: clearance [m]; corner: angle of its free side [rad]; wall: 0
    degree: Array  # (M,) int32 number of walls the circle of a node touches
    certified: Array  # (M,) bool, nothing unseen inside the circle of a node
    valid: Array  # (M,) bool, False marks padding


class Links(NamedTuple):
    """Branches of one diagram that join two of its junctions, padded to P; robot frame."""

    pair: Array  # (P, 2) int32 indices of the features they join
    via: Array  # (P, 2) [m] a point half-way
    clearance: Array  # (P,) [m] the smaller of that point and of both ends
    valid: Array  # (P,) bool


class NodeSpec(NamedTuple):
    """How many landmarks a scan may have, and what makes them; static under jit."""

    nodes: int = 6
    corners: int = 6
    walls: int = 3
    candidates: int = 24  # junction cells looked at
    least: float = 0.35  # [m] smallest clearance of a node
    most: float = 3.2  # [m] largest
    apart: float = 0.7  # [rad] three feet of a node must differ by this, seen from it
    wall_length: float = 2.0  # [m] of a run whose direction counts
    corner_length: float = 0.3  # [m] of the runs of a corner
    corner_angle: float = 0.6  # [rad] by which these must turn
    touch: float = 0.1  # [m] walls this close to the circle of a node touch it

    @property
    def size(self) -> int:
        """Number of landmarks M of a scan."""
        return self.nodes + self.corners + self.walls


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
    return jnp.all(_seen(rim, scan, lidar))


def _seen(places: Array, scan: Scan, lidar: Lidar) -> Array:
    """Whether places (N, 2) [m] lie before the ends of the beams next to them."""
    beam = (jnp.arctan2(places[:, 1], places[:, 0]) - lidar.first) / lidar.step
    low = jnp.clip(jnp.floor(beam).astype(jnp.int32), 0, lidar.beams - 2)
    within = (beam > -0.5) & (beam < lidar.beams - 0.5)
    free = jnp.minimum(scan.ranges[low], scan.ranges[low + 1])
    return within & (jnp.linalg.norm(places, axis=1) < free)


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
    good &= (size < 0.04) & _seen(circle.centre, scan, lidar)
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
    return _blank(
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


def find_corners(runs: Runs, spec: NodeSpec) -> Nodes:
    """Corners in which two runs meet, the best located first.

    A corner c solves n_k . c = n_k . centre_k for its two runs, which also gives its covariance.
    The free side of a concave corner is narrower than a straight angle, of a convex one wider.
    """
    along = runs.along
    following = jnp.roll(along, -1, axis=0)
    turn = jnp.arctan2(cross(along, following), dot(along, following))
    place = runs.ends[:, 1]
    s = runs.line_variance(dot(place - runs.centre, along))
    ahead = dot(place - jnp.roll(runs.centre, -1, axis=0), following)
    t = jnp.roll(runs.variance, -1) * (
        1.0 / jnp.roll(runs.weight, -1) + ahead**2 / jnp.roll(runs.spread, -1)
    )
    # The inverse of the matrix of two unit normals has the other wall's direction as columns.
    sine = jnp.where(runs.meets, jnp.sin(turn), 1.0)
    first, second = following / sine[:, None], along / sine[:, None]
    cov = s[:, None, None] * first[:, :, None] * first[:, None, :]
    cov += t[:, None, None] * second[:, :, None] * second[:, None, :]
    enough = (runs.weight >= 5) & (runs.length > spec.corner_length)
    good = runs.meets & runs.valid & enough & jnp.roll(enough, -1)
    good &= (jnp.abs(turn) > spec.corner_angle) & (jnp.abs(turn) < jnp.pi - spec.corner_angle)
    size = jnp.where(good, cov[:, 0, 0] + cov[:, 1, 1], jnp.inf)
    order = jnp.argsort(size, stable=True)[: spec.corners]
    inward = jnp.arctan2(runs.normal[:, 1], runs.normal[:, 0]) + 0.5 * turn
    zero = jnp.zeros(spec.corners, place.dtype)
    return _blank(
        Nodes(
            kind=jnp.full(spec.corners, CORNER, jnp.int32),
            xy=place[order],
            cov=cov[order],
            direction=wrap_angle(inward)[order],
            variance=zero,
            shape=(jnp.pi - turn)[order],
            degree=jnp.full(spec.corners, 2, jnp.int32),
            certified=jnp.ones(spec.corners, bool),
            valid=(good & (size < 0.02))[order],
        )
    )


def find_walls(runs: Runs, spec: NodeSpec) -> Nodes:
    """Directions of the walls of a scan: groups of long parallel runs, the longest first.

    No two directions need be at right angles: each is a landmark of its own.
    """
    angle = jnp.arctan2(runs.along[:, 1], runs.along[:, 0])
    long = runs.valid & (runs.length > spec.wall_length) & (runs.weight >= 8)
    precision = runs.spread / runs.variance
    length = jnp.where(long, runs.length, 0.0)

    def step(left, _):
        best = jnp.argmax(left)
        off = wrap_line(angle - angle[best])
        member = (left > 0.0) & (jnp.abs(off) < 0.1)
        w = jnp.where(member, precision, 0.0)
        total = jnp.maximum(jnp.sum(w), 1e-6)
        mean = wrap_line(angle[best] + jnp.sum(w * off) / total)
        return jnp.where(member, 0.0, left), (mean, 1.0 / total, left[best] > 0.0)

    _, (direction, variance, valid) = lax.scan(step, length, length=spec.walls)
    return _blank(
        Nodes(
            kind=jnp.full(spec.walls, WALL, jnp.int32),
            xy=jnp.zeros((spec.walls, 2), angle.dtype),
            cov=jnp.zeros((spec.walls, 2, 2), angle.dtype),
            direction=direction,
            variance=variance,
            shape=jnp.zeros(spec.walls, angle.dtype),
            degree=jnp.zeros(spec.walls, jnp.int32),
            certified=jnp.ones(spec.walls, bool),
            valid=valid,
        )
    )


def _blank(nodes: Nodes) -> Nodes:
    """Set every number of the padding to zero."""
    keep = nodes.valid

    def clear(x: Array) -> Array:
        return jnp.where(keep.reshape(keep.shape + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x))

    return jax.tree.map(clear, nodes)._replace(kind=nodes.kind)


def find_links(
    found: Nodes,
    diagram: Diagram,
    sources: Array,
    scan: Scan,
    lidar: Lidar,
    grid: GridSpec,
    spec: NodeSpec,
) -> Links:
    """Which junctions the branches of a diagram join.

    The ids of the junctions expand along the branches, by the same automaton as the fronts before;
    where two ids meet, an arc is found.

    Args:
        found: Features of the scan, junctions first.
        diagram: Its diagram.
        sources: (H, W) bool, the cells the fronts came from.
        scan: The scan.
        lidar: The scanner.
        grid: The grid of the diagram.
        spec: Capacities; at most seven junctions, the bits of a uint8.
    """
    count = spec.nodes
    place, valid = found.xy[:count], found.valid[:count]
    middle = centres(grid).astype(place.dtype)
    near = jnp.linalg.norm(middle[None] - place[:, None, None], axis=-1) < 2.5 * grid.cell
    near &= valid[:, None, None]  # (N, H, W)
    bit = jnp.uint8(1) << jnp.arange(count, dtype=jnp.uint8)
    seeds = jnp.zeros(grid.shape, jnp.uint8)
    for k in range(count):
        seeds |= jnp.where(near[k], bit[k], jnp.uint8(0))
    branch = branches(diagram, sources).astype(jnp.uint8)
    thick = (block_union(branch) > 0) & (diagram.labels != 0) & ~sources
    met = expand(seeds, thick | (seeds != 0), steps=LINK_STEPS)
    ids, when = met.labels, jnp.where(met.arrival >= 0, met.arrival, LINK_STEPS + 1)
    # An even meet: one id here, another next door.
    beside = jnp.zeros_like(ids)
    for other in around(single(ids)):
        beside |= other
    both = ids | jnp.where(single(ids) != 0, beside, jnp.uint8(0))

    first, second = np.triu_indices(count, 1)
    hits = points(scan, lidar)

    def link(i: Array, j: Array) -> tuple[Array, Array, Array]:
        want = bit[i] | bit[j]
        here = jnp.where(both & want == want, when, LINK_STEPS + 1).reshape(-1)
        at = jnp.argmin(here)
        via = centre_of(jnp.stack([at // grid.shape[1], at % grid.shape[1]]), grid)
        via = via.astype(place.dtype)
        away = jnp.linalg.norm(hits - via[None], axis=1)
        room = jnp.min(jnp.where(scan.hit, away, jnp.inf))
        room = jnp.minimum(room, jnp.minimum(found.shape[i], found.shape[j]))
        return via, room, (here[at] <= LINK_STEPS) & valid[i] & valid[j]

    via, room, joined = jax.vmap(link)(jnp.asarray(first), jnp.asarray(second))
    pair = jnp.stack([jnp.asarray(first), jnp.asarray(second)], axis=1).astype(jnp.int32)
    return Links(pair=pair, via=via, clearance=room, valid=joined)


def restrict(nodes: Nodes, wanted: Array) -> Nodes:
    """Blank the landmarks that are not valid, not `wanted` (M,) bool, or hold NaN or infinity."""
    numbers = (nodes.xy, nodes.cov, nodes.direction, nodes.variance, nodes.shape)
    for x in numbers:
        wanted &= jnp.all(jnp.isfinite(x.reshape(x.shape[0], -1)), axis=1)
    return _blank(nodes._replace(valid=nodes.valid & wanted))


def join(*parts: Nodes) -> Nodes:
    """All landmarks of a scan in one record."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
