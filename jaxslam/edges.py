"""What the fronts of the automaton start from: edge codes (the paper) or straight runs (default).

Edge codes label each boundary cell by the pattern of its neighbours; a run is a stretch of one
straight wall, found in the order of the beams, with its line fit.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxslam.geometry import cross, dot, unit
from jaxslam.grid import Grid, GridSpec, cell_of, centres
from jaxslam.lidar import Lidar, Scan, points
from jaxslam.types import Array, expect
from jaxslam.voronoi import around

# Code of each pattern of occupied neighbours, bits N=1 E=2 S=4 W=8 with the sensor axis to the
# north; 34 is e3 on the clockwise side of the axis and e4 on the other; 0 is no source.
_SIDE = 34
_CODES = (1, _SIDE, 2, 5, _SIDE, _SIDE, 5, 3, 2, 6, 2, 2, 6, 4, 2, 0)


def codes(grid: Grid, spec: GridSpec) -> Array:
    """Edge code (H, W) uint8 of each cell: 1..6 for e1..e6, 0 for no edge.

    e1 is an isolated cell: salt-and-pepper noise. e3 and e4 share a pattern and are told apart by
    the side of the sensor axis they lie on. Patterns that face away from the sensor cannot be
    seen by it and count as the one they mirror.

    Raises:
        ValueError: The grid has another shape or type than `spec` says; while tracing.

    References:
        Paper, section 2.2, Figs. 3 to 5.
    """
    expect("grid.occupied", grid.occupied, spec.shape, jnp.bool_)
    north, south, west, east = around(grid.occupied.astype(jnp.uint8))
    pattern = north + 2 * east + 4 * south + 8 * west
    code = jnp.array(_CODES, jnp.uint8)[pattern]
    clockwise = centres(spec)[..., 1] < 0.0
    code = jnp.where(code == _SIDE, jnp.where(clockwise, 3, 4).astype(jnp.uint8), code)
    return jnp.where(grid.occupied, code, 0).astype(jnp.uint8)


def code_bits(codes: Array) -> Array:
    """Label bit (H, W) uint8 that each coded cell starts with: e2..e6; e1 starts nothing."""
    shift = jnp.clip(codes, 2, 6) - jnp.uint8(2)
    return jnp.where(codes >= 2, jnp.uint8(1) << shift, jnp.uint8(0))


class Runs(NamedTuple):
    """Straight runs of a scan in the order of its beams (counter-clockwise), padded to K."""

    normal: Array  # (K, 2) unit normal, robot frame; the robot is on its positive side
    centre: Array  # (K, 2) [m] mean of the points of the fit, robot frame
    ends: Array  # (K, 2, 2) [m] first and last end, robot frame
    real: Array  # (K, 2) bool, the wall itself ends there (not the view of it)
    end_variance: Array  # (K, 2) [m^2] of an end, in any direction
    variance: Array  # (K,) [m^2] of one point across the line
    weight: Array  # (K,) number of points in the fit
    spread: Array  # (K,) [m^2] sum of squared distances of these points from `centre`
    meets: Array  # (K,) bool, this run meets the next one in a corner, at `ends[:, 1]`
    valid: Array  # (K,) bool
    of_beam: Array  # (R,) int32 run of each beam, K for none

    @property
    def along(self) -> Array:
        """Unit vectors (K, 2) from the first end to the last: counter-clockwise around."""
        return jnp.stack([self.normal[..., 1], -self.normal[..., 0]], axis=-1)

    @property
    def length(self) -> Array:
        """Length (K,) [m]."""
        return dot(self.ends[:, 1] - self.ends[:, 0], self.along)

    def line_variance(self, along: Array) -> Array:
        """Variance (..., K) [m^2] across the line, `along` (..., K) [m] from the centre."""
        return self.variance * (1.0 / self.weight + along**2 / self.spread)


class RunSpec(NamedTuple):
    """How scans are cut into runs; static under jit."""

    capacity: int = 31  # K, one label bit each, and one for the automaton
    splits: int = 8  # rounds of splitting
    gap: float = 0.2  # [m] a step between beams below this is no jump
    bend: float = 0.06  # [m] a run whose points leave its chord by more is split
    corner: float = 0.15  # [m] how far the ends of two runs that meet may be from their corner


def jumps(scan: Scan, lidar: Lidar, spec: RunSpec) -> Array:
    """Whether the wall is interrupted before each beam (R,) bool.

    On a straight wall, however grazing, 1 / r is a sinusoid of the bearing, so that
    1/r[i+1] + 1/r[i-1] = 2 cos(step) / r[i]. A wide step between two beams is no jump when the
    two beams on either side of it predict it.
    """
    r = scan.ranges
    xy = points(scan, lidar)
    wide = jnp.linalg.norm(xy - jnp.roll(xy, 1, axis=0), axis=1) > spec.gap
    twice = 2 * jnp.cos(jnp.asarray(lidar.step, r.dtype))

    def predicted(near: Array, far: Array) -> Array:
        inverse = twice / near - 1.0 / far
        guess = jnp.where(inverse > 0.0, 1.0 / jnp.maximum(inverse, 1e-6), jnp.inf)
        return guess

    # Beam i from i-1 and i-2, and beam i-1 from i and i+1.
    later = predicted(jnp.roll(r, 1), jnp.roll(r, 2))
    earlier = predicted(r, jnp.roll(r, -1))
    # Two readings of noise s extrapolate with about 2.2 s; a far wall may also bend a little.
    tolerance = 5.0 * lidar.noise + 0.05 * jnp.abs(r - jnp.roll(r, 1))
    smooth = (jnp.abs(later - r) < tolerance) | (jnp.abs(earlier - jnp.roll(r, 1)) < tolerance)
    broken = ~scan.hit | ~jnp.roll(scan.hit, 1) | (wide & ~smooth)
    return broken.at[0].set(True)


def _spans(breaks: Array) -> tuple[Array, Array]:
    """First and last beam (R,) int32 of the stretch each beam is in; True starts a stretch."""
    beam = jnp.arange(breaks.size, dtype=jnp.int32)
    first = lax.cummax(jnp.where(breaks, beam, 0))
    ends = jnp.append(breaks[1:], True)
    last = lax.cummin(jnp.where(ends, beam, breaks.size - 1), reverse=True)
    return first, last


def _split(xy: Array, breaks: Array, tolerance: Array, rounds: int) -> Array:
    """Break stretches where their points (R, 2) are furthest from their chord, if too far."""

    def step(breaks, _):
        first, last = _spans(breaks)
        start, chord = xy[first], xy[last] - xy[first]
        size = jnp.maximum(jnp.linalg.norm(chord, axis=1), 1e-6)
        off = jnp.abs(cross(chord, xy - start)) / size
        # A chord of almost no length says nothing of direction: take the distance to its start.
        off = jnp.where(size < 0.05, jnp.linalg.norm(xy - start, axis=1), off)
        # The running maximum of a stretch, in tenths of a millimetre: its first beam in the high
        # bits makes every stretch begin anew.
        tenths = jnp.minimum(off * 1e4, 2.0**18 - 1).astype(jnp.int32)
        running = lax.cummax(first * 2**18 + tenths)
        worst = running == running[last]
        leads = worst & ~jnp.roll(worst, 1).at[0].set(False)
        return breaks | (leads & (off > tolerance)), None

    return lax.scan(step, breaks, length=rounds)[0]


def _claim(breaks: Array, hit: Array, capacity: int) -> Array:
    """Run (R,) int32 of each beam: the stretches with most beams, in the order of the beams.

    Where there are more stretches than runs, the shortest ones share the last run: they are
    obstacles still, told apart no more.
    """
    first, last = _spans(breaks)
    leads = breaks & hit
    size = jnp.where(leads, last - first + 1, 0)
    count = jnp.sum(leads)
    top, place = lax.top_k(size, capacity)
    # With overflow the last run is kept free for the rest.
    kept = jnp.where(count > capacity, jnp.arange(capacity) < capacity - 1, top > 0)
    order = jnp.sort(jnp.where(kept, place, breaks.size).astype(jnp.int32))
    slot = jnp.full(breaks.size, capacity - 1, jnp.int32)
    slot = slot.at[order].set(jnp.arange(capacity, dtype=jnp.int32), mode="drop")
    return jnp.where(hit, slot[first], capacity)


def _fit(xy: Array, member: Array, noise: float) -> tuple[Array, ...]:
    """Total least squares lines: `member` (K, R) picks the points (R, 2) of each.

    The variance of a point blends the lidar's noise (worth four points) with the residuals.
    """
    w = member.astype(xy.dtype)
    weight = jnp.maximum(w.sum(axis=1), 1.0)
    centre = (w @ xy) / weight[:, None]
    d = (xy[None] - centre[:, None]) * w[:, :, None]
    xx, yy, xy_ = (
        jnp.sum(d[..., 0] ** 2, 1),
        jnp.sum(d[..., 1] ** 2, 1),
        jnp.sum(d[..., 0] * d[..., 1], 1),
    )
    flat = (jnp.abs(xy_) < 1e-9) & (jnp.abs(xx - yy) < 1e-9)
    angle = 0.5 * jnp.arctan2(jnp.where(flat, 0.0, 2 * xy_), jnp.where(flat, 1.0, xx - yy))
    normal = unit(angle + 0.5 * jnp.pi)
    normal = jnp.where(dot(normal, centre)[:, None] > 0.0, -normal, normal)
    half = 0.5 * (xx + yy)
    tilt = jnp.sqrt(jnp.maximum((0.5 * (xx - yy)) ** 2 + xy_**2, 1e-18))
    across = jnp.maximum(half - tilt, 0.0)
    variance = (4 * noise**2 + across) / (4.0 + jnp.maximum(weight - 2.0, 0.0))
    return normal, centre, variance, weight, jnp.maximum(half + tilt, 1e-6)


def _tolerance(lidar: Lidar, spec: RunSpec) -> float:
    """How far [m] the points of one wall may lie from a line through two of them."""
    return max(spec.bend, 4.5 * lidar.noise)


def _merge(breaks: Array, xy: Array, scan: Scan, lidar: Lidar, spec: RunSpec) -> Array:
    """Undo breaks between stretches of adjacent beams that lie on one line.

    The better line of the two is the judge, at the middle of the other.
    """
    of_beam = _claim(breaks, scan.hit, spec.capacity)
    index = jnp.arange(spec.capacity, dtype=jnp.int32)
    member = of_beam[None] == index[:, None]
    normal, centre, _, weight, spread = _fit(xy, member, lidar.noise)
    following = lambda x: jnp.roll(x, -1, axis=0)
    gap = following(centre) - centre
    by_own, by_next = jnp.abs(dot(gap, normal)), jnp.abs(dot(gap, following(normal)))
    off = jnp.where(spread >= following(spread), by_own, by_next)
    same = (weight >= 3) & (following(weight) >= 3) & (off < 0.6 * _tolerance(lidar, spec))
    same &= (jnp.abs(cross(normal, following(normal))) < 0.2) & (dot(normal, following(normal)) > 0)
    same &= index < spec.capacity - 2
    joins = jnp.roll(same, 1).at[0].set(False)
    # Where the shortest stretches share a run, the next run need not be the next stretch.
    beside = jnp.roll(of_beam, 1) == of_beam - 1
    slot = jnp.clip(of_beam, 0, spec.capacity - 1)
    return breaks & ~(joins[slot] & beside & (of_beam < spec.capacity))


def runs(scan: Scan, lidar: Lidar, spec: RunSpec) -> Runs:
    """Straight runs of a scan, in the order of its beams.

    The scan is broken at jumps, split where a stretch bends away from its chord, and stretches
    that lie on one line are joined again. Lines are fitted to the points away from the ends.
    Where two runs meet, both end in the intersection of their lines.
    """
    xy = points(scan, lidar)
    jump = jumps(scan, lidar, spec)
    tolerance = jnp.asarray(_tolerance(lidar, spec), xy.dtype)
    breaks = _split(xy, jump, tolerance, spec.splits)
    breaks = _merge(breaks, xy, scan, lidar, spec)

    of_beam = _claim(breaks, scan.hit, spec.capacity)
    beam = jnp.arange(lidar.beams, dtype=jnp.int32)
    member = of_beam[None] == jnp.arange(spec.capacity, dtype=jnp.int32)[:, None]  # (K, R)
    count = member.sum(axis=1, dtype=jnp.int32)
    first = jnp.min(jnp.where(member, beam[None], lidar.beams - 1), axis=1)
    last = jnp.max(jnp.where(member, beam[None], 0), axis=1)
    # The points next to a corner may belong to the other wall: leave them out of the fit.
    trim = jnp.where(count >= 8, 2, jnp.where(count >= 6, 1, 0))
    inner = member & (beam[None] >= (first + trim)[:, None])
    inner &= beam[None] <= (last - trim)[:, None]
    normal, centre, variance, weight, spread = _fit(xy, inner, lidar.noise)
    valid = count > 0
    fitted = count >= 3
    along = jnp.stack([normal[:, 1], -normal[:, 0]], axis=-1)

    def onto(point: Array) -> Array:
        on_line = centre + along * dot(along, point - centre)[:, None]
        return jnp.where(fitted[:, None], on_line, point)

    start, end = onto(xy[first]), onto(xy[last])

    # Corners: where the next run begins at the next beam, no jump between.
    following = jnp.roll(jnp.arange(spec.capacity), -1)
    touches = valid & valid[following] & (first[following] == last + 1) & ~jump[first[following]]
    turn = cross(along, along[following])
    safe = jnp.where(jnp.abs(turn) > 0.3, turn, 1.0)
    reach = cross(centre[following] - centre, along[following]) / safe
    corner = centre + along * reach[:, None]
    slack = spec.corner + 2 * lidar.step * jnp.linalg.norm(corner, axis=1)
    close = (jnp.linalg.norm(corner - end, axis=1) < slack) & (
        jnp.linalg.norm(corner - start[following], axis=1) < slack
    )
    meets = touches & fitted & fitted[following] & (jnp.abs(turn) > 0.3) & close
    meets &= following > 0
    met = jnp.roll(meets, 1)  # by the run before

    # An end is real at a corner, and on the near side of a jump; there the wall goes on for
    # about half a beam more than was seen of it.
    before, after = jnp.maximum(first - 1, 0), jnp.minimum(last + 1, lidar.beams - 1)

    def silhouette(own: Array, other: Array) -> Array:
        near = scan.ranges[own] < jnp.minimum(scan.ranges[other], 0.9 * lidar.reach)
        return (other != own) & near & jump[jnp.maximum(own, other)]

    def unseen(point: Array) -> Array:
        away = jnp.linalg.norm(point, axis=1)
        grazing = jnp.abs(cross(along, point)) / jnp.maximum(away, 1e-6)
        return 0.5 * lidar.step * away / jnp.maximum(grazing, 0.1)

    real = jnp.stack([met | silhouette(first, before), meets | silhouette(last, after)], axis=1)
    room = jnp.stack([unseen(start), unseen(end)], axis=1)
    further = jnp.where(real & fitted[:, None], room, 0.0)
    start = jnp.where(met[:, None], jnp.roll(corner, 1, 0), start - along * further[:, :1])
    end = jnp.where(meets[:, None], corner, end + along * further[:, 1:])
    cornered = jnp.stack([met, meets], axis=1)
    end_variance = 2 * variance[:, None] + jnp.where(cornered, 0.0, room**2 / 3)
    return Runs(
        normal=normal,
        centre=centre,
        ends=jnp.stack([start, end], axis=1),
        real=real,
        end_variance=end_variance,
        variance=variance,
        weight=weight,
        spread=spread,
        meets=meets,
        valid=(count > 0) & (count == last - first + 1),
        of_beam=of_beam,
    )


def run_bits(scan: Scan, lidar: Lidar, runs: Runs, spec: GridSpec, *, fill: int = 6) -> Array:
    """Label bits (H, W) uint32 of the cells on each run, drawn without gaps from hit to hit.

    Args:
        scan: The scan the runs are of.
        lidar: The scanner.
        runs: Its runs; run k starts bit k.
        spec: The grid to draw on.
        fill: Points drawn from each hit to the next of the same run.
    """
    xy, of = points(scan, lidar), runs.of_beam
    capacity = runs.valid.size
    last = jnp.arange(of.size, dtype=jnp.int32) == of.size - 1
    same = (of == jnp.roll(of, -1)) & (of < capacity - 1) & ~last
    part = jnp.where(same[:, None], jnp.arange(fill, dtype=xy.dtype) / fill, 0.0)
    drawn = xy[:, None] + part[:, :, None] * (jnp.roll(xy, -1, axis=0) - xy)[:, None]
    drawn = jnp.where((of < capacity)[:, None, None], drawn, jnp.inf)
    index = cell_of(drawn.reshape(-1, 2), spec)
    slot = jnp.repeat(of, fill)
    lowest = jnp.full(spec.shape, capacity, jnp.int32)
    lowest = lowest.at[index[:, 0], index[:, 1]].min(slot, mode="drop")
    highest = jnp.full(spec.shape, -1, jnp.int32)
    highest = highest.at[index[:, 0], index[:, 1]].max(slot, mode="drop")
    bit = lambda k: jnp.uint32(1) << jnp.clip(k, 0, capacity - 1).astype(jnp.uint32)
    return jnp.where(highest >= 0, bit(lowest) | bit(highest), jnp.uint32(0))
