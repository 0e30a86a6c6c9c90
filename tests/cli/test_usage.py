"""Help, version and wrong usage of the command line."""

import subprocess
import sys

import pytest

import jaxslam
from jaxslam.cli import main


def printed_help(capsys, *arguments):
    """Help text, on one line."""
    with pytest.raises(SystemExit) as stopped:
        main.main([*arguments, "--help"])
    assert not stopped.value.code
    return " ".join(capsys.readouterr().out.replace("\u2502", " ").split())


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_help_lists_the_commands(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main.main(arguments)
    assert not stopped.value.code
    said = capsys.readouterr().out
    assert "simulate" in said and "run" in said and "--version" in said


def test_version(capsys):
    assert main.main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxslam {jaxslam.__version__}\n"


@pytest.mark.parametrize(
    "arguments", [["simulate", "--trials", "many"], ["fly"], ["simulate", "--labels", "x"]]
)
def test_wrong_usage_exits_2(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main.main(arguments)
    assert stopped.value.code == 2
    assert capsys.readouterr().err


def test_a_run_without_a_log_is_one_line(capsys):
    assert main.main(["run"]) == 2
    assert capsys.readouterr().err == "jaxslam: error: LOG: is missing; name one log, or several\n"


def test_help_says_in_a_line_what_each_command_does(capsys):
    text = printed_help(capsys)
    assert "simulate Run SLAM on Monte-Carlo trials" in text
    assert "run Run SLAM on a laser log." in text
    assert "map Extract the topological map, the rooms and the doors of an occupancy grid." in text
    assert "tune Tune the noise parameters of the filter (Q and R)" in text
    assert "Writes" not in text


OPTIONS = {
    "simulate": "--world --trials --seed --noise --landmarks --labels --out",
    "run": "--reference --relations --odometry --smooth --no-smooth --noise --map --scan-topic "
    "--odometry-topic --mount --upside-down --scan-frame --base-frame --odom-frame "
    "--angle-increment --pose-frame --scan --gif --rerun --strict --out",
    "map": "--robot-radius --min-obstacle-size --regions --out",
    "tune": "--test --reference --odometry --world --trials --heldout --loss --updates --batch "
    "--patience --freeze --noise --mount --upside-down --scan-frame --base-frame --odom-frame "
    "--angle-increment --seed --out",
}


@pytest.mark.parametrize("command", OPTIONS)
def test_help_of_a_command_explains_its_options(capsys, command):
    text = printed_help(capsys, command)
    assert text.startswith(f"usage: jaxslam {command} ") and "Writes metrics.json" in text.replace(
        "noise.json, which --noise of the other commands reads; ", ""
    )
    assert set(OPTIONS[command].split()) <= set(text.replace(",", " ").split())
    assert "None" not in text
    if "--noise" in OPTIONS[command]:
        assert "noise parameters of the filter (Q and R)" in text


def test_help_of_run_describes_smoothing(capsys):
    text = "Batch-smooth the trajectory and landmarks, with loop closures; --no-smooth writes the"
    assert f"{text} online estimates." in printed_help(capsys, "run")


def test_importing_the_package_stays_light():
    """Neither JAX nor matplotlib nor a command is imported by `import jaxslam`."""
    heavy = ("jax", "matplotlib", "tyro", "optax", "jaxslam.cli.main", "jaxslam.tuning.fitting")
    code = f"import sys, jaxslam; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_importing_the_command_line_does_not_import_matplotlib():
    code = "import sys, jaxslam.cli.main; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


@pytest.mark.parametrize("command", ["map_command", "route_command"])
def test_commands_on_saved_maps_do_not_import_jax(command):
    """Nor do the pictures that they draw."""
    code = f"import sys, jaxslam.cli.main, jaxslam.cli.{command}\n"
    code += "from jaxslam.viz import canvas, maps, rooms, routes\nprint('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
