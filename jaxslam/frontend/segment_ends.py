"""Ends of straight wall segments: corners where two meet, and free or occluding ends."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import vector_length
from jaxslam.core.types import Array
from jaxslam.frontend.line_fitting import BeamIntervals
from jaxslam.frontend.segments import SegmentSpec


class EndBeams(NamedTuple):
    """First and last return of each piece.

    Attributes:
        first: (K,) int32 first beam.
        last: (K,) int32 last beam.
        inner: (K, 2) int32 first return after the first beam, and last before the last one.
        x: (K, 2) [m] of the hits.
        y: (K, 2) [m] of the hits.
        ranges: (K, 2) [m].
        beyond: (K, 2) [m] range of the next return outside the piece, or of the next beam if that
            begins more than a drop-out; 0 outside the field of view.
        gap: (K, 2) number of beams to it.
        jump: (K, 2) 1.0 if a jump is between the two, else 0.0.
        normal: (K, 2) of the line that the partition fitted.
    """

    first: Array
    last: Array
    inner: Array
    x: Array
    y: Array
    ranges: Array
    beyond: Array
    gap: Array
    jump: Array
    normal: Array


class FittedLines(NamedTuple):
    """Lines of K pieces, by coordinates: n = (nx, ny) towards the robot, c = (cx, cy) the centre.

    The direction is u = (ny, -nx). `offset_variance` and `angle_variance` are those of `Segments`.
    """

    nx: Array
    ny: Array
    cx: Array
    cy: Array
    offset_variance: Array
    angle_variance: Array
    centre: Array

    def coordinate(self, x: Array, y: Array) -> Array:
        """Position (K, 2) [m] of points (K, 2) along their line: u (p - c)."""
        cx, cy = self.cx[:, None], self.cy[:, None]
        return (x - cx) * self.ny[:, None] - (y - cy) * self.nx[:, None]


class SegmentEnds(NamedTuple):
    """Ends of pieces, (K,) or (K, 2): position [m], and entries xx, xy, yy of the covariance."""

    x: Array
    y: Array
    cov_xx: Array
    cov_xy: Array
    cov_yy: Array


def project_ends(end_beams: EndBeams, line: FittedLines, fitted: Array) -> tuple[Array, Array]:
    """Outermost hits x, y (K, 2) [m], projected onto the line where there is one: c + s u."""
    x, y = end_beams.x, end_beams.y
    along = line.coordinate(x, y)
    x = jnp.where(fitted[:, None], line.cx[:, None] + along * line.ny[:, None], x)
    y = jnp.where(fitted[:, None], line.cy[:, None] - along * line.nx[:, None], y)
    return x, y


def adjacent(intervals: BeamIntervals, end_beams: EndBeams) -> Array:
    """Whether the next piece (K,) begins at the next beam, without a jump between them."""
    slot = jnp.arange(intervals.first.size, dtype=jnp.int32)
    next_beam = intervals.last + 1 == jnp.roll(intervals.first, -1)
    return (slot < slot.size - 1) & next_beam & (end_beams.jump[:, 1] == 0.0)


def segment_corners(
    line: FittedLines,
    x: Array,
    y: Array,
    adjacent: Array,
    fitted: Array,
    noise: float,
    lidar: Lidar,
    spec: SegmentSpec,
) -> tuple[SegmentEnds, Array]:
    """Intersection of the line of each piece with that of the next one.

    With n, c of a line, m, d of the next and turn = n x m (the sine of the angle between them):

        corner p:        n (p - c) = 0,  m (p - d) = 0
                         p = c - s u,    s = m (d - c) / turn
        its covariance:  A^-1 diag(v, w) A^-T,  A = [n; m],  det A = turn
                         A^-1 = [[my, -ny], [-mx, nx]] / turn

    where v and w are the variances of the two lines across themselves, at p.

    Args:
        line: Lines of the pieces.
        x: (K, 2) [m] ends on the lines.
        y: (K, 2) [m] ends on the lines.
        adjacent: (K,) bool.
        fitted: (K,) bool.
        noise: [m] standard deviation of a range.
        lidar: The scanner.
        spec: Parameters.

    Returns:
        The corners (K,), and whether the two pieces meet there: they are adjacent, their lines are
        not nearly parallel, and the corner is near the end of one and the beginning of the other.
    """
    nx, ny, cx, cy = line.nx, line.ny, line.cx, line.cy
    own = [nx, ny, cx, cy, line.offset_variance, line.angle_variance, x[:, 0], y[:, 0]]
    following = jnp.roll(jnp.stack(own), -1, axis=1)
    mx, my, dx, dy, next_offset_variance, next_angle_variance, next_x, next_y = following
    turn = nx * my - ny * mx
    safe = jnp.where(jnp.abs(turn) > 0.1, turn, 1.0)
    along = ((dx - cx) * mx + (dy - cy) * my) / safe
    corner_x, corner_y = cx - ny * along, cy + nx * along

    tolerance = spec.corner_tolerance + 3 * noise / jnp.maximum(jnp.abs(turn), 0.3)
    tolerance += 2 * lidar.angle_increment * vector_length(corner_x, corner_y)
    near = vector_length(corner_x - x[:, 1], corner_y - y[:, 1]) < tolerance
    near &= vector_length(corner_x - next_x, corner_y - next_y) < tolerance
    meets = adjacent & fitted & jnp.roll(fitted, -1) & (jnp.abs(turn) > 0.3) & near

    next_along = (corner_x - dx) * my - (corner_y - dy) * mx
    variance = (along**2 * line.angle_variance + line.offset_variance) / safe**2
    next_variance = (next_along**2 * next_angle_variance + next_offset_variance) / safe**2
    corner = SegmentEnds(
        x=corner_x,
        y=corner_y,
        cov_xx=variance * my * my + next_variance * ny * ny,
        cov_xy=-variance * my * mx - next_variance * ny * nx,
        cov_yy=variance * mx * mx + next_variance * nx * nx,
    )
    return corner, meets


def free_ends(
    line: FittedLines, x: Array, y: Array, end_beams: EndBeams, fitted: Array, lidar: Lidar
) -> tuple[SegmentEnds, Array]:
    """Ends (K, 2) of pieces that are no corners, and which of them are occluding ends.

    An occluding end is on the near side of a jump: the beam beyond passes the wall. So the wall
    ends between the two beams, on average half their spacing on the wall beyond the last hit:

        half = gap * step / 2 * range / cos(incidence)

    The covariance is n n' across + u u' (across + half^2 / 3), where `across` is the variance of
    the line at the end: along it, the end is uniform within +-half.

    Args:
        line: Lines of the pieces.
        x: (K, 2) [m] ends on the lines.
        y: (K, 2) [m] ends on the lines.
        end_beams: The outermost beams.
        fitted: (K,) bool; the ends of other pieces stay where they are.
        lidar: The scanner.
    """
    nx, ny = line.nx[:, None], line.ny[:, None]
    distance = vector_length(x, y)
    cos_incidence = jnp.abs(nx * x + ny * y) / jnp.maximum(distance, 1e-6)
    half = 0.5 * lidar.angle_increment * end_beams.gap * distance / jnp.maximum(cos_incidence, 0.1)
    occluding = end_beams.jump > 0.0
    occluding &= end_beams.ranges < jnp.minimum(end_beams.beyond, 0.9 * lidar.range_max)
    outwards = jnp.array([-1.0, 1.0], x.dtype)[None]
    shift = jnp.where(occluding & fitted[:, None], half, 0.0) * outwards
    x, y = x + ny * shift, y - nx * shift

    offset_variance, angle_variance = line.offset_variance[:, None], line.angle_variance[:, None]
    across = offset_variance + line.coordinate(x, y) ** 2 * angle_variance
    along = across + half**2 / 3
    ends = SegmentEnds(
        x=x,
        y=y,
        cov_xx=across * nx * nx + along * ny * ny,
        cov_xy=(across - along) * nx * ny,
        cov_yy=across * ny * ny + along * nx * nx,
    )
    return ends, occluding
