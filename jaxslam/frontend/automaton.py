"""TODO."""

from collections.abc import Callable
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import sequential_vmap_on_cpu
from jaxslam.core.types import Array, check_array
from jaxslam.frontend.voronoi import _as_unsigned, _diagonal_neighbours, _four_neighbours


class Diagram(NamedTuple):
    """Voronoi diagram on a grid: which fronts reached each cell, and when.

    Attributes:
        labels: (H, W) unsigned bit set of labels, 0 where no front arrived.
        arrival: (H, W) int32 step of arrival: 0 at sources, -1 where no front arrived.
    """

    labels: Array
    arrival: Array


def single_label(labels: Array) -> Array:
    """The labels of cells that hold exactly one, 0 elsewhere; any shape."""
    return jnp.where(labels & (labels - 1) == 0, labels, 0)


def neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four neighbours (H, W) of every cell: next and previous row, next and previous column."""
    return _four_neighbours(jnp.pad(cells, 1))


EMPTY, SHUT = -1, -128
"""Values of cells that hold no label: not reached yet, and never to be reached."""

CHECK_EVERY = 8  # steps between two checks whether any cell still changes


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
        state, _ = lax.scan(two_steps, state, length=CHECK_EVERY // 2)
        changes = jnp.max((state[0] ^ state[1]).view(jnp.uint8)) > 0
        return done + CHECK_EVERY, changes, state

    checked = steps // CHECK_EVERY * CHECK_EVERY
    first = (jnp.int32(0), jnp.bool_(True), (start, start, is_empty(start)))
    state = lax.while_loop(lambda carry: (carry[0] < checked) & carry[1], until_check, first)[2]
    (even, odd, waited), _ = lax.scan(two_steps, state, length=(steps - checked) // 2)
    if steps % 2:
        even = odd_step(even, odd)
        waited = waited + is_empty(even)
    return even, waited


class Fronts(NamedTuple):
    """Result of `expand_fronts`: the cells in the encoding of the module's docstring.

    Attributes:
        cells: (H, W) int8 number of the only label that a cell holds, EMPTY, or shut (below EMPTY).
        arrival: (H, W) unsigned, in how many states from 0 on it was empty: its step of arrival.
    """

    cells: Array
    arrival: Array


def initial_fronts(labels: Array, open: Array) -> Array:
    """Cells (H, W) int8 that fronts start from: numbers of single labels, EMPTY, or SHUT.

    Args:
        labels: (H, W) unsigned bit sets.
        open: (H, W) bool, the cells that fronts may enter.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check_array("labels", labels, ("H", "W"), jnp.unsignedinteger)
    check_array("open", open, labels.shape, jnp.bool_)
    own = lax.population_count(labels - 1).astype(jnp.int8)  # of 1 << n: n
    own = jnp.where((labels != 0) & (labels & (labels - 1) == 0), own, SHUT)
    return jnp.where((labels == 0) & open, EMPTY, own).astype(jnp.int8)


def expand_fronts(start: Array, *, steps: int, octagon: bool = False) -> Fronts:
    """Expand all sources together, in the encoding of one byte per cell.

    Args:
        start: (H, W) int8 as of `initial_fronts`.
        steps: Number of steps; a front advances one cell per step.
        octagon: As of `expand`.

    Raises:
        ValueError: `start` has another shape or type, or `steps` is negative; while tracing.
    """
    check_array("start", start, ("H", "W"), jnp.int8)
    if steps < 0:
        raise ValueError(f"steps is {steps}, not 0 or more")
    grow_padded = sequential_vmap_on_cpu(partial(_grow_padded, steps=steps, octagon=octagon))
    cells, waited = grow_padded(jnp.pad(start, 1, constant_values=SHUT))
    return Fronts(cells[1:-1, 1:-1], waited[1:-1, 1:-1])


def diagram_of_fronts(labels: Array, fronts: Fronts, *, octagon: bool = False) -> Diagram:
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
    check_array("labels", labels, ("H", "W"), jnp.unsignedinteger)
    check_array("fronts.cells", fronts.cells, labels.shape, jnp.int8)
    cells = jnp.pad(fronts.cells, 1, constant_values=SHUT)
    waited, arrival = jnp.pad(fronts.arrival, 1), fronts.arrival
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
    fronts = expand_fronts(initial_fronts(labels, open), steps=steps, octagon=octagon)
    return diagram_of_fronts(labels, fronts, octagon=octagon)
