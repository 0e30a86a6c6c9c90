"""Standard errors of paired and unpaired differences, of outcomes that are made up."""

import json

import numpy as np
import pytest

from experiments import paired_trials
from jaxslam.study import runner
from jaxslam.study.kept_trials import Collected
from jaxslam.study.outcomes import Outcomes

N, T = 400, 5


def outcomes(rmse):
    error = np.repeat(np.asarray(rmse)[:, None], T, axis=1)
    count = np.full(N, 3)
    place = np.zeros((N, T, 2))
    return Outcomes(error, place, np.ones(N), np.ones(N), count > 0, count, count)


def test_the_ratio_is_that_of_what_trials_do_not_have_in_common(tmp_path, monkeypatch, capsys):
    """Errors c + e with a common part: the ratio is the root of var(e) / (var(c) + var(e))."""
    variants = paired_trials.variants_of(T)
    rng = np.random.default_rng(0)
    common = rng.normal(1.0, 0.1, N)
    own = [outcomes(common + rng.normal(0.0, s, N)) for s in [0.05] * (len(variants) - 1)]
    found = [Collected(one, 1.0, 1.0) for one in (outcomes(common), *own)]
    monkeypatch.setattr(runner, "run_timed", lambda *_, **__: found)
    assert paired_trials.main(["--out", str(tmp_path), "--steps", "5"]) == 0
    numbers = json.loads((tmp_path / "paired_trials.json").read_text())
    wanted = 0.05 / np.sqrt(2 * 0.1**2 + 0.05**2)
    for row in numbers["rows"]:
        assert row["ratio"] == pytest.approx(wanted, rel=0.2)
        assert row["ratio_low"] < row["ratio"] < row["ratio_high"]
    inside = [row["ratio_low"] < wanted < row["ratio_high"] for row in numbers["rows"]]
    assert np.mean(inside) > 0.7
    assert "ratio 0." in capsys.readouterr().out
    assert (tmp_path / "paired_trials.png").read_bytes().startswith(b"\x89PNG")


def test_all_but_the_robot_of_other_wheels_run_the_same_program():
    variants = paired_trials.variants_of(T)
    programs = [runner.program_of(one) for one in variants]
    assert len(set(programs)) == 2 and programs.count(programs[0]) == len(variants) - 1
    assert len({runner.fingerprint(one, 0) for one in variants}) == len(variants)
