"""The building and the drive of `jaxslam simulate`, before anything is compiled."""

import re

import numpy as np
import pytest

from jaxslam.cli.main import main
from jaxslam.cli.world_options import read_building
from jaxslam.core.maps import OccupancyMap
from jaxslam.io import ros_map
from jaxslam.io.errors import InputError
from jaxslam.simulation import path_following, worlds
from jaxslam.simulation.path_checks import check_path_in_world

WALLS = "0,0,6,0\n6,0,6,4\n6,4,0,4\n0,4,0,0\n3,0,3,2.5\n"


@pytest.fixture
def plan(tmp_path):
    file = tmp_path / "plan.csv"
    file.write_text(WALLS)
    return file


def path_of(folder, points, name="path.csv"):
    file = folder / name
    file.write_text("".join(f"{x},{y}\n" for x, y in points))
    return file


def test_a_built_in_world_has_its_drive_or_another_one(tmp_path):
    found = read_building("office")
    np.testing.assert_allclose(found.world.walls, worlds.named("office").walls)
    np.testing.assert_allclose(found.path, path_following.densify(worlds.waypoints("office")))
    assert found.notes == ()
    other = read_building("office", path_of(tmp_path, [(1, 1), (1, 9)]))
    np.testing.assert_allclose(other.path[:: len(other.path) - 1], [(1, 1), (1, 9)])
    room = read_building("fig07", path_of(tmp_path, [(1, 1), (1, 2)]))
    np.testing.assert_allclose(room.world.walls, worlds.named("fig07").walls)


def test_a_file_is_driven_along_its_path(plan, tmp_path):
    around = [(1, 1), (1, 3.2), (5, 3.2), (5, 1)]
    found = read_building(str(plan), path_of(tmp_path, around))
    assert found.world.walls.shape == (5, 4)
    points = np.asarray(found.path)
    gaps = np.hypot(*np.diff(points, axis=0).T)
    assert gaps.sum() == pytest.approx(2.2 + 4 + 2.2) and gaps.max() <= 0.06
    dense = path_following.densify(around, 0.001)  # as if recorded: fewer points, the same path
    again = read_building(str(plan), path_of(tmp_path, dense))
    np.testing.assert_allclose(again.path, points, atol=1e-9)


def test_what_was_found_on_the_path_is_noted(plan, tmp_path):
    with open(plan, "a") as file:
        file.write("0,0,0,0\n")
    found = read_building(str(plan), path_of(tmp_path, [(1, 0.1), (2, 0.1)]), unit="m")
    assert found.notes == (
        "left out: lines of no length (1)",
        "the path comes within 0.10 m of a wall",
    )


def test_a_drive_inside_of_a_column_is_noted(plan, tmp_path):
    with open(plan, "a") as file:
        file.write("0.5,0.5,2,0.5\n2,0.5,2,2\n2,2,0.5,2\n0.5,2,0.5,0.5\n")
    inside = read_building(str(plan), path_of(tmp_path, [(1, 1), (1.6, 1), (1.6, 1.6)]))
    assert inside.notes[-1] == "around the path walls enclose 1.5 m x 1.5 m of 6.0 m x 4.0 m"
    outside = read_building(str(plan), path_of(tmp_path, [(2.5, 1), (2.5, 3)]))
    assert not any("enclose" in note for note in outside.notes)


def test_waypoints_of_a_drawing_in_another_unit_are_in_metres(plan, tmp_path):
    path = path_of(tmp_path, [(0.4, 0.4), (0.4, 0.9)])
    found = read_building(str(plan), path, unit="ft")
    assert found.notes == (f"waypoints of {path} are in metres, whatever the unit of {plan}",)
    np.testing.assert_allclose(found.path[0], (0.4, 0.4))
    assert not any("waypoints" in x for x in read_building(str(plan), path).notes)


def test_a_path_is_in_the_coordinates_of_the_file(tmp_path):
    shift = np.array([500000.0, 5300000.0])
    rows = np.array([row.split(",") for row in WALLS.split()], float) + np.tile(shift, 2)
    plan = tmp_path / "far.csv"
    np.savetxt(plan, rows, delimiter=",")
    found = read_building(str(plan), path_of(tmp_path, np.add([(1, 1), (1, 3)], shift)))
    np.testing.assert_allclose(found.path[:: len(found.path) - 1], [(1, 1), (1, 3)])
    with pytest.raises(InputError, match=r"path.csv \(less x 500000, y 5300000 m\): path starts"):
        read_building(str(plan), path_of(tmp_path, [(1, 1), (1, 3)]))


@pytest.mark.parametrize(
    "path, message",
    [
        (None, "plan.csv: is a file, which has no drive of its own; add --drive patrol, or --path"),
        ([(1, 1), (5, 1)], "path.csv: path goes through a wall at x 3.00, y 1.00 m"),
        ([(9, 1), (9, 3)], "path.csv: path starts at x 9.00, y 1.00 m, which is outside"),
        ([(1, 1)], "path.csv: is a path shorter than 0.5 m"),
    ],
)
def test_paths_that_cannot_be_driven_end_with_one_line(plan, tmp_path, capsys, path, message):
    options = ["--world", str(plan), "--out", str(tmp_path / "out")]
    if path is not None:
        options += ["--path", str(path_of(tmp_path, path))]
    assert main(["simulate", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line)
    assert not (tmp_path / "out").exists()


def test_a_robot_that_does_not_fit_is_refused(tmp_path, plan):
    path = path_of(tmp_path, [(1, 1), (1, 3)])
    assert read_building(str(plan), path, robot_radius=0.9).path[0].tolist() == [1.0, 1.0]
    for world, file, radius in ((str(plan), path, 1.2), ("office", None, 0.6)):
        with pytest.raises(
            InputError, match=rf"within .* the robot's \[body\] reaches {radius}0 m"
        ):
            read_building(world, file, robot_radius=radius)
    with pytest.raises(InputError, match="--drive: .*radius"):
        read_building("office", drive="patrol", robot_radius=3.0)


def test_a_drive_that_is_found_keeps_the_radius_of_the_robot(plan):
    for radius in (0.3, 0.7):
        building = read_building(str(plan), drive="patrol", robot_radius=radius)
        found = check_path_in_world(building.path, building.world)
        assert radius <= found.clearance < radius + 0.5


def test_a_path_through_a_map_starts_in_free_space(tmp_path):
    pytest.importorskip("yaml", reason="pip install 'jaxslam[ros]'")
    occupied = np.zeros((60, 60), bool)
    occupied[5:55, 5:55] = True
    occupied[10:50, 10:50] = False
    free = np.zeros_like(occupied)
    free[10:50, 10:30] = True
    ros_map.write(tmp_path / "map.yaml", OccupancyMap(occupied, free, 0.1, np.zeros(3)))
    world = str(tmp_path / "map.yaml")
    found = read_building(world, path_of(tmp_path, [(1.5, 1.5), (1.5, 2.5)]))
    assert len(found.world.walls) == 8 and found.notes[1:] == ()
    through = read_building(world, path_of(tmp_path, [(1.5, 2), (4.5, 2), (4.5, 4.5)]))
    assert through.notes[1] == "1.5 m of the path are where the map is unknown"
    for start, kind in (((0.7, 0.7), "occupied"), ((1.5, 4), "unknown"), ((-1, 1), "left")):
        path = path_of(tmp_path, [start, (1.5, 1.5)])
        with pytest.raises(InputError, match=f"starts at .* m, where the map is {kind}; start in"):
            read_building(world, path)


@pytest.mark.parametrize(
    "world, options, message",
    [
        ("ofice", {}, "--world: no world named 'ofice'; there are fig04, .*office, .*and files"),
        ("office", {"unit": "m"}, "--unit: is for files; 'office' is none"),
        ("office", {"resolution": 0.1}, "--resolution: is for files"),
        ("office", {"layers": ("a",)}, "--layers: is for files"),
        ("fig04", {}, "--world: no drive named 'fig04'"),
    ],
)
def test_wrong_names_and_options_are_refused(world, options, message):
    with pytest.raises(InputError, match=message):
        read_building(world, **options)
