"""Small dense algebra for batches on a CPU, in array operations alone.

No LAPACK: programs that call it can hang when several run at once on the threads of one CPU.
"""

import jax.numpy as jnp
from jax import lax

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
