import os
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.batching import map_batches, pad_to, sequential_vmap_on_cpu
from jaxslam.core.devices import DeviceMap, _run


def assert_same(one, two):
    jax.tree.map(np.testing.assert_array_equal, one, two)


def items(count):
    return {"a": jnp.arange(3.0 * count).reshape(count, 3), "b": jnp.arange(count)}


def function(item):
    return item["a"].sum() * item["b"].astype(float), item["b"] + 1


@pytest.mark.parametrize("count, size", [(7, 3), (6, 3), (2, 5), (1, 1)])
def test_map_batches_equals_vmap(count, size):
    ours = map_batches(function, items(count), batch_size=size)
    assert_same(ours, jax.vmap(function)(items(count)))


def test_padding_repeats_the_last_and_keeps_the_kind_of_array():
    for x in (np.arange(3.0), jnp.arange(3.0)):
        longer = pad_to(x, to=5)
        assert longer.tolist() == [0, 1, 2, 2, 2] and type(longer) is type(x)
    assert pad_to(jnp.arange(3), to=3).tolist() == [0, 1, 2]


def test_one_by_one_is_vmap_at_any_depth_and_with_what_is_common():
    both = lambda f: jax.vmap(jax.vmap(f, in_axes=(0, None)), in_axes=(0, 0))
    some = {"a": jnp.arange(24.0).reshape(2, 3, 4), "b": jnp.arange(6).reshape(2, 3)}
    other = jnp.arange(8.0).reshape(2, 4)
    what = lambda item, other: {"x": item["a"] * other, "y": item["b"] + 1}
    assert_same(jax.jit(both(sequential_vmap_on_cpu(what)))(some, other), both(what)(some, other))


def test_what_is_done_one_by_one_stays_a_decision():
    """On a CPU no item does what another needs: of a vectorised condition both sides are done."""
    decide = lambda x: jax.lax.cond(x > 0, lambda x: x, lambda x: -x, x)
    compiled = lambda f: jax.jit(jax.vmap(f)).lower(jnp.arange(4)).compile().as_text()
    assert "conditional" in compiled(sequential_vmap_on_cpu(decide)) and "while" in compiled(
        sequential_vmap_on_cpu(decide)
    )
    assert "conditional" not in compiled(decide)


def scaled(power, common, item):
    return jax.tree.map(lambda x: common["by"] * jnp.sin(x.astype(float)) ** power, item)


@pytest.mark.parametrize("count", [1, 2, 5, 16, 19])
@pytest.mark.parametrize("devices", [1, 2])
def test_spread_equals_vmap_on_any_number_of_devices(count, devices):
    common = {"by": jnp.float64(1.7)}
    spread = DeviceMap(scaled, size=4, static=1)
    ours = spread(3, common, items(count), devices=jax.devices()[:devices])
    assert all(isinstance(x, np.ndarray) for x in jax.tree.leaves(ours))
    theirs = jax.vmap(lambda item: scaled(3, common, item))(items(count))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), ours, theirs)


def test_bits_do_not_depend_on_the_number_of_items_or_devices():
    common = {"by": jnp.float64(1.7)}
    spread = DeviceMap(scaled, size=4, static=1)
    many = spread(2, common, items(19))
    few = spread(2, common, items(9), devices=jax.devices()[:1])
    assert_same(jax.tree.map(lambda x: x[:9], many), few)


def test_what_is_one_at_a_time_is_not_vectorised():
    """A decision of one item stays one: of a batch, both sides would be done."""
    decide = lambda common, item: jax.lax.cond(item > 0, lambda: common, lambda: -common)
    for size, word in [(1, "cond"), (2, "select")]:
        run = _run.trace((decide,), jnp.float64(1.0), jnp.arange(size)).jaxpr
        assert word in str(run)
    assert DeviceMap(decide, size=1)(jnp.float64(2.0), jnp.array([1, 0, 3])).tolist() == [2, -2, 2]


def test_work_is_begun_before_it_is_waited_for():
    spread = DeviceMap(scaled, size=2, static=1)
    common = {"by": jnp.float64(1.7)}
    finish = [spread.begin(2, common, items(count)) for count in (3, 7)]
    for one, count in zip(finish, (3, 7), strict=True):
        assert_same(one(), spread(2, common, items(count)))


USE = "import os, jax; from jaxslam import batches; batches.use_cores({}); "
TELL = "print(jax.device_count(), os.environ.get('XLA_FLAGS', ''))"


def told(code, **own):
    keep = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    run = partial(subprocess.run, capture_output=True, text=True, timeout=60, check=True)
    return run([sys.executable, "-c", code], env=keep | own).stdout.split()


@pytest.mark.timeout(120)
def test_every_core_is_a_device_unless_told_otherwise():
    whole = "--xla_disable_hlo_passes=cpu-parallel-task-assigner"
    three = "--xla_force_host_platform_device_count=3"
    assert told(USE.format(3) + TELL) == ["3", three, whole]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert told(USE.format("") + TELL)[0] == str(cores)
    # What the user says holds, and what is up stays.
    assert told(USE.format(2) + TELL, XLA_FLAGS=three) == ["3", three, whole]
    assert told("import jax; jax.devices(); " + USE.format(3) + TELL) == ["1"]
    assert told(USE.format(3) + "print(os.environ.get('XLA_FLAGS', '-'))", JAX_PLATFORMS="tpu") == [
        "-"
    ]


def test_spread_is_traced_once_for_each_number_of_batches():
    traces = []

    def counted(common, item):
        traces.append(1)
        return common * item

    spread = DeviceMap(counted, size=2)
    for _ in range(3):
        spread(jnp.float64(2.0), jnp.arange(8.0))
    assert len(traces) == 1
