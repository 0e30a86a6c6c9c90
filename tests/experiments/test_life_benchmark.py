import jax
import jax.numpy as jnp
import numpy as np

from experiments import life_benchmark
from jaxslam.core.scan import Lidar
from jaxslam.simulation import World, cast, named, with_index

LIDAR = Lidar(num_beams=61, angle_increment=np.pi / 60)


def test_walls_in_pieces_are_met_as_whole_ones_by_index_and_without():
    whole = np.asarray(named("office").walls)
    pieces = life_benchmark.cut(whole, 1000)
    assert 950 < len(pieces) < 1100
    lengths = [np.hypot(*(w[:, 2:] - w[:, :2]).T).sum() for w in (whole, pieces)]
    np.testing.assert_allclose(*lengths)
    pose = jnp.asarray([3.0, 7.5, 0.4])
    scan = jax.jit(cast, static_argnums=0)
    world = World(jnp.asarray(pieces))
    expected = scan(LIDAR, World(jnp.asarray(whole)), pose).ranges
    for given in (world, with_index(world, LIDAR.range_max)):
        np.testing.assert_allclose(scan(LIDAR, given, pose).ranges, expected, rtol=1e-9)
