import json

import jax
import numpy as np
import pytest

from experiments import damaged_drives, drive_records, hurt_logs, stress
from experiments.damaged_drives import Drive
from experiments.log_folder import Log
from jaxslam.cli import main
from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import dead_reckoning, increments, relative
from jaxslam.io import readers, tum
from jaxslam.pipeline import log_input, odometry_notes, offline, online

T, R = 60, 36
LIDAR = Lidar(R, -np.pi / 2, np.pi / R, 20.0, 0.02)
KEYS = {"log", "how", "seed", "scans", "ate_rmse_m", "relations_translation_m"}
KEYS |= {"relations_rotation_deg", "warned", "notes", "refused"}


def tiny_drive(seed=0, reversing=False):
    rng = np.random.default_rng(seed)
    steps = np.tile([0.1, 0.0, 0.05], (T, 1))
    steps[[20, 40], 2] = 1.0
    poses = dead_reckoning(np.zeros(3), steps)
    ranges = rng.uniform(1.0, 9.0, (T, R))
    return Drive(LIDAR, Scan(ranges, np.ones_like(ranges, bool)), poses)


@pytest.fixture
def quick(monkeypatch):
    """Drives are tiny, and odometry takes the place of SLAM; the runs are counted."""
    runs = []

    def run_log(log, source):
        runs.append(source)
        return log.odom_poses, not log.has_odometry, list(log.notes)

    monkeypatch.setattr(damaged_drives, "simulate", tiny_drive)
    monkeypatch.setattr(stress, "run_log", run_log)
    return runs


@pytest.fixture
def folder(tmp_path):
    """A log of a tiny drive with its reference and, of every tenth scan, relations."""
    folder = tmp_path / "logs"
    folder.mkdir()
    drive = tiny_drive()
    record = drive_records.DriveRecord.of_drive(np.random.default_rng(1), drive)
    record = record._replace(odom_poses=drive.poses)
    drive_records.write(folder / "hall.clf", record)
    tum.write(folder / "hall.reference.tum", record.stamps, drive.poses)
    pairs = [
        (record.stamps[i], record.stamps[i + 10], *relative(*drive.poses[[i, i + 10]]))
        for i in range(0, 50, 10)
    ]
    lines = [f"{a:.6f} {b:.6f} {x} {y} 0 0 0 {turn}\n" for a, b, x, y, turn in pairs]
    (folder / "hall.relations").write_text("".join(lines))
    return folder


def arguments(out, *more):
    return ["--out", str(out), "--seed", "2", *map(str, more)]


def test_every_fault_has_its_rows(quick, folder, tmp_path):
    given = arguments(tmp_path / "a", "--data", folder, "--drives", 1, "--seeds", 2)
    assert stress.main(given) == 0
    found = json.loads((tmp_path / "a" / "stress.json").read_text())
    assert (tmp_path / "a" / "stress.png").stat().st_size > 10_000
    assert all(row.keys() == KEYS for row in found["rows"])
    hows = [(row["how"], row["seed"]) for row in found["rows"] if row["log"] == "hall"]
    assert {how for how, _ in hows} == {*hurt_logs.FAULTS, "still-scans-only"}
    assert [seed for how, seed in hows if how == "latched"] == [2, 3]
    assert [seed for how, seed in hows if how == "scale"] == [None]
    assert hows == [(r["how"], r["seed"]) for r in found["rows"] if r["log"] == "simulated-0"]
    assert quick.count("scans-only") == 2 and len(quick) == len(found["rows"])
    rows = {row["how"]: row for row in found["rows"] if row["log"] == "hall"}
    for how in ("none", "stamps-zero", "stamps-set-back", "missing", "dropped"):
        assert rows[how]["ate_rmse_m"] < 1e-3 and rows[how]["relations_translation_m"] < 1e-3
    for how in ("lost", "still", "carried", "scale"):
        assert rows[how]["ate_rmse_m"] > 0.01
        assert (rows[how]["relations_translation_m"] > 0.01) == (how != "carried")
    assert rows["still"]["scans"] == T and rows["carried"]["scans"] < T
    assert any(row["notes"] for row in found["rows"]) and not rows["none"]["notes"]
    assert not (tmp_path / "a" / "stress_parts").exists()


def test_what_was_interrupted_resumes_with_the_same_result(quick, tmp_path, monkeypatch):
    assert stress.main(arguments(tmp_path / "a", "--drives", 2)) == 0
    total, whole = len(quick), (tmp_path / "a" / "stress.json").read_text()
    run_log = stress.run_log

    def interrupted(log, source):
        if len(quick) == total + 7:
            raise KeyboardInterrupt
        return run_log(log, source)

    monkeypatch.setattr(stress, "run_log", interrupted)
    assert stress.main(arguments(tmp_path / "b", "--drives", 2)) == 130
    assert not (tmp_path / "b" / "stress.json").exists()
    monkeypatch.setattr(stress, "run_log", run_log)
    assert stress.main(arguments(tmp_path / "b", "--drives", 2)) == 0
    assert (tmp_path / "b" / "stress.json").read_text() == whole
    assert len(quick) == 2 * total


def test_relations_of_scans_that_are_gone_are_left_out():
    poses, times = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]), np.arange(4.0)
    log = LaserLog.from_arrays(times, poses, np.full((4, R), 2.0), LIDAR)
    pairs = Relations(np.array([0.0, 1]), np.array([3.0, 2]), np.array([[3.0, 0, 0], [1, 0, 0]]))
    source = stress.recorded("a", Log("a", None, log, None, pairs))
    bent = poses + [[0, 0, 0], [0, 0, 0], [0, 0.5, 0], [0, 0.25, 0]]
    assert stress.errors(source, np.arange(4), bent)["relations_translation_m"] == 0.375
    found = stress.errors(source, np.array([0, 1, 3]), bent[[0, 1, 3]])
    assert found["relations_translation_m"] == 0.25 and found["ate_rmse_m"] is None
    assert stress.errors(source, np.array([0, 1]), bent[:2])["relations_translation_m"] is None


def test_a_log_that_is_refused_has_a_row(quick, monkeypatch):
    source = stress.simulated(0, 0)
    monkeypatch.setattr(stress, "write", lambda path, _: path.write_text("nothing\n"))
    row = stress.run_case(source, "scale", None)
    assert row.keys() == KEYS and "no known format" in row["refused"]
    assert row["ate_rmse_m"] is None and not row["warned"] and "refused" in stress.line(row)


def row(error, **more):
    known = {"log": "a", "how": "none", "seed": None, "ate_rmse_m": error, "warned": False}
    return known | {"relations_translation_m": None, "refused": None} | more


def test_the_table_counts_what_is_lost_and_silent():
    rows = [row(0.1), row(0.7), row(0.9, warned=True), row(None, relations_translation_m=0.3)]
    rows += [row(None, refused="no", log="simulated-0"), row(0.2, log="simulated-1")]
    found = stress.table(rows)
    assert found.keys() == {"a", "simulated"}
    assert found["a"]["none"] == {
        **{"rows": 4, "median_m": 0.5, "worst_m": 0.9, "warned": 1},
        **{"refused": 0, "lost": 2, "silent": 1},
    }
    assert found["simulated"]["none"]["refused"] == 1
    text = stress.table_text({"table": found})
    assert "0.500 to 0.900 (1/4)" in text and "2 of 6 rows lost, 1 silently; 1 refused" in text


@pytest.mark.parametrize("how", ["none", "still", "still-scans-only"])
def test_a_case_is_run_as_by_the_command_line(how, tmp_path, monkeypatch):
    class Stop(Exception):
        pass

    given = []

    def stop(*args, callback=None, **options):
        given.append((args, options))
        raise Stop

    monkeypatch.setattr(offline, "run_slam", stop)
    fault, scans_only, _ = how.partition(stress.SCANS_ONLY)
    record = drive_records.DriveRecord.of_drive(np.random.default_rng(1), tiny_drive())
    drive_records.write(tmp_path / "a.clf", hurt_logs.hurt(fault, 0, record))
    source = "scans-only" if scans_only else "scan"
    options = ["--odometry", source] if scans_only else []
    with pytest.raises(Stop):
        main.main(["run", str(tmp_path / "a.clf"), "--out", str(tmp_path / "out"), *options])
    with pytest.raises(Stop):
        stress.run_log(readers.read_log(tmp_path / "a.clf"), source)
    (first, options), (second, others) = given
    for name in ("odometry_guessed", "after_pause", "new_drive"):
        np.testing.assert_array_equal(options.pop(name), others.pop(name))
    assert first[0] == second[0] and options == others  # configuration is static
    jax.tree.map(np.testing.assert_array_equal, first[1:], second[1:])


@pytest.mark.parametrize(
    "more, message",
    [
        (["--data", "nowhere"], "nowhere: is no folder"),
        (["--drives", "0"], "no log"),
        (["--drives", "-1"], "--drives: -1 is too small"),
        (["--seeds", "0"], "--seeds: 0 is too small"),
    ],
)
def test_bad_input_is_one_line(more, message, tmp_path, capsys):
    assert stress.main(arguments(tmp_path / "a", *more)) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "a").exists()


@pytest.mark.slow
def test_wheels_that_report_driving_backwards_as_forwards_are_found_out_and_noted(tmp_path):
    """Where the sign is believed, a drive of 0.25 m a scan is off by up to half a metre."""
    source = stress.simulated(0, 0)
    drive_records.write(tmp_path / "a.clf", hurt_logs.hurt("unsigned", 0, source.recording))
    log = log_input.from_laser_log(readers.read_log(tmp_path / "a.clf"))
    true = increments(source.truth)
    assert np.sum(true[:, 0] < -0.2) > 40 and log.increments[:, 0].min() > -1e-3
    matches = online.match_log(log.config, log.increments, log.scans)
    off = relative(true, np.asarray(matches.increment))
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.1
    assert odometry_notes.unsigned(matches, log.increments) != ()
