"""Round things that the beams of a scan meet before its walls."""

import math
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.simulation import worlds
from jaxslam.simulation.discs import Discs, nearest_discs
from jaxslam.simulation.ray_casting import cast, find_hits, incidence
from jaxslam.simulation.worlds import World

ROUND = Lidar(num_beams=180, angle_min=-math.pi, angle_increment=math.pi / 90, range_max=8.0)
ROOM = World(jnp.asarray(worlds.outline([(-6.0, -6.0, 6.0, 6.0)])))


def crowd(seed, count):
    """Discs anywhere in the room, a third of them padding; two may overlap."""
    rng = np.random.default_rng(seed)
    radius = rng.uniform(0.1, 0.6, count) * (np.arange(count) % 3 > 0)
    return Discs(jnp.asarray(rng.uniform(-6, 6, (count, 2))), jnp.asarray(radius))


def slow_distances(lidar, pose, discs):
    """Distances (R, K): the least root above 0 of |p + t u - c|^2 = r^2, by NumPy's polynomials."""
    table = np.full((lidar.num_beams, len(discs.radius)), np.inf)
    for i in range(lidar.num_beams):
        angle = pose[2] + lidar.angle_min + i * lidar.angle_increment
        u = np.array([np.cos(angle), np.sin(angle)])
        for k, (centre, radius) in enumerate(zip(*map(np.asarray, discs), strict=True)):
            to = centre - pose[:2]
            roots = np.roots([1.0, -2 * u @ to, to @ to - radius**2])
            ahead = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 1e-6)]
            if radius > 0 and ahead.size:
                table[i, k] = ahead.min()
    return table


find = jax.jit(find_hits, static_argnums=0)
nearest = jax.jit(nearest_discs, static_argnums=0)


@pytest.mark.parametrize("seed", [0, 2])
def test_distances_are_those_to_the_nearest_disc(seed):
    discs = crowd(seed, 30)
    pose = np.array([0.3, -0.2, 0.4])
    pose[:2] = discs.centre[1] + 0.01 if seed == 2 else pose[:2]  # from within one
    table = slow_distances(ROUND, pose, discs)
    distance, disc = nearest(ROUND, jnp.asarray(pose), discs)
    np.testing.assert_allclose(distance, table.min(axis=1), rtol=1e-6)
    hit = np.isfinite(table).any(axis=1)
    np.testing.assert_array_equal(disc, np.where(hit, table.argmin(axis=1), -1))
    assert hit.any() and (hit.all() == (seed == 2))


def test_the_nearer_of_disc_and_wall_is_met_and_said():
    discs, pose = crowd(3, 30), jnp.array([0.3, -0.2, 0.4])
    alone, hits = find(ROUND, ROOM, pose), find(ROUND, ROOM, pose, discs)
    distance, disc = nearest(ROUND, pose, discs)
    nearer = np.asarray(distance) < np.minimum(alone.distance, ROUND.range_max)
    assert 20 < nearer.sum() < 160
    np.testing.assert_array_equal(hits.distance, np.where(nearer, distance, alone.distance))
    np.testing.assert_array_equal(hits.disc, np.where(nearer, disc, -1))
    np.testing.assert_array_equal(hits.wall, np.where(nearer, -1, alone.wall))
    scan = jax.jit(cast, static_argnums=0)(ROUND, ROOM, pose, discs)
    np.testing.assert_array_equal(scan.hit, np.isfinite(hits.distance))
    ranges = np.minimum(hits.distance, ROUND.range_max)
    np.testing.assert_allclose(scan.ranges, ranges, rtol=1e-12)


def test_what_lies_beyond_the_range_is_not_met():
    far = Discs(jnp.array([[9.0, 0.0]]), jnp.array([0.5]))
    hits = find(ROUND._replace(range_max=5.0), ROOM, jnp.zeros(3), far)
    assert (np.asarray(hits.wall) == -1).all() and (np.asarray(hits.disc) == -1).all()
    assert np.isinf(hits.distance).all()


def test_incidence_on_a_disc_is_the_angle_to_its_radius():
    discs, pose = Discs(jnp.array([[2.0, 0.0]]), jnp.array([0.5])), jnp.zeros(3)
    hits = find(ROUND, ROOM, pose, discs)
    angles = jax.jit(incidence, static_argnums=0)
    angle = np.asarray(angles(ROUND, ROOM, pose, discs=discs, hits=hits))
    met = np.asarray(hits.disc) == 0
    beam = -np.pi + np.pi / 90 * np.arange(180)
    expected = np.arcsin(2.0 * np.abs(np.sin(beam[met])) / 0.5)
    np.testing.assert_allclose(angle[met], expected, atol=1e-9)
    plain = angles(ROUND, ROOM, pose)
    np.testing.assert_allclose(angle[~met], np.asarray(plain)[~met], rtol=1e-9)
    assert met.sum() == 15  # |beam| < asin(0.25) = 14.5 degrees


def test_gradients_are_those_of_differences_and_finite_where_a_beam_grazes():
    discs, pose = crowd(4, 12), jnp.array([0.3, -0.2, 0.4])

    def distances(pose, discs):
        return nearest_discs(ROUND, pose, discs)[0]

    of_pose, of_discs = jax.jit(jax.jacrev(distances, (0, 1)))(pose, discs)
    step = jnp.array([2e-7, -1e-7, 1e-7])
    moved = Discs(discs.centre + 1e-7, discs.radius * (1 + 1e-7))
    change = np.asarray(
        nearest(ROUND, pose + step, moved)[0] - nearest(ROUND, pose - step, discs)[0]
    )
    expected = 2 * of_pose @ step + 1e-7 * (
        of_discs.centre.sum((1, 2)) + of_discs.radius @ discs.radius
    )
    same = np.isfinite(change)
    assert same.sum() > 20
    np.testing.assert_allclose(np.asarray(expected)[same], change[same], atol=1e-10)
    lidar = ROUND._replace(num_beams=2, angle_min=0.0)
    grazed = Discs(jnp.array([[2.0, 0.5]]), jnp.array([0.5]))
    first = partial(_first, lidar)
    distance, slope = (jax.jit(f)(jnp.zeros(3), grazed) for f in (first, jax.grad(first)))
    np.testing.assert_allclose(distance, 2.0, atol=1e-6)
    assert np.isfinite(slope).all()


def _first(lidar, pose, discs):
    return nearest_discs(lidar, pose, discs)[0][0]


@pytest.mark.parametrize(
    "centre, radius, message",
    [
        (jnp.zeros((3, 3)), jnp.ones(3), "discs.centre is float64 (3, 3)"),
        (jnp.zeros((3, 2)), jnp.ones(2), "discs.radius is float64 (2,), not floating (3,)"),
    ],
)
def test_wrong_shapes_are_named_while_tracing(centre, radius, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        jax.eval_shape(lambda: cast(ROUND, ROOM, jnp.zeros(3), Discs(centre, radius)))


def test_no_discs_are_as_none():
    none = Discs(jnp.zeros((0, 2)), jnp.zeros(0))
    hits, alone = find(ROUND, ROOM, jnp.zeros(3), none), find(ROUND, ROOM, jnp.zeros(3))
    np.testing.assert_array_equal(hits.distance, alone.distance)
