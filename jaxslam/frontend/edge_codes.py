"""Edge codes of a local grid, the sources of the automaton in the paper (section 2.2)."""

import jax.numpy as jnp

from jaxslam.core.arguments import as_bool
from jaxslam.core.types import Array
from jaxslam.frontend.automaton import neighbours
from jaxslam.frontend.grid import Grid, GridSpec, centres, check_grid_spec

# Code of each pattern of occupied neighbours, bits N=1 E=2 S=4 W=8 with the sensor axis to the
# north; `_SIDE` is e3 on the clockwise side of the axis and e4 on the other; 0 is no source.
_SIDE = 34
_CODES = (1, _SIDE, 2, 5, _SIDE, _SIDE, 5, 3, 2, 6, 2, 2, 6, 4, 2, 0)


def edge_codes(spec: GridSpec, grid: Grid) -> Array:
    """Edge code (H, W) uint8 of each cell: 1..6 for e1..e6, 0 for no edge.

    e1 is an isolated cell: salt-and-pepper noise. e3 and e4 share a pattern and differ by the side
    of the sensor axis they lie on. Patterns that face away from the sensor cannot be seen by it
    and count as the one they mirror.

    Args:
        spec: The extent of the grid.
        grid: The local grid of a scan; NumPy arrays, lists or JAX arrays.

    Raises:
        ValueError: The grid has another shape or type than `spec` says; while tracing.

    References:
        Paper, section 2.2, Figs. 3 to 5.
    """
    check_grid_spec(spec)
    occupied = as_bool("grid.occupied", grid.occupied, spec.shape)
    north, south, west, east = neighbours(occupied.astype(jnp.uint8))
    pattern = north + 2 * east + 4 * south + 8 * west
    code = jnp.array(_CODES, jnp.uint8)[pattern]
    clockwise = centres(spec)[..., 1] < 0.0
    code = jnp.where(code == _SIDE, jnp.where(clockwise, 3, 4).astype(jnp.uint8), code)
    return jnp.where(occupied, code, 0).astype(jnp.uint8)


def edge_code_bits(codes: Array) -> Array:
    """Label bit (H, W) uint8 that each coded cell starts with: e2..e6; e1 starts nothing."""
    shift = jnp.clip(codes, 2, 6) - jnp.uint8(2)
    return jnp.where(codes >= 2, jnp.uint8(1) << shift, jnp.uint8(0))
