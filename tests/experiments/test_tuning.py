"""The experiments on tuning: their clock, searches, counts and cache."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import (
    adaptation,
    calibration_rows,
    common,
    exact_model,
    model_tuners,
    noise_search,
    parameter_recovery,
    tuning,
)
from jaxslam.core import trace_cache
from jaxslam.filtering.noise import NoiseParams
from jaxslam.tuning import fitting, parameters, standard_errors
from jaxslam.tuning.fitting import TuneResult
from jaxslam.tuning.standard_errors import StandardErrors

HAND = NoiseParams.for_landmark_sensor()
TASK = noise_search.Task(exact_model.CONFIG, HAND, None, None, ("wall_angle_std",))
TRUTH_ROW = {"method": "truth", "loss": -0.7, "error": 0.0, "seconds": 0.0}
OWN_ROW = {"method": "jaxslam", "error": 0.1, "seconds": 2.0}
CALIBRATION_ROW = {"data": "calibration", "method": "closed form", "heldout_rmse_m": 0.01}
CALIBRATION_ROW |= {"nees": 1.2, "seconds": 0.1}
BEST = parameters.flatten_params(HAND) + np.array([1.5, -3.0, 2.0, 1.0, -2.4, -3.0, 1.1, 0.0])


def parabola(params):
    """A loss of two drives that is least at BEST."""
    return np.sum((parameters.flatten_params(params) - BEST) ** 2) + np.array([-0.1, 0.1])


@pytest.fixture
def easy(monkeypatch):
    """Losses without a filter; the clock moves by 2 s for them, by 100 s on held-out drives."""
    clock = [0.0]

    def values(config, params, episodes, loss):
        clock[0] += 2.0
        return parabola(params)

    def evaluate_heldout(task, params):
        clock[0] += 100.0
        return {"heldout_rmse_m": parabola(params).mean(), "nees": 1.0, "diverged": 0}

    monkeypatch.setattr(noise_search, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(noise_search, "evaluate_heldout", evaluate_heldout)
    monkeypatch.setattr(fitting, "values", values)


@pytest.mark.parametrize("method", noise_search.METHODS)
def test_a_search_starts_at_hand_set_noise_keeps_its_best_and_pauses_its_clock(easy, method):
    if method == "bayesian":
        pytest.importorskip("optuna")
    found = noise_search.by_search(TASK, method, 0, 60.0, 40)
    assert found["evaluations"] == 40 and found["seconds"] == 80.0
    points = found["points"]
    np.testing.assert_allclose(points[0]["theta"], parameters.flatten_params(HAND), rtol=1e-6)
    loss = [point["loss"] for point in points]
    assert len(loss) > 2 and np.all(np.diff(loss) < 0)
    for point in points:
        assert point["seconds"] == 2.0 * point["evaluations"]
        off = point["theta"] - parameters.flatten_params(HAND)
        assert np.abs(off).max() <= np.log(noise_search.SEARCH_FACTOR) and off[-1] == 0.0
    assert noise_search.by_search(TASK, method, 0, 60.0, 40)["points"][-1]["loss"] == loss[-1]


def test_random_is_uniform():
    sampler = noise_search.RandomSampler(3, 7)
    drawn = np.array([sampler.propose() for _ in range(2001)])
    assert not drawn[0].any() and np.abs(drawn).max() <= 1.0
    assert np.abs(drawn.mean(axis=0)).max() < 4.5 / np.sqrt(3 * 2000)
    assert np.abs(drawn.std(axis=0) * np.sqrt(3) - 1).max() < 0.05


def test_parameters_with_a_loss_that_is_not_finite_are_no_candidate(easy, monkeypatch):
    monkeypatch.setattr(fitting, "values", lambda *_: np.array([np.nan, -9.0]))
    assert noise_search.by_search(TASK, "random", 0, 0.0, 3)["points"] == []


def test_points_within_a_limit_and_the_time_to_an_error():
    points = [
        {"seconds": s, "evaluations": n, "heldout_rmse_m": e}
        for s, n, e in [(1.0, 1, 0.5), (2.0, 4, 0.7), (5.0, 9, 0.2)]
    ]
    trace = {"points": points}
    assert noise_search.last_within(trace, "seconds", 4.0) is points[1]
    assert noise_search.last_within(trace, "evaluations", 9) is points[2]
    assert noise_search.last_within(trace, "seconds", 0.5) is points[0]
    assert noise_search.time_to(trace, 0.5) == 1.0 and noise_search.time_to(trace, 0.3) == 5.0
    assert noise_search.time_to(trace, 0.1) is None


def test_rows_hold_the_errors_within_the_time_and_evaluations_of_the_gradient():
    def trace(*points):
        names = ("seconds", "evaluations", "heldout_rmse_m", "nees")
        points = [dict(zip(names, point, strict=True)) for point in points]
        return {"points": points, "seconds": points[-1]["seconds"] + 1.0, "evaluations": 50}

    own = trace((1.0, 1, 0.9, 2.0), (3.0, 3, 0.4, 1.0), (4.0, 4, 0.2, 1.0)) | {"evaluations": 5}
    other = trace((1.0, 1, 0.9, 2.0), (4.5, 6, 0.3, 1.0), (30.0, 40, 0.35, 1.5))
    within = noise_search.last_within(other, "evaluations", 5)
    row = tuning._row("office", "random", other["points"][-1], 31.0, 50, own, within, other)
    assert row["heldout_rmse_m"] == 0.35 and row["nees"] == 1.5
    assert row["heldout_rmse_at_equal_evaluations_m"] == 0.9
    assert row["heldout_rmse_at_equal_seconds_m"] == 0.3
    assert row["best_heldout_rmse_m"] == 0.3 and row["seconds_to_best"] == 4.5
    assert row["gradient_seconds_to_that"] == 4.0


def test_recovery_counts_the_starts_that_end_near_the_truth(monkeypatch, tmp_path):
    truth, size = parameters.flatten_params(exact_model.true_params()), 8
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

    def errors(config, params, episodes):
        np.testing.assert_allclose(parameters.flatten_params(params), ends[0], rtol=1e-6)
        known = np.isfinite(se)
        return StandardErrors(
            parameters.param_names(params), se, np.eye(size), known, ("a warning",)
        )

    monkeypatch.setattr(parameter_recovery, "_recover", recover)
    monkeypatch.setattr(standard_errors, "standard_errors", errors)
    monkeypatch.setattr(parameter_recovery, "position_rmse", lambda params, drives: 0.01)
    monkeypatch.setattr(exact_model, "drives", lambda *_, num_trials: jnp.zeros(num_trials))
    found = parameter_recovery.compute(0, 3, 4, 2, common.ResultCache(tmp_path / "cache", "x"))
    assert found["within_3_se"] == 2 and asked == [0, 1, 2]
    np.testing.assert_allclose([found["worst_z"], found["worst_heldout_ratio"]], [3.1, 1.02])
    again = parameter_recovery.compute(0, 3, 4, 2, common.ResultCache(tmp_path / "cache", "x"))
    assert asked == [0, 1, 2] and json.dumps(common.plain(again)) == json.dumps(common.plain(found))


def test_results_are_cached_until_the_program_or_the_arguments_change(tmp_path, monkeypatch):
    made = []

    def make():
        made.append(1)
        return {"x": np.float64(1 / 3), "nan": np.nan, "all": np.arange(2)}

    cache = common.ResultCache(tmp_path / "cache", {"seed": 0})
    first = cache("one part", make)
    assert first == {"x": 1 / 3, "nan": None, "all": [0, 1]}
    assert common.ResultCache(tmp_path / "cache", {"seed": 0})("one part", make) == first
    assert len(made) == 1
    common.ResultCache(tmp_path / "cache", {"seed": 1})("one part", make)
    assert len(made) == 2
    (file,) = (tmp_path / "cache").iterdir()
    file.write_text("{")
    common.ResultCache(tmp_path / "cache", {"seed": 1})("one part", make)
    monkeypatch.setattr(trace_cache, "version", lambda: "another")
    common.ResultCache(tmp_path / "cache", {"seed": 1})("one part", make)
    assert len(made) == 4
    cache.clear()
    assert not (tmp_path / "cache").exists()


def test_each_start_is_off_by_a_factor_of_its_own(monkeypatch):
    """And is tuned on some runs a step, on some, then on all of them."""
    calls = []

    def tune(config, params, episodes, **options):
        calls.append((parameters.flatten_params(params), len(episodes), options))
        found = jax.tree.map(lambda x: 2.0 * x, params)
        skipped = np.array([1, 0])
        return TuneResult(found, 1, np.array([3.0, 2.0]), None, None, skipped)

    monkeypatch.setattr(fitting, "tune", tune)
    monkeypatch.setattr(parameter_recovery, "position_rmse", lambda params, drives: 0.5)
    train = np.zeros(200)
    found = [parameter_recovery._recover(0, number, train, None) for number in range(40)]
    off = np.array([one["start"] for one in found]) - parameters.flatten_params(
        exact_model.true_params()
    )
    reach = np.log(parameter_recovery.FACTOR)
    assert np.abs(off).max() <= reach and np.abs(off).max() > 0.95 * reach
    assert np.abs(off.mean()) < 4.5 * reach / np.sqrt(3 * off.size)
    assert [count for _, count, _ in calls[:3]] == [200, parameter_recovery.SECOND_BATCH, 200]
    batches = [options.get("batch_size") for _, _, options in calls[:3]]
    assert batches == [parameter_recovery.FIRST_BATCH, None, None]
    np.testing.assert_allclose(calls[1][0], found[0]["start"] + np.log(2), rtol=1e-6)
    np.testing.assert_allclose(found[0]["theta"], found[0]["start"] + np.log(8), rtol=1e-6)
    assert found[0]["loss"] == 2.0 and found[0]["skipped"] == 3


def test_each_task_is_compared_on_its_own_drives_and_all_is_written(monkeypatch, tmp_path, capsys):
    office, robots = TASK._replace(train="drives"), TASK._replace(train="robots")
    compared = []
    point = {"seconds": 1.0, "evaluations": 1, "heldout_rmse_m": 0.1, "nees": 1.0}
    trace = {"points": [point], "seconds": 2.0, "evaluations": 3}

    def compare(data, task, seed, num_updates, cache):
        compared.append((data, task.train))
        return [tuning._row(data, "hand", point, 0.0, 0, trace, point)], {"gradient": trace}

    def adapting(data, task, own, cache):
        assert own == trace and task.train == ("drives" if data == "office" else "robots")
        names = ("hand, adapting", "gradient", "gradient, adapting")
        return [tuning._row(data, name, point, 0.0, 0, trace, point) for name in names]

    theta = parameters.flatten_params(exact_model.true_params())
    rows = [{"start": theta + 0.1, "theta": theta}]
    sure = {"standard_errors": [0.1] * 8, "identifiable": [True] * 7 + [False]}
    recovered = {"starts": 1, "runs": 2, "within_3_se": 1, "worst_heldout_ratio": 1.0, "rows": rows}
    recovered |= sure | {
        "names": parameters.param_names(exact_model.true_params()),
        "log_truth": theta,
    }
    monkeypatch.setattr(tuning, "office", lambda *_: office)
    monkeypatch.setattr(tuning, "recorded", lambda _: robots)
    monkeypatch.setattr(tuning, "compare", compare)
    step = {"runs": 2, "scans": 3, "seconds": 0.5}
    monkeypatch.setattr(tuning, "update_seconds", lambda task: step | {"of": task.train})
    monkeypatch.setattr(parameter_recovery, "compute", lambda *_: recovered)
    models = {name: [TRUTH_ROW, TRUTH_ROW | OWN_ROW] for name in ("pendulum", "linear")}
    monkeypatch.setattr(model_tuners, "compute", lambda *_: models)
    monkeypatch.setattr(calibration_rows, "compute", lambda *_: [CALIBRATION_ROW])
    monkeypatch.setattr(tuning, "adapting", adapting)
    monkeypatch.setattr(tuning, "enable_caches", lambda: None)
    assert tuning.main(["--out", str(tmp_path), "--mrclam", "folder"]) == 0
    assert compared == [("office", "drives"), ("mrclam", "robots")]
    numbers = json.loads((tmp_path / "tuning.json").read_text())
    assert [row["data"] for row in numbers["rows"]] == 4 * ["office"] + 4 * ["mrclam"]
    assert numbers["models"] == models and numbers["calibration"] == [CALIBRATION_ROW]
    assert numbers["step"]["of"] == "drives" and numbers["recovery"]["within_3_se"] == 1
    assert {file.name for file in tmp_path.iterdir()} == {"tuning.json", "tuning.png"}
    printed = capsys.readouterr().out
    assert "NEES" in printed and "closed form" in printed and "jaxslam" in printed


def test_hand_set_and_tuned_noise_adapt_with_the_parameters_that_they_have(monkeypatch, tmp_path):
    """Noise that adapts starts from the first and the last point of the gradient."""
    truth = parameters.flatten_params(HAND)
    points = [{"theta": list(truth + by), "heldout_rmse_m": 0.1, "nees": 2.0} for by in (0, 1, 2)]
    asked = []

    def heldout(config, params, drives):
        asked.append((config, parameters.flatten_params(params), drives))
        found = {"heldout_rmse_m": 0.01 * len(asked), "nees": 1.5, "diverged": 0}
        return found | {"q_factor": 0.5, "r_factor": 2.0}

    monkeypatch.setattr(adaptation, "heldout", heldout)
    own = {"points": points, "seconds": 5.0, "evaluations": 7}
    cache = common.ResultCache(tmp_path / "cache", "x")
    task = TASK._replace(test="held out")
    rows = tuning.adapting("office", task, own, cache)
    assert rows == tuning.adapting("office", task, own, cache) and len(asked) == 2
    assert [row["method"] for row in rows] == ["hand, adapting", "gradient, adapting"]
    for (config, theta, drives), by in zip(asked, (0, 2), strict=True):
        assert config is TASK.config.filter and drives == "held out"
        np.testing.assert_allclose(theta, truth + by, rtol=1e-6)
    assert [row["heldout_rmse_m"] for row in rows] == [0.01, 0.02]
    assert [row["seconds"] for row in rows] == [0.0, 5.0] and rows[1]["evaluations"] == 7
    assert rows[0]["nees"] == 1.5 and rows[0]["q_factor"] == 0.5 and rows[0]["r_factor"] == 2.0


def test_a_folder_without_the_data_is_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tuning, "enable_caches", lambda: None)
    assert tuning.main(["--out", str(tmp_path / "out"), "--mrclam", str(tmp_path)]) == 2
    assert "tuning: error: " in capsys.readouterr().err and not (tmp_path / "out").exists()
