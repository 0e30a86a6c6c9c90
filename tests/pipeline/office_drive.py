"""A drive through the simulated office, for tests of broken drives and of sessions."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.simulation import path_following, ray_casting, worlds

LIDAR = Lidar(num_beams=91, angle_min=-np.pi / 2, angle_increment=np.pi / 90, range_max=10.0)
CONFIG = Config.for_laser_log(LIDAR)
PARAMS = NoiseParams.for_laser_log(match_scans=True)


def office_drive(step=0.25):
    """Poses (T, 3) on the drive through the office, and its scans."""
    path = path_following.densify(worlds.waypoints("office"))
    poses = path_following.poses_along(path, step)
    return poses, scans_along(worlds.named("office"), poses, 3)


def scans_along(world, poses, seed):
    """Scans [T] of a world from poses (T, 3), with noise."""
    keys = jax.random.split(jax.random.key(seed), len(poses))

    @jax.jit
    def cast(keys, poses):
        def scan(key, pose):
            return ray_casting.add_range_noise(key, LIDAR, ray_casting.cast(LIDAR, world, pose))

        return jax.vmap(scan)(keys, poses)

    return jax.tree.map(np.asarray, cast(keys, jnp.asarray(poses)))


def take(scans, index):
    return jax.tree.map(lambda x: x[index], scans)
