import gc
import os
import re
import subprocess
import sys
import threading
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import devices
from jaxslam.core.devices import (
    MAX_PROGRAMS,
    DeviceMap,
    _queue,
    _runner,
    use_cpu_devices,
)


def assert_same(one, two):
    jax.tree.map(np.testing.assert_array_equal, one, two)


def items(count):
    return {"a": jnp.arange(3.0 * count).reshape(count, 3), "b": jnp.arange(count)}


def scaled(power, common, item):
    return jax.tree.map(lambda x: common["by"] * jnp.sin(x.astype(float)) ** power, item)


@pytest.mark.parametrize("count", [1, 2, 5, 16, 19])
@pytest.mark.parametrize("devices", [1, 2])
def test_a_device_map_equals_vmap_on_any_number_of_devices(count, devices):
    common = {"by": jnp.float64(1.7)}
    device_map = DeviceMap(scaled, size=4, static=1)
    found = device_map(3, common, items(count), devices=jax.devices()[:devices])
    assert all(isinstance(x, np.ndarray) for x in jax.tree.leaves(found))
    expected = jax.vmap(lambda item: scaled(3, common, item))(items(count))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), found, expected)


def test_bits_do_not_depend_on_the_number_of_items_or_devices():
    common = {"by": jnp.float64(1.7)}
    device_map = DeviceMap(scaled, size=4, static=1)
    many = device_map(2, common, items(19))
    few = device_map(2, common, items(9), devices=jax.devices()[:1])
    assert_same(jax.tree.map(lambda x: x[:9], many), few)


def test_single_items_are_not_vectorised():
    """A condition of one item stays a branch: of a batch, both branches would be computed."""

    def signed(common, item):
        return jax.lax.cond(item > 0, lambda: common, lambda: -common)

    for size, word in [(1, "cond"), (2, "select")]:
        run = _runner(False, (signed,), size)
        assert word in str(run.trace((signed,), jnp.float64(1.0), jnp.arange(size)).jaxpr)
    assert DeviceMap(signed, size=1)(jnp.float64(2.0), jnp.array([1, 0, 3])).tolist() == [2, -2, 2]


def test_work_begins_before_its_results_are_waited_for():
    device_map = DeviceMap(scaled, size=2, static=1)
    common = {"by": jnp.float64(1.7)}
    finish = [device_map.begin(2, common, items(count)) for count in (3, 7)]
    for one, count in zip(finish, (3, 7), strict=True):
        assert_same(one(), device_map(2, common, items(count)))


USE = "import os, jax; from jaxslam.core import devices; devices.use_cpu_devices({}); "
PRINT = "print(jax.device_count(), os.environ.get('XLA_FLAGS', ''))"


def output_of(code, **own):
    keep = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    run = partial(subprocess.run, capture_output=True, text=True, timeout=60, check=True)
    return run([sys.executable, "-c", code], env=keep | own).stdout.split()


@pytest.mark.timeout(120)
@pytest.mark.slow
def test_every_core_is_a_device_by_default():
    whole = "--xla_disable_hlo_passes=cpu-parallel-task-assigner"
    three = "--xla_force_host_platform_device_count=3"
    assert output_of(USE.format(3) + PRINT) == ["3", three, whole]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert output_of(USE.format("") + PRINT)[0] == str(cores)
    # Flags of the user are kept, and so are backends that have started.
    assert output_of(USE.format(2) + PRINT, XLA_FLAGS=three) == ["3", three, whole]
    assert output_of("import jax; jax.devices(); " + USE.format(3) + PRINT) == ["1"]
    flags = "print(os.environ.get('XLA_FLAGS', '-'))"
    assert output_of(USE.format(3) + flags, JAX_PLATFORMS="tpu") == ["-"]


def test_a_device_map_traces_once_whatever_the_number_of_batches():
    traces = []

    def counted(common, item):
        traces.append(1)
        return common * item

    device_map = DeviceMap(counted, size=2)
    for _ in range(3):
        device_map(jnp.float64(2.0), jnp.arange(8.0))
    assert len(traces) == 1


@pytest.fixture
def few_objects():
    """Of all that other tests have left, nothing is looked through again by the collector."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


def live_programs():
    gc.collect()
    return len(jax.devices()[0].client.live_executables())


def test_devices_of_the_cpu_share_one_compiled_program(few_objects):
    device_map = DeviceMap(scaled, size=3, static=1)
    given = 5, {"by": np.float64(0.3)}, jax.tree.map(np.asarray, items(17))
    _runner.cache_clear()
    before = live_programs()
    both = device_map(*given, devices=jax.devices()[:2])
    alone = device_map(*given, devices=jax.devices()[:1])
    assert live_programs() == before + 1
    assert_same(both, alone)


def test_devices_with_memory_of_their_own_have_programs_of_their_own(monkeypatch, few_objects):
    device_map = DeviceMap(scaled, size=3, static=1)
    given = 6, {"by": np.float64(0.3)}, jax.tree.map(np.asarray, items(17))
    shared = device_map(*given, devices=jax.devices()[:2])
    monkeypatch.setattr(devices, "_is_cpu", lambda device: False)
    before = live_programs()
    assert_same(device_map(*given, devices=jax.devices()[:2]), shared)
    assert live_programs() == before + 1


def power_of(exponent, common, item):
    return common * item**exponent


def test_a_process_keeps_a_bounded_number_of_programs(few_objects):
    """What is compiled for a CPU takes up memory maps, of which a process has only so many."""

    device_map = DeviceMap(power_of, size=2, static=1)
    common, given = np.float64(2.0), np.array([1.0, 2.0, 3.0])
    first = device_map(0, common, given)
    _runner.cache_clear()
    before, counts = live_programs(), []
    for exponent in range(MAX_PROGRAMS + 3):
        found = device_map(exponent, common, given)
        np.testing.assert_allclose(found, 2.0 * given**exponent, rtol=1e-15)
        counts.append(live_programs() - before)
    assert counts[:MAX_PROGRAMS] == list(range(1, MAX_PROGRAMS + 1))
    assert counts[MAX_PROGRAMS:] == 3 * [MAX_PROGRAMS]
    assert_same(device_map(0, common, given), first)  # compiled again


def test_devices_work_at_the_same_time(monkeypatch):
    """Each waits for the other at the end of every batch, which they could not in turn."""
    both, wait = threading.Barrier(2, timeout=30), jax.block_until_ready
    monkeypatch.setattr(jax, "block_until_ready", lambda x: [wait(x), both.wait()][0])
    found = DeviceMap(square, size=1)(2.0, np.arange(6.0), devices=jax.devices()[:2])
    np.testing.assert_array_equal(found, 2.0 * np.arange(6.0) ** 2)


def test_work_that_is_given_up_is_not_begun(monkeypatch):
    done, go_on, wait = [], threading.Event(), jax.block_until_ready

    def second_waits(x):
        done.append(wait(x))
        assert len(done) == 1 or go_on.wait(30)
        return x

    def interrupted(mesh, parts):
        raise KeyboardInterrupt

    monkeypatch.setattr(jax, "block_until_ready", second_waits)
    monkeypatch.setattr(devices, "_gather", interrupted)
    device = jax.devices()[0]
    finish = DeviceMap(square, size=1).begin(2.0, np.arange(5.0), devices=[device])
    with pytest.raises(KeyboardInterrupt):
        finish()
    go_on.set()
    _queue(device).submit(int).result(30)
    assert len(done) <= 2


def test_devices_work_in_the_precision_of_the_caller(single_precision):
    found = DeviceMap(square, size=2)(np.float32(0.1), np.arange(5, dtype=np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, 0.1 * np.arange(5.0) ** 2, rtol=1e-6)


def square(common, item):
    return common * item**2


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_items_may_be_arrays_of_numpy_or_jax(kind):
    found = DeviceMap(square, size=2)(kind(2.0), kind([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(found, [2.0, 8.0, 18.0])


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: DeviceMap(square, size=0), "size is 0, not 1 or more"),
        (lambda: DeviceMap(square, size=2, static=-1), "static is -1, not 0 or more"),
        (lambda: DeviceMap(square, size=2)(np.zeros(3)), "1 arguments, not 0 static ones, the com"),
        (lambda: DeviceMap(square, size=2)(2.0, np.zeros(0)), "items is empty"),
        (lambda: DeviceMap(square, size=2)(2.0, [np.zeros(2), np.zeros(3)]), "lengths: [2, 3]"),
        (lambda: use_cpu_devices(0), "num_devices is 0, not 1 or more"),
    ],
)
def test_impossible_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


def test_what_is_compiled_quickly_is_the_same_to_rounding():
    items = jnp.linspace(0.0, 3.0, 8)
    found = [DeviceMap(wave, size=2, compile_quickly=q)(jnp.float64(2.0), items) for q in (0, 1)]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-14)


def wave(common, item):
    return jnp.sin(common * item) + jnp.exp(-item)
