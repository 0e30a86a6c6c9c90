"""calibration.json: what is written is read; what is not of this robot is refused."""

import json

import jax
import numpy as np
import pytest

from jaxslam.core.calibration import Calibration
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.io import calibration_file
from jaxslam.io.calibration_file import RobotCalibration
from jaxslam.io.errors import InputError

LIDAR = Lidar(181, -np.pi / 2, np.pi / 180, 20.0)
FOUND = RobotCalibration(
    Calibration(*map(np.asarray, (1.05, 0.97, 0.01, [0.25, 0.0, 0.05], 0.08))),
    Calibration(*map(np.asarray, (0.001, 0.002, 0.003, [0.1, 0.2, 0.003], 0.004))),
    ("mount[0]",),
    np.array([0.1, 0.2, 0.3]),
    np.array([-0.1, 0.0, 0.3]),
    ("base_link", "laser"),
    LIDAR,
)


def log_of(lidar=LIDAR, mount=FOUND.mount, frames=FOUND.frames):
    ranges = np.ones((1, lidar.num_beams))
    log = LaserLog.from_arrays([0.0], [[0.0, 0.0, 0.0]], ranges, lidar)
    return log._replace(mount=np.asarray(mount), frames=frames)


def written(path, change=None):
    """The file of `FOUND`, its content changed."""
    calibration_file.write(path, FOUND)
    content = json.loads(path.read_text())
    if change is not None:
        change(content)
        path.write_text(json.dumps(content))
    return path


def test_what_is_written_is_read(tmp_path):
    read = calibration_file.read(written(tmp_path / "a.json"))
    jax.tree.map(np.testing.assert_array_equal, read[:2], FOUND[:2])
    np.testing.assert_array_equal(read.mount, FOUND.mount)
    np.testing.assert_array_equal(read.wheels, FOUND.wheels)
    assert (read.not_determined, read.frames) == (FOUND.not_determined, FOUND.frames)
    assert read.lidar[:4] == LIDAR[:4]
    calibration_file.check_robot("a.json", read, log_of())


def put(*keys_and_value):
    *keys, last, value = keys_and_value

    def change(content):
        for key in keys:
            content = content[key]
        content[last] = value

    return change


def drop(*keys):
    *keys, last = keys

    def change(content):
        for key in keys:
            content = content[key]
        del content[last]

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (put("format", "jaxslam-noise"), "format: is no jaxslam-calibration file"),
        (put("version", 2), "version: 2 instead of 1"),
        (put("version", True), "version: True instead of 1"),
        (put("calibration", "distance_scale", 0), "calibration.distance_scale: 0.0 is not between"),
        (put("calibration", "turn_scale", -1.0), "calibration.turn_scale: -1.0 is not between"),
        (put("calibration", "mount", [0, 0]), "calibration.mount: is not 3 numbers"),
        (put("calibration", "mount", [0, [1], 2]), "calibration.mount: is not 3 numbers"),
        (put("calibration", "mount", [True, 0, 0]), "calibration.mount: is not 3 numbers"),
        (put("calibration", "time_offset", "0"), "calibration.time_offset: is not a number"),
        (put("calibration", "time_offset", True), "calibration.time_offset: is not a number"),
        (put("calibration", "time_offset", 1e400), "is not JSON (Infinity is no number of JSON)"),
        (put("calibration", "turn_scale", float("nan")), "is not JSON (NaN is no number of JSON)"),
        (put("calibration", []), "calibration: is no object"),
        (put("calibration", "base", 1.0), "calibration.base: unknown key; the keys are distance"),
        (drop("calibration", "turn_scale"), "calibration.turn_scale: missing"),
        (drop("robot"), "robot: missing"),
        (put("standard_errors", "mount", [0, 0, -1]), "standard_errors.mount: [0.0, 0.0, -1.0] is"),
        (put("not_determined", "all"), "not_determined: holds something that is no text"),
        (put("not_determined", ["mount"]), "not_determined: 'mount'; the names are distance_sc"),
        (put("robot", "num_beams", 2.5), "robot.num_beams: 2.5 is no whole number"),
        (put("robot", "angle_increment", 0), "robot.angle_increment: 0.0 is not between"),
        (put("robot", "base_frame", 3), "robot.base_frame, robot.scan_frame: holds something"),
    ],
)
def test_what_is_no_calibration_is_refused_in_a_line(tmp_path, change, message):
    path = written(tmp_path / "a.json", change)
    with pytest.raises(InputError) as caught:
        calibration_file.read(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="there is no such file; name a calibration.json"):
        calibration_file.read(tmp_path / "a.json")


def test_a_calibration_out_of_its_limits_is_not_written(tmp_path):
    wrong = FOUND._replace(calibration=FOUND.calibration._replace(turn_scale=np.asarray(np.nan)))
    with pytest.raises(InputError, match=r"calibration\.turn_scale: nan is not between"):
        calibration_file.write(tmp_path / "a.json", wrong)
    assert not (tmp_path / "a.json").exists()


def test_a_calibration_that_no_robot_has_names_the_log():
    calibration_file.require_possible("a.clf", FOUND.calibration)
    with pytest.raises(InputError) as caught:
        wrong = FOUND.calibration._replace(distance_scale=np.asarray(0.101))
        calibration_file.require_possible("a.clf", wrong)
    assert str(caught.value).startswith("a.clf: distance_scale: the calibration is found to be 0.1")
    assert "check the units" in str(caught.value)


@pytest.mark.parametrize(
    "log, message",
    [
        (log_of(LIDAR._replace(num_beams=361)), "robot.num_beams: is of another robot: 181 beams"),
        (log_of(LIDAR._replace(angle_min=-1.5)), "robot.angle_min: is of another robot: the first"),
        (log_of(LIDAR._replace(angle_increment=0.0175)), "robot.angle_increment: is of another"),
        (log_of(frames=("base", "laser")), "robot.base_frame: is of another robot: frame 'base_l"),
        (log_of(frames=("", "rear")), "robot.scan_frame: is of another robot: frame 'laser', and"),
        (log_of(mount=[0.1, 0.2, 0.35]), "robot.mount: is of another robot: scanner taken to be"),
    ],
)
def test_a_calibration_of_another_robot_is_refused(log, message):
    with pytest.raises(InputError) as caught:
        calibration_file.check_robot("a.json", FOUND, log)
    assert str(caught.value).startswith(f"a.json: {message}")


def test_frames_that_are_not_known_do_not_matter():
    calibration_file.check_robot("a.json", FOUND, log_of(frames=("", "")))
    calibration_file.check_robot("a.json", FOUND._replace(frames=("", "")), log_of())
    far = LIDAR._replace(range_max=80.0)  # the same scanner, cut off elsewhere
    calibration_file.check_robot("a.json", FOUND, log_of(far))
