"""Scans of simulated places that the tests of scan matching share."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import relative
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World

LIDAR = Lidar(num_beams=181, angle_increment=np.pi / 180, range_max=15.0, range_std=0.01)
CORRIDOR = World(jnp.array([[-60.0, 1.0, 60.0, 1.0], [60.0, -1.2, -60.0, -1.2]]))


@partial(jax.jit, static_argnames="range_std")
def scans_of(world, poses, range_std=0.0, seed=0):
    """Scans [T] from poses (T, 3)."""
    scans = jax.vmap(partial(ray_casting.cast, LIDAR, world))(poses)
    keys = jax.random.split(jax.random.key(seed), len(poses))
    noisy = LIDAR._replace(range_std=range_std)
    return jax.vmap(lambda key, scan: ray_casting.add_range_noise(key, noisy, scan))(keys, scans)


@jax.jit
def odometry_of(poses):
    """True increments (T, 3) of poses (T, 3), zero at the first."""
    return jnp.concatenate([jnp.zeros((1, 3)), jax.vmap(relative)(poses[:-1], poses[1:])])


def item(scans, index):
    """One scan, or some, of many."""
    return jax.tree.map(lambda x: x[index], scans)
