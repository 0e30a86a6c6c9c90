"""Map a function over many items: in batches on each device, on all devices of all processes."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from jaxslam.core.types import Array


def sequential_vmap_on_cpu(function: Callable) -> Callable:
    """`function` whose `jax.vmap` is a loop over the batch on a CPU, and a plain vmap elsewhere.

        vmap(one_by_one(f))(x)  =  lax.map(f, x)  on a CPU,  vmap(f)(x)  on other platforms

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
            return called(*treedef.unflatten(merged))

        loop = partial(lax.map, partial(on_item, sequential))
        vectorised = jax.vmap(partial(on_item, function))
        result = lax.platform_dependent(batched, cpu=loop, default=vectorised)
        return result, jax.tree.map(lambda _: True, result)

    return sequential


def map_batches(function: Callable, items: Any, *, batch_size: int) -> Any:
    """Map `function` over the leading axis of `items`, `batch_size` of them vectorised at a time.

    The last batch is filled up with copies of the last item: unlike `lax.map(batch_size=...)`
    this compiles the function once.
    """
    count = jax.tree.leaves(items)[0].shape[0]
    batch_size = min(batch_size, count)
    items = pad_to(items, to=count + -count % batch_size)
    batches = jax.tree.map(lambda x: x.reshape((-1, batch_size) + x.shape[1:]), items)
    result = lax.map(jax.vmap(function), batches)
    return jax.tree.map(lambda x: x.reshape((-1,) + x.shape[2:])[:count], result)


def pad_to(items: Any, *, to: int) -> Any:
    """Repeat the last of `items`, arrays that lead with their number, until there are `to`."""

    def lengthen(x: Any) -> Any:
        missing = to - x.shape[0]
        if not missing:
            return x
        numpy = jnp if isinstance(x, jax.Array) else np
        return numpy.concatenate([x, numpy.repeat(x[-1:], missing, axis=0)])

    return jax.tree.map(lengthen, items)
