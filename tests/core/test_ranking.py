"""Orders without a sort, and functions with the batch last."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import ranking
from jaxslam.frontend import lidar
from jaxslam.frontend.trailing_batch import with_trailing_batch

bearing, sorted_three = jax.jit(lidar.bearing), jax.jit(ranking.sorted_three)
first_true = jax.jit(ranking.first_true, static_argnums=1)
stable_order = jax.jit(ranking.stable_order)


@pytest.mark.parametrize("seed", range(4))
def test_order_is_that_of_a_stable_sort(seed):
    key = np.random.default_rng(seed).integers(0, 5, 24).astype(np.float32)  # with ties
    key[seed], key[-1] = np.inf, -np.inf
    np.testing.assert_array_equal(stable_order(jnp.asarray(key)), np.argsort(key, kind="stable"))


def test_many_keys_are_ordered_likewise():
    key = np.random.default_rng(0).integers(0, 30, 2 * ranking.MAX_COMPARED).astype(np.float32)
    key[5] = np.nan
    expected = np.argsort(np.where(np.isnan(key), np.inf, key), kind="stable")
    np.testing.assert_array_equal(stable_order(jnp.asarray(key)), expected)


def test_order_with_nan_is_a_permutation_with_nan_last():
    order = np.asarray(stable_order(jnp.array([jnp.nan, 1.0, jnp.nan, 0.0])))
    np.testing.assert_array_equal(order, [3, 1, 0, 2])


@pytest.mark.parametrize("true", [(), (0, 3, 4, 8), tuple(range(9))])
def test_first_true_entries_and_how_many_there_are(true):
    mask = np.isin(np.arange(9), true)
    index, found = first_true(jnp.asarray(mask), 5)
    count = min(5, len(true))
    np.testing.assert_array_equal(found, np.arange(5) < count)
    np.testing.assert_array_equal(np.asarray(index)[:count], true[:5])
    assert np.all(np.asarray(index)[count:] == 0)


def test_three_rows_are_sorted():
    rows = np.random.default_rng(0).integers(0, 4, (3, 50))
    np.testing.assert_array_equal(np.stack(sorted_three(jnp.asarray(rows))), np.sort(rows, axis=0))


def test_bearing_is_that_of_numpy_within_rounding_in_all_octants():
    angle = np.linspace(-np.pi, np.pi, 20001)
    xy = (7.0 * np.stack([np.cos(angle), np.sin(angle)])).astype(np.float32)
    expected = np.arctan2(*xy[::-1].astype(float))
    found = np.asarray(bearing(*jnp.asarray(xy)), float)
    assert np.abs(np.angle(np.exp(1j * (found - expected)))).max() < 4e-7
    assert bearing(jnp.float32(0.0), jnp.float32(0.0)) == 0.0


def cumulative(x, scale):
    """Of (R, B) arrays: sums up to each row, times the scale (1, B)."""
    return jnp.cumsum(x, axis=0) * scale


def test_function_with_the_batch_last_is_the_same_for_one_and_many():
    x, scale = np.arange(12.0).reshape(4, 3), np.full((1,), 2.0)
    one = with_trailing_batch(cumulative)
    many = jax.jit(jax.vmap(one, in_axes=(0, None)))(x, scale)
    np.testing.assert_array_equal(many, 2 * np.cumsum(x, axis=1))
    np.testing.assert_array_equal(jax.jit(one)(x[1], scale), many[1])
    twice = jax.jit(jax.vmap(jax.vmap(one, in_axes=(0, None)), in_axes=(0, None)))(x[None], scale)
    np.testing.assert_array_equal(twice[0], many)


def test_function_with_the_batch_last_has_derivatives_under_vmap():
    x, scale = np.arange(12.0).reshape(4, 3), np.full((1,), 2.0)

    def last(x):
        return with_trailing_batch(cumulative)(x, scale)[-1] ** 2

    slope = jax.jit(jax.vmap(jax.grad(last)))(x)
    expected = 2 * (2 * np.sum(x, axis=1, keepdims=True)) * 2 * np.ones((1, 3))
    np.testing.assert_allclose(slope, expected)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(last))(x[1]), expected[1])
