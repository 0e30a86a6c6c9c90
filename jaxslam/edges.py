"""Sources of the Voronoi automaton in a scan: edge codes (paper) or straight segments (default).

Edge codes label each boundary cell by the pattern of its neighbours (`codes`). A segment is one
straight piece of wall, found in the order of the beams, with its line fit (`runs`).
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

    e1 is an isolated cell: salt-and-pepper noise. e3 and e4 share a pattern and differ by the side
    of the sensor axis they lie on. Patterns that face away from the sensor cannot be seen by it
    and count as the one they mirror.

    Args:
        grid: The local grid of a scan.
        spec: Its extent.

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
    """Straight wall segments of a scan, counter-clockwise in the order of its beams, padded to K.

    Robot frame throughout. See `runs` for a figure.

    Attributes:
        normal: (K, 2) unit normal of the line, towards the robot.
        centre: (K, 2) [m] weighted mean of the points, on the line.
        ends: (K, 2, 2) [m] first and last end.
        end_cov: (K, 2, 2, 2) [m^2] covariance of each end.
        real: (K, 2) bool, the wall itself ends there, not only the view of it.
        sharp: (K, 2) bool, occluding end: what lies behind it is hidden by the wall.
        offset_variance: (K,) [m^2] variance of the line across itself, at `centre`.
        angle_variance: (K,) [rad^2] variance of its direction.
        count: (K,) int32 number of beams.
        meets: (K,) bool, this segment meets the next one in a corner, at `ends[:, 1]`.
        valid: (K,) bool, False for padding and for the slot of all surplus segments.
        of_beam: (R,) int32 segment of each beam, K for none.
    """

    normal: Array
    centre: Array
    ends: Array
    end_cov: Array
    real: Array
    sharp: Array
    offset_variance: Array
    angle_variance: Array
    count: Array
    meets: Array
    valid: Array
    of_beam: Array

    @property
    def along(self) -> Array:
        """Unit vectors (K, 2) from first to last end: counter-clockwise around the robot."""
        return jnp.stack([self.normal[..., 1], -self.normal[..., 0]], axis=-1)

    @property
    def length(self) -> Array:
        """Length (K,) [m]."""
        return dot(self.ends[:, 1] - self.ends[:, 0], self.along)

    def line_variance(self, along: Array) -> Array:
        """Variance (..., K) [m^2] across the line, `along` (..., K) [m] from the centre."""
        return self.offset_variance + along**2 * self.angle_variance


class RunSpec(NamedTuple):
    """Parameters of the segmentation of scans; static under jit.

    Attributes:
        capacity: K, most segments; one label bit each, and one for the automaton.
        gap: [m] two successive hits nearer to each other than this are never a jump.
        price: Cost of a segment, in squared standard deviations.
        outlier: Bound of the cost of one beam, in squared standard deviations.
        lanes: Candidates that the partition keeps at each beam.
        uneven: [m] standard deviation of a wall about its line that does not split it.
        grain: [m] length of wall over which that deviation is the same.
        rough: [m] standard deviation added to each point in the line fit.
        corner: [m] distance at most from the ends of two adjacent segments to their corner.
    """

    capacity: int = 31
    gap: float = 0.2
    price: float = 20.0
    outlier: float = 16.0
    lanes: int = 16
    uneven: float = 0.02
    grain: float = 0.03
    rough: float = 0.002
    corner: float = 0.15


class _Pieces(NamedTuple):
    """Pieces of a scan between its cuts; those with most beams have a slot 0..K-1 each.

    Attributes:
        spans: (K,) first and last beam.
        of_beam: (R,) int32 slot of each beam, K for none.
        valid: (K,) bool.
        fitted: (K,) bool, valid and of three beams or more: a line is fitted.
        overflow: () bool, there are more pieces than slots.
        surplus: () int32 slot of the fewest beams; if there are more pieces, it takes these too.
    """

    spans: lines.Spans
    of_beam: Array
    valid: Array
    fitted: Array
    overflow: Array
    surplus: Array


class _EndBeams(NamedTuple):
    """First and last beam of each piece.

    Attributes:
        first: (K,) int32 first beam.
        last: (K,) int32 last beam.
        x: (K, 2) [m] of the hits.
        y: (K, 2) [m] of the hits.
        ranges: (K, 2) [m].
        range_beyond: (K, 2) [m] of the next beam outside the piece; 0 outside the field of view.
        jump: (K, 2) 1.0 if a jump is between the two, else 0.0.
        normal: (K, 2) of the line that the partition fitted.
    """

    first: Array
    last: Array
    x: Array
    y: Array
    ranges: Array
    range_beyond: Array
    jump: Array
    normal: Array


class _Line(NamedTuple):
    """Lines of K pieces, by coordinates: n = (nx, ny) towards the robot, c = (cx, cy) the centre.

    The direction is u = (ny, -nx). `offset_variance` and `angle_variance` are those of `Runs`.
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


class _Ends(NamedTuple):
    """Ends of pieces, (K,) or (K, 2): position [m], and entries xx, xy, yy of the covariance."""

    x: Array
    y: Array
    cov_xx: Array
    cov_xy: Array
    cov_yy: Array


def jumps(scan: Scan, lidar: Lidar, spec: RunSpec) -> Array:
    """Whether the wall is interrupted before each beam (R,) bool.

    On a straight wall, however grazing, 1 / r is a sinusoid of the bearing, so that
    1 / r[i+1] + 1 / r[i-1] = 2 cos(step) / r[i]. Two successive hits that are far apart are no jump
    if the two beams before them predict the second, or the two after them the first.
    """
    r = scan.ranges
    xy = points(scan, lidar)
    x, y = xy[:, 0], xy[:, 1]
    wide = _length(x - jnp.roll(x, 1), y - jnp.roll(y, 1)) > spec.gap
    twice = 2 * jnp.cos(jnp.asarray(lidar.step, r.dtype))

    def prediction_error(second: Array, nearest: Array, measured: Array) -> Array:
        """Error [m] of a range from the nearest beam and the second, less what is uneven."""
        inverse = twice / nearest - 1.0 / second
        predicted = jnp.where(inverse > 0.0, 1.0 / jnp.maximum(inverse, 1e-6), jnp.inf)
        # An offset of the wall changes a range by 1 / cos(angle of incidence) times as much.
        slant = _length(nearest - second, nearest * lidar.step) / (nearest * lidar.step)
        return jnp.abs(predicted - measured) - 2.0 * spec.uneven * slant

    # Beam i from i-1 and i-2, and beam i-1 from i and i+1.
    forward = prediction_error(jnp.roll(r, 2), jnp.roll(r, 1), r)
    backward = prediction_error(jnp.roll(r, -1), r, jnp.roll(r, 1))
    # Two ranges of noise s extrapolate with about 2.2 s; a far wall may also bend a little.
    tolerance = 5.0 * lidar.noise + 0.05 * jnp.abs(r - jnp.roll(r, 1))
    smooth = (forward < tolerance) | (backward < tolerance)
    broken = ~scan.hit | ~jnp.roll(scan.hit, 1) | (wide & ~smooth)
    return broken.at[0].set(True)


def _length(x: Array, y: Array) -> Array:
    """Length of vectors, at least 1e-6, with finite derivatives."""
    return jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))


def runs(scan: Scan, lidar: Lidar, spec: RunSpec) -> Runs:
    """Straight wall segments of a scan, in the order of its beams.

    Two segments seen by the robot R, 0 and 1, counter-clockwise:

          ==========  wall further away
                .
                 .  beam beyond the end
                  .
        ends[1, 1]  o-----------------------+  ends[1, 0] = ends[0, 1]
        occluding    .      normal[1]       |  a corner: meets[0], both ends real
        end: sharp    .         |           |
        and real       .        v           |
                        .                   |  ^
                         R    normal[0] <-- |  | along[0]
                                            o  ends[0, 0]
                                               only the view ends here: not real

    Steps:

    1. Split the beams at jumps and where straight lines explain them best (`lines.partition`).
    2. Give the pieces with most beams a slot each (`_longest_pieces`). If there are more than
       `capacity`, the slot of the fewest beams takes all others too, and is not valid: its beams
       are obstacles without a line.
    3. Fit a line to each by weighted total least squares (`_fit_lines`).
    4. Project the outermost hits onto the lines (`_project_ends`).
    5. Intersect the lines of adjacent segments: corners (`_corners`).
    6. Classify the other ends; an occluding end is half a beam beyond its hit (`_free_ends`).

    Args:
        scan: The scan.
        lidar: Its scanner.
        spec: Parameters.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    xy = points(scan, lidar)
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
    pieces = _longest_pieces(cut.begins, scan.hit, spec.capacity)
    end_beams = _end_beams(scan.ranges, xy, jump, cut.normal, pieces.spans)
    line = _fit_lines(xy, unit(bearings(lidar)).astype(xy.dtype), pieces, end_beams, noise, spec)
    x, y = _project_ends(end_beams, line, pieces.fitted)
    adjacent = _adjacent(pieces.spans, end_beams)
    corner, meets = _corners(line, x, y, adjacent, pieces.fitted, noise, lidar, spec)
    free, occluding = _free_ends(line, x, y, end_beams, pieces.fitted, lidar)

    # The corner of segments k and k + 1 is the last end of k and the first of k + 1.
    at_corner = jnp.stack([*corner, meets.astype(x.dtype)])
    at_corner = jnp.stack([jnp.roll(at_corner, 1, axis=1), at_corner], axis=2)  # (6, K, 2)
    ends = _Ends(*jnp.where(at_corner[5:] > 0.0, at_corner[:5], jnp.stack(free)))
    cov = jnp.stack([ends.cov_xx, ends.cov_xy, ends.cov_xy, ends.cov_yy], axis=2)
    surplus_beam = scan.hit & (pieces.of_beam == spec.capacity) & pieces.overflow
    return Runs(
        normal=jnp.stack([line.nx, line.ny], axis=1),
        centre=line.centre,
        ends=jnp.stack([ends.x, ends.y], axis=2),
        end_cov=cov.reshape(spec.capacity, 2, 2, 2),
        real=occluding | jnp.stack([jnp.roll(adjacent, 1), adjacent], axis=1),
        sharp=occluding,
        offset_variance=line.offset_variance,
        angle_variance=line.angle_variance,
        count=pieces.spans.size,
        meets=meets,
        valid=pieces.valid,
        of_beam=jnp.where(surplus_beam, pieces.surplus, pieces.of_beam),
    )


def _longest_pieces(begins: Array, hit: Array, capacity: int) -> _Pieces:
    """The `capacity` pieces with most beams; `begins` and `hit` (R,) as of `lines.longest`."""
    spans = lines.longest(begins, hit, capacity=capacity)
    fewest = jnp.argmin(spans.size).astype(jnp.int32)
    overflow = jnp.sum(begins & hit, dtype=jnp.int32) > capacity
    own = ~(overflow & (jnp.arange(capacity, dtype=jnp.int32) == fewest))
    return _Pieces(
        spans=spans,
        of_beam=spans.of_beam(hit.size),
        valid=own & (spans.size > 0),
        fitted=own & (spans.size >= 3),
        overflow=overflow,
        surplus=fewest,
    )


def _end_beams(
    ranges: Array, xy: Array, jump: Array, normal: Array, spans: lines.Spans
) -> _EndBeams:
    """First and last beam of each piece and what is beside them, by one gather.

    Args:
        ranges: (R,) [m].
        xy: (R, 2) [m] hits.
        jump: (R,) bool, of `jumps`.
        normal: (R, 2), of `lines.Partition`.
        spans: (K,) first and last beams.
    """
    jump = jump.astype(ranges.dtype)
    before = jnp.stack([jnp.roll(ranges, 1), jump], axis=1)
    after = jnp.stack([jnp.roll(ranges, -1), jnp.append(jump[1:], 1.0)], axis=1)
    # Range 0 outside the field of view: no wall ends there, only the view of it.
    before, after = before.at[0].set(0.0), after.at[-1, 0].set(0.0)
    table = jnp.concatenate([xy, normal, ranges[:, None], before, after], axis=1)
    first, last = jnp.minimum(spans.first, ranges.size - 1), jnp.maximum(spans.last, 0)
    beams = table[jnp.stack([first, last], axis=1)]  # (K, 2, 9)
    return _EndBeams(
        first=first,
        last=last,
        x=beams[:, :, 0],
        y=beams[:, :, 1],
        ranges=beams[:, :, 4],
        range_beyond=jnp.stack([beams[:, 0, 5], beams[:, 1, 7]], axis=1),
        jump=jnp.stack([beams[:, 0, 6], beams[:, 1, 8]], axis=1),
        normal=beams[:, 1, 2:4],
    )


def _fit_lines(
    xy: Array, ray: Array, pieces: _Pieces, end_beams: _EndBeams, noise: float, spec: RunSpec
) -> _Line:
    """Weighted total least squares: one line for each piece.

    A range error e moves a point by e cos(incidence) across the wall, so grazing beams count more:
    weight = 1 / ((noise cos)^2 + rough^2). Of six beams or more the outermost two do not count:
    they may be mixed pixels. With W the sum of the weights and S that of weight times the squared
    coordinate along the line, the variances are scale / W of the offset and scale / S of the angle.
    The scale is the reduced chi-square, with four more degrees of freedom at their expectation.

    Args:
        xy: (R, 2) [m] hits.
        ray: (R, 2) unit vectors of the beams.
        pieces: The pieces.
        end_beams: Their outermost beams.
        noise: [m] standard deviation of a range.
        spec: Parameters.
    """
    count, of_beam = pieces.spans.size, pieces.of_beam
    trim = jnp.where(count >= 6, 1, 0)
    inner = jnp.stack([end_beams.first + trim, end_beams.last - trim], axis=1)
    inner = inner.at[of_beam].get(mode="clip")  # (R, 2)
    beam = jnp.arange(of_beam.size, dtype=jnp.int32)
    used = (of_beam < spec.capacity) & (beam >= inner[:, 0]) & (beam <= inner[:, 1])
    cos_incidence = dot(end_beams.normal.at[of_beam].get(mode="clip"), ray)
    weight = jnp.where(used, 1.0 / ((noise * cos_incidence) ** 2 + spec.rough**2), 0.0)
    sums = lines.moments(xy, weight, of_beam, lines=spec.capacity)
    normal, chi_square, spread = lines.principal(sums.scatter)
    sign = jnp.where(dot(normal, sums.mean) > 0.0, -1.0, 1.0)  # towards the robot
    degrees = jnp.maximum(count - 2 * trim - 2, 0).astype(xy.dtype)
    scale = (4.0 + chi_square) / (4.0 + degrees)
    return _Line(
        nx=sign * normal[:, 0],
        ny=sign * normal[:, 1],
        cx=sums.mean[:, 0],
        cy=sums.mean[:, 1],
        offset_variance=scale / jnp.maximum(sums.weight, 1e-9),
        angle_variance=scale / jnp.maximum(spread, 1e-6),
        centre=sums.mean,
    )


def _project_ends(end_beams: _EndBeams, line: _Line, fitted: Array) -> tuple[Array, Array]:
    """Outermost hits x, y (K, 2) [m], projected onto the line where there is one: c + s u."""
    x, y = end_beams.x, end_beams.y
    along = line.coordinate(x, y)
    x = jnp.where(fitted[:, None], line.cx[:, None] + along * line.ny[:, None], x)
    y = jnp.where(fitted[:, None], line.cy[:, None] - along * line.nx[:, None], y)
    return x, y


def _adjacent(spans: lines.Spans, end_beams: _EndBeams) -> Array:
    """Whether the next piece (K,) begins at the next beam, without a jump between them."""
    slot = jnp.arange(spans.first.size, dtype=jnp.int32)
    next_beam = spans.last + 1 == jnp.roll(spans.first, -1)
    return (slot < slot.size - 1) & next_beam & (end_beams.jump[:, 1] == 0.0)


def _corners(
    line: _Line,
    x: Array,
    y: Array,
    adjacent: Array,
    fitted: Array,
    noise: float,
    lidar: Lidar,
    spec: RunSpec,
) -> tuple[_Ends, Array]:
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

    tolerance = spec.corner + 3 * noise / jnp.maximum(jnp.abs(turn), 0.3)
    tolerance += 2 * lidar.step * _length(corner_x, corner_y)
    near = _length(corner_x - x[:, 1], corner_y - y[:, 1]) < tolerance
    near &= _length(corner_x - next_x, corner_y - next_y) < tolerance
    meets = adjacent & fitted & jnp.roll(fitted, -1) & (jnp.abs(turn) > 0.3) & near

    next_along = (corner_x - dx) * my - (corner_y - dy) * mx
    variance = (along**2 * line.angle_variance + line.offset_variance) / safe**2
    next_variance = (next_along**2 * next_angle_variance + next_offset_variance) / safe**2
    corner = _Ends(
        x=corner_x,
        y=corner_y,
        cov_xx=variance * my * my + next_variance * ny * ny,
        cov_xy=-variance * my * mx - next_variance * ny * nx,
        cov_yy=variance * mx * mx + next_variance * nx * nx,
    )
    return corner, meets


def _free_ends(
    line: _Line, x: Array, y: Array, end_beams: _EndBeams, fitted: Array, lidar: Lidar
) -> tuple[_Ends, Array]:
    """Ends (K, 2) of pieces that are no corners, and which of them are occluding ends.

    An occluding end is on the near side of a jump: the beam beyond passes the wall. So the wall
    ends between the two beams, on average half their spacing on the wall beyond the last hit:

        half = step / 2 * range / cos(incidence)

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
    distance = _length(x, y)
    cos_incidence = jnp.abs(nx * x + ny * y) / jnp.maximum(distance, 1e-6)
    half = 0.5 * lidar.step * distance / jnp.maximum(cos_incidence, 0.1)
    occluding = end_beams.jump > 0.0
    occluding &= end_beams.ranges < jnp.minimum(end_beams.range_beyond, 0.9 * lidar.reach)
    outwards = jnp.array([-1.0, 1.0], x.dtype)[None]
    shift = jnp.where(occluding & fitted[:, None], half, 0.0) * outwards
    x, y = x + ny * shift, y - nx * shift

    offset_variance, angle_variance = line.offset_variance[:, None], line.angle_variance[:, None]
    across = offset_variance + line.coordinate(x, y) ** 2 * angle_variance
    along = across + half**2 / 3
    ends = _Ends(
        x=x,
        y=y,
        cov_xx=across * nx * nx + along * ny * ny,
        cov_xy=(across - along) * nx * ny,
        cov_yy=across * ny * ny + along * nx * nx,
    )
    return ends, occluding


def run_cells(scan: Scan, lidar: Lidar, runs: Runs, spec: GridSpec, *, fill: int = 6) -> Array:
    """Segment (H, W) int8 that each cell lies on, -1 for none; drawn without gaps from hit to hit.

    Args:
        scan: The scan.
        lidar: Its scanner.
        runs: Its segments; where two share a cell, the later one has it.
        spec: The grid to draw on.
        fill: Points drawn from each hit to the next of the same segment.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    xy, of_beam = points(scan, lidar), runs.of_beam
    capacity = runs.valid.size
    is_last = jnp.arange(of_beam.size, dtype=jnp.int32) == of_beam.size - 1
    continues = (of_beam == jnp.roll(of_beam, -1)) & ~is_last
    continues &= runs.valid[jnp.minimum(of_beam, capacity - 1)]
    fraction = jnp.where(continues[:, None], jnp.arange(fill, dtype=xy.dtype) / fill, 0.0)
    drawn = xy[:, None] + fraction[:, :, None] * (jnp.roll(xy, -1, axis=0) - xy)[:, None]
    drawn = jnp.where((of_beam < capacity)[:, None, None], drawn, jnp.inf)
    index = cell_of(drawn.reshape(-1, 2), spec)
    cells = jnp.full(spec.shape, -1, jnp.int8)
    values = jnp.repeat(of_beam, fill).astype(jnp.int8)
    return cells.at[index[:, 0], index[:, 1]].max(values, mode="drop")
