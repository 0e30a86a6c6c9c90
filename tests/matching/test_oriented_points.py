from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from simulated_scans import CORRIDOR, LIDAR, item, scans_of

from jaxslam.core.se2 import transform
from jaxslam.frontend import lidar
from jaxslam.matching.oriented_points import oriented_points, transform_points


def test_surfaces_are_the_walls_that_a_scan_sees():
    pose = jnp.array([3.0, 0.2, 0.4])
    scan = item(scans_of(CORRIDOR, pose[None]), 0)
    found = jax.jit(partial(oriented_points, LIDAR))(scan)
    points = np.asarray(transform(pose, found.points))[found.valid]
    normal = np.asarray(found.normal)[found.valid]
    across = np.array([np.sin(0.4), np.cos(0.4)])  # of the corridor, robot frame
    np.testing.assert_allclose(np.abs(normal @ across), 1.0, atol=1e-6)
    assert np.min(np.abs(points[:, 1:] - [1.0, -1.2]), axis=1).max() < 1e-6
    assert found.valid.sum() > 120
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-12)


def test_a_surface_ends_at_a_jump_of_the_range():
    """A door in a wall: the points of the wall behind have normals of their own."""
    ranges = np.where(np.abs(lidar.beam_angles(LIDAR)) < 0.3, 6.0, 2.0) / np.cos(
        np.clip(lidar.beam_angles(LIDAR), -1.2, 1.2)
    )
    found = oriented_points(LIDAR, lidar.to_scan(LIDAR, jnp.asarray(ranges)))
    steep = np.abs(np.asarray(lidar.beam_angles(LIDAR))) < 1.1
    use = np.asarray(found.valid) & steep
    assert use.sum() > 0.95 * steep.sum()
    np.testing.assert_allclose(np.abs(found.normal[use, 0]), 1.0, atol=1e-6)
    assert np.asarray(found.neighbour_gap)[use].max() < 1.0


def test_transformed_points_keep_their_distances_from_their_lines():
    pose = jnp.array([3.0, 0.2, 0.4])
    found = jax.jit(partial(oriented_points, LIDAR))(item(scans_of(CORRIDOR, pose[None]), 0))
    moved = transform_points(pose, found)
    np.testing.assert_allclose(moved.points, transform(pose, found.points), atol=1e-12)
    turn = np.arctan2(moved.normal[:, 1], moved.normal[:, 0]) - np.arctan2(*found.normal.T[::-1])
    np.testing.assert_allclose(np.exp(1j * turn), np.exp(0.4j), atol=1e-12)
    np.testing.assert_array_equal(moved.valid, found.valid)
