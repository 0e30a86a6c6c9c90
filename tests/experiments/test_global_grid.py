import json

import numpy as np
import pytest

from experiments import baselines, global_grid, ground_truth
from jaxslam.simulation import worlds

ROOM = worlds.outline([(0.0, 0.0, 4.0, 2.0)])  # its junctions are (1, 1) and (3, 1)
ROW = {
    "position_rmse_m": 0.5,
    "heading_rmse_deg": 1.0,
    "nees": 1.0,
    "diverged": 0,
    "runs": 2,
}


def test_walls_are_two_cells_thick_and_the_outside_is_occupied():
    grid = global_grid.rasterise(ROOM, np.array([1.0, 1.0]), 0.1)
    cells = np.argwhere(grid.free)
    assert len(cells) == 38 * 18
    np.testing.assert_allclose(grid.centres(cells).min(axis=0), [0.15, 0.15])
    np.testing.assert_allclose(grid.centres(cells).max(axis=0), [3.85, 1.85])


def test_what_cannot_be_reached_is_occupied():
    walls = np.vstack([ROOM, worlds.outline([(1.0, 0.5, 2.0, 1.5)])])
    grid = global_grid.rasterise(walls, np.array([0.5, 0.5]), 0.1)
    assert grid.free.sum() == 38 * 18 - 12 * 12
    with pytest.raises(ValueError, match="on a wall"):
        global_grid.rasterise(walls, np.array([1.0, 1.0]) * [1.0, 0.5], 0.1)


def test_the_automaton_on_the_grid_of_a_room_finds_its_junctions():
    grid = global_grid.rasterise(ROOM, np.array([1.0, 1.0]), 0.1)
    found = global_grid.junctions_of(grid, global_grid.global_diagram(grid.free))
    true = ground_truth.junctions(ROOM, ground_truth.FreeSpace(ROOM)).xy
    assert global_grid.agreement(found, true) == {
        "junctions": 2,
        "junctions_correct": 2,
        "true_junctions": 2,
        "true_junctions_found": 2,
    }
    np.testing.assert_allclose(found[np.argsort(found[:, 0])], [[1.0, 1.0], [3.0, 1.0]], atol=0.1)


def test_agreement_counts_both_sides():
    found = np.array([[0.0, 0.0], [0.1, 0.1], [5.0, 5.0]])
    true = np.array([[0.05, 0.0], [2.0, 2.0]])
    counts = global_grid.agreement(found, true)
    assert counts["junctions_correct"] == 2 and counts["true_junctions_found"] == 1


def test_the_table_of_baselines_has_a_row_of_the_global_grid(tmp_path, monkeypatch, capsys):
    found = ROW | {"dead_reckoning": {k: ROW[k] for k in baselines.KEYS[:2]} | {"diverged": 1}}
    grid = dict.fromkeys(baselines.KEYS) | {"name": global_grid.NAME, "cells": [3, 4]}
    grid |= {"seconds_per_grid": 0.25, "seconds_of_local_diagrams": 0.5, "scans": 7}
    grid |= {"junctions": 4, "junctions_correct": 3, "true_junctions": 5}
    grid |= {"true_junctions_found": 2}
    monkeypatch.setattr(baselines.common, "filter_trials", lambda *_: None)
    monkeypatch.setattr(baselines.summary, "evaluate", lambda _: found)
    monkeypatch.setattr(global_grid, "compute", lambda seed: grid)
    baselines.main(["--out", str(tmp_path), "--runs", "2"])
    rows = json.loads((tmp_path / "baselines.json").read_text())["rows"]
    names = ["dead_reckoning", "nodes_codes", "nodes_runs", "all", "global_automaton"]
    assert [row["name"] for row in rows] == names
    assert all(set(row) == {"name", *baselines.KEYS} for row in rows[:-1])
    assert rows[-1]["position_rmse_m"] is None and rows[-1]["seconds_per_grid"] == 0.25
    assert (tmp_path / "baselines.png").stat().st_size > 5000
    printed = capsys.readouterr().out
    assert "250 ms per grid" in printed and "2 of 5 junctions found; 3 of its 4 correct" in printed
