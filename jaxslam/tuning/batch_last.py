"""Functions of small arrays: a batch that is the last axis, and derivatives that recompute.

`vmap` puts the batch first. Matrices of a few rows then are short pieces of memory, and a loop over
one does not vectorise. With the batch last each element of a matrix is one long vector:

    a[i, k] is (B,);    (A B)[i, j] = sum_k a[i, k] * b[k, j]    is vectorised over the batch
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

Batched = Any
"""Which arrays of a record have a batch axis, a record of bools; None: there is no batch."""


def recomputed(function: Callable[[Any, Batched], tuple[Any, Any]], *, last: bool) -> Callable:
    """A function of one item whose derivative, in reverse only, keeps nothing but the arguments.

    In a `lax.scan` that is the memory of the states alone; the price is that each step is computed
    twice.

    Args:
        function: Of a record of arrays and `Batched`. Those that are batched have the batch as
            their last axis; all that it returns must have it. It returns the results that can be
            differentiated, arrays of floats, and others.
        last: Whether `jax.vmap` makes the batch the last axis; else it is first, and `Batched` is
            always None.

    Returns:
        A function of the record.
    """

    def of_item(args: Any) -> Any:
        return function(args, None)

    def pull_item(args: Any, grad_out: Any) -> Any:
        return _pull(function, args, None, grad_out)

    forward_last, backward_last = custom_vmap(of_item), custom_vmap(pull_item)

    @forward_last.def_vmap
    def forward_rule(size: int, batched: Any, args: Any) -> tuple[Any, Any]:
        del size
        out = function(_move_last(args, batched[0]), batched[0])
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), out), jax.tree.map(_true, out)

    @backward_last.def_vmap
    def backward_rule(size: int, batched: Any, args: Any, grad_out: Any) -> tuple[Any, Any]:
        # Each item has its own derivative, also by what all items share.
        def repeat(x: Any, own: bool) -> Any:
            return x if own or not _is_float(x) else jnp.broadcast_to(x[None], (size, *x.shape))

        args = jax.tree.map(repeat, args, batched[0])
        own = jax.tree.map(lambda x, b: b or _is_float(x), args, batched[0])
        grad_out = jax.tree.map(
            lambda x, b: x if b else jnp.broadcast_to(x[None], (size, *x.shape)),
            grad_out,
            batched[1],
        )
        grad_out = _move_last(grad_out, jax.tree.map(_true, grad_out))
        grads = _pull(function, _move_last(args, own), own, grad_out)
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), grads), jax.tree.map(_true, grads)

    forward = forward_last if last else of_item
    backward = backward_last if last else pull_item

    @jax.custom_vjp
    def call(args: Any) -> Any:
        return forward(args)

    def call_fwd(args: Any) -> tuple[Any, Any]:
        return forward(args), args

    def call_bwd(args: Any, grad_out: Any) -> tuple[Any]:
        return (backward(args, grad_out[0]),)

    call.defvjp(call_fwd, call_bwd)
    return call


def _pull(function: Callable, args: Any, batched: Batched, grad_out: Any) -> Any:
    """Derivatives by the arrays of floats among the arguments; None for the others."""
    leaves, treedef = jax.tree.flatten(args)
    floats = [_is_float(x) for x in leaves]

    def of_floats(given: list[Any]) -> Any:
        remaining = iter(given)
        merged = [next(remaining) if f else x for x, f in zip(leaves, floats, strict=True)]
        return function(jax.tree.unflatten(treedef, merged), batched)

    own = [x for x, f in zip(leaves, floats, strict=True) if f]
    pull = jax.vjp(of_floats, own, has_aux=True)[1]
    grads = iter(pull(grad_out)[0])
    return jax.tree.unflatten(treedef, [next(grads) if f else None for f in floats])


def _move_last(args: Any, batched: Any) -> Any:
    return jax.tree.map(lambda x, own: jnp.moveaxis(x, 0, -1) if own else x, args, batched)


def _is_float(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


def _true(x: Any) -> bool:
    del x
    return True
