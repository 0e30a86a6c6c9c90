"""Covariance of a map of L landmarks, (2 L, 2 L): dense, or with its downdates deferred.

A Kalman update subtracts y^T y from the map's covariance, with few rows y (k, 2 L). For a large map
this pass over the whole matrix is what an update costs. It can be deferred: the rows are stored,

    P  =  base - rows^T rows,    base (2 L, 2 L),   rows (<= MAX_DEFERRED_ROWS, 2 L)

and an update appends its y to `rows`, which costs O(k L) instead of O(k L^2). What the filter reads
of P in between is little, and is computed from the two parts when it is read:

    rows of a few landmarks i     P[i] = base[i] - rows[:, i]^T rows     (`slot_rows`)
    2 x 2 blocks of landmarks     from running sums over `rows`           (`slot_blocks`)

When `rows` is full, it is subtracted from `base` as one matrix product, which is far faster than
the same number of separate updates (`flush_if_full`, `flush`). Nothing is approximated: P is the
same up to rounding. A deferred covariance has no derivatives.

References:
    Knight, Davison, Reid (2001), Towards constant time SLAM using postponement.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import linalg
from jaxslam.core.linalg import add_outer_products
from jaxslam.core.types import Array

VARIANCE_GUARD = 2  # units of rounding by which each update raises the variances
LARGE_MAP = 256  # rows of a map above which it pays to leave zero rows out
STRIP_ROWS = 192  # rows of the covariance that a flush works on at a time
MAX_DEFERRED_ROWS = 96  # capacity: deferred rows at most


class DeferredCovariance(NamedTuple):
    """A symmetric matrix P = `base` - `rows`^T `rows`; made by `defer`, ended by `flush`.

    Attributes:
        base: (n, n) covariance before the deferred downdates; n = 2 L.
        rows: (MAX_DEFERRED_ROWS, n) deferred rows, in order; unused ones are zero.
        sums: (2, n) running sums over the deferred rows r, for the diagonal blocks of
            rows^T rows: sums[0, j] = sum of r[j]^2, sums[1, j] = sum of r[j] r[j + 1]. Of the
            latter only even j are read, where j and j + 1 are the two numbers of one landmark.
        num_rows: () int32 how many of `rows` are used.
        num_updates: () how many updates were deferred; each raises the variances by
            `VARIANCE_GUARD` units of rounding, which the flush applies.
    """

    base: Array
    rows: Array
    sums: Array
    num_rows: Array
    num_updates: Array


def defer(cov: Array) -> DeferredCovariance:
    """A deferred covariance with nothing deferred yet, for a dense one (n, n)."""
    zeros = jnp.zeros((MAX_DEFERRED_ROWS + 2, len(cov)), cov.dtype)
    return DeferredCovariance(cov, zeros[2:], zeros[:2], jnp.int32(0), jnp.zeros((), cov.dtype))


def flush(cov: Array | DeferredCovariance) -> Array:
    """Flush: the dense covariance (n, n), with all deferred downdates applied."""
    if not isinstance(cov, DeferredCovariance):
        return cov
    diagonal = jnp.arange(len(cov.base), dtype=jnp.int32)
    raised = 1 + VARIANCE_GUARD * np.finfo(cov.base.dtype).eps * cov.num_updates
    flushed = _subtract_product(cov.base, cov.rows)
    return flushed.at[diagonal, diagonal].multiply(raised, unique_indices=True)


def _subtract_product(base: Array, rows: Array) -> Array:
    """`base` - rows^T rows, in place, one strip of `STRIP_ROWS` rows of the result at a time.

    Strips keep the product small enough for the cache, and those past the last landmark in use are
    skipped: there all columns of `rows` are zero.

        base    +---------+  strip 0
                +---------+  strip 1
                +---------+  ...             up to the last strip with a nonzero column of `rows`
                +---------+  remainder       len(base) mod STRIP_ROWS rows, always
    """
    columns = rows.T
    num_strips, remainder = divmod(len(base), STRIP_ROWS)
    if remainder:
        base = base.at[-remainder:].add(-columns[-remainder:] @ rows)
    if not num_strips:
        return base

    def subtract_strip(strip: Array, result: Array) -> Array:
        start = strip * STRIP_ROWS
        old = lax.dynamic_slice_in_dim(result, start, STRIP_ROWS)
        new = old - lax.dynamic_slice_in_dim(columns, start, STRIP_ROWS) @ rows
        return lax.dynamic_update_slice_in_dim(result, new, start, 0)

    used = jnp.any(columns[: num_strips * STRIP_ROWS].reshape(num_strips, -1) != 0.0, axis=1)
    strips_up_to = jnp.arange(1, num_strips + 1, dtype=jnp.int32)
    num_used = jnp.max(jnp.where(used, strips_up_to, 0))
    return lax.fori_loop(0, num_used, subtract_strip, base)


def flush_if_full(cov: Array | DeferredCovariance, more: int) -> Array | DeferredCovariance:
    """The same covariance with capacity for `more` deferred rows: flushed if there is none.

    Args:
        cov: The covariance; a dense one is returned as it is.
        more: Rows that will be deferred next, at most `MAX_DEFERRED_ROWS`.
    """
    if not isinstance(cov, DeferredCovariance):
        return cov
    full = cov.num_rows + more > MAX_DEFERRED_ROWS
    return lax.cond(full, lambda cov: defer(flush(cov)), lambda cov: cov, cov)


def slot_rows(cov: Array | DeferredCovariance, slot: Array) -> Array:
    """Rows (K, 2, n) of the covariance at the landmark slots (K,) int32."""
    if not isinstance(cov, DeferredCovariance):
        return cov.reshape(-1, 2, cov.shape[-1])[slot]
    base, size = slot_rows(cov.base, slot), len(cov.base)
    deferred = cov.rows.reshape(MAX_DEFERRED_ROWS, -1, 2)[:, slot]
    deferred = deferred.reshape(MAX_DEFERRED_ROWS, -1)  # columns of the slots, (.., 2 K)
    return base - (deferred.T @ cov.rows).reshape(-1, 2, size)


def slot_blocks(cov: Array | DeferredCovariance) -> Array:
    """The diagonal blocks (L, 2, 2): the covariance of each landmark."""
    if not isinstance(cov, DeferredCovariance):
        size = len(cov) // 2
        index = jnp.arange(size, dtype=jnp.int32)
        return cov.reshape(size, 2, size, 2)[index, :, index]
    # Each (2, L): the sums at the first and at the second number of each landmark.
    squares, products = cov.sums.reshape(2, -1, 2).swapaxes(1, 2)
    deferred = jnp.stack([squares[0], products[0], products[0], squares[1]], axis=-1)
    return slot_blocks(cov.base) - deferred.reshape(-1, 2, 2)


def downdate(cov: Array | DeferredCovariance, y: Array, seen: Array) -> Array | DeferredCovariance:
    """Downdate by y^T y, and raise the variances by rounding if anything was observed.

    In single precision P - y^T y alone becomes indefinite after some ten thousand updates that
    carry no new information: each loses half a unit of rounding. The raise makes up for it.

    Args:
        cov: The covariance. A deferred one must have capacity for the rows that are not zero
            (`flush_if_full`), which is not checked.
        y: (k, n); rows of zeros change nothing.
        seen: () bool, whether anything was observed.
    """
    if isinstance(cov, DeferredCovariance):
        return _defer(cov, y, seen)
    # Rows that are not zero come first. Of a large map they are seldom more than half of all, and
    # the pass over the matrix for the others is skipped when they are zero.
    half = len(y) // 2 if len(cov) > LARGE_MAP else len(y)
    if half < len(y):
        cov = linalg.downdate_rarely(cov, y[half:], jnp.any(y[half:] != 0.0))
    return _raise_variances(add_outer_products(cov, y[:half], y[:half], sign=-1), seen)


def _defer(cov: DeferredCovariance, y: Array, seen: Array) -> DeferredCovariance:
    """Append the rows of y (k, n) that are not zero, and add to the running sums."""
    nonzero = jnp.any(y != 0.0, axis=1)
    # All k rows are written, nonzero ones first; the next call overwrites the zeros behind them.
    nonzero_first = y[jnp.argsort(~nonzero, stable=True)]
    rows = lax.dynamic_update_slice(cov.rows, nonzero_first, (cov.num_rows, jnp.int32(0)))
    held = cov.num_rows + jnp.sum(nonzero, dtype=jnp.int32)
    shifted = jnp.pad(y[:, 1:], ((0, 0), (0, 1)))  # r[j + 1] at j
    sums = cov.sums + jnp.stack([jnp.sum(y * y, axis=0), jnp.sum(y * shifted, axis=0)])
    return DeferredCovariance(cov.base, rows, sums, held, cov.num_updates + seen.astype(y.dtype))


def _raise_variances(cov: Array, seen: Array) -> Array:
    """The dense covariance, its diagonal raised by `VARIANCE_GUARD` units of rounding if `seen`."""
    relative, one = VARIANCE_GUARD * np.finfo(cov.dtype).eps, jnp.ones((), cov.dtype)
    if len(cov) > LARGE_MAP:
        diagonal = jnp.arange(len(cov), dtype=jnp.int32)
        factor = jnp.where(seen, one + relative, one)
        return cov.at[diagonal, diagonal].multiply(factor, unique_indices=True)
    raised = 1 + relative * np.eye(len(cov))  # a constant: half the cost, as long as it is small
    return cov * jnp.where(seen, raised.astype(cov.dtype), one)


def downdate_rarely(
    cov: Array | DeferredCovariance, y: Array, wanted: Array
) -> Array | DeferredCovariance:
    """Downdate by y^T y that is rarely wanted; the variances are not raised.

    Args:
        cov: The covariance, with capacity for the rows if it is deferred.
        y: (k, n); zero where not `wanted`.
        wanted: () bool.
    """
    if isinstance(cov, DeferredCovariance):
        return downdate(cov, y, jnp.bool_(False))
    return linalg.downdate_rarely(cov, y, wanted)


def put_rows(cov: Array | DeferredCovariance, rows: Array, at: Array) -> Array | DeferredCovariance:
    """Replace rows and columns, which is rarely wanted: `linalg.put_rows`.

    In a deferred covariance the new rows go to `base`, and the deferred rows become zero in these
    columns, so that `base` - rows^T rows has the new rows exactly.

    Args:
        cov: The covariance.
        rows: (k, n) new rows, symmetric where rows and columns cross.
        at: (k,) int32 index of each, n for nowhere; otherwise unique.
    """
    if not isinstance(cov, DeferredCovariance):
        return linalg.put_rows(cov, rows, at)
    zero = jnp.zeros((), rows.dtype)
    deferred = cov.rows.at[:, at].set(zero, mode="drop", unique_indices=True)
    # Squares are kept at the number itself, products at the first number of its landmark.
    cleared = jnp.stack([at, at - at % 2])
    sums = cov.sums.at[jnp.arange(2, dtype=jnp.int32)[:, None], cleared].set(0.0, mode="drop")
    return cov._replace(base=linalg.put_rows(cov.base, rows, at), rows=deferred, sums=sums)
