"""The command `jaxslam study`: wrong studies are one line, a small one runs to its end."""

import json

import numpy as np
import pytest

from jaxslam.cli import main, study_command, study_variants
from jaxslam.io.errors import InputError
from jaxslam.io.robot_file import EXAMPLE
from jaxslam.study import kept_trials, runner, study_file
from jaxslam.study.kept_trials import Collected
from jaxslam.study.processes import Group, LostProcessError

SMALL = """
trials = 5
seed = 2
success_m = 0.5
[base]
path = "p.csv"
max_landmarks = 32
[[variant]]
name = "as it is"
[[variant]]
name = "people"
life.people = 4
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "p.csv").write_text("1.0,0.9\n2.2,0.9\n")
    (tmp_path / "w.csv").write_text("x1,y1,x2,y2\n0,0,4,0\n4,0,4,4\n4,4,0,4\n0,4,0,0\n")
    (tmp_path / "big.toml").write_text(EXAMPLE.replace('length = "0.5 m"', 'length = "4 m"'))
    slides = EXAMPLE.replace("differential", "holonomic").replace("[1.004, 0.998]", "1.004")
    noise = 'encoder_noise = "4 mm"      # of a wheel, over one metre'
    slides = slides.replace(noise, 'slip_noise = ["5 mm", "8 mm", "1 deg"]')
    (tmp_path / "h.toml").write_text(slides)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def no_trials(monkeypatch):
    """Fail at once where a wrong study is taken to be right."""
    monkeypatch.setattr(runner, "run_timed", None)


def said_of(folder, text, capsys, *more):
    (folder / "s.toml").write_text(text)
    assert main.main(["study", str(folder / "s.toml"), "--out", str(folder / "o"), *more]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith("jaxslam: error: ") and errors.count("\n") == 1
    assert not (folder / "o").exists()
    return errors


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ('world = "ofice"\n', "s.toml: base: --world: no world named 'ofice'"),
        ('world = "a.yaml"\n', "a.yaml"),
        ('path = "none.csv"\n', "none.csv"),
        ('scanner = "LDS-9"\n', "s.toml: base: no scanner named 'LDS-9'; there are: LDS-01"),
        ('robot = "r.toml"\n', "r.toml"),
        ('world = "w.csv"\npath = "p.csv"\nlife.closed = 0.2\n', "closed needs doors, and none"),
        ('path = "p.csv"\nlife.moved_at = 9\n', "life.moved_at: says nothing without life.moved;"),
        ('path = "p.csv"\nlife.moved = 1\n', "life.moved: says nothing without life.moved_at;"),
        ('path = "p.csv"\nlife = "none.toml"\n', "none.toml: does not exist"),
        ('path = "p.csv"\nscanner = "LDS-01"\nscan_period = 0.05\n', "LDS-01 scans every 0.2 s"),
        ('path = "p.csv"\nodometry_factor = 0\n', "base.odometry_factor: 0 is not between 0.00"),
        ('path = "p.csv"\ndrive = "route"\n', "--drive: is not for a drive that --path gives"),
        ('path = "p.csv"\nscan_period = 0\n', "robot.scan_period is 0.0, not above 0"),
        (
            'path = "p.csv"\nrobot = "h.toml"\nencoder_noise = 0.01\n',
            "encoder_noise says nothing of",
        ),
        ('path = "p.csv"\nrobot = "big.toml"\n', "p.csv: path comes within"),
        ("life.persons = 2\n", "base: life.persons is not known; did you mean life."),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(folder, base, message, capsys, no_trials):
    assert message in said_of(folder, f"[base]\n{base}", capsys)


def test_a_path_through_a_wall_is_refused(folder, capsys):
    (folder / "q.csv").write_text("1.0,0.9\n11.0,8.0\n")
    assert "q.csv: path goes through a wall" in said_of(folder, '[base]\npath = "q.csv"\n', capsys)


def test_variants_have_the_settings_of_the_study(folder):
    (folder / "s.toml").write_text(
        '[base]\npath = "p.csv"\n[vary]\nscanner = ["LDS-01", "TiM571"]\n'
        "life.people = [0, 7]\nodometry_factor = [1, 2]\n"
    )
    found = study_variants.prepare(study_file.read(folder / "s.toml"))
    assert len(found.variants) == 8 and any("LDS-01" in note for note in found.notes)
    first, last = found.variants[0], found.variants[-1]
    assert first.robot.scanner.name == "LDS-01" and last.robot.scanner.name == "TiM571"
    assert first.config.frontend.lidar.num_beams == first.robot.scanner.num_beams
    assert len(first.life.movers.people) == len(last.life.movers.people) == 7
    assert float(first.life.traffic.people) == 0.0 and float(last.life.traffic.people) == 7.0
    own = {one.settings["odometry_factor"]: one.params for one in found.variants[:2]}
    for a, b in ((own[1.0], own[2.0]),):
        np.testing.assert_allclose(2 * a.odometry_coefficients, b.odometry_coefficients)
        np.testing.assert_array_equal(a.range_std, b.range_std)
    plain = '[base]\npath = "p.csv"\n'
    (folder / "s.toml").write_text(plain)
    assert study_variants.prepare(study_file.read(folder / "s.toml")).variants[0].life is None


def test_layers_of_a_drawing_are_those_of_simulate(folder, capsys):
    def line(layer, *points):
        shape = {"type": "LineString", "coordinates": points}
        return {"type": "Feature", "properties": {"layer": layer}, "geometry": shape}

    walls = line("walls", [0, 0], [4, 0], [4, 4], [0, 4], [0, 0])
    lines = [walls, line("axes", [1.5, 0], [1.5, 4]), line("door", [3, 0], [3, 1])]
    content = {"type": "FeatureCollection", "features": lines}
    (folder / "w.geojson").write_text(json.dumps(content))
    text = '[base]\nworld = "w.geojson"\npath = "p.csv"\n'
    assert "path goes through a wall at x 1.50" in said_of(folder, text, capsys)
    (folder / "s.toml").write_text(text + 'layers = "walls, door"\n')
    (found,) = study_variants.prepare(study_file.read(folder / "s.toml")).variants
    assert len(found.world.walls) == 5
    assert "'wall' is no layer" in said_of(folder, text + 'layers = "wall"\n', capsys)


def test_a_value_that_is_the_default_is_no_other_variant(folder, capsys):
    base = '[base]\npath = "p.csv"\n[[variant]]\nname = "as it is"\n'
    other = '[[variant]]\nname = "so fast"\nmax_speed = 0.6\n'
    assert "variants: 'as it is' and 'so fast' are the same" in said_of(
        folder, base + other, capsys
    )


def test_variants_that_differ_in_what_says_nothing_are_noted(folder):
    """All combinations are run, as asked: without people their speed changes nothing."""
    text = '[base]\npath = "p.csv"\n[vary]\nlife.speed = [1, 2]\nlife.people = [0, 3]\n'
    (folder / "s.toml").write_text(text)
    found = study_variants.prepare(study_file.read(folder / "s.toml"))
    assert len(found.variants) == 4
    same = [note for note in found.notes if "same trials" in note]
    assert same == [
        "'speed 1, people 0' and 'speed 2, people 0' have the same trials: "
        "what they differ in says nothing"
    ]


def test_a_file_of_life_is_that_of_simulate(folder, capsys):
    (folder / "life.toml").write_text('people = 3\nmissing = "10 %"\n')
    text = '[base]\npath = "p.csv"\nlife = "life.toml"\n[vary]\nlife.missing = [0, 0.2]\n'
    (folder / "s.toml").write_text(text)
    found = study_variants.prepare(study_file.read(folder / "s.toml"))
    assert [float(one.life.ranges.missing) for one in found.variants] == [0.0, 0.2]
    assert all(float(one.life.traffic.people) == 3.0 for one in found.variants)
    assert "missing 0: life: people 3, missing 0" in found.notes


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--processes", "0"], "--processes: 0 is not between 1 and 256"),
        (["--process-id", "1"], "--coordinator-address: is missing"),
        (["--coordinator-address", "a:1", "--num-processes", "2"], "--process-id: is not below"),
    ],
)
def test_processes_that_do_not_fit_are_one_line(folder, options, message, capsys):
    assert message in said_of(folder, '[base]\npath = "p.csv"\n', capsys, *options)


def test_several_processes_keep_trials_that_this_one_reads(tmp_path, monkeypatch):
    group = Group("127.0.0.1:1", 3, (0, 1))
    said = []
    monkeypatch.setattr(study_command.runner, "in_numpy", lambda one: one)
    monkeypatch.setattr(
        study_command.processes_module,
        "run_group",
        lambda group, work, *given: said.append((work, given)) or [700.0, 600.0],
    )
    kept = [Collected("record", 1.0, 500.0)]
    own = {"num_trials": 4, "seed": 7, "folder": tmp_path}
    read = {}
    monkeypatch.setattr(study_command, "run_shown", lambda _, **given: read.update(given) or kept)
    found = study_command._run(["variant"], 4, 7, tmp_path, group)
    assert found == [Collected("record", 1.0, 1300.0)]  # the memory of both
    assert read == own
    assert said == [(study_command._share, (["variant"], 4, 7, tmp_path))]
    assert study_command._run(["variant"], 4, 7, tmp_path, group._replace(own=(2,))) is None

    def lost(*_):
        raise LostProcessError("process 1 of 3 ended early")

    monkeypatch.setattr(study_command.processes_module, "run_group", lost)
    with pytest.raises(InputError, match="process 1 of 3 ended early"):
        study_command._run(["variant"], 4, 7, tmp_path, group)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_study_runs_resumes_and_writes_its_page(folder, capsys, monkeypatch):
    (folder / "s.toml").write_text(SMALL)
    call = ["study", "s.toml", "--out", "o"]
    assert main.main([*call, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "2 variants of 5 trials" in said and "minutes on" in said and "MB of memory" in said
    assert not (folder / "o").exists()
    whole = kept_trials.collect
    done = []

    def stops(*arguments, **more):
        if done:
            raise KeyboardInterrupt("interrupted; the same command resumes")
        done.append(whole(*arguments, **more))
        return done[0]

    monkeypatch.setattr(kept_trials, "collect", stops)
    assert main.main(call) == 130
    assert list((folder / "o").glob("study_parts/000/*.npz"))
    monkeypatch.setattr(kept_trials, "collect", whole)
    assert main.main(call) == 0
    names = ["report.html", "study.json", "study.png", "trials.csv"]
    assert sorted(x.name for x in (folder / "o").iterdir()) == names
    found = json.loads((folder / "o" / "study.json").read_text())
    assert [row["name"] for row in found["variants"]] == ["as it is", "people"]
    assert found["variants"][1]["settings"] == {"life.people": 4}
    assert all(row["success"]["value"] == 1.0 for row in found["variants"])
    assert found["variants"][1]["against_first"]["success"]["pairs"] == 5
    assert len((folder / "o" / "trials.csv").read_text().splitlines()) == 11
    said = capsys.readouterr().out
    assert "as it is" in said and "- All variants succeed equally often" in said
    page = (folder / "o" / "report.html").read_text()
    assert "All variants succeed equally often" in page and "people: life: people 4" in page
