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

from jaxslam.cli import main, tune_command, tune_jobs
from jaxslam.core import se2
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import carmen, mrclam, noise_file, tum
from jaxslam.simulation import drives as drives_module
from jaxslam.simulation import trials
from jaxslam.tuning import fitting, losses, parameters

# The command runs in processes of its own, in float32 as users run it, on drives so short and with
# programs so hardly optimised (`conftest`) that starting takes longest.
MAIN = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from jaxslam import cli; sys.exit(cli.main(sys.argv[1:]))"
)
START = 1248272000.125  # [s]
PLACES = {6: (3.0, 1.0), 7: (-2.5, 3.0), 8: (0.5, -2.5), 9: (0.0, 5.0)}
RANGE, BEARING = 0.05, 0.02  # noise of the sightings
ROBOTS, STEPS = 5, 12
KILLS = 2  # of which it must lose nothing
FILES = {"noise.json", "metrics.json", "history.png"}


def write_mrclam(folder, *, robots=ROBOTS, seconds=20.0, reference=True, seed=0):
    """A data set of robots that drive circles, not quite as their wheels say, past landmarks."""
    folder.mkdir(parents=True)
    rng, h = np.random.default_rng(seed), 0.25

    def save(name, rows):
        (folder / name).write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))

    save("Barcodes.dat", [(subject, 10 * subject) for subject in (1, 2, *PLACES)])
    save("Landmark_Groundtruth.dat", [(i, *place, 0, 0) for i, place in PLACES.items()])
    times = (START + np.arange(0.0, seconds, h)).tolist()
    for robot in range(1, robots + 1):
        told = rng.uniform([0.2, -0.1], [0.8, 0.6], (len(times), 2))
        done = told + rng.normal(size=told.shape) * [0.04, 0.08] / np.sqrt(h)
        poses = [np.array([0.0, 0.0, robot])]
        for v, turn in done[:-1] * h:
            step = np.array([v * np.cos(turn / 2), v * np.sin(turn / 2), turn])
            poses.append(np.asarray(se2.compose(poses[-1], step)))
        save(f"Robot{robot}_Odometry.dat", [(t, *x) for t, x in zip(times, told, strict=True)])
        if reference:
            known = [(t, *x) for t, x in zip(times, poses, strict=True)]
            save(f"Robot{robot}_Groundtruth.dat", known)
        seen = []
        for t, pose in list(zip(times, poses, strict=True))[2::2]:
            for i in rng.choice(list(PLACES), 2, replace=False).tolist():
                dx, dy = np.array(PLACES[i]) - pose[:2]
                bearing = np.arctan2(dy, dx) - pose[2] + rng.normal(0, BEARING)
                seen.append((t, 10 * i, np.hypot(dx, dy) + rng.normal(0, RANGE), bearing))
        save(f"Robot{robot}_Measurement.dat", seen)
    return folder


def begin(place, out, *more):
    """Start a tuning in a process of its own: some robots a step, judged by another one."""
    robots = [place / "drives" / f"Robot{i}" for i in range(1, ROBOTS + 1)]
    given = ["tune", *robots[:-1], "--test", robots[-1], "--batch", ROBOTS - 2]
    given += ["--steps", STEPS, "--seed", 3, "--freeze", "wall", "--out", out, *more]
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


def evaluations(out):
    """Evaluations that the checkpoint of a tuning holds; 0 without one."""
    try:
        with open(out / tune_command.CHECKPOINT_FILE, "rb") as file, np.load(file) as kept:
            return int(kept["leaf0"])
    except FileNotFoundError:
        return 0


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
    """A tuning that was killed again and again, then interrupted; and how it went on."""
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
    assert (done.out / "history.png").read_bytes().startswith(b"\x89PNG")


def test_it_finds_a_better_noise(done):
    numbers, before = done.numbers, done.numbers["before"]
    assert numbers["loss"] < before["loss"] - 0.1
    assert abs(np.log(numbers["nees"])) < abs(np.log(before["nees"]))
    assert numbers["diverged"] == before["diverged"] == 0 and numbers["skipped"] == 0
    assert numbers["evaluations"] == STEPS + 1 and 0 < numbers["best"] <= STEPS
    assert numbers["judged_on"] == "held-out runs" and numbers["runs"] == 1
    start = NoiseParams.for_landmark_sensor()
    assert before["noise"]["bearing"] == pytest.approx(float(start.bearing_std))
    assert BEARING / 1.5 < numbers["noise"]["bearing"] < float(start.bearing_std)
    assert numbers["noise"]["wall"] == pytest.approx(float(start.wall_angle_std)), "was frozen"


def test_its_noise_is_that_of_its_numbers_and_goes_back_in(done):
    found = noise_file.read(done.out / "noise.json", NoiseParams.for_landmark_sensor())
    assert parameters.param_names(found)[:2] == ("odometry[0]", "odometry[1]")
    for name, value in found._asdict().items():
        told = done.numbers["noise"][name]
        assert (value is None) == (told is None)
        if value is not None:
            np.testing.assert_allclose(value, told, rtol=1e-6)
    given = (), (), False, done.out / "noise.json", losses.pose_mse
    job = tune_jobs.recorded_job([done.place / "drives"], *given)
    assert job().noise._asdict().keys() == found._asdict().keys()
    for a, b in zip(*map(jax.tree.leaves, (job().noise, found)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_it_says_how_sure_it_is(done):
    errors = done.numbers["standard_errors"]
    assert errors.keys() == set(parameters.param_names(NoiseParams.for_landmark_sensor()))
    assert 0.0 < errors["bearing"] < 0.5 and errors["wall"] is None
    unsure = [name for name, x in errors.items() if name != "wall" and (x is None or x > 0.5)]
    assert len(done.numbers["warnings"]) == bool(unsure)
    for name in unsure:
        assert name in done.numbers["warnings"][0]


def test_it_shows_how_far_it_is_and_a_summary(done):
    assert f"{STEPS + 1}/{STEPS + 1}" in done.errors and "heldout=" in done.errors
    said = done.said.splitlines()
    assert said[0] == f"{ROBOTS - 1} logs, {4 * 39} steps; held out: 1"
    table = {line.split()[0]: line.split()[1:] for line in said if line.startswith("  ")}
    assert float(table["loss"][0]) == pytest.approx(done.numbers["before"]["loss"], rel=1e-3)
    assert float(table["loss"][1]) == pytest.approx(done.numbers["loss"], rel=1e-3)
    assert float(table["bearing"][1]) == pytest.approx(done.numbers["noise"]["bearing"], rel=1e-3)
    assert table["bearing"][2] == f"{done.numbers['standard_errors']['bearing']:.0%}"
    assert said[-1].startswith(f"results: {done.out}") and len(said) < 24


def test_a_kill_loses_no_evaluation(stopped):
    assert 0 < stopped.history[0] and stopped.history[-1] < STEPS
    assert (np.diff(stopped.history) > 0).all()


def test_an_interrupt_leaves_the_best_so_far_and_says_how_to_go_on(stopped):
    said, errors = stopped.interrupted
    assert f"resuming after evaluation {stopped.history[-1]} of {STEPS + 1}" in said
    line = errors.splitlines()[-1]
    assert line.startswith("jaxslam: interrupted after ") and "the same command resumes" in line
    assert f" of {STEPS + 1} evaluations; {stopped.out / 'noise.json'} holds" in line
    assert "Traceback" not in errors
    assert stopped.found == {"noise.json", tune_command.CHECKPOINT_FILE}
    best = jax.tree.leaves(stopped.best)
    assert all(np.isfinite(x).all() and (np.asarray(x) > 0).all() for x in best)
    assert float(stopped.best.bearing_std) != pytest.approx(
        float(NoiseParams.for_landmark_sensor().bearing_std)
    )


@pytest.fixture
def refused(tmp_path, capsys, monkeypatch):
    """Function that runs bad arguments, checks how they are refused, and returns the line."""
    monkeypatch.setattr(tune_command, "keep_compiled", lambda: None)
    monkeypatch.setattr(fitting, "gradients", lambda *_: pytest.fail("work has begun"))

    def refuse(*arguments, out=None):
        fresh = out is None
        out = tmp_path / "results" if fresh else out
        before = {} if fresh else contents(out)
        assert main.main(["tune", *map(str, arguments), "--out", str(out)]) == 2
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith("jaxslam: error: ")
        assert not out.exists() if fresh else contents(out) == before
        assert not list(tmp_path.glob(".unfinished*"))
        return line.removeprefix("jaxslam: error: ")

    return refuse


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


@pytest.mark.parametrize(
    "change, field",
    [
        (["--steps", STEPS + 1], "steps"),
        (["--seed", 4], "seed"),
        (["--freeze", "range"], "frozen"),
        (["--loss", "localisation"], "loss"),
        (["--patience", 3], "patience"),
        (["--batch", 2], "batch"),
        (["--test"], "heldout"),
    ],
)
def test_another_tuning_does_not_go_on_in_the_same_folder(stopped, done, refused, change, field):
    drives = [done.place / "drives" / f"Robot{i}" for i in range(1, ROBOTS + 1)]
    given = {"--test": drives[-1:], "--batch": [3], "--steps": [STEPS], "--seed": [3]}
    given |= {"--freeze": ["wall"], change[0]: change[1:]}
    options = [x for name, values in given.items() if values for x in (name, *values)]
    with jax.enable_x64(False):
        line = refused(*drives[:-1], *options, out=stopped.out)
    assert line.startswith(
        f"{stopped.out / tune_command.CHECKPOINT_FILE}: {field}: belongs to another run; "
    )
    assert "--out" in line


def test_what_was_stopped_ends_as_what_was_not(stopped, done):
    """The last test of a stopped tuning: it goes on to the end."""
    said, _ = end(begin(done.place, stopped.out))
    assert "resuming after evaluation" in said
    assert {file.name for file in stopped.out.iterdir()} >= FILES
    assert not (stopped.out / tune_command.CHECKPOINT_FILE).exists()
    assert (stopped.out / "noise.json").read_bytes() == (done.out / "noise.json").read_bytes()
    numbers = json.loads((stopped.out / "metrics.json").read_text())
    assert numbers | {"seconds": 0} == done.numbers | {"seconds": 0}


def scan(t, pose, beams=5, range=2.0):
    numbers = " ".join(f"{x:.3f}" for x in [range] * beams + [*pose] * 2)
    return f"FLASER {beams} {numbers} {t} host {t}\n"


def write_carmen(path, **options):
    path.write_text("".join(scan(t + 0.5, (0.1 * t, 0, 0), **options) for t in range(6)))
    return path


@pytest.fixture
def log(tmp_path):
    return write_carmen(tmp_path / "a.clf")


@pytest.fixture
def reference(tmp_path):
    tum.write(tmp_path / "a.tum", np.arange(6) + 0.5, np.zeros((6, 3)))
    return tmp_path / "a.tum"


@pytest.fixture
def drives(tmp_path):
    return write_mrclam(tmp_path / "drives", robots=1, seconds=4.0)


@pytest.mark.parametrize(
    "arguments, told",
    [
        (["--batch", 0], "--batch: 0 is not between 1 and"),
        (["--steps", 0], "--steps: 0 is not between 1 and"),
        (["--patience", 0], "--patience: 0 is not between 1 and"),
        (["--seed", -1], "--seed: -1 is not between 0 and"),
        (["--runs", 0], "--runs: 0 is not between 1 and"),
        (["--heldout", -1], "--heldout: -1 is not between 0 and"),
        (["--world", "nowhere"], "--world: "),
        (["--freeze", "rnage"], "--freeze: no parameter is called 'rnage'; known: odometry[0], "),
        (["--freeze", "odometry[4]"], "--freeze: no parameter is called 'odometry[4]'"),
        (["--freeze", *NoiseParams._fields], "--freeze: all parameters are frozen"),
        (["--test", "some.clf"], "--test, --reference: apply to logs only"),
        (["--reference", "some.tum"], "--test, --reference: apply to logs only"),
        (["missing.clf"], "missing.clf: does not exist"),
        (["missing/Robot1"], "missing/Robot1: does not exist"),
        (["--noise", "missing.json"], "missing.json: does not exist"),
    ],
)
def test_bad_options(refused, arguments, told):
    assert refused(*arguments).startswith(told)


def noise_with(**changes):
    fields = {
        name: np.asarray(x).tolist()
        for name, x in NoiseParams.for_landmark_sensor()._asdict().items()
    }
    fields = {name: x for name, x in (fields | changes).items() if x is not None}
    return {"format": "jaxslam-noise", "version": 1, "noise": fields}


@pytest.mark.parametrize(
    "content, told",
    [
        (noise_with(what=1.0), "what: unknown field"),
        (noise_with(wall=None), "wall: missing"),
        (noise_with(range=0.0), "range: 0.0 is not positive"),
        (noise_with(range=-1.0), "range: -1.0 is not positive"),
        (noise_with(odometry=[1, 1, 1, float("nan")]), "odometry: [1.0, 1.0, 1.0, nan] is not"),
        (noise_with() | {"version": 2}, "version: 2 instead of 1"),
    ],
)
def test_a_bad_noise_to_start_from(refused, tmp_path, drives, content, told):
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(content))
    assert refused(drives, "--noise", path).startswith(f"{path}: {told}")


def test_a_noise_to_start_from_is_not_written_over(tmp_path, capsys, drives):
    noise_file.write(tmp_path / "noise.json", NoiseParams.for_landmark_sensor())
    given = [
        "tune",
        drives,
        "--noise",
        tmp_path / "noise.json",
        "--out",
        tmp_path / "drives" / "..",
    ]
    assert main.main([*map(str, given)]) == 2
    assert "would be replaced" in capsys.readouterr().err
    assert (tmp_path / "noise.json").is_file()


@pytest.mark.parametrize("loss", ["calibrated", "localisation"])
def test_a_loss_that_needs_the_truth_of_a_log_without(refused, log, tmp_path, loss):
    line = refused(log, "--loss", loss)
    assert line.startswith(
        f"{log}: has no reference, which the loss {loss} needs; give --reference"
    )
    blind = write_mrclam(tmp_path / "blind", robots=2, seconds=4.0, reference=False)
    line = refused(blind, "--loss", loss)
    assert line.startswith(f"{blind / 'Robot1'}: has no reference") and "--loss likelihood" in line


def test_references_are_as_many_as_logs_and_on_their_clock(refused, log, reference, tmp_path):
    assert refused(log, log, "--reference", reference).startswith(
        "--reference: 1 files for 2 logs; give one for each log"
    )
    assert refused(log, "--test", log, "--reference", reference).startswith("--reference: 1 files")
    late = tmp_path / "late.tum"
    tum.write(late, 1e6 + np.arange(6), np.zeros((6, 3)))
    line = refused(log, "--test", log, "--reference", reference, late)
    assert line.startswith(f"{late}: has no pose at the time of a scan; compare their clocks")


def test_logs_of_one_kind_and_scanner_are_tuned_together(refused, log, drives, reference, tmp_path):
    apart = "LOG: laser logs and MRCLAM data sets are tuned separately"
    assert refused(log, drives).startswith(apart)
    assert refused(drives, "--test", log).startswith(apart)
    assert refused(drives, "--reference", reference).startswith("--reference: MRCLAM data sets co")
    other = write_carmen(tmp_path / "b.clf", beams=7)
    line = refused(log, other, "--reference", reference, reference)
    assert line.startswith(f"{other}: has another scanner than {log}; tune them separately")
    assert carmen.read(other).lidar != carmen.read(log).lidar


def test_a_robot_that_is_not_there(refused, drives):
    assert refused(drives / "Robot7").startswith(f"{drives}: has no robot 7; choose from 1")


def test_a_data_set_or_its_robots_can_be_named(drives):
    assert (
        tune_jobs.mrclam_robots(drives)
        == [(drives, i) for i in mrclam.robots(drives)]
        == [(drives, 1)]
    )
    for name in ("Robot12", "Robot12_Odometry.dat"):
        assert tune_jobs.mrclam_robots(drives / name) == [(drives, 12)]
    assert tune_jobs.mrclam_robots(drives.parent / "Robot1") is None
    assert tune_jobs.mrclam_robots(drives / "Barcodes.dat") is None


def test_a_broken_checkpoint(refused, drives, tmp_path):
    out = tmp_path / "some"
    out.mkdir()
    (out / tune_command.CHECKPOINT_FILE).write_bytes(b"what")
    line = refused(drives, out=out)
    assert (
        line.startswith(f"{out / tune_command.CHECKPOINT_FILE}: is no checkpoint (")
        and "remove it" in line
    )


def test_an_interrupt_before_the_first_evaluation_leaves_nothing(
    tmp_path, capsys, monkeypatch, drives
):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(tune_command, "keep_compiled", lambda: None)
    monkeypatch.setattr(fitting, "gradients", stop)
    assert main.main(["tune", str(drives), "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "jaxslam: interrupted, nothing written"
    assert [file.name for file in tmp_path.iterdir()] == ["drives"]


def test_an_interrupt_of_the_judgement_says_that_the_noise_is_there(
    tmp_path, capsys, monkeypatch, drives
):
    def stop(*_, **__):
        raise KeyboardInterrupt

    values = np.array([1.0]), np.full((1, 8), 0.5)
    monkeypatch.setattr(tune_command, "keep_compiled", lambda: None)
    monkeypatch.setattr(fitting, "gradients", lambda *_: values)
    monkeypatch.setattr(fitting, "values", stop)
    out = tmp_path / "out"
    assert main.main(["tune", str(drives), "--steps", "2", "--out", str(out)]) == 130
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(
        f"jaxslam: interrupted after all evaluations; {out / 'noise.json'} holds"
    )
    assert {file.name for file in out.iterdir()} == {"noise.json", tune_command.CHECKPOINT_FILE}
    assert evaluations(out) == 3


def test_simulated_drives_are_parted_into_those_to_tune_on_and_the_others(monkeypatch):
    asked = []

    def simulate(*given, runs, steps):
        asked.append((given[-1].shape[1], steps))
        return {"run": np.arange(runs)}

    monkeypatch.setattr(drives_module, "num_scans_of_drive", lambda *_: 7)
    monkeypatch.setattr(trials, "simulate_episodes", simulate)
    for heldout, test in ((2, [3, 4]), (0, None)):
        job = tune_jobs.simulated_job("office", 3, heldout, None, 0)()
        np.testing.assert_array_equal(job.train["run"], [0, 1, 2])
        assert (job.test if test is None else job.test["run"].tolist()) == test
        assert job.noise.feature_std_scale == NoiseParams.for_laser_log().feature_std_scale
    assert asked == [(2, 7)] * 2
