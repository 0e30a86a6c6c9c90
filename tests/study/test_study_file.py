"""Files of studies: what they ask for, and what is refused in one line."""

import numpy as np
import pytest

from jaxslam.io.errors import InputError
from jaxslam.study import study_file

BASE = """
trials = 20
seed = 4
[base]
world = "random:7"
drive = "patrol"
life.people = 5
"""


def read(tmp_path, text):
    file = tmp_path / "s.toml"
    file.write_text(text)
    return study_file.read(file)


def test_every_combination_is_a_variant_of_the_base(tmp_path):
    found = read(
        tmp_path,
        BASE + '[vary]\nscanner = ["LDS-01", "RPLidar A1"]\nlife.missing = [0.0, 0.1, 0.2]\n',
    )
    assert (found.num_trials, found.seed, found.success_distance) == (20, 4, 0.5)
    assert [name for name, _ in found.variants][:2] == ["LDS-01, missing 0", "LDS-01, missing 0.1"]
    assert len(found.variants) == 6 and found.varied == ("scanner", "life.missing")
    assert found.variants[5][1] == {
        "world": "random:7",
        "drive": "patrol",
        "life.people": 5,
        "scanner": "RPLidar A1",
        "life.missing": 0.2,
    }


def test_variants_one_by_one_and_a_base_alone(tmp_path):
    text = '[[variant]]\nname = "slow"\nmax_speed = 0.3\n[[variant]]\nlife.people = 20\n'
    found = read(tmp_path, BASE + text)
    assert [name for name, _ in found.variants] == ["slow", "people 20"]
    assert found.variants[1][1]["life.people"] == 20 and set(found.varied) == {
        "max_speed",
        "life.people",
    }
    alone = read(tmp_path, BASE)
    assert [name for name, _ in alone.variants] == ["base"] and alone.varied == ()


@pytest.mark.parametrize("method", ["sobol", "latin"])
def test_samples_fill_their_box_evenly(tmp_path, method):
    text = f'[sample]\nmethod = "{method}"\ncount = 16\nlife.missing = [0.1, 0.5]\n'
    text += "max_speed = [0.2, 1.0]\n"
    found = read(tmp_path, BASE + text)
    points = np.array([[own["life.missing"], own["max_speed"]] for _, own in found.variants])
    cells = np.floor((points - [0.1, 0.2]) / [0.4, 0.8] * 16)
    for axis in cells.T:
        assert sorted(axis) == list(range(16))  # one in each sixteenth
    again = read(tmp_path, BASE + text)
    assert again.variants == found.variants
    whole = read(tmp_path, BASE + "[sample]\ncount = 8\nlife.people = [0, 40]\n")
    assert all(isinstance(own["life.people"], int) for _, own in whole.variants)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trails = 3\n", "s.toml: trails is not known; did you mean trials?"),
        ("trials = 0\n", "s.toml: trials: is 0, not between 1 and 1000000"),
        ("trials = 2.5\n", "s.toml: trials: is 2.5, not a whole number"),
        ("success_m = true\n", "s.toml: success_m: is True, not a number"),
        ("[base]\nlife.persons = 3\n", "s.toml: base: life.persons is not known"),
        ("[base]\nlife.missing = 1.5\n", "base: life.missing: is 1.5, not between 0 and 1"),
        ('[base]\nmax_speed = "fast"\n', "base: max_speed: is 'fast', not a number"),
        ('[base]\ndrive = "zigzag"\n', "base: drive: is 'zigzag', not patrol or route"),
        ("[base]\nworld = 3\n", "base: world: is 3, not name or file of the building"),
        ("base = 3\n", "s.toml: base: is no table"),
        ("[vary]\n", "s.toml: vary: is empty; name a setting and its values"),
        ("[vary]\nmax_speed = 3\n", "vary.max_speed: is no list of values"),
        (
            "[vary]\nmax_speed = [1, 1.0]\n",
            "variants: 'max_speed 1' and 'max_speed 1' are the same",
        ),
        ("[vary]\nmax_speed = [1]\n[sample]\ncount = 3\n", "vary: and sample are both there"),
        ('[[variant]]\nname = "a"\n[[variant]]\nname = "a"\nmax_speed = 2\n', "two are called 'a'"),
        ("[sample]\nmax_speed = [1, 1]\n", "sample.max_speed: goes from 1.0 to 1.0"),
        ('[sample]\nscanner = ["a", "b"]\n', "sample.scanner: is not [from, to] of a number"),
        ('[sample]\nmethod = "grid"\n', "sample.method: is 'grid', not sobol or latin"),
        ("[sample]\ncount = 4\n", "sample: is empty"),
        ("[base\n", "is not TOML"),
    ],
)
def test_what_is_refused_is_one_line(tmp_path, text, message):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_too_many_variants_are_refused_before_they_are_made(tmp_path):
    values = ", ".join(map(str, range(1, 40)))
    text = f"[vary]\nmax_speed = [{values}]\nlife.people = [{values}]\nencoder_noise = [{values}]\n"
    with pytest.raises(InputError, match="asks for 59319 variants, more than 1000"):
        read(tmp_path, text)
