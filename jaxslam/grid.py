"""One scan as a local grid of occupied, free and unknown cells (paper, section 2.2)."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.lidar import Lidar, Scan, points
from jaxslam.types import Array


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


def cell_of(points: Array, spec: GridSpec) -> Array:
    """Cell index (..., 2) of points (..., 2) [m, robot frame]; H or W, which is nowhere, outside."""
    index = jnp.floor((points + jnp.array([spec.behind, spec.side])) / spec.cell).astype(jnp.int32)
    shape = jnp.array(spec.shape)
    return jnp.where(jnp.all((index >= 0) & (index < shape), -1, keepdims=True), index, shape)


def centre_of(index: Array, spec: GridSpec) -> Array:
    """Centre (..., 2) [m, robot frame] of the cells with index (..., 2)."""
    return (index + 0.5) * spec.cell - jnp.array([spec.behind, spec.side])


def centres(spec: GridSpec) -> Array:
    """Centre (H, W, 2) [m, robot frame] of every cell."""
    return centre_of(jnp.stack(jnp.indices(spec.shape), axis=-1), spec)


def seen_free(scan: Scan, lidar: Lidar, spec: GridSpec) -> Array:
    """Cells (H, W) whose centre both bracketing beams pass."""
    xy = centres(spec)
    away = jnp.hypot(xy[..., 0], xy[..., 1])
    beam = (jnp.arctan2(xy[..., 1], xy[..., 0]) - lidar.first) / lidar.step
    beam = jnp.where(beam < -0.5, beam + 2 * jnp.pi / lidar.step, beam)
    low = jnp.floor(beam).astype(jnp.int32)
    within = (beam > -0.5) & (beam < lidar.beams - 0.5)
    shorter = jnp.minimum(scan.ranges[:-1], scan.ranges[1:])
    return within & (away < shorter[jnp.clip(low, 0, lidar.beams - 2)])


def mark(index: Array, spec: GridSpec) -> Array:
    """Grid (H, W) that is True at the cells with index (N, 2); indices outside are dropped."""
    return jnp.zeros(spec.shape, bool).at[index[:, 0], index[:, 1]].set(True, mode="drop")


def rasterise(scan: Scan, lidar: Lidar, spec: GridSpec) -> Grid:
    """Draw a scan on the local grid, walls two cells thick (paper, section 2.2).

    The second cell of a wall lies behind the first, away from the sensor along the dominant axis
    of the beam, along both where their ratio is at least one half; it never covers a free cell.
    """
    xy = points(scan, lidar)
    nowhere = jnp.array(spec.shape)
    index = jnp.where(scan.hit[:, None], cell_of(xy, spec), nowhere)
    front = mark(index, spec)
    free = seen_free(scan, lidar, spec) & ~front
    size = jnp.abs(xy)
    axes = 2 * size >= jnp.max(size, axis=1, keepdims=True)  # (R, 2) which axes to step along
    behind = index + jnp.where(axes, jnp.sign(xy), 0.0).astype(jnp.int32)
    inside = jnp.all((index < nowhere) & (behind >= 0), axis=1, keepdims=True)
    back = mark(jnp.where(inside, behind, nowhere), spec)
    return Grid(occupied=front | (back & ~free), free=free)
