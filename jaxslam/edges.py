"""What the fronts of the automaton start from: edge codes (the paper) or straight runs (default).

Edge codes label each boundary cell by the pattern of its neighbours; a run is a stretch of one
straight wall, found in the order of the beams, with its line fit.
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam import lines
from jaxslam.geometry import cross, dot, unit
from jaxslam.grid import Grid, GridSpec, cell_of, centres
from jaxslam.lidar import Lidar, Scan, bearings, points
from jaxslam.lines import Moments
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
    rough: float = 0.002  # [m] by which walls themselves leave a line
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


def _fit(xy: Array, weight: Array, of: Array, capacity: int) -> tuple[Array, Moments, Array, Array]:
    """Normals (K, 2) towards the robot, moments, and sums of squares across and along."""
    sums = lines.moments(xy, weight, of, lines=capacity)
    normal, across, along = lines.principal(sums.scatter)
    normal = jnp.where(dot(normal, sums.mean)[:, None] > 0.0, -normal, normal)
    return normal, sums, across, along


def _meeting(normal: Array, centre: Array) -> tuple[Array, Array]:
    """Sine (K,) of the turn from each line to the next, and where they meet (K, 2) [m]."""
    following = lambda x: jnp.roll(x, -1, axis=0)
    turn = cross(normal, following(normal))
    safe = jnp.where(jnp.abs(turn) > 0.1, turn, 1.0)
    reach = dot(following(centre) - centre, following(normal)) / safe
    # The line goes along (ny, -nx), on which the next normal projects to minus the sine.
    along = jnp.stack([normal[:, 1], -normal[:, 0]], axis=-1)
    return turn, centre - along * reach[:, None]


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
        scan, jump, lidar, noise, price=spec.price, outlier=spec.outlier, lanes=spec.lanes
    )
    spans = lines.longest(cut.begins, scan.hit, capacity=capacity)
    overflow = jnp.sum(cut.begins & scan.hit, dtype=jnp.int32) > capacity
    rest = jnp.arange(capacity) == jnp.where(overflow, jnp.argmin(spans.size), capacity)

    following = jnp.roll(jnp.arange(capacity), -1)
    beside = (following > 0) & (spans.last + 1 == spans.first[following])
    beside &= ~jump.at[spans.first[following]].get(mode="fill", fill_value=True)
    adjoin = beside & ~rest & ~rest[following]
    adjoin &= (spans.size >= 3) & (spans.size[following] >= 3)
    count, first = spans.size, jnp.minimum(spans.first, lidar.beams - 1)
    last = jnp.maximum(spans.last, 0)
    of = spans.of_beam(lidar.beams)
    beam = jnp.arange(lidar.beams, dtype=jnp.int32)
    trim = jnp.where(count >= 6, 1, 0)
    mine = lambda x: x.at[of].get(mode="clip")
    inner = (of < capacity) & (beam >= mine(first + trim)) & (beam <= mine(last - trim))
    slant = dot(mine(cut.normal[last]), unit(bearings(lidar)).astype(xy.dtype))
    weight = jnp.where(inner, 1.0 / ((noise * slant) ** 2 + spec.rough**2), 0.0)
    normal, sums, across, spread = _fit(xy, weight, of, capacity)
    centre, valid, fitted = sums.mean, (count > 0) & ~rest, (count >= 3) & ~rest
    # The residuals scale the variances, four of them are taken as expected.
    degrees = jnp.maximum(count - 2 * trim - 2, 0).astype(xy.dtype)
    scale = (4.0 + across) / (4.0 + degrees)
    offset_variance = scale / jnp.maximum(sums.weight, 1e-9)
    angle_variance = scale / jnp.maximum(spread, 1e-6)
    along = jnp.stack([normal[:, 1], -normal[:, 0]], axis=-1)

    def onto(point: Array) -> Array:
        on_line = centre + along * dot(along, point - centre)[:, None]
        return jnp.where(fitted[:, None], on_line, point)

    start, end = onto(xy[first]), onto(xy[last])
    turn, corner = _meeting(normal, centre)
    slack = spec.corner + 2 * lidar.step * jnp.linalg.norm(corner, axis=1)
    slack += 3 * noise / jnp.maximum(jnp.abs(turn), 0.3)
    close = (jnp.linalg.norm(corner - end, axis=1) < slack) & (
        jnp.linalg.norm(corner - start[following], axis=1) < slack
    )
    meets = adjoin & (jnp.abs(turn) > 0.3) & close
    met = jnp.roll(meets, 1)  # by the run before

    # An end is real where another run begins, and on the near side of a jump; there the wall goes
    # on for about half a beam more than was seen of it.
    before, after = jnp.maximum(first - 1, 0), jnp.minimum(last + 1, lidar.beams - 1)

    def silhouette(own: Array, other: Array) -> Array:
        near = scan.ranges[own] < jnp.minimum(scan.ranges[other], 0.9 * lidar.reach)
        return (other != own) & near & jump[jnp.maximum(own, other)]

    def unseen(point: Array) -> Array:
        away = jnp.linalg.norm(point, axis=1)
        grazing = jnp.abs(cross(along, point)) / jnp.maximum(away, 1e-6)
        return 0.5 * lidar.step * away / jnp.maximum(grazing, 0.1)

    sharp = jnp.stack([silhouette(first, before), silhouette(last, after)], axis=1)
    real = sharp | jnp.stack([jnp.roll(beside, 1), beside], axis=1)
    room = jnp.stack([unseen(start), unseen(end)], axis=1)
    further = jnp.where(sharp & fitted[:, None], room, 0.0)
    start = jnp.where(met[:, None], jnp.roll(corner, 1, 0), start - along * further[:, :1])
    end = jnp.where(meets[:, None], corner, end + along * further[:, 1:])
    ends = jnp.stack([start, end], axis=1)

    # Of a corner, the inverse of the matrix of the two normals maps the errors of the lines.
    own = dot(end - centre, along) ** 2 * angle_variance + offset_variance
    ahead = dot(end - centre[following], along[following]) ** 2 * angle_variance[following]
    ahead += offset_variance[following]
    sine = jnp.where(meets, turn, 1.0)[:, None, None]
    outer = lambda v: v[..., :, None] * v[..., None, :]
    of_corner = own[:, None, None] * outer(along[following]) + ahead[:, None, None] * outer(along)
    of_corner = of_corner / sine**2
    at = dot(ends - centre[:, None], along[:, None])  # (K, 2)
    across = offset_variance[:, None] + at**2 * angle_variance[:, None]
    loose = across[..., None, None] * outer(normal)[:, None]
    loose += (room**2 / 3 + across)[..., None, None] * outer(along)[:, None]
    cornered = jnp.stack([met, meets], axis=1)[..., None, None]
    end_cov = jnp.where(cornered, jnp.stack([jnp.roll(of_corner, 1, 0), of_corner], axis=1), loose)
    shared = jnp.where(overflow, jnp.argmin(spans.size).astype(jnp.int32), capacity)
    of_beam = jnp.where(scan.hit & (of == capacity), shared, of)
    return Runs(
        normal=normal,
        centre=centre,
        ends=ends,
        end_cov=end_cov,
        real=real,
        sharp=sharp,
        offset_variance=offset_variance,
        angle_variance=angle_variance,
        count=count,
        meets=meets,
        valid=valid,
        of_beam=of_beam,
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
