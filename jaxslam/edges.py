"""What the fronts of the automaton start from: edge codes (the paper) or straight runs (default).

Edge codes label each boundary cell by the pattern of its neighbours; a run is a stretch of one
straight wall, found in the order of the beams, with its line fit.
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam import lines
from jaxslam.geometry import dot, unit
from jaxslam.grid import Grid, GridSpec, cell_of, centres
from jaxslam.lidar import Lidar, Scan, bearings, points
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
    centre: Array  # (K, 2) [m] weighted mean of the points, on the line, robot frame
    ends: Array  # (K, 2, 2) [m] first and last end, robot frame
    end_cov: Array  # (K, 2, 2, 2) [m^2] covariance of the ends
    real: Array  # (K, 2) bool, the wall itself ends there (not the view of it)
    sharp: Array  # (K, 2) bool, it ends before something further away: what it hides is unseen
    offset_variance: Array  # (K,) [m^2] of the line across itself, at `centre`
    angle_variance: Array  # (K,) [rad^2] of its direction
    count: Array  # (K,) int32 number of beams
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
        return self.offset_variance + along**2 * self.angle_variance


class RunSpec(NamedTuple):
    """How scans are cut into runs; static under jit."""

    capacity: int = 31  # K, one label bit each, and one for the automaton
    gap: float = 0.2  # [m] a step between beams below this is no jump
    price: float = 20.0  # squared standard deviations that a run must explain to be one
    outlier: float = 16.0  # squared standard deviations that one beam may count
    lanes: int = 16  # runs that are followed together
    uneven: float = 0.02  # [m] by which walls step in and out and are still one run
    grain: float = 0.03  # [m] length of wall over which they do so together
    rough: float = 0.002  # [m] by which points leave a line whatever their number, in its fit
    corner: float = 0.15  # [m] how far the ends of two runs that meet may be from their corner


def jumps(scan: Scan, lidar: Lidar, spec: RunSpec) -> Array:
    """Whether the wall is interrupted before each beam (R,) bool.

    On a straight wall, however grazing, 1 / r is a sinusoid of the bearing, so that
    1/r[i+1] + 1/r[i-1] = 2 cos(step) / r[i]. A wide step between two beams is no jump when the
    two beams on either side of it predict it.
    """
    r = scan.ranges
    xy = points(scan, lidar)
    x, y = xy[:, 0], xy[:, 1]
    wide = _size(x - jnp.roll(x, 1), y - jnp.roll(y, 1)) > spec.gap
    twice = 2 * jnp.cos(jnp.asarray(lidar.step, r.dtype))

    def astray(far: Array, near: Array, there: Array) -> Array:
        inverse = twice / near - 1.0 / far
        guess = jnp.where(inverse > 0.0, 1.0 / jnp.maximum(inverse, 1e-6), jnp.inf)
        # A wall that steps in or out does so by the more along a beam, the more it is grazed.
        slant = _size(near - far, near * lidar.step) / (near * lidar.step)
        return jnp.abs(guess - there) - 2.0 * spec.uneven * slant

    # Beam i from i-1 and i-2, and beam i-1 from i and i+1.
    later = astray(jnp.roll(r, 2), jnp.roll(r, 1), r)
    earlier = astray(jnp.roll(r, -1), r, jnp.roll(r, 1))
    # Two readings of noise s extrapolate with about 2.2 s; a far wall may also bend a little.
    tolerance = 5.0 * lidar.noise + 0.05 * jnp.abs(r - jnp.roll(r, 1))
    smooth = (later < tolerance) | (earlier < tolerance)
    broken = ~scan.hit | ~jnp.roll(scan.hit, 1) | (wide & ~smooth)
    return broken.at[0].set(True)


def _size(x: Array, y: Array) -> Array:
    return jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))


def _of_beams(scan: Scan, lidar: Lidar, jump: Array, normal: Array) -> Array:
    """What runs want to know of the beams they end at, (R, 9), so that it is looked up at once.

    x and y of the hit, normal (2), range, and of the beam before and after: range and jump between.
    """
    r, jump = scan.ranges, jump.astype(scan.ranges.dtype)
    before = jnp.stack([jnp.roll(r, 1), jump], axis=1)
    after = jnp.stack([jnp.roll(r, -1), jnp.append(jump[1:], 1.0)], axis=1)
    # Nothing is beyond the first and the last beam: a wall does not end there, its view does.
    before, after = before.at[0].set(0.0), after.at[-1, 0].set(0.0)
    return jnp.concatenate([points(scan, lidar), normal, r[:, None], before, after], axis=1)


def runs(scan: Scan, lidar: Lidar, spec: RunSpec) -> Runs:
    """Straight runs of a scan, in the order of its beams.

    The scan is broken at jumps, and cut where straight lines explain it best. Each point counts
    by its noise across the line, which is small for grazing beams. Two runs that meet end in the
    intersection of their lines. Where there are more runs than `capacity`, those with the fewest
    beams share one label: they are obstacles, told apart no more.
    """
    xy, capacity = points(scan, lidar), spec.capacity
    jump = jumps(scan, lidar, spec)
    noise = max(lidar.noise, 0.005)
    cut = lines.partition(
        scan,
        jump,
        lidar,
        noise,
        price=spec.price,
        outlier=spec.outlier,
        lanes=spec.lanes,
        uneven=spec.uneven,
        grain=spec.grain,
    )
    spans = lines.longest(cut.begins, scan.hit, capacity=capacity)
    fewest = jnp.argmin(spans.size).astype(jnp.int32)
    overflow = jnp.sum(cut.begins & scan.hit, dtype=jnp.int32) > capacity
    slot = jnp.arange(capacity, dtype=jnp.int32)
    own = ~(overflow & (slot == fewest))
    count, valid, fitted = spans.size, own & (spans.size > 0), own & (spans.size >= 3)
    first, last = jnp.minimum(spans.first, lidar.beams - 1), jnp.maximum(spans.last, 0)
    ends = _of_beams(scan, lidar, jump, cut.normal)[jnp.stack([first, last], axis=1)]

    of = spans.of_beam(lidar.beams)
    beam = jnp.arange(lidar.beams, dtype=jnp.int32)
    trim = jnp.where(count >= 6, 1, 0)
    mine = lambda x: x.at[of].get(mode="clip")
    inner = mine(jnp.stack([first + trim, last - trim], axis=1))
    inner = (of < capacity) & (beam >= inner[:, 0]) & (beam <= inner[:, 1])
    slant = dot(mine(ends[:, 1, 2:4]), unit(bearings(lidar)).astype(xy.dtype))
    weight = jnp.where(inner, 1.0 / ((noise * slant) ** 2 + spec.rough**2), 0.0)
    sums = lines.moments(xy, weight, of, lines=capacity)
    normal, across, spread = lines.principal(sums.scatter)
    cx, cy = sums.mean[:, 0], sums.mean[:, 1]
    sign = jnp.where(dot(normal, sums.mean) > 0.0, -1.0, 1.0)
    nx, ny = sign * normal[:, 0], sign * normal[:, 1]
    # The residuals scale the variances, four of them are taken as expected.
    degrees = jnp.maximum(count - 2 * trim - 2, 0).astype(xy.dtype)
    scale = (4.0 + across) / (4.0 + degrees)
    offset_variance = scale / jnp.maximum(sums.weight, 1e-9)
    angle_variance = scale / jnp.maximum(spread, 1e-6)

    # Ends on the line (ny, -nx): of its points, and of the next line, of which it is a turn away.
    x, y = ends[:, :, 0], ends[:, :, 1]  # (K, 2)
    part = (x - cx[:, None]) * ny[:, None] - (y - cy[:, None]) * nx[:, None]
    x = jnp.where(fitted[:, None], cx[:, None] + part * ny[:, None], x)
    y = jnp.where(fitted[:, None], cy[:, None] - part * nx[:, None], y)
    of_next = [nx, ny, cx, cy, offset_variance, angle_variance, x[:, 0], y[:, 0]]
    mx, my, dx, dy, next_offset, next_angle, next_x, next_y = jnp.roll(jnp.stack(of_next), -1, 1)
    turn = nx * my - ny * mx
    safe = jnp.where(jnp.abs(turn) > 0.1, turn, 1.0)
    reach = ((dx - cx) * mx + (dy - cy) * my) / safe
    corner_x, corner_y = cx - ny * reach, cy + nx * reach
    slack = spec.corner + 3 * noise / jnp.maximum(jnp.abs(turn), 0.3)
    slack += 2 * lidar.step * _size(corner_x, corner_y)
    close = _size(corner_x - x[:, 1], corner_y - y[:, 1]) < slack
    close &= _size(corner_x - next_x, corner_y - next_y) < slack
    next_first, next_fitted = jnp.roll(spans.first, -1), jnp.roll(fitted, -1)
    beside = (slot < capacity - 1) & (spans.last + 1 == next_first) & (ends[:, 1, 8] == 0.0)
    meets = beside & fitted & next_fitted & (jnp.abs(turn) > 0.3) & close

    # An end is real where another run begins, and on the near side of a jump; there the wall goes
    # on for about half a beam more than was seen of it.
    away = _size(x, y)
    grazing = jnp.abs(nx[:, None] * x + ny[:, None] * y) / jnp.maximum(away, 1e-6)
    room = 0.5 * lidar.step * away / jnp.maximum(grazing, 0.1)
    beyond = jnp.stack([ends[:, 0, 5], ends[:, 1, 7]], axis=1)
    sharp = jnp.stack([ends[:, 0, 6], ends[:, 1, 8]], axis=1) > 0.0
    sharp &= ends[:, :, 4] < jnp.minimum(beyond, 0.9 * lidar.reach)
    further = jnp.where(sharp & fitted[:, None], room, 0.0) * jnp.array([-1.0, 1.0], x.dtype)[None]
    x, y = x + ny[:, None] * further, y - nx[:, None] * further

    # Of a corner, the inverse of the matrix of the two normals maps the errors of the lines.
    part = (corner_x - dx) * my - (corner_y - dy) * mx
    ahead = (part**2 * next_angle + next_offset) / safe**2
    here = (reach**2 * angle_variance + offset_variance) / safe**2
    of_corner = [
        corner_x,
        corner_y,
        here * my * my + ahead * ny * ny,
        -here * my * mx - ahead * ny * nx,
        here * mx * mx + ahead * nx * nx,
        meets.astype(x.dtype),
    ]
    of_corner = jnp.stack(of_corner)
    of_corner = jnp.stack([jnp.roll(of_corner, 1, axis=1), of_corner], axis=2)  # (6, K, 2)
    part = (x - cx[:, None]) * ny[:, None] - (y - cy[:, None]) * nx[:, None]
    thin = offset_variance[:, None] + part**2 * angle_variance[:, None]
    long = thin + room**2 / 3
    u, v = nx[:, None], ny[:, None]
    of_end = [x, y, thin * u * u + long * v * v, (thin - long) * u * v, thin * v * v + long * u * u]
    x, y, xx, cov_xy, yy = jnp.where(of_corner[5:] > 0.0, of_corner[:5], jnp.stack(of_end))
    return Runs(
        normal=jnp.stack([nx, ny], axis=1),
        centre=sums.mean,
        ends=jnp.stack([x, y], axis=2),
        end_cov=jnp.stack([xx, cov_xy, cov_xy, yy], axis=2).reshape(capacity, 2, 2, 2),
        real=sharp | jnp.stack([jnp.roll(beside, 1), beside], axis=1),
        sharp=sharp,
        offset_variance=offset_variance,
        angle_variance=angle_variance,
        count=count,
        meets=meets,
        valid=valid,
        of_beam=jnp.where(scan.hit & (of == capacity) & overflow, fewest, of),
    )


def run_cells(scan: Scan, lidar: Lidar, runs: Runs, spec: GridSpec, *, fill: int = 6) -> Array:
    """Run (H, W) int8 that each cell lies on, -1 for none; drawn without gaps from hit to hit.

    Args:
        scan: The scan the runs are of.
        lidar: The scanner.
        runs: Its runs; where two share a cell, the later has it.
        spec: The grid to draw on.
        fill: Points drawn from each hit to the next of the same run.
    """
    xy, of = points(scan, lidar), runs.of_beam
    capacity = runs.valid.size
    last = jnp.arange(of.size, dtype=jnp.int32) == of.size - 1
    same = (of == jnp.roll(of, -1)) & runs.valid[jnp.minimum(of, capacity - 1)] & ~last
    part = jnp.where(same[:, None], jnp.arange(fill, dtype=xy.dtype) / fill, 0.0)
    drawn = xy[:, None] + part[:, :, None] * (jnp.roll(xy, -1, axis=0) - xy)[:, None]
    drawn = jnp.where((of < capacity)[:, None, None], drawn, jnp.inf)
    index = cell_of(drawn.reshape(-1, 2), spec)
    run = jnp.full(spec.shape, -1, jnp.int8)
    return run.at[index[:, 0], index[:, 1]].max(jnp.repeat(of, fill).astype(jnp.int8), mode="drop")
