"""Pockets that no beam reached: in front of a wall they are free, behind it they are wall."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.mapping.hidden_walls import DEPTH, with_hidden_walls
from jaxslam.mapping.occupancy import occupancy_map
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World, outline

LIDAR = Lidar(num_beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=12.0)
WORLD = World(jnp.asarray(outline([(0, 0, 6, 4)], [(2.5, 0.0, 2.8, 2.0)]), float))
POSES = np.array([[1.0, 3.0, 0.3], [1.2, 1.0, -1.0], [4.5, 3.2, -2.0]])


def test_pockets_are_as_the_world_has_them():
    scans = jax.tree.map(
        np.asarray, jax.vmap(lambda pose: ray_casting.cast(LIDAR, WORLD, pose))(jnp.asarray(POSES))
    )
    grid = occupancy_map(LIDAR, POSES, scans, resolution=0.05)
    whole = with_hidden_walls(grid, LIDAR, POSES, scans)
    new = (whole.free | whole.occupied) & ~(grid.free | grid.occupied)
    assert np.count_nonzero(new) > 100
    np.testing.assert_array_equal(whole.free & ~new, grid.free)
    np.testing.assert_array_equal(whole.occupied & ~new, grid.occupied)
    x, y = ((np.argwhere(new) + 0.5) * 0.05 + grid.origin[:2]).T
    inside = (x > 0) & (x < 6) & (y > 0) & (y < 4) & ~((x > 2.5) & (x < 2.8) & (y < 2.0))
    # Cells within one of a wall may be on either side, and corners belong to two walls.
    from_wall = np.min([np.abs(x), np.abs(6 - x), np.abs(y), np.abs(4 - y)], axis=0)
    box = np.maximum(np.maximum(2.5 - x, x - 2.8), y - 2.0)
    clear = np.minimum(from_wall, np.abs(box)) > 0.1
    assert np.mean(whole.free[new][clear] == inside[clear]) > 0.93
    free = np.argwhere(grid.free)
    apart = np.array([np.hypot(*(free - cell).T).min() for cell in np.argwhere(new)[::20]])
    assert (apart <= DEPTH / 0.05 + 1).all()
