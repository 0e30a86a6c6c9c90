"""Orders of a few numbers without a sort, which is slow on a CPU: by comparing all pairs."""

import jax.numpy as jnp

from jaxslam.core.types import Array

MAX_COMPARED = 64  # keys whose pairs are all compared


def stable_order(key: Array) -> Array:
    """Index (N,) int32 of keys in ascending order, equal ones in their order.

    `jnp.argsort(key, stable=True)`, for up to `MAX_COMPARED` keys as N^2 comparisons, which then
    take a part of its time.

    Args:
        key: (N,) real numbers; NaN counts as infinity.
    """
    key = jnp.where(jnp.isnan(key), jnp.inf, key)
    if key.size > MAX_COMPARED:
        return jnp.argsort(key, stable=True).astype(jnp.int32)
    index = jnp.arange(key.size, dtype=jnp.int32)
    other, earlier = key[:, None], index[:, None] < index[None]
    before = (other < key[None]) | ((other == key[None]) & earlier)
    rank = jnp.sum(before, axis=0, dtype=jnp.int32)
    is_ranked = rank[:, None] == index[None]
    return jnp.sum(jnp.where(is_ranked, index[:, None], 0), axis=0, dtype=jnp.int32)


def first_true(mask: Array, count: int) -> tuple[Array, Array]:
    """Index (count,) int32 of the first true entries of a mask (N,), 0 where there are no more.

    Also returned is where there is one: (count,) bool.
    """
    index = jnp.arange(mask.size, dtype=jnp.int32)
    rank = jnp.where(mask, jnp.cumsum(mask, dtype=jnp.int32) - 1, mask.size)
    place = jnp.arange(count, dtype=jnp.int32)
    is_ranked = rank[:, None] == place[None]
    first = jnp.sum(jnp.where(is_ranked, index[:, None], 0), axis=0, dtype=jnp.int32)
    return first, place < jnp.sum(mask, dtype=jnp.int32)


def sorted_three(rows: Array) -> tuple[Array, Array, Array]:
    """The smallest, the middle and the largest (C,) of each column of (3, C)."""
    a, b, c = rows
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    middle = jnp.maximum(low, jnp.minimum(high, c))
    return jnp.minimum(low, c), middle, jnp.maximum(high, c)
