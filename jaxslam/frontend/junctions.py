"""Junctions of the Voronoi diagram of one scan as landmarks.

A junction is the centre of an empty circle that touches three or more walls. The automaton finds
the cells; the circle is then fitted to the line fits of the straight segments, which gives it
sub-cell accuracy, and a covariance from theirs.
"""

from collections.abc import Sequence
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from jaxslam.core.features import Features, zero_padding
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import FAR_JUNCTION, JUNCTION, Array
from jaxslam.frontend.circle_fitting import FittedCircles, fit_circles
from jaxslam.frontend.circle_search import best_apart, find_circles
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.lidar import beam_ends, in_free_view, is_free_view
from jaxslam.frontend.pyramid import Level, largest_radius
from jaxslam.frontend.segments import Segments
from jaxslam.frontend.tangent_circles import wall_segments

MAX_STEP, MAX_TRUSTED_STEP = 0.08, 0.05
"""[m] Beam ends of rough walls may be so far inside the circle of a junction, of a trusted one."""


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


def _not_of_finer(circle: FittedCircles, levels: Sequence[Level], of_level: np.ndarray) -> Array:
    """Whether circles (C,) are beyond what the levels finer than theirs, `of_level`, can hold."""
    good = jnp.ones(circle.radius.shape, bool)
    for k, (finer, level) in enumerate(pairwise(levels)):
        x, y = circle.centre[:, 0], circle.centre[:, 1]
        held = circle.radius <= largest_radius(x, y, finer, level)
        good &= ~(jnp.asarray(of_level > k) & held)
    return good


def _intrusion(circle: FittedCircles, scan: Scan, lidar: Lidar) -> Array:
    """Depth (C,) [m] to which beam ends are inside circles; negative if none is."""
    hits = jnp.where(scan.hit[:, None], beam_ends(lidar, scan), jnp.inf)
    dx, dy = (circle.centre[:, None, k] - hits[None, :, k] for k in range(2))
    return circle.radius - jnp.sqrt(jnp.min(dx * dx + dy * dy, axis=1))


def _is_junction(
    circle: FittedCircles,
    trace: Array,
    intrusion: Array,
    max_radius: Array,
    scan: Scan,
    lidar: Lidar,
    spec: FeatureSpec,
) -> Array:
    """Whether fitted circles (C,) are junctions that may be observed.

    The circle is empty of walls and, but for the steps of a rough wall, of beam ends (`intrusion`
    (C,) [m]); every foot is real, the radius is within limits (up to `max_radius` (C,) [m]), the
    centre is located well (`trace` (C,) [m^2] of its covariance) and in sight.
    """
    good = circle.feet_real & (circle.penetration < 0.05) & (trace < 0.02)
    good &= (circle.radius > spec.min_clearance) & (circle.radius < max_radius)
    good &= intrusion < max(MAX_STEP, 4 * lidar.range_std)
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
    well (`circle_search`).

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
        those of coarser ones, `FAR_JUNCTION`; of each level trusted ones first, then those whose
        circle was seen; robot frame.
    """
    dtype = scan.ranges.dtype
    tangent, found, of_level = find_circles(cells, wall_segments(segments), levels, spec, dtype)
    circle = fit_circles(tangent, segments, within=spec.tangency_gate, thick=spec.wall_thickness)
    trace = jnp.trace(circle.cov, axis1=1, axis2=2)
    intrusion = _intrusion(circle, scan, lidar)
    max_radius = spec.max_clearance * np.array([level.scale for level in levels])[of_level]
    max_radius = jnp.asarray(max_radius, dtype)
    good = found & _is_junction(circle, trace, intrusion, max_radius, scan, lidar, spec)
    good &= _not_of_finer(circle, levels, of_level)
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
    # Angles are below 4: on each level trusted junctions come first, then those that were seen.
    tier = 4.0 * (trusted.astype(dtype) + (area > spec.min_seen_fraction).astype(dtype))
    tier += jnp.asarray(12.0 * (len(levels) - 1 - of_level), dtype)
    score = jnp.where(good, tier + tangent.min_angle, 0.0).astype(dtype)
    best, good = best_apart(score, circle.centre, spec.min_separation, spec.max_junctions)
    zero = jnp.zeros(spec.max_junctions, dtype)
    far = good & jnp.asarray(of_level > 0)[best]
    angle = None
    if spec.incidence:  # of the walls (K, C) that the circles touch
        own = jnp.where(circle.touched, segments.incidence[:, None], 0.0)
        angle = jnp.max(own, axis=0)[best]
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
            incidence=angle,
        )
    )
