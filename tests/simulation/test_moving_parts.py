"""What may move in a world: doors are in its openings, furniture is moved to where it fits."""

import numpy as np

from jaxslam.simulation import buildings, moving_parts, worlds
from jaxslam.simulation.moving_parts import Moves
from jaxslam.simulation.path_checks import check_path_in_world
from jaxslam.simulation.path_following import densify

BOX = np.array([(0, 0, 1, 0), (1, 0, 1, 1), (1, 1, 0, 1), (0, 1, 0, 0)], float)
ROOM = 8.0 * BOX
PATH = densify([(1.0, 1.0), (7.0, 1.0)])


def middles(doors):
    return (doors[:, :2] + doors[:, 2:]) / 2


def test_doors_of_a_random_building_are_in_its_openings():
    doors = moving_parts.doors_of_building("random:3")
    length = np.hypot(*(doors[:, 2:] - doors[:, :2]).T)
    assert len(doors) > 3 and length.min() > 0.7 and length.max() < 1.3


def test_doors_are_found_where_they_are_known_to_be():
    assert len(moving_parts.doors_by_name("office")) == 13
    known = moving_parts.doors_of_building("random:3")
    found = moving_parts.find_doors(buildings.named_building("random:3").world.walls)
    gap = np.linalg.norm(middles(known)[:, None] - middles(found)[None], axis=-1)
    assert np.all(gap.min(axis=1) < 0.2)
    own = found[gap.argmin(axis=1)]
    width = np.hypot(*(own[:, 2:] - own[:, :2]).T)
    np.testing.assert_allclose(width, np.hypot(*(known[:, 2:] - known[:, :2]).T), atol=0.16)


def test_loose_pieces_are_closed_small_and_touch_nothing():
    chair = 0.5 * BOX + [3, 3, 3, 3]
    at_wall = 0.5 * BOX + [0, 5, 0, 5]  # shares the line of the west wall
    hall = 3.0 * BOX + [4, 4, 4, 4]  # too large
    line = np.array([(2.0, 5.0, 2.5, 5.0)])
    walls = np.concatenate([ROOM, chair, at_wall, hall, line])
    found = moving_parts.loose_pieces(walls)
    np.testing.assert_array_equal(found, [-1] * 4 + [0] * 4 + [-1] * 9)


def test_moved_furniture_keeps_its_shape_and_fits():
    rng = np.random.default_rng(0)
    chairs = [0.4 * BOX + np.tile(rng.uniform(2.0, 7.0, 2), 2) for _ in range(3)]
    chairs = [chairs[0], chairs[0] + [2, 0, 2, 0], chairs[0] + [0, 2, 0, 2]]
    walls = np.concatenate([ROOM, *chairs])
    found = moving_parts.move_furniture(walls, PATH, Moves(1.0, 0.8), 4)
    assert found.pieces == 3 and len(found.before) == len(found.after) == 12
    np.testing.assert_array_equal(found.fixed, ROOM)
    size = [np.hypot(*(x[:, 2:] - x[:, :2]).T) for x in (found.before, found.after)]
    np.testing.assert_allclose(*size)
    middle = [x.reshape(3, -1, 2).mean(axis=1) for x in (found.before, found.after)]
    np.testing.assert_allclose(np.hypot(*(middle[1] - middle[0]).T), 0.8)
    moved = worlds.World(np.concatenate([found.fixed, found.after]))
    assert check_path_in_world(PATH, moved).clearance > 0.4
    one = moving_parts.move_furniture(walls, PATH, Moves(0.4, 0.8), 4)
    assert {tuple(x) for x in one.after} < {tuple(x) for x in found.after}


def test_what_has_no_other_place_stays():
    tight = np.concatenate([0.8 * BOX + [3, 3, 3, 3], 1.0 * BOX + [2.9, 2.9, 2.9, 2.9]])
    found = moving_parts.move_furniture(np.concatenate([ROOM, tight]), PATH, Moves(1.0, 0.5), 0)
    assert found.pieces <= 1 and len(moving_parts.loose_pieces(tight)) == 8
    none = moving_parts.move_furniture(ROOM, PATH, Moves(1.0), 0)
    assert none.pieces == 0 and not len(none.before)
