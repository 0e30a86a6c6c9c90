"""Cellular automaton that grows a Voronoi diagram on a grid (paper, sections 2.1 and 2.3).

Rule. A cell holds a set of labels, as bits: none (empty), one (it belongs to the region of that
label), or several (fronts met in it: it is a branch cell). All cells change at once, step by step:

    for each cell that is free and empty:
        arrived = the labels of those of its four neighbours that hold exactly one label
        the cell holds the union of arrived

A cell that holds a label keeps it, and a branch cell passes nothing on: diagonal bisectors of the
Manhattan distance are one cell thin. The cells that hold a label in the beginning are the sources.

Encoding. `expand_encoded` follows this rule with one signed byte per cell:

    int8          the same bits as uint8    meaning
    0 .. 126      0 .. 126                  number of the only label that the cell holds
    EMPTY = -1    255                       free, not reached yet
    -128 .. -2    128 .. 254                frozen: it never changes and passes nothing on
                                            FROZEN = -128: not free, or a source of several labels
                                            n - 128: fronts met, n is the largest label of them

Let `largest` be the maximum of the neighbours as int8, `smallest` their minimum as uint8. In the
first order each label is above whatever holds none, in the second it is below. Hence

    neighbours that hold a label    largest, smallest    value of an empty cell
    one label n                     both n               n
    labels a < ... < b              b and a, so a < b    b with the sign bit set: frozen
    none, one is EMPTY              -1                   EMPTY
    none, all are frozen            -128 .. -2           frozen: nothing can ever reach it

FROZEN is the sign bit alone, so all of this is `largest | (FROZEN if smallest < largest else 0)`:
where `largest` is negative its sign bit is set anyhow. The sets of labels of the cells in which
fronts met are recovered from their neighbours when growth has ended (`decode`).

Start here: `expand` is the whole automaton, `encode_sources`, `expand_encoded` and `decode` are its
three steps.
"""

from collections.abc import Callable, Iterator
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.arguments import as_array, as_bool
from jaxslam.core.batching import sequential_vmap_on_cpu
from jaxslam.core.types import Array, check_array


class Diagram(NamedTuple):
    """Voronoi diagram on a grid: which fronts reached each cell, and when.

    Attributes:
        labels: (H, W) unsigned bit set of labels, 0 where no front arrived.
        arrival: (H, W) int32 step of arrival: 0 at sources, -1 where no front arrived.
    """

    labels: Array
    arrival: Array


def single_labels(labels: Array) -> Array:
    """The labels of cells that hold exactly one, 0 elsewhere; any shape."""
    return jnp.where(labels & (labels - 1) == 0, labels, 0)


def neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four neighbours (H, W) of every cell: next and previous row, next and previous column."""
    return four_neighbours(jnp.pad(cells, 1))


def four_neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """`neighbours` of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 1:-1], cells[:-2, 1:-1], cells[1:-1, 2:], cells[1:-1, :-2]


def diagonal_neighbours(cells: Array) -> tuple[Array, Array, Array, Array]:
    """The four diagonal neighbours of the inner cells (H, W) of (H + 2, W + 2)."""
    return cells[2:, 2:], cells[:-2, 2:], cells[2:, :-2], cells[:-2, :-2]


def ringed(cells: Array, value: int | bool) -> Array:
    """Cells (H + 2, W + 2): those (H, W) given, in a ring of `value`.

    As `jnp.pad`, which on a CPU asks of each cell where it is: written as one block it is copied.
    """
    side = jnp.full((cells.shape[0], 1), value, cells.dtype)
    end = jnp.full((1, cells.shape[1] + 2), value, cells.dtype)
    whole = jnp.concatenate([end, jnp.concatenate([side, cells, side], axis=1), end])
    return lax.optimization_barrier(whole)


def as_unsigned(cells: tuple[Array, ...]) -> Iterator[Array]:
    """The bits of int8 arrays as uint8: what holds no label is above all labels."""
    return (lax.bitcast_convert_type(x, jnp.uint8) for x in cells)


EMPTY, FROZEN = -1, -128
"""Encoded cells that hold no label: not reached yet, and never to be reached."""

CHECK_EVERY = 8
"""Steps between two checks whether any cell still changes; even."""

_Steps = tuple[Array, Array, Array]
"""State after an even and an odd step, and in how many states so far each cell was empty."""


def _step(cells: Array, buffer: Array, *, diagonal: bool, diagonal_next: bool) -> Array:
    """One step of the automaton, in the encoding of the module's docstring.

    Args:
        cells: (H + 2, W + 2) int8, ringed by frozen cells.
        buffer: An earlier state, of which the ring is kept and the rest overwritten, not copied.
        diagonal: Where none of the four neighbours holds a label, the diagonal ones count.
        diagonal_next: They count in the next step: a cell between four frozen ones stays empty.

    Returns:
        The cells (H + 2, W + 2) after the step.
    """
    sides = four_neighbours(cells)
    corners = diagonal_neighbours(cells) if diagonal else ()
    largest, smallest = reduce(jnp.maximum, sides), reduce(jnp.minimum, as_unsigned(sides))
    if diagonal:
        from_side = largest >= 0
        largest = jnp.where(from_side, largest, reduce(jnp.maximum, corners, largest))
        with_corners = reduce(jnp.minimum, as_unsigned(corners), smallest)
        smallest = jnp.where(from_side, smallest, with_corners)
    if diagonal_next:
        largest = jnp.maximum(largest, jnp.int8(EMPTY))
    # The sign bit is set where labels differ. No overflow: both are labels, or both are negative.
    difference = lax.bitcast_convert_type(smallest, jnp.int8) - largest
    reached = largest | (difference & jnp.int8(FROZEN))
    inner = cells[1:-1, 1:-1]
    inner = jnp.where(inner == EMPTY, reached, inner)
    return lax.dynamic_update_slice(buffer, inner, (1, 1))


def _expand_padded(start: Array, steps: int, octagon: bool) -> tuple[Array, Array]:
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
        start: (H + 2, W + 2) int8, ringed by frozen cells.
        steps: Number of steps.
        octagon: As of `expand`.

    Returns:
        The cells at the end, and in how many states from 0 on each was empty: its step of arrival.
    """
    counter = np.min_scalar_type(steps + 1)
    odd_step = partial(_step, diagonal=False, diagonal_next=octagon)
    even_step = partial(_step, diagonal=octagon, diagonal_next=False)

    def is_empty(cells: Array) -> Array:
        return (cells == EMPTY).astype(counter)

    def two_steps(state: _Steps, _: None) -> tuple[_Steps, None]:
        even, odd, waited = state
        odd = odd_step(even, odd)
        even = even_step(odd, even)
        return (even, odd, waited + (is_empty(odd) + is_empty(even))), None

    def until_check(carry: tuple[Array, Array, _Steps]) -> tuple[Array, Array, _Steps]:
        done, _, state = carry
        state, _ = lax.scan(two_steps, state, length=CHECK_EVERY // 2)
        changes = jnp.max((state[0] ^ state[1]).view(jnp.uint8)) > 0
        return done + CHECK_EVERY, changes, state

    def unfinished(carry: tuple[Array, Array, _Steps]) -> Array:
        done, changes, _ = carry
        return (done < checked) & changes

    checked = steps // CHECK_EVERY * CHECK_EVERY
    first = (jnp.int32(0), jnp.bool_(True), (start, start, is_empty(start)))
    _, _, state = lax.while_loop(unfinished, until_check, first)
    (even, odd, waited), _ = lax.scan(two_steps, state, length=(steps - checked) // 2)
    if steps % 2:
        even = odd_step(even, odd)
        waited = waited + is_empty(even)
    return even, waited


class EncodedDiagram(NamedTuple):
    """Result of `expand_encoded`: the cells in the encoding of the module's docstring.

    Attributes:
        cells: (H, W) int8 number of the only label that a cell holds, EMPTY, or frozen (below).
        arrival: (H, W) unsigned, in how many states from 0 on it was empty: its step of arrival.
    """

    cells: Array
    arrival: Array


def encode_sources(labels: Array, free: Array) -> Array:
    """Initial cells (H, W) int8 of the automaton: numbers of single labels, EMPTY, or FROZEN.

    Args:
        labels: (H, W) unsigned bit sets of the sources, 0 elsewhere.
        free: (H, W) bool, the cells that fronts may enter.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check_array("labels", labels, ("H", "W"), jnp.unsignedinteger)
    check_array("free", free, labels.shape, jnp.bool_)
    own = lax.population_count(labels - 1).astype(jnp.int8)  # of 1 << n: n
    own = jnp.where((labels != 0) & (labels & (labels - 1) == 0), own, FROZEN)
    return jnp.where((labels == 0) & free, EMPTY, own).astype(jnp.int8)


def expand_encoded(start: Array, *, steps: int, octagon: bool = False) -> EncodedDiagram:
    """Expand all sources together, in the encoding of one byte per cell.

    Args:
        start: (H, W) int8 as of `encode_sources`.
        steps: Number of steps; a front advances one cell per step.
        octagon: As of `expand`.

    Raises:
        ValueError: `start` has another shape or type, or `steps` is negative; while tracing.
    """
    check_array("start", start, ("H", "W"), jnp.int8)
    if steps < 0:
        raise ValueError(f"steps is {steps}, not 0 or more")
    expand_padded = sequential_vmap_on_cpu(partial(_expand_padded, steps=steps, octagon=octagon))
    cells, waited = expand_padded(ringed(start, FROZEN))
    return EncodedDiagram(cells[1:-1, 1:-1], waited[1:-1, 1:-1])


def decode(labels: Array, encoded: EncodedDiagram, *, octagon: bool = False) -> Diagram:
    """Recover the sets of labels of all cells from the numbers of single labels.

    A cell holds the labels that its neighbours held before its step of arrival; of octagons, where
    none of the four did and that step is even, those of its diagonal neighbours.

    Args:
        labels: (H, W) unsigned bit sets of the sources.
        encoded: Result of `expand_encoded`.
        octagon: The same as given to `expand_encoded`.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check_array("labels", labels, ("H", "W"), jnp.unsignedinteger)
    check_array("encoded.cells", encoded.cells, labels.shape, jnp.int8)
    cells = jnp.pad(encoded.cells, 1, constant_values=FROZEN)
    waited, arrival = jnp.pad(encoded.arrival, 1), encoded.arrival
    one, none = jnp.ones((), labels.dtype), jnp.zeros((), labels.dtype)
    wrap = jnp.int8(8 * labels.dtype.itemsize - 1)  # numbers past the last bit start again
    bits = jnp.where(cells >= 0, one << (jnp.maximum(cells, 0) & wrap).astype(labels.dtype), none)

    def arrived(beside: Callable[[Array], tuple[Array, Array, Array, Array]]) -> Array:
        pairs = zip(beside(bits), beside(waited), strict=True)
        return reduce(jnp.bitwise_or, (jnp.where(when < arrival, bit, none) for bit, when in pairs))

    union = arrived(four_neighbours)
    if octagon:
        from_corners = (union == 0) & (arrival % 2 == 0)
        union |= jnp.where(from_corners, arrived(diagonal_neighbours), none)
    union = jnp.where(encoded.cells == EMPTY, none, union | labels)
    return Diagram(labels=union, arrival=jnp.where(union != 0, arrival.astype(jnp.int32), -1))


def expand(labels: Array, free: Array, *, steps: int, octagon: bool = False) -> Diagram:
    """Expand all sources together for a fixed number of steps.

    Arguments may be NumPy arrays, lists or JAX arrays.

    Args:
        labels: (H, W) bit sets, unsigned, as many labels as bits; non-zero cells are the sources.
            Other integers become 32 bits wide.
        free: (H, W) bool, the cells that fronts may enter.
        steps: Number of steps; a front advances one cell per step.
        octagon: Every second step enters the four diagonal neighbours too, where no front comes
            from a side. Fronts then grow as octagons, which are nearer to circles than the paper's
            diamonds.

    Raises:
        ValueError: An argument has another shape, type or range; while tracing.

    References:
        Paper, section 2.1, Figs. 1 and 2.
    """
    labels = as_labels("labels", labels)
    free = as_bool("free", free, labels.shape)
    if steps < 0:
        raise ValueError(f"steps is {steps}, not 0 or more")
    return _expand(labels, free, steps=steps, octagon=octagon)


@partial(jax.jit, static_argnames=("steps", "octagon"))
def _expand(labels: Array, free: Array, *, steps: int, octagon: bool) -> Diagram:
    """`expand` of JAX arrays."""
    encoded = expand_encoded(encode_sources(labels, free), steps=steps, octagon=octagon)
    return decode(labels, encoded, octagon=octagon)


def as_labels(name: str, x: Any) -> Array:
    """Bit sets (H, W) as a JAX array of unsigned integers, checked.

    Args:
        name: Name of `x`, for the message.
        x: Array-like of unsigned integers; or of signed ones, which become 32 bits wide.

    Raises:
        ValueError: It is no (H, W) of integers, or one is negative or has more than 32 bits.
    """
    x = as_array(name, x)
    if jnp.issubdtype(x.dtype, jnp.signedinteger) and not isinstance(x, jax.core.Tracer):
        check_array(name, x, ("H", "W"))
        if x.size and not 0 <= x.min() <= x.max() < 2**32:
            raise ValueError(f"{name} is from {x.min()} to {x.max()}, not from 0 to 2^32 - 1")
        x = x.astype(np.uint32)
    check_array(name, x, ("H", "W"), jnp.unsignedinteger)
    return jnp.asarray(x)
