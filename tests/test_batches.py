import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.batches import Spread, map_batches, pad


def assert_same(one, two):
    jax.tree.map(np.testing.assert_array_equal, one, two)


def items(count):
    return {"a": jnp.arange(3.0 * count).reshape(count, 3), "b": jnp.arange(count)}


def function(item):
    return item["a"].sum() * item["b"].astype(float), item["b"] + 1


@pytest.mark.parametrize("count, size", [(7, 3), (6, 3), (2, 5), (1, 1)])
def test_map_batches_equals_vmap(count, size):
    ours = map_batches(function, items(count), size=size)
    assert_same(ours, jax.vmap(function)(items(count)))


def test_padding_repeats_the_last_and_keeps_the_kind_of_array():
    for x in (np.arange(3.0), jnp.arange(3.0)):
        longer = pad(x, to=5)
        assert longer.tolist() == [0, 1, 2, 2, 2] and type(longer) is type(x)
    assert pad(jnp.arange(3), to=3).tolist() == [0, 1, 2]


def scaled(power, common, item):
    return jax.tree.map(lambda x: common["by"] * jnp.sin(x.astype(float)) ** power, item)


@pytest.mark.parametrize("count", [1, 2, 5, 16, 19])
@pytest.mark.parametrize("devices", [1, 2])
def test_spread_equals_vmap_on_any_number_of_devices(count, devices):
    common = {"by": jnp.float64(1.7)}
    spread = Spread(scaled, size=4, static=1)
    ours = spread(3, common, items(count), devices=jax.devices()[:devices])
    assert all(isinstance(x, np.ndarray) for x in jax.tree.leaves(ours))
    theirs = jax.vmap(lambda item: scaled(3, common, item))(items(count))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), ours, theirs)


def test_bits_do_not_depend_on_the_number_of_items_or_devices():
    common = {"by": jnp.float64(1.7)}
    spread = Spread(scaled, size=4, static=1)
    many = spread(2, common, items(19))
    few = spread(2, common, items(9), devices=jax.devices()[:1])
    assert_same(jax.tree.map(lambda x: x[:9], many), few)


def test_spread_is_traced_once_for_each_number_of_batches():
    traces = []

    def counted(common, item):
        traces.append(1)
        return common * item

    spread = Spread(counted, size=2)
    for _ in range(3):
        spread(jnp.float64(2.0), jnp.arange(8.0))
    assert len(traces) == 1
