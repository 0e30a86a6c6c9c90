"""Help, version and wrong usage of the command line."""

import subprocess
import sys

import pytest

import jaxslam
from jaxslam.cli import main, usage


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
    "arguments, line",
    [
        (
            "fly",
            "fly: is no command; the commands are simulate, run, localise, map, route, tune, study",
        ),
        ("rout out", "rout: is no command; did you mean route?"),
        ("--fly", "--fly: is no command; the commands are"),
        ("map a.png --resolution abc", "--resolution: 'abc' is no number; write --resolution M"),
        ("simulate --trials 1.5", "--trials: '1.5' is no whole number; write --trials N"),
        ("run a --scan=", "--scan: '' is no whole number; write --scan N"),
        ("map a --regions x", "--regions: 'x' is none of largest, all; write --regions largest|"),
        ("run a --rerun x", "--rerun: 'x' is none of live, file; write --rerun {live,file}"),
        ("map a --out", "--out: has no value; write --out DIR"),
        ("run a --mount 1 2", "--mount: has 2 values, not 3; write --mount X Y YAW"),
        ("tune --mount 1 -2 x", "--mount: 'x' is no number; write --mount X Y YAW"),
        ("run a --gif=no", "--gif: has 1 value, not 0; write --gif"),
        ("map a --robot-radiu 3", "--robot-radiu: is no option of `jaxslam map`; did you mean "),
        ("map a --bogus 3", "--bogus: is no option of `jaxslam map`; see `jaxslam map --help`"),
        ("map a -o 3", "-o: is no option of `jaxslam map`; see `jaxslam map --help`"),
        ("map a b", "b: is one argument too many; write `jaxslam map MAP` and then options"),
        ("simulate 3", "3: is one argument too many; write `jaxslam simulate` and then options"),
        ("map", "MAP: is missing; write `jaxslam map MAP` and then options"),
        ("run", "LOG: is missing; name one log, or several"),
        ("localise a", "--map: is missing; write `jaxslam localise LOG --map DIR` and then"),
        ("route", "MAP, --from, --to: are missing; write `jaxslam route MAP --from X Y --to X Y|"),
        ("run a --strict b", "Unrecognized options: b; see `jaxslam run --help`"),
    ],
)
def test_wrong_usage_is_one_line(arguments, line, capsys):
    assert main.main(arguments.split()) == 2
    said, errors = capsys.readouterr()
    assert errors.startswith(f"jaxslam: error: {line}") and errors.count("\n") == 1 and not said


def test_what_a_parser_says_in_a_box_becomes_a_line():
    text = "/- Error -\\\n| Bad --a |\n| value. |\n| ------- |\n| Help |\n\\---------/"
    assert usage.first_paragraph(text) == "Bad --a value."
    drawn = text.translate({ord("|"): "\u2502", ord("-"): "\u2500"}).replace("\u2500\u2500a", "--a")
    assert usage.first_paragraph(drawn) == "Bad --a value."
    assert usage.first_paragraph("") == "wrong arguments"


def test_help_says_in_a_line_what_each_command_does(capsys):
    text = printed_help(capsys)
    assert "simulate Run SLAM on Monte-Carlo trials" in text
    assert "run Run SLAM on a laser log." in text
    assert "map Extract the topological map, the rooms and the doors of an occupancy grid." in text
    assert "tune Tune the noise parameters of the filter (Q and R)" in text
    assert "Writes" not in text


OPTIONS = {
    "simulate": "--world --trials --seed --noise --robot --landmarks --labels --out",
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
    known = {argument.name for argument in usage.arguments_of(main.function_of(command))}
    assert {word for word in OPTIONS[command].split()} <= known
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
