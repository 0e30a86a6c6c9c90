"""Map a function over many items: in batches on each device, on all devices of all processes."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from jaxslam.core.trace_cache import setting
from jaxslam.core.types import Array


class BatchSize(NamedTuple):
    """Items that are vectorised at a time, by what they run on.

    On a CPU there are few: their arrays stay in its cache, and more of them are not faster. An
    accelerator begins an operation in some microseconds, however few numbers it is of, so that
    there are as many as keep it busy; they cost memory, and where there are fewer items than a
    batch holds, work on copies.

    Attributes:
        cpu: On a CPU.
        accelerator: On all else.
    """

    cpu: int
    accelerator: int

    def on(self, platform: str) -> int:
        """The number on a platform, as `Device.platform` and `traced_platform` name it."""
        return self.cpu if platform == "cpu" else self.accelerator


def traced_platform() -> str:
    """Platform that programs are traced for: of `jax.default_device`, else of the default backend.

    JAX traces a function again where its default device is another one. So a host without an
    accelerator lowers programs for one by

        with jax.default_device("gpu"):
            traced = jax.jit(function).trace(*arguments)
        traced.lower(lowering_platforms=("cuda",))
    """
    chosen = setting("jax_default_device")
    if chosen is None:
        return jax.default_backend()
    return chosen if isinstance(chosen, str) else chosen.platform


def sequential_vmap_on_cpu(function: Callable) -> Callable:
    """`function` whose `jax.vmap` is a loop over the batch on a CPU, and a plain vmap elsewhere.

        vmap(sequential_vmap_on_cpu(f))(x)  =  lax.map(f, x)  on a CPU,  vmap(f)(x)  elsewhere

    On a CPU the arrays of one item stay in the cache, a `lax.cond` stays a branch, and results are
    computed once: XLA fuses operations on a whole batch that it takes for cheap into each of
    their consumers and repeats them there, which for some on images is most of the run time.
    Under several vmaps each becomes a loop.

    Args:
        function: Of arrays, or records of them; it must not close over arrays.
    """
    sequential = custom_vmap(function)

    @sequential.def_vmap
    def rule(axis_size: int, in_batched: Sequence[Any], *args: Any) -> tuple[Any, Any]:
        del axis_size
        leaves, treedef = jax.tree.flatten(args)
        has_batch_axis = jax.tree.leaves(in_batched)
        batched = [x for x, own in zip(leaves, has_batch_axis, strict=True) if own]

        def on_item(called: Callable, own_leaves: list[Array]) -> Any:
            """Call on the leaves of one item, and the leaves that all items share."""
            remaining = iter(own_leaves)
            merged = [
                next(remaining) if own else shared
                for shared, own in zip(leaves, has_batch_axis, strict=True)
            ]
            return called(*jax.tree.unflatten(treedef, merged))

        loop = partial(lax.map, partial(on_item, sequential))
        vectorised = jax.vmap(partial(on_item, function))
        result = lax.platform_dependent(batched, cpu=loop, default=vectorised)
        return result, jax.tree.map(lambda _: True, result)

    return sequential


def update_where(wanted: Array, update: Callable, state: Any, *given: Any, block: int) -> Any:
    """`update(state, *given)` where `wanted`, else `state`; under vmap only for those that want it.

    `vmap` turns a `lax.cond` with a batched condition into a select that computes all of a batch.
    This function has its own batching rule: members that want it are gathered and updated, a block
    of them at a time, so the cost is that of their number, rounded up to whole blocks.

    Args:
        wanted: () bool.
        update: Of records of arrays; it must not close over arrays: pass them in `given`.
        state: What is updated; the result has its structure, shapes and dtypes.
        *given: Further arguments of `update`.
        block: Members of a batch that are updated at once.

    Returns:
        The state. It has no derivative rule.
    """

    @custom_vmap
    def branch(wanted: Array, operands: Any) -> Any:
        return lax.cond(wanted, lambda xs: update(xs[0], *xs[1]), lambda xs: xs[0], operands)

    @branch.def_vmap
    def in_blocks(size: int, is_batched: Any, wanted: Array, operands: Any) -> tuple[Any, Any]:
        state, given = operands
        own_wanted, (own_state, own_given) = is_batched
        wanted = wanted if own_wanted else jnp.broadcast_to(wanted, (size,))
        state = jax.tree.map(
            lambda x, own: x if own else jnp.broadcast_to(x, (size, *x.shape)),
            state,
            own_state,
        )
        order = jnp.argsort(~wanted)  # stable: those that want it, in their order, come first
        order = jnp.concatenate([order, jnp.full(block, size, order.dtype)])
        count = jnp.sum(wanted, dtype=jnp.int32)
        leaves, treedef = jax.tree.flatten(given)
        batched = jax.tree.leaves(own_given)

        def on_block(number: Array, state: Any) -> Any:
            rank = number * block + jnp.arange(block, dtype=jnp.int32)
            chosen = jnp.where(rank < count, order[rank], size)  # `size`: none
            some = [x[chosen] if own else x for x, own in zip(leaves, batched, strict=True)]
            axes = jax.tree.unflatten(treedef, [0 if own else None for own in batched])
            of_block = jax.tree.map(lambda x: x[chosen], state)
            after = jax.vmap(lambda state, given: update(state, *given), (0, axes))(
                of_block, jax.tree.unflatten(treedef, some)
            )
            return jax.tree.map(lambda x, y: x.at[chosen].set(y, mode="drop"), state, after)

        result = lax.fori_loop(0, (count + block - 1) // block, on_block, state)
        return result, jax.tree.map(lambda _: True, result)

    return branch(wanted, (state, given))


def map_batches(function: Callable, items: Any, *, batch_size: int | BatchSize) -> Any:
    """Map `function` over the leading axis of `items`, `batch_size` of them vectorised at a time.

    The last batch is filled up with copies of the last item: unlike `lax.map(batch_size=...)`
    this compiles the function once.

    Args:
        function: Of one item, an array or a record of arrays.
        items: Arrays of NumPy or JAX that lead with the number of items, at least one.
        batch_size: Items of a batch; of a `BatchSize` those on `traced_platform`.

    Returns:
        The results, arrays that lead with the number of items.

    Raises:
        ValueError: There are no items, their arrays differ in length, or `batch_size` is below 1.
    """
    count = leading_size("items", items)
    if isinstance(batch_size, BatchSize):
        batch_size = batch_size.on(traced_platform())
    if batch_size < 1:
        raise ValueError(f"batch_size is {batch_size}, not 1 or more")
    batch_size = min(batch_size, count)
    items = pad_to(items, to=count + -count % batch_size)
    batches = jax.tree.map(lambda x: x.reshape((-1, batch_size) + x.shape[1:]), items)
    result = lax.map(jax.vmap(function), batches)
    return jax.tree.map(lambda x: x.reshape((-1,) + x.shape[2:])[:count], result)


def leading_size(name: str, items: Any) -> int:
    """The number of items: the length of all arrays of a record.

    Args:
        name: Name of `items`, for the message.
        items: Arrays of NumPy or JAX, or a record of them.

    Raises:
        ValueError: There are no arrays, one has no axes or no entries, or their lengths differ.
    """
    shapes = [np.shape(x) for x in jax.tree.leaves(items)]
    if not shapes or () in shapes:
        raise ValueError(f"{name} has shapes {shapes}, not those of arrays with a leading axis")
    lengths = sorted({shape[0] for shape in shapes})
    if len(lengths) > 1:
        raise ValueError(f"{name} holds arrays of different lengths: {lengths}")
    if not lengths[0]:
        raise ValueError(f"{name} is empty")
    return lengths[0]


def pad_to(items: Any, *, to: int) -> Any:
    """Repeat the last of `items`, arrays that lead with their number, until there are `to`."""

    def lengthen(x: Any) -> Any:
        missing = to - x.shape[0]
        if not missing:
            return x
        xp = jnp if isinstance(x, jax.Array) else np
        return xp.concatenate([x, xp.repeat(x[-1:], missing, axis=0)])

    return jax.tree.map(lengthen, items)


def on_device(items: Any) -> Any:
    """NumPy arrays and numbers as JAX arrays, real numbers in JAX's default precision.

    Nothing is compiled; `jnp.asarray` compiles a program for each shape and type.
    """

    def put(x: Any) -> Array:
        array = np.asarray(x)
        return jax.device_put(array.astype(float) if array.dtype.kind == "f" else array)

    return jax.tree.map(put, items)
