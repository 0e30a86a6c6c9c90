import json
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from tune_logs import BEARING, evaluations, write_mrclam

from jaxslam.cli import tune_command, tune_jobs
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import noise_file
from jaxslam.tuning import losses

pytestmark = pytest.mark.slow  # all that share one tuning

# The command runs in processes of its own, in float32 as users run it, on drives so short and with
# programs so little optimised (`conftest`) that starting takes longest.
MAIN = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from jaxslam.cli import main; sys.exit(main.main(sys.argv[1:]))"
)
ROBOTS, UPDATES = 5, 12
KILLS = 2  # times that the command is killed, without losing an evaluation
FILES = {"noise.json", "metrics.json", "report.png", "history.png"}
FILE_KEYS = ["odometry", "range", "bearing", "scale", "wall", "alignment"]


def begin(place, out, *more):
    """Start a tuning in a process of its own: minibatches of robots, another one held out."""
    robots = [place / "drives" / f"Robot{i}" for i in range(1, ROBOTS + 1)]
    given = ["tune", *robots[:-1], "--test", robots[-1], "--batch", ROBOTS - 2]
    given += ["--updates", UPDATES, "--seed", 3, "--freeze", "wall_angle_std", "--out", out, *more]
    keep = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    flags = os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=1")  # compiles once
    return subprocess.Popen(
        [sys.executable, "-c", MAIN, *map(str, given)],
        env=keep | {"XDG_CACHE_HOME": str(place / "cache"), "XLA_FLAGS": flags},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(process, code=0):
    """Output and errors of a process that ended with this code."""
    said, errors = process.communicate(timeout=300)
    assert process.returncode == code, errors
    return said, errors


def wait(process, out, beyond):
    """Wait until a tuning has done more evaluations than those, or has ended."""
    until = time.monotonic() + 300
    while evaluations(out) <= beyond and process.poll() is None:
        assert time.monotonic() < until
        time.sleep(0.005)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A tuning from beginning to end."""
    place = tmp_path_factory.mktemp("tuning")
    write_mrclam(place / "drives")
    said, errors = end(begin(place, place / "whole"))
    numbers = json.loads((place / "whole" / "metrics.json").read_text())
    return SimpleNamespace(
        place=place, out=place / "whole", said=said, errors=errors, numbers=numbers
    )


@pytest.fixture(scope="module")
def stopped(done):
    """A tuning that was killed repeatedly, then interrupted."""
    out, rng, history = done.place / "a" / "stopped", np.random.default_rng(7), []
    for _ in range(KILLS):
        process = begin(done.place, out)
        wait(process, out, evaluations(out))
        time.sleep(rng.uniform(0.0, 0.05))
        process.kill()
        process.communicate()
        history.append(evaluations(out))
    process = begin(done.place, out)
    wait(process, out, evaluations(out))
    process.send_signal(signal.SIGINT)
    interrupted = end(process, 130)
    found = {file.name for file in out.iterdir() if not file.name.startswith(".")}
    best = noise_file.read(out / "noise.json", NoiseParams.for_landmark_sensor())
    return SimpleNamespace(
        out=out, history=history, interrupted=interrupted, found=found, best=best
    )


def test_it_writes_its_files_and_nothing_else(done):
    assert {file.name for file in done.out.iterdir()} == FILES
    assert {file.name for file in done.place.iterdir()} == {"drives", "whole", "cache"}
    for name in ("history.png", "report.png"):
        assert (done.out / name).read_bytes().startswith(b"\x89PNG")


def test_tuning_improves_loss_and_consistency(done):
    numbers, before = done.numbers, done.numbers["before"]
    assert numbers["loss"] < before["loss"] - 0.1
    assert abs(np.log(numbers["nees"])) < abs(np.log(before["nees"]))
    assert numbers["diverged"] == before["diverged"] == 0 and numbers["skipped"] == 0
    assert numbers["evaluations"] == UPDATES + 1 and 0 < numbers["best"] <= UPDATES
    assert numbers["judged_on"] == "held-out runs" and numbers["runs"] == 1
    start = NoiseParams.for_landmark_sensor()
    assert before["noise"]["bearing"] == pytest.approx(float(start.bearing_std))
    assert BEARING / 1.5 < numbers["noise"]["bearing"] < float(start.bearing_std)
    assert numbers["noise"]["wall"] == pytest.approx(float(start.wall_angle_std)), "was frozen"


def test_noise_json_agrees_with_metrics_json_and_can_be_read_back(done):
    found = noise_file.read(done.out / "noise.json", NoiseParams.for_landmark_sensor())
    numbers = done.numbers["noise"]
    assert list(numbers) == FILE_KEYS
    assert list(done.numbers["before"]["noise"]) == list(numbers)
    for name, value in noise_file.to_keys(found).items():
        assert (value is None) == (numbers[name] is None)
        if value is not None:
            np.testing.assert_allclose(value, numbers[name], rtol=1e-6)
    content = json.loads((done.out / "noise.json").read_text())["noise"]
    assert list(content) == FILE_KEYS[:5]
    task = tune_jobs.recorded_task(
        [done.place / "drives"],
        (),
        (),
        done.out / "noise.json",
        match_scans=False,
        loss=losses.pose_mse,
    )
    assert task.load().params._asdict().keys() == found._asdict().keys()
    for a, b in zip(*map(jax.tree.leaves, (task.params, found)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_standard_errors_and_warnings_are_written(done):
    errors = done.numbers["standard_errors"]
    assert list(errors) == [f"odometry[{i}]" for i in range(4)] + FILE_KEYS[1:5]
    assert 0.0 < errors["bearing"] < 0.5 and errors["wall"] is None
    unsure = [name for name, x in errors.items() if name != "wall" and (x is None or x > 0.5)]
    unknown = [line for line in done.numbers["warnings"] if line.startswith("not identifiable")]
    assert len(unknown) == bool(unsure)
    for name in unsure:
        assert noise_file.name_of(name) in done.numbers["warnings"][0]


def test_consistency_parameters_and_correlations_are_written(done):
    numbers = done.numbers
    before, after = (numbers["consistency"][when] for when in ("before", "after"))
    assert abs(np.log(after["nis_per_dof"])) < abs(np.log(before["nis_per_dof"]))
    assert before["nis_count"] == after["nis_count"] > 30
    assert after["nees_per_dof"] == pytest.approx(numbers["nees"], rel=1e-4)
    assert list(after["autocorrelation"]) == ["heading", "to the left", "ahead"]
    for series in after["autocorrelation"].values():
        assert series[0] == pytest.approx(1.0) and len(series) >= 2
    low, high = after["nis_per_dof_interval"]
    assert low < after["nis_per_dof"] < high and 0.0 <= after["ljung_box_p"] <= 1.0
    assert after["verdicts"] and before["verdicts"]

    errors, parameters = numbers["standard_errors"], numbers["parameters"]
    assert list(parameters) == list(errors)
    for name, each in parameters.items():
        field, _, index = name.partition("[")
        found, start = numbers["noise"][field], numbers["before"]["noise"][field]
        pick = int(index[:-1]) if index else None
        assert each["value"] == pytest.approx(found if pick is None else found[pick])
        assert each["before"] == pytest.approx(start if pick is None else start[pick])
        assert each["frozen"] == (name == "wall")
        if errors[name] is None:
            assert each["interval"] is None
        else:
            ratio = np.exp(1.959964 * errors[name])
            expected = [each["value"] / ratio, each["value"] * ratio]
            assert each["interval"] == pytest.approx(expected)
    names = numbers["correlations"]["names"]
    assert names == [name for name in errors if name != "wall"]
    matrix = numbers["correlations"]["matrix"]
    for i, name in enumerate(names):
        assert (matrix[i][i] is None) == (errors[name] is None)
        for j in range(len(names)):
            assert matrix[i][j] == matrix[j][i] or matrix[i][j] == pytest.approx(matrix[j][i])
            assert matrix[i][j] is None or abs(matrix[i][j]) <= 1.0 + 1e-6


def test_progress_and_a_summary_are_printed(done):
    assert f"{UPDATES + 1}/{UPDATES + 1}" in done.errors and "heldout=" in done.errors
    said = done.said.splitlines()
    assert said[0] == f"{ROBOTS - 1} logs, {4 * 39} steps; held out: 1"
    table = {line.split()[0]: line.split()[1:] for line in said if line.startswith("  ")}
    assert float(table["loss"][0]) == pytest.approx(done.numbers["before"]["loss"], rel=1e-3)
    assert float(table["loss"][1]) == pytest.approx(done.numbers["loss"], rel=1e-3)
    assert float(table["bearing_std"][1]) == pytest.approx(
        done.numbers["noise"]["bearing"], rel=1e-3
    )
    assert table["bearing_std"][2] == f"{done.numbers['standard_errors']['bearing']:.0%}"
    assert said[-1].startswith(f"results: {done.out}") and len(said) < 28
    found = [line.removeprefix("filter: ") for line in said if line.startswith("filter: ")]
    assert found == done.numbers["consistency"]["after"]["verdicts"][:3]


def test_no_evaluation_is_lost_when_the_process_is_killed(stopped):
    assert 0 < stopped.history[0] and stopped.history[-1] < UPDATES
    assert (np.diff(stopped.history) > 0).all()


def test_an_interrupt_leaves_the_best_so_far_and_says_how_to_resume(stopped):
    said, errors = stopped.interrupted
    assert f"resuming after evaluation {stopped.history[-1]} of {UPDATES + 1}" in said
    line = errors.splitlines()[-1]
    assert line.startswith("jaxslam: interrupted after ") and "the same command resumes" in line
    assert f" of {UPDATES + 1} evaluations; {stopped.out / 'noise.json'} holds" in line
    assert "Traceback" not in errors
    assert stopped.found == {"noise.json", tune_command.CHECKPOINT_FILE}
    best = jax.tree.leaves(stopped.best)
    assert all(np.isfinite(x).all() and (np.asarray(x) > 0).all() for x in best)
    assert float(stopped.best.bearing_std) != pytest.approx(
        float(NoiseParams.for_landmark_sensor().bearing_std)
    )


@pytest.mark.parametrize(
    "change, field",
    [
        (["--updates", UPDATES + 1], "updates"),
        (["--seed", 4], "seed"),
        (["--freeze", "range_std"], "frozen"),
        (["--loss", "pose_mse"], "loss"),
        (["--patience", 3], "patience"),
        (["--batch", 2], "batch"),
        (["--test"], "heldout"),
    ],
)
def test_another_tuning_does_not_resume_in_the_same_folder(
    stopped, done, refused_by_tune, change, field
):
    drives = [done.place / "drives" / f"Robot{i}" for i in range(1, ROBOTS + 1)]
    given = {"--test": drives[-1:], "--batch": [3], "--updates": [UPDATES], "--seed": [3]}
    given |= {"--freeze": ["wall_angle_std"], change[0]: change[1:]}
    options = [x for name, values in given.items() if values for x in (name, *values)]
    with jax.enable_x64(False):
        line = refused_by_tune(*drives[:-1], *options, out=stopped.out)
    assert line.startswith(
        f"{stopped.out / tune_command.CHECKPOINT_FILE}: {field}: belongs to another run; "
    )
    assert "--out" in line


def test_a_resumed_tuning_ends_as_an_uninterrupted_one(stopped, done):
    """The last test of a stopped tuning: it resumes to the end."""
    said, _ = end(begin(done.place, stopped.out))
    assert "resuming after evaluation" in said
    assert {file.name for file in stopped.out.iterdir()} >= FILES
    assert not (stopped.out / tune_command.CHECKPOINT_FILE).exists()
    assert (stopped.out / "noise.json").read_bytes() == (done.out / "noise.json").read_bytes()
    numbers = json.loads((stopped.out / "metrics.json").read_text())
    assert numbers | {"seconds": 0} == done.numbers | {"seconds": 0}
