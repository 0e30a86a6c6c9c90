import numpy as np
import pytest

from experiments import ground_truth
from jaxslam.simulation import worlds

ROOM = worlds.outline([(0.0, 0.0, 4.0, 2.0)])
SIDE = 4.0
TRIANGLE = worlds.polyline([(0, 0), (SIDE, 0), (SIDE / 2, SIDE * np.sqrt(0.75)), (0, 0)])


def in_order(x):
    return x[np.lexsort(np.round(x, 6).T)]


def test_junctions_of_a_room_are_one_half_width_from_its_short_sides():
    found = ground_truth.junctions(ROOM, ground_truth.FreeSpace(ROOM))
    np.testing.assert_allclose(in_order(found.xy), [[1.0, 1.0], [3.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(found.clearance, 1.0, atol=1e-9)
    np.testing.assert_allclose(found.min_angle, np.pi / 2, atol=1e-9)


def test_the_junction_of_a_triangle_is_the_centre_of_its_incircle():
    radius = SIDE / np.sqrt(12)
    found = ground_truth.junctions(TRIANGLE, ground_truth.FreeSpace(TRIANGLE))
    np.testing.assert_allclose(found.xy, [[SIDE / 2, radius]], atol=1e-9)
    np.testing.assert_allclose(found.clearance, radius, atol=1e-9)
    np.testing.assert_allclose(found.min_angle, 2 * np.pi / 3, atol=1e-9)


@pytest.mark.parametrize(
    "walls, corners, cosine",
    [
        (ROOM, [[0, 0], [4, 0], [0, 2], [4, 2]], 0.0),
        (TRIANGLE, [[0, 0], [SIDE, 0], [SIDE / 2, SIDE * np.sqrt(0.75)]], 0.5),
    ],
)
def test_corners_are_where_walls_meet(walls, corners, cosine):
    found = ground_truth.corners(walls)
    np.testing.assert_allclose(in_order(found.xy), in_order(np.array(corners, float)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=-1), 1.0)
    np.testing.assert_allclose(
        np.sum(found.directions[:, 0] * found.directions[:, 1], -1), cosine, atol=1e-9
    )


def test_a_wall_that_ends_on_another_makes_two_corners_and_a_bend_in_line_none():
    found = ground_truth.corners(np.array([[0.0, 0, 4, 0], [4.0, 0, 6, 0], [1.0, 0, 1, 1]]))
    np.testing.assert_allclose(found.xy, [[1.0, 0.0]] * 2)
    np.testing.assert_allclose(found.directions, [[[0, 1], [1, 0]], [[0, 1], [-1, 0]]], atol=1e-9)


def test_a_wall_hides_what_is_behind_it():
    walls = np.array([[1.0, -1.0, 1.0, 1.0]])
    points = np.array([[[0.5, 0.0], [2.0, 0.0], [2.0, 1.9], [2.0, 2.1], [-2.0, 0.0]]])
    seen = ground_truth.in_sight(np.zeros((1, 2)), points, walls)
    np.testing.assert_array_equal(seen, [[True, False, False, True, True]])


def test_free_space_is_the_inside_of_the_largest_room():
    walls = np.vstack([ROOM, worlds.outline([(5.0, 0.0, 6.0, 1.0)])])
    points = np.array([[2.0, 1.0], [0.2, 0.2], [5.5, 0.5], [4.5, 1.0], [-1.0, 1.0], [99.0, 0.0]])
    inside = ground_truth.FreeSpace(walls).contains(points)
    np.testing.assert_array_equal(inside, [True, True, False, False, False, False])
