"""`jaxslam route MAP --from X Y --to X Y|ROOM`: files, printed legs, refusals."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from jaxslam.cli import main, route_command
from jaxslam.core.maps import OccupancyMap
from jaxslam.core.regions import Door, Region, Regions
from jaxslam.io import ros_map

FILES = {"metrics.json", "route.json", "route.png"}
ORIGIN = np.array([-5.0, -2.0, 0.0])


@pytest.fixture(scope="session")
def floor(tmp_path_factory):
    """A map folder: two rooms, x from -4.5 to -0.1 and 0.1 to 4.5, a door of 0.8 m at y = 0."""
    folder = tmp_path_factory.mktemp("floor")
    free = np.zeros((100, 50), bool)
    free[5:49, 5:45] = free[51:95, 5:45] = True
    free[49:51, 16:24] = True
    grid = OccupancyMap(~free, free, 0.1, ORIGIN)
    ros_map.write(folder / "a.yaml", grid)
    assert main.main(["map", str(folder / "a.yaml"), "--out", str(folder / "map")]) == 0
    ros_map.write(folder / "map" / "map.yaml", grid)
    return folder / "map"


@pytest.fixture
def rooms(monkeypatch):
    """The rooms of the floor, in every folder."""
    found = []
    for k, (x, x_end) in enumerate([(-4.5, -0.1), (0.1, 4.5)]):
        polygon = np.array([(x, -1.5), (x_end, -1.5), (x_end, 2.5), (x, 2.5)])
        found.append(Region(f"room_{k + 1}", "room", polygon, 17.6, (0,), (1 - k,)))
    jambs = np.array([(0.0, -0.4), (0.0, 0.4)])
    door = Door("door_1", np.zeros(2), jambs, 0.8, (0, 1))
    regions = Regions(np.zeros((0, 0), np.int32), tuple(found), (door,), 0.1, ORIGIN)
    read = route_command.read_map_folder
    monkeypatch.setattr(
        route_command, "read_map_folder", lambda path: read(path)._replace(regions=regions)
    )
    return regions


def run(*arguments):
    return main.main(["route", *map(str, arguments)])


def test_a_route_is_written_and_printed(floor, rooms, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(floor, "--from", -3, -1, "--to", 3, 1.5, "--out", out) == 0
    assert {file.name for file in out.iterdir()} == FILES
    said, errors = capsys.readouterr()
    assert errors == ""
    first, second = said.splitlines()[2:4]
    assert first.startswith("  1. heading ") and first.endswith(
        " m in room_1 to the door door_1 (0.80 m wide)"
    )
    assert second.endswith(" m in room_2 to the goal")
    found = json.loads((out / "route.json").read_text())
    numbers = json.loads((out / "metrics.json").read_text())
    assert found["start"] == [-3.0, -1.0] and found["goal"] == [3.0, 1.5]
    polyline = np.array(found["polyline"])
    length = np.hypot(*np.diff(polyline, axis=0).T).sum()
    assert found["length_m"] == numbers["length_m"] == pytest.approx(length)
    assert numbers["straight_m"] == 6.5 <= length < 7.0
    assert sum(leg["length_m"] for leg in found["legs"]) == pytest.approx(length)
    assert [leg["door"] for leg in found["legs"]] == ["door_1", None]
    assert [leg["region"] for leg in found["legs"]] == ["room_1", "room_2"]
    assert found["legs"][0]["door_width_m"] == 0.8 and found["legs"][1]["door_width_m"] is None
    assert 0.2 < found["narrowest_m"] <= 0.4 and numbers["doors"] == 1
    assert numbers["robot_radius_m"] == found["robot_radius_m"] == 0.25


def test_the_picture_has_its_size_and_shows_the_route(floor, rooms, tmp_path):
    run(floor, "--from", -3, -1, "--to", 3, 1.5, "--out", tmp_path)
    image = np.asarray(Image.open(tmp_path / "route.png").convert("RGB")).astype(int)
    assert image.shape[1] == 900 and 400 < image.shape[0] < 700
    blue = np.abs(image - [0x00, 0x72, 0xB2]).max(axis=2) < 30
    columns = np.flatnonzero(blue[: image.shape[0] - 80].any(axis=0))
    assert np.ptp(columns) > 430  # 6 m of 11 m, without the circles at its ends


@pytest.mark.parametrize(
    "ends", [("--from=-3", "-1", "--to", "3,1.5"), ("--to", "3", "1.5", "--from", "-3e0 -1.")]
)
def test_points_may_be_written_in_several_forms(floor, tmp_path, ends):
    assert run(floor, *ends, "--out", tmp_path) == 0
    assert json.loads((tmp_path / "route.json").read_text())["start"] == [-3.0, -1.0]


def test_a_room_is_a_goal(floor, rooms, tmp_path, capsys):
    assert run(floor, "--from", -3, -1, "--to", "room_2", "--out", tmp_path) == 0
    found = json.loads((tmp_path / "route.json").read_text())
    assert found["goal"][0] > 0.9 and found["goal_region"] == "room_2"
    assert capsys.readouterr().out.splitlines()[3].endswith(" m in room_2 to room_2")


def test_without_an_occupancy_map_a_note_says_so(floor, tmp_path, capsys):
    shutil.copy(floor / "map.geojson", tmp_path)
    assert run(tmp_path, "--from", -3, 0.5, "--to", 3, 0.5, "--out", tmp_path / "out") == 0
    assert capsys.readouterr().out.startswith("note: no map.yaml: obstacles beside")


@pytest.fixture
def refused(tmp_path, capsys):
    """Function that runs bad arguments, checks how they are refused, and returns the line."""

    def refuse(*arguments):
        before = sorted(tmp_path.rglob("*"))
        assert run(*arguments, "--out", tmp_path / "results") == 2
        line = capsys.readouterr().err
        assert line.startswith("jaxslam: error: ") and line.count("\n") == 1
        assert sorted(tmp_path.rglob("*")) == before
        return line.removeprefix("jaxslam: error: ").rstrip()

    return refuse


@pytest.mark.parametrize(
    "start, goal, line",
    [
        ("1", "3 1", "--from: has one number, not two; give x y [m], as in 1.5 -2"),
        ("-3 -1", "3", "--to: has one number, not two; give x y [m], as in 1.5 -2, or a room"),
        ("-3 -1", "3 1 2", "--to: has 3 numbers, not two; give"),
        ("-3 -1", "3 east", "--to: 'east' is not a number; give"),
        ("nan 1", "3 1", "--from: nan 1 is not finite; give"),
        ("-3 -1", "3 -inf", "--to: 3 -inf is not finite; give"),
        ("-3 -1", "room_7", "--to: 'room_7', no room of the map; it has room_2, room_1"),
        ("0 1", "3 1", "--from: (0.00, 1.00) is in a wall"),
        ("-3 -1", "0.05 -0.35", "--to: (0.05, -0.35) is 0.05 m from an obstacle, nearer than the"),
        ("-30 -1", "3 1", "--from: (-30.00, -1.00) is outside of the map, which reaches x -5.0 to"),
    ],
)
def test_bad_starts_and_goals_are_one_line(refused, floor, rooms, start, goal, line):
    assert refused(floor, "--from", *start.split(), "--to", *goal.split()).startswith(line)


def test_no_route_is_one_line(refused, floor, rooms):
    line = refused(floor, "--from", -3, -0.5, "--to", 3, 1, "--robot-radius", 0.6)
    assert line == (
        f"{floor}: no route leads from (-3.00, -0.50) to (3.00, 1.00): its door door_1 is 0.80 m "
        "wide, the robot 1.20 m"
    )


def test_a_deleted_edge_is_no_route(refused, floor, tmp_path):
    for name in ("map.geojson", "map.yaml", "map.pgm"):
        shutil.copy(floor / name, tmp_path)
    path = tmp_path / "map.geojson"
    content = json.loads(path.read_text())
    west = [f for f in content["features"] if f["geometry"]["type"] == "MultiLineString"]
    for edge in west:
        line = edge["geometry"]["coordinates"][0]
        if line[-1][0] < line[0][0]:
            content["features"].remove(edge)
    path.write_text(json.dumps(content))
    assert run(tmp_path, "--from", -3, 1, "--to", 3, -1, "--out", tmp_path / "east") == 0
    shutil.rmtree(tmp_path / "east")
    line = refused(tmp_path, "--from", 3, -1, "--to", -3, 1)
    assert line.endswith(": one-way arcs lead in the other direction")


def test_bad_folders_and_radii_are_one_line(refused, tmp_path, floor):
    ends = ("--from", -3, -1, "--to", 3, 1)
    assert "none: does not exist; name an output folder" in refused(tmp_path / "none", *ends)
    assert refused(tmp_path, *ends).startswith(f"{tmp_path}: holds no map.geojson; name")
    assert refused(floor, *ends, "--robot-radius", "nan").startswith("--robot-radius: nan is not")
    shutil.copytree(floor, tmp_path / "bare")
    (tmp_path / "bare" / "rooms.json").unlink()
    line = refused(tmp_path / "bare", "--from", -3, -1, "--to", "room_1")
    assert line.startswith("--to: 'room_1', and the")


def test_a_route_is_not_written_into_the_folder_of_the_map(floor, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "out"
    shutil.copytree(floor, folder)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    (tmp_path / "link").symlink_to(folder)
    for given, out in ((folder, folder), (folder / "map.geojson", tmp_path / "link")):
        assert run(given, "--from", -3, -1, "--to", 3, 1, "--out", out) == 2
        assert capsys.readouterr().err == (
            f"jaxslam: error: --out: {out} is the folder of the map, whose results would be "
            "replaced; name another folder\n"
        )
    monkeypatch.chdir(tmp_path)
    assert run("out", "--from", -3, -1, "--to", 3, 1) == 0
    assert {file.name for file in (tmp_path / "route").iterdir()} == FILES
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_the_help_says_where_in_a_room_a_route_ends(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        run("--help")
    said = capsys.readouterr().out  # the line breaks of the docstring are not in it
    assert "as in room_12: the route ends on an arc inside, 1 m from its doors if it is" in said


def test_an_interrupt_leaves_nothing_behind(floor, tmp_path, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(route_command, "draw_route", stop)
    assert run(floor, "--from", -3, -1, "--to", 3, 1, "--out", tmp_path / "out") == 130
    assert not list(tmp_path.iterdir())
