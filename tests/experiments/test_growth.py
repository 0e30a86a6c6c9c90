"""The town of corridors, its submaps, and the figures of `growth` in small."""

import json

import numpy as np
import pytest

from experiments import growth, town
from jaxslam.core import se2_np


def test_exponents_are_slopes_of_the_largest():
    x = [1, 2, 4, 8, 16]
    assert growth.exponent(x, [100.0, 100.0, 16.0, 64.0, 256.0]) == pytest.approx(2.0)
    assert growth.exponent([3], [1.0]) is None


def test_a_town_is_driven_as_its_poses_say_and_its_corners_are_seen_as_they_are():
    where = town.make(1, 300, 0)
    assert where.truth.shape == (300, 3)
    gap = np.linalg.norm(np.diff(where.truth[:, :2], axis=0), axis=1)
    assert gap.min() > 0.2 and gap.max() < 0.3
    features, seen = where.measurements.features, where.corner >= 0
    exact = se2_np.inverse_transform(where.truth[:, None], where.corners[where.corner])
    error = (features.xy - exact)[seen]
    assert np.abs(error.mean()) < 0.002 and 0.01 < error.std() < 0.03
    increments = where.measurements.odometry - se2_np.increments(where.truth)
    assert 0.008 < increments[1:, 0].std() < 0.012  # 0.02 m / sqrt(m) over 0.25 m


def test_what_was_stopped_goes_on_and_ends_in_the_same_figures(tmp_path, monkeypatch):
    """Each figure is drawn anew where it is computed, so none may be computed twice."""

    def figures(stop_at, folder, counts):
        cache = growth.common.ResultCache(folder, 0)

        def town_of(*_):
            counts.append("town")
            return {"seconds_exponent": len(counts), "memory_exponent": 1.0, "progress": []}

        def run(task, _, arguments, *, module):
            if len(counts) == stop_at:
                raise KeyboardInterrupt
            counts.append((task, *arguments.values()))
            number = 1.5 * len(counts)
            one = {"landmark_rmse_m": number, "landmarks": 3}
            return {
                **dict.fromkeys(("landmarks", "scans", "trials"), number),
                **dict.fromkeys(("ms_per_scan", "covariance_mb", "seconds"), number**2),
                **({"one_map": one, "submaps": one} if task == "accuracy" else {}),
            }

        monkeypatch.setattr(growth, "in_town", town_of)
        return growth.compute(0, largest=128, num_drives=3, run=run, keep=cache)

    counts: list = []
    for stop_at in (1, 3, 9, 13):
        with pytest.raises(KeyboardInterrupt):
            figures(stop_at, tmp_path / "parts", counts)
        assert len(counts) == stop_at
    resumed, whole = figures(-1, tmp_path / "parts", counts), figures(-1, tmp_path / "own", [])
    assert json.dumps(resumed) == json.dumps(whole)
    assert len(counts) == len(set(counts)) == 1 + 4 + 4 + 3 + 3


@pytest.mark.slow
def test_figures_of_a_small_town(tmp_path, monkeypatch):
    """No corner is taken for another, and submaps do not cost more than their bound."""

    def here(task, cache, arguments, *, module):
        return growth.TASKS[task](**arguments)

    monkeypatch.setattr(growth, "SMALL_TOWN", (1, 400))
    monkeypatch.setattr(growth, "SCAN_COUNTS", (40,))
    monkeypatch.setattr(growth, "TRIAL_COUNTS", (2,))
    monkeypatch.setattr(growth, "SCANS", 40)
    found = growth.compute(0, blocks=1, num_scans=400, largest=64, num_drives=1, run=here)
    of_town, cost = found["town"], found["cost"]
    assert of_town["wrong_matches"] == 0 and of_town["duplicates"] <= 2
    assert 0.6 < of_town["cost_per_dof"] < 1.5
    assert cost["submaps"]["landmark_rmse_m"] < 2.0 * cost["one_map"]["landmark_rmse_m"] + 0.02
    assert of_town["pose_rmse_m"] < of_town["online_max_m"]
    growth.common.save(tmp_path, growth.NAME, found, growth.draw)
    assert json.loads((tmp_path / "growth.json").read_text())["town"]["scans"] == 400
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")
