import pytest

from jaxslam.cli import main, simulate_command
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io.robot_file import EXAMPLE
from jaxslam.pipeline.config import Config
from jaxslam.simulation import scanner_presets
from jaxslam.simulation.robot import Robot


@pytest.fixture
def robot_file(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(EXAMPLE)
    return path


def test_without_a_file_the_robot_is_the_default_one(capsys):
    config = Config(frontend=FrontendConfig(labels="codes"))
    assert simulate_command._robot(None, config) == (Robot(), config)
    assert capsys.readouterr().out == ""


def test_the_robot_of_a_file_is_printed_and_seen_with_its_scanner(robot_file, capsys):
    given = Config(frontend=FrontendConfig(labels="codes"))
    robot, config = simulate_command._robot(robot_file, given)
    config.check()
    assert robot.wheel_base == 0.32 and robot.scanner.name == "RPLidar A2"
    assert config.frontend.labels == "codes"
    assert config.frontend.lidar[:4] == scanner_presets.preset("RPLidar A2").lidar()[:4]
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("robot delivery robot: differential, wheel base 0.32 m, up to 0.8 m/s")


def test_what_is_assumed_of_a_preset_is_printed(robot_file, capsys):
    robot_file.write_text(EXAMPLE.replace('range_noise = ["8 mm", "1 % from 1 m"]', ""))
    simulate_command._robot(robot_file, Config())
    assert "a third of its precision is assumed" in capsys.readouterr().out


def test_a_robot_that_is_not_possible_ends_the_command_in_a_line(robot_file, tmp_path, capsys):
    robot_file.write_text(EXAMPLE.replace("320 mm", "320 lbs"))
    out = tmp_path / "out"
    assert main.main(["simulate", "--robot", str(robot_file), "--out", str(out)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"{robot_file}: kinematics.wheel_base: '320 lbs' has the unit 'lbs'" in line
    assert not out.exists()


def test_a_robot_that_cannot_follow_the_path_ends_the_command_in_a_line(
    robot_file, tmp_path, capsys
):
    text = EXAMPLE.replace(
        'type = "differential"', 'type = "ackermann"\nmin_turning_radius = "3 m"'
    )
    text = text.replace("wheel_scales = [1.004, 0.998]", 'steering_noise = "0.2 deg"')
    robot_file.write_text(text)
    out = tmp_path / "out"
    assert main.main(["simulate", "--robot", str(robot_file), "--out", str(out)]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "--robot: robot leaves the path by" in said and "turning radius is 3.00 m" in said
    assert not out.exists()
