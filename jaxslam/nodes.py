"""Features of one scan as one record; those found without a diagram: corners, wall directions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.edges import Runs
from jaxslam.geometry import cross, dot, unit, wrap_angle, wrap_line
from jaxslam.types import CORNER, NODE, WALL, Array, expect


class Nodes(NamedTuple):
    """Features of one scan, of all three kinds, padded to M; robot frame.

    Attributes:
        kind: (M,) int32, `NODE` (a junction), `CORNER` or `WALL`.
        xy: (M, 2) [m] position; zero for a wall direction.
        cov: (M, 2, 2) [m^2] covariance of the position.
        direction: (M,) [rad] of a corner: bisector of its free side; of a wall: of its line, in
            [-pi/2, pi/2); 0 for a junction.
        variance: (M,) [rad^2] of a wall's direction.
        shape: (M,) descriptor. Junction: clearance [m]; corner: angle of its free side [rad]; 0 for
            a wall.
        degree: (M,) int32 number of walls that the circle of a junction touches.
        certified: (M,) bool, all of the circle of a junction was seen.
        trusted: (M,) bool, may start a new landmark; the others are only matched with known ones.
        valid: (M,) bool, False marks padding.
    """

    kind: Array
    xy: Array
    cov: Array
    direction: Array
    variance: Array
    shape: Array
    degree: Array
    certified: Array
    trusted: Array
    valid: Array


class NodeSpec(NamedTuple):
    """How many features a scan may have, and their thresholds; static under jit.

    Attributes:
        nodes: Capacity for junctions.
        corners: Capacity for corners.
        walls: Capacity for wall directions.
        least: [m] smallest clearance of a junction.
        most: [m] largest clearance of a junction.
        distinct: [m] of junctions nearer to each other than this one is kept.
        apart: [rad] smallest angle between the feet of a trusted junction, seen from it.
        seen: Smallest fraction of the circle of a trusted junction that was seen.
        thick: [m] thickness of walls, by which they may continue unseen behind a visible end.
        hidden: [m] by which unseen walls may cut into the circle of a trusted junction.
        wall_length: [m] smallest length of a segment whose direction counts.
        corner_length: [m] smallest length of the segments of a trusted corner.
        corner_angle: [rad] smallest turn between the segments of a corner, and the smallest
            difference of the turn from pi.
        touch: Number of standard deviations from the circle of a junction within which a wall
            touches it.
    """

    nodes: int = 8
    corners: int = 8
    walls: int = 3
    least: float = 0.35
    most: float = 3.2
    distinct: float = 0.15
    apart: float = 0.6
    seen: float = 0.9
    thick: float = 0.25
    hidden: float = 0.02
    wall_length: float = 2.0
    corner_length: float = 0.12
    corner_angle: float = 0.6
    touch: float = 1.5

    @property
    def candidates(self) -> int:
        """Number of cells at which junctions are searched: three for each."""
        return 3 * self.nodes

    @property
    def size(self) -> int:
        """Number of features M of a scan."""
        return self.nodes + self.corners + self.walls


def _with_next(mask: Array) -> Array:
    """Whether (K,) bool a mask holds for a segment and for the next one."""
    return mask & jnp.roll(mask, -1)


def find_corners(runs: Runs, spec: NodeSpec) -> Nodes:
    """Corners at which two segments meet, the best located first.

    A corner c solves n_k . c = n_k . centre_k for its two segments k, which also gives its
    covariance (both are fields of `Runs`). The free side of a concave corner is narrower than pi,
    of a convex one wider.

    Args:
        runs: The straight segments of the scan.
        spec: Capacities and thresholds.

    Returns:
        `spec.corners` features of kind `CORNER`, trusted ones first; robot frame.
    """
    along = runs.along
    following = jnp.roll(along, -1, axis=0)
    turn = jnp.arctan2(cross(along, following), dot(along, following))
    xy, cov = runs.ends[:, 1], runs.end_cov[:, 1]
    good = runs.meets & runs.valid & _with_next(runs.count >= 3)
    good &= (jnp.abs(turn) > spec.corner_angle) & (jnp.abs(turn) < jnp.pi - spec.corner_angle)
    trace = cov[:, 0, 0] + cov[:, 1, 1]
    good &= trace < 0.02
    long = (runs.count >= 5) & (runs.length > spec.corner_length)
    trusted = good & _with_next(long) & (trace < 0.005)
    # A trace is below 1: trusted corners come first.
    rank = jnp.where(good, trace - trusted.astype(trace.dtype), jnp.inf)
    order = jnp.argsort(rank, stable=True)[: spec.corners]
    inward = jnp.arctan2(runs.normal[:, 1], runs.normal[:, 0]) + 0.5 * turn
    zero = jnp.zeros(spec.corners, xy.dtype)
    return blank(
        Nodes(
            kind=jnp.full(spec.corners, CORNER, jnp.int32),
            xy=xy[order],
            cov=cov[order],
            direction=wrap_angle(inward)[order],
            variance=zero,
            shape=(jnp.pi - turn)[order],
            degree=jnp.full(spec.corners, 2, jnp.int32),
            certified=jnp.ones(spec.corners, bool),
            trusted=trusted[order],
            valid=good[order],
        )
    )


def find_walls(runs: Runs, spec: NodeSpec) -> Nodes:
    """Directions of the walls of a scan: groups of long parallel segments, the longest first.

    A group holds all segments left within 0.1 rad of the longest one; its direction is their mean,
    weighted by the inverse variances. No two directions need be at right angles: each is a landmark
    of its own.

    Args:
        runs: The straight segments of the scan.
        spec: Capacities and thresholds.

    Returns:
        `spec.walls` features of kind `WALL`; robot frame.
    """
    angle = jnp.arctan2(runs.along[:, 1], runs.along[:, 0])
    long = runs.valid & (runs.length > spec.wall_length) & (runs.count >= 8)
    precision = 1.0 / runs.angle_variance
    length = jnp.where(long, runs.length, 0.0)

    def next_group(left: Array, _: None):
        longest = jnp.argmax(left)
        difference = wrap_line(angle - angle[longest])
        member = (left > 0.0) & (jnp.abs(difference) < 0.1)
        w = jnp.where(member, precision, 0.0)
        total = jnp.maximum(jnp.sum(w), 1e-6)
        mean = wrap_line(angle[longest] + jnp.sum(w * difference) / total)
        return jnp.where(member, 0.0, left), (mean, 1.0 / total, left[longest] > 0.0)

    _, (direction, variance, valid) = lax.scan(next_group, length, length=spec.walls)
    return blank(
        Nodes(
            kind=jnp.full(spec.walls, WALL, jnp.int32),
            xy=jnp.zeros((spec.walls, 2), angle.dtype),
            cov=jnp.zeros((spec.walls, 2, 2), angle.dtype),
            direction=direction,
            variance=variance,
            shape=jnp.zeros(spec.walls, angle.dtype),
            degree=jnp.zeros(spec.walls, jnp.int32),
            certified=jnp.ones(spec.walls, bool),
            trusted=valid,
            valid=valid,
        )
    )


def from_polar(polar: Array, valid: Array, part: float = 0.0) -> Nodes:
    """Features of a sensor that measures range and bearing of landmarks itself.

    Args:
        polar: (M, 2) range [m] and bearing [rad], robot frame.
        valid: (M,) bool, False marks padding.
        part: Standard deviation of the range as a fraction of the range, on top of the measurement
            noise that the filter assumes.

    Returns:
        M features of kind `NODE`, all trusted; robot frame.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    expect("polar", polar, ("M", 2), jnp.floating)
    expect("valid", valid, polar.shape[:1], jnp.bool_)
    count = valid.size
    zero, none = jnp.zeros(count, polar.dtype), jnp.zeros(count, bool)
    xy = polar[:, :1] * unit(polar[:, 1])
    return blank(
        Nodes(
            kind=jnp.full(count, NODE, jnp.int32),
            xy=xy,
            cov=part**2 * xy[:, :, None] * xy[:, None],
            direction=zero,
            variance=zero,
            shape=zero + 1.0,
            degree=jnp.zeros(count, jnp.int32),
            certified=none,
            trusted=valid,
            valid=valid,
        )
    )


def blank(nodes: Nodes) -> Nodes:
    """Set every number of the padding to zero, except `kind`."""
    valid = nodes.valid

    def clear(x: Array) -> Array:
        return jnp.where(valid.reshape(valid.shape + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x))

    return jax.tree.map(clear, nodes)._replace(kind=nodes.kind)


def restrict(nodes: Nodes, wanted: Array) -> Nodes:
    """Blank the features that are not valid, not `wanted` (M,) bool, or hold NaN or infinity."""
    numbers = (nodes.xy, nodes.cov, nodes.direction, nodes.variance, nodes.shape)
    for x in numbers:
        wanted &= jnp.all(jnp.isfinite(x.reshape(x.shape[0], -1)), axis=1)
    return blank(nodes._replace(valid=nodes.valid & wanted))


def join(*parts: Nodes) -> Nodes:
    """Concatenate features of one scan into one record."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
