"""Cellular automaton that grows a Voronoi diagram on a grid (paper, sections 2.1 and 2.3).

Rule. A cell holds a set of labels, as bits: none (empty), one (it belongs to the region of that
label), or several (fronts met in it: it is a branch cell). All cells change at once, step by step:

    for each cell that is open and empty:
        arrived = the labels of those of its four neighbours that hold exactly one label
        the cell holds the union of arrived

A cell that holds a label keeps it, and a branch cell passes nothing on: diagonal bisectors of the
Manhattan distance are one cell thin.

Encoding. `grow` follows this rule with one signed byte per cell:

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
fronts met are recovered from their neighbours when growth has ended (`gather`).
"""

from collections.abc import Callable, Iterator
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.batches import one_by_one
from jaxslam.types import Array, expect


class Diagram(NamedTuple):
    """Voronoi diagram on a grid: which fronts reached each cell, and when.

    Attributes:
        labels: (H, W) unsigned bit set of labels, 0 where no front arrived.
        arrival: (H, W) int32 step of arrival: 0 at sources, -1 where no front arrived.
    """

    labels: Array
    arrival: Array


def single(labels: Array) -> Array:
    """The labels of cells that hold exactly one, 0 elsewhere; any shape."""
    return jnp.where(labels & (labels - 1) == 0, labels, 0)


def around(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four neighbours (H, W) of every cell: next and previous row, next and previous column."""
    return _four_neighbours(jnp.pad(cells, 1))


def _four_neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """`around` of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 1:-1], cells[:-2, 1:-1], cells[1:-1, 2:], cells[1:-1, :-2]


def _diagonal_neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four diagonal neighbours of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 2:], cells[:-2, 2:], cells[2:, :-2], cells[:-2, :-2]


def block_union(labels: Array) -> Array:
    """Union (H, W) of the bit sets in the 3 x 3 block around every cell."""
    padded = jnp.pad(labels, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


EMPTY, SHUT = -1, -128
"""Values of cells that hold no label: not reached yet, and never to be reached."""

PACE = 8  # steps between two checks whether any cell still changes


def _as_unsigned(cells: tuple[Array, ...]) -> Iterator[Array]:
    """The bits of int8 arrays as uint8: what holds no label is above all labels."""
    return (lax.bitcast_convert_type(x, jnp.uint8) for x in cells)


def _step(cells: Array, buffer: Array, *, diagonal: bool, diagonal_next: bool) -> Array:
    """One step of the automaton, in the encoding of the module's docstring.

    Args:
        cells: (H + 2, W + 2) int8, ringed by shut cells.
        buffer: An earlier state, of which the ring is kept and the rest overwritten, not copied.
        diagonal: Where none of the four neighbours holds a label, the diagonal ones count.
        diagonal_next: They count in the next step: a cell between four shut ones stays empty.

    Returns:
        The cells (H + 2, W + 2) after the step.
    """
    sides = _four_neighbours(cells)
    corners = _diagonal_neighbours(cells) if diagonal else ()
    largest, smallest = reduce(jnp.maximum, sides), reduce(jnp.minimum, _as_unsigned(sides))
    if diagonal:
        from_side = largest >= 0
        largest = jnp.where(from_side, largest, reduce(jnp.maximum, corners, largest))
        with_corners = reduce(jnp.minimum, _as_unsigned(corners), smallest)
        smallest = jnp.where(from_side, smallest, with_corners)
    if diagonal_next:
        largest = jnp.maximum(largest, jnp.int8(EMPTY))
    # The sign bit is set where labels differ. No overflow: both are labels, or both are negative.
    difference = lax.bitcast_convert_type(smallest, jnp.int8) - largest
    reached = largest | (difference & jnp.int8(SHUT))
    inner = cells[1:-1, 1:-1]
    inner = jnp.where(inner == EMPTY, reached, inner)
    return lax.dynamic_update_slice(buffer, inner, (1, 1))


def _grow_padded(start: Array, steps: int, octagon: bool) -> tuple[Array, Array]:
    """Apply `_step` to one grid, `steps` times or until nothing changes any more.

    Steps go in pairs, odd and even: the two states are each other's buffers, and of an octagon
    the odd step enters the four neighbours, the even one the diagonal ones too:

                     . . . . .         . 2 2 2 .
        step 1:      . . 1 . .   2:    2 2 1 2 2
                     . 1 0 1 .         2 1 0 1 2
                     . . 1 . .         2 2 1 2 2
                     . . . . .         . 2 2 2 .

    After n steps a front from the origin has |x|, |y| <= n and |x| + |y| <= n + n // 2.

    Args:
        start: (H + 2, W + 2) int8, ringed by shut cells.
        steps: The most steps.
        octagon: As of `expand`.

    Returns:
        The cells at the end, and in how many states from 0 on each was empty: its step of arrival.
    """
    counter = np.min_scalar_type(steps + 1)
    odd_step = partial(_step, diagonal=False, diagonal_next=octagon)
    even_step = partial(_step, diagonal=octagon, diagonal_next=False)

    def is_empty(cells: Array) -> Array:
        return (cells == EMPTY).astype(counter)

    def two_steps(state: tuple[Array, Array, Array], _: None):
        even, odd, waited = state
        odd = odd_step(even, odd)
        even = even_step(odd, even)
        return (even, odd, waited + (is_empty(odd) + is_empty(even))), None

    def until_check(carry: tuple[Array, Array, tuple[Array, Array, Array]]):
        done, _, state = carry
        state, _ = lax.scan(two_steps, state, length=PACE // 2)
        changes = jnp.max((state[0] ^ state[1]).view(jnp.uint8)) > 0
        return done + PACE, changes, state

    checked = steps // PACE * PACE
    first = (jnp.int32(0), jnp.bool_(True), (start, start, is_empty(start)))
    state = lax.while_loop(lambda carry: (carry[0] < checked) & carry[1], until_check, first)[2]
    (even, odd, waited), _ = lax.scan(two_steps, state, length=(steps - checked) // 2)
    if steps % 2:
        even = odd_step(even, odd)
        waited = waited + is_empty(even)
    return even, waited


class Fronts(NamedTuple):
    """Result of `grow`: the cells in the encoding of the module's docstring.

    Attributes:
        cells: (H, W) int8 number of the only label that a cell holds, EMPTY, or shut (below EMPTY).
        waited: (H, W) unsigned, in how many states from 0 on it was empty: its step of arrival.
    """

    cells: Array
    waited: Array


def number(labels: Array, open: Array) -> Array:
    """Cells (H, W) int8 that fronts start from: numbers of single labels, EMPTY, or SHUT.

    Args:
        labels: (H, W) unsigned bit sets.
        open: (H, W) bool, the cells that fronts may enter.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    expect("labels", labels, ("H", "W"), jnp.unsignedinteger)
    expect("open", open, labels.shape, jnp.bool_)
    own = lax.population_count(labels - 1).astype(jnp.int8)  # of 1 << n: n
    own = jnp.where((labels != 0) & (labels & (labels - 1) == 0), own, SHUT)
    return jnp.where((labels == 0) & open, EMPTY, own).astype(jnp.int8)


def grow(start: Array, *, steps: int, octagon: bool = False) -> Fronts:
    """Expand all sources together, in the encoding of one byte per cell.

    Args:
        start: (H, W) int8 as of `number`.
        steps: Number of steps; a front advances one cell per step.
        octagon: As of `expand`.

    Raises:
        ValueError: `start` has another shape or type, or `steps` is negative; while tracing.
    """
    expect("start", start, ("H", "W"), jnp.int8)
    if steps < 0:
        raise ValueError(f"steps is {steps}, not 0 or more")
    grow_padded = one_by_one(partial(_grow_padded, steps=steps, octagon=octagon))
    cells, waited = grow_padded(jnp.pad(start, 1, constant_values=SHUT))
    return Fronts(cells[1:-1, 1:-1], waited[1:-1, 1:-1])


def gather(labels: Array, fronts: Fronts, *, octagon: bool = False) -> Diagram:
    """Recover the sets of labels of all cells from the numbers of single labels.

    A cell holds the labels that its neighbours held before its step of arrival; of octagons, where
    none of the four did and that step is even, those of its diagonal neighbours.

    Args:
        labels: (H, W) unsigned bit sets of the sources.
        fronts: What grew from them.
        octagon: As it grew.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    expect("labels", labels, ("H", "W"), jnp.unsignedinteger)
    expect("fronts.cells", fronts.cells, labels.shape, jnp.int8)
    cells = jnp.pad(fronts.cells, 1, constant_values=SHUT)
    waited, arrival = jnp.pad(fronts.waited, 1), fronts.waited
    one, none = jnp.ones((), labels.dtype), jnp.zeros((), labels.dtype)
    bits = jnp.where(cells >= 0, one << jnp.maximum(cells, 0).astype(labels.dtype), none)

    def arrived(neighbours: Callable[[Array], tuple[Array, Array, Array, Array]]) -> Array:
        pairs = zip(neighbours(bits), neighbours(waited), strict=True)
        return reduce(jnp.bitwise_or, (jnp.where(when < arrival, bit, none) for bit, when in pairs))

    union = arrived(_four_neighbours)
    if octagon:
        from_corners = (union == 0) & (arrival % 2 == 0)
        union |= jnp.where(from_corners, arrived(_diagonal_neighbours), none)
    union = jnp.where(fronts.cells == EMPTY, none, union | labels)
    return Diagram(labels=union, arrival=jnp.where(union != 0, arrival.astype(jnp.int32), -1))


@partial(jax.jit, static_argnames=("steps", "octagon"))
def expand(labels: Array, open: Array, *, steps: int, octagon: bool = False) -> Diagram:
    """Expand all sources together for a fixed number of steps.

    Args:
        labels: (H, W) unsigned bit sets, as many labels as bits; non-zero cells are the sources.
        open: (H, W) bool, the cells that fronts may enter.
        steps: Number of steps; a front advances one cell per step.
        octagon: Every second step enters the four diagonal neighbours too, where no front comes
            from a side. Fronts then grow as octagons, which are nearer to circles than the paper's
            diamonds.

    Raises:
        ValueError: An argument has another shape or type, or `steps` is negative; while tracing.

    References:
        Paper, section 2.1, Figs. 1 and 2.
    """
    fronts = grow(number(labels, open), steps=steps, octagon=octagon)
    return gather(labels, fronts, octagon=octagon)


def crowded(fronts: Fronts, sources: Array) -> Array:
    """Cells (H, W) bool whose 3 x 3 block, sources left out, holds three or more single labels.

    As `junctions`; a third label is one strictly between the smallest and the largest.

    Args:
        fronts: Result of `grow`.
        sources: (H, W) bool, the cells they came from.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    expect("fronts.cells", fronts.cells, ("H", "W"), jnp.int8)
    expect("sources", sources, fronts.cells.shape, jnp.bool_)
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
    expect("diagram.labels", diagram.labels, ("H", "W"), jnp.unsignedinteger)
    expect("sources", sources, diagram.labels.shape, jnp.bool_)


def branches(diagram: Diagram, sources: Array) -> Array:
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
    own = jnp.where(sources, 0, single(labels))
    larger = jnp.zeros_like(met)
    for other in around(own):
        larger |= other > own
    return ~sources & (met | ((own != 0) & larger))


def junctions(diagram: Diagram, sources: Array) -> Array:
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
