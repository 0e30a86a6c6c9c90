"""The cellular automaton that grows a Voronoi diagram (paper, sections 2.1 and 2.3).

A cell holds a *set* of labels as bits: none, one (it belongs to a region), or several (fronts met
in it: it lies on a branch). One rule does everything: an empty open cell takes the union of its
four neighbours that hold exactly one label. A cell that holds a label keeps it, and a branch
cell passes nothing on, which makes the diagonal bisector of the Manhattan distance one cell thin.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.types import Array


class Diagram(NamedTuple):
    """Which fronts reached each cell, and when."""

    labels: Array  # (H, W) bit set, 0 where nothing arrived
    arrival: Array  # (H, W) int32 step of arrival: 0 at sources, -1 where nothing arrived


def single(labels: Array) -> Array:
    """The labels of cells that hold exactly one, 0 elsewhere; any shape."""
    return jnp.where(labels & (labels - 1) == 0, labels, 0)


def around(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four neighbours (H, W) of every cell: next and previous row, next and previous column."""
    p = jnp.pad(cells, 1)
    return p[2:, 1:-1], p[:-2, 1:-1], p[1:-1, 2:], p[1:-1, :-2]


def block_union(labels: Array) -> Array:
    """Union (H, W) of the bit sets in the 3 x 3 block around every cell."""
    p = jnp.pad(labels, 1)
    rows = p[:-2] | p[1:-1] | p[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


@partial(jax.jit, static_argnames="steps")
def expand(labels: Array, open: Array, *, steps: int) -> Diagram:
    """Expand all sources together for a fixed number of steps.

    Args:
        labels: (H, W) unsigned bit sets that leave the highest bit free: 7 labels in uint8, 15 in
            uint16, 31 in uint32; non-zero cells are the sources.
        open: (H, W) bool, the cells that fronts may enter.
        steps: Number of steps; a front advances one cell a step.

    References:
        Paper, section 2.1, Figs. 1 and 2.
    """
    # Signed cells carry a mark in the sign bit: what is negative passes nothing on, be it a cell
    # in which fronts met or a closed one. A ring of closed cells stays around the grid, so that
    # no step has to pad it.
    signed = jnp.dtype(f"int{8 * labels.dtype.itemsize}")
    mark = jnp.iinfo(signed).min
    cells = lax.bitcast_convert_type(labels, signed)
    cells = jnp.where(labels & (labels - 1) != 0, cells | mark, cells)
    cells = jnp.where((cells == 0) & ~open, mark, cells)
    start = jnp.pad(cells, 1, constant_values=mark)

    def step(now, _):
        cells, waited = now
        fronts = jnp.maximum(cells, 0)
        union = fronts[2:, 1:-1] | fronts[:-2, 1:-1] | fronts[1:-1, 2:] | fronts[1:-1, :-2]
        met = jnp.where(union & (union - 1) != 0, union | mark, union)
        inner = cells[1:-1, 1:-1]
        inner = jnp.where(inner == 0, met, inner)
        waited = waited + (inner == 0).astype(waited.dtype)
        return (lax.dynamic_update_slice(cells, inner, (1, 1)), waited), None

    # waited: the steps after which a cell was still empty, so it is reached at waited + 1.
    (cells, waited), _ = lax.scan(step, (start, jnp.zeros(labels.shape, jnp.int16)), length=steps)
    cells = lax.bitcast_convert_type(cells[1:-1, 1:-1] & ~mark, labels.dtype)
    arrival = jnp.where(labels != 0, 0, waited.astype(jnp.int32) + 1)
    return Diagram(labels=cells, arrival=jnp.where(cells != 0, arrival, -1))


def branches(diagram: Diagram, sources: Array) -> Array:
    """Cells (H, W) bool of the Voronoi branches.

    A cell in which fronts met is a branch. Where two fronts meet between two cells, no cell holds
    both labels: then the cell with the smaller label is the branch, so that the branch stays
    one cell thick and no two regions are left unseparated.

    Args:
        diagram: Result of `expand`.
        sources: (H, W) bool, the cells the fronts came from; they are never branches.
    """
    labels = diagram.labels
    met = labels & (labels - 1) != 0
    own = jnp.where(sources, 0, single(labels))
    larger = jnp.zeros_like(met)
    for other in around(own):
        larger |= other > own
    return ~sources & (met | ((own != 0) & larger))


def junctions(diagram: Diagram, sources: Array) -> Array:
    """Cells (H, W) bool whose 3 x 3 block, sources left out, holds three or more labels."""
    union = block_union(jnp.where(sources, 0, diagram.labels))
    return ~sources & (diagram.labels != 0) & (lax.population_count(union) >= 3)
