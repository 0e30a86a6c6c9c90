"""Stretches of beams that lie on straight lines, and the lines: split, merge and fit."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.geometry import dot, unit
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


def stretches(breaks: Array, hit: Array, *, capacity: int) -> Spans:
    """The `capacity` longest stretches of beams that return, cut where `breaks` (R,) bool.

    Args:
        breaks: A stretch begins at this beam.
        hit: (R,) bool, the beam returned.
        capacity: K; the stretches with the fewest beams are left out.
    """
    beams = hit.size
    beam = jnp.arange(beams, dtype=jnp.int32)
    ends = hit & jnp.append((breaks | ~hit)[1:], True)
    first = jnp.sort(jnp.where(breaks & hit, beam, beams))
    last = jnp.sort(jnp.where(ends, beam, beams))
    return longest(Spans(first, jnp.where(last < beams, last, -1)), capacity=capacity)


def longest(spans: Spans, *, capacity: int) -> Spans:
    """The stretches with most beams, in the order of the beams."""
    size, index = lax.top_k(spans.size, capacity)
    index = jnp.sort(jnp.where(size > 0, index, spans.first.size))
    return Spans(
        spans.first.at[index].get(mode="fill", fill_value=NONE),
        spans.last.at[index].get(mode="fill", fill_value=-1),
    )


def split(spans: Spans, xy: Array, tolerance: float, *, rounds: int) -> Spans:
    """Cut stretches where their points are furthest from their chord, if too far.

    Args:
        spans: Stretches; padding is what can be filled with new ones.
        xy: (R, 2) [m] the points.
        tolerance: [m] from the chord.
        rounds: How often every stretch may be cut in two.
    """
    beams, capacity = len(xy), spans.first.size
    bits = int(beams - 1).bit_length()
    beam = jnp.arange(beams, dtype=jnp.int32)
    slot = jnp.arange(capacity, dtype=jnp.int32)

    def step(now, _):
        spans, of = now
        start = xy[jnp.minimum(spans.first, beams - 1)]
        chord = xy[jnp.maximum(spans.last, 0)] - start
        size = jnp.maximum(jnp.sqrt(dot(chord, chord)), 1e-6)
        normal = jnp.stack([-chord[:, 1], chord[:, 0]], axis=1) / size[:, None]
        # A chord of almost no length says nothing of direction: take the distance to its start.
        short = (size < 0.05)[:, None].astype(xy.dtype)
        mine = jnp.concatenate([start, normal, short], axis=1).at[of].get(mode="clip")
        d = xy - mine[:, :2]
        off = jnp.where(mine[:, 4] > 0.0, jnp.sqrt(dot(d, d)), jnp.abs(dot(mine[:, 2:4], d)))
        # The furthest beam and its distance in one integer: distances in high bits, 1 mm each.
        code = jnp.minimum(off * 1e3, 2.0 ** (30 - bits)).astype(jnp.int32) << bits | beam
        worst = jnp.max(jnp.where(of[None] == slot[:, None], code, 0), axis=1)
        at = worst & (2**bits - 1)
        cut = (worst >> bits) > round(tolerance * 1e3)
        used = jnp.sum(spans.size > 0, dtype=jnp.int32)
        fresh = used + jnp.sum(cut[None] & (slot[None] < slot[:, None]), axis=1, dtype=jnp.int32)
        cut &= fresh < capacity
        into = jnp.where(cut, fresh, capacity)
        first = spans.first.at[into].set(at, mode="drop")
        last = spans.last.at[into].set(spans.last, mode="drop")
        last = jnp.where(cut, at - 1, last)
        new = jnp.stack([into, at], axis=1).at[of].get(mode="fill", fill_value=capacity)
        of = jnp.where((new[:, 0] < capacity) & (beam >= new[:, 1]), new[:, 0], of)
        return (Spans(first, last), of), None

    # Free slots come last.
    spans = lax.scan(step, (spans, spans.of_beam(beams)), length=rounds)[0][0]
    return Spans(*lax.sort(tuple(spans), num_keys=1))


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


def joined(a: Moments, b: Moments) -> Moments:
    """Moments of two sets of points together."""
    total = jnp.maximum(a.weight + b.weight, 1e-9)
    gap = b.mean - a.mean
    outer = jnp.stack([gap[:, 0] ** 2, gap[:, 0] * gap[:, 1], gap[:, 1] ** 2], axis=1)
    return Moments(
        a.weight + b.weight,
        a.mean + gap * (b.weight / total)[:, None],
        a.scatter + b.scatter + outer * (a.weight * b.weight / total)[:, None],
    )


def principal(scatter: Array) -> tuple[Array, Array, Array]:
    """Normal (..., 2), sum of squares across (...,) and along (...,) of scatters (..., 3)."""
    xx, xy, yy = scatter[..., 0], scatter[..., 1], scatter[..., 2]
    half, part = 0.5 * (xx + yy), 0.5 * (xx - yy)
    flat = (jnp.abs(xy) < 1e-12) & (jnp.abs(part) < 1e-12)
    angle = 0.5 * jnp.arctan2(jnp.where(flat, 0.0, xy), jnp.where(flat, 1.0, part))
    tilt = jnp.sqrt(jnp.where(flat, 1e-24, part**2 + xy**2))
    return unit(angle + 0.5 * jnp.pi), jnp.maximum(half - tilt, 0.0), half + tilt


def merge(spans: Spans, xy: Array, apart: Array, tolerance: float, *, rounds: int) -> Spans:
    """Join neighbours whose points lie on one line as well as on two.

    Two stretches are joined if the sum of squares across their lines grows by less than the
    square of the tolerance, those that fit best first.

    Args:
        spans: Stretches in the order of the beams.
        xy: (R, 2) [m] the points.
        apart: (R,) bool, the stretch that begins at this beam is not to be joined to the left.
        tolerance: [m] of one point; n points may be off by its n^.5 th part.
        rounds: How often pairs are joined.
    """
    beams, capacity = len(xy), spans.first.size
    slot = jnp.arange(capacity, dtype=jnp.int32)
    beside = spans.last + 1 == jnp.roll(spans.first, -1)
    beside &= ~apart.at[jnp.roll(spans.first, -1)].get(mode="fill", fill_value=True)
    beside &= slot < capacity - 1
    sums = moments(xy, jnp.ones_like(xy[:, 0]), spans.of_beam(beams), lines=capacity)

    def step(now, _):
        last, sums, after, before, open = now
        take = lambda index: Moments(*(x[index] for x in sums))
        both = joined(sums, take(after))
        across = principal(sums.scatter)[1]
        cost = principal(both.scatter)[1] - across - across[after]
        cost = jnp.where(open, cost, jnp.inf)
        best = (cost < cost[after]) & (cost <= jnp.where(before == slot, jnp.inf, cost[before]))
        join = best & (cost < tolerance**2)
        gone = join[before] & (before != slot)
        pick = lambda new, old: jnp.where(join.reshape((-1,) + (1,) * (old.ndim - 1)), new, old)
        sums = Moments(*(pick(new, old) for new, old in zip(both, sums, strict=True)))
        last = jnp.where(gone, -1, pick(last[after], last))
        open = jnp.where(gone, False, pick(open[after], open))
        after = pick(after[after], after)
        before = jnp.where(gone[before], before[before], before)
        return (last, sums, after, before, open), None

    after = jnp.minimum(slot + 1, capacity - 1)
    before = jnp.maximum(slot - 1, 0)
    start = (spans.last, sums, after, before, beside)
    last = lax.scan(step, start, length=rounds)[0][0]
    return Spans(jnp.where(last >= 0, spans.first, NONE), last)
