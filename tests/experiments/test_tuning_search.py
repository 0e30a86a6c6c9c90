"""The experiments on tuning: their clock, their searches, what they count and what they keep."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import common, exact, recovery, search, tuning
from jaxslam.core import trace_cache
from jaxslam.filtering.noise import NoiseParams
from jaxslam.tuning import fitting, parameters, standard_errors
from jaxslam.tuning.fitting import TuneResult
from jaxslam.tuning.standard_errors import StandardErrors

HAND = NoiseParams.for_landmark_sensor()
TASK = search.Task(exact.CONFIG, HAND, None, None, ("wall",))
BEST = parameters.flatten_params(HAND) + np.array([1.5, -3.0, 2.0, 1.0, -2.4, -3.0, 1.1, 0.0])


def parabola(noise):
    """A loss of two runs that is least at BEST."""
    return np.sum((parameters.flatten_params(noise) - BEST) ** 2) + np.array([-0.1, 0.1])


@pytest.fixture
def easy(monkeypatch):
    """Losses without a filter, on a clock that an evaluation moves by 2 s, and judging by 100."""
    clock = [0.0]

    def values(noise, config, logs, loss):
        clock[0] += 2.0
        return parabola(noise)

    def judge(task, noise):
        clock[0] += 100.0
        return {"heldout_rmse_m": parabola(noise).mean(), "nees": 1.0, "diverged": 0}

    monkeypatch.setattr(search, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(search, "judge", judge)
    monkeypatch.setattr(fitting, "values", values)


@pytest.mark.parametrize("method", search.METHODS)
def test_a_search_starts_by_hand_keeps_its_best_and_pauses_its_clock(easy, method):
    if method == "bayesian":
        pytest.importorskip("optuna")
    found = search.by_search(TASK, method, 0, 60.0, 40)
    assert found["evaluations"] == 40 and found["seconds"] == 80.0
    points = found["points"]
    np.testing.assert_allclose(points[0]["theta"], parameters.flatten_params(HAND), rtol=1e-6)
    loss = [point["loss"] for point in points]
    assert len(loss) > 2 and np.all(np.diff(loss) < 0)
    for point in points:
        assert point["seconds"] == 2.0 * point["evaluations"]
        off = point["theta"] - parameters.flatten_params(HAND)
        assert np.abs(off).max() <= np.log(search.WIDE) and off[-1] == 0.0
    assert search.by_search(TASK, method, 0, 60.0, 40)["points"][-1]["loss"] == loss[-1]


def test_random_is_uniform():
    ask, _ = search.at_random(3, 7)
    drawn = np.array([ask() for _ in range(2001)])
    assert not drawn[0].any() and np.abs(drawn).max() <= 1.0
    assert np.abs(drawn.mean(axis=0)).max() < 4.5 / np.sqrt(3 * 2000)
    assert np.abs(drawn.std(axis=0) * np.sqrt(3) - 1).max() < 0.05


def test_a_noise_that_fails_is_no_candidate(easy, monkeypatch):
    monkeypatch.setattr(fitting, "values", lambda noise, *_: np.array([np.nan, -9.0]))
    assert search.by_search(TASK, "random", 0, 0.0, 3)["points"] == []


def test_points_within_a_limit_and_the_time_to_an_error():
    points = [
        {"seconds": s, "evaluations": n, "heldout_rmse_m": e}
        for s, n, e in [(1.0, 1, 0.5), (2.0, 4, 0.7), (5.0, 9, 0.2)]
    ]
    trace = {"points": points}
    assert search.best_by(trace, seconds=4.0) is points[1]
    assert search.best_by(trace, evaluations=9) is points[2]
    assert search.best_by(trace, seconds=0.5) is points[0]
    assert search.time_to(trace, 0.5) == 1.0 and search.time_to(trace, 0.3) == 5.0
    assert search.time_to(trace, 0.1) is None


def test_rows_tell_what_was_found_in_the_time_and_evaluations_of_the_gradient():
    def trace(*points):
        names = ("seconds", "evaluations", "heldout_rmse_m", "nees")
        points = [dict(zip(names, point, strict=True)) for point in points]
        return {"points": points, "seconds": points[-1]["seconds"] + 1.0, "evaluations": 50}

    own = trace((1.0, 1, 0.9, 2.0), (3.0, 3, 0.4, 1.0), (4.0, 4, 0.2, 1.0)) | {"evaluations": 5}
    other = trace((1.0, 1, 0.9, 2.0), (4.5, 6, 0.3, 1.0), (30.0, 40, 0.35, 1.5))
    within = search.best_by(other, evaluations=5)
    row = tuning._row("office", "random", other["points"][-1], 31.0, 50, own, within, other)
    assert row["heldout_rmse_m"] == 0.35 and row["nees"] == 1.5
    assert row["heldout_rmse_at_equal_evaluations_m"] == 0.9
    assert row["heldout_rmse_at_equal_seconds_m"] == 0.3
    assert row["best_heldout_rmse_m"] == 0.3 and row["seconds_to_best"] == 4.5
    assert row["gradient_seconds_to_that"] == 4.0


def test_recovery_counts_the_starts_that_end_near_the_truth(monkeypatch, tmp_path):
    truth, size = parameters.flatten_params(exact.truth()), 8
    se = np.full(size, 0.1)
    se[1] = np.inf
    ends = truth + 0.1 * np.array([[2.9] * size, [-3.1] + [0.0] * (size - 1), [0.0] * size])
    ends[2, 1] = -40.0  # not identifiable: it may go where it likes
    asked = []

    def recover(seed, number, train, test):
        asked.append(number)
        errors = dict(enumerate((0.0101, 0.0099, 0.0102)))
        rest = {"start": truth, "skipped": 0, "heldout_rmse_m": errors[number]}
        return {"theta": ends[number], "loss": float(number)} | rest

    def errors(noise, config, logs):
        np.testing.assert_allclose(parameters.flatten_params(noise), ends[0], rtol=1e-6)
        known = np.isfinite(se)
        return StandardErrors(
            parameters.param_names(noise), se, np.eye(size), known, ("a warning",)
        )

    monkeypatch.setattr(recovery, "_recover", recover)
    monkeypatch.setattr(standard_errors, "standard_errors", errors)
    monkeypatch.setattr(recovery, "position_rmse", lambda noise, logs: 0.01)
    monkeypatch.setattr(exact, "drives", lambda *_, runs: jnp.zeros(runs))
    told = recovery.compute(0, 3, 4, 2, common.Kept(tmp_path / "kept", "x"))
    assert told["within_3_se"] == 2 and asked == [0, 1, 2]
    np.testing.assert_allclose([told["worst_z"], told["worst_heldout_ratio"]], [3.1, 1.02])
    again = recovery.compute(0, 3, 4, 2, common.Kept(tmp_path / "kept", "x"))
    assert asked == [0, 1, 2] and json.dumps(common.plain(again)) == json.dumps(common.plain(told))


def test_parts_are_kept_until_the_program_or_the_arguments_change(tmp_path, monkeypatch):
    made = []

    def make():
        made.append(1)
        return {"x": np.float64(1 / 3), "nan": np.nan, "all": np.arange(2)}

    kept = common.Kept(tmp_path / "kept", {"seed": 0})
    first = kept("one part", make)
    assert first == {"x": 1 / 3, "nan": None, "all": [0, 1]}
    assert common.Kept(tmp_path / "kept", {"seed": 0})("one part", make) == first
    assert len(made) == 1
    common.Kept(tmp_path / "kept", {"seed": 1})("one part", make)
    assert len(made) == 2
    (file,) = (tmp_path / "kept").iterdir()
    file.write_text("{")
    common.Kept(tmp_path / "kept", {"seed": 1})("one part", make)
    monkeypatch.setattr(trace_cache, "version", lambda: "another")
    common.Kept(tmp_path / "kept", {"seed": 1})("one part", make)
    assert len(made) == 4
    kept.clear()
    assert not (tmp_path / "kept").exists()


def test_each_start_is_off_by_a_factor_of_its_own(monkeypatch):
    """And is tuned on some runs a step, on some, then on all of them."""
    calls = []

    def tune(noise, config, logs, **how):
        calls.append((parameters.flatten_params(noise), len(logs), how))
        found = jax.tree.map(lambda x: 2.0 * x, noise)
        skipped = np.array([1, 0])
        return TuneResult(found, 1, np.array([3.0, 2.0]), None, None, skipped)

    monkeypatch.setattr(fitting, "tune", tune)
    monkeypatch.setattr(recovery, "position_rmse", lambda noise, logs: 0.5)
    train = np.zeros(200)
    told = [recovery._recover(0, number, train, None) for number in range(40)]
    off = np.array([one["start"] for one in told]) - parameters.flatten_params(exact.truth())
    reach = np.log(recovery.FACTOR)
    assert np.abs(off).max() <= reach and np.abs(off).max() > 0.95 * reach
    assert np.abs(off.mean()) < 4.5 * reach / np.sqrt(3 * off.size)
    assert [runs for _, runs, _ in calls[:3]] == [200, recovery.SOME, 200]
    assert [how.get("batch") for _, _, how in calls[:3]] == [recovery.PACK, None, None]
    np.testing.assert_allclose(calls[1][0], told[0]["start"] + np.log(2), rtol=1e-6)
    np.testing.assert_allclose(told[0]["theta"], told[0]["start"] + np.log(8), rtol=1e-6)
    assert told[0]["loss"] == 2.0 and told[0]["skipped"] == 3


def test_each_task_is_compared_on_its_own_runs_and_all_is_written(monkeypatch, tmp_path, capsys):
    office, robots = TASK._replace(train="drives"), TASK._replace(train="robots")
    compared = []
    point = {"seconds": 1.0, "evaluations": 1, "heldout_rmse_m": 0.1, "nees": 1.0}
    trace = {"points": [point], "seconds": 2.0, "evaluations": 3}

    def compare(data, task, seed, steps, kept):
        compared.append((data, task.train))
        return [tuning._row(data, "hand", point, 0.0, 0, trace, point)], {"gradient": trace}

    theta = parameters.flatten_params(exact.truth())
    rows = [{"start": theta + 0.1, "theta": theta}]
    sure = {"standard_errors": [0.1] * 8, "identifiable": [True] * 7 + [False]}
    told = {"starts": 1, "runs": 2, "within_3_se": 1, "worst_heldout_ratio": 1.0, "rows": rows}
    told |= sure | {"names": parameters.param_names(exact.truth()), "log_truth": theta}
    monkeypatch.setattr(tuning, "office", lambda *_: office)
    monkeypatch.setattr(tuning, "recorded", lambda _: robots)
    monkeypatch.setattr(tuning, "compare", compare)
    step = {"runs": 2, "scans": 3, "seconds": 0.5}
    monkeypatch.setattr(tuning, "step_seconds", lambda task: step | {"of": task.train})
    monkeypatch.setattr(recovery, "compute", lambda *_: told)
    monkeypatch.setattr(tuning, "keep_compiled", lambda: None)
    given = ["--out", str(tmp_path), "--mrclam", "folder"]
    assert tuning.main(given) == 0
    assert compared == [("office", "drives"), ("mrclam", "robots")]
    numbers = json.loads((tmp_path / "tuning.json").read_text())
    assert [row["data"] for row in numbers["rows"]] == ["office", "mrclam"]
    assert numbers["step"]["of"] == "drives" and numbers["recovery"]["within_3_se"] == 1
    assert {file.name for file in tmp_path.iterdir()} == {"tuning.json", "tuning.png"}
    assert "NEES" in capsys.readouterr().out


def test_a_folder_without_the_data_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tuning, "keep_compiled", lambda: None)
    assert tuning.main(["--out", str(tmp_path / "out"), "--mrclam", str(tmp_path)]) == 2
    assert "tuning: error: " in capsys.readouterr().err and not (tmp_path / "out").exists()
