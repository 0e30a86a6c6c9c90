"""Landmarks of one scan as one record; those that need no diagram: corners and wall directions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.edges import Runs
from jaxslam.geometry import cross, dot, unit, wrap_angle, wrap_line
from jaxslam.types import CORNER, NODE, WALL, Array, expect


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
    trusted: Array  # (M,) bool, worth a new landmark; the others may be matched with known ones
    valid: Array  # (M,) bool, False marks padding


class NodeSpec(NamedTuple):
    """How many landmarks a scan may have, and what makes them; static under jit."""

    nodes: int = 8
    corners: int = 8
    walls: int = 3
    least: float = 0.35  # [m] smallest clearance of a node
    most: float = 3.2  # [m] largest
    distinct: float = 0.15  # [m] nodes nearer to each other than this are one
    apart: float = 0.6  # [rad] three feet of a trusted node differ by this, seen from it
    seen: float = 0.9  # part of the circle of a trusted node that was seen
    thick: float = 0.25  # [m] of walls, as far as they may hide themselves
    hidden: float = 0.02  # [m] by which such may reach into the circle of a trusted node
    wall_length: float = 2.0  # [m] of a run whose direction counts
    corner_length: float = 0.12  # [m] of the runs of a corner that is trusted
    corner_angle: float = 0.6  # [rad] by which these must turn
    touch: float = 1.5  # standard deviations from the circle of a node within which a wall touches

    @property
    def candidates(self) -> int:
        """Number of places that are looked at for nodes: for each node three."""
        return 3 * self.nodes

    @property
    def size(self) -> int:
        """Number of landmarks M of a scan."""
        return self.nodes + self.corners + self.walls


def find_corners(runs: Runs, spec: NodeSpec) -> Nodes:
    """Corners in which two runs meet, the best located first.

    A corner c solves n_k . c = n_k . centre_k for its two runs, which also gives its covariance.
    The free side of a concave corner is narrower than a straight angle, of a convex one wider.
    """
    along = runs.along
    following = jnp.roll(along, -1, axis=0)
    turn = jnp.arctan2(cross(along, following), dot(along, following))
    place, cov = runs.ends[:, 1], runs.end_cov[:, 1]
    both = lambda x: x & jnp.roll(x, -1)
    good = runs.meets & runs.valid & both(runs.count >= 3)
    good &= (jnp.abs(turn) > spec.corner_angle) & (jnp.abs(turn) < jnp.pi - spec.corner_angle)
    size = cov[:, 0, 0] + cov[:, 1, 1]
    good &= size < 0.02
    trusted = good & both((runs.count >= 5) & (runs.length > spec.corner_length)) & (size < 0.005)
    order = jnp.argsort(jnp.where(good, size - trusted.astype(size.dtype), jnp.inf), stable=True)[
        : spec.corners
    ]
    inward = jnp.arctan2(runs.normal[:, 1], runs.normal[:, 0]) + 0.5 * turn
    zero = jnp.zeros(spec.corners, place.dtype)
    return blank(
        Nodes(
            kind=jnp.full(spec.corners, CORNER, jnp.int32),
            xy=place[order],
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
    """Directions of the walls of a scan: groups of long parallel runs, the longest first.

    No two directions need be at right angles: each is a landmark of its own.
    """
    angle = jnp.arctan2(runs.along[:, 1], runs.along[:, 0])
    long = runs.valid & (runs.length > spec.wall_length) & (runs.count >= 8)
    precision = 1.0 / runs.angle_variance
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
    """Features of a sensor that itself tells range and bearing of landmarks.

    Args:
        polar: (M, 2) range [m] and bearing [rad].
        valid: (M,) bool, False marks padding.
        part: Their own standard deviation is this part of their range, along it. By default there
            is none: what the filter assumes of range and bearing is all.

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
    """Set every number of the padding to zero."""
    keep = nodes.valid

    def clear(x: Array) -> Array:
        return jnp.where(keep.reshape(keep.shape + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x))

    return jax.tree.map(clear, nodes)._replace(kind=nodes.kind)


def restrict(nodes: Nodes, wanted: Array) -> Nodes:
    """Blank the landmarks that are not valid, not `wanted` (M,) bool, or hold NaN or infinity."""
    numbers = (nodes.xy, nodes.cov, nodes.direction, nodes.variance, nodes.shape)
    for x in numbers:
        wanted &= jnp.all(jnp.isfinite(x.reshape(x.shape[0], -1)), axis=1)
    return blank(nodes._replace(valid=nodes.valid & wanted))


def join(*parts: Nodes) -> Nodes:
    """All landmarks of a scan in one record."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
