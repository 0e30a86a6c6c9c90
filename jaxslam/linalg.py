"""Small dense algebra for batches on a CPU, in array operations alone.

No LAPACK: programs that call it can hang when several run at once on the threads of one CPU.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxslam.types import Array


def add_products(start: Array, left: Array, right: Array, *, sign: int = 1) -> Array:
    """`start` (a, b) plus or minus left^T right, for left (n, a) and right (n, b).

    A sum of outer products is one vectorised loop over the result, which takes half the time of a
    batched matrix product of this size.
    """
    for u, v in zip(left, right, strict=True):
        start = start + u[:, None] * v[None] if sign > 0 else start - u[:, None] * v[None]
    return start


def inverse_root(s: Array) -> tuple[Array, Array, Array]:
    """Return A with A S A^T = I, log det S (), and whether S (n, n) is positive definite ().

    Forward elimination of [S, I], two rows at a time; A is the inverse of the Cholesky factor. It
    is zero where S is not positive definite. Unrolled, what is left gets smaller with each row: a
    scan over the rows takes five times as long.
    """
    n = s.shape[0]
    left, rows, pivots = jnp.concatenate([s, jnp.eye(n, dtype=s.dtype)], axis=1), [], []

    def unit(row: Array, at: int) -> Array:
        pivots.append(row[at])
        return row * lax.rsqrt(jnp.where(row[at] > 0.0, row[at], 1.0))

    for k in range(0, n, 2):
        # The columns below the pivots are the rows to their right: S stays symmetric.
        first = unit(left[0], 0)
        rows.append(first[n - k :])
        if k + 1 < n:
            second = unit(left[1] - first[1] * first, 1)
            rows.append(second[n - k :])
            left = left[2:, 2:] - first[2 : n - k, None] * first[None, 2:]
            left -= second[2 : n - k, None] * second[None, 2:]
    pivot = jnp.stack(pivots)
    good = jnp.all(pivot > 0.0) & jnp.all(jnp.isfinite(pivot))
    logdet = jnp.sum(jnp.log(jnp.where(good, pivot, 1.0)))
    return jnp.where(good, jnp.stack(rows), 0.0), logdet, good


def whiten(s: Array, b: Array) -> Array:
    """Return L^-1 b (n, k) for S = L L^T (n, n) and b (n, k); NaN where S is not such a product."""
    root, _, good = inverse_root(s)
    return jnp.where(good, root, jnp.nan) @ b


def sometimes(wanted: Array, do: Callable, skip: Callable, *given: Any) -> Any:
    """`do(*given)` where `wanted` () bool, else `skip(*given)`.

    Of a batch, where `lax.cond` always does both, all is skipped unless one at least wants it. For
    those that do not, `do` must give what `skip` gives. They close over no array; there is no
    derivative.
    """

    @custom_vmap
    def choose(wanted: Array, given: Any) -> Any:
        return lax.cond(wanted, lambda x: do(*x), lambda x: skip(*x), given)

    @choose.def_vmap
    def _(size: int, batched: Any, wanted: Array, given: Any) -> tuple[Any, Any]:
        axes = tuple(jax.tree.map(lambda along: 0 if along else None, batched[1]))
        many = lambda f: lambda x: jax.vmap(f, in_axes=axes, axis_size=size)(*x)
        result = lax.cond(jnp.any(wanted), many(do), many(skip), given)
        return result, jax.tree.map(lambda _: True, result)

    return choose(wanted, given)


@jax.custom_vjp
def lower(matrix: Array, y: Array, wanted: Array) -> Array:
    """`matrix` (n, n) - y^T y for y (k, n), seldom `wanted` () bool: y is zero where it is not.

    Derivatives are taken in reverse only.
    """
    return _lower(matrix, y, wanted)[0]


def _lower(matrix: Array, y: Array, wanted: Array) -> tuple[Array, tuple[Array, Array]]:
    do = lambda matrix, y: add_products(matrix, y, y, sign=-1)
    return sometimes(wanted, do, lambda matrix, y: matrix, matrix, y), (y, wanted)


def _lower_back(kept: tuple[Array, Array], out: Array) -> tuple[Array, Array, None]:
    y, wanted = kept
    do = lambda out, y: -(y @ out + (out @ y.T).T)
    return out, sometimes(wanted, do, lambda out, y: jnp.zeros_like(y), out, y), None


lower.defvjp(_lower, _lower_back)


@jax.custom_vjp
def put_rows(matrix: Array, rows: Array, at: Array) -> Array:
    """Symmetric `matrix` (n, n) with some of its rows and columns replaced, which is seldom wanted.

    Derivatives are taken in reverse only.

    Args:
        matrix: Symmetric.
        rows: (k, n) the new ones, those of them that cross symmetric.
        at: (k,) int32 where each goes, n for nowhere; no two at one place.
    """
    return _put_rows(matrix, rows, at)[0]


def _put_rows(matrix: Array, rows: Array, at: Array) -> tuple[Array, Array]:
    skip = lambda matrix, rows, at: matrix
    return sometimes(jnp.any(at < len(matrix)), _replace, skip, matrix, rows, at), at


def _replace(matrix: Array, rows: Array, at: Array) -> Array:
    how = {"mode": "drop", "unique_indices": True}
    return matrix.at[at].set(rows, **how).at[:, at].set(rows.T, **how)


def _put_rows_back(at: Array, out: Array) -> tuple[Array, Array, None]:
    none = lambda out, at: jnp.zeros((at.size, len(out)), out.dtype)

    def do(out: Array, at: Array) -> tuple[Array, Array]:
        replace = lambda matrix, rows: _replace(matrix, rows, at)
        return jax.linear_transpose(replace, out, none(out, at))(out)

    skip = lambda out, at: (out, none(out, at))
    return *sometimes(jnp.any(at < len(out)), do, skip, out, at), None


put_rows.defvjp(_put_rows, _put_rows_back)
