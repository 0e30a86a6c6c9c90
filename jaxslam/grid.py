"""Local occupancy grid of one scan: occupied, free and unknown cells (paper, section 2.2)."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.lidar import Lidar, Scan, points
from jaxslam.types import Array, expect


class GridSpec(NamedTuple):
    """Extent of the local grid in the robot frame (base_link); static under jit.

    The robot is at the origin, x points ahead and y to the left:

          y = side    0    -side
              +-------+-------+       x = ahead, row H - 1
              |       ^       |
              |       |       |
              +-------R-------+       x = 0
              +---------------+       x = -behind, row 0
        column W - 1       column 0

    Attributes:
        cell: [m] side of a cell.
        ahead: [m] extent of the grid in front of the robot.
        behind: [m] extent behind the robot.
        side: [m] extent to each side.
    """

    cell: float = 0.1
    ahead: float = 8.0
    behind: float = 0.2
    side: float = 8.0

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells (H, W)."""
        return round((self.ahead + self.behind) / self.cell), round(2 * self.side / self.cell)


class Grid(NamedTuple):
    """Occupancy grid of a scan; a cell that is neither occupied nor free is unknown.

    Attributes:
        occupied: (H, W) bool, a beam ended here.
        free: (H, W) bool, beams passed through.
    """

    occupied: Array
    free: Array


def corner(spec: GridSpec) -> np.ndarray:
    """Outer corner (2,) [m, robot frame] of cell [0, 0]: the origin of the grid."""
    return -np.array([spec.behind, spec.side])


def cell_of(points: Array, spec: GridSpec) -> Array:
    """Index (..., 2) int32 of the cell of points (..., 2) [m, robot frame].

    Points outside the grid get the index (H, W), which `mode="drop"` drops.
    """
    lead = (1,) * (points.ndim - 1)
    origin = jnp.asarray(corner(spec), points.dtype).reshape(*lead, 2)
    shape = jnp.array(spec.shape, jnp.int32).reshape(*lead, 2)
    # Compared in floating point: an infinite coordinate has no integer.
    index = jnp.floor((points - origin) / spec.cell)
    inside = jnp.all((index >= 0.0) & (index < shape.astype(index.dtype)), axis=-1, keepdims=True)
    return jnp.where(inside, jnp.where(inside, index, 0.0).astype(jnp.int32), shape)


def centre_of(index: Array, spec: GridSpec) -> Array:
    """Centre (..., 2) [m, robot frame] of the cells with index (..., 2)."""
    origin = jnp.asarray(corner(spec), float).reshape(*(1,) * (index.ndim - 1), 2)
    return origin + (index.astype(float) + 0.5) * spec.cell


def centres(spec: GridSpec) -> Array:
    """Centre (H, W, 2) [m, robot frame] of every cell."""
    return centre_of(jnp.stack(jnp.indices(spec.shape), axis=-1), spec)


def seen_free(scan: Scan, lidar: Lidar, spec: GridSpec) -> Array:
    """Free cells (H, W) bool: both beams beside the centre of the cell end further away.

    Args:
        scan: The scan.
        lidar: Its scanner.
        spec: The grid.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    expect("scan.ranges", scan.ranges, (lidar.beams,), jnp.floating)
    # The beams beside a cell depend on static values only: NumPy finds them while tracing.
    x, y = (np.indices(spec.shape) + 0.5) * spec.cell + corner(spec)[:, None, None]
    beam = (np.arctan2(y, x) - lidar.first) / lidar.step
    beam = np.where(beam < -0.5, beam + 2 * np.pi / lidar.step, beam)
    in_view = (beam > -0.5) & (beam < lidar.beams - 0.5)
    beam_before = np.clip(np.floor(beam), 0, lidar.beams - 2).astype(np.int32)
    distance = jnp.asarray(np.hypot(x, y), scan.ranges.dtype)
    return in_view & (distance < jnp.minimum(scan.ranges[:-1], scan.ranges[1:])[beam_before])


def mark(index: Array, spec: GridSpec) -> Array:
    """Grid (H, W) that is True at the cells with index (N, 2); indices outside are dropped."""
    return jnp.zeros(spec.shape, bool).at[index[:, 0], index[:, 1]].set(True, mode="drop")


def rasterise(scan: Scan, lidar: Lidar, spec: GridSpec) -> Grid:
    """Draw a scan on the local grid, walls two cells thick (paper, section 2.2).

    The second cell of a wall lies behind the first, away from the sensor along the dominant axis
    of the beam, along both where their ratio is at least one half; it never covers a free cell.

    Args:
        scan: The scan.
        lidar: Its scanner.
        spec: The grid.

    Raises:
        ValueError: Ranges or hits are not those of one scan of this lidar; while tracing.
    """
    expect("scan.hit", scan.hit, (lidar.beams,), jnp.bool_)
    xy = points(scan, lidar)
    outside = jnp.array(spec.shape, jnp.int32)[None]
    index = jnp.where(scan.hit[:, None], cell_of(xy, spec), outside)
    front = mark(index, spec)
    free = seen_free(scan, lidar, spec) & ~front
    size = jnp.abs(xy)
    dominant = 2 * size >= jnp.max(size, axis=1, keepdims=True)  # (R, 2)
    behind = index + jnp.where(dominant, jnp.sign(xy), 0.0).astype(jnp.int32)
    inside = jnp.all((index < outside) & (behind >= 0), axis=1, keepdims=True)
    back = mark(jnp.where(inside, behind, outside), spec)
    return Grid(occupied=front | (back & ~free), free=free)
