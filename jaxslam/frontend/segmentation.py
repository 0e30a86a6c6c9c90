"""Segmentation of a scan into straight wall segments with weighted line fits."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.scan import Lidar, Scan, as_scan
from jaxslam.core.se2 import dot, unit_vector
from jaxslam.core.types import Array
from jaxslam.frontend import line_fitting, segment_ends
from jaxslam.frontend.dropouts import FilledScan, fill_dropouts
from jaxslam.frontend.lidar import beam_angles, beam_ends
from jaxslam.frontend.line_fitting import BeamIntervals
from jaxslam.frontend.segment_ends import (
    EndBeams,
    FittedLines,
    SegmentEnds,
    free_ends,
    project_ends,
    segment_corners,
)
from jaxslam.frontend.segments import Segments, SegmentSpec, check_segment_spec


class _Pieces(NamedTuple):
    """Pieces of a scan between its cuts; those with most beams have a slot 0..K-1 each.

    Attributes:
        intervals: (K,) first and last beam.
        of_beam: (R,) int32 slot of each beam, K for none.
        num_beams: (K,) int32 number of beams that returned.
        valid: (K,) bool.
        fitted: (K,) bool, valid and of three such beams or more: a line is fitted.
        overflow: () bool, there are more pieces than slots.
        surplus: () int32 slot of the fewest beams; if there are more pieces, it takes these too.
    """

    intervals: BeamIntervals
    of_beam: Array
    num_beams: Array
    valid: Array
    fitted: Array
    overflow: Array
    surplus: Array


def find_segments(lidar: Lidar, spec: SegmentSpec, scan: Scan) -> Segments:
    """Straight wall segments of a scan, in the order of its beams.

    Two segments seen by the robot R, 0 and 1, counter-clockwise:

          ==========  wall further away
                .
                 .  beam beyond the end
                  .
        ends[1, 1]  o-----------------------+  ends[1, 0] = ends[0, 1]
        occluding    .      normal[1]       |  a corner: meets_next[0], both ends real
        end, real     .         |           |
                       .        v           |
                        .                   |  ^
                         R    normal[0] <-- |  | tangent[0]
                                            o  ends[0, 0]
                                               only the view ends here: not real

    Steps:

    1. Fill drop-outs and split the beams at jumps (`dropouts.fill_dropouts`), and where straight
       lines fit best (`line_fitting.partition_beams`).
    2. Give the pieces with most beams a slot each (`_longest_pieces`). If there are more than
       `max_segments`, the slot of the fewest beams takes all others too, and is not valid: its
       beams are obstacles without a line.
    3. Fit a line to each by weighted total least squares (`_fit_lines`).
    4. Project the outermost hits onto the lines (`project_ends`).
    5. Intersect the lines of adjacent segments: corners (`segment_corners`).
    6. Classify the other ends; an occluding end is half a beam beyond its hit (`free_ends`).

    Args:
        lidar: The scanner.
        spec: Parameters.
        scan: One of its scans; NumPy arrays, lists or JAX arrays.

    Raises:
        ValueError: Scanner or parameters are impossible, or ranges or hits are not those of one of
            its scans; while tracing.
    """
    check_segment_spec(spec)
    return segment_filled(lidar, spec, fill_dropouts(lidar, spec, as_scan(lidar, scan)))


def segment_filled(lidar: Lidar, spec: SegmentSpec, filled: FilledScan) -> Segments:
    """`find_segments` of a scan whose drop-outs are filled already."""
    xy = beam_ends(lidar, filled.scan)
    noise = max(lidar.range_std, 0.005)
    cut = line_fitting.partition_beams(
        lidar,
        filled.scan,
        filled.jump,
        filled.measured,
        noise,
        segment_cost=spec.segment_cost,
        outlier_cost=spec.outlier_cost,
        num_candidates=spec.num_candidates,
        roughness_std=spec.roughness_std,
        roughness_length=spec.roughness_length,
    )
    pieces = _longest_pieces(cut.begins, filled, spec.max_segments)
    end_beams = _end_beams(filled, xy, cut.normal, pieces.intervals)
    line = _fit_lines(
        xy,
        unit_vector(beam_angles(lidar)).astype(xy.dtype),
        filled,
        pieces,
        end_beams,
        noise,
        spec,
    )
    x, y = project_ends(end_beams, line, pieces.fitted)
    adjacent = segment_ends.adjacent(pieces.intervals, end_beams)
    corner, meets = segment_corners(line, x, y, adjacent, pieces.fitted, noise, lidar, spec)
    free, occluding = free_ends(line, x, y, end_beams, pieces.fitted, lidar)

    # The corner of segments k and k + 1 is the last end of k and the first of k + 1.
    at_corner = jnp.stack([*corner, meets.astype(x.dtype)])
    at_corner = jnp.stack([jnp.roll(at_corner, 1, axis=1), at_corner], axis=2)  # (6, K, 2)
    ends = SegmentEnds(*jnp.where(at_corner[5:] > 0.0, at_corner[:5], jnp.stack(free)))
    cov = jnp.stack([ends.cov_xx, ends.cov_xy, ends.cov_xy, ends.cov_yy], axis=2)
    surplus_beam = filled.scan.hit & (pieces.of_beam == spec.max_segments) & pieces.overflow
    return Segments(
        normal=jnp.stack([line.nx, line.ny], axis=1),
        centre=line.centre,
        ends=jnp.stack([ends.x, ends.y], axis=2),
        end_cov=cov.reshape(spec.max_segments, 2, 2, 2),
        end_is_real=occluding | jnp.stack([jnp.roll(adjacent, 1), adjacent], axis=1),
        end_occludes=occluding,
        offset_variance=line.offset_variance,
        angle_variance=line.angle_variance,
        num_beams=pieces.num_beams,
        meets_next=meets,
        valid=pieces.valid,
        segment_of_beam=jnp.where(surplus_beam, pieces.surplus, pieces.of_beam),
    )


def _longest_pieces(begins: Array, filled: FilledScan, capacity: int) -> _Pieces:
    """The `capacity` pieces with most beams.

    Args:
        begins: (R,) bool, a piece begins at this beam.
        filled: The scan.
        capacity: K.
    """
    hit = filled.scan.hit
    intervals = line_fitting.longest_intervals(begins, hit, capacity=capacity)
    fewest = jnp.argmin(intervals.size).astype(jnp.int32)
    overflow = jnp.sum(begins & hit, dtype=jnp.int32) > capacity
    own = ~(overflow & (jnp.arange(capacity, dtype=jnp.int32) == fewest))
    up_to = jnp.append(jnp.int32(0), jnp.cumsum(filled.measured, dtype=jnp.int32))
    num_beams = up_to[intervals.last + 1] - up_to[jnp.minimum(intervals.first, hit.size)]
    num_beams = jnp.maximum(num_beams, 0)
    return _Pieces(
        intervals=intervals,
        of_beam=intervals.interval_of_beam(hit.size),
        num_beams=num_beams,
        valid=own & (num_beams > 0),
        fitted=own & (num_beams >= 3),
        overflow=overflow,
        surplus=fewest,
    )


def _end_beams(filled: FilledScan, xy: Array, normal: Array, intervals: BeamIntervals) -> EndBeams:
    """First and last returns of each piece and what is beside them, by one gather.

    A piece begins with a return, but may go on after its last one, to where the next begins.

    Args:
        filled: The scan.
        xy: (R, 2) [m] hits.
        normal: (R, 2), of `Partition`.
        intervals: (K,) first and last beams.
    """
    count = filled.measured.size
    end = jnp.clip(intervals.last, 0, count - 1)
    first = jnp.minimum(intervals.first, count - 1)
    last = jnp.where(filled.measured[end], end, jnp.maximum(filled.previous[end], 0))
    beam = jnp.stack([first, last], axis=1)
    jump = filled.jump.astype(xy.dtype)
    # No wall ends outside the field of view, only the view of it: there is a jump.
    jumps = jnp.stack([jump, jnp.append(jump[1:], 1.0)], axis=1)
    gap = filled.gap.astype(xy.dtype)
    own = [xy, normal, filled.scan.ranges[:, None], filled.beyond, gap]
    beams = jnp.concatenate(own, axis=1)[beam]  # (K, 2, 9)
    side = jnp.arange(2)
    return EndBeams(
        first=first,
        last=last,
        inner=jnp.stack([filled.following[first], filled.previous[last]], axis=1),
        x=beams[:, :, 0],
        y=beams[:, :, 1],
        ranges=beams[:, :, 4],
        beyond=jnp.stack([beams[:, 0, 5], beams[:, 1, 6]], axis=1),
        gap=jnp.stack([beams[:, 0, 7], beams[:, 1, 8]], axis=1),
        jump=jumps[jnp.stack([first, end], axis=1), side[None]],
        normal=beams[:, 1, 2:4],
    )


def _fit_lines(
    xy: Array,
    ray: Array,
    filled: FilledScan,
    pieces: _Pieces,
    end_beams: EndBeams,
    noise: float,
    spec: SegmentSpec,
) -> FittedLines:
    """Weighted total least squares: one line for each piece.

    A range error e moves a point by e cos(incidence) across the wall, so grazing beams count more:
    weight = 1 / ((noise cos)^2 + point_std^2). Of six beams or more the outermost two do not count:
    they may be mixed pixels. With W the sum of the weights and S that of weight times the squared
    coordinate along the line, the variances are scale / W of the offset and scale / S of the angle.
    The scale is the reduced chi-square, with four more degrees of freedom at their expectation.

    Args:
        xy: (R, 2) [m] hits.
        ray: (R, 2) unit vectors of the beams.
        filled: The scan; only beams that returned count.
        pieces: The pieces.
        end_beams: Their outermost beams.
        noise: [m] standard deviation of a range.
        spec: Parameters.
    """
    count, of_beam = pieces.num_beams, pieces.of_beam
    trim = count >= 6
    outermost = jnp.stack([end_beams.first, end_beams.last], axis=1)
    inner = jnp.where(trim[:, None], end_beams.inner, outermost)
    inner = inner.at[of_beam].get(mode="clip")  # (R, 2)
    beam = jnp.arange(of_beam.size, dtype=jnp.int32)
    used = filled.measured & (of_beam < spec.max_segments)
    used &= (beam >= inner[:, 0]) & (beam <= inner[:, 1])
    cos_incidence = dot(end_beams.normal.at[of_beam].get(mode="clip"), ray)
    weight = jnp.where(used, 1.0 / ((noise * cos_incidence) ** 2 + spec.point_std**2), 0.0)
    sums = line_fitting.line_moments(xy, weight, of_beam, lines=spec.max_segments)
    normal, chi_square, spread = line_fitting.principal_axes(sums.scatter)
    sign = jnp.where(dot(normal, sums.mean) > 0.0, -1.0, 1.0)  # towards the robot
    degrees = jnp.maximum(count - jnp.where(trim, 4, 2), 0).astype(xy.dtype)
    scale = (4.0 + chi_square) / (4.0 + degrees)
    return FittedLines(
        nx=sign * normal[:, 0],
        ny=sign * normal[:, 1],
        cx=sums.mean[:, 0],
        cy=sums.mean[:, 1],
        offset_variance=scale / jnp.maximum(sums.weight, 1e-9),
        angle_variance=scale / jnp.maximum(spread, 1e-6),
        centre=sums.mean,
    )
