"""Which feature is which landmark: gates on distances; knows no filter."""

import jax.numpy as jnp

from jaxslam.types import Array


def match(distance: Array, possible: Array, *, gate: float, margin: float) -> Array:
    """Match features to landmarks one to one.

    A pair is believed when it lies in the gate, each is the nearest to the other, and the
    runner-up of the feature is clearly further; what is ambiguous stays unmatched.

    Args:
        distance: (M, L) squared Mahalanobis distances.
        possible: (M, L) bool, pairs that may be matched at all.
        gate: Largest squared distance of a match.
        margin: How much further, in squared distance, the second nearest landmark must be.

    Returns:
        (M,) int32 landmark of each feature, L for none.
    """
    m, l = distance.shape
    d = jnp.where(possible & jnp.isfinite(distance), distance, jnp.inf)
    best = jnp.argmin(d, axis=1)
    nearest = jnp.take_along_axis(d, best[:, None], axis=1)[:, 0]
    others = jnp.where(jnp.arange(l)[None] == best[:, None], jnp.inf, d)
    clear = jnp.min(others, axis=1) > nearest + margin
    mutual = jnp.argmin(d, axis=0)[best] == jnp.arange(m)
    return jnp.where((nearest < gate) & clear & mutual, best, l).astype(jnp.int32)


def claim_slots(worth: Array, wanted: Array) -> Array:
    """Slot (M,) int32 for each feature that wants one, in order; L, nowhere, for all others.

    Args:
        worth: (L,) what is lost with each slot; the least go first, infinite ones never.
        wanted: (M,) bool.
    """
    l = worth.size
    index = jnp.arange(l, dtype=jnp.int32)
    before = (worth[:, None] < worth[None]) | (
        (worth[:, None] == worth[None]) & (index[:, None] < index[None])
    )
    place = jnp.sum(before, axis=0, dtype=jnp.int32)  # in the order of worth
    turn = jnp.where(wanted, jnp.cumsum(wanted, dtype=jnp.int32) - 1, l)
    mine = (turn[:, None] == place[None]) & (worth < jnp.inf)[None]
    return jnp.where(jnp.any(mine, axis=1), jnp.argmax(mine, axis=1), l).astype(jnp.int32)
