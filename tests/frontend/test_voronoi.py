import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from scipy.ndimage import distance_transform_cdt

from jaxslam.frontend import automaton, voronoi
from jaxslam.frontend.automaton import EMPTY, FROZEN, Diagram, decode, expand, expand_encoded

branch_cells, junction_cells = jax.jit(voronoi.branch_cells), jax.jit(voronoi.junction_cells)
encoded_junction_cells = jax.jit(voronoi.encoded_junction_cells)
encode_sources = jax.jit(automaton.encode_sources)
STEPS = 60  # more than any front needs on the grids below
SEEDS = range(4)

# Fig. 2 of the paper: arrival and label of each cell after three steps; blank where no front has
# arrived and where fronts met. The upper three rows; the others mirror them.
ONE = [
    "      3,1   2,1   3,1       ",
    "3,1   2,1   1,1   2,1   3,1 ",
    "2,1   1,1   0,1   1,1   2,1 ",
]
TWO = [
    "      3,1   2,1   3,1         3,2   2,2   3,2       ",
    "3,1   2,1   1,1   2,1         2,2   1,2   2,2   3,2 ",
    "2,1   1,1   0,1   1,1         1,2   0,2   1,2   2,2 ",
]


def random_grid(seed, shape=(20, 27), labels=5, walls=0.15, dtype=np.uint8):
    """Random sources of a few labels, and free cells."""
    random = np.random.default_rng(seed)
    sources = random.random(shape) < 0.04
    bits = np.where(sources, 1 << random.integers(0, labels, shape), 0).astype(dtype)
    return bits, random.random(shape) > walls


def grown(bits, free, steps=STEPS, octagon=False):
    diagram = expand(jnp.asarray(bits), jnp.asarray(free), steps=steps, octagon=octagon)
    return jax.tree.map(np.asarray, diagram)


def permuted(bits, order):
    """The same sets with label k renamed order[k]."""
    parts = [((bits >> k) & 1) << order[k] for k in range(len(order))]
    return np.bitwise_or.reduce(parts).astype(bits.dtype)


def cells_of(rows, width):
    """Table of a figure as (text of) cells, its lower half mirrored from the upper."""
    rows = [[row[6 * k : 6 * k + 6].strip() for k in range(width)] for row in rows]
    return rows + rows[-2::-1]


def printed(diagram):
    """What the figure prints of each cell: arrival and label, or nothing."""
    rows = zip(diagram.arrival.tolist(), diagram.labels.tolist(), strict=True)
    return [
        [f"{t},{v}" if reference.bits(v) == 1 else "" for t, v in zip(*row, strict=True)]
        for row in rows
    ]


def test_one_source_grows_as_figure_2a():
    bits = np.zeros((5, 5), np.uint8)
    bits[2, 2] = 1
    assert printed(grown(bits, bits == 0, steps=3)) == cells_of(ONE, 5)


def test_two_sources_meet_as_in_figure_2b():
    bits = np.zeros((5, 9), np.uint8)
    bits[2, 2], bits[2, 6] = 1, 2
    diagram = grown(bits, bits == 0, steps=3)
    assert printed(diagram) == cells_of(TWO, 9)
    np.testing.assert_array_equal(diagram.labels[:, 4], [0, 3, 3, 3, 0])
    np.testing.assert_array_equal(diagram.arrival[:, 4], [-1, 3, 2, 3, -1])
    later = grown(bits, bits == 0, steps=4)
    np.testing.assert_array_equal(later.labels[:, 4], 3)
    np.testing.assert_array_equal(later.arrival[:, 4], [4, 3, 2, 3, 4])
    np.testing.assert_array_equal(
        branch_cells(later, bits != 0), np.arange(9) == np.full((5, 1), 4)
    )


@pytest.mark.parametrize("steps", [0, 1, 5, STEPS])
@pytest.mark.parametrize("seed", SEEDS)
def test_expand_agrees_with_breadth_first_search(seed, steps):
    bits, free = random_grid(seed)
    diagram = grown(bits, free, steps)
    labels, arrival = reference.expand(bits, free, steps)
    np.testing.assert_array_equal(diagram.labels, labels)
    np.testing.assert_array_equal(diagram.arrival, arrival)
    assert reference.bits(diagram.labels.max()) > 1 or steps < 5  # fronts did meet


@pytest.mark.parametrize("dtype, labels", [(np.uint8, 8), (np.uint16, 16), (np.uint32, 32)])
def test_every_label_that_fits_expands(dtype, labels):
    bits, free = random_grid(7, dtype=dtype, shape=(30, 30))
    bits[bits != 0] = 2 ** (np.arange(np.count_nonzero(bits)) % labels)
    diagram = grown(bits, free)
    assert diagram.labels.dtype == dtype
    assert np.bitwise_or.reduce(diagram.labels, axis=None) == 2**labels - 1
    np.testing.assert_array_equal(diagram.labels, reference.expand(bits, free, STEPS)[0])


def test_sources_of_two_labels_pass_nothing_on():
    bits = np.zeros((3, 7), np.uint8)
    bits[1, 3] = 5
    diagram = grown(bits, bits == 0)
    np.testing.assert_array_equal(diagram.labels, bits)
    np.testing.assert_array_equal(diagram.arrival, np.where(bits != 0, 0, -1))


@pytest.mark.parametrize("seed", SEEDS)
def test_arrival_is_the_manhattan_distance_to_the_nearest_source(seed):
    bits, _ = random_grid(seed)
    arrival = grown(bits, np.ones(bits.shape, bool)).arrival
    distance = distance_transform_cdt(bits == 0, metric="taxicab")
    reached = arrival >= 0
    np.testing.assert_array_equal(arrival[reached], distance[reached])
    assert reached.mean() > 0.9


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("turn", [np.rot90, np.flipud, np.fliplr, np.transpose])
def test_expand_turns_and_mirrors_with_the_grid(turn, seed):
    bits, free = random_grid(seed)
    before, after = grown(bits, free), grown(turn(bits), turn(free))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, turn(b)), after, before)
    found = junction_cells(before, bits != 0)
    np.testing.assert_array_equal(junction_cells(after, turn(bits) != 0), turn(found))


@pytest.mark.parametrize("seed", SEEDS)
def test_names_of_the_labels_do_not_matter(seed):
    bits, free = random_grid(seed)
    order = np.random.default_rng(seed + 100).permutation(5)
    before, after = grown(bits, free), grown(permuted(bits, order), free)
    np.testing.assert_array_equal(after.labels, permuted(before.labels, order))
    np.testing.assert_array_equal(after.arrival, before.arrival)
    found = junction_cells(before, bits != 0)
    np.testing.assert_array_equal(junction_cells(after, bits != 0), found)
    assert found.any()


@pytest.mark.parametrize("seed", SEEDS)
def test_cells_that_are_not_free_never_change_and_padding_is_invisible(seed):
    bits, free = random_grid(seed)
    diagram = grown(bits, free)
    barred = ~free & (bits == 0)
    assert not diagram.labels[barred].any() and (diagram.arrival[barred] == -1).all()
    padded = grown(np.pad(bits, 3), np.pad(free, 3))
    inner = jax.tree.map(lambda x: x[3:-3, 3:-3], padded)
    jax.tree.map(np.testing.assert_array_equal, inner, diagram)
    assert padded.labels.astype(bool).sum() == diagram.labels.astype(bool).sum()


@pytest.mark.parametrize("seed", SEEDS)
def test_branches_separate_every_two_regions(seed):
    bits, free = random_grid(seed)
    diagram, sources = grown(bits, free), bits != 0
    branch = np.asarray(branch_cells(diagram, sources))
    assert not reference.unseparated(diagram.labels, branch, sources)
    assert reference.unseparated(diagram.labels, np.zeros_like(branch), sources)  # they do meet
    assert not branch[sources | (diagram.labels == 0)].any()


def test_an_even_meet_is_marked_on_one_side_only():
    bits = np.zeros((1, 6), np.uint8)
    bits[0, 0], bits[0, 5] = 2, 1
    diagram = grown(bits, bits == 0)
    np.testing.assert_array_equal(diagram.labels, [[2, 2, 2, 1, 1, 1]])
    np.testing.assert_array_equal(branch_cells(diagram, bits != 0), [[0, 0, 0, 1, 0, 0]])


@pytest.mark.parametrize("seed", SEEDS)
def test_junctions_are_where_three_labels_are_near(seed):
    bits, free = random_grid(seed)
    diagram = grown(bits, free)
    expected = reference.junctions(diagram.labels, bits != 0)
    np.testing.assert_array_equal(junction_cells(diagram, bits != 0), expected)
    assert 0 < expected.sum() < expected.size / 2


def test_expand_batches():
    bits, free = (np.stack(x) for x in zip(*map(random_grid, SEEDS), strict=True))
    together = jax.jit(jax.vmap(lambda b, o: expand(b, o, steps=STEPS)))(bits, free)
    for k in SEEDS:
        alone = grown(bits[k], free[k])
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k], b), together, alone)


def test_expand_batches_in_two_levels_with_free_cells_in_common():
    bits = np.stack([random_grid(seed)[0] for seed in SEEDS])
    free = random_grid(0)[1]
    of_row = jax.vmap(lambda own: expand(own, free, steps=STEPS))
    together = jax.jit(jax.vmap(of_row))(bits.reshape(2, 2, *free.shape))
    for k in SEEDS:
        alone = grown(bits[k], free)
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_array_equal(np.asarray(a).reshape(4, *free.shape)[k], b)


@pytest.mark.parametrize("steps", [7, 8, 254, 255, 256, 299, 400])
def test_a_front_may_take_hundreds_of_steps(steps):
    bits = np.zeros((1, 300), np.uint8)
    bits[0, 0] = 128
    diagram = grown(bits, bits == 0, steps=steps)
    cell = np.arange(300)
    np.testing.assert_array_equal(diagram.arrival[0], np.where(cell <= steps, cell, -1))
    np.testing.assert_array_equal(diagram.labels[0], np.where(cell <= steps, 128, 0))


def test_a_cell_that_cannot_be_reached_stays_empty():
    bits = np.zeros((7, 7), np.uint8)
    bits[0, 0], bits[6, 6] = 1, 2
    free = np.ones((7, 7), bool)
    free[2:5, 2:5] = False
    free[3, 3] = True  # walled in
    diagram = grown(bits, free)
    assert diagram.labels[3, 3] == 0 and diagram.arrival[3, 3] == -1
    np.testing.assert_array_equal(diagram.labels, reference.expand(bits, free, STEPS)[0])


def test_a_derivative_ignores_the_automaton():
    bits, free = map(jnp.asarray, random_grid(0))

    def length(x):
        labels = jnp.where(x > 0.0, bits, jnp.zeros_like(bits))
        return x**2 + jnp.sum(expand(labels, free, steps=STEPS).arrival).astype(x.dtype)

    def looped(x):
        return jax.lax.scan(lambda s, _: (jax.checkpoint(length)(s), None), x, length=1)[0]

    for function in (length, looped, jax.jit(looped)):
        assert jax.grad(function)(3.0) == 6.0


@pytest.mark.parametrize("steps", [1, 2, 9, STEPS])
@pytest.mark.parametrize("seed", SEEDS)
def test_octagons_agree_with_a_slow_automaton(seed, steps):
    bits, free = random_grid(seed, walls=0.35)
    diagram = grown(bits, free, steps, octagon=True)
    labels, arrival = reference.expand_octagons(bits, free, steps)
    np.testing.assert_array_equal(diagram.labels, labels)
    np.testing.assert_array_equal(diagram.arrival, arrival)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("quarters", range(4))
def test_octagons_turn_and_mirror_with_the_grid(quarters, mirror, seed):

    def turn(x):
        return np.rot90(np.fliplr(x) if mirror else x, quarters)

    bits, free = random_grid(seed)
    before = grown(bits, free, octagon=True)
    after = grown(turn(bits), turn(free), octagon=True)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, turn(b)), after, before)


@pytest.mark.parametrize("steps", [6, 9])
def test_one_source_grows_as_an_octagon(steps):
    """Of n steps, n // 2 go across: |x|, |y| <= n and |x| + |y| <= n + n // 2."""
    bits = np.zeros((25, 25), np.uint8)
    bits[12, 12] = 1
    row, column = np.abs(np.indices(bits.shape) - 12)
    inside = (np.maximum(row, column) <= steps) & (row + column <= steps + steps // 2)
    reached = grown(bits, bits == 0, steps, octagon=True).labels != 0
    np.testing.assert_array_equal(reached, inside)


def encoded_sources(bits, free):
    """The encoded sources, cell by cell."""
    start = np.full(bits.shape, FROZEN, np.int8)
    start[free & (bits == 0)] = EMPTY
    for cell in np.argwhere(bits):
        if reference.bits(int(bits[tuple(cell)])) == 1:
            start[tuple(cell)] = int(bits[tuple(cell)]).bit_length() - 1
    return start


@jax.jit
def expand_both(start, bits):
    """Encoded diagrams of diamonds and octagons, and the diagrams."""
    both = [expand_encoded(start, steps=9, octagon=octagon) for octagon in (False, True)]
    return both, [decode(bits, x, octagon=k == 1) for k, x in enumerate(both)]


@pytest.mark.parametrize("seed", SEEDS)
def test_encoded_labels_expand_as_sets_do(seed):
    bits, free = random_grid(seed, labels=32, dtype=np.uint32)
    bits[3, 4] = bits[15, 20] = 3 << seed  # sources of two labels
    start = encoded_sources(bits, free)
    np.testing.assert_array_equal(encode_sources(jnp.asarray(bits), jnp.asarray(free)), start)
    slow = reference.expand(bits, free, 9), reference.expand_octagons(bits, free, 9)
    for encoded, diagram, (labels, arrival) in zip(*expand_both(start, bits), slow, strict=True):
        np.testing.assert_array_equal(diagram.labels, labels)
        np.testing.assert_array_equal(diagram.arrival, arrival)
        alone = np.vectorize(reference.bits)(labels) == 1
        np.testing.assert_array_equal(np.asarray(encoded.cells) >= 0, alone)
        np.testing.assert_array_equal(encoded.cells[alone], np.log2(labels[alone]))


@pytest.mark.parametrize("seed", SEEDS)
def test_encoded_junctions_are_where_three_labels_are_near(seed):
    bits, free = random_grid(seed, labels=32, dtype=np.uint32)
    sources = bits != 0
    encoded = expand_both(encoded_sources(bits, free), bits)[0][seed % 2]
    cells, expected = np.asarray(encoded.cells), np.zeros(bits.shape, bool)
    for cell in np.ndindex(*bits.shape):
        block = [near for near in reference.block(cell, bits.shape) if not sources[near]]
        held = {int(cells[near]) for near in block if cells[near] >= 0}
        expected[cell] = len(held) >= 3 and not sources[cell] and cells[cell] != EMPTY
    np.testing.assert_array_equal(encoded_junction_cells(encoded, jnp.asarray(sources)), expected)
    assert 5 < expected.sum() < expected.size / 2


CELLS, MASK = jnp.zeros((4, 5), jnp.uint8), jnp.zeros((4, 5), bool)
BYTES = jnp.zeros((4, 5), jnp.int8)
GOOD = Diagram(labels=CELLS, arrival=jnp.zeros((4, 5), jnp.int32))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: expand(CELLS.astype(int), MASK, steps=1), "labels is int64 (4, 5), not unsigned"),
        (
            lambda: expand(CELLS[0], MASK, steps=1),
            "labels is uint8 (5,), not unsignedinteger (H, W)",
        ),
        (lambda: expand(CELLS, MASK[1:], steps=1), "free is bool (3, 5), not bool (4, 5)"),
        (lambda: expand(CELLS, CELLS, steps=1), "free is uint8 (4, 5), not bool (4, 5)"),
        (lambda: expand(CELLS, MASK, steps=-1), "steps is -1, not 0 or more"),
        (lambda: expand_encoded(MASK, steps=1), "start is bool (4, 5), not int8 (H, W)"),
        (lambda: expand_encoded(BYTES[0], steps=1), "start is int8 (5,), not int8 (H, W)"),
        (lambda: expand_encoded(BYTES, steps=-2), "steps is -2, not 0 or more"),
        (lambda: branch_cells(GOOD, MASK[:, 1:]), "sources is bool (4, 4), not bool (4, 5)"),
        (lambda: junction_cells(GOOD, CELLS), "sources is uint8 (4, 5), not bool (4, 5)"),
        (lambda: junction_cells(Diagram(MASK, MASK), MASK), "diagram.labels is bool (4, 5), not"),
    ],
)
def test_wrong_shapes_and_types_are_named_while_tracing(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        jax.eval_shape(call)
