"""Old names of options and values: they work for one version, and say so."""

import pytest

from jaxslam.cli import deprecated, main, simulate_command, tune_command

ROWS = [
    ("simulate --runs 3", "simulate --trials 3", ["--runs is now --trials"]),
    ("simulate --runs=3 --out o", "simulate --trials=3 --out o", ["--runs is now --trials"]),
    (
        "simulate --landmarks nodes --labels runs",
        "simulate --landmarks junctions --labels segments",
        [
            "--landmarks nodes is now --landmarks junctions",
            "--labels runs is now --labels segments",
        ],
    ),
    (
        "simulate --labels=runs",
        "simulate --labels=segments",
        ["--labels runs is now --labels segments"],
    ),
    ("run a.clf --animate", "run a.clf --gif", ["--animate is now --gif"]),
    ("run --no-animate a.clf", "run --no-gif a.clf", ["--no-animate is now --no-gif"]),
    ("run --no_animate a.clf", "run --no-gif a.clf", ["--no_animate is now --no-gif"]),
    ("run a.clf --view live", "run a.clf --rerun live", ["--view is now --rerun"]),
    (
        "map m.yaml --clearance 0.3 --speck=0.2",
        "map m.yaml --robot-radius 0.3 --min-obstacle-size=0.2",
        ["--clearance is now --robot-radius", "--speck is now --min-obstacle-size"],
    ),
    (
        "tune --runs 4 --steps=2 --loss calibrated",
        "tune --trials 4 --updates=2 --loss pose_nll",
        [
            "--runs is now --trials",
            "--steps is now --updates",
            "--loss calibrated is now --loss pose_nll",
        ],
    ),
    (
        "tune --loss=likelihood",
        "tune --loss=innovation_nll",
        ["--loss likelihood is now --loss innovation_nll"],
    ),
    (
        "tune --loss localisation",
        "tune --loss pose_mse",
        ["--loss localisation is now --loss pose_mse"],
    ),
    (
        "tune --freeze wall odometry[2] range_std --loss pose_mse",
        "tune --freeze wall_angle_std odometry_coefficients[2] range_std --loss pose_mse",
        [
            "--freeze wall is now --freeze wall_angle_std",
            "--freeze odometry[2] is now --freeze odometry_coefficients[2]",
        ],
    ),
]


@pytest.mark.parametrize("old, new, notes", ROWS)
def test_old_names_become_new_ones_with_a_note(capsys, old, new, notes):
    assert deprecated.rewrite(old.split()) == new.split()
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"note: {x}; the old name goes away in the next version" for x in notes]


@pytest.mark.parametrize(
    "arguments",
    [
        "",
        "--help",
        "simulate --trials 3 --landmarks all --labels codes --seed 1",
        "run nodes --reference runs --noise calibrated --no-smooth",
        "run a.clf --smooth --gif --rerun file --scan 3",
        "map runs --regions all",
        "tune likelihood --test calibrated --loss pose_nll --freeze range_std --batch 3",
        "tune --loss pose_nll likelihood",  # the second is a log
        "fly --runs 3",
    ],
)
def test_new_names_and_other_values_stay(capsys, arguments):
    assert deprecated.rewrite(arguments.split()) == arguments.split()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("row", [name for name, _, _ in ROWS if name.startswith("simulate")])
def test_old_options_of_simulate_reach_the_command(monkeypatch, capsys, row):
    """`use_cpu_devices` comes first: what is left of the command is stopped there."""
    monkeypatch.setattr(simulate_command, "use_cpu_devices", stop)
    assert main.main(row.split()) == 130
    assert capsys.readouterr().err.startswith("note: ")


@pytest.mark.parametrize("row", [name for name, _, _ in ROWS if name.startswith("tune")])
def test_old_options_of_tune_reach_the_command(monkeypatch, capsys, row):
    monkeypatch.setattr(tune_command, "use_cpu_devices", stop)
    assert main.main(row.split()) == 130
    assert capsys.readouterr().err.startswith("note: ")


@pytest.mark.parametrize("row", [name for name, _, _ in ROWS if name.startswith(("run", "map"))])
def test_old_options_of_run_and_map_reach_the_command(capsys, row, tmp_path):
    """The file that they name does not exist."""
    assert main.main([*row.split(), "--out", str(tmp_path / "out")]) == 2
    *notes, error = capsys.readouterr().err.splitlines()
    assert all(note.startswith("note: ") for note in notes) and notes
    assert error.startswith("jaxslam: error: ") and "does not exist" in error


def stop(*_):
    raise KeyboardInterrupt
