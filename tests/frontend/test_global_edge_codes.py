import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.frontend import global_edge_codes as global_codes
from jaxslam.frontend import tiled_automaton, voronoi

branch_cells, global_edge_code_bits, global_edge_codes = map(
    jax.jit,
    (voronoi.branch_cells, global_codes.global_edge_code_bits, global_codes.global_edge_codes),
)


def codes(occupied):
    return np.asarray(global_edge_codes(jnp.asarray(occupied, bool)))


def clutter(seed):
    return np.random.default_rng(seed).random((40, 33)) < 0.5


def test_a_block_has_four_faces_and_four_corners():
    occupied = np.zeros((6, 7), bool)
    occupied[1:5, 1:6] = True
    expected = np.zeros((6, 7), int)
    expected[1, 2:5], expected[4, 2:5] = 3, 1  # open to the row before, to the next
    expected[2:4, 1], expected[2:4, 5] = 4, 2
    expected[1, 1], expected[1, 5], expected[4, 1], expected[4, 5] = 7, 6, 8, 5
    np.testing.assert_array_equal(codes(occupied), expected)


def test_a_line_and_its_ends_have_a_code_for_each_axis():
    occupied = np.zeros((7, 7), bool)
    occupied[1, 1:6] = occupied[3:6, 3] = True
    found = codes(occupied)
    np.testing.assert_array_equal(found[1, 1:6], [12, 10, 10, 10, 12])
    np.testing.assert_array_equal(found[3:6, 3], [11, 9, 11])


def test_neither_noise_nor_the_inside_is_a_source():
    occupied = np.zeros((9, 9), bool)
    occupied[1, 1] = True
    occupied[3:8, 3:8] = True
    found = codes(occupied)
    assert found[1, 1] == 0 and not found[4:7, 4:7].any()
    assert not found[~occupied].any() and not np.asarray(global_edge_code_bits(found))[1, 1]


@pytest.mark.parametrize("turn", [np.rot90, np.flipud, np.fliplr, np.transpose])
def test_turning_the_map_permutes_the_codes(turn):
    names = np.zeros(13, int)
    before, after = turn(codes(clutter(0))), codes(turn(clutter(0)))
    names[before.ravel()] = after.ravel()
    assert sorted(names.tolist()) == list(range(13)) and names[0] == 0
    for seed in range(4):
        expected = names[turn(codes(clutter(seed)))]
        np.testing.assert_array_equal(codes(turn(clutter(seed))), expected)
    assert (names[1:] != np.arange(1, 13)).any()


def test_each_of_the_twelve_codes_has_a_bit_of_its_own():
    bits = np.asarray(global_edge_code_bits(jnp.arange(13, dtype=jnp.uint8)))
    np.testing.assert_array_equal(bits, [0, *(1 << np.arange(12))])
    assert bits.dtype == np.uint16
    assert set(codes(clutter(1)).ravel().tolist()) == set(range(13))


def test_the_automaton_draws_the_middle_line_of_a_corridor():
    occupied = np.zeros((15, 40), bool)
    occupied[:2] = occupied[-2:] = True
    bits = np.array(global_edge_code_bits(global_edge_codes(jnp.asarray(occupied))))
    bits[0] = bits[-1] = 0  # beyond the map there is nothing to face
    diagram = tiled_automaton.expand_tiled(bits, ~occupied)
    found = np.asarray(branch_cells(diagram, jnp.asarray(bits != 0)))[:, 4:-4]
    np.testing.assert_array_equal(np.flatnonzero(found.all(axis=1)), [7])
    assert not np.delete(found, 7, axis=0).any()
