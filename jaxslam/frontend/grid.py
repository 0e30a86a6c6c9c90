"""Local occupancy grid of one scan: occupied, free and unknown cells (paper, section 2.2)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from jaxslam.core.batching import traced_platform
from jaxslam.core.scan import Lidar, Scan, as_scan
from jaxslam.core.types import Array, check_array
from jaxslam.frontend.lidar import beam_ends

WORD = 32
"""Bits of a number in which the answers for the scans of a batch are kept."""


class GridSpec(NamedTuple):
    """Extent of the local grid in the robot frame (base_link); static under jit.

    The robot is at the origin, x points ahead and y to the left:

         y = y_half   0   -y_half
              +-------+-------+       x = x_max, row H - 1
              |       ^       |
              |       |       |
              +-------R-------+       x = 0
              +---------------+       x = x_min, row 0
        column W - 1       column 0

    Attributes:
        cell_size: [m] side of a cell.
        x_max: [m] x of the foremost edge.
        x_min: [m] x of the rearmost edge; negative behind the robot.
        y_half: [m] extent to each side.
    """

    cell_size: float = 0.1
    x_max: float = 8.0
    x_min: float = -0.2
    y_half: float = 8.0

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells (H, W)."""
        height = round((self.x_max - self.x_min) / self.cell_size)
        return height, round(2 * self.y_half / self.cell_size)


class Grid(NamedTuple):
    """Occupancy grid of a scan; a cell that is neither occupied nor free is unknown.

    Attributes:
        occupied: (H, W) bool, a beam ended here.
        free: (H, W) bool, beams passed through.
    """

    occupied: Array
    free: Array


def check_grid_spec(spec: GridSpec) -> None:
    """Raise ValueError, naming the field, unless the grid has a positive extent and cells."""
    if not isinstance(spec, GridSpec):
        raise ValueError(f"grid is a {type(spec).__name__}, not a GridSpec")
    if not all(math.isfinite(value) for value in spec):
        raise ValueError(f"grid is {spec}, not of finite numbers")
    if not spec.cell_size > 0.0:
        raise ValueError(f"grid.cell_size is {spec.cell_size}, not above 0")
    if min(spec.shape) < 1:
        raise ValueError(f"grid is {spec}, which has {spec.shape} cells")


def grid_origin(spec: GridSpec) -> np.ndarray:
    """Outer corner (2,) [m, robot frame] of cell [0, 0]: the origin of the grid."""
    return np.array([spec.x_min, -spec.y_half])


def cell_of(spec: GridSpec, points: Array) -> Array:
    """Index (..., 2) int32 of the cell of points (..., 2) [m, robot frame].

    Points outside the grid get the index (H, W), which `mode="drop"` drops.
    """
    lead = (1,) * (points.ndim - 1)
    origin = jnp.asarray(grid_origin(spec), points.dtype).reshape(*lead, 2)
    shape = jnp.array(spec.shape, jnp.int32).reshape(*lead, 2)
    # Compared in floating point: an infinite coordinate has no integer.
    index = jnp.floor((points - origin) / spec.cell_size)
    inside = jnp.all((index >= 0.0) & (index < shape.astype(index.dtype)), axis=-1, keepdims=True)
    return jnp.where(inside, jnp.where(inside, index, 0.0).astype(jnp.int32), shape)


def centre_of(spec: GridSpec, index: Array) -> Array:
    """Centre (..., 2) [m, robot frame] of the cells with index (..., 2)."""
    origin = jnp.asarray(grid_origin(spec), float).reshape(*(1,) * (index.ndim - 1), 2)
    return origin + (index.astype(float) + 0.5) * spec.cell_size


def centres(spec: GridSpec) -> Array:
    """Centre (H, W, 2) [m, robot frame] of every cell."""
    return centre_of(spec, jnp.stack(jnp.indices(spec.shape), axis=-1))


def seen_free(lidar: Lidar, spec: GridSpec, scan: Scan) -> Array:
    """Free cells (H, W) bool: both beams beside the centre of the cell end further away.

    Args:
        lidar: The scanner.
        spec: The grid.
        scan: The scan.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    check_array("scan.ranges", scan.ranges, (lidar.num_beams,), jnp.floating)
    # The beams beside a cell depend on static values only: NumPy finds them while tracing.
    x, y = (np.indices(spec.shape) + 0.5) * spec.cell_size + grid_origin(spec)[:, None, None]
    beam = (np.arctan2(y, x) - lidar.angle_min) / lidar.angle_increment
    beam = np.where(beam < -0.5, beam + 2 * np.pi / lidar.angle_increment, beam)
    in_view = (beam > -0.5) & (beam < lidar.num_beams - 0.5)
    beam_before = np.clip(np.floor(beam), 0, lidar.num_beams - 2).astype(np.int32)
    distance = np.where(in_view, np.hypot(x, y), np.inf)
    nearer = lax.stop_gradient(jnp.minimum(scan.ranges[:-1], scan.ranges[1:]))
    return _is_below(nearer, beam_before.reshape(-1), distance.reshape(-1)).reshape(spec.shape)


def _is_below(limits: Array, index: np.ndarray, value: np.ndarray) -> Array:
    """`value < limits[index]`, (N,) bool; of a batch on a CPU in half the time.

    There a gather takes most of it. The limits of all items of a batch beside each other are
    gathered as one, and compared at once; the answers are bits of one number for each value.

    Args:
        limits: (M,) limits.
        index: (N,) static, which of them is for each value.
        value: (N,) static.
    """
    values = value.astype(limits.dtype)  # of NumPy: the functions below close over it

    def compare(limits: Array) -> Array:
        return jnp.less(values, limits[index])

    compared = custom_vmap(compare)

    @compared.def_vmap
    def rule(size: int, is_batched: Sequence[bool], limits: Array) -> tuple[Array, bool]:
        del is_batched
        if size > WORD or traced_platform() != "cpu":
            return jax.vmap(compare)(limits), True
        bit = jnp.arange(size, dtype=jnp.uint32)
        beside = limits.T.at[index].get(mode="promise_in_bounds")  # (N, B)
        bits = jnp.where(values[:, None] < beside, jnp.uint32(1) << bit[None], jnp.uint32(0))
        word = jnp.sum(bits, axis=1, dtype=jnp.uint32)
        return (word[None] >> bit[:, None] & 1).astype(bool), True

    return compared(limits)


def mark_cells(spec: GridSpec, index: Array) -> Array:
    """Grid (H, W) that is True at the cells with index (N, 2); indices outside are dropped."""
    return jnp.zeros(spec.shape, bool).at[index[:, 0], index[:, 1]].set(True, mode="drop")


def rasterise(lidar: Lidar, spec: GridSpec, scan: Scan) -> Grid:
    """Draw a scan on the local grid, walls two cells thick (paper, section 2.2).

    The second cell of a wall lies behind the first, away from the sensor along the dominant axis
    of the beam, along both where their ratio is at least one half; it never covers a free cell.

    Args:
        lidar: The scanner.
        spec: The grid.
        scan: The scan; NumPy arrays, lists or JAX arrays.

    Raises:
        ValueError: Scanner or grid are impossible, or ranges or hits are not those of one scan of
            this lidar; while tracing.
    """
    check_grid_spec(spec)
    scan = as_scan(lidar, scan)
    xy = beam_ends(lidar, scan)
    outside = jnp.array(spec.shape, jnp.int32)[None]
    index = jnp.where(scan.hit[:, None], cell_of(spec, xy), outside)
    front = mark_cells(spec, index)
    free = seen_free(lidar, spec, scan) & ~front
    size = jnp.abs(xy)
    dominant = 2 * size >= jnp.max(size, axis=1, keepdims=True)  # (R, 2)
    behind = index + jnp.where(dominant, jnp.sign(xy), 0.0).astype(jnp.int32)
    inside = jnp.all((index < outside) & (behind >= 0), axis=1, keepdims=True)
    back = mark_cells(spec, jnp.where(inside, behind, outside))
    return Grid(occupied=front | (back & ~free), free=free)
