"""Range noise that grows with the angle between a beam and the wall that it meets."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.frontend.lidar import beam_angles
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World

LIDAR = Lidar(num_beams=41, angle_min=-1.0, angle_increment=0.05, range_max=20.0)
WORLD = World(jnp.array([[2.0, -9.0, 2.0, 9.0], [3.0, -9.0, 5.0, 9.0]]))  # the second is hidden
POSE = jnp.array([0.0, 0.0, 0.2])


def test_the_incidence_is_the_angle_to_the_normal_of_the_wall_that_is_met():
    found = jax.jit(ray_casting.incidence, static_argnums=0)(LIDAR, WORLD, POSE)
    np.testing.assert_allclose(found, np.abs(np.asarray(beam_angles(LIDAR)) + 0.2), atol=1e-7)


def test_noise_has_the_factors_and_without_them_is_as_before():
    scan = ray_casting.cast(LIDAR, WORLD, POSE)
    factors = jnp.linspace(0.5, 4.0, LIDAR.num_beams)
    count = 2000

    @jax.jit
    @jax.vmap
    def noisy(key):
        one = jnp.ones_like(factors)
        return [
            ray_casting.add_range_noise(key, LIDAR, scan, x).ranges for x in (None, one, factors)
        ]

    plain, same, grown = noisy(jax.random.split(jax.random.key(0), count))
    np.testing.assert_array_equal(plain, same)
    ratio = np.asarray(grown).std(axis=0) / (LIDAR.range_std * np.asarray(factors))
    assert (np.abs(ratio - 1.0) < 4.5 / np.sqrt(2 * count)).all()
