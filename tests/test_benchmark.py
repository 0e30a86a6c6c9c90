import jax
import numpy as np
import pytest

from experiments import benchmark, peers
from jaxslam.voronoi import expand


def test_without_the_c_program_its_figures_are_null_and_a_note_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "YARDSTICK", tmp_path / "none.c")
    monkeypatch.setattr(peers, "SIZE", 16)
    numbers = peers.automaton(maps=2, repeats=1)
    assert numbers["automaton_vs_c"] is None and numbers["automaton_batch_vs_c"] is None
    assert numbers["ms_per_map"]["c"] is None and numbers["ms_per_map"]["batch"] > 0
    assert "none.c" in numbers["note"]


def test_what_does_not_compile_is_told(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "bad.c").write_text("this is no C")
    rival = peers.compiled(tmp_path / "in" / "bad.c", tmp_path)
    assert rival.program is None and "not compared" in rival.note


@pytest.mark.parametrize("maps, moves", [(peers.scattered, False), (peers.distant, True)])
def test_fronts_of_the_maps_settle_early_or_never(maps, moves):
    labels = maps(1)[0]
    assert 2 <= np.count_nonzero(labels) <= 200
    last = np.asarray(expand(labels, labels == 0, steps=peers.STEPS).arrival).max()
    assert (last == peers.STEPS) is np.bool_(moves) or last < peers.STEPS // 2


def test_the_stages_are_those_of_the_front_end():
    config = benchmark.slam.Config()
    scans = benchmark.Scan(jax.numpy.full((2, 361), 3.0), jax.numpy.ones((2, 361), bool))
    calls = benchmark.stages(config, scans)
    (start,) = calls["automaton"][1:]
    assert start.shape == (2, *config.grid.shape)
