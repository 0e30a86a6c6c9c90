import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose, transform
from jaxslam.frontend.lidar import beam_angles, beam_ends
from jaxslam.simulation import worlds
from jaxslam.simulation.ray_casting import add_range_noise, cast
from jaxslam.simulation.worlds import World

ROUND = Lidar(num_beams=360, angle_min=-math.pi, angle_increment=math.pi / 180)
BOX = (-2.0, -1.0, 3.0, 2.0)


def box_ranges(pose, lidar):
    """Distances (R,) [m] to the sides of BOX: each axis is left through the side ahead."""
    angle = pose[2] + np.asarray(beam_angles(lidar))
    with np.errstate(divide="ignore"):
        x = np.where(np.cos(angle) > 0, BOX[2] - pose[0], BOX[0] - pose[0]) / np.cos(angle)
        y = np.where(np.sin(angle) > 0, BOX[3] - pose[1], BOX[1] - pose[1]) / np.sin(angle)
    return np.minimum(np.abs(x), np.abs(y))


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (1.3, -0.4, 0.7), (-1.9, 1.9, -3.0)])
def test_ranges_in_a_room_are_the_distances_to_its_sides(pose):
    scan = cast(ROUND, World(worlds.outline([BOX])), jnp.array(pose))
    np.testing.assert_allclose(scan.ranges, box_ranges(pose, ROUND), atol=1e-9)
    assert scan.hit.all()


def test_ends_of_the_beams_lie_on_the_walls():
    pose = jnp.array([1.3, -0.4, 0.7])
    ends = transform(pose, beam_ends(ROUND, cast(ROUND, World(worlds.outline([BOX])), pose)))
    side = np.abs(np.asarray(ends)[:, [0, 1, 0, 1]] - np.array(BOX)).min(axis=1)
    np.testing.assert_allclose(side, 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_turning_world_and_robot_together_changes_nothing(seed):
    office, pose = worlds.named("office"), jnp.array([1.013, 0.917, 0.31])
    turn = jax.random.uniform(jax.random.key(seed), (3,), minval=-3, maxval=3)
    walls = transform(turn, jnp.asarray(office.walls).reshape(-1, 2, 2)).reshape(-1, 4)
    here, there = cast(Lidar(), office, pose), cast(Lidar(), World(walls), compose(turn, pose))
    np.testing.assert_allclose(there.ranges, here.ranges, atol=1e-9)
    np.testing.assert_array_equal(there.hit, here.hit)


def test_no_beam_slips_through_a_corner():
    square = jnp.asarray(worlds.outline([(-1.0, -1.0, 1.0, 1.0)])).reshape(-1, 2, 2)
    # Every other beam meets a corner.
    fan = Lidar(num_beams=8, angle_min=-math.pi, angle_increment=math.pi / 4)
    turns = jax.random.uniform(jax.random.key(0), (2000, 3), minval=-3, maxval=3)

    @jax.jit
    @jax.vmap
    def ranges(turn):
        return cast(fan, World(transform(turn, square).reshape(-1, 4)), turn).ranges

    expected = np.tile([1, math.sqrt(2)] * 4, (2000, 1))
    np.testing.assert_allclose(ranges(turns), expected, atol=1e-4)


def test_nothing_returns_from_beyond_the_largest_range():
    scan = cast(ROUND._replace(range_max=1.5), World(worlds.outline([BOX])), jnp.zeros(3))
    near = box_ranges((0, 0, 0), ROUND) < 1.5
    np.testing.assert_array_equal(scan.hit, near)
    assert np.all(np.asarray(scan.ranges)[~near] == 1.5)


def test_range_noise_has_its_standard_deviation_and_spares_beams_without_return():
    n = 20_000
    lidar = Lidar(num_beams=n, range_std=0.03)
    scan = Scan(ranges=jnp.full(n, 2.0).at[:100].set(10.0), hit=jnp.arange(n) >= 100)
    noisy = add_range_noise(jax.random.key(0), lidar, scan)
    error = np.asarray(noisy.ranges - scan.ranges)[100:]
    assert abs(error.mean()) < 4 * 0.03 / np.sqrt(error.size)
    assert abs(error.std() - 0.03) < 4 * 0.03 / np.sqrt(2 * error.size)
    np.testing.assert_array_equal(noisy.hit, scan.hit)
    np.testing.assert_array_equal(noisy.ranges[:100], 10.0)


def test_noisy_readings_beyond_the_largest_range_are_lost():
    n = 4000
    lidar = Lidar(num_beams=n, range_std=0.03)
    scan = Scan(ranges=jnp.full(n, lidar.range_max - 1e-9), hit=jnp.ones(n, bool))
    lost = 1 - np.asarray(add_range_noise(jax.random.key(1), lidar, scan).hit).mean()
    assert abs(lost - 0.5) < 4 * 0.5 / np.sqrt(n)


def test_scans_are_batched_and_differentiable():
    office = worlds.named("office")
    starts = jnp.array([[1.01, 0.9, 0.1], [3.5, 3.6, 1.2]])
    ranges = jax.jit(lambda pose: cast(Lidar(), office, pose).ranges)
    alone = jnp.stack([ranges(pose) for pose in starts])
    np.testing.assert_allclose(jax.jit(jax.vmap(ranges))(starts), alone, atol=1e-12)
    slope = jax.jit(jax.jacfwd(ranges))(starts[0])
    assert jnp.isfinite(slope).all()


@pytest.mark.parametrize(
    "walls, pose, message",
    [
        (jnp.zeros((5, 3)), jnp.zeros(3), "world.walls is float64 (5, 3)"),
        (jnp.zeros((5, 4)), jnp.zeros((2, 3)), "pose is float64 (2, 3), not"),
    ],
)
def test_wrong_shapes_are_named_while_tracing(walls, pose, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        jax.eval_shape(lambda: cast(ROUND, World(walls), pose))
