"""What goes wrong, on the command line: in a line; wrong files are one line, too; open worlds."""

import json

import numpy as np
import pytest

from jaxslam.cli import main
from jaxslam.cli.life_options import check_moved_at, leaving, leaving_note, life_of
from jaxslam.cli.world_options import Building, read_building
from jaxslam.core.scan import Lidar
from jaxslam.io.errors import InputError
from jaxslam.simulation import densify
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

SQUARE = np.array([(0, 0, 8, 0), (8, 0, 8, 8), (8, 8, 0, 8), (0, 8, 0, 0)], float)
CHAIR = np.array([(4, 4, 4.5, 4), (4.5, 4, 4.5, 4.5), (4.5, 4.5, 4, 4.5), (4, 4.5, 4, 4)])
PATH = densify([(1.0, 2.0), (7.0, 2.0)])
ROUND = Lidar(num_beams=360, angle_min=-np.pi, angle_increment=np.pi / 180, range_max=5.0)


def building(walls):
    return Building(World(np.asarray(walls)), PATH, (), "a room")


def test_doors_and_furniture_are_found_where_they_are_asked_for():
    office = read_building("office")
    found = life_of(office, {"closed": 0.3, "people": 2}, slots=4)
    assert len(found.life.movers.doors) == 13 and len(found.life.movers.people) == 4
    assert found.note == "closed 0.3, people 2; 13 doors"
    room = building(np.concatenate([SQUARE, CHAIR]))
    crowded = life_of(office, {"people_per_metre": 0.1, "speed": 0.5})
    people = int(crowded.life.traffic.people)
    assert people > 3 and crowded.note.endswith(f": people {people}")
    assert len(crowded.life.movers.people) == people
    moved = life_of(room, {"moved": 1.0, "moved_at": 9.0, "moved_by": 1.0})
    assert moved.note.endswith("1 pieces of furniture are moved")
    np.testing.assert_allclose(moved.world.walls, SQUARE)
    np.testing.assert_allclose(moved.life.movers.before, CHAIR)
    assert len(moved.life.materials) == 4 and float(moved.life.traffic.moved_at) == 9.0
    robot = Robot(scan_period=0.5)
    check_moved_at(moved.life, robot, 19)
    with pytest.raises(InputError, match="moved_at is 9 s, and the drive ends after 8 s; give an"):
        check_moved_at(moved.life, robot, 17)
    check_moved_at(found.life, robot, 2)  # nothing is moved, at infinity
    with pytest.raises(
        InputError, match="moved needs loose furniture; none can be moved in a room"
    ):
        life_of(building(SQUARE), {"moved": 1.0, "moved_at": 9.0})
    with pytest.raises(InputError, match="closed needs doors, and none are found in a room"):
        life_of(building(SQUARE), {"closed": 0.5})


def test_the_share_of_beams_that_leave_is_that_of_the_open_angle():
    """Without its north wall: from the middle of the south wall the opening is seen at 2 atan."""
    open_room = building(SQUARE[[0, 1, 3]])
    found = leaving(ROUND, open_room.world, Robot(), PATH)
    x = np.linspace(1.0, 7.0, 200)
    angle = np.mean(np.arctan2(x, 6.0) + np.arctan2(8.0 - x, 6.0))
    np.testing.assert_allclose(float(found.no_wall), angle / (2 * np.pi), atol=0.01)
    assert float(found.beyond_range) > float(found.no_wall)
    assert leaving_note(found, 5.0).startswith(f"{float(found.no_wall):.1%} of the beams along")
    assert float(leaving(ROUND, World(SQUARE), Robot(), PATH).no_wall) == 0.0


def test_a_drive_that_sees_no_wall_is_refused():
    """As where walls in millimetres are taken as metres."""
    message = r"no beam along the drive meets a wall within 5 m, the walls span 8000 m x 8000 m; ch"
    with pytest.raises(InputError, match=message):
        leaving(ROUND, World(1000.0 * SQUARE), Robot(), PATH + 1000.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("persons = 3\n", "life.toml: life.persons: is an unknown key"),
        ('missing = "5 m"\n', "life.missing: '5 m' has the unit 'm'"),
        ("moved = 0.5\n", "life.moved: says nothing without moved_at"),
    ],
)
def test_a_wrong_file_is_one_line_and_nothing_is_written(text, message, tmp_path, capsys):
    (tmp_path / "life.toml").write_text(text)
    out = tmp_path / "out"
    call = ["simulate", "--life", str(tmp_path / "life.toml"), "--out", str(out)]
    assert main.main(call) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line and not out.exists()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_simulate_says_what_goes_wrong_and_makes_it_happen(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.csv").write_text("1.0,0.9\n2.2,0.9\n")
    (tmp_path / "life.toml").write_text("missing = 0.98\npeople = 2\n")
    call = ["simulate", "--path", "p.csv", "--trials", "2", "--out", "o"]
    assert main.main([*call, "--life", "life.toml"]) == 0
    said = capsys.readouterr().out
    assert "life: missing 0.98, people 2\n" in said and "of the beams along the drive leave" in said
    numbers = json.loads((tmp_path / "o" / "metrics.json").read_text())
    assert numbers["matches"] == 0.0 and numbers["landmarks"] == 0.0  # of seven beams
    assert numbers["beams_leaving"]["no_wall"] == 0.0
