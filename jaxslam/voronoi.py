"""The cellular automaton that grows a Voronoi diagram (paper, sections 2.1 and 2.3).

A cell holds a *set* of labels as bits: none, one (it belongs to a region), or several (fronts met
in it: it lies on a branch). One rule does everything: an empty open cell takes the union of its
four neighbours that hold exactly one label. A cell that holds a label keeps it, and a branch
cell passes nothing on, which makes the diagonal bisector of the Manhattan distance one cell thin.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.batches import one_by_one
from jaxslam.types import Array, expect


class Diagram(NamedTuple):
    """Which fronts reached each cell, and when."""

    labels: Array  # (H, W) bit set, 0 where nothing arrived
    arrival: Array  # (H, W) int32 step of arrival: 0 at sources, -1 where nothing arrived


def single(labels: Array) -> Array:
    """The labels of cells that hold exactly one, 0 elsewhere; any shape."""
    return jnp.where(labels & (labels - 1) == 0, labels, 0)


def around(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four neighbours (H, W) of every cell: next and previous row, next and previous column."""
    return _beside(jnp.pad(cells, 1))


def _beside(cells: Array) -> tuple[Array, Array, Array, Array]:
    """`around` of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 1:-1], cells[:-2, 1:-1], cells[1:-1, 2:], cells[1:-1, :-2]


def _across(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four diagonal neighbours of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 2:], cells[:-2, 2:], cells[2:, :-2], cells[:-2, :-2]


def block_union(labels: Array) -> Array:
    """Union (H, W) of the bit sets in the 3 x 3 block around every cell."""
    p = jnp.pad(labels, 1)
    rows = p[:-2] | p[1:-1] | p[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


EMPTY, SHUT = -1, -128
"""Values of cells while fronts move: not reached yet, and never to be; see `_fronts`."""

PACE = 8  # steps from one look whether anything still moves to the next


def _next(now: Array, other: Array, *, diagonal: bool, more: bool) -> Array:
    """Cells (H + 2, W + 2) after one step; the ring around them is kept from `other`.

    A front's number is that of its label, and all else is negative. So the largest neighbour, and
    the smallest as unsigned numbers, are the same unless fronts of several labels meet, or none
    is there; what met gets the sign bit, and passes nothing on. An empty cell that has only shut
    ones around it becomes one of them: it can never be reached, unless `more` neighbours count in
    another step.
    """
    bits = lambda cells: (lax.bitcast_convert_type(x, jnp.uint8) for x in cells)
    beside, across = _beside(now), _across(now) if diagonal else ()
    most, least = reduce(jnp.maximum, beside), reduce(jnp.minimum, bits(beside))
    if diagonal:
        nearer = most >= 0
        most = jnp.where(nearer, most, reduce(jnp.maximum, across, most))
        least = jnp.where(nearer, least, reduce(jnp.minimum, bits(across), least))
    if more:
        most = jnp.maximum(most, jnp.int8(EMPTY))
    differ = lax.bitcast_convert_type(least, jnp.int8) - most  # negative where fronts meet
    reached = most | (differ & jnp.int8(SHUT))
    inner = now[1:-1, 1:-1]
    inner = jnp.where(inner == EMPTY, reached, inner)
    # Written to the state before `now`, which nobody needs any more, so that nothing is copied.
    return lax.dynamic_update_slice(other, inner, (1, 1))


def _fronts(start: Array, steps: int, octagon: bool) -> tuple[Array, Array]:
    """Move the fronts of one grid (H + 2, W + 2) int8, ringed by shut cells, until nothing moves.

    Returns:
        The cells: the number of the label that holds it alone, `EMPTY`, or what is shut: closed
        cells and those in which fronts met. And the number of states from 0 on in which each cell
        was empty, which is the step of its arrival.
    """
    small = np.min_scalar_type(steps + 1)
    first = partial(_next, diagonal=False, more=octagon)
    second = partial(_next, diagonal=octagon, more=False)
    empty = lambda cells: (cells == EMPTY).astype(small)

    def two(now: tuple[Array, Array, Array], _: None):
        even, odd, waited = now
        odd = first(even, odd)
        even = second(odd, even)
        return (even, odd, waited + (empty(odd) + empty(even))), None

    def some(now: tuple[Array, Array, tuple[Array, Array, Array]]):
        done, _, cells = now
        cells, _ = lax.scan(two, cells, length=PACE // 2)
        return done + PACE, jnp.max((cells[0] ^ cells[1]).view(jnp.uint8)) > 0, cells

    whole = steps // PACE * PACE
    go_on = lambda now: (now[0] < whole) & now[1]
    begin = (jnp.int32(0), jnp.bool_(True), (start, start, empty(start)))
    now = lax.while_loop(go_on, some, begin)[2]
    (even, odd, waited), _ = lax.scan(two, now, length=(steps - whole) // 2)
    if steps % 2:
        even = first(even, odd)
        waited = waited + empty(even)
    return even, waited


class Fronts(NamedTuple):
    """How far fronts of sources with one label each have come."""

    cells: Array  # (H, W) int8 number of the label that holds a cell alone, EMPTY, or less: shut
    waited: Array  # (H, W) unsigned, states from 0 on in which it was empty: step of arrival


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
    own = lax.population_count(labels - 1).astype(jnp.int8)
    own = jnp.where((labels != 0) & (labels & (labels - 1) == 0), own, SHUT)
    return jnp.where((labels == 0) & open, EMPTY, own).astype(jnp.int8)


def grow(start: Array, *, steps: int, octagon: bool = False) -> Fronts:
    """Expand all sources together, as numbers of one byte a cell: `expand` without the sets.

    Args:
        start: (H, W) int8 as of `number`.
        steps: Number of steps; a front advances one cell a step.
        octagon: As of `expand`.

    Raises:
        ValueError: `start` has another shape or type, or `steps` is negative; while tracing.
    """
    expect("start", start, ("H", "W"), jnp.int8)
    if steps < 0:
        raise ValueError(f"steps is {steps}, not 0 or more")
    fronts = one_by_one(partial(_fronts, steps=steps, octagon=octagon))
    cells, waited = fronts(jnp.pad(start, 1, constant_values=SHUT))
    return Fronts(cells[1:-1, 1:-1], waited[1:-1, 1:-1])


def gather(labels: Array, fronts: Fronts, *, octagon: bool = False) -> Diagram:
    """The sets of all cells: that of one in which fronts met is known from those around it.

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
    waited, own = jnp.pad(fronts.waited, 1), fronts.waited
    one, none = jnp.ones((), labels.dtype), jnp.zeros((), labels.dtype)
    bits = jnp.where(cells >= 0, one << jnp.maximum(cells, 0).astype(labels.dtype), none)

    def came(around: Callable[[Array], tuple[Array, Array, Array, Array]]) -> Array:
        near = zip(around(bits), around(waited), strict=True)
        return reduce(jnp.bitwise_or, (jnp.where(when < own, bit, none) for bit, when in near))

    union = came(_beside)
    if octagon:
        union |= jnp.where((union == 0) & (own % 2 == 0), came(_across), none)
    union = jnp.where(fronts.cells == EMPTY, none, union | labels)
    return Diagram(labels=union, arrival=jnp.where(union != 0, own.astype(jnp.int32), -1))


@partial(jax.jit, static_argnames=("steps", "octagon"))
def expand(labels: Array, open: Array, *, steps: int, octagon: bool = False) -> Diagram:
    """Expand all sources together for a fixed number of steps.

    Args:
        labels: (H, W) unsigned bit sets: 8 labels in uint8, 16 in uint16, 32 in uint32; non-zero
            cells are the sources.
        open: (H, W) bool, the cells that fronts may enter.
        steps: Number of steps; a front advances one cell a step.
        octagon: Every second step enters the four diagonal neighbours too, where no front comes
            from nearer. Fronts then grow as octagons, which are nearer to circles than the paper's
            diamonds.

    Raises:
        ValueError: An argument has another shape or type, or `steps` is negative; while tracing.

    References:
        Paper, section 2.1, Figs. 1 and 2.
    """
    fronts = grow(number(labels, open), steps=steps, octagon=octagon)
    return gather(labels, fronts, octagon=octagon)


def crowded(fronts: Fronts, sources: Array) -> Array:
    """Cells (H, W) bool whose 3 x 3 block, sources left out, holds three or more numbers.

    `junctions` without the sets of the cells in which fronts met.

    Args:
        fronts: Result of `grow`.
        sources: (H, W) bool, the cells they came from.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    expect("fronts.cells", fronts.cells, ("H", "W"), jnp.int8)
    expect("sources", sources, fronts.cells.shape, jnp.bool_)
    own = jnp.where(sources, jnp.int8(SHUT), fronts.cells)
    p = jnp.pad(own, 1, constant_values=SHUT)
    block = (own, *_beside(p), *_across(p))
    most = reduce(jnp.maximum, block)
    # As unsigned numbers, what holds no label is larger than what does.
    least = reduce(jnp.minimum, (lax.bitcast_convert_type(x, jnp.uint8) for x in block))
    least = lax.bitcast_convert_type(least, jnp.int8)
    between = reduce(jnp.logical_or, ((x > least) & (x < most) for x in block))
    return between & (least >= 0) & (fronts.cells != EMPTY) & ~sources


def _expect_cells(diagram: Diagram, sources: Array) -> None:
    """Raise ValueError unless a diagram and its sources fit."""
    expect("diagram.labels", diagram.labels, ("H", "W"), jnp.unsignedinteger)
    expect("sources", sources, diagram.labels.shape, jnp.bool_)


def branches(diagram: Diagram, sources: Array) -> Array:
    """Cells (H, W) bool of the Voronoi branches.

    A cell in which fronts met is a branch. Where two fronts meet between two cells, no cell holds
    both labels: then the cell with the smaller label is the branch, so that the branch stays
    one cell thick and no two regions are left unseparated.

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
