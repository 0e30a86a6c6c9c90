"""The experiment of many drives: on several processes, stopped and resumed."""

import json
import os
import subprocess
import sys
from io import StringIO
from time import monotonic

import jax
import numpy as np
import pytest

from experiments import filter_benchmark, monte_carlo, scaling
from jaxslam.io.errors import InputError
from jaxslam.io.output import plain
from jaxslam.pipeline.episodes import TrialResult
from jaxslam.study import kept_trials, processes
from tests.short_trials import variant

SEED = 5
NUM_TRIALS = 10
TIMED = {"seconds", "seconds_per_scan", "peak_mb", "processes", "devices"}


def untimed(numbers):
    """The numbers that do not depend on where and when they were computed."""
    return json.loads(json.dumps(plain(numbers) | dict.fromkeys(TIMED)))


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The numbers of one process, and the folder where it has kept its runs."""
    folder = tmp_path_factory.mktemp("one") / "runs"
    return monte_carlo.work(variant(), SEED, NUM_TRIALS, folder, StringIO()), folder


@pytest.mark.timeout(300)
@pytest.mark.slow
def test_two_processes_give_the_same_as_one_bit_for_bit(done, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_X64", "1")  # as in this one, which has two devices
    flags = os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=1")
    monkeypatch.setenv("XLA_FLAGS", flags)
    numbers = monte_carlo.compute(
        variant(), SEED, NUM_TRIALS, tmp_path / "runs", processes.local(2)
    )
    assert numbers["processes"] == numbers["devices"] == 2
    assert untimed(numbers) == untimed(done[0])
    (one,), (two,) = ([*folder.glob("*.npz")] for folder in (done[1], tmp_path / "runs"))
    with np.load(one) as one, np.load(two) as two:
        for name in TrialResult._fields:
            np.testing.assert_array_equal(one[name], two[name])


@pytest.mark.timeout(120)
@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.slow
def test_a_process_that_is_missing_is_reported_in_one_line(number, tmp_path):
    """The command itself: the other one of two machines is never started."""
    port = processes.local(2).address.split(":")[1]
    code = "import sys; from experiments import monte_carlo; from jaxslam.study import processes; "
    code += "processes.STARTUP_TIMEOUT = 6.0; sys.exit(monte_carlo.main(sys.argv[1:]))"
    options = ["--coordinator_address", f"127.0.0.1:{port}", "--num_processes", "2"]
    options += ["--process_id", str(number), "--runs", "8", "--out", str(tmp_path)]
    begin = monotonic()
    done = subprocess.run(
        [sys.executable, "-c", code, *options], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2 and monotonic() - begin < 60
    (line,) = done.stderr.splitlines()
    assert line.startswith("monte_carlo: error: not all of 2 processes came up at 127.0.0.1")


@pytest.mark.parametrize(
    "options, field",
    [
        (["--runs", "0"], "--runs"),
        (["--process_id", "1"], "--coordinator_address"),
        (["--coordinator_address", "a:1", "--num_processes", "2"], "--process_id"),
        (
            ["--coordinator_address", "a:1", "--num_processes", "2", "--process_id", "2"],
            "--process_id",
        ),
    ],
)
def test_options_that_do_not_fit_are_refused(options, field, tmp_path, capsys):
    assert monte_carlo.main(["--out", str(tmp_path), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"monte_carlo: error: {field}")


class Stop(Exception):
    pass


@pytest.mark.slow
def test_each_core_is_a_device_before_the_first_array_fixes_them(tmp_path, monkeypatch):
    order = []

    def stop():
        order.append("arrays")
        raise InputError("stopped")

    monkeypatch.setattr(monte_carlo, "use_cpu_devices", lambda: order.append("devices"))
    monkeypatch.setattr(monte_carlo, "office", stop)
    assert monte_carlo.main(["--out", str(tmp_path)]) == 2
    assert order == ["devices", "arrays"]


def test_an_experiment_that_was_stopped_resumes_and_gives_the_same(done, tmp_path, monkeypatch):
    """Stopped after the first file, as kill -9 would: a part of the next one is left."""
    folder = tmp_path / "runs"
    monkeypatch.setattr(kept_trials, "TRIALS_PER_FILE", 8)
    real = kept_trials._keep

    def stopping(*arguments):
        real(*arguments)
        raise Stop

    monkeypatch.setattr(kept_trials, "_keep", stopping)
    with pytest.raises(Stop):
        monte_carlo.work(variant(), SEED, NUM_TRIALS, folder, StringIO())
    monkeypatch.setattr(kept_trials, "_keep", real)
    (file,) = folder.iterdir()
    before = file.stat().st_mtime_ns
    (folder / ".123.tmp").write_bytes(b"half of")
    numbers = monte_carlo.work(variant(), SEED, NUM_TRIALS, folder, StringIO())
    assert untimed(numbers) == untimed(done[0]) and file.stat().st_mtime_ns == before
    assert [f.name for f in sorted(folder.glob("*.npz"))] == ["0000000.npz", "0000008.npz"]


@pytest.mark.slow
def test_trials_of_another_seed_are_not_mixed_in(done):
    with pytest.raises(InputError, match="has trials of another variant, seed"):
        monte_carlo.work(variant(), SEED + 1, NUM_TRIALS, done[1])


def kept(folder):
    """The results in a folder of ten trials."""
    (file,) = folder.glob("*.npz")
    with np.load(file) as saved:
        return TrialResult(*(saved[name] for name in TrialResult._fields))


@pytest.mark.slow
def test_the_distribution_is_that_of_the_trials(done):
    numbers, folder = done
    results = kept(folder)
    off = np.linalg.norm((results.estimate - results.truth)[..., :2], axis=-1)
    rmse = np.sqrt(np.mean(off**2, axis=1))
    assert numbers["p50_m"] == pytest.approx(np.median(rmse))
    assert numbers["p50_m"] <= numbers["p95_m"] <= numbers["p99_m"] <= rmse.max()
    assert numbers["position_rmse_m"] == pytest.approx(np.sqrt(np.mean(off**2)))
    assert sum(numbers["histogram"]["runs"]) == numbers["runs"] == NUM_TRIALS
    worst = [one["run"] for one in numbers["worst"]]
    assert worst == np.argsort(-rmse, kind="stable")[: monte_carlo.WORST].tolist()
    assert numbers["largest_m"] == pytest.approx(off.max())


@pytest.mark.slow
def test_trials_that_are_not_finite_are_masked_and_listed(done):
    numbers, folder = done
    results = kept(folder)
    import jax

    estimate = results.estimate.copy()
    estimate[3, 2] = np.nan
    found = monte_carlo.summary(jax.random.key(5), results._replace(estimate=estimate))
    assert found["nonfinite_runs"] == [3] and sum(found["histogram"]["runs"]) == NUM_TRIALS - 1
    assert np.isfinite(found["p99_m"]) and 3 not in [one["run"] for one in found["worst"]]
    estimate[:] = np.nan
    none = monte_carlo.summary(jax.random.key(5), results._replace(estimate=estimate))
    assert none["p50_m"] is None and none["worst"] == []


@pytest.mark.slow
def test_one_trial_is_replayed_alone(done):
    worst = done[0]["worst"][0]
    alone = monte_carlo.replay(variant(), SEED, worst["run"])
    assert alone["position_rmse_m"] == pytest.approx(worst["position_rmse_m"], rel=1e-12)
    np.testing.assert_array_equal(alone["worst"][0]["estimate"], worst["estimate"])


@pytest.mark.slow
def test_picture_and_numbers_are_written_and_kept_trials_are_removed(done, tmp_path, monkeypatch):
    row = {"devices": 1, "seconds": 2.0, "ms_per_scan": 1.0, "peak_mb": 500.0}
    rows = {name: [row | {name: v} for v in values] for name, values in scaling.VARIED.items()}
    rows["steps"] = [{"chain_note": "it failed"}]
    two = {"two_vs_one": 1.9, "rows": [row, row | {"devices": 2}]}
    monkeypatch.setattr(scaling, "compute", lambda *_: rows | {"devices": two})
    monkeypatch.setattr(monte_carlo, "compute", lambda *_: dict(done[0]))
    (tmp_path / "monte_carlo_runs").mkdir()
    assert monte_carlo.main(["--out", str(tmp_path), "--runs", str(NUM_TRIALS)]) == 0
    numbers = json.loads((tmp_path / "monte_carlo.json").read_text())
    keys = "runs diverged nonfinite position_rmse_m p50_m p95_m p99_m seconds seconds_per_scan"
    assert {*keys.split(), "peak_mb", "devices", "scaling"} <= numbers.keys()
    assert (tmp_path / "monte_carlo.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "monte_carlo_runs").exists()


def test_scaling_measures_each_figure_in_its_own_process(monkeypatch):
    asked = []

    def measured(task, cache, arguments, *, num_devices, module, no_split):
        assert no_split
        asked.append((num_devices, arguments["runs"], arguments["steps"], arguments["landmarks"]))
        return {"seconds": 3.0 / num_devices, "devices": num_devices} | arguments

    monkeypatch.setattr(scaling, "run_task", measured)
    numbers = scaling.compute(0)
    assert numbers["devices"]["two_vs_one"] == pytest.approx(2.0)
    for name, values in scaling.VARIED.items():
        assert [one[name] for one in numbers[name]] == list(values)
    assert {one[0] for one in asked} == {1, 2}
    monkeypatch.setattr(scaling, "run_task", lambda *_, **__: {"chain_note": "it failed"})
    none = scaling.compute(0)["devices"]
    assert none == {"two_vs_one": None, "rows": [], "chain_note": "it failed"}


@pytest.mark.timeout(60)
def test_a_task_that_a_module_does_not_have_has_a_note(tmp_path):
    done = filter_benchmark.run_task("none", str(tmp_path), {}, module="experiments.scaling")
    assert "KeyError" in done["none_note"]


def test_trials_that_diverged_are_listed_with_their_keys():
    key = jax.random.key(7)
    zero = np.zeros((3, 2, 3))
    off = zero.copy()
    off[1, 1, 0] = 3.0
    results = TrialResult(
        truth=zero,
        estimate=off,
        cov=np.tile(np.eye(3), (3, 2, 1, 1)),
        dead_reckoning=zero,
        num_updates=np.zeros((3, 2), np.int32),
        num_landmarks=np.zeros(3, np.int32),
        finite=np.ones(3, bool),
        truth_mask=np.ones((3, 2), bool),
        num_steps=np.full(3, 2, np.int32),
    )
    found = monte_carlo.summary(key, results)
    assert found["diverged_runs"] == [1]
    own = jax.random.key_data(jax.random.fold_in(key, 1))
    np.testing.assert_array_equal(found["diverged_keys"], [own])
    none = monte_carlo.summary(key, results._replace(estimate=zero + 1e-3))
    assert none["diverged"] == 0 and none["diverged_keys"].shape == (0, 2)
