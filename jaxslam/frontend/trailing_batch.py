"""Functions of one scan that are written for many, with the batch as the last axis.

`jax.vmap` puts the batch first. A loop over the beams of a scan works on few numbers for each: with
the batch last, sums and minima over these are vectorised over the scans.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from jaxslam.core.types import Array


def with_trailing_batch(function: Callable) -> Callable:
    """A function of one item, of one that takes and returns arrays (..., B) of B items.

        f = with_trailing_batch(function),   f(x) = function(x[..., None])[..., 0]
        vmap(f)(x) = moveaxis(function(moveaxis(x, 0, -1)), -1, 0)

    Args:
        function: Of arrays; it must not close over arrays, and treat the items alike.

    Returns:
        The function of arrays (...). It may be differentiated; where it is, items are batched by
        `jax.vmap` as usual.
    """

    def of_one(*args: Array) -> Any:
        return jax.tree.map(lambda x: x[..., 0], function(*(x[..., None] for x in args)))

    batched = custom_vmap(of_one)

    @batched.def_vmap
    def rule(size: int, is_batched: Sequence[bool], *args: Array) -> tuple[Any, Any]:
        last = [
            jnp.moveaxis(x, 0, -1) if own else jnp.broadcast_to(x[..., None], (*x.shape, size))
            for x, own in zip(args, is_batched, strict=True)
        ]
        result = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), function(*last))
        return result, jax.tree.map(lambda _: True, result)

    differentiable = jax.custom_jvp(lambda *args: batched(*args))

    @differentiable.defjvp
    def jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Any, Any]:
        return jax.jvp(of_one, primals, tangents)

    return differentiable
