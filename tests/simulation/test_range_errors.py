"""What a scanner measures of its ranges, against the statistics that its errors ask for."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.simulation.range_errors import RangeErrors, Returns, measure, mix_edges

LIDAR = Lidar(num_beams=40, angle_min=0.0, angle_increment=0.02, range_max=12.0, range_std=0.02)
DISTANCE = jnp.linspace(0.5, 10.0, 40)
INCIDENCE = jnp.linspace(0.0, 1.4, 40)
COUNT = 4000
jit_mix_edges = jax.jit(mix_edges, static_argnums=1)


def returns_of(distance=DISTANCE, surface=None, is_black=False):
    surface = jnp.zeros(40, jnp.int32) if surface is None else jnp.asarray(surface, jnp.int32)
    return Returns(jnp.asarray(distance), INCIDENCE, surface, jnp.full(40, is_black))


@partial(jax.jit, static_argnums=1)
def scans(errors, count, returns):
    keys = jax.random.split(jax.random.key(0), count)
    return jax.vmap(lambda key: measure(key, LIDAR, errors, returns))(keys)


def test_the_noise_grows_with_range_and_incidence():
    found = np.asarray(scans(RangeErrors(std_per_range=0.01), COUNT, returns_of()).ranges)
    std = np.hypot(0.02, 0.01 * np.asarray(DISTANCE))
    np.testing.assert_array_less(np.abs(found.std(axis=0) / std - 1.0), 4.5 / np.sqrt(2 * COUNT))
    far = np.abs(found.mean(axis=0) - np.asarray(DISTANCE))
    np.testing.assert_array_less(far, 4.5 * std / np.sqrt(COUNT))
    found = np.asarray(scans(RangeErrors(std_by_incidence=0.7), COUNT, returns_of()).ranges)
    std = 0.02 * np.exp(0.7 * np.asarray(INCIDENCE))
    np.testing.assert_array_less(np.abs(found.std(axis=0) / std - 1.0), 4.5 / np.sqrt(2 * COUNT))


def test_ranges_are_whole_steps_and_the_derivative_of_rounding_is_one():
    errors = RangeErrors(resolution=0.05)
    found = np.asarray(scans(errors, 50, returns_of()).ranges)
    np.testing.assert_allclose(found / 0.05, np.round(found / 0.05), atol=1e-9)
    exact = np.asarray(scans(RangeErrors(), 50, returns_of()).ranges)
    assert np.abs(found - exact).max() <= 0.025 + 1e-9

    @jax.jit
    @jax.grad
    def slope_of(std, resolution):
        own = RangeErrors(std_per_range=std, resolution=resolution)
        return measure(jax.random.key(1), LIDAR, own, returns_of()).ranges.sum()

    slope = slope_of(0.01, 0.05)
    assert abs(slope) > 1.0
    np.testing.assert_allclose(slope, slope_of(0.01, 0.0))


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_beams_does_not_return(share):
    found = scans(RangeErrors(missing=share), COUNT, returns_of())
    missing = 1.0 - np.asarray(found.hit).mean()
    assert abs(missing - share) <= 4.5 * np.sqrt(share * (1.0 - share) / found.hit.size)
    assert np.all(np.asarray(found.ranges)[~np.asarray(found.hit)] == LIDAR.range_max)


def test_black_walls_return_from_near():
    errors = RangeErrors(black_range=4.0)
    far = np.asarray(DISTANCE)
    reach = 4.0 * np.cos(np.asarray(INCIDENCE))
    sure = np.abs(far - reach) > 0.1
    hit = np.asarray(scans(errors, 20, returns_of(is_black=True)).hit)
    np.testing.assert_array_equal(hit[:, sure], np.tile(far < reach, (20, 1))[:, sure])
    hit = np.asarray(scans(errors, 20, returns_of()).hit)
    np.testing.assert_array_equal(hit[:, sure], True)


def test_a_spot_that_covers_an_edge_gets_the_mean_over_it():
    """Against the mean over many directions in the spot, of an edge at a random angle."""
    near_far = np.where(np.arange(40) < 20, 2.0, 5.0)
    given = returns_of(near_far, np.arange(40) >= 20)
    spot = 0.03  # wider than half an increment: now and then both beams beside the edge cover it
    keys = jax.random.split(jax.random.key(3), 4000)
    mixed = jax.jit(jax.vmap(lambda key: mix_edges(key, LIDAR, spot, given)))
    found = np.asarray(mixed(keys))
    np.testing.assert_array_equal(found[:, :19], 2.0)
    np.testing.assert_array_equal(found[:, 21:], 5.0)
    rng = np.random.default_rng(0)
    edge = 19 * 0.02 + 0.02 * rng.random(4000)
    across = spot * (np.arange(1000) + 0.5) / 1000 - spot / 2
    wanted = [
        np.where(k * 0.02 + across[None] < edge[:, None], 2.0, 5.0).mean(axis=1) for k in (19, 20)
    ]
    for own, other in zip((found[:, 19], found[:, 20]), wanted, strict=True):
        se = np.sqrt(own.var() + other.var()) / np.sqrt(4000)
        assert abs(own.mean() - other.mean()) < 4.5 * se
        np.testing.assert_allclose(
            np.quantile(own, [0.1, 0.5, 0.9]), np.quantile(other, [0.1, 0.5, 0.9]), atol=0.06
        )
    both = found[:, 19:21]
    assert np.all((both > 2.0 - 1e-12) & (both < 5.0 + 1e-12))


def test_no_edge_no_spot_and_no_return_change_nothing():
    split = np.arange(40) >= 20
    for spot, given in (
        (0.03, returns_of()),
        (0.0, returns_of(surface=split)),
        (0.03, returns_of(np.where(split, np.inf, 2.0), split)),
    ):
        found = jit_mix_edges(jax.random.key(0), LIDAR, spot, given)
        np.testing.assert_array_equal(found, given.distance)
    with jax.debug_nans(True):
        slope = jax.jit(
            jax.grad(
                lambda spot: jnp.where(
                    split, 0.0, mix_edges(jax.random.key(0), LIDAR, spot, given)
                ).sum()
            )
        )(0.03)
    assert slope == 0.0


def test_neighbours_share_an_error_that_falls_off_along_the_beams():
    """Its covariance over k beams is std^2 exp(-k increment / angle)."""
    exact = returns_of(jnp.full(40, 5.0))
    errors = RangeErrors(std_scale=0.0, shared_std=0.03, shared_angle=0.05)
    error = np.asarray(scans(errors, COUNT, exact).ranges) - 5.0
    for lag in (0, 1, 3, 10):
        product = error[:, lag:] * error[:, : 40 - lag]
        by_scan = product.mean(axis=1)  # scans are independent
        wanted = 0.03**2 * np.exp(-lag * 0.02 / 0.05)
        assert abs(by_scan.mean() - wanted) < 4.5 * by_scan.std() / np.sqrt(COUNT)
    none = np.asarray(scans(RangeErrors(std_scale=0.0), 5, exact).ranges)
    np.testing.assert_allclose(none, 5.0, atol=1e-12)
