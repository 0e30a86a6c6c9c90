"""The covariance of a map (2 L, 2 L): an array, or one from which products are still to be taken.

An update takes the product of a few rows from all of a map that may be large. Put off, it costs
little: what is asked of the covariance in between, a few of its rows, is worked out when it is
asked, and many products are taken at once, as one of matrices. Nothing is approximated. There are
no derivatives of a covariance that is put off.

References:
    Knight, Davison, Reid (2001), Towards constant time SLAM using postponement.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.linalg import add_products, lower
from jaxslam.linalg import put_rows as put_in
from jaxslam.types import Array

GUARD = 2  # units of rounding by which each update raises the variances
LARGE = 256  # rows of a map above which it pays to leave zeros out
STRIP = 192  # rows of a covariance that are worked on at a time
ROOM = 96  # rows that are put off at most


class Postponed(NamedTuple):
    """A symmetric matrix `base` - `rows`^T `rows`; made by `postpone`, ended by `settle`."""

    base: Array  # (n, n)
    rows: Array  # (ROOM, n) those that are put off, then zeros
    sums: Array  # (2, n) over them: each number squared, and every second times the next
    held: Array  # () int32 how many
    updates: Array  # () in how many updates


def postpone(cov: Array) -> Postponed:
    """A covariance (n, n), from here on put off."""
    none = jnp.zeros((ROOM + 2, len(cov)), cov.dtype)
    return Postponed(cov, none[2:], none[:2], jnp.int32(0), jnp.zeros((), cov.dtype))


def settle(cov: Array | Postponed) -> Array:
    """The covariance (n, n), with nothing put off."""
    if not isinstance(cov, Postponed):
        return cov
    at = jnp.arange(len(cov.base), dtype=jnp.int32)
    raised = 1 + GUARD * np.finfo(cov.base.dtype).eps * cov.updates
    return _settled(cov.base, cov.rows).at[at, at].multiply(raised, unique_indices=True)


def _settled(base: Array, rows: Array) -> Array:
    """`base` - rows^T rows, a strip at a time in place, as far as any row is not zero."""
    columns = rows.T
    whole, rest = divmod(len(base), STRIP)
    if rest:
        base = base.at[-rest:].add(-columns[-rest:] @ rows)
    if not whole:
        return base

    def strip(k: Array, now: Array) -> Array:
        own = lambda x: lax.dynamic_slice_in_dim(x, k * STRIP, STRIP)
        return lax.dynamic_update_slice_in_dim(now, own(now) - own(columns) @ rows, k * STRIP, 0)

    used = jnp.any(columns[: whole * STRIP].reshape(whole, -1) != 0.0, axis=1)
    number = jnp.arange(1, whole + 1, dtype=jnp.int32)
    return lax.fori_loop(0, jnp.max(jnp.where(used, number, 0)), strip, base)


def make_room(cov: Array | Postponed, more: int) -> Array | Postponed:
    """The same, after which `more` rows can be put off."""
    if not isinstance(cov, Postponed):
        return cov
    full = cov.held + more > ROOM
    return lax.cond(full, lambda cov: postpone(settle(cov)), lambda cov: cov, cov)


def rows_at(cov: Array | Postponed, slot: Array) -> Array:
    """Rows (K, 2, n) of the slots (K,)."""
    if not isinstance(cov, Postponed):
        return cov.reshape(-1, 2, cov.shape[-1])[slot]
    base, size = rows_at(cov.base, slot), len(cov.base)
    own = cov.rows.reshape(ROOM, -1, 2)[:, slot].reshape(ROOM, -1)
    return base - (own.T @ cov.rows).reshape(-1, 2, size)


def blocks_of(cov: Array | Postponed) -> Array:
    """The blocks (L, 2, 2) of each slot with itself."""
    if not isinstance(cov, Postponed):
        size = len(cov) // 2
        index = jnp.arange(size, dtype=jnp.int32)
        return cov.reshape(size, 2, size, 2)[index, :, index]
    square, across = cov.sums.reshape(2, -1, 2).swapaxes(1, 2)
    put_off = jnp.stack([square[0], across[0], across[0], square[1]], axis=-1)
    return blocks_of(cov.base) - put_off.reshape(-1, 2, 2)


def subtract(cov: Array | Postponed, y: Array, seen: Array) -> Array | Postponed:
    """Take y^T y, for rows y (k, n), and raise the variances a little if anything was `seen` ().

    In single precision P - Y^T Y alone is indefinite after some ten thousand steps where the map
    learns nothing more: each loses half a unit of rounding.

    Args:
        cov: The covariance; where it is put off, there must be room for the rows.
        y: Rows of zeros stand for nothing.
        seen: () bool.
    """
    if isinstance(cov, Postponed):
        some = jnp.any(y != 0.0, axis=1)
        first = y[jnp.argsort(~some, stable=True)]
        rows = lax.dynamic_update_slice(cov.rows, first, (cov.held, jnp.int32(0)))
        held = cov.held + jnp.sum(some, dtype=jnp.int32)
        of_next = jnp.pad(y[:, 1:], ((0, 0), (0, 1)))
        sums = cov.sums + jnp.stack([jnp.sum(y * y, axis=0), jnp.sum(y * of_next, axis=0)])
        return Postponed(cov.base, rows, sums, held, cov.updates + seen.astype(y.dtype))
    half = len(y) // 2 if len(cov) > LARGE else len(y)
    # Rows that count come first, and of a large map seldom are more than half of all.
    if half < len(y):
        cov = lower(cov, y[half:], jnp.any(y[half:] != 0.0))
    return _guarded(add_products(cov, y[:half], y[:half], sign=-1), seen)


def _guarded(cov: Array, seen: Array) -> Array:
    """The covariance with a little over its diagonal, if anything was `seen`."""
    more, one = GUARD * np.finfo(cov.dtype).eps, jnp.ones((), cov.dtype)
    if len(cov) > LARGE:
        at = jnp.arange(len(cov), dtype=jnp.int32)
        return cov.at[at, at].multiply(jnp.where(seen, one + more, one), unique_indices=True)
    raised = 1 + more * np.eye(len(cov))  # a constant: half the cost, as long as it is small
    return cov * jnp.where(seen, raised.astype(cov.dtype), one)


def subtract_seldom(cov: Array | Postponed, y: Array, wanted: Array) -> Array | Postponed:
    """Take y^T y for rows y (k, n) where `wanted` () bool; y is zero where it is not."""
    if isinstance(cov, Postponed):
        return subtract(cov, y, jnp.bool_(False))
    return lower(cov, y, wanted)


def put_rows(cov: Array | Postponed, rows: Array, at: Array) -> Array | Postponed:
    """Replace some rows and columns, which is seldom wanted: `linalg.put_rows`."""
    if not isinstance(cov, Postponed):
        return put_in(cov, rows, at)
    how = {"mode": "drop", "unique_indices": True}
    put_off = cov.rows.at[:, at].set(jnp.zeros((), rows.dtype), **how)
    # Of either number of a slot, its product with the other.
    both = jnp.stack([at, at - at % 2])
    sums = cov.sums.at[jnp.arange(2, dtype=jnp.int32)[:, None], both].set(0.0, mode="drop")
    return cov._replace(base=put_in(cov.base, rows, at), rows=put_off, sums=sums)
