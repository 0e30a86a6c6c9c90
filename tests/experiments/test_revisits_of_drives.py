import json

import numpy as np

from experiments import damaged_drives, revisits
from jaxslam.matching.revisits import Revisits


def test_pairs_are_counted_by_the_true_poses(monkeypatch):
    drive = damaged_drives.simulate(3)
    seen = {}

    def find(spec, scan_map):
        seen["poses"] = scan_map.poses
        first, second = np.array([0, 1, 2]), np.array([9, 10, 11])
        between = revisits.relative(scan_map.poses[first], scan_map.poses[second])
        between[2, 0] += 0.6
        return Revisits(first, second, between, np.array([0, 0, 1]))

    monkeypatch.setattr(revisits, "find_revisits", find)
    case = revisits.examine(drive, damaged_drives.unhurt, np.random.default_rng(0))
    assert (case["right"], case["wrong"], case["wrong_sets"], case["error_m"]) == (2, 1, 1, 0.0)
    steps = np.hypot(*np.diff(seen["poses"][:, :2], axis=0).T)
    assert len(seen["poses"]) <= len(drive.poses) and np.median(steps) > 0.2


def test_sums_are_those_of_the_cases():
    cases = [
        {"drive": "a", "damage": "x", "right": 3, "wrong": 0, "wrong_sets": 0},
        {"drive": "a", "damage": "y", "right": 0, "wrong": 2, "wrong_sets": 1},
        {"drive": "b", "damage": "x", "right": 0, "wrong": 0, "wrong_sets": 0},
    ]
    row = revisits.total(cases, drive="a")
    assert (row["cases"], row["found"], row["right"], row["wrong"]) == (2, 2, 3, 2)
    assert revisits.total(cases, damage="x")["found"] == 1


def test_the_experiment_writes_what_it_counts(tmp_path, monkeypatch):
    none = revisits.total([], drive="")
    monkeypatch.setattr(revisits, "examine", lambda *_: none | {"damage": "unhurt"})
    assert revisits.main(["--out", str(tmp_path), "--seed", "5", "--drives", "2"]) == 0
    numbers = json.loads((tmp_path / "revisits.json").read_text())
    assert len(numbers["cases"]) == 2 and (tmp_path / "revisits.png").is_file()
