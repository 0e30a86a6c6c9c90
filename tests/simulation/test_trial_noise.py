"""Noise of a trial as an argument: it means the same as that of a key, and can be scaled."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import compose
from jaxslam.simulation import densify, life_in, named
from jaxslam.simulation.drives import drive_and_scan
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_noise import draw_noise, draw_noises, draws_of
from jaxslam.simulation.wheel_faults import WheelFaults, draw_faults
from jaxslam.simulation.worlds import World

SCANS = 400
LIDAR = Lidar(num_beams=31, angle_min=-1.5, angle_increment=0.1)
ROBOT = Robot()
WORLD = World(jnp.asarray(named("fig07").walls))
PATH = jnp.asarray(densify([(0.7, 0.8), (2.0, 1.0), (2.2, 2.3)]))
WHEELS = WheelFaults(slip=0.2, dropped=0.3)
LIFE = life_in(WORLD, PATH, ranges=RangeErrors(missing=0.25), wheels=WHEELS)


def noise_of(seed, num_scans=SCANS):
    return draw_noise(jax.random.key(seed), LIDAR, ROBOT, num_scans)


@partial(jax.jit, static_argnames="with_life")
def driven(noise, mount_error=None, with_life=False):
    """True poses, odometry and scans."""
    life = LIFE if with_life else None
    given = draws_of(noise, life), LIDAR, ROBOT, WORLD, PATH
    scan_of, items, odometry = drive_and_scan(*given, life=life, mount_error=mount_error)
    return items[0], odometry, jax.lax.map(scan_of, items)


def test_what_goes_wrong_is_as_often_as_by_a_key():
    """Shares of slips, lost scans and missing beams, within four standard errors."""
    drawn = draws_of(noise_of(0), LIFE).life
    slip, kept = np.asarray(drawn.events.faults.slip), np.asarray(drawn.kept)
    assert slip.shape == (SCANS - 1, 2) and kept.shape == (SCANS,)
    assert abs(np.mean(slip > 0) - 0.2) < 4 * np.sqrt(0.16 / slip.size)
    assert abs(np.mean(kept) - 0.7) < 4 * np.sqrt(0.21 / SCANS)
    other = np.asarray(draw_faults(jax.random.key(1), WHEELS, SCANS, float).slip)
    for own in (slip, other):  # the median of the modulus of a t is 0.816, of two degrees
        share = np.median(own[own > 0])
        assert abs(share - 0.2 * 0.816) < 4 * 0.2 * 0.11
    failures = np.asarray(drawn.failures)
    assert failures.min() >= 0 and abs(failures.mean() - 0.5) < 4 / np.sqrt(12 * failures.size)
    hits = [driven(noise_of(k, 12), with_life=True)[2].hit for k in range(20)]
    hit = np.concatenate([np.asarray(x) for x in hits])
    found = hit[hit.any(axis=1)]  # in a closed room all beams meet a wall
    assert abs(found.mean() - 0.75) < 4 * np.sqrt(0.1875 / found.size)


def test_noise_of_one_scan_changes_nothing_before_it():
    noise = noise_of(3, 12)
    other = noise_of(4, 12)
    at = 6

    def put(x, y):
        return x.at[at].set(y[at])

    changed = noise._replace(
        wheels=put(noise.wheels, other.wheels),
        ranges=put(noise.ranges, other.ranges),
        scans=put(noise.scans, other.scans),
    )
    for with_life in (False, True):
        (one, _, scans), (two, _, seen) = (driven(x, with_life=with_life) for x in (noise, changed))
        np.testing.assert_array_equal(one[:at], two[:at])
        np.testing.assert_array_equal(scans.ranges[:at], seen.ranges[:at])
        assert np.any(scans.ranges[at] != seen.ranges[at]) and np.any(one[at + 1] != two[at + 1])


def test_scaled_noise_is_that_of_another_robot():
    """Without noise of ranges a scan is exact; with twice the noise it is twice as far off."""
    noise = noise_of(5, 12)
    exact = driven(noise._replace(ranges=0.0 * noise.ranges))[2].ranges
    once, twice = (driven(noise._replace(ranges=k * noise.ranges))[2].ranges for k in (1.0, 2.0))
    np.testing.assert_allclose(twice - exact, 2 * (once - exact), atol=1e-12)
    np.testing.assert_allclose(once - exact, LIDAR.range_std * noise.ranges, atol=1e-12)


def test_a_mount_error_moves_the_scanner_and_not_the_odometry():
    noise, error = noise_of(6, 12), jnp.array([0.1, -0.05, 0.2])
    truth, odometry, scans = driven(noise)
    moved, same, other = driven(noise, mount_error=error)
    wanted = jax.vmap(compose, in_axes=(0, None))(truth, error)
    np.testing.assert_allclose(moved, wanted, atol=1e-12)
    np.testing.assert_array_equal(odometry, same)
    assert np.any(scans.ranges != other.ranges)


def test_noise_of_many_trials_is_that_of_each():
    keys = jax.random.split(jax.random.key(7), 3)
    many = draw_noises(keys, LIDAR, ROBOT, 5)
    one = draw_noise(keys[1], LIDAR, ROBOT, 5)
    np.testing.assert_allclose(many.wheels[1], one.wheels)
    np.testing.assert_array_equal(
        jax.random.key_data(many.scans[1]), jax.random.key_data(one.scans)
    )


def test_life_without_its_draws_is_refused():
    noise = noise_of(8, 4)
    given = draws_of(noise, None), LIDAR, ROBOT, WORLD, PATH
    with pytest.raises(ValueError, match="one of life and draws.life is None"):
        drive_and_scan(*given, life=LIFE)
