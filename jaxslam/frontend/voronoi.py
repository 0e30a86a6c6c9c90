"""Branches and junctions of a Voronoi diagram on a grid (paper, section 2.3)."""

from functools import reduce

import jax.numpy as jnp
from jax import lax

from jaxslam.core.types import Array, check_array
from jaxslam.frontend.automaton import (
    EMPTY,
    FROZEN,
    Diagram,
    EncodedDiagram,
    as_unsigned,
    diagonal_neighbours,
    four_neighbours,
    neighbours,
    ringed,
    single_labels,
)


def block_union(labels: Array) -> Array:
    """Union (H, W) of the bit sets in the 3 x 3 block around every cell."""
    padded = jnp.pad(labels, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


def _check_cells(diagram: Diagram, sources: Array) -> None:
    """Raise ValueError unless a diagram and its sources have the same cells."""
    check_array("diagram.labels", diagram.labels, ("H", "W"), jnp.unsignedinteger)
    check_array("sources", sources, diagram.labels.shape, jnp.bool_)


def branch_cells(diagram: Diagram, sources: Array) -> Array:
    """Cells (H, W) bool of the Voronoi branches.

    A cell in which fronts met is a branch cell. Where two fronts meet between two cells, no cell
    holds both labels: then the cell with the smaller label is the branch, which stays one cell
    thick, and no two regions touch.

    Args:
        diagram: Result of `automaton.expand`.
        sources: (H, W) bool, the cells that fronts started from; they are never branches.

    Raises:
        ValueError: `sources` has another shape than the diagram, or type; while tracing.
    """
    _check_cells(diagram, sources)
    labels = diagram.labels
    met = labels & (labels - 1) != 0
    own = jnp.where(sources, 0, single_labels(labels))
    larger = jnp.zeros_like(met)
    for other in neighbours(own):
        larger |= other > own
    return ~sources & (met | ((own != 0) & larger))


def junction_cells(diagram: Diagram, sources: Array) -> Array:
    """Cells (H, W) bool whose 3 x 3 block, sources left out, holds three or more labels.

    Args:
        diagram: Result of `automaton.expand`.
        sources: (H, W) bool, the cells that fronts started from.

    Raises:
        ValueError: `sources` has another shape than the diagram, or type; while tracing.
    """
    _check_cells(diagram, sources)
    union = block_union(jnp.where(sources, 0, diagram.labels))
    two_less = union & (union - 1)
    return ~sources & (diagram.labels != 0) & (two_less & (two_less - 1) != 0)


def encoded_junction_cells(encoded: EncodedDiagram, sources: Array) -> Array:
    """Cells (H, W) bool whose 3 x 3 block, sources left out, holds three or more single labels.

    As `junction_cells`; a third label is one strictly between the smallest and the largest.

    Args:
        encoded: Result of `automaton.expand_encoded`.
        sources: (H, W) bool, the cells that fronts started from.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check_array("encoded.cells", encoded.cells, ("H", "W"), jnp.int8)
    check_array("sources", sources, encoded.cells.shape, jnp.bool_)
    own = jnp.where(sources, jnp.int8(FROZEN), encoded.cells)
    padded = ringed(own, FROZEN)
    block = (own, *four_neighbours(padded), *diagonal_neighbours(padded))
    largest = reduce(jnp.maximum, block)
    smallest = reduce(jnp.minimum, as_unsigned(block))
    smallest = lax.bitcast_convert_type(smallest, jnp.int8)  # negative where no label is
    below = reduce(jnp.maximum, (jnp.where(x == largest, jnp.int8(FROZEN), x) for x in block))
    return (below > smallest) & (smallest >= 0) & (encoded.cells != EMPTY) & ~sources
