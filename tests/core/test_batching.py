import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.batching import (
    map_batches,
    on_device,
    pad_to,
    sequential_vmap_on_cpu,
    update_where,
)


def assert_same(one, two):
    jax.tree.map(np.testing.assert_array_equal, one, two)


def items(count):
    return {"a": jnp.arange(3.0 * count).reshape(count, 3), "b": jnp.arange(count)}


def function(item):
    return item["a"].sum() * item["b"].astype(float), item["b"] + 1


@pytest.mark.parametrize("count, size", [(7, 3), (6, 3), (2, 5), (1, 1)])
def test_map_batches_equals_vmap(count, size):
    ours = map_batches(function, items(count), batch_size=size)
    assert_same(ours, jax.jit(jax.vmap(function))(items(count)))


def test_padding_repeats_the_last_and_keeps_the_kind_of_array():
    for x in (np.arange(3.0), jnp.arange(3.0)):
        longer = pad_to(x, to=5)
        assert longer.tolist() == [0, 1, 2, 2, 2] and type(longer) is type(x)
    assert pad_to(jnp.arange(3), to=3).tolist() == [0, 1, 2]


def scaled_sum(item, other):
    return {"x": item["a"] * other, "y": item["b"] + 1}


def doubly_mapped(f):
    return jax.vmap(jax.vmap(f, in_axes=(0, None)), in_axes=(0, 0))


def test_sequential_vmap_is_vmap_at_any_depth_with_shared_arguments():
    some = {"a": jnp.arange(24.0).reshape(2, 3, 4), "b": jnp.arange(6).reshape(2, 3)}
    other = jnp.arange(8.0).reshape(2, 4)
    sequential = jax.jit(doubly_mapped(sequential_vmap_on_cpu(scaled_sum)))
    assert_same(sequential(some, other), jax.jit(doubly_mapped(scaled_sum))(some, other))


def absolute(x):
    return jax.lax.cond(x > 0, lambda x: x, lambda x: -x, x)


def test_a_condition_stays_a_branch_under_a_sequential_vmap():
    """On a CPU only the branch that an item takes is computed; a vectorised one computes both."""

    def compiled(f):
        return jax.jit(jax.vmap(f)).lower(jnp.arange(4)).compile().as_text()

    looped = compiled(sequential_vmap_on_cpu(absolute))
    assert "conditional" in looped and "while" in looped
    assert "conditional" not in compiled(absolute)


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_items_may_be_arrays_of_numpy_or_jax(kind):
    given = jax.tree.map(kind, items(5))
    mapped = jax.jit(jax.vmap(function))(items(5))
    assert_same(map_batches(function, given, batch_size=2), mapped)


@pytest.mark.parametrize(
    "items, size, message",
    [
        (np.zeros((0, 3)), 2, "items is empty"),
        ((np.zeros(3), np.zeros(4)), 2, "items holds arrays of different lengths: [3, 4]"),
        ((np.zeros(3), 1.0), 2, "items has shapes [(3,), ()], not those of arrays with a leading"),
        ({}, 2, "items has shapes [], not those of arrays with a leading axis"),
        (np.zeros(3), 0, "batch_size is 0, not 1 or more"),
    ],
)
def test_items_that_cannot_be_mapped_are_refused(items, size, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        map_batches(function, items, batch_size=size)


@pytest.mark.parametrize("block", [1, 3, 8])
def test_updates_where_wanted_are_those_of_the_loop(block):
    wanted = np.array([True, False, True, True, False, True, True])
    state = {"a": np.arange(7.0), "b": np.arange(14.0).reshape(7, 2)}
    own, shared = np.arange(7.0) + 10.0, np.array([2.0, 3.0])

    def update(state, own, shared):
        return {"a": state["a"] + own, "b": state["b"] * shared}

    def one(wanted, state, own):
        return update_where(wanted, update, state, own, shared, block=block)

    found, alone = jax.jit(jax.vmap(one))(wanted, state, own), jax.jit(one)
    for k in range(7):
        item = jax.tree.map(lambda x: x[k], state)  # noqa: B023
        expected = update(item, own[k], shared) if wanted[k] else item
        jax.tree.map(np.testing.assert_array_equal, expected, alone(wanted[k], item, own[k]))
        of_batch = jax.tree.map(lambda x: x[k], found)  # noqa: B023
        jax.tree.map(np.testing.assert_array_equal, expected, of_batch)


def test_updates_that_are_not_wanted_are_not_computed():
    calls = []

    def update(state):
        jax.debug.callback(lambda _: calls.append(1), state)
        return state + 1.0

    def one(wanted, state):
        return update_where(wanted, update, state, block=2)

    for count, expected in ((0, 0), (1, 2), (4, 4), (5, 6)):
        calls.clear()
        jax.block_until_ready(jax.vmap(one)(jnp.arange(9) < count, jnp.arange(9.0)))
        jax.effects_barrier()
        assert len(calls) == expected


def test_arrays_on_the_device_have_its_precision_and_keep_their_kind():
    given = {"real": np.ones(3, np.float32), "whole": np.arange(3, dtype=np.int32), "flag": [True]}
    given["flag"] = np.array(given["flag"])
    found = on_device(given)
    assert found["real"].dtype == jnp.zeros(()).dtype and found["whole"].dtype == jnp.int32
    assert found["flag"].dtype == jnp.bool_ and isinstance(found["whole"], jax.Array)


@pytest.mark.parametrize("wide", [False, True])
def test_arrays_come_to_the_device_without_a_program(wide):
    """Shapes and types that no other test has; `jnp.asarray` compiles one for each."""
    given = [np.full((3, 17, wide + 2), 0.1, kind) for kind in (np.float16, np.float32, float)]
    given += [np.zeros((19, 3, wide + 1), kind) for kind in (bool, np.int32, np.int64)]
    programs = []

    def listen(event, *_, **__):
        if "backend_compile" in event:
            programs.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        with jax.enable_x64(wide):
            found = on_device(given)
            assert not programs
            wanted = [jnp.asarray(x, float if x.dtype.kind == "f" else None) for x in given]
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    for one, other in zip(found, wanted, strict=True):
        assert one.dtype == other.dtype and not one.weak_type
        np.testing.assert_array_equal(one, other)
