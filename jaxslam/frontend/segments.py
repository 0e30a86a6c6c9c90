"""Straight wall segments of a scan: the records, and the cells of the grid that they lie on.

They are found in the order of the beams, with their line fits (`segmentation.find_segments`). They
are the default sources of the Voronoi automaton; the paper's are edge codes (`edge_codes`).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import sequential_vmap_on_cpu
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import dot
from jaxslam.core.types import Array
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.lidar import beam_ends


class Segments(NamedTuple):
    """Straight wall segments of a scan, counter-clockwise in the order of its beams, padded to K.

    Robot frame throughout. See `segmentation.find_segments` for a figure.

    Attributes:
        normal: (K, 2) unit normal of the line, towards the robot.
        centre: (K, 2) [m] weighted mean of the points, on the line.
        ends: (K, 2, 2) [m] first and last end.
        end_cov: (K, 2, 2, 2) [m^2] covariance of each end.
        end_is_real: (K, 2) bool, the wall itself ends there, not only the view of it.
        end_occludes: (K, 2) bool, occluding end: what lies behind it is hidden by the wall.
        offset_variance: (K,) [m^2] variance of the line across itself, at `centre`.
        angle_variance: (K,) [rad^2] variance of its direction.
        num_beams: (K,) int32 number of beams that returned.
        meets_next: (K,) bool, this segment meets the next one in a corner, at `ends[:, 1]`.
        valid: (K,) bool, False for padding and for the slot of all surplus segments.
        segment_of_beam: (R,) int32 segment of each beam, K for none.
    """

    normal: Array
    centre: Array
    ends: Array
    end_cov: Array
    end_is_real: Array
    end_occludes: Array
    offset_variance: Array
    angle_variance: Array
    num_beams: Array
    meets_next: Array
    valid: Array
    segment_of_beam: Array

    @property
    def tangent(self) -> Array:
        """Unit vectors (K, 2) from first to last end: counter-clockwise around the robot."""
        return jnp.stack([self.normal[..., 1], -self.normal[..., 0]], axis=-1)

    @property
    def length(self) -> Array:
        """Length (K,) [m]."""
        return dot(self.ends[:, 1] - self.ends[:, 0], self.tangent)

    @property
    def incidence(self) -> Array:
        """Angle (K,) [rad] between the beam to the centre and the normal, 0 to pi / 2."""
        distance = jnp.sqrt(jnp.maximum(dot(self.centre, self.centre), 1e-12))
        cosine = jnp.abs(dot(self.centre, self.normal)) / distance
        return jnp.arccos(jnp.minimum(cosine, 1.0))

    def line_variance(self, along: Array) -> Array:
        """Variance (..., K) [m^2] across the line, `along` (..., K) [m] from the centre."""
        return self.offset_variance + along**2 * self.angle_variance


class SegmentSpec(NamedTuple):
    """Parameters of the segmentation of scans; static under jit.

    Attributes:
        max_segments: K, most segments, at most `MAX_SEGMENTS`.
        jump_distance: [m] two successive hits nearer to each other than this are never a jump.
        max_gap: [m] beams that do not return are no opening if they leave open less than this,
            across the beams; 0: each of them is one.
        segment_cost: Cost of a segment, in squared standard deviations.
        outlier_cost: Bound of the cost of one beam, in squared standard deviations.
        num_candidates: Candidates that the partition keeps at each beam.
        roughness_std: [m] standard deviation of a wall about its line that does not split it.
        roughness_length: [m] length of wall over which that deviation is the same.
        point_std: [m] standard deviation added to each point in the line fit.
        corner_tolerance: [m] largest distance from the ends of two adjacent segments to their
            corner.
    """

    max_segments: int = 48
    jump_distance: float = 0.2
    max_gap: float = 0.4
    segment_cost: float = 20.0
    outlier_cost: float = 16.0
    num_candidates: int = 16
    roughness_std: float = 0.02
    roughness_length: float = 0.03
    point_std: float = 0.002
    corner_tolerance: float = 0.15


POINTS_PER_GAP = 6
"""Points drawn from each hit to the next of the same segment, on cells of 10 cm."""

MAX_SEGMENTS = 64
"""Most segments of a scan."""

LABEL_BITS = 32
"""Bits of a label set."""


def check_segment_spec(spec: SegmentSpec) -> None:
    """Raise ValueError, naming the field, unless a segmentation can have these parameters."""
    if not isinstance(spec, SegmentSpec):
        raise ValueError(f"segments is a {type(spec).__name__}, not a SegmentSpec")
    if not 1 <= spec.max_segments <= MAX_SEGMENTS:
        raise ValueError(f"segments.max_segments is {spec.max_segments}, not 1..{MAX_SEGMENTS}")
    if spec.num_candidates < 1:
        raise ValueError(f"segments.num_candidates is {spec.num_candidates}, not 1 or more")


def segment_bits(segment: Array) -> Array:
    """Bit uint32 of each segment's number (...) in a label set, 0 where it is negative.

    Segments `LABEL_BITS` apart share a bit: no branch between them is in the label sets of the
    diagram. Junctions are not lost: they are found from the numbers.
    """
    shift = (jnp.maximum(segment, 0) % LABEL_BITS).astype(jnp.uint32)
    return jnp.where(segment >= 0, jnp.uint32(1) << shift, jnp.uint32(0))


def segment_cells(
    lidar: Lidar,
    spec: GridSpec,
    scan: Scan,
    segments: Segments,
    *,
    points_per_gap: int = POINTS_PER_GAP,
) -> Array:
    """Segment (H, W) int8 that each cell lies on, -1 for none; drawn without gaps from hit to hit.

    Args:
        lidar: The scanner.
        spec: The grid to draw on.
        scan: The scan.
        segments: Its segments; where two share a cell, the later one has it.
        points_per_gap: Points drawn from each hit to the next of the same segment.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    xy, of_beam = lax.stop_gradient(beam_ends(lidar, scan)), segments.segment_of_beam
    capacity, (height, width) = segments.valid.size, spec.shape
    is_last = jnp.arange(of_beam.size, dtype=jnp.int32) == of_beam.size - 1
    continues = (of_beam == jnp.roll(of_beam, -1)) & ~is_last
    continues &= segments.valid[jnp.minimum(of_beam, capacity - 1)]
    # In cells, and a beam of no segment outside of the grid.
    x = jnp.where(of_beam < capacity, (xy[:, 0] - spec.x_min) / spec.cell_size, -1.0)
    y = (xy[:, 1] + spec.y_half) / spec.cell_size
    to_next = jnp.where(continues, jnp.stack([jnp.roll(x, -1) - x, jnp.roll(y, -1) - y]), 0.0)

    def draw(x: Array, y: Array, to_x: Array, to_y: Array, values: Array) -> Array:
        fraction = jnp.asarray(np.arange(points_per_gap) / points_per_gap, x.dtype)[:, None]
        # The points of a beam lead, and each axis is an array of its own: both are vectorised.
        i, j = (
            jnp.floor(x[None] + fraction * to_x[None]),
            jnp.floor(y[None] + fraction * to_y[None]),
        )
        inside = (i >= 0.0) & (i < height) & (j >= 0.0) & (j < width)
        # One index for a cell, the last for what is outside: faster than two indices.
        size = height * width
        i, j = (jnp.where(inside, k, 0.0).astype(jnp.int32) for k in (i, j))
        cell = jnp.where(inside, i * width + j, size)
        blank = jnp.full(size + 1, -1, jnp.int8)
        values = jnp.broadcast_to(values.astype(jnp.int8), cell.shape)
        return blank.at[cell].max(values, mode="promise_in_bounds")

    return sequential_vmap_on_cpu(draw)(x, y, *to_next, of_beam)[:-1].reshape(spec.shape)
