"""Files of what goes wrong: their keys are those of `Life`, wrong ones are one line."""

import jax
import pytest

from jaxslam.io import life_file
from jaxslam.io.errors import InputError
from jaxslam.simulation import life_defaults, named
from jaxslam.simulation.life import check_numbers_of


def read(tmp_path, text, name="life.toml"):
    file = tmp_path / name
    file.write_text(text)
    return life_file.read(file)


def test_values_have_units_and_become_the_parts_of_life(tmp_path):
    found = read(tmp_path, life_file.EXAMPLE)
    assert found == {"people": 5, "speed": 0.8, "missing": 0.05, "closed": 0.2, "slip": 0.01}
    parts = life_file.parts(found)
    assert parts["traffic"].people == 5 and parts["ranges"].missing == 0.05
    assert parts["wheels"].slip == 0.01 and parts["furniture"].moved == 0.0
    assert read(tmp_path, '{"spot": "1 deg", "std_by_incidence": -0.5}', "l.json") == {
        "spot": pytest.approx(0.0174533, rel=1e-5),
        "std_by_incidence": -0.5,
    }
    assert life_file.describe(found).startswith("people 5, speed 0.8, missing 0.05")


def test_what_the_file_takes_the_simulation_takes(tmp_path):
    """Limits of the file are within those of the simulation, for every key."""
    for key in life_file.SETTINGS:
        table = life_file.Table("f", "life", {})
        accepted = []
        for given in (-1.0, 0.0, 1e-6, 0.5, 1.0, 7.0):
            try:
                accepted.append(life_file.number(table, key, given))
            except InputError as error:
                assert key in str(error)
        assert accepted
        for value in accepted:
            for name, part in life_file.parts({key: value}).items():
                if name not in ("furniture", "crowding"):
                    check_numbers_of(name, part)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("persons = 3\n", "life.toml: life.persons: is an unknown key"),
        ("misssing = 0.1\n", "did you mean missing"),
        ("missing = 1.5\n", "life.missing: 1.5 is not between 0 and 0.99"),
        ("dropped = 1\n", "life.dropped: 1 is not between 0 and 0.99"),
        ("black = 1.5\n", "life.black: 1.5 is not between 0 and 1"),
        ('missing = "5 m"\n', "life.missing: '5 m' has the unit 'm'; units are %"),
        ('people = 2\nspeed = "3 lb"\n', "life.speed: '3 lb' has the unit 'lb'; units are m/s, cm"),
        ("people = 2.5\n", "life.people: 2.5 is no whole number"),
        ('people = "2 m"\n', "units are none"),
        ("people = true\n", "life.people: True is no number"),
        ("speed = 1\n", "life.speed: says nothing without people; add people"),
        (
            "people = 0\ncarts = 1\n",
            "life.carts: says nothing where people is 0; give people above",
        ),
        (
            "moved = 0.5\nmoved_at = 0\n",
            "life.moved: says nothing where moved_at is 0; give moved_",
        ),
        ("slip = 0.1\nslip_share = 0\n", "life.slip: says nothing where slip_share is 0; give"),
        ("people = 2\npeople_per_metre = 0.1\n", "life.people_per_metre: says nothing beside"),
        ("# nothing\n", "life.toml: asks for nothing; write KEY = NUMBER"),
        ("resolution = 10\n", "life.resolution: 10 is not between 0 and 1 m; check its unit"),
        ("std_by_incidence = -20\n", "life.std_by_incidence: -20 is not between -10 and 10"),
        ("moved_at = 30\n", "life.moved_at: says nothing without moved"),
        ("[life]\npeople = 3\n", "life.life: is an unknown key"),
        ("people = \n", "is not TOML"),
    ],
)
def test_what_is_refused_is_one_line(tmp_path, text, message):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_typical_is_the_life_of_the_defaults(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = life_file.read("typical")
    path = [(0.0, 0.0), (300.0, 0.0)]
    parts, wanted = life_file.parts(found), life_defaults.typical_life(named("office"), path)
    for name in ("ranges", "wheels"):
        expected = jax.tree.map(float, getattr(wanted, name))
        assert jax.tree.map(float, parts[name])._asdict() == pytest.approx(
            expected._asdict(), rel=1e-6
        )
    assert life_file.number_of_people(found, path) == float(wanted.traffic.people) == 4
    assert life_file.number_of_people(found | {"people": 9}, path) == 9
    assert life_file.unused([found]) is None
