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

`nearest_three_walls` picks the walls to start with, `tangent_circles` solves for the tangent circle
and exchanges walls until it is empty, `circle_fitting.fit_circles` refines the circle with all
walls that it touches.

Layout: walls lead (K) and circles trail (C), so that sums and minima over the walls are vectorised
over all circles.
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.se2 import dot
from jaxslam.core.types import AnyArray, Array
from jaxslam.frontend.segments import Segments

MAX_FOOT_COSINE = 0.95
"""Cosine of the angle between two feet above which they may belong to one corner or wall."""


class WallSegments(NamedTuple):
    """Wall segments, component by component; C is 1 for walls that all circles share.

    Attributes:
        start: ((K, C), (K, C)) [m] x and y of the first end, robot frame.
        along: ((K, C), (K, C)) unit vector from the first end to the second.
        length: (K, C) [m].
        valid: (K, C) bool, False marks padding.
    """

    start: tuple[Array, Array]
    along: tuple[Array, Array]
    length: Array
    valid: Array

    def of(self, index: Array) -> "WallSegments":
        """The walls (N, C) with index (N, C), of its own for each circle; self is (K, 1)."""
        return jax.tree.map(lambda x: x[:, 0][index], self)


class FootPoints(NamedTuple):
    """Foot of each wall for each circle: the point of the segment nearest to the centre.

    Attributes:
        distance: (K, C) [m] from the centre to the foot, infinite for padding.
        toward: ((K, C), (K, C)) unit vector from the centre to the foot, robot frame.
        along: (K, C) [m] position of the foot along the wall, from its first end.
    """

    distance: Array
    toward: tuple[Array, Array]
    along: Array


class TangentCircles(NamedTuple):
    """Circles tangent to three walls each.

    Attributes:
        x: (C,) [m] centre, robot frame.
        y: (C,) [m] centre, robot frame.
        radius: (C,) [m] mean distance to the three walls.
        walls: (3, C) int32 index of the walls.
        penetration: (C,) [m] by which the nearest other wall cuts into the circle; negative if none
            does.
        min_angle: (C,) [rad] smallest angle between two of the three feet, seen from the centre.
        fourth_wall: (C,) int32 nearest wall whose foot lies in another direction than all three
            feet.
    """

    x: Array
    y: Array
    radius: Array
    walls: Array
    penetration: Array
    min_angle: Array
    fourth_wall: Array


def wall_segments(segments: Segments) -> WallSegments:
    """Wall segments (K, 1) between the ends of the straight segments of a scan."""
    start, end = segments.ends[:, 0], segments.ends[:, 1]
    gap = end - start
    length = jnp.sqrt(jnp.maximum(dot(gap, gap), 1e-12))
    along = gap / length[:, None]
    return WallSegments(
        start=(start[:, :1], start[:, 1:]),
        along=(along[:, :1], along[:, 1:]),
        length=length[:, None],
        valid=segments.valid[:, None],
    )


def foot_points(x: Array, y: Array, walls: WallSegments) -> FootPoints:
    """Feet (K, C) of walls (K, C) or (K, 1) for centres x, y (C,) [m, robot frame]."""
    (start_x, start_y), (along_x, along_y) = walls.start, walls.along
    x, y = x[None], y[None]
    position = jnp.clip((x - start_x) * along_x + (y - start_y) * along_y, 0.0, walls.length)
    dx, dy = start_x + position * along_x - x, start_y + position * along_y - y
    distance = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-8))
    toward = dx / distance, dy / distance
    return FootPoints(jnp.where(walls.valid, distance, jnp.inf), toward, position)


def nearest_wall(distance: Array) -> Array:
    """Row index (C,) int32 of the smallest entry of each column of (K, C), the first of ties."""
    index = jnp.arange(len(distance), dtype=jnp.int32)[:, None]
    smallest = jnp.min(distance, axis=0, keepdims=True)
    return jnp.min(jnp.where(distance <= smallest, index, len(distance) - 1), axis=0)


def _cosine(toward: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Cosines (K, C) of the angles between unit vectors, (K, C) or (1, C)."""
    return toward[0] * other[0] + toward[1] * other[1]


def largest_cosine(toward: tuple[Array, Array], three: tuple[Array, Array]) -> Array:
    """Cosine (K, C) of the angle between unit vectors (K, C) and the nearest of (3, C)."""
    x, y = three
    return reduce(
        jnp.maximum, (_cosine(toward, (x[k : k + 1], y[k : k + 1])) for k in range(len(x)))
    )


def nearest_three_walls(
    x: Array, y: Array, walls: WallSegments, max_cosine: float
) -> tuple[Array, Array]:
    """The three nearest walls whose feet lie in different directions.

    Args:
        x: (C,) [m] centre, robot frame.
        y: (C,) [m] centre, robot frame.
        walls: (K, 1) all walls.
        max_cosine: Cosine of the smallest angle between two of the three feet.

    Returns:
        Index (3, C) int32, nearest first, and the distance (C,) [m] to the nearest.
    """
    foot = foot_points(x, y, walls)
    distance, index = foot.distance, [nearest_wall(foot.distance)]
    for _ in range(2):
        last = foot_points(x, y, walls.of(index[-1][None]))
        apart = _cosine(foot.toward, last.toward) < max_cosine
        distance = jnp.where(apart, distance, jnp.inf)
        index.append(nearest_wall(distance))
    return jnp.stack(index), jnp.min(foot.distance, axis=0)


def _newton(
    x: Array, y: Array, three: WallSegments, max_step: AnyArray | float
) -> tuple[Array, Array, FootPoints]:
    """Solve d_0 = d_1 = d_2 for the centre by four steps of Newton's method.

    Moving the centre by (u, v) changes distance k to d_k - t_k . (u, v), to first order. All three
    become equal if

        (t_1 - t_0) . (u, v) = d_1 - d_0
        (t_2 - t_0) . (u, v) = d_2 - d_0

    which Cramer's rule solves. The determinant is kept away from zero.

    Args:
        x: (C,) [m] initial centre, robot frame.
        y: (C,) [m] initial centre, robot frame.
        three: (3, C) the walls.
        max_step: (C,) or () [m] largest size of each component of a step.

    Returns:
        Centres x and y (C,), and the feet (3, C) of the walls there.
    """

    def step(_: int, at: tuple[Array, Array]) -> tuple[Array, Array]:
        x, y = at
        foot = foot_points(x, y, three)
        (tx, ty), d = foot.toward, foot.distance
        ax, ay, gap = tx[1:] - tx[:1], ty[1:] - ty[:1], d[1:] - d[:1]  # rows 1 and 2: (2, C)
        determinant = ax[0] * ay[1] - ax[1] * ay[0]
        determinant = jnp.where(jnp.abs(determinant) > 1e-4, determinant, 1e-4)
        x = x + jnp.clip((gap[0] * ay[1] - gap[1] * ay[0]) / determinant, -max_step, max_step)
        y = y + jnp.clip((ax[0] * gap[1] - ax[1] * gap[0]) / determinant, -max_step, max_step)
        return x, y

    x, y = lax.fori_loop(0, 4, step, (x, y))  # as fast as unrolled, and less to compile
    foot = foot_points(x, y, three)
    return x, y, foot


def one_of(three: Array, index: Array) -> Array:
    """Whether each wall, `index` (K, 1), is one of the three (3, C) of a circle: (K, C) bool."""
    return (index == three[:1]) | (index == three[1:2]) | (index == three[2:])


_Circle = tuple[Array, Array, Array]
"""Centres x and y (C,) and walls (3, C)."""


def tangent_circles(
    x: Array,
    y: Array,
    three: Array,
    walls: WallSegments,
    *,
    swaps: int,
    max_step: AnyArray | float = 0.4,
) -> TangentCircles:
    """Circles near x, y that touch three walls and that no wall cuts.

    While another wall j cuts into the circle, it replaces the one of the three whose foot lies in
    the most similar direction, that is, the wall that it stands in front of. Below, j cuts into the
    circle and replaces wall 2, since t_j . t_2 is larger than t_j . t_0 and t_j . t_1:

            -------+-------               repeat `swaps` times:
        |          f0         |  wall 2       solve for the circle tangent to the three (`_newton`)
        |              |      |               j = the nearest other wall
     f1 +          c   + fj   + f2            penetration = radius - d_j
        |              |      |               if penetration > 1 mm:
     wall 1          wall j                       j replaces the wall k of largest t_j . t_k
                                          solve once more

    The *fourth* wall is the nearest other one whose foot is in none of the three directions (all
    cosines below `MAX_FOOT_COSINE`). Three junctions may lie close by: those in which it replaces
    one of the three walls. `circle_search` searches these.

    Args:
        x: (C,) [m] initial centre, robot frame.
        y: (C,) [m] initial centre, robot frame.
        three: (3, C) int32 index of the walls to start with.
        walls: (K, 1) all walls.
        swaps: How many times a wall may be replaced.
        max_step: (C,) or () [m] largest size of each component of a step of Newton's method.

    Returns:
        The C circles, with `penetration` and `fourth_wall` of the last solution.
    """
    index = jnp.arange(len(walls.length), dtype=jnp.int32)[:, None]

    def solve(x: Array, y: Array, three: Array) -> tuple[Array, Array, FootPoints, FootPoints]:
        """Centres, feet (3, C) of the three walls, and those (K, C) of all, the three at `inf`."""
        x, y, own = _newton(x, y, walls.of(three), max_step)
        every = foot_points(x, y, walls)
        others = jnp.where(one_of(three, index), jnp.inf, every.distance)
        return x, y, own, every._replace(distance=others)

    def solve_and_swap(circle: _Circle, _: None) -> tuple[_Circle, None]:
        x, y, three = circle
        x, y, own, others = solve(x, y, three)
        intruder = nearest_wall(others.distance)
        penetration = jnp.mean(own.distance, axis=0) - jnp.min(others.distance, axis=0)
        toward = foot_points(x, y, walls.of(intruder[None])).toward
        replaced = nearest_wall(-_cosine(own.toward, toward))
        replaces = jnp.arange(3, dtype=jnp.int32)[:, None] == replaced[None]  # (3, C)
        replaces &= (penetration > 1e-3)[None]
        return (x, y, jnp.where(replaces, intruder[None], three)), None

    (x, y, three), _ = lax.scan(solve_and_swap, (x, y, three), length=swaps)
    x, y, own, others = solve(x, y, three)
    own_tx, own_ty = own.toward
    largest = largest_cosine(others.toward, own.toward)
    between = [own_tx[i] * own_tx[j] + own_ty[i] * own_ty[j] for i, j in ((0, 1), (1, 2), (2, 0))]
    cosine = jnp.maximum(jnp.maximum(between[0], between[1]), between[2])
    radius = jnp.mean(own.distance, axis=0)
    return TangentCircles(
        x=x,
        y=y,
        radius=radius,
        walls=three,
        penetration=radius - jnp.min(others.distance, axis=0),
        min_angle=jnp.arccos(jnp.clip(cosine, -0.9999, 0.9999)),
        fourth_wall=nearest_wall(jnp.where(largest < MAX_FOOT_COSINE, others.distance, jnp.inf)),
    )
