"""Small dense linear algebra for batches on a CPU, written in array operations alone.

No LAPACK: programs that call it can deadlock when several run at once on the threads of one CPU.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxslam.core.types import Array

MAX_ELIMINATED = 4  # rows of a matrix up to which it is eliminated row by row


def add_outer_products(start: Array, left: Array, right: Array, *, sign: int = 1) -> Array:
    """`start` (a, b) plus or minus left^T right, for left (n, a) and right (n, b).

    Written as a sum of n outer products. XLA fuses it into one vectorised loop over the result,
    which takes half the time of a batched matrix product of this size.
    """
    for u, v in zip(left, right, strict=True):
        start = start + u[:, None] * v[None] if sign > 0 else start - u[:, None] * v[None]
    return start


def inverse_cholesky(s: Array) -> tuple[Array, Array, Array]:
    """Inverse of the Cholesky factor of S, and log det S.

    With S = L L^T, A = L^-1 is found by halves: of the blocks

        S = [S11   S21^T]     L21 = S21 A1^T,  A = [     A1       0 ]
            [S21   S22  ]                      [-A2 L21 A1   A2]

    where A1 is the inverse factor of S11, and A2 that of the matrix beside it. Matrices of up to
    `MAX_ELIMINATED` rows are eliminated row by row. So the operations are few and small, all the
    same for many matrices; row by row alone twice as many are run, and compiled.

    Args:
        s: (n, n) symmetric S.

    Returns:
        A (n, n), lower triangular; log det S (); and whether S is positive definite and finite
        () bool. Where it is not, A and the logarithm are zero.
    """
    inv_root, diagonal = _inverse_factor(s)
    good = jnp.all(diagonal > 0.0) & jnp.all(jnp.isfinite(diagonal))
    logdet = 2 * jnp.sum(jnp.log(jnp.where(good, diagonal, 1.0)))
    return jnp.where(good, inv_root, 0.0), logdet, good


def _inverse_factor(s: Array) -> tuple[Array, Array]:
    """A = L^-1 (n, n) and the diagonal (n,) of L, of which a number is not positive if S is not."""
    n, half = len(s), len(s) // 2
    if n <= MAX_ELIMINATED:
        return _eliminated(s)
    first, first_diagonal = _inverse_factor(s[:half, :half])
    below = jnp.sum(s[half:, None, :half] * first[None], axis=2)  # L21
    left = s[half:, half:] - jnp.sum(below[:, None] * below[None], axis=2)
    second, second_diagonal = _inverse_factor(left)
    corner = jnp.sum(below[:, :, None] * first[None], axis=1)
    corner = -jnp.sum(second[:, :, None] * corner[None], axis=1)
    upper = jnp.pad(first, ((0, 0), (0, n - half)))
    lower = jnp.concatenate([corner, second], axis=1)
    return jnp.concatenate([upper, lower]), jnp.concatenate([first_diagonal, second_diagonal])


def _eliminated(s: Array) -> tuple[Array, Array]:
    """`_inverse_factor` of a small S, by forward elimination of the table [S | I].

    It multiplies the table from the left by A, so that [S | I] becomes [L^T | A]:

        row k  =  table[k] - sum over j < k of L[k, j] (row j),     L[k, j] = (row j)[k]
        row k  =  row k / sqrt((row k)[k])                          if that is positive
    """
    n = len(s)
    table = jnp.concatenate([s, jnp.eye(n, dtype=s.dtype)], axis=1)
    rows: list[Array] = []
    for k in range(n):
        row = table[k]
        for finished in rows:
            row = row - finished[k] * finished
        rows.append(row * lax.rsqrt(jnp.where(row[k] > 0.0, row[k], 1.0)))
    diagonal = jnp.stack([row[k] for k, row in enumerate(rows)])
    return jnp.stack(rows)[:, n:], diagonal


def whiten(s: Array, b: Array) -> Array:
    """L^-1 b (n, k) for S = L L^T (n, n) and b (n, k); NaN where S is not positive definite."""
    root, _, good = inverse_cholesky(s)
    return jnp.where(good, root, jnp.nan) @ b


def cond_rarely(wanted: Array, do: Callable, skip: Callable, *given: Any) -> Any:
    """`do(*given)` where `wanted`, else `skip(*given)`: a `lax.cond` that still skips under vmap.

    `vmap` turns a `lax.cond` with a batched condition into a select that always computes both
    branches. This function has its own batching rule, with one condition for the whole batch:

        any(wanted)?   yes: vmap(do)(*given)   for all members
                       no:  vmap(skip)(*given) for all members

    So for a member whose `wanted` is False, `do` must return what `skip` returns.

    Args:
        wanted: () bool.
        do: The expensive branch. As `skip`, it must not close over arrays: pass them in `given`.
        skip: The cheap branch; its result has the same shapes and dtypes.
        *given: Arguments of both branches, pytrees of arrays.

    Returns:
        The branch's result. It has no derivative rule: give the caller one (see `downdate_rarely`).
    """

    @custom_vmap
    def branch(wanted: Array, operands: Any) -> Any:
        return lax.cond(wanted, lambda xs: do(*xs), lambda xs: skip(*xs), operands)

    @branch.def_vmap
    def _batched_branch(
        batch_size: int, is_batched: Any, wanted: Array, operands: Any
    ) -> tuple[Any, Any]:
        in_axes = tuple(jax.tree.map(lambda batched: 0 if batched else None, is_batched[1]))

        def do_all(operands: Any) -> Any:
            return jax.vmap(do, in_axes=in_axes, axis_size=batch_size)(*operands)

        def skip_all(operands: Any) -> Any:
            return jax.vmap(skip, in_axes=in_axes, axis_size=batch_size)(*operands)

        result = lax.cond(jnp.any(wanted), do_all, skip_all, operands)
        return result, jax.tree.map(lambda _: True, result)

    return branch(wanted, given)


@jax.custom_vjp
def downdate_rarely(matrix: Array, y: Array, wanted: Array) -> Array:
    """Downdate `matrix` - y^T y that is rarely wanted: skipped where all of a batch are not.

    Derivatives are taken in reverse only. With C the derivative by the result,

        by matrix: C,        by y: -y (C + C^T).

    Args:
        matrix: (n, n), may be not symmetric.
        y: (k, n); zero where not `wanted`.
        wanted: () bool.
    """
    return _downdate_fwd(matrix, y, wanted)[0]


def _downdate_fwd(matrix: Array, y: Array, wanted: Array) -> tuple[Array, tuple[Array, Array]]:
    def downdate(matrix: Array, y: Array) -> Array:
        return add_outer_products(matrix, y, y, sign=-1)

    def unchanged(matrix: Array, y: Array) -> Array:
        return matrix

    return cond_rarely(wanted, downdate, unchanged, matrix, y), (y, wanted)


def _downdate_bwd(saved: tuple[Array, Array], grad_out: Array) -> tuple[Array, Array, None]:
    y, wanted = saved

    def grad_y(grad_out: Array, y: Array) -> Array:
        return -(y @ grad_out + (grad_out @ y.T).T)

    def no_grad_y(grad_out: Array, y: Array) -> Array:
        return jnp.zeros_like(y)

    return grad_out, cond_rarely(wanted, grad_y, no_grad_y, grad_out, y), None


downdate_rarely.defvjp(_downdate_fwd, _downdate_bwd)


@jax.custom_vjp
def put_rows(matrix: Array, rows: Array, at: Array) -> Array:
    """Replace rows and columns of a symmetric matrix; skipped where all of a batch replace none.

        result[at] = rows,      result[:, at] = rows^T

    Derivatives are taken in reverse only.

    Args:
        matrix: (n, n) symmetric.
        rows: (k, n) new rows; their columns `at`, where rows and columns cross, must be symmetric.
        at: (k,) int32 index of each, n for nowhere; otherwise unique.
    """
    return _put_rows_fwd(matrix, rows, at)[0]


def _put_rows_fwd(matrix: Array, rows: Array, at: Array) -> tuple[Array, Array]:
    def unchanged(matrix: Array, rows: Array, at: Array) -> Array:
        return matrix

    any_row = jnp.any(at < len(matrix))
    return cond_rarely(any_row, _replace_rows_and_columns, unchanged, matrix, rows, at), at


def _replace_rows_and_columns(matrix: Array, rows: Array, at: Array) -> Array:
    matrix = matrix.at[at].set(rows, mode="drop", unique_indices=True)
    return matrix.at[:, at].set(rows.T, mode="drop", unique_indices=True)


def _put_rows_bwd(at: Array, grad_out: Array) -> tuple[Array, Array, None]:
    """The replacement is linear in matrix and rows; its derivative is its transpose."""

    def no_rows(grad_out: Array, at: Array) -> Array:
        return jnp.zeros((at.size, len(grad_out)), grad_out.dtype)

    def transposed(grad_out: Array, at: Array) -> tuple[Array, Array]:
        def replace(matrix: Array, rows: Array) -> Array:
            return _replace_rows_and_columns(matrix, rows, at)

        return jax.linear_transpose(replace, grad_out, no_rows(grad_out, at))(grad_out)

    def unchanged(grad_out: Array, at: Array) -> tuple[Array, Array]:
        return grad_out, no_rows(grad_out, at)

    any_row = jnp.any(at < len(grad_out))
    return *cond_rarely(any_row, transposed, unchanged, grad_out, at), None


put_rows.defvjp(_put_rows_fwd, _put_rows_bwd)
