"""Small models that are tuned by this library and by others."""

import warnings

import jax
import numpy as np
import pytest

from experiments import any_model, common, model_tasks, model_tuners
from experiments.model_tasks import DT, LINEAR

TASK = model_tasks.task(LINEAR, seed=0, num_trials=1, num_steps=60)


def test_each_parameter_starts_off_by_the_factor():
    start = model_tuners.start_of(TASK, 0)
    off = np.array([float(start[key] - TASK.params[key]) for key in TASK.params])
    np.testing.assert_allclose(np.abs(off), np.log(model_tuners.FACTOR))
    others = [float(model_tuners.start_of(TASK, seed)["motion_std"]) for seed in range(8)]
    assert len(set(others)) == 2  # up or down


def test_other_libraries_are_given_the_matrices_and_their_full_ones_count_by_the_mean_variance():
    F, H = model_tuners.linear_matrices(TASK)
    np.testing.assert_allclose(F, [[1.0, DT], [0.0, 1.0]])
    np.testing.assert_allclose(H, [[1.0, 0.0]])
    found = model_tuners._from_matrices(np.array([[0.03, 0.01], [0.01, 0.05]]), np.array([[0.25]]))
    np.testing.assert_allclose(found["motion_std"], np.log(0.2))
    np.testing.assert_allclose(found["measurement_std"], np.log(0.5))


def test_a_method_without_its_library_is_left_out_and_tried_again(tmp_path, capsys):
    """The others are rows with their loss and error, and are computed once."""
    calls = []

    def off_by(by):
        def make(task, seed):
            def tune(start, num_updates):
                calls.append(num_updates)
                assert start == model_tuners.start_of(task, seed)
                return {key: value + by for key, value in task.params.items()}

            return tune

        return make

    def missing(task, seed):
        raise ModuleNotFoundError("no such thing", name="another")

    cache = common.ResultCache(tmp_path / "cache", "x")
    tuners = {"near": off_by(0.1), "absent": missing, "far": off_by(-0.5)}
    for _ in range(2):
        rows = model_tuners.rows_of("linear", TASK, tuners, 3, 7, cache)
        assert calls == [1, 7, 1, 7]  # the first of each compiles
        printed = capsys.readouterr().out
        assert printed == "left out: absent, as another is missing; pip install '.[bench]'\n"
    assert [row["method"] for row in rows] == ["truth", "near", "far"]
    np.testing.assert_allclose([row["error"] for row in rows], [0.0, 0.1, 0.5], rtol=1e-6)
    likelihood = TASK.own(TASK.params, jax.tree.map(lambda x: x[0], TASK.data))
    np.testing.assert_allclose(rows[0]["loss"], -likelihood / 60, rtol=1e-6)
    assert rows[2]["loss"] > rows[0]["loss"]


def test_the_gradient_finds_less_than_the_truth_and_than_a_search():
    """The least loss is below that of the truth; a search stays in its box, and is above it."""
    start = model_tuners.start_of(TASK, 0)
    loss = {"truth": TASK.params, "start": start}
    for method, updates in (("jaxslam", 25), ("random", 2)):
        loss[method] = model_tuners.TUNERS[method](TASK, 0)(start, updates)
    off = [float(loss["random"][key] - start[key]) for key in start]
    assert 0.0 < np.abs(off).max() <= np.log(2 * model_tuners.FACTOR)
    found = {key: model_tuners._row(TASK, key, value, 0.0)["loss"] for key, value in loss.items()}
    assert found["jaxslam"] < found["truth"] < found["start"]
    assert found["jaxslam"] < found["random"] < found["start"]


@pytest.mark.slow
def test_dynamax_fits_the_noise_of_the_linear_model_alone():
    """By its own SGD with F and H fixed, close to what this library finds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("dynamax.linear_gaussian_ssm", exc_type=ImportError)
        task = model_tasks.task(LINEAR, seed=1, num_trials=1, num_steps=400)
        start = model_tuners.start_of(task, 0)
        own = model_tuners.TUNERS["jaxslam"](task, 0)(start, 25)
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            other = model_tuners.LINEAR_TUNERS["dynamax, SGD"](task, 0)(start, 20)
    for key, value in own.items():
        assert abs(float(value) - other[key]) < 0.35, key


def test_any_model_is_drawn_where_the_memory_of_its_process_is_unknown(tmp_path):
    row = {"ratio": {"seconds": 0.3, "planned": 0.1, "grown": None}}
    numbers = {"trials": 8, "against_dynamax": {"pendulum": row, "beacons": row}}
    any_model.draw(numbers, tmp_path / "any_model.png")
    assert (tmp_path / "any_model.png").read_bytes().startswith(b"\x89PNG")


def test_without_dynamax_there_is_one_line(tmp_path, monkeypatch, capsys):
    def missing(args, name):
        raise ModuleNotFoundError(name="dynamax")

    monkeypatch.setattr(any_model, "pin", lambda: None)
    monkeypatch.setattr(any_model, "against_dynamax", missing)
    assert any_model.main(["--out", str(tmp_path / "out")]) == 2
    assert (
        capsys.readouterr().err == "any_model: error: dynamax is missing; pip install '.[bench]'\n"
    )
    assert not (tmp_path / "out").exists()
