"""Prediction and update of a small Gaussian, in arrays whose batch is the last axis.

Matrices are (n, m, ...), with the batch, or nothing, for the dots. The derivative is written by
hand, as that of `filtering.kalman` is, whose docstring derives it.
"""

import operator
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.types import Array

UNROLLED = 12  # states up to which their matrices are written element by element


class Linearized(NamedTuple):
    """A step of a filter, linearised: n states, m measurements.

    Attributes:
        cov: (n, n, ...) P before the step.
        F: (n, n, ...) derivative of the motion by the state.
        Q: (n, n, ...) covariance of the motion's noise.
        H: (m, n, ...) derivative of the measurement by the state.
        R: (m, m, ...) covariance of the measurement's noise.
        innovation: (m, ...) v, measured minus predicted.
    """

    cov: Array
    F: Array
    Q: Array
    H: Array
    R: Array
    innovation: Array


class StepResult(NamedTuple):
    """What a step makes of the covariance, and what it adds to the mean.

    Attributes:
        shift: (n, ...) change of the mean by the update, K v.
        cov: (n, n, ...) covariance after the step.
        innovation_cov: (m, m, ...) S.
        nis: (...) normalised innovation squared, v^T S^-1 v.
        logdet: (...) log det S.
    """

    shift: Array
    cov: Array
    innovation_cov: Array
    nis: Array
    logdet: Array


class _Saved(NamedTuple):
    """What the derivative needs of a step; A is the inverse of the Cholesky factor of S."""

    F: Array
    H: Array
    FP: Array  # (n, n, ...) F P
    cov: Array  # (n, n, ...) P-, after the prediction
    HP: Array  # (m, n, ...) H P-
    A: Array  # (m, m, ...)
    K: Array  # (n, m, ...)
    w: Array  # (m, ...) A v
    shift: Array  # (n, ...)


@jax.custom_vjp
def kalman_step(step: Linearized) -> tuple[StepResult, Array]:
    """Predict and update.

        P- = F P F^T + Q,    S = H P- H^T + R,    A S A^T = I,    K = P- H^T A^T A,
        P' = (I - K H) P- (I - K H)^T + K R K^T   (Joseph's form)

    Returns:
        The result, and whether S is positive definite (...) bool; where it is not, K = 0.
        Derivatives are taken in reverse only, with all covariances symmetric.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), "Estimation with applications to tracking and
        navigation", sections 5.2 and 10.3.
    """
    result, good, _ = _forward(step)
    return result, good


def _forward(step: Linearized) -> tuple[StepResult, Array, _Saved]:
    P, F, Q, H, R, v = step
    FP = matmul(F, _symmetric(P))
    cov = matmul(FP, transpose(F)) + Q
    HP = matmul(H, cov)
    S = matmul(HP, transpose(H)) + R
    A, logdet, good = inverse_cholesky(S)
    w = matvec(A, v)
    K = matmul(matmul(transpose(HP), transpose(A)), A)
    J = _eye_like(cov) - matmul(K, H)
    after = matmul(matmul(J, cov), transpose(J)) + matmul(matmul(K, R), transpose(K))
    shift = matvec(K, v)
    result = StepResult(shift, after, S, jnp.sum(w * w, axis=0), logdet)
    return result, good, _Saved(F, H, FP, cov, HP, A, K, w, shift)


def _fwd(step: Linearized) -> tuple[tuple[StepResult, Array], _Saved]:
    result, good, saved = _forward(step)
    return (result, good), saved


def _bwd(saved: _Saved, grad_out: tuple[StepResult, Array]) -> tuple[Linearized]:
    """Derivative in reverse; the symbols are those of `filtering.kalman`.

    With G by P', g by the shift, n by nis, l by logdet, C by S, and u = S^-1 v, M = K^T G, r =
    K^T g, and with P' = P- - K H P- where it stands in a product:

        grad_v = r + 2 n u
        grad_R = M K - (r u^T + u r^T) / 2 - n u u^T + l S^-1 + C
        grad_H = -2 M P' + u (P' g)^T - grad_v shift^T + 2 l K^T + 2 C H P-
        grad_P- = G + H^T X + X^T H,    X = -M + u g^T / 2 + grad_R H / 2
        grad_Q = grad_P-,    grad_F = 2 grad_P- F P,    grad_P = F^T grad_P- F
    """
    F, H, FP, cov, HP, A, K, w, shift = saved
    by = grad_out[0]
    G, C, g = _symmetric(by.cov), _symmetric(by.innovation_cov), by.shift
    Kt = transpose(K)
    M = matmul(Kt, G)
    u = matvec(transpose(A), w)
    r = matvec(Kt, g)
    grad_v = r + 2 * by.nis[None] * u
    MK, ru = matmul(M, K), _outer(r, u)
    grad_R = MK - (ru + transpose(ru)) / 2 - by.nis[None, None] * _outer(u, u) + C
    grad_R += by.logdet[None, None] * matmul(transpose(A), A)
    Pg = matvec(cov, g) - matvec(transpose(HP), r)
    grad_H = 2 * (matmul(MK + C, HP) - matmul(M, cov) + by.logdet[None, None] * Kt)
    grad_H += _outer(u, Pg) - _outer(grad_v, shift)
    X = (_outer(u, g) + matmul(grad_R, H)) / 2 - M
    HX = matmul(transpose(H), X)
    grad_Q = G + HX + transpose(HX)
    grad_F = 2 * matmul(grad_Q, FP)
    grad_P = matmul(transpose(F), matmul(grad_Q, F))
    return (Linearized(grad_P, F=grad_F, Q=grad_Q, H=grad_H, R=grad_R, innovation=grad_v),)


kalman_step.defvjp(_fwd, _bwd)


def inverse_cholesky(S: Array) -> tuple[Array, Array, Array]:
    """Inverse A (m, m, ...) of the Cholesky factor of S, log det S (...), and whether it exists.

    By forward elimination of the table [S | I], which a multiplication by A turns into [L^T | A]:
    finished rows and columns are cut off, so that column 0 is the next pivot's. Where S is not
    positive definite, or not finite, A and the logarithm are zero, as of
    `core.linalg.inverse_cholesky`.
    """
    table = jnp.concatenate([S, _eye_like(S)], axis=1)
    rows, pivots = [], []
    for left in range(len(S), 0, -1):  # columns of S that are left of the table
        pivots.append(table[0, 0])
        row = table[0] * lax.rsqrt(jnp.where(pivots[-1] > 0.0, pivots[-1], 1.0))[None]
        rows.append(row[left:])
        table = table[1:, 1:] - row[1:left, None] * row[None, 1:]
    pivot = jnp.stack(pivots)
    good = jnp.all(jnp.isfinite(pivot) & (pivot > 0.0), axis=0)
    logdet = jnp.sum(jnp.log(jnp.where(good[None], pivot, 1.0)), axis=0)
    return jnp.where(good[None, None], jnp.stack(rows), 0.0), logdet, good


def matmul(a: Array, b: Array) -> Array:
    """Product (n, m, ...) of matrices (n, k, ...) and (k, m, ...).

    Written as a reduction where there is a batch: XLA for CPUs calls the library for each small
    product of a batch, and repeats a sum of products inside of every operation that uses it.
    """
    if a.ndim == 2:
        return a * b if a.shape[1] == 1 else a @ b
    if a.shape[1] > UNROLLED:
        return jnp.einsum("ik...,kj...->ij...", a, b)
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def matvec(a: Array, x: Array) -> Array:
    """Product (n, ...) of a matrix (n, k, ...) and a vector (k, ...)."""
    return reduce(operator.add, (a[:, k] * x[None, k] for k in range(a.shape[1])))


def transpose(a: Array) -> Array:
    """Transpose (m, n, ...) of a matrix (n, m, ...)."""
    return jnp.swapaxes(a, 0, 1)


def _symmetric(a: Array) -> Array:
    return (a + transpose(a)) / 2


def _outer(x: Array, y: Array) -> Array:
    return x[:, None] * y[None]


def _eye_like(a: Array) -> Array:
    eye = jnp.eye(len(a), dtype=a.dtype)
    return jnp.broadcast_to(eye.reshape(*eye.shape, *(1,) * (a.ndim - 2)), a.shape)
