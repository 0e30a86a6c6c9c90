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
    assert [one.name for one in found.variants][:2] == ["LDS-01, missing 0", "LDS-01, missing 0.1"]
    assert len(found.variants) == 6 and found.varied == ("scanner", "life.missing")
    assert found.variants[5].settings == {
        "world": "random:7",
        "drive": "patrol",
        "life.people": 5,
        "scanner": "RPLidar A1",
        "life.missing": 0.2,
    }


def test_variants_one_by_one_and_a_base_alone(tmp_path):
    text = '[[variant]]\nname = "slow"\nmax_speed = 0.3\n[[variant]]\nlife.people = 20\n'
    found = read(tmp_path, BASE + text)
    assert [one.name for one in found.variants] == ["slow", "people 20"]
    assert found.variants[1].settings["life.people"] == 20 and set(found.varied) == {
        "max_speed",
        "life.people",
    }
    alone = read(tmp_path, BASE)
    assert [one.name for one in alone.variants] == ["base"] and alone.varied == ()


@pytest.mark.parametrize("method", ["sobol", "latin"])
def test_samples_fill_their_box_evenly(tmp_path, method):
    text = f'[sample]\nmethod = "{method}"\ncount = 16\nlife.missing = [0.1, 0.5]\n'
    text += "max_speed = [0.2, 1.0]\n"
    found = read(tmp_path, BASE + text)
    points = np.array(
        [
            [own["life.missing"], own["max_speed"]]
            for own in (one.settings for one in found.variants)
        ]
    )
    cells = np.floor((points - [0.1, 0.2]) / [0.4, 0.8] * 16)
    for axis in cells.T:
        assert sorted(axis) == list(range(16))  # one in each sixteenth
    again = read(tmp_path, BASE + text)
    assert again.variants == found.variants
    whole = read(tmp_path, BASE + "[sample]\ncount = 8\nlife.people = [0, 40]\n")
    assert all(
        isinstance(own["life.people"], int) for own in (one.settings for one in whole.variants)
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trails = 3\n", "s.toml: trails is not known; did you mean trials?"),
        ("trials = 0\n", "s.toml: trials: is 0, not between 1 and 1000000"),
        ("trials = 2.5\n", "s.toml: trials: is 2.5, not a whole number"),
        ("success_m = true\n", "s.toml: success_m: is True, not a number"),
        ("[base]\nlife.persons = 3\n", "s.toml: base: life.persons is not known"),
        ("[base]\nlife.missing = 1.5\n", "base.life.missing: 1.5 is not between 0 and 0.99"),
        ('[base]\nmax_speed = "fast"\n', "base.max_speed: 'fast' is no speed; write \"1.5 m/s\""),
        ('[base]\ndrive = "zigzag"\n', "base.drive: is 'zigzag', not patrol or route"),
        ("[base]\nworld = 3\n", "base.world: is 3, not name or file of the building"),
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
        ('[base]\nmax_speed = "3 lb"\n', "base.max_speed: '3 lb' has the unit 'lb'; units are m/s"),
        ("[base]\nlife.people = 1.5\n", "base.life.people: 1.5 is no whole number"),
        ('[base]\nlife.missing = "5 m"\n', "base.life.missing: '5 m' has the unit 'm'"),
        ('[cost]\nscanner = {"A1" = 3}\n', "cost.scanner: 'A1' is no value of scanner in this"),
        ("[cost]\nscaner = {}\n", "cost: scaner is not known; did you mean scanner?"),
        ("[cost]\nbase = -3\n", "cost.base: is -3, not 0 or more"),
        ("cost = 3\n", "cost: is no table of costs"),
        ("[cost]\nscanner = 3\n", "cost.scanner: is no table of costs by value"),
        (
            '[vary]\nscanner = ["a", "b"]\n[cost]\nscanner = {"a" = 3}\n',
            "cost.scanner: has no cost of scanner 'b'; add it",
        ),
        (
            '[[variant]]\nname = "a"\ncost = 2\n[[variant]]\nname = "b"\nmax_speed = 2\n',
            "variant 'b': has no cost, and others have",
        ),
        (
            '[vary]\nmax_speed = [1]\n[cost]\nmax_speed = {"1" = 3, "100 cm/s" = 4}\n',
            "cost.max_speed.100 cm/s: is another cost of 1.0",
        ),
        ("[cost]\nbase = inf\n", "cost.base: is inf, not a number"),
        ("# nothing yet\n", "s.toml: asks for nothing; see jaxslam.study.study_file"),
        ("variant = []\n", "variant: is no [[variant]]"),
        ('[[variant]]\nname = " "\n', "variant 1.name: ' ' is no text of one line"),
        ('[[variant]]\nname = "a\\nb"\n', "variant 1.name: 'a\\nb' is no text of one line"),
        ("[[variant]]\nname = 5\n", "variant 1.name: 5 is no text of one line"),
        ("success_m = 500\n", "success_m: is 500, not between 1e-06 and 100"),
        ("[base]\nmax_landmarks = 1000000\n", "base.max_landmarks: 1000000 is not between 1 and"),
        ("[base]\ntime_offset = 900\n", "base.time_offset: 900 is not between -10 and 10 s"),
    ],
)
def test_what_is_refused_is_one_line(tmp_path, text, message):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_the_unit_of_a_drawing_may_be_its_metres(tmp_path):
    for given in ('"0.1"', "0.1"):
        settings = read(tmp_path, f"[base]\nunit = {given}\n").variants[0].settings
        assert settings == {"unit": "0.1"}


def test_too_many_variants_are_refused_before_they_are_made(tmp_path):
    values = ", ".join(map(str, range(1, 40)))
    text = f"[vary]\nmax_speed = [{values}]\nlife.people = [{values}]\nsensor_factor = [{values}]\n"
    with pytest.raises(InputError, match="asks for 59319 variants, more than 1000"):
        read(tmp_path, text)


def test_costs_of_values_are_added_to_those_of_all_and_of_variants(tmp_path):
    text = '[vary]\nscanner = ["a", "b"]\nmax_speed = [0.2, "50 cm/s"]\nlife.people = [0, 3]\n'
    text += '[cost]\nbase = 100\nscanner = {"a" = 3, "b" = 5}\n'
    text += 'max_speed = {"0.2 m/s" = 10, "0.5" = 20}\nlife.people = {"0" = 0, "3" = 0.5}\n'
    found = read(tmp_path, BASE + text).variants
    own = {(v["scanner"], v["max_speed"], v["life.people"]): c for _, v, c in found}
    assert own["a", 0.2, 0] == 113.0 and own["b", 0.5, 3] == 125.5 and len(own) == 8
    listed = '[[variant]]\nname = "a"\ncost = 7\n[[variant]]\nmax_speed = 1\ncost = 1\n'
    assert [one.cost for one in read(tmp_path, BASE + listed).variants] == [7.0, 1.0]
    both = read(tmp_path, BASE + listed + "[cost]\nbase = 2\n").variants
    assert [one.cost for one in both] == [9.0, 3.0]
    assert [one.cost for one in read(tmp_path, BASE).variants] == [None]
