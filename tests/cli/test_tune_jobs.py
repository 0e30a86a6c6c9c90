"""What `jaxslam tune` refuses before any work starts, and the tasks that it makes of files."""

import json

import numpy as np
import pytest
from tune_logs import LANDMARKS, evaluations, write_carmen, write_mrclam

from jaxslam.cli import main, tune_command, tune_jobs
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import carmen, mrclam, noise_file, tum
from jaxslam.simulation import drives as drives_module
from jaxslam.simulation import trial_episodes
from jaxslam.tuning import fitting, losses


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--batch", 0], "--batch: 0 is not between 1 and"),
        (["--updates", 0], "--updates: 0 is not between 1 and"),
        (["--patience", 0], "--patience: 0 is not between 1 and"),
        (["--patience", 3, "--heldout", 0], "--patience: needs held-out runs"),
        (["--seed", -1], "--seed: -1 is not between 0 and"),
        (["--trials", 0], "--trials: 0 is not between 1 and"),
        (["--heldout", -1], "--heldout: -1 is not between 0 and"),
        (["--world", "nowhere"], "--world: "),
        (["--freeze", "rnage"], "--freeze: no parameter is called 'rnage'; known: odometry_coeff"),
        (["--freeze", "range_std[0]"], "--freeze: no parameter is called 'range_std[0]'"),
        (["--freeze", *NoiseParams._fields], "--freeze: all parameters are frozen"),
        (["--test", "some.clf"], "--test, --reference: apply to logs only"),
        (["--reference", "some.tum"], "--test, --reference: apply to logs only"),
        (["missing.clf"], "missing.clf: does not exist"),
        (["missing/Robot1"], "missing/Robot1: does not exist"),
        (["--noise", "missing.json"], "missing.json: does not exist"),
    ],
)
def test_bad_options_are_refused(refused_by_tune, arguments, message):
    assert refused_by_tune(*arguments).startswith(message)


def noise_with(**changes):
    given = noise_file.to_keys(NoiseParams.for_landmark_sensor())
    fields = {name: np.asarray(x).tolist() for name, x in given.items()}
    fields = {name: x for name, x in (fields | changes).items() if x is not None}
    return {"format": "jaxslam-noise", "version": 1, "noise": fields}


@pytest.mark.parametrize(
    "content, message",
    [
        (noise_with(what=1.0), "what: unknown field"),
        (noise_with(wall=None), "wall: missing"),
        (noise_with(range=0.0), "range: 0.0 is not positive"),
        (noise_with(range=-1.0), "range: -1.0 is not positive"),
        (noise_with(odometry=[1, 1, 1, float("nan")]), "odometry: [1.0, 1.0, 1.0, nan] is not"),
        (noise_with() | {"version": 2}, "version: 2 instead of 1"),
    ],
)
def test_a_bad_noise_file_is_refused(refused_by_tune, tmp_path, drives, content, message):
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(content))
    assert refused_by_tune(drives, "--noise", path).startswith(f"{path}: {message}")


def test_the_initial_noise_file_is_not_overwritten(tmp_path, capsys, drives):
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


@pytest.mark.parametrize("loss", ["pose_nll", "pose_mse"])
def test_a_loss_that_needs_truth_is_refused_for_a_log_without_reference(
    refused_by_tune, log, tmp_path, loss
):
    line = refused_by_tune(log, "--loss", loss)
    assert line.startswith(
        f"{log}: has no reference, which the loss {loss} needs; give --reference"
    )
    blind = write_mrclam(tmp_path / "blind", robots=2, seconds=4.0, reference=False)
    line = refused_by_tune(blind, "--loss", loss)
    assert (
        line.startswith(f"{blind / 'Robot1'}: has no reference") and "--loss innovation_nll" in line
    )


def test_references_are_as_many_as_logs_and_on_their_clock(
    refused_by_tune, log, reference, tmp_path
):
    assert refused_by_tune(log, log, "--reference", reference).startswith(
        "--reference: 1 files for 2 logs; give one for each log"
    )
    assert refused_by_tune(log, "--test", log, "--reference", reference).startswith(
        "--reference: 1 files"
    )
    late = tmp_path / "late.tum"
    tum.write(late, 1e6 + np.arange(6), np.zeros((6, 3)))
    line = refused_by_tune(log, "--test", log, "--reference", reference, late)
    assert line.startswith(f"{late}: has no pose at the time of a scan; compare their clocks")


def test_logs_of_one_kind_and_scanner_are_tuned_together(
    refused_by_tune, log, drives, reference, tmp_path
):
    apart = "LOG: laser logs and MRCLAM data sets are tuned separately"
    assert refused_by_tune(log, drives).startswith(apart)
    assert refused_by_tune(drives, "--test", log).startswith(apart)
    assert refused_by_tune(drives, "--reference", reference).startswith(
        "--reference: MRCLAM data sets co"
    )
    other = write_carmen(tmp_path / "b.clf", beams=7)
    line = refused_by_tune(log, other, "--reference", reference, reference)
    assert line.startswith(f"{other}: has another scanner than {log}; tune them separately")
    assert carmen.read(other).lidar != carmen.read(log).lidar


def test_an_unknown_robot_is_refused(refused_by_tune, drives):
    assert refused_by_tune(drives / "Robot7").startswith(f"{drives}: has no robot 7; choose from 1")


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


def test_a_broken_checkpoint_is_refused(refused_by_tune, drives, tmp_path):
    out = tmp_path / "some"
    out.mkdir()
    (out / tune_command.CHECKPOINT_FILE).write_bytes(b"what")
    line = refused_by_tune(drives, out=out)
    assert (
        line.startswith(f"{out / tune_command.CHECKPOINT_FILE}: is no checkpoint (")
        and "remove it" in line
    )


def test_an_interrupt_before_the_first_evaluation_leaves_nothing(
    tmp_path, capsys, monkeypatch, drives
):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(tune_command, "enable_caches", lambda: None)
    monkeypatch.setattr(fitting, "gradients_of", stop)
    assert main.main(["tune", str(drives), "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "jaxslam: interrupted, nothing written"
    assert [file.name for file in tmp_path.iterdir()] == ["drives"]


def test_a_tuning_that_has_nothing_to_minimise_is_one_line(tmp_path, capsys, monkeypatch, drives):
    values = np.array([np.nan]), np.full((1, 8), np.nan)
    monkeypatch.setattr(tune_command, "enable_caches", lambda: None)
    monkeypatch.setattr(fitting, "gradients_of", lambda *_: values)
    assert main.main(["tune", str(drives), "--out", str(tmp_path / "out")]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "the loss and gradient of none of 1 sequences are finite; look for" in last


def test_an_interrupt_during_the_evaluation_says_where_the_noise_is(
    tmp_path, capsys, monkeypatch, drives
):
    def stop(*_, **__):
        raise KeyboardInterrupt

    values = np.array([1.0]), np.full((1, 8), 0.5)
    monkeypatch.setattr(tune_command, "enable_caches", lambda: None)
    monkeypatch.setattr(fitting, "gradients_of", lambda *_: values)
    monkeypatch.setattr(tune_command, "filter_with_statistics", stop)
    out = tmp_path / "out"
    assert main.main(["tune", str(drives), "--updates", "2", "--out", str(out)]) == 130
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(
        f"jaxslam: interrupted after all evaluations; {out / 'noise.json'} holds"
    )
    assert {file.name for file in out.iterdir()} == {"noise.json", tune_command.CHECKPOINT_FILE}
    assert evaluations(out) == 3


def test_simulated_trials_are_split_into_training_and_heldout_ones(monkeypatch):
    asked = []

    def simulate(*given, num_trials, num_scans):
        asked.append((given[-1].shape[1], num_scans))
        return {"trial": np.arange(num_trials)}

    monkeypatch.setattr(drives_module, "num_scans_of_drive", lambda *_: 7)
    monkeypatch.setattr(trial_episodes, "simulate_episodes", simulate)
    for heldout, test in ((2, [3, 4]), (0, None)):
        job = tune_jobs.simulated_task("office", 3, heldout, None, 0).load()
        np.testing.assert_array_equal(job.train["trial"], [0, 1, 2])
        assert (job.test if test is None else job.test["trial"].tolist()) == test
        assert job.params.feature_std_scale == NoiseParams.for_laser_log().feature_std_scale
    assert asked == [(2, 7)] * 2


def test_a_parameter_that_is_left_to_tune_must_be_one_of_the_task(refused_by_tune, drives):
    """All but the factor on scan matching are frozen, and no scans are matched."""
    rest = [name for name in NoiseParams._fields if name != "scan_match_std_scale"]
    assert refused_by_tune(drives, "--freeze", *rest).startswith(
        "--freeze: all parameters are frozen"
    )
    assert refused_by_tune("--freeze", *rest).startswith("--freeze: all parameters are frozen")


def test_noise_without_scan_matching_is_refused_for_matched_scans(refused_by_tune, log, tmp_path):
    noise_file.write(tmp_path / "wheels.json", NoiseParams.for_laser_log())
    line = refused_by_tune(log, "--loss", "innovation_nll", "--noise", tmp_path / "wheels.json")
    assert line.startswith(f"{tmp_path / 'wheels.json'}: alignment: missing")


def test_heldout_episodes_are_padded_to_the_features_of_the_others(tmp_path):
    """Their measurements a step differ in number."""
    few = write_mrclam(tmp_path / "few", robots=1, seconds=4.0)
    many = write_mrclam(tmp_path / "many", robots=1, seconds=4.0)
    path = many / "Robot1_Measurement.dat"
    rows = path.read_text().splitlines()
    time, _, *rest = rows[0].split()
    extra = [" ".join([time, str(10 * i), *rest]) for i in LANDMARKS]
    path.write_text("\n".join(extra + rows) + "\n")
    task = tune_jobs.recorded_task(
        [few], [many], (), None, match_scans=False, loss=losses.innovation_nll
    )
    job = task.load()
    assert job.train.features.valid.shape[2] == job.test.features.valid.shape[2] > 2
    assert job.train.features.valid.sum() > 0 and not job.train.features.valid[..., 2:].any()
    assert (job.train.landmark_ids[..., 2:] == -1).all()
