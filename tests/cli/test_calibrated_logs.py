"""`--calibrate` and `--calibration`: what is refused at once, and what a run writes."""

import json
from pathlib import Path

import numpy as np
import pytest
import test_run_logs
import wheel_drives
from test_run_logs import refused

from jaxslam.cli import calibrated_logs, main, run_command
from jaxslam.core.calibration import Calibration
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.io import calibration_file, readers
from jaxslam.io.calibration_file import RobotCalibration
from jaxslam.io.errors import InputError
from jaxslam.pipeline import log_input


def calibration_of(path, log, **changes):
    """A calibration.json of the robot of a log."""
    identity, sure = Calibration.identity(), Calibration(*map(np.asarray, (0, 0, 0, [0] * 3, 0)))
    robot = RobotCalibration(identity, sure, (), log.mount, log.mount, log.frames, log.lidar)
    calibration_file.write(path, robot._replace(**changes))
    return path


@pytest.mark.parametrize("command", ["run", "tune"])
def test_a_log_without_wheels_has_nothing_to_calibrate(tmp_path, capsys, command):
    log = test_run_logs.still(tmp_path / "a.clf")
    options = ["--calibrate", "--out", tmp_path / "out"]
    options += ["--loss", "innovation_nll"] if command == "tune" else []
    line = refused(capsys, command, log, *options)
    assert line.startswith(f"{log}: there is no odometry to calibrate")
    assert not (tmp_path / "out").exists()


def test_scans_alone_have_nothing_to_calibrate(tmp_path, capsys):
    log = test_run_logs.room_log(tmp_path / "a")
    options = ["--odometry", "scans-only", "--calibrate", "--out", tmp_path / "out"]
    assert "where scans alone are matched" in refused(capsys, "run", log, *options)


def test_simulated_trials_are_not_calibrated(tmp_path, capsys):
    line = refused(capsys, "tune", "--calibrate", "--out", tmp_path / "out")
    assert line.startswith("--calibrate: applies to laser logs only")


def test_a_calibration_of_another_robot_is_refused_at_once(tmp_path, capsys):
    path = test_run_logs.room_log(tmp_path / "a")
    log = readers.read_log(path)
    other = log.lidar._replace(num_beams=log.lidar.num_beams + 1)
    file = calibration_of(tmp_path / "c.json", log, lidar=other)
    line = refused(capsys, "run", path, "--calibration", file, "--out", tmp_path / "out")
    assert line.startswith(f"{file}: robot.num_beams: is of another robot: 181 beams")
    file = calibration_of(tmp_path / "c.json", log)
    options = ["--mount", 1, 0, 0, "--calibration", file, "--out", tmp_path / "out"]
    assert f"{file}: robot.mount: is of another robot" in refused(capsys, "run", path, *options)
    assert not (tmp_path / "out").exists()


def test_as_many_calibrations_as_logs_or_one(tmp_path, capsys):
    log = test_run_logs.room_log(tmp_path / "a")
    files = ["--calibration", "a", "--calibration", "b"]
    line = refused(capsys, "run", log, log, log, *files, "--out", tmp_path / "out")
    assert line.startswith("--calibration: is given 2 times for 3 logs")


def test_lines_name_what_is_not_determined():
    lidar = Lidar(8, -1.0, 0.25, 10.0)
    log = LaserLog.from_arrays([0.0], [[0.0, 0.0, 0.0]], np.ones((1, 8)), lidar)
    robot = RobotCalibration(
        Calibration(*map(np.asarray, (1.05, 0.97, 0.01, [0.25, 0.0, np.radians(3.0)], 0.08))),
        Calibration(*map(np.asarray, (0.001, 0.002, 0.003, [0.3, 0.3, np.radians(0.1)], 0.01))),
        ("mount[0]",),
        log.mount,
        log.mount,
        log.frames,
        log.lidar,
    )
    lines = calibrated_logs.calibration_lines(robot)
    assert lines[0].split() == ["distance_scale", "1.0500", "+-", "0.0010"]
    assert lines[5].split() == ["mount[2]", "3.0000", "+-", "0.1000", "deg"]
    assert [line for line in lines if "not determined" in line] == [lines[3]]
    assert not [line for line in lines if "far from" in line]
    turned = robot.calibration._replace(mount=np.array([0.0, 0.0, 1.5]))
    lines = calibrated_logs.calibration_lines(robot._replace(calibration=turned))
    assert [line for line in lines if "far from" in line] == [lines[5]]


def small_log(mount=(0.0, 0.0, 0.0)):
    """Four scans of a robot that drives ahead."""
    poses = np.outer(np.arange(4), [0.3, 0.0, 0.0])
    lidar = Lidar(40, -1.0, 0.05, 10.0)
    log = LaserLog.from_arrays(0.5 * np.arange(4), poses, np.full((4, 40), 3.0), lidar)
    return log._replace(mount=np.array(mount))


def test_logs_of_two_robots_are_not_calibrated_together():
    logs = [small_log(), small_log((0.3, 0.0, 0.0))]
    paths = [Path("a.npz"), Path("b.npz")]
    with pytest.raises(InputError) as caught:
        calibrated_logs.check_same_robot(paths, logs)
    assert str(caught.value).startswith("--calibrate: a.npz: robot.mount: is of another robot")
    assert "and b.npz has [0.3 0.  0. ]; only logs of one robot" in str(caught.value)
    calibrated_logs.check_same_robot(paths, logs[:1] * 2)


def test_what_a_calibration_leaves_open_is_named_where_it_is_used(tmp_path, capsys):
    log = small_log()
    file = calibration_of(tmp_path / "c.json", log, not_determined=("mount[0]", "time_offset"))
    robot, given = calibration_file.read(file), log_input.from_laser_log(log)
    calibrated_logs.use_calibration(Path("a.npz"), log, given, robot)
    assert capsys.readouterr().out.endswith("; not determined: mount[0], time_offset\n")


def test_wheels_that_contradict_the_scans_are_warned_of(capsys):
    spans = wheel_drives.drive(np.random.default_rng(0), 40)
    assert calibrated_logs.print_contradictions(Path("a.clf"), wheel_drives.TRUE, spans) == 0
    assert not capsys.readouterr().out
    increment = spans.increment + np.outer(np.arange(39) < 12, [1.0, 0.0, 0.0])
    wrong = spans._replace(increment=increment)
    assert calibrated_logs.print_contradictions(Path("a.clf"), wheel_drives.TRUE, wrong) == 12
    printed = capsys.readouterr().out
    assert printed.startswith("WARNING: a.clf: calibrated wheels do not move as the scans show at")
    assert "12 of 39 spans" in printed


def test_a_calibration_of_an_earlier_run_is_noted(tmp_path):
    (tmp_path / "calibration.json").write_text("{}")
    (note,) = run_command.left_from_before(tmp_path, [], 1)
    assert note.endswith("calibration.json of an earlier run stay there")
    assert not run_command.left_from_before(tmp_path, ["calibration.json"], 1)


@pytest.mark.slow
def test_a_run_calibrates_itself_and_the_next_one_uses_that(tmp_path, capsys):
    log, out, again = test_run_logs.room_log(tmp_path / "a"), tmp_path / "out", tmp_path / "again"
    assert main.main(["run", str(log), "--calibrate", "--no-smooth", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "distance_scale" in printed and "on top of the scanner's mount" in printed
    numbers = json.loads((out / "metrics.json").read_text())["calibration"]
    file = calibration_file.read(out / "calibration.json")
    assert numbers["distance_scale"] == file.calibration.distance_scale
    assert numbers["not_determined"] == list(file.not_determined)
    options = ["--calibration", str(out / "calibration.json"), "--no-smooth", "--out", str(again)]
    assert main.main(["run", str(log), *options]) == 0
    assert (again / "trajectory.tum").read_bytes() == (out / "trajectory.tum").read_bytes()
    assert not (again / "calibration.json").exists()
