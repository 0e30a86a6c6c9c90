"""Optimal partition of the beams of a scan into straight segments, and moments of line fits."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import dot, unit_vector
from jaxslam.core.types import Array
from jaxslam.frontend.lidar import beam_angles
from jaxslam.frontend.trailing_batch import with_trailing_batch

NO_BEAM = np.iinfo(np.int32).max  # first beam of padding
MAX_EXACT_BEAMS = 4096  # of fewer the square is exact in float32


class BeamIntervals(NamedTuple):
    """Intervals of successive beams, padded to K; padding holds no beam.

    Attributes:
        first: (K,) int32 first beam; of padding a number past all beams.
        last: (K,) int32 last beam; -1 of padding.
    """

    first: Array
    last: Array

    @property
    def size(self) -> Array:
        """Number (K,) int32 of their beams."""
        return jnp.maximum(self.last - self.first + 1, 0)

    def interval_of_beam(self, num_beams: int) -> Array:
        """Index (R,) int32 of the interval that each beam is in, K for none."""
        beam = jnp.arange(num_beams, dtype=jnp.int32)[None]
        slot = jnp.arange(self.first.size, dtype=jnp.int32)[:, None]
        member = (self.first[:, None] <= beam) & (beam <= self.last[:, None])
        return jnp.min(jnp.where(member, slot, self.first.size), axis=0)


class Moments(NamedTuple):
    """Weighted moments of points, from which K lines follow.

    Attributes:
        weight: (K,) sum of the weights.
        mean: (K, 2) [m] weighted mean.
        scatter: (K, 3) weighted sums of xx, xy, yy about the mean, [m^2] times the weight's unit.
    """

    weight: Array
    mean: Array
    scatter: Array


class LineCandidates(NamedTuple):
    """Candidates for the last segment up to the present beam, with their lines: C of B scans.

    Each candidate is one choice of the segment's first beam. Its line is
    1 / r = a cos(t) + b sin(t), where t is the bearing from that first beam; see `partition_beams`.

    Attributes:
        cost: (C, B) of the best partition up to the present beam that ends in this segment.
        first: (C, B) int32 first beam of the segment.
        heading: Two of (C, B), cosine and sine of the bearing of the first beam, robot frame.
        line: Two of (C, B), a and b [1/m].
        cov: Three of (C, B), covariance of a and b: aa, ab, bb [1/m^2].
    """

    cost: Array
    first: Array
    heading: tuple[Array, Array]
    line: tuple[Array, Array]
    cov: tuple[Array, Array, Array]


class Partition(NamedTuple):
    """Partition of the beams of a scan into segments.

    Attributes:
        begins: (R,) bool, a segment begins at this beam.
        normal: (R, 2) unit normal, away from the robot, of the line fitted up to this beam.
    """

    begins: Array
    normal: Array


_Pair = tuple[Array, Array]
_Carry = tuple[LineCandidates, Array, Array]
"""Candidates, the least of their costs (B,), and index of the one that costs most (B,)."""


def partition_beams(
    lidar: Lidar,
    scan: Scan,
    breaks: Array,
    measured: Array,
    range_std: float,
    *,
    segment_cost: float,
    outlier_cost: float,
    num_candidates: int,
    roughness_std: float,
    roughness_length: float,
    max_incidence: float = 10.0,
) -> Partition:
    """Partition a scan into straight segments, at the least cost.

    Line. A wall at the distance d, with its normal at the bearing p, is r cos(bearing - p) = d:

        1 / r = a cos(t) + b sin(t),    a = cos(p - p0) / d,    b = sin(p - p0) / d

    with t = bearing - p0, and p0 the bearing of the segment's first beam. So q = 1 / r is linear in
    (a, b). There sqrt(a^2 + b^2) = 1 / d is the inverse distance of the foot of the perpendicular,
    and b / a the tangent of the angle of incidence at t = 0. The prior is a = q with its variance,
    and b = 0 with the standard deviation `max_incidence` * q.

    Fit. Each beam is one step of recursive least squares, h = (cos t, sin t) (`_add_beam`):

        innovation = q - h (a, b)
        variance   = var(q) + h P h'
        gain       = P h' / variance
        (a, b)    += gain innovation
        P         -= gain h P
        cost      += innovation^2 / variance    adds up to the squared residuals of the final line

    Partition. With F(j) the least cost of beams 0..j and C(i, j) the cost of the line of i..j,

        F(-1) = 0,    F(j) = min over i <= j of F(i - 1) + segment_cost + C(i, j)

    A candidate holds one i, and its cost is the term under the minimum. At each beam all candidates
    take the beam in, and a new one starts with i = j. To bound their number, it replaces the one
    that cost most after the beam before; with as many candidates as beams the partition is optimal.
    From the best i of each beam the first beams of the segments follow backwards (`_backtrack`).

    Args:
        lidar: The scanner.
        scan: The scan.
        breaks: (R,) bool, a segment must begin at this beam.
        measured: (R,) bool; hits that are not measured begin no segment and cost nothing.
        range_std: [m] standard deviation of a range.
        segment_cost: Cost of a segment, in squared standard deviations.
        outlier_cost: Bound of the cost of one beam; a beam that reaches it does not change the
            line.
        num_candidates: C, number of candidates that are kept.
        roughness_std: [m] standard deviation of the wall about its line.
        roughness_length: [m] length of wall over which that deviation is the same.
        max_incidence: Standard deviation of the tangent of the angle of incidence in the prior.

    References:
        Jackson et al., An algorithm for optimal partitioning of data on an interval, 2005;
        Killick, Fearnhead, Eckley, Optimal detection of changepoints with a linear computational
        cost, 2012.
    """
    beam = np.arange(lidar.num_beams, dtype=np.int32)
    candidate = np.arange(num_candidates, dtype=np.int32)[:, None]

    def variance(q: Array, foot: Array) -> Array:
        """Variance [1/m^2] of q = 1 / r on a line whose foot has the inverse distance `foot`.

        A range error e changes q by -q^2 e, an offset e of the wall by -q foot e. The offset is
        the same for all roughness_length q^2 / (angle_increment foot) beams that hit one piece of
        wall of `roughness_length`, so that one beam counts the less, the more of them there are.
        """
        wall = foot * jnp.maximum(foot, roughness_length / lidar.angle_increment * q * q)
        return q * q * ((range_std * q) ** 2 + roughness_std**2 * wall)

    def step(carry: _Carry, observed: tuple[Array, ...]) -> tuple[_Carry, tuple[Array, _Pair]]:
        old, least_cost, worst = carry
        index, q, cosine, sine, must_begin, skip = observed  # of the beam: (B,), or () for all
        least, q, must_begin, skip = (x[None] for x in (least_cost, q, must_begin, skip))
        foot = jnp.sqrt(old.line[0] ** 2 + old.line[1] ** 2)
        extended = _add_beam(old, q, (cosine, sine), variance(q, foot), outlier_cost)
        extended = extended._replace(cost=jnp.where(must_begin, jnp.inf, extended.cost))
        zero = jnp.zeros_like(q)
        prior_cov = variance(q, q), zero, (max_incidence * q) ** 2
        begun = LineCandidates(least + segment_cost, index, (cosine, sine), (q, zero), prior_cov)
        replaced = (candidate == worst[None]) & ~skip
        new = jax.tree.map(
            lambda x, y, z: jnp.where(replaced, x, jnp.where(skip, z, y)), begun, extended, old
        )
        least_cost, most = jnp.min(new.cost, axis=0), jnp.max(new.cost, axis=0)
        best, worst = (  # the first of equal ones
            jnp.min(jnp.where(new.cost == x[None], candidate, num_candidates - 1), axis=0)
            for x in (least_cost, most)
        )
        item = jnp.arange(best.size, dtype=jnp.int32)
        fields = new.first, new.heading, new.line
        first, (cos0, sin0), (a, b) = jax.tree.map(lambda x: x[best, item], fields)
        normal = cos0 * a - sin0 * b, sin0 * a + cos0 * b  # (a, b) turned to the robot frame
        return (new, least_cost, worst), (first, normal)

    def best_segments(q: Array, must_begin: Array, skipped: Array) -> tuple[Array, _Pair]:
        """First beam and normal of the best segment up to each beam, all (R, B)."""
        zero = jnp.zeros((num_candidates, q.shape[1]), q.dtype)
        one, index = zero + 1.0, jnp.broadcast_to(candidate, zero.shape)
        unused = LineCandidates(one * jnp.inf, index, (one, zero), (zero, zero), (one, zero, one))
        start = unused, zero[0], index[0]
        ray = unit_vector(beam_angles(lidar)).astype(q.dtype)
        beams = jnp.asarray(beam), q, ray[:, 0], ray[:, 1], must_begin, skipped
        return lax.scan(step, start, beams)[1]

    q = 1.0 / jnp.maximum(scan.ranges, 0.02)
    partition = with_trailing_batch(best_segments)
    first, normal = partition(q, breaks | ~scan.hit, scan.hit & ~measured)
    normals = jnp.stack(normal, axis=1)
    size = jnp.sqrt(jnp.maximum(dot(normals, normals), 1e-12))
    return Partition(_backtrack(jnp.asarray(beam), first), normals / size[:, None])


def _add_beam(
    candidates: LineCandidates, q: Array, ray: tuple[Array, Array], variance: Array, outlier: float
) -> LineCandidates:
    """Extend all candidates by one beam: a step of recursive least squares (`partition_beams`).

    Args:
        candidates: The candidates up to the beam before.
        q: (1, B) [1/m] inverse range of the beam.
        ray: Cosine and sine of its bearing.
        variance: (C, B) [1/m^2] of q, on the line of each.
        outlier: Squared standard deviations from which on the beam does not change a line.
    """
    (cosine, sine), (cos0, sin0) = ray, candidates.heading
    (a, b), (aa, ab, bb) = candidates.line, candidates.cov
    # h = (cos t, sin t), and P h'.
    cos_t, sin_t = cosine * cos0 + sine * sin0, sine * cos0 - cosine * sin0
    cov_a, cov_b = aa * cos_t + ab * sin_t, ab * cos_t + bb * sin_t
    innovation = q - a * cos_t - b * sin_t
    total = variance + cos_t * cov_a + sin_t * cov_b
    squared = innovation * innovation / total
    inverse = jnp.where(squared < outlier, 1.0 / total, 0.0)
    return LineCandidates(
        cost=candidates.cost + jnp.minimum(squared, outlier),
        first=candidates.first,
        heading=candidates.heading,
        line=(a + cov_a * inverse * innovation, b + cov_b * inverse * innovation),
        cov=(
            aa - cov_a * inverse * cov_a,
            ab - cov_a * inverse * cov_b,
            bb - cov_b * inverse * cov_b,
        ),
    )


def _backtrack(beam: Array, first: Array) -> Array:
    """Beams (R,) bool at which segments begin.

    Args:
        beam: (R,) int32 0..R-1.
        first: (R,) int32 first beam of the last segment of the best partition up to each beam.
    """

    def step(segment_first: Array, here: tuple[Array, Array]) -> tuple[Array, Array]:
        index, first_before = here
        begins = index == segment_first
        return jnp.where(begins, first_before, segment_first), begins

    return lax.scan(step, first[-1], (beam, jnp.roll(first, 1)), reverse=True)[1]


def longest_intervals(begins: Array, hit: Array, *, capacity: int) -> BeamIntervals:
    """The segments with most beams, in the order of the beams.

    Args:
        begins: (R,) bool, a segment begins at this beam.
        hit: (R,) bool, the beam returned; segments of beams that did not are left out.
        capacity: K.
    """
    num_beams = hit.size
    beam = jnp.arange(num_beams, dtype=jnp.int32)
    next_first = lax.cummin(jnp.where(begins, beam, num_beams), reverse=True)
    last = jnp.append(next_first[1:], num_beams) - 1
    size = jnp.where(begins & hit, last - beam + 1, 0)
    if num_beams < MAX_EXACT_BEAMS:
        # `top_k` of reals selects, that of integers sorts. Of equal sizes the first beam counts.
        key = (size * num_beams + (num_beams - 1 - beam)).astype(jnp.float32)
        index = lax.top_k(key, capacity)[1]
    else:
        index = lax.top_k(size, capacity)[1]
    first = jnp.sort(jnp.where(size[index] > 0, index, NO_BEAM))
    return BeamIntervals(first, last.at[first].get(mode="fill", fill_value=-1))


def line_moments(xy: Array, weight: Array, of: Array, *, lines: int) -> Moments:
    """Weighted moments of the points of each of K lines.

    Args:
        xy: (R, 2) [m] points.
        weight: (R,) weight of each.
        of: (R,) int32 line of each point; other numbers than 0..K-1 count nowhere.
        lines: K.
    """
    # Lines last: of a product, that is the axis that is vectorised.
    one_hot = (of[:, None] == jnp.arange(lines, dtype=jnp.int32)[None]).astype(xy.dtype)
    wx, wy = weight * xy[:, 0], weight * xy[:, 1]
    total, sum_x, sum_y = jnp.stack([weight, wx, wy]) @ one_hot
    mean = jnp.stack([sum_x, sum_y], axis=1) / jnp.maximum(total, 1e-9)[:, None]
    offset = xy - mean.at[of].get(mode="clip")
    wx, wy = weight * offset[:, 0], weight * offset[:, 1]
    products = jnp.stack([wx * offset[:, 0], wx * offset[:, 1], wy * offset[:, 1]])
    return Moments(total, mean, jnp.stack([*(products @ one_hot)], axis=1))


def principal_axes(scatter: Array) -> tuple[Array, Array, Array]:
    """Principal axes of scatter matrices: total least squares lines.

    The eigenvalues of [[xx, xy], [xy, yy]] are half +- tilt, half = (xx + yy) / 2 and
    tilt^2 = ((xx - yy) / 2)^2 + xy^2; the larger one's axis has the angle atan2(xy, part) / 2 with
    part = (xx - yy) / 2. Equal eigenvalues give the axis x, with finite derivatives.

    Args:
        scatter: (..., 3) xx, xy, yy.

    Returns:
        Unit normal (..., 2) of the line, sum of squares across it (...,) and along it (...,).
    """
    xx, xy, yy = scatter[..., 0], scatter[..., 1], scatter[..., 2]
    half, part = 0.5 * (xx + yy), 0.5 * (xx - yy)
    flat = (jnp.abs(xy) < 1e-12) & (jnp.abs(part) < 1e-12)
    angle = 0.5 * jnp.arctan2(jnp.where(flat, 0.0, xy), jnp.where(flat, 1.0, part))
    tilt = jnp.sqrt(jnp.where(flat, 1e-24, part**2 + xy**2))
    return unit_vector(angle + 0.5 * jnp.pi), jnp.maximum(half - tilt, 0.0), half + tilt
