"""Paths through walls, or out of the building, are refused; others are measured."""

import re

import numpy as np
import pytest

from jaxslam.simulation import worlds
from jaxslam.simulation.path_checks import TOUCH, check_line_in_world, check_path_in_world
from jaxslam.simulation.worlds import World, named, outline, polyline

ROOM = World(outline([(0.0, 0.0, 6.0, 4.0)], [(3.0, 0.0, 3.2, 3.0)]))  # a wall from y 0 to 3


def test_the_drive_of_the_office_is_accepted():
    found = check_path_in_world(worlds.waypoints("office"), named("office"))
    assert found.open_share == 0.0  # it is closed
    assert 0.3 < found.clearance < 1.0


def test_clearance_is_the_distance_of_the_nearest_wall():
    assert check_path_in_world([[1, 1], [1, 2.5]], ROOM).clearance == pytest.approx(1.0)
    found = check_path_in_world([[1, 2], [1, 3.5], [2, 3.5], [5, 3.6]], ROOM)
    assert found.clearance == pytest.approx(0.4) and found.leg == 2  # below y 4
    np.testing.assert_allclose(found.seen, (6.0, 4.0))
    alcove = check_path_in_world([[1, 1], [1, 1.6]], ROOM).seen  # the wall hides what is behind
    assert alcove[0] < 6.0 and alcove[1] == pytest.approx(4.0)


@pytest.mark.parametrize(
    "path, message",
    [
        ([[1, 1], [5, 1]], "goes through a wall at x 3.00, y 1.00 m, from waypoint 1 to 2"),
        ([[1, 1], [1, 2], [1, 3.5], [4, 2]], "wall at x 3.00, y 2.50 m, from waypoint 3 to 4"),
        ([[1, 1], [3, 2]], "goes through a wall at x 3.00, y 2.00 m"),  # ends in it
        ([[1, 1], [3, 3], [5, 3.5]], "goes through a wall at x 3.00, y 3.00 m"),  # at its corner
        ([[1, 3], [1, 4], [2, 4]], "goes through a wall at x 1.00, y 4.00 m"),  # along it
        ([[1, 3 + TOUCH / 2], [5, 3 + TOUCH / 2]], "goes through a wall at x 3.00"),  # its end
        ([[1, 1], [1, 9]], "goes through a wall at x 1.00, y 4.00 m"),
        ([[-1, 2], [1, 2]], r"starts at x -1.00, y 2.00 m, which is outside: \d+% of all direct"),
    ],
)
def test_paths_that_cannot_be_driven_are_refused(path, message):
    with pytest.raises(ValueError, match=message):
        check_path_in_world(np.array(path, float), ROOM)


@pytest.mark.parametrize("height", [2.0, 1.7, 0.1 + 0.2])
@pytest.mark.parametrize("gap", [0.0, 1e-6])
def test_walls_that_meet_end_to_end_have_no_gap_between_them(height, gap):
    """Neither is crossed strictly by a path through the point in which both end."""
    wall = [[3.0, 0.0, 3.0, height], [3.0, height + gap, 3.0, 4.0]]
    world = World(np.concatenate([outline([(0.0, 0.0, 6.0, 4.0)]), wall]))
    for start in (0.7, 0.8, 1.0 / 3.0):
        with pytest.raises(ValueError, match="goes through a wall at x 3.00"):
            check_path_in_world([[start, height], [5.1, height]], world)


def test_what_was_driven_may_go_through_a_wall_though_its_path_does_not():
    """A turn around the end of a wall is cut: the message says who, and where."""
    path = np.array([[2.9, 1.0], [2.9, 3.2], [3.3, 3.2], [3.3, 1.0]])
    assert check_path_in_world(path, ROOM).clearance == pytest.approx(0.1)
    check_line_in_world(path, ROOM, "the cart")
    with pytest.raises(ValueError, match=r"the cart goes through a wall at x 3.00, y 2.65 m"):
        check_line_in_world(np.delete(path, 2, axis=0), ROOM, "the cart")


def test_a_path_may_look_out_of_an_open_building_but_not_leave_it():
    walls = polyline([(6, 2.5), (6, 4), (0, 4), (0, 0), (6, 0), (6, 1.5)])  # a door, 1 m wide
    inside = np.array([[1.0, 1.0], [4.0, 2.0]])
    share = check_path_in_world(inside, World(walls)).open_share
    angles = [2 * np.arctan2(0.5, 5.0) / (2 * np.pi), 2 * np.arctan2(0.5, 2.0) / (2 * np.pi)]
    assert angles[0] < share < angles[1]
    with pytest.raises(
        ValueError, match=r"leaves the building at x 6.8\d, y 2.00 m, which is outside"
    ):
        check_path_in_world([[1.0, 2.0], [8.0, 2.0]], World(walls))


@pytest.mark.parametrize("seed", range(5))
def test_crossings_are_those_of_shapely(seed):
    shapely = pytest.importorskip("shapely", reason="pip install 'jaxslam[test]'")
    rng = np.random.default_rng(seed)
    box = outline([(0.0, 0.0, 10.0, 10.0)])
    starts = rng.uniform(1, 9, (6, 2))
    inner = np.hstack([starts, np.clip(starts + rng.normal(size=(6, 2)), 0.5, 9.5)])
    world = World(np.vstack([box, inner]))
    lines = shapely.MultiLineString([wall.reshape(2, 2) for wall in world.walls])
    for _ in range(20):
        path = rng.uniform(0.2, 9.8, (4, 2))
        distance = shapely.distance(shapely.LineString(path), lines)
        if distance == 0.0:
            with pytest.raises(ValueError, match="goes through a wall") as of_path:
                check_path_in_world(path, world)
            with pytest.raises(ValueError, match="line goes through a wall") as of_line:
                check_line_in_world(path, world, "line")
            where = r"at x .* y [\d.]+ m"
            assert re.findall(where, str(of_line.value)) == re.findall(where, str(of_path.value))
        else:
            check_line_in_world(path, world, "line")
            assert check_path_in_world(path, world).clearance == pytest.approx(distance)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="path"):
        check_path_in_world([1.0, 2.0], ROOM)
