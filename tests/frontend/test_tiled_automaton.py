import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.frontend import automaton, tiled_automaton

FAR = 400  # more steps than any front needs on the grids below


def scene(seed, shape, dtype=np.uint16, sources=0.01, walls=0.2):
    """Sources of a few labels, some of two, and closed cells, strewn over a grid."""
    random = np.random.default_rng(seed)
    bits = (1 << random.integers(0, 6, shape)) | (1 << random.integers(0, 6, shape))
    bits = np.where(random.random(shape) < 0.8, bits & -bits, bits)
    bits = np.where(random.random(shape) < sources, bits, 0).astype(dtype)
    return bits, random.random(shape) > walls


def serpentine(size, pitch):
    """A grid that is one long corridor, with a source of its own at either end."""
    open = np.zeros((size, size), bool)
    open[1:-1, 1:-1] = True
    for k, i in enumerate(range(pitch, size - 1, pitch)):
        open[i, 1:-1] = False
        open[i, 1 if k % 2 else -2] = True
    bits = np.zeros((size, size), np.uint8)
    bits[1, 1], bits[-2, -2] = 1, 2
    return bits, open


def check(bits, open, steps, **sizes):
    """The same cell for cell, in tiles and at once."""
    found = tiled_automaton.expand_tiled(bits, open, steps=steps, **sizes)
    whole = FAR if steps is None else steps
    expected = automaton.expand(jnp.asarray(bits), jnp.asarray(open), steps=whole)
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
    bits, open = np.zeros((2, 160, 160), np.uint8)
    bits[20, 20], open[16:32, :] = 1, 1
    worked, plain = [], tiled_automaton._advance

    def counted(cells, may, active, tile, halo):
        worked.append(len(active))
        return plain(cells, may, active, tile, halo)

    monkeypatch.setattr(tiled_automaton, "_advance", counted)
    check(bits, open.astype(bool), None, tile=16, halo=16)
    assert worked[0] == 10 and max(worked[1:]) <= 4  # the open row of tiles, then its front
    assert len(worked) < 12


@pytest.mark.parametrize(
    "change",
    [{"open": np.ones((3, 4), bool)}, {"tile": 4, "halo": 5}, {"halo": 0}, {"steps": -1}],
)
def test_bad_arguments_are_refused(change):
    given = {"labels": np.zeros((3, 3), np.uint8), "open": np.ones((3, 3), bool)} | change
    with pytest.raises(ValueError):
        tiled_automaton.expand_tiled(**given)
