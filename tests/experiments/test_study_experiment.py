"""The study of scanners, buildings and people: its variants, and its figure, without trials."""

import json

import numpy as np
import pytest

from experiments import study
from jaxslam.simulation import named_worlds
from jaxslam.study import runner
from jaxslam.study.kept_trials import Collected
from jaxslam.study.outcomes import Outcomes

N = 12


@pytest.fixture
def variants(monkeypatch):
    """The variants, whose buildings are all the random one."""
    world, path = named_worlds.named("random:7"), named_worlds.named_path("random:7")
    monkeypatch.setattr(study, "building_of", lambda *_: (world, np.asarray(path)))
    monkeypatch.setattr(study.drives, "num_scans_of_drive", lambda *_: 6)
    return study.variants_of(None, None, 10.0)


def made_up(variants, folder=None, **_):
    """Outcomes in which trials fail as often as there are people."""
    found = []
    for one in variants:
        error = np.full((N, one.num_scans), 0.01, np.float32)
        error[: one.settings["people"] // 2, 3:] = 1.0
        place = np.tile(one.path[:6].astype(np.float32), (N, 1, 1))
        count = np.full(N, 2)
        own = Outcomes(error, place, np.zeros(N), np.ones(N), count > 0, count, count)
        found.append(Collected(own, 1.0, 1.0))
    return found


def test_a_variant_for_each_scanner_building_and_number_of_people(variants):
    assert len(variants) == len({one.name for one in variants}) == 27
    programs = {runner.program_of(one) for one in variants}
    assert len(programs) == 3  # people are numbers that are traced
    assert {float(one.life.traffic.people) for one in variants} == {0.0, 5.0, 20.0}
    assert all(one.path.shape[1] == 2 and len(one.path) < 600 for one in variants)
    for one in variants[::3]:
        assert one.config.frontend.lidar.num_beams == one.robot.scanner.num_beams


def test_the_figure_is_drawn_from_its_numbers(variants, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(runner, "run_timed", made_up)
    monkeypatch.setattr(study, "variants_of", lambda *_: variants)
    assert study.main(["--out", str(tmp_path), "--runs", str(N)]) == 0
    numbers = json.loads((tmp_path / "study.json").read_text())
    assert len(numbers["variants"]) == 27 and len(numbers["worlds"]) == 3
    assert numbers["variants"][2]["success"]["value"] == pytest.approx(2 / N)
    effect = [one for one in numbers["effects"] if one["setting"] == "people"]
    assert [one["value"] for one in effect] == [5, 20] and effect[0]["pairs_of_variants"] == 9
    assert effect[1]["success"]["mean"] == pytest.approx(-10 / N)
    assert (tmp_path / "study.png").read_bytes().startswith(b"\x89PNG")
    assert "people 20 instead of 0, over 9 pairs of variants" in capsys.readouterr().out


def test_a_map_that_is_missing_is_named_in_one_line(tmp_path, capsys):
    assert study.main(["--out", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("study: error: --maps: is missing; it has the map of Willow Garage")
