"""Least-squares fit of circles to all walls that they touch, with covariance."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxslam.core.se2 import dot
from jaxslam.core.types import Array
from jaxslam.frontend.segments import Segments
from jaxslam.frontend.tangent_circles import (
    MAX_FOOT_COSINE,
    FootPoints,
    TangentCircles,
    WallSegments,
    foot_points,
    largest_cosine,
    one_of,
    wall_segments,
)

FOOT_VARIANCE_FLOOR = 4e-6
"""Variance [m^2] of every foot on top of that of its line: walls are rough by 2 mm."""


class FittedCircles(NamedTuple):
    """Circles fitted to all walls that they touch.

    Attributes:
        centre: (C, 2) [m] robot frame.
        radius: (C,) [m].
        cov: (C, 2, 2) [m^2] covariance of the centre.
        penetration: (C,) [m] by which the nearest wall cuts into the circle.
        touched: (K, C) bool, the walls that the circle touches.
        feet_real: (C,) bool, no foot is an end made by occlusion or by the field of view.
        hidden_depth: (C,) [m] by which unseen parts of walls, behind their visible ends, may cut
            into the circle.
    """

    centre: Array
    radius: Array
    cov: Array
    penetration: Array
    touched: Array
    feet_real: Array
    hidden_depth: Array


def _variance(foot: FootPoints, walls: WallSegments, segments: Segments) -> Array:
    """Variance (K, C) [m^2] of the distances to the feet.

    It is t^T Sigma_foot t + `FOOT_VARIANCE_FLOOR`, with t the unit vector to the foot.

    A foot inside its segment errs as the fitted line does across itself, a foot at an end as that
    end.
    """
    (tx, ty), (start_x, start_y), (along_x, along_y) = foot.toward, walls.start, walls.along

    def toward_end(cov: Array) -> Array:  # (K, 2, 2) -> (K, C)
        xx, xy, yy = cov[:, :1, 0], cov[:, :1, 1], cov[:, 1:, 1]
        return tx * tx * xx + 2 * tx * ty * xy + ty * ty * yy

    centre = (segments.centre[:, :1] - start_x) * along_x + (
        segments.centre[:, 1:] - start_y
    ) * along_y
    inside = (
        segments.offset_variance[:, None]
        + (foot.along - centre) ** 2 * segments.angle_variance[:, None]
    )
    at_start = toward_end(segments.end_cov[:, 0])
    at_end = jnp.where(foot.along <= 0.0, at_start, toward_end(segments.end_cov[:, 1]))
    return (
        jnp.where((foot.along > 0.0) & (foot.along < walls.length), inside, at_end)
        + FOOT_VARIANCE_FLOOR
    )


def _hidden_depth(x: Array, y: Array, radius: Array, segments: Segments, thick: float) -> Array:
    """By how much [m] unseen parts of walls may cut into circles (C,).

    Behind an end that occludes what is farther away, the wall may continue along the line of sight
    by its thickness `thick` [m]: the nearest point of that piece to the centre counts.
    """
    end = segments.ends.reshape(-1, 2)  # (2 K, 2)
    end_range = jnp.sqrt(jnp.maximum(dot(end, end), 1e-12))[:, None]
    end_x, end_y = end[:, :1], end[:, 1:]
    sight_x, sight_y = end_x / end_range, end_y / end_range
    behind = jnp.clip((x[None] - end_x) * sight_x + (y[None] - end_y) * sight_y, 0.0, thick)
    dx, dy = end_x + behind * sight_x - x[None], end_y + behind * sight_y - y[None]
    distance = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-12))
    occludes = (segments.end_occludes & segments.valid[:, None]).reshape(-1, 1)
    return jnp.max(jnp.where(occludes, radius[None] - distance, 0.0), axis=0)


def _touched(
    start: TangentCircles, foot: FootPoints, variance: Array, walls: WallSegments, within: float
) -> Array:
    """Walls (K, C) bool that circles touch: their own three, and those within the errors.

    A wall whose foot is in about the direction of one of the three (cosine above `MAX_FOOT_COSINE`)
    is not counted again: it is probably the next segment of the same wall, with a correlated error.
    """
    index = jnp.arange(len(walls.valid), dtype=jnp.int32)[:, None]
    touched = jnp.abs(foot.distance - start.radius[None]) < within * jnp.sqrt(variance)
    own = foot_points(start.x, start.y, walls.of(start.walls))
    touched &= largest_cosine(foot.toward, own.toward) < MAX_FOOT_COSINE
    touched |= one_of(start.walls, index)
    return touched & walls.valid


_Three = tuple[Array, Array, Array]


def fit_circles(
    start: TangentCircles, segments: Segments, *, within: float, thick: float
) -> FittedCircles:
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
        segments: K straight segments of the scan: the walls.
        within: A wall touches a circle if its distance is within so many standard deviations of
            the radius.
        thick: [m] thickness of walls, by which they may continue unseen behind a visible end.
    """
    walls, x, y, radius = wall_segments(segments), start.x, start.y, start.radius
    foot = foot_points(x, y, walls)
    variance = _variance(foot, walls, segments)
    touched = _touched(start, foot, variance, walls, within)
    w = lax.stop_gradient(jnp.where(touched, 1.0 / variance, 0.0))
    total = jnp.maximum(jnp.sum(w, axis=0), 1e-9)

    def gauss_newton(now: _Three, _: None) -> tuple[_Three, _Three]:
        x, y, radius = now
        foot = foot_points(x, y, walls)
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
    foot = foot_points(x, y, walls)
    real_end = jnp.where(
        foot.along <= 0.0, segments.end_is_real[:, :1], segments.end_is_real[:, 1:]
    )
    real_foot = real_end | ((foot.along > 0.0) & (foot.along < walls.length))
    return FittedCircles(
        centre=jnp.stack([x, y], axis=-1),
        radius=radius,
        cov=jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], axis=-1),
        penetration=radius - jnp.min(foot.distance, axis=0),
        touched=touched,
        feet_real=jnp.all(real_foot | ~touched, axis=0),
        hidden_depth=_hidden_depth(x, y, radius, segments, thick),
    )
