import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.batching import BatchSize, map_batches, traced_platform
from jaxslam.core.devices import DeviceMap
from jaxslam.frontend.extract import SCAN_BATCH
from jaxslam.simulation.trial_episodes import DRIVE_BATCH, DRIVE_SCAN_BATCH, map_drives

SIZE = BatchSize(cpu=2, accelerator=5)


def test_the_platform_is_that_of_the_default_device():
    assert traced_platform() == jax.default_backend() == "cpu"
    with jax.default_device(jax.devices()[1]):
        assert traced_platform() == "cpu"
    for name in ("gpu", "tpu", "cpu"):
        with jax.default_device(name):
            assert traced_platform() == name
            assert SIZE.on(traced_platform()) == (2 if name == "cpu" else 5)


def traced_sizes(call, count):
    """Number of batches, and shape of one, of `count` items (3,), by platform."""

    def of_platform(name):
        with jax.default_device(name):
            jaxpr = jax.jit(lambda x: call(jnp.sin, x)).trace(np.zeros((count, 3))).jaxpr
        (loop,) = [eqn for eqn in jaxpr.jaxpr.eqns if eqn.primitive.name == "scan"]
        return loop.params["length"], loop.params["jaxpr"].jaxpr.invars[-1].aval.shape

    return {name: of_platform(name) for name in ("cpu", "gpu")}


def test_batches_are_of_the_size_of_the_platform():
    found = traced_sizes(lambda f, x: map_batches(f, x, batch_size=SIZE), 10)
    assert found == {"cpu": (5, (2, 3)), "gpu": (2, (5, 3))}
    found = traced_sizes(lambda f, x: map_batches(f, x, batch_size=4), 10)
    assert found == {"cpu": (3, (4, 3)), "gpu": (3, (4, 3))}


def test_drives_are_simulated_in_turn_on_a_cpu_and_together_elsewhere():
    count = 2 * DRIVE_BATCH.accelerator
    found = traced_sizes(map_drives, count)
    assert found == {"cpu": (count, (3,)), "gpu": (2, (DRIVE_BATCH.accelerator, 3))}
    items = np.linspace(0.0, 1.0, 3 * count).reshape(count, 3)
    with jax.default_device("gpu"):
        traced = jax.jit(lambda x: map_drives(jnp.sin, x)).trace(items)
    together = traced.lower(lowering_platforms=("cpu",)).compile()(items)
    np.testing.assert_allclose(together, np.sin(items), rtol=1e-12)


@pytest.mark.parametrize("platform", SIZE._fields)
def test_scans_of_all_drives_together_are_no_more_than_of_one(platform):
    drives, scans = getattr(DRIVE_BATCH, platform), getattr(DRIVE_SCAN_BATCH, platform)
    assert drives * scans == getattr(SCAN_BATCH, platform)


def test_a_device_map_has_the_size_of_its_devices_whatever_the_default_is():
    seen = []

    def function(common, item):
        seen.append(traced_platform())
        return common * item

    items = np.arange(7.0)
    whole = DeviceMap(function, size=SIZE)(2.0, items, devices=jax.devices()[:1])
    np.testing.assert_array_equal(whole, 2.0 * items)
    assert set(seen) == {"cpu"}
    with jax.default_device("gpu"):
        again = DeviceMap(function, size=SIZE)(3.0, items, devices=jax.devices("cpu")[:1])
    np.testing.assert_array_equal(again, 3.0 * items)
    assert set(seen) == {"cpu"}


@pytest.mark.parametrize("wrong", [BatchSize(0, 4), BatchSize(4, 0)])
def test_a_batch_of_nothing_is_refused(wrong):
    with pytest.raises(ValueError, match="size is .*, not 1 or more"):
        DeviceMap(jnp.multiply, size=wrong)
    if not wrong.cpu:
        with pytest.raises(ValueError, match="batch_size is 0, not 1 or more"):
            map_batches(jnp.sin, np.arange(3.0), batch_size=wrong)
