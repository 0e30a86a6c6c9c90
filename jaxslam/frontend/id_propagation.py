"""Junction ids propagated along the branches of a Voronoi diagram by the same automaton."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array
from jaxslam.frontend.automaton import Diagram, expand
from jaxslam.frontend.grid import GridSpec, cell_of, centre_of
from jaxslam.frontend.voronoi import block_union, branch_cells

MAX_ARC_STEPS = 96  # [cells] along a branch that an id propagates at most


def id_bits(count: int) -> Array:
    """One bit (N + 1,) for each of N ids and one that no cell holds, in the smallest type.

    Raises:
        ValueError: There are more than 31 ids.
    """
    for bits in (8, 16, 32):
        if count < bits:
            return jnp.asarray(2 ** np.arange(count + 1, dtype=np.int64), f"uint{bits}")
    raise ValueError(f"features.max_junctions is {count}, more than the 31 that arcs can join")


class PropagatedIds(NamedTuple):
    """Ids of the junctions, propagated along the branches.

    A cell keeps its step of arrival and whether it lies on the branch itself (which is propagated
    on in a band of three cells) in one small integer, so that both are gathered at once:

        packed = 2 * step + on_branch        step = packed // 2        on_branch = packed % 2

    Attributes:
        ids: (H, W) bit sets of ids: none, one, or those that met.
        packed: (H, W) int16 step of arrival and on-branch bit; -1 where no id arrived.
    """

    ids: Array
    packed: Array


def propagate_ids(seeds: Array, diagram: Diagram, sources: Array) -> PropagatedIds:
    """Propagate ids from their seeds (H, W) along the branches of a diagram.

    The branches are widened to three cells, so that a gap of one cell does not cut them.

    Args:
        seeds: (H, W) bit sets of ids, of `seed_cells`.
        diagram: The Voronoi diagram.
        sources: (H, W) bool, the cells that fronts started from.
    """
    branch = branch_cells(diagram, sources)
    band = (block_union(branch.astype(jnp.uint8)) > 0) & (diagram.labels != 0) & ~sources
    met = expand(seeds, band | (seeds != 0), steps=MAX_ARC_STEPS)
    packed = 2 * met.arrival.astype(jnp.int16) + branch.astype(jnp.int16)
    return PropagatedIds(met.labels, jnp.where(met.arrival >= 0, packed, jnp.int16(-1)))


def seed_cells(xy: Array, valid: Array, bit: Array, grid: GridSpec) -> Array:
    """Bit sets (H, W) of ids: each junction (N, 2) marks the cells within 2.5 cells of it."""
    block = jnp.asarray(np.indices((7, 7)).reshape(2, -1).T - 3, jnp.int32)
    cell = cell_of(grid, xy)[:, None] + block[None]  # (N, 49, 2)
    distance = jnp.linalg.norm(centre_of(grid, cell).astype(xy.dtype) - xy[:, None], axis=-1)
    near = (distance < 2.5 * grid.cell_size) & valid[:, None] & jnp.all(cell >= 0, axis=-1)
    row = jnp.where(near, cell[..., 0], grid.shape[0])
    # No id marks a cell twice: the sum of bits is their union.
    own = jnp.broadcast_to(bit[:-1, None], row.shape)
    return jnp.zeros(grid.shape, bit.dtype).at[row, cell[..., 1]].add(own, mode="drop")
