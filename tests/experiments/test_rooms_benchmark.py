import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments import rooms_benchmark

ROOMS = Path(__file__).resolve().parents[3] / "shared" / "data" / "rooms"


def rooms_and_label():
    truth = np.zeros((40, 60), int)
    truth[5:35, 5:25], truth[5:35, 30:55] = 1, 2
    return truth, np.where(truth > 0, 3 - truth, 0)


def test_scores_of_a_division():
    truth, label = rooms_and_label()
    assert rooms_benchmark.compare(truth, label) == (1.0, 1.0, 1.0)
    recall, precision, mcc = rooms_benchmark.compare(truth, (label > 0).astype(int))
    assert recall == 1.0 and precision == pytest.approx(0.5) and mcc == 0.0
    half = np.where(np.arange(60) < 15, 0, label)
    recall, precision, mcc = rooms_benchmark.compare(truth, half)
    assert recall == pytest.approx(0.75) and precision == 1.0 and 0.0 < mcc < 1.0
    assert rooms_benchmark.compare(truth, 0 * label) == (0.0, 0.0, 0.0)


@pytest.fixture
def plan_folder(tmp_path):
    """A plan of two rooms and a door, and its rooms."""
    free = np.zeros((100, 220), bool)
    free[5:85, 5:105] = free[5:85, 110:210] = free[30:50, 105:110] = True
    rooms = free.copy()
    rooms[:, 105:110] = False
    for name, white in (("a.png", free), ("a.furnished.png", free), ("a.rooms.png", rooms)):
        Image.fromarray(np.where(white, 255, 0).astype(np.uint8)).save(tmp_path / name)
    return tmp_path


def test_the_benchmark_writes_its_figures(plan_folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert rooms_benchmark.main(["--rooms", str(plan_folder), "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == {"rooms_benchmark.json", "rooms_benchmark.png"}
    numbers = json.loads((out / "rooms_benchmark.json").read_text())
    assert numbers["plans"]["a"]["empty"]["mcc"] > 0.99
    assert "MAORIS" in capsys.readouterr().out
    assert rooms_benchmark.main(["--rooms", str(out), "--out", str(out)]) == 2


@pytest.mark.parametrize("ending, least", [(".png", 0.95), (".furnished.png", 0.925)])
def test_rooms_of_recorded_plans_are_those_of_a_person(ending, least):
    if not ROOMS.is_dir():
        pytest.skip("no plans of rooms in ../shared/data/rooms beside the repository")
    scores = [
        rooms_benchmark.score_plan(ROOMS / f"{name}{ending}", ROOMS / f"{name}.rooms.png")
        for name in rooms_benchmark.plans(ROOMS)
    ]
    recall, precision, mcc = np.mean(scores, axis=0)
    assert mcc >= least and recall >= 0.94 and precision >= 0.955
