"""Stretches of beams that lie on straight lines, and the lines: cut and fit."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.geometry import dot, unit
from jaxslam.lidar import Lidar, Scan, bearings
from jaxslam.types import Array

NONE = np.iinfo(np.int32).max  # in place of the first beam of padding


class Spans(NamedTuple):
    """Stretches of successive beams, padded to K; padding holds no beam."""

    first: Array  # (K,) int32 first beam; for padding a number past all beams
    last: Array  # (K,) int32 last beam; -1 for padding

    @property
    def size(self) -> Array:
        """Number (K,) int32 of their beams."""
        return jnp.maximum(self.last - self.first + 1, 0)

    def of_beam(self, beams: int) -> Array:
        """Stretch (R,) int32 that each beam is in, K for none."""
        beam = jnp.arange(beams, dtype=jnp.int32)[None]
        slot = jnp.arange(self.first.size, dtype=jnp.int32)[:, None]
        member = (self.first[:, None] <= beam) & (beam <= self.last[:, None])
        return jnp.min(jnp.where(member, slot, self.first.size), axis=0)


class Moments(NamedTuple):
    """Sums over points (2,) with weights, from which a line follows; leading axis K."""

    weight: Array  # (K,)
    mean: Array  # (K, 2) [m]
    scatter: Array  # (K, 3) sum of weighted xx, xy, yy [m^2] about the mean


class Lanes(NamedTuple):
    """Stretches that may end at the present beam, and their lines; leading axis C.

    In the polar frame turned to its first beam, a line is 1 / r = a cos(turn) + b sin(turn).
    """

    cost: Array  # (C,) of the best stretches up to the present beam, this one last
    first: Array  # (C,) int32 first beam
    heading: tuple[Array, Array]  # (C,), (C,) cosine and sine of its bearing
    line: tuple[Array, Array]  # (C,), (C,) a and b [1/m]
    cov: tuple[Array, Array, Array]  # (C,) each, of a and b: aa, ab, bb


class Partition(NamedTuple):
    """The beams of a scan cut into stretches."""

    begins: Array  # (R,) bool, a stretch begins at this beam
    normal: Array  # (R, 2) unit normal, away from the robot, of the line up to this beam


def partition(
    scan: Scan,
    breaks: Array,
    lidar: Lidar,
    sigma: float,
    *,
    price: float,
    outlier: float,
    lanes: int,
    uneven: float,
    grain: float,
    steep: float = 10.0,
) -> Partition:
    """Cut a scan into stretches of straight lines: the cut that costs least.

    The cost is the sum of squared residuals of ranges about the line of their stretch, in standard
    deviations of scanner and wall, and a price for each stretch. Beam by beam, every stretch that
    may still be part of the best cut takes the beam in by one step of recursive least squares: in
    1 / r a line is linear. The best cut up to a beam is the best cut up to the beginning of its
    last stretch, and this; what cannot be better any more makes room for the stretch that begins
    at the beam.

    Args:
        scan: The scan.
        breaks: (R,) bool, a stretch must begin at this beam.
        lidar: The scanner.
        sigma: [m] standard deviation of a range.
        price: Of a stretch.
        outlier: A beam costs no more than this, and then does not move the line.
        lanes: C, stretches that are followed together.
        uneven: [m] standard deviation by which walls step in and out of their line.
        grain: [m] length of wall over which they do so together.
        steep: Tangent of the angle of incidence that is one standard deviation beforehand.

    References:
        Jackson et al., An algorithm for optimal partitioning of data on an interval, 2005;
        Killick, Fearnhead, Eckley, Optimal detection of changepoints with a linear computational
        cost, 2012.
    """
    q = 1.0 / jnp.maximum(scan.ranges, 0.02)
    beam = jnp.arange(lidar.beams, dtype=jnp.int32)
    ray = unit(bearings(lidar)).astype(q.dtype)
    lane = jnp.arange(lanes, dtype=jnp.int32)

    def variance(q: Array, near: Array) -> Array:
        # Of 1 / r, `near` being that of the foot. A grain is hit by grain * q**2 / (step * near)
        # beams, which say the same thing.
        wall = near * jnp.maximum(near, grain / lidar.step * q * q)
        return q * q * ((sigma * q) ** 2 + uneven**2 * wall)

    def step(now: tuple[Lanes, Array, Array], beam: tuple):
        old, least, free = now
        index, q, c, s, alone = beam
        (hc, hs), (a, b), (aa, ab, bb) = old.heading, old.line, old.cov
        cosine, sine = c * hc + s * hs, s * hc - c * hs
        gain_a, gain_b = aa * cosine + ab * sine, ab * cosine + bb * sine
        off = q - a * cosine - b * sine
        noise = variance(q, jnp.sqrt(a * a + b * b))
        total = noise + cosine * gain_a + sine * gain_b
        excess = off * off / total
        share = jnp.where(excess < outlier, 1.0 / total, 0.0)
        cost = jnp.where(alone, jnp.inf, old.cost + jnp.minimum(excess, outlier))
        line = a + gain_a * share * off, b + gain_b * share * off
        cov = (
            aa - gain_a * share * gain_a,
            ab - gain_a * share * gain_b,
            bb - gain_b * share * gain_b,
        )
        zero = jnp.zeros_like(q)
        wide = variance(q, q), zero, (steep * q) ** 2
        fresh = Lanes(least + price, index, (c, s), (q, zero), wide)
        goes_on = Lanes(cost, old.first, old.heading, line, cov)
        new = jax.tree.map(lambda x, y: jnp.where(lane == free, x, y), fresh, goes_on)
        best, free = jnp.argmin(new.cost), jnp.argmax(new.cost).astype(jnp.int32)
        (hc, hs), (a, b) = jax.tree.map(lambda x: x[best], (new.heading, new.line))
        normal = hc * a - hs * b, hs * a + hc * b
        return (new, new.cost[best], free), (new.first[best], normal)

    zero, one = jnp.zeros(lanes, q.dtype), jnp.ones(lanes, q.dtype)
    none = Lanes(one * jnp.inf, lane, (one, zero), (zero, zero), (one, zero, one))
    alone = breaks | ~scan.hit
    start = none, jnp.zeros((), q.dtype), jnp.int32(0)
    _, (first, normal) = lax.scan(step, start, (beam, q, ray[:, 0], ray[:, 1], alone))

    def back(last: Array, beam: tuple[Array, Array]):
        index, before = beam
        begins = index == last
        return jnp.where(begins, before, last), begins

    _, begins = lax.scan(back, first[-1], (beam, jnp.roll(first, 1)), reverse=True)
    normal = jnp.stack(normal, axis=1)
    size = jnp.sqrt(jnp.maximum(dot(normal, normal), 1e-12))
    return Partition(begins, normal / size[:, None])


def longest(begins: Array, hit: Array, *, capacity: int) -> Spans:
    """The stretches with most beams, in the order of the beams.

    Args:
        begins: (R,) bool, a stretch begins at this beam.
        hit: (R,) bool, the beam returned; stretches of beams that did not are left out.
        capacity: K.
    """
    beams = hit.size
    beam = jnp.arange(beams, dtype=jnp.int32)
    following = lax.cummin(jnp.where(begins, beam, beams), reverse=True)
    last = jnp.append(following[1:], beams) - 1
    size, index = lax.top_k(jnp.where(begins & hit, last - beam + 1, 0), capacity)
    first = jnp.sort(jnp.where(size > 0, index, NONE))
    return Spans(first, last.at[first].get(mode="fill", fill_value=-1))


def moments(xy: Array, weight: Array, of: Array, *, lines: int) -> Moments:
    """Moments of points (R, 2) with weights (R,), of each of the K `lines` that `of` (R,) names."""
    one_hot = (of[None] == jnp.arange(lines, dtype=jnp.int32)[:, None]).astype(xy.dtype)
    weighed = weight[:, None] * xy
    sums = one_hot @ jnp.concatenate([weight[:, None], weighed], axis=1)
    total = sums[:, 0]
    mean = sums[:, 1:] / jnp.maximum(total, 1e-9)[:, None]
    d = xy - mean.at[of].get(mode="clip")
    wx, wy = weight * d[:, 0], weight * d[:, 1]
    scatter = one_hot @ jnp.stack([wx * d[:, 0], wx * d[:, 1], wy * d[:, 1]], axis=1)
    return Moments(total, mean, scatter)


def principal(scatter: Array) -> tuple[Array, Array, Array]:
    """Normal (..., 2), sum of squares across (...,) and along (...,) of scatters (..., 3)."""
    xx, xy, yy = scatter[..., 0], scatter[..., 1], scatter[..., 2]
    half, part = 0.5 * (xx + yy), 0.5 * (xx - yy)
    flat = (jnp.abs(xy) < 1e-12) & (jnp.abs(part) < 1e-12)
    angle = 0.5 * jnp.arctan2(jnp.where(flat, 0.0, xy), jnp.where(flat, 1.0, part))
    tilt = jnp.sqrt(jnp.where(flat, 1e-24, part**2 + xy**2))
    return unit(angle + 0.5 * jnp.pi), jnp.maximum(half - tilt, 0.0), half + tilt
