"""Edge codes on a complete global grid: twelve codes, whichever side a wall is seen from.

A scanner sees only the faces that look towards it, so six codes are enough for a scan
(`edge_codes.edge_codes`). On a global grid every direction occurs, and the method that the paper
compares itself with has twelve codes.
"""

import jax.numpy as jnp

from jaxslam.core.arguments import as_bool
from jaxslam.core.types import Array
from jaxslam.frontend.automaton import neighbours

# Code of each pattern of occupied neighbours, bits N=1 E=2 S=4 W=8, north being the next row and
# east the next column. Faces 1..4 are open to N, E, S, W; convex corners 5..8 to N+E, S+E, S+W,
# N+W; 9 and 10 are lines, open on both sides, along N-S and E-W; 11 and 12 the ends of such lines.
# 0 is no source: neither the inside of an object nor an isolated cell, which is noise (e1).
_CODES = (0, 11, 12, 7, 11, 9, 8, 4, 12, 6, 10, 3, 5, 2, 1, 0)


def global_edge_codes(occupied: Array) -> Array:
    """Edge code (H, W) uint8 of each cell of a complete grid (H, W) bool: 1..12, 0 for no source.

    The paper gives the number of codes, not their patterns. Of the sixteen patterns of four
    neighbours two are no edge; here the two ends of a line along one axis share a code, which
    makes twelve of the other fourteen. Turning the grid by 90 degrees permutes the codes.

    Raises:
        ValueError: `occupied` has another shape or type.

    References:
        Paper, section 2.2.
    """
    occupied = as_bool("occupied", occupied, ("H", "W"))
    north, south, east, west = neighbours(occupied.astype(jnp.uint8))
    pattern = north + 2 * east + 4 * south + 8 * west
    return jnp.where(occupied, jnp.array(_CODES, jnp.uint8)[pattern], 0).astype(jnp.uint8)


def global_edge_code_bits(codes: Array) -> Array:
    """Label bit (H, W) uint16 that each coded cell starts with; code 0 starts nothing."""
    shift = jnp.maximum(codes, 1).astype(jnp.uint16) - jnp.uint16(1)
    return jnp.where(codes > 0, jnp.uint16(1) << shift, jnp.uint16(0))
