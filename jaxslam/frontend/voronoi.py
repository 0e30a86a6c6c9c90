"""Cellular automaton that grows a Voronoi diagram on a grid (paper, sections 2.1 and 2.3).

Rule. A cell holds a set of labels, as bits: none (empty), one (it belongs to the region of that
label), or several (fronts met in it: it is a branch cell). All cells change at once, step by step:

    for each cell that is open and empty:
        arrived = the labels of those of its four neighbours that hold exactly one label
        the cell holds the union of arrived

A cell that holds a label keeps it, and a branch cell passes nothing on: diagonal bisectors of the
Manhattan distance are one cell thin.

Encoding. `expand_fronts` follows this rule with one signed byte per cell:

    int8          the same bits as uint8    meaning
    0 .. 126      0 .. 126                  number of the only label that the cell holds
    EMPTY = -1    255                       open, not reached yet
    -128 .. -2    128 .. 254                shut: it never changes and passes nothing on
                                            SHUT = -128: closed, or a source of several labels
                                            n - 128: fronts met, n is the largest label of them

Let `largest` be the maximum of the neighbours as int8, `smallest` their minimum as uint8. In the
first order each label is above whatever holds none, in the second it is below. Hence

    neighbours that hold a label    largest, smallest    value of an empty cell
    one label n                     both n               n
    labels a < ... < b              b and a, so a < b    b with the sign bit set: shut
    none, one is EMPTY              -1                   EMPTY
    none, all are shut              -128 .. -2           shut: nothing can ever reach it

SHUT is the sign bit alone, so all of this is `largest | (SHUT if smallest < largest else 0)`:
where `largest` is negative its sign bit is set anyhow. The sets of labels of the cells in which
fronts met are recovered from their neighbours when growth has ended (`diagram_of_fronts`).
"""

from collections.abc import Iterator
from functools import reduce

import jax.numpy as jnp
from jax import lax

from jaxslam.core.types import Array, check_array
from jaxslam.frontend import automaton
from jaxslam.frontend.automaton import EMPTY, SHUT, Diagram, Fronts, single_label


def _four_neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """`neighbours` of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 1:-1], cells[:-2, 1:-1], cells[1:-1, 2:], cells[1:-1, :-2]


def _diagonal_neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four diagonal neighbours of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 2:], cells[:-2, 2:], cells[2:, :-2], cells[:-2, :-2]


def block_union(labels: Array) -> Array:
    """Union (H, W) of the bit sets in the 3 x 3 block around every cell."""
    padded = jnp.pad(labels, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


def _as_unsigned(cells: tuple[Array, ...]) -> Iterator[Array]:
    """The bits of int8 arrays as uint8: what holds no label is above all labels."""
    return (lax.bitcast_convert_type(x, jnp.uint8) for x in cells)


def junction_cells_of_fronts(fronts: Fronts, sources: Array) -> Array:
    """Cells (H, W) bool whose 3 x 3 block, sources left out, holds three or more single labels.

    As `junction_cells`; a third label is one strictly between the smallest and the largest.

    Args:
        fronts: Result of `expand_fronts`.
        sources: (H, W) bool, the cells they came from.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check_array("fronts.cells", fronts.cells, ("H", "W"), jnp.int8)
    check_array("sources", sources, fronts.cells.shape, jnp.bool_)
    own = jnp.where(sources, jnp.int8(SHUT), fronts.cells)
    padded = jnp.pad(own, 1, constant_values=SHUT)
    block = (own, *_four_neighbours(padded), *_diagonal_neighbours(padded))
    largest = reduce(jnp.maximum, block)
    smallest = reduce(jnp.minimum, _as_unsigned(block))
    smallest = lax.bitcast_convert_type(smallest, jnp.int8)  # negative where no label is
    between = reduce(jnp.logical_or, ((x > smallest) & (x < largest) for x in block))
    return between & (smallest >= 0) & (fronts.cells != EMPTY) & ~sources


def _expect_cells(diagram: Diagram, sources: Array) -> None:
    """Raise ValueError unless a diagram and its sources have the same cells."""
    check_array("diagram.labels", diagram.labels, ("H", "W"), jnp.unsignedinteger)
    check_array("sources", sources, diagram.labels.shape, jnp.bool_)


def branch_cells(diagram: Diagram, sources: Array) -> Array:
    """Cells (H, W) bool of the Voronoi branches.

    A cell in which fronts met is a branch cell. Where two fronts meet between two cells, no cell
    holds both labels: then the cell with the smaller label is the branch, which stays one cell
    thick, and no two regions touch.

    Args:
        diagram: Result of `expand`.
        sources: (H, W) bool, the cells the fronts came from; they are never branches.

    Raises:
        ValueError: `sources` has another shape than the diagram, or type; while tracing.
    """
    _expect_cells(diagram, sources)
    labels = diagram.labels
    met = labels & (labels - 1) != 0
    own = jnp.where(sources, 0, single_label(labels))
    larger = jnp.zeros_like(met)
    for other in automaton.neighbours(own):
        larger |= other > own
    return ~sources & (met | ((own != 0) & larger))


def junction_cells(diagram: Diagram, sources: Array) -> Array:
    """Cells (H, W) bool whose 3 x 3 block, sources left out, holds three or more labels.

    Args:
        diagram: Result of `expand`.
        sources: (H, W) bool, the cells the fronts came from.

    Raises:
        ValueError: `sources` has another shape than the diagram, or type; while tracing.
    """
    _expect_cells(diagram, sources)
    union = block_union(jnp.where(sources, 0, diagram.labels))
    two_less = union & (union - 1)
    return ~sources & (diagram.labels != 0) & (two_less & (two_less - 1) != 0)
