"""One scan as a local grid of occupied, free and unknown cells (paper, section 2.2)."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.lidar import Lidar, Scan, points
from jaxslam.types import Array, expect


class GridSpec(NamedTuple):
    """Size of the local grid; static under jit. The robot is at the origin of its frame."""

    cell: float = 0.1  # [m]
    ahead: float = 8.0  # [m] reach of the grid in front of the robot
    behind: float = 0.2  # [m] and behind it
    side: float = 8.0  # [m] and to each side

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells (H, W)."""
        return round((self.ahead + self.behind) / self.cell), round(2 * self.side / self.cell)


class Grid(NamedTuple):
    """What a scan says of each cell; a cell that is neither occupied nor free is unknown."""

    occupied: Array  # (H, W) bool, a beam ended here
    free: Array  # (H, W) bool, beams went through


def corner(spec: GridSpec) -> np.ndarray:
    """Corner (2,) [m, robot frame] of the grid at which cell [0, 0] lies."""
    return -np.array([spec.behind, spec.side])


def cell_of(points: Array, spec: GridSpec) -> Array:
    """Cell index (..., 2) of points (..., 2) [m, robot frame]; (H, W), nowhere, if outside."""
    lead = (1,) * (points.ndim - 1)
    origin = jnp.asarray(corner(spec), points.dtype).reshape(*lead, 2)
    shape = jnp.array(spec.shape, jnp.int32).reshape(*lead, 2)
    # In floating point first: an infinite coordinate has no integer.
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
    """Cells (H, W) whose centre both bracketing beams pass.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    expect("scan.ranges", scan.ranges, (lidar.beams,), jnp.floating)
    # Which beams these are is a matter of static values, so NumPy works it out while tracing.
    x, y = (np.indices(spec.shape) + 0.5) * spec.cell + corner(spec)[:, None, None]
    beam = (np.arctan2(y, x) - lidar.first) / lidar.step
    beam = np.where(beam < -0.5, beam + 2 * np.pi / lidar.step, beam)
    within = (beam > -0.5) & (beam < lidar.beams - 0.5)
    low = np.clip(np.floor(beam), 0, lidar.beams - 2).astype(np.int32)
    away = jnp.asarray(np.hypot(x, y), scan.ranges.dtype)
    return within & (away < jnp.minimum(scan.ranges[:-1], scan.ranges[1:])[low])


def mark(index: Array, spec: GridSpec) -> Array:
    """Grid (H, W) that is True at the cells with index (N, 2); indices outside are dropped."""
    return jnp.zeros(spec.shape, bool).at[index[:, 0], index[:, 1]].set(True, mode="drop")


def rasterise(scan: Scan, lidar: Lidar, spec: GridSpec) -> Grid:
    """Draw a scan on the local grid, walls two cells thick (paper, section 2.2).

    The second cell of a wall lies behind the first, away from the sensor along the dominant axis
    of the beam, along both where their ratio is at least one half; it never covers a free cell.

    Raises:
        ValueError: Ranges or hits are not those of one scan of this lidar; while tracing.
    """
    expect("scan.hit", scan.hit, (lidar.beams,), jnp.bool_)
    xy = points(scan, lidar)
    nowhere = jnp.array(spec.shape, jnp.int32)[None]
    index = jnp.where(scan.hit[:, None], cell_of(xy, spec), nowhere)
    front = mark(index, spec)
    free = seen_free(scan, lidar, spec) & ~front
    size = jnp.abs(xy)
    axes = 2 * size >= jnp.max(size, axis=1, keepdims=True)  # (R, 2) which axes to step along
    behind = index + jnp.where(axes, jnp.sign(xy), 0.0).astype(jnp.int32)
    inside = jnp.all((index < nowhere) & (behind >= 0), axis=1, keepdims=True)
    back = mark(jnp.where(inside, behind, nowhere), spec)
    return Grid(occupied=front | (back & ~free), free=free)
