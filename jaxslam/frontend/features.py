"""Features of one scan as one record; those found without a diagram: corners, wall directions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.arguments import as_bool, as_float
from jaxslam.core.features import Features, zero_padding
from jaxslam.core.se2 import cross, dot, unit_vector, wrap_angle, wrap_direction
from jaxslam.core.types import CORNER, JUNCTION, WALL, Array
from jaxslam.frontend.segments import Segments


class FeatureSpec(NamedTuple):
    """How many features a scan may have, and their thresholds; static under jit.

    Attributes:
        max_junctions: Capacity for junctions.
        max_corners: Capacity for corners.
        max_walls: Capacity for wall directions.
        min_clearance: [m] smallest clearance of a junction.
        max_clearance: [m] largest clearance of a junction.
        min_separation: [m] of junctions nearer to each other than this one is kept.
        min_foot_angle: [rad] smallest angle between the feet of a trusted junction, seen from it.
        min_seen_fraction: Smallest fraction of the circle of a trusted junction that was seen.
        wall_thickness: [m] by which walls may continue unseen behind a visible end.
        max_hidden_depth: [m] by which unseen walls may cut into the circle of a trusted junction.
        min_wall_length: [m] smallest length of a segment whose direction counts.
        min_corner_length: [m] smallest length of the segments of a trusted corner.
        min_corner_angle: [rad] smallest turn between the segments of a corner, and the smallest
            difference of the turn from pi.
        tangency_gate: A wall touches the circle of a junction if it is within so many standard
            deviations of it.
        max_coarse_candidates: Number of cells of each coarser level of the pyramid at which
            junctions are searched.
        incidence: Whether features hold the angle of incidence, for noise that depends on it.
    """

    max_junctions: int = 8
    max_corners: int = 8
    max_walls: int = 3
    min_clearance: float = 0.35
    max_clearance: float = 3.2
    min_separation: float = 0.15
    min_foot_angle: float = 0.6
    min_seen_fraction: float = 0.9
    wall_thickness: float = 0.25
    max_hidden_depth: float = 0.02
    min_wall_length: float = 2.0
    min_corner_length: float = 0.12
    min_corner_angle: float = 0.6
    tangency_gate: float = 1.5
    max_coarse_candidates: int = 8
    incidence: bool = False

    @property
    def num_candidates(self) -> int:
        """Number of cells of the finest level at which junctions are searched: three for each."""
        return 3 * self.max_junctions

    @property
    def max_features(self) -> int:
        """Number of features M of a scan."""
        return self.max_junctions + self.max_corners + self.max_walls


def check_feature_spec(spec: FeatureSpec) -> None:
    """Raise ValueError, naming the field, unless capacities of features are possible."""
    if not isinstance(spec, FeatureSpec):
        raise ValueError(f"features is a {type(spec).__name__}, not a FeatureSpec")
    if spec.max_junctions < 1:
        raise ValueError(
            f"features.max_junctions is {spec.max_junctions}, not 1 or more; for a filter without "
            "junctions leave them out of filter.landmark_kinds"
        )
    for name in ("max_corners", "max_walls", "max_coarse_candidates"):
        if getattr(spec, name) < 0:
            raise ValueError(f"features.{name} is {getattr(spec, name)}, not 0 or more")


def _with_next(mask: Array) -> Array:
    """Whether (K,) bool a mask holds for a segment and for the next one."""
    return mask & jnp.roll(mask, -1)


def find_corners(spec: FeatureSpec, segments: Segments) -> Features:
    """Corners at which two segments meet, the best located first.

    A corner c solves n_k . c = n_k . centre_k for its two segments k, which also gives its
    covariance (both are fields of `Segments`). The free side of a concave corner is narrower than
    pi, of a convex one wider.

    Args:
        spec: Capacities and thresholds.
        segments: The straight segments of the scan.

    Returns:
        `spec.max_corners` features of kind `CORNER`, trusted ones first; robot frame.
    """
    along = segments.tangent
    following = jnp.roll(along, -1, axis=0)
    turn = jnp.arctan2(cross(along, following), dot(along, following))
    xy, cov = segments.ends[:, 1], segments.end_cov[:, 1]
    good = segments.meets_next & segments.valid & _with_next(segments.num_beams >= 3)
    good &= (jnp.abs(turn) > spec.min_corner_angle) & (
        jnp.abs(turn) < jnp.pi - spec.min_corner_angle
    )
    trace = cov[:, 0, 0] + cov[:, 1, 1]
    good &= trace < 0.02
    long = (segments.num_beams >= 5) & (segments.length > spec.min_corner_length)
    trusted = good & _with_next(long) & (trace < 0.005)
    # A trace is below 1: trusted corners come first.
    rank = jnp.where(good, trace - trusted.astype(trace.dtype), jnp.inf)
    order = jnp.argsort(rank, stable=True)[: spec.max_corners]
    inward = jnp.arctan2(segments.normal[:, 1], segments.normal[:, 0]) + 0.5 * turn
    angle = None
    if spec.incidence:
        own = segments.incidence
        angle = jnp.maximum(own, jnp.roll(own, -1))[order]
    zero = jnp.zeros(spec.max_corners, xy.dtype)
    return zero_padding(
        Features(
            kind=jnp.full(spec.max_corners, CORNER, jnp.int32),
            xy=xy[order],
            cov=cov[order],
            direction=wrap_angle(inward)[order],
            direction_variance=zero,
            descriptor=(jnp.pi - turn)[order],
            degree=jnp.full(spec.max_corners, 2, jnp.int32),
            certified=jnp.ones(spec.max_corners, bool),
            trusted=trusted[order],
            valid=good[order],
            incidence=angle,
        )
    )


def find_wall_directions(spec: FeatureSpec, segments: Segments) -> Features:
    """Directions of the walls of a scan: groups of long parallel segments, the longest first.

    A group holds all segments, not yet in a group, within 0.1 rad of the longest of them. Its
    direction is their mean, weighted by the inverse variances. No two directions need be at right
    angles: each is a landmark of its own.

    Args:
        spec: Capacities and thresholds.
        segments: The straight segments of the scan.

    Returns:
        `spec.max_walls` features of kind `WALL`; robot frame.
    """
    angle = jnp.arctan2(segments.tangent[:, 1], segments.tangent[:, 0])
    long = segments.valid & (segments.length > spec.min_wall_length) & (segments.num_beams >= 8)
    precision = 1.0 / segments.angle_variance
    length = jnp.where(long, segments.length, 0.0)

    def next_group(left: Array, _: None) -> tuple[Array, tuple[Array, Array, Array, Array | None]]:
        longest = jnp.argmax(left)
        difference = wrap_direction(angle - angle[longest])
        member = (left > 0.0) & (jnp.abs(difference) < 0.1)
        w = jnp.where(member, precision, 0.0)
        total = jnp.maximum(jnp.sum(w), 1e-6)
        mean = wrap_direction(angle[longest] + jnp.sum(w * difference) / total)
        own = segments.incidence[longest] if spec.incidence else None
        return jnp.where(member, 0.0, left), (mean, 1.0 / total, left[longest] > 0.0, own)

    _, (direction, variance, valid, own) = lax.scan(next_group, length, length=spec.max_walls)
    return zero_padding(
        Features(
            kind=jnp.full(spec.max_walls, WALL, jnp.int32),
            xy=jnp.zeros((spec.max_walls, 2), angle.dtype),
            cov=jnp.zeros((spec.max_walls, 2, 2), angle.dtype),
            direction=direction,
            direction_variance=variance,
            descriptor=jnp.zeros(spec.max_walls, angle.dtype),
            degree=jnp.zeros(spec.max_walls, jnp.int32),
            certified=jnp.ones(spec.max_walls, bool),
            trusted=valid,
            valid=valid,
            incidence=own,
        )
    )


def features_from_range_bearing(
    range_bearing: Array, valid: Array, range_std_fraction: float = 0.0
) -> Features:
    """Features of a sensor that measures range and bearing of landmarks itself.

    Args:
        range_bearing: (M, 2) range [m] and bearing [rad], robot frame; a NumPy array, list or JAX
            array, as `valid`.
        valid: (M,) bool, False marks padding.
        range_std_fraction: Standard deviation of the range as a fraction of the range, on top of
            the measurement noise that the filter assumes; not negative.

    Returns:
        M features of kind `JUNCTION`, all trusted; robot frame.

    Raises:
        ValueError: An argument has another shape, type or range; while tracing.
    """
    range_bearing = as_float("range_bearing", range_bearing, ("M", 2))
    valid = as_bool("valid", valid, range_bearing.shape[:1])
    if not isinstance(range_std_fraction, jax.core.Tracer) and range_std_fraction < 0.0:
        raise ValueError(f"range_std_fraction is {range_std_fraction}, which is below 0")
    count = valid.size
    zero, none = jnp.zeros(count, range_bearing.dtype), jnp.zeros(count, bool)
    xy = range_bearing[:, :1] * unit_vector(range_bearing[:, 1])
    return zero_padding(
        Features(
            kind=jnp.full(count, JUNCTION, jnp.int32),
            xy=xy,
            cov=range_std_fraction**2 * xy[:, :, None] * xy[:, None],
            direction=zero,
            direction_variance=zero,
            descriptor=zero + 1.0,
            degree=jnp.zeros(count, jnp.int32),
            certified=none,
            trusted=valid,
            valid=valid,
        )
    )
