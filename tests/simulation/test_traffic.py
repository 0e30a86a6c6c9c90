"""People, doors and furniture that move while the robot drives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.simulation import traffic as traffic_module
from jaxslam.simulation.traffic import Movers, Traffic, make_crowd, moved_walls, people_at, walkway

CORNERS = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0]])
DOORS = np.array([[2.0, -1.0, 2.0, 1.0], [8.0, 3.0, 9.0, 3.0]])
CHAIR = np.array([[1.0, 1.0, 1.5, 1.0]])
MOVERS = Movers(np.arange(30), walkway(CORNERS), DOORS, CHAIR, CHAIR + 2.0)
FAR = jnp.array([100.0, 100.0])
TIMES = jnp.arange(0.0, 400.0, 0.5)


@partial(jax.jit, static_argnames="slots")
def crowd_of(traffic, slots=30, seed=0):
    return make_crowd(jax.random.key(seed), traffic, MOVERS._replace(people=np.arange(slots)))


@jax.jit
def people_over_time(crowd, traffic, scanner):
    return jax.vmap(lambda t: people_at(crowd, traffic, MOVERS, t, scanner)[0])(TIMES)


@jax.jit
def doors_over_time(crowd, traffic, scanner):
    return jax.vmap(lambda t: moved_walls(crowd, traffic, MOVERS, t, scanner)[:2])(
        jnp.arange(0.0, 600.0, 10.0)
    )


def centres_of(traffic, scanner=FAR):
    crowd = crowd_of(traffic)
    return np.asarray(people_over_time(crowd, traffic, scanner)), np.asarray(crowd.radius)


def distance_to_walkway(points):
    """Distance of points (..., 2) to the lines that join `CORNERS`."""
    found = []
    for a, b in zip(CORNERS[:-1], CORNERS[1:], strict=True):
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        found.append(np.linalg.norm(points - a - share[..., None] * (b - a), axis=-1))
    return np.min(found, axis=0)


def test_people_walk_to_and_fro_along_the_whole_walkway_at_their_speed():
    traffic = Traffic(people=30.0, speed=1.2, standing=0.0)
    centres, _ = centres_of(traffic)
    assert distance_to_walkway(centres).max() <= traffic_module.MAX_ASIDE + 1e-9
    for k in range(30):
        assert np.linalg.norm(centres[:, k] - CORNERS[0], axis=-1).min() < 1.0
        assert np.linalg.norm(centres[:, k] - CORNERS[2], axis=-1).min() < 1.0
    pace = np.linalg.norm(np.diff(centres, axis=0), axis=-1) / 0.5
    typical = np.median(pace, axis=0)
    assert np.all((typical > 0.7 * 1.2 - 1e-9) & (typical < 1.3 * 1.2 + 1e-9))
    assert abs(typical.mean() - 1.2) < 4.5 * 1.2 * 0.3 / np.sqrt(12 * 30) * 2


@pytest.mark.parametrize("standing", [0.0, 0.4, 1.0])
def test_people_stand_for_a_share_of_the_time(standing):
    centres, _ = centres_of(Traffic(people=30.0, standing=standing))
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=-1)
    assert abs((moved < 1e-9).mean() - standing) < 0.04


def test_a_person_is_the_same_whatever_their_number():
    few, many = crowd_of(Traffic(people=3.0), 5), crowd_of(Traffic(people=30.0), 30)
    for a, b in zip(few[:4], many[:4], strict=True):
        np.testing.assert_array_equal(a[:3], b[:3])
    np.testing.assert_array_equal(few.radius[:3], many.radius[:3])
    assert np.all(few.radius[3:] == 0.0) and np.all(many.radius > 0.0)


def test_people_keep_away_from_the_scanner():
    traffic = Traffic(people=30.0, carts=0.5, distance=0.35)
    scanner = jnp.array([4.0, 0.1])
    centres, radius = centres_of(traffic, scanner=scanner)
    free, _ = centres_of(traffic)
    gap = np.linalg.norm(centres - np.asarray(scanner), axis=-1)
    assert np.all(gap >= radius + 0.35 - 1e-9)
    far = np.linalg.norm(free - np.asarray(scanner), axis=-1) > radius + 0.35
    assert far.any() and not far.all()
    np.testing.assert_allclose(centres[far], free[far], atol=1e-12)


def test_doors_are_closed_for_their_share_of_the_time_and_open_before_the_robot():
    traffic = Traffic(closed=0.3, door_period=10.0)

    def is_closed(seed, scanner):
        crowd = crowd_of(traffic, 1, seed)
        walls = np.asarray(doors_over_time(crowd, traffic, scanner))
        return np.linalg.norm(walls[..., 2:] - walls[..., :2], axis=-1) > 0.0

    states = np.stack([is_closed(seed, FAR) for seed in range(40)])
    for door in range(2):
        share, count = states[..., door].mean(), states[..., door].size
        assert abs(share - 0.3) < 4.5 * np.sqrt(0.21 / count)
    near = np.stack([is_closed(seed, jnp.array([2.5, 0.0])) for seed in range(5)])
    assert not near[..., 0].any()
    np.testing.assert_array_equal(near[..., 1], states[:5, :, 1])


def test_furniture_is_moved_once_and_a_world_may_have_nothing_that_moves():
    traffic = Traffic(moved_at=20.0)
    crowd = crowd_of(traffic, 1)
    moved = jax.jit(moved_walls)
    before, after = (moved(crowd, traffic, MOVERS, t, FAR)[2:] for t in (19.9, 20.0))
    np.testing.assert_array_equal(before, CHAIR)
    np.testing.assert_array_equal(after, CHAIR + 2.0)
    none = np.zeros((0, 4))
    empty = Movers(np.arange(0), MOVERS.walkway, none, none, none)
    crowd = make_crowd(jax.random.key(0), traffic, empty)
    assert moved_walls(crowd, traffic, empty, 1.0, FAR).shape == (0, 4)
    assert people_at(crowd, traffic, empty, 1.0, FAR)[0].shape == (0, 2)


def test_a_walkway_has_even_steps_and_needs_a_length():
    steps = np.linalg.norm(np.diff(walkway(CORNERS), axis=0), axis=1)
    assert np.ptp(np.delete(steps, np.argmin(steps))) < 1e-9  # but for the one around the corner
    with pytest.raises(ValueError, match="path has no length"):
        walkway([[1.0, 1.0], [1.0, 1.0]])
