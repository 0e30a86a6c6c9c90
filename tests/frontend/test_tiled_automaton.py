import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.frontend import automaton, tiled_automaton

MANY = 400  # more steps than any front needs on the grids below


def scene(seed, shape, dtype=np.uint16, sources=0.01, walls=0.2):
    """Random sources of a few labels, some of two, and free cells."""
    random = np.random.default_rng(seed)
    bits = (1 << random.integers(0, 6, shape)) | (1 << random.integers(0, 6, shape))
    bits = np.where(random.random(shape) < 0.8, bits & -bits, bits)
    bits = np.where(random.random(shape) < sources, bits, 0).astype(dtype)
    return bits, random.random(shape) > walls


def serpentine(size, pitch):
    """A grid that is one long corridor, with a source of its own at either end."""
    free = np.zeros((size, size), bool)
    free[1:-1, 1:-1] = True
    for k, i in enumerate(range(pitch, size - 1, pitch)):
        free[i, 1:-1] = False
        free[i, 1 if k % 2 else -2] = True
    bits = np.zeros((size, size), np.uint8)
    bits[1, 1], bits[-2, -2] = 1, 2
    return bits, free


def check(bits, free, steps, **sizes):
    """The same cell for cell, in tiles and at once."""
    found = tiled_automaton.expand_tiled(bits, free, steps=steps, **sizes)
    num_steps = MANY if steps is None else steps
    expected = automaton.expand(jnp.asarray(bits), jnp.asarray(free), steps=num_steps)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert found.labels.dtype == bits.dtype and found.arrival.dtype == np.int32
    return expected


@pytest.mark.parametrize("steps", [None, 0, 1, 8, 13])
@pytest.mark.parametrize("shape", [(37, 53), (48, 48), (5, 90)])
def test_tiles_equal_the_whole(shape, steps):
    for seed in range(3):
        check(*scene(seed, shape), steps, tile=16, halo=8)


@pytest.mark.parametrize("tile, halo", [(7, 1), (16, 16), (64, 16)])
def test_size_of_tiles_and_halo_does_not_matter(tile, halo):
    check(*scene(5, (45, 71), np.uint8), None, tile=tile, halo=halo)


def test_a_front_that_crosses_tiles_many_times_arrives_on_time():
    diagram = check(*serpentine(41, 4), None, tile=16, halo=8)
    assert diagram.arrival.max() > 150


def test_tiles_of_several_batches_all_advance():
    check(*scene(1, (75, 90), np.uint32, sources=0.002), None, tile=16, halo=16)


def test_only_tiles_that_may_change_are_worked_on(monkeypatch):
    bits, free = np.zeros((2, 160, 160), np.uint8)
    bits[20, 20], free[16:32, :] = 1, 1
    worked, plain = [], tiled_automaton._advance

    def counted(cells, is_free, active, tile, halo):
        worked.append(len(active))
        return plain(cells, is_free, active, tile, halo)

    monkeypatch.setattr(tiled_automaton, "_advance", counted)
    check(bits, free.astype(bool), None, tile=16, halo=16)
    assert worked[0] == 10 and max(worked[1:]) <= 4  # the free row of tiles, then its front
    assert len(worked) < 12


LABELS, FREE = np.zeros((3, 3), np.uint8), np.ones((3, 3), bool)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: tiled_automaton.expand_tiled(LABELS, FREE[1:]), "free is bool (2, 3), not bool"),
        (lambda: tiled_automaton.expand_tiled(LABELS, LABELS), "free is uint8 (3, 3), not bool"),
        (lambda: tiled_automaton.expand_tiled(FREE, FREE), "labels is bool (3, 3), not unsigned"),
        (lambda: tiled_automaton.expand_tiled(LABELS, FREE, tile=4, halo=5), "halo 5 is not"),
        (lambda: tiled_automaton.expand_tiled(LABELS, FREE, halo=0), "halo 0 is not between 1"),
        (lambda: tiled_automaton.expand_tiled(LABELS, FREE, steps=-1), "steps is -1, not 0 or"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()
