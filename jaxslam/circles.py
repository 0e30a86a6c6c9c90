"""Empty circles tangent to three or more walls: the junctions of a Voronoi diagram of segments.

A junction of the generalised Voronoi diagram of wall segments is as far from three walls and no
farther from any other: it is the centre of a circle that touches three walls and that none cuts.

               wall 0
        -----------+-----------      c = (x, y)  centre of the circle
                   | f0              f_k         foot: the point of wall k nearest to c
                   |                 d_k         distance |f_k - c|
        |          |          |      t_k         unit vector (f_k - c) / d_k
        |          |          |
     f1 +----------c----------+ f2   touch:  d_0 = d_1 = d_2 = radius
        |                     |      empty:  d_j >= radius for every other wall j
     wall 1                wall 2

`nearest_three` picks the walls to start with, `touch` solves for the tangent circle and exchanges
walls until it is empty, `fit` refines the circle with all walls that it touches.

Layout: walls lead (K) and circles trail (C), so that sums and minima over the walls are vectorised
over all circles.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.edges import Runs
from jaxslam.geometry import dot
from jaxslam.types import Array

APART = 0.95
"""Cosine of the angle between two feet above which they may belong to one corner or wall."""

FLOOR = 4e-6
"""Variance [m^2] of every foot on top of that of its line: walls are rough by 2 mm."""


class Walls(NamedTuple):
    """Wall segments, component by component; C is 1 for walls that all circles share.

    Attributes:
        start: ((K, C), (K, C)) [m] x and y of the first end, robot frame.
        along: ((K, C), (K, C)) unit vector from the first end to the second.
        size: (K, C) [m] length.
        valid: (K, C) bool, False marks padding.
    """

    start: tuple[Array, Array]
    along: tuple[Array, Array]
    size: Array
    valid: Array

    def of(self, index: Array) -> "Walls":
        """The walls (N, C) with index (N, C), of its own for each circle; self is (K, 1)."""
        return jax.tree.map(lambda x: x[:, 0][index], self)


class Feet(NamedTuple):
    """Foot of each wall for each circle: the point of the segment nearest to the centre.

    Attributes:
        distance: (K, C) [m] from the centre to the foot, infinite for padding.
        toward: ((K, C), (K, C)) unit vector from the centre to the foot, robot frame.
        part: (K, C) [m] position of the foot along the wall, from its first end.
    """

    distance: Array
    toward: tuple[Array, Array]
    part: Array


class Touching(NamedTuple):
    """Circles tangent to three walls each.

    Attributes:
        x: (C,) [m] centre, robot frame.
        y: (C,) [m] centre, robot frame.
        radius: (C,) [m] mean distance to the three walls.
        three: (3, C) int32 index of the walls.
        depth: (C,) [m] by which the nearest other wall cuts into the circle; negative if none does.
        spread: (C,) [rad] smallest angle between two of the three feet, seen from the centre.
        fourth: (C,) int32 nearest wall whose foot lies in another direction than all three feet.
    """

    x: Array
    y: Array
    radius: Array
    three: Array
    depth: Array
    spread: Array
    fourth: Array


class Circles(NamedTuple):
    """Circles fitted to all walls that they touch.

    Attributes:
        centre: (C, 2) [m] robot frame.
        radius: (C,) [m].
        cov: (C, 2, 2) [m^2] covariance of the centre.
        depth: (C,) [m] by which the nearest wall cuts into the circle.
        touched: (K, C) bool, the walls that the circle touches.
        real: (C,) bool, no foot is an end made by occlusion or by the field of view.
        hidden: (C,) [m] by which unseen parts of walls, behind their visible ends, may cut into the
            circle.
    """

    centre: Array
    radius: Array
    cov: Array
    depth: Array
    touched: Array
    real: Array
    hidden: Array


def walls_of(runs: Runs) -> Walls:
    """Wall segments (K, 1) between the ends of the straight segments of a scan."""
    start, end = runs.ends[:, 0], runs.ends[:, 1]
    gap = end - start
    length = jnp.sqrt(jnp.maximum(dot(gap, gap), 1e-12))
    along = gap / length[:, None]
    return Walls(
        start=(start[:, :1], start[:, 1:]),
        along=(along[:, :1], along[:, 1:]),
        size=length[:, None],
        valid=runs.valid[:, None],
    )


def feet(x: Array, y: Array, walls: Walls) -> Feet:
    """Feet (K, C) of walls (K, C) or (K, 1) for centres x, y (C,) [m, robot frame]."""
    (start_x, start_y), (along_x, along_y) = walls.start, walls.along
    x, y = x[None], y[None]
    position = jnp.clip((x - start_x) * along_x + (y - start_y) * along_y, 0.0, walls.size)
    dx, dy = start_x + position * along_x - x, start_y + position * along_y - y
    distance = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-8))
    toward = dx / distance, dy / distance
    return Feet(jnp.where(walls.valid, distance, jnp.inf), toward, position)


def nearest(distance: Array) -> Array:
    """Row index (C,) int32 of the smallest entry of each column of (K, C), the first of ties."""
    index = jnp.arange(len(distance), dtype=jnp.int32)[:, None]
    smallest = jnp.min(distance, axis=0, keepdims=True)
    return jnp.min(jnp.where(distance <= smallest, index, len(distance) - 1), axis=0)


def _cosine(toward: tuple[Array, Array], wall: Array) -> Array:
    """Cosines (K, C) of the angles between all feet and those of the walls with index (C,)."""
    tx, ty = toward
    index = jnp.arange(len(tx), dtype=jnp.int32)[:, None]
    one_hot = (index == wall[None]).astype(tx.dtype)
    wall_tx, wall_ty = jnp.sum(one_hot * tx, axis=0), jnp.sum(one_hot * ty, axis=0)
    return tx * wall_tx[None] + ty * wall_ty[None]


def nearest_three(f: Feet, alike: float) -> Array:
    """The three nearest walls whose feet lie in different directions.

    Args:
        f: Feet of K walls for C circles.
        alike: Cosine of the smallest angle between two of the three feet.

    Returns:
        Index (3, C) int32, nearest first.
    """
    first = nearest(f.distance)
    near_first = _cosine(f.toward, first)
    second = nearest(jnp.where(near_first < alike, f.distance, jnp.inf))
    near_both = jnp.maximum(near_first, _cosine(f.toward, second))
    third = nearest(jnp.where(near_both < alike, f.distance, jnp.inf))
    return jnp.stack([first, second, third])


def _newton(x: Array, y: Array, three: Walls) -> tuple[Array, Array, Feet]:
    """Solve d_0 = d_1 = d_2 for the centre by four steps of Newton's method.

    Moving the centre by (u, v) changes distance k to d_k - t_k . (u, v), to first order. All three
    become equal if

        (t_1 - t_0) . (u, v) = d_1 - d_0
        (t_2 - t_0) . (u, v) = d_2 - d_0

    which Cramer's rule solves. The determinant is kept away from zero, and each component of a
    step within 0.4 m.

    Args:
        x: (C,) [m] initial centre, robot frame.
        y: (C,) [m] initial centre, robot frame.
        three: (3, C) the walls.

    Returns:
        Centres x and y (C,), and the feet (3, C) of the walls there.
    """
    foot = feet(x, y, three)
    for _ in range(4):
        (tx, ty), d = foot.toward, foot.distance
        ax, ay, gap = tx[1:] - tx[:1], ty[1:] - ty[:1], d[1:] - d[:1]  # rows 1 and 2: (2, C)
        determinant = ax[0] * ay[1] - ax[1] * ay[0]
        determinant = jnp.where(jnp.abs(determinant) > 1e-4, determinant, 1e-4)
        x = x + jnp.clip((gap[0] * ay[1] - gap[1] * ay[0]) / determinant, -0.4, 0.4)
        y = y + jnp.clip((ax[0] * gap[1] - ax[1] * gap[0]) / determinant, -0.4, 0.4)
        foot = feet(x, y, three)
    return x, y, foot


def _one_of(three: Array, index: Array) -> Array:
    """Whether each wall, `index` (K, 1), is one of the three (3, C) of a circle: (K, C) bool."""
    return (index == three[:1]) | (index == three[1:2]) | (index == three[2:])


def _most_similar(cosines: list[Array], wall: Array, index: Array) -> Array:
    """Which of the three walls, 0..2 (C,), has its foot in a direction most like that of `wall`.

    Args:
        cosines: Three of (K, C), of the angles between every foot and that of one of the three.
        wall: (C,) index of a wall.
        index: (K, 1) row numbers.
    """
    is_wall = index == wall[None]
    cosine = [jnp.sum(jnp.where(is_wall, every, 0.0), axis=0) for every in cosines]
    return nearest(-jnp.stack(cosine))


def touch(x: Array, y: Array, three: Array, walls: Walls, *, swaps: int) -> Touching:
    """Circles near x, y that touch three walls and that no wall cuts.

    While another wall j cuts into the circle, it replaces the one of the three whose foot lies in
    the most similar direction, that is, the wall that it stands in front of. Below, j cuts into the
    circle and replaces wall 2, since t_j . t_2 is larger than t_j . t_0 and t_j . t_1:

            -------+-------               repeat `swaps` + 1 times:
        |          f0         |  wall 2       solve for the circle tangent to the three (`_newton`)
        |              |      |               j = the nearest other wall
     f1 +          c   + fj   + f2            depth = radius - d_j
        |              |      |               if depth > 1 mm:
     wall 1          wall j                       j replaces the wall k of largest t_j . t_k

    The *fourth* wall is the nearest other one whose foot is in none of the three directions (all
    cosines below `APART`). Three junctions may lie close by: those in which it replaces one of the
    three walls. `junctions.find_junctions` searches these.

    Args:
        x: (C,) [m] initial centre, robot frame.
        y: (C,) [m] initial centre, robot frame.
        three: (3, C) int32 index of the walls to start with.
        walls: (K, 1) all walls.
        swaps: How many times a wall may be replaced.

    Returns:
        The C circles, with `depth` and `fourth` of the last solution.
    """
    index = jnp.arange(len(walls.size), dtype=jnp.int32)[:, None]

    def solve_and_swap(x: Array, y: Array, three: Array):
        x, y, own = _newton(x, y, walls.of(three))
        every = feet(x, y, walls)
        radius = jnp.mean(own.distance, axis=0)
        others = jnp.where(_one_of(three, index), jnp.inf, every.distance)  # (K, C)
        intruder, depth = nearest(others), radius - jnp.min(others, axis=0)
        (tx, ty), (own_tx, own_ty) = every.toward, own.toward
        cosines = [tx * own_tx[k][None] + ty * own_ty[k][None] for k in range(3)]
        replaced = _most_similar(cosines, intruder, index)
        replaces = jnp.arange(3, dtype=jnp.int32)[:, None] == replaced[None]  # (3, C)
        replaces &= (depth > 1e-3)[None]
        largest = jnp.maximum(jnp.maximum(cosines[0], cosines[1]), cosines[2])
        fourth = nearest(jnp.where(largest < APART, others, jnp.inf))
        between = [
            own_tx[i] * own_tx[j] + own_ty[i] * own_ty[j] for i, j in ((0, 1), (1, 2), (2, 0))
        ]
        cosine = jnp.maximum(jnp.maximum(between[0], between[1]), between[2])
        solved = Touching(x, y, radius, three, depth, cosine, fourth)
        return (x, y, jnp.where(replaces, intruder[None], three)), solved

    def body(carry, _: None):
        return solve_and_swap(*carry[0]), None

    zero = jnp.zeros_like(x)
    unsolved = Touching(x, y, zero, three, zero, zero, jnp.zeros_like(three[0]))
    (_, last), _ = lax.scan(body, ((x, y, three), unsolved), length=swaps + 1)
    # Up to here `spread` holds the cosine.
    return last._replace(spread=jnp.arccos(jnp.clip(last.spread, -0.9999, 0.9999)))


def _variance(foot: Feet, walls: Walls, runs: Runs) -> Array:
    """Variance (K, C) [m^2] of the distances to the feet: t^T Sigma_foot t, plus `FLOOR`.

    A foot inside its segment errs as the fitted line does across itself, a foot at an end as that
    end.
    """
    (tx, ty), (start_x, start_y), (along_x, along_y) = foot.toward, walls.start, walls.along

    def toward_end(cov: Array) -> Array:  # (K, 2, 2) -> (K, C)
        xx, xy, yy = cov[:, :1, 0], cov[:, :1, 1], cov[:, 1:, 1]
        return tx * tx * xx + 2 * tx * ty * xy + ty * ty * yy

    centre = (runs.centre[:, :1] - start_x) * along_x + (runs.centre[:, 1:] - start_y) * along_y
    inside = (
        runs.offset_variance[:, None] + (foot.part - centre) ** 2 * runs.angle_variance[:, None]
    )
    at_start = toward_end(runs.end_cov[:, 0])
    at_end = jnp.where(foot.part <= 0.0, at_start, toward_end(runs.end_cov[:, 1]))
    return jnp.where((foot.part > 0.0) & (foot.part < walls.size), inside, at_end) + FLOOR


def _hidden_depth(x: Array, y: Array, radius: Array, runs: Runs, thick: float) -> Array:
    """By how much [m] unseen parts of walls may cut into circles (C,).

    Behind an end that occludes what is farther away, the wall may continue along the line of sight
    by its thickness `thick` [m]: the nearest point of that piece to the centre counts.
    """
    end = runs.ends.reshape(-1, 2)  # (2 K, 2)
    end_range = jnp.sqrt(jnp.maximum(dot(end, end), 1e-12))[:, None]
    end_x, end_y = end[:, :1], end[:, 1:]
    sight_x, sight_y = end_x / end_range, end_y / end_range
    behind = jnp.clip((x[None] - end_x) * sight_x + (y[None] - end_y) * sight_y, 0.0, thick)
    dx, dy = end_x + behind * sight_x - x[None], end_y + behind * sight_y - y[None]
    distance = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-12))
    occludes = (runs.sharp & runs.valid[:, None]).reshape(-1, 1)
    return jnp.max(jnp.where(occludes, radius[None] - distance, 0.0), axis=0)


def _touched(start: Touching, foot: Feet, variance: Array, valid: Array, within: float) -> Array:
    """Walls (K, C) bool that circles touch: their own three, and those within the errors.

    A wall whose foot is in about the direction of one of the three (cosine above `APART`) is not
    counted again: it is probably the next segment of the same wall, with a correlated error.
    """
    index = jnp.arange(len(valid), dtype=jnp.int32)[:, None]
    touched = jnp.abs(foot.distance - start.radius[None]) < within * jnp.sqrt(variance)
    cosines = [_cosine(foot.toward, wall) for wall in start.three]
    touched &= jnp.maximum(jnp.maximum(cosines[0], cosines[1]), cosines[2]) < APART
    touched |= _one_of(start.three, index)
    return touched & valid


def fit(start: Touching, runs: Runs, *, within: float, thick: float) -> Circles:
    """Fit circles to all walls that they touch, by weighted least squares.

    Minimises sum_k w_k (d_k - r)^2 over the centre and the radius r, with w_k the inverse variance
    of distance k, by two steps of Gauss-Newton. A step (u, v, s) of x, y and r solves

        A (u, v, s) = o,    rows of A: (t_k, 1),    o_k = d_k - r,    weights W = diag(w_k).

    With m_t, m_o the weighted means of t_k and o_k, eliminating s leaves two equations for (u, v):

        S (u, v) = sum_k w_k (t_k - m_t) (o_k - m_o),    S = sum_k w_k (t_k - m_t) (t_k - m_t)^T
        s = m_o - m_t . (u, v)

    By the implicit function theorem (A^T W A)^-1 is the covariance of centre and radius; its block
    of the centre is S^-1.

    Args:
        start: C circles, through three walls each.
        runs: K straight segments of the scan: the walls.
        within: A wall touches a circle if its distance is within so many standard deviations of
            the radius.
        thick: [m] thickness of walls, by which they may continue unseen behind a visible end.
    """
    walls, x, y, radius = walls_of(runs), start.x, start.y, start.radius
    foot = feet(x, y, walls)
    variance = _variance(foot, walls, runs)
    touched = _touched(start, foot, variance, walls.valid, within)
    w = lax.stop_gradient(jnp.where(touched, 1.0 / variance, 0.0))
    total = jnp.maximum(jnp.sum(w, axis=0), 1e-9)

    def gauss_newton(now: tuple[Array, Array, Array], _: None):
        x, y, radius = now
        foot = feet(x, y, walls)
        (tx, ty), o = foot.toward, jnp.where(touched, foot.distance - radius[None], 0.0)
        mx, my, mo = (jnp.sum(w * a, axis=0) / total for a in (tx, ty, o))
        dx, dy, do = tx - mx[None], ty - my[None], o - mo[None]
        sxx, sxy, syy, bx, by = (
            jnp.sum(w * a, axis=0) for a in (dx * dx, dx * dy, dy * dy, dx * do, dy * do)
        )
        # A determinant near zero: all feet in one direction.
        det = jnp.maximum(sxx * syy - sxy * sxy, 1e-6 * (sxx * sxx + syy * syy) + 1e-9)
        u = jnp.clip((syy * bx - sxy * by) / det, -0.3, 0.3)
        v = jnp.clip((sxx * by - sxy * bx) / det, -0.3, 0.3)
        cov = syy / det, -sxy / det, sxx / det
        return (x + u, y + v, radius + mo - mx * u - my * v), cov

    (x, y, radius), cov = lax.scan(gauss_newton, (x, y, radius), length=2)
    xx, xy, yy = (c[-1] for c in cov)
    foot = feet(x, y, walls)
    real_end = jnp.where(foot.part <= 0.0, runs.real[:, :1], runs.real[:, 1:])
    real_foot = real_end | ((foot.part > 0.0) & (foot.part < walls.size))
    return Circles(
        centre=jnp.stack([x, y], axis=-1),
        radius=radius,
        cov=jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], axis=-1),
        depth=radius - jnp.min(foot.distance, axis=0),
        touched=touched,
        real=jnp.all(real_foot | ~touched, axis=0),
        hidden=_hidden_depth(x, y, radius, runs, thick),
    )
