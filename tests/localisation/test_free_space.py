"""What a map saw to be free, against points on beams and by a law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import transform
from jaxslam.frontend.lidar import beam_angles
from jaxslam.localisation import LocaliseSpec, map_of_scans
from jaxslam.localisation.free_space import CLEAR, map_score
from jaxslam.matching.place_fit import cells_of, score_pose
from jaxslam.matching.place_recognition import make_query

SPEC = LocaliseSpec()
LIDAR = Lidar(num_beams=181, angle_increment=np.pi / 180, range_max=15.0)
POSES = np.array([[0.0, 0.0, 0.0], [0.5, -0.5, 2.0]])


def room(pose, half=3.0):
    """Ranges (R,) from a pose to the walls of a square room, by its four lines."""
    angle = np.asarray(beam_angles(LIDAR)) + pose[2]
    ranges = np.inf
    for axis, direction in enumerate((np.cos(angle), np.sin(angle))):
        with np.errstate(divide="ignore"):
            for wall in (half, -half):
                to_wall = (wall - pose[axis]) / direction
                ranges = np.minimum(ranges, np.where(to_wall > 0.0, to_wall, np.inf))
    return ranges


def scans(ranges):
    ranges = jnp.asarray(np.array(ranges))
    return Scan(ranges, ranges < LIDAR.range_max)


@pytest.fixture(scope="module")
def place_map():
    return map_of_scans(SPEC, LIDAR, POSES, scans([room(pose) for pose in POSES]))


def test_cells_are_free_on_beams_and_nowhere_else(place_map):
    free = np.asarray(place_map.free)
    angle, rng = np.asarray(beam_angles(LIDAR)), np.random.default_rng(0)
    for pose in POSES:
        share = rng.uniform(0.0, 0.85, (40, 1))  # up to 45 cm before the wall, or more
        ranges = share * room(pose)[None]
        points = np.stack([ranges * np.cos(angle), ranges * np.sin(angle)], axis=-1)
        cells = cells_of(SPEC.place, place_map.places, jnp.asarray(transform(pose, points[0])))
        clear = np.asarray(place_map.places.distance)[cells] > CLEAR
        assert clear.any() and free[cells][clear].all()
    low, cell = np.asarray(place_map.places.origin), SPEC.place.cell
    where = low + cell * np.argwhere(free)
    assert np.abs(where).max() < 3.0 - CLEAR + 0.15
    assert (np.asarray(place_map.places.distance)[free] > CLEAR).all()
    behind = np.abs(np.arctan2(where[:, 1], where[:, 0])) > np.pi / 2 + 0.2
    off = where[behind] - POSES[1, :2]
    seen = np.abs((np.arctan2(off[:, 1], off[:, 0]) - POSES[1, 2] + np.pi) % (2 * np.pi) - np.pi)
    near = np.hypot(*off.T) < 0.3
    assert (near | (seen < np.pi / 2 + 0.2)).all()  # the first robot does not see behind itself


def test_walls_in_free_space_contradict_and_those_beyond_do_not(place_map):
    score = jax.jit(map_score, static_argnums=0)
    ranges = room(POSES[0])
    for changed, expected in ((0.4, 0.25), (3.0, 0.0)):  # in the room, and far beyond its walls
        new = ranges.copy()
        new[:45] = changed * ranges[:45]
        query = make_query(SPEC.place, LIDAR, scans([new]), jnp.zeros((1, 3)))
        pose = jnp.asarray(POSES[0])
        plain = score_pose(SPEC.place, place_map.places, query, pose)
        share = plain - score(SPEC, place_map, query, pose)
        np.testing.assert_allclose(share, expected, atol=0.03)
