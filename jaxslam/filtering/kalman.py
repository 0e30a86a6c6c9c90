"""Kalman update of a Gaussian over pose and map by measurements of one landmark each.

The covariance is kept in blocks, of the pose (3, 3), of pose and map (3, 2 L), and of the map
(2 L, 2 L): a prediction leaves the largest of them alone, and its rows stay aligned in memory. With
biases of odometry beside the pose, the 3 in all shapes is 6.

The derivative of the update is written by hand (`update_gradient`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.linalg import add_outer_products, inverse_cholesky
from jaxslam.core.types import Array
from jaxslam.filtering.covariance import downdate, slot_rows
from jaxslam.filtering.joint_covariance import CovarianceBlocks, LinearizedMeasurements
from jaxslam.filtering.update_gradient import (
    Columns,
    Saved,
    grad_update,
    shift_of,
    slot_columns,
    total,
    transposed_matmul,
)


class UpdateResult(NamedTuple):
    """Result of the update.

    Attributes:
        shift: (D,) change of the mean, K v.
        cov: Covariance after the update.
        nis: () normalised innovation squared, v^T S^-1 v.
        logdet: () log det S.
        ok: () bool, S is positive definite and all is finite; otherwise nothing was changed.
    """

    shift: Array
    cov: CovarianceBlocks
    nis: Array
    logdet: Array
    ok: Array


class Innovation(NamedTuple):
    """What an update computes of its innovations first, N = 2 M; it has no derivative.

    Attributes:
        by_pose: (N, 3) columns of the pose of H P.
        by_map: (N, 2 L) columns of the map of H P.
        inv_root: (N, N) A with A S A^T = I.
        logdet: () log det S.
        is_definite: () bool, S is positive definite and finite; if not, A and `logdet` are zero.
    """

    by_pose: Array
    by_map: Array
    inv_root: Array
    logdet: Array
    is_definite: Array


def kalman_update(
    cov: CovarianceBlocks, rows: LinearizedMeasurements, known: Innovation | None = None
) -> UpdateResult:
    """Kalman update by all measurements at once.

        S = H P H^T + R,   A S A^T = I,   Y = A H P,   w = A v,
        P' = P - Y^T Y,    shift = Y^T w,    nis = w^T w

    which is the textbook's P' = P - K S K^T and shift = K v with the gain K = P H^T S^-1 = Y^T A.

    P' is symmetric by construction, and stays positive definite for any number of steps: its
    diagonal is raised by `VARIANCE_GUARD` units of rounding, which the derivative leaves out. No
    inverse of S is taken. Where S is not positive definite, by rounding or bad input, or a residual
    is not finite, nothing is changed.

    Cost: O(N (2 L)^2) for P', N = 2 M, O(N^2 L) for the rest. H is never built: a measurement has
    five columns that are not zero. Derivatives, in reverse only, are by `grad_update`; `cov` is
    symmetric.

    Args:
        cov: P.
        rows: H, R and v.
        known: Products of these that are known already.

    References:
        Paper, eqs. (14)-(16).
    """
    return _update(cov, rows, known)


@jax.custom_vjp
def _update(
    cov: CovarianceBlocks, rows: LinearizedMeasurements, known: Innovation | None
) -> UpdateResult:
    return _fwd(cov, rows, known)[0]


def innovation_cov(cov: CovarianceBlocks, rows: LinearizedMeasurements) -> Array:
    """Innovation covariance S = H P H^T + R, (2 M, 2 M)."""
    return project(cov, rows)[1]


def log_likelihood(result: UpdateResult, dof: Array) -> Array:
    """Log-likelihood () [nats] of the residuals, which have `dof` () int32 degrees of freedom."""
    nis, logdet = result.nis, result.logdet
    return -0.5 * (nis + logdet + dof.astype(nis.dtype) * jnp.log(2 * jnp.pi).astype(nis.dtype))


def project(cov: CovarianceBlocks, rows: LinearizedMeasurements) -> tuple[Columns, Array]:
    """H P (N, D) and S = H P H^T + R (N, N), from the columns of H that are not zero."""
    n, slot = 2 * rows.slot.size, rows.slot
    cov_slot_pose = jnp.moveaxis(slot_columns(cov.cross, slot), 0, 2)  # (M, 2, 3)
    cov_slot_map = slot_rows(cov.map, slot)  # (M, 2, 2 L)
    hp_pose = _small_matmul(rows.H_pose, cov.pose[None])
    hp_pose = (hp_pose + _small_matmul(rows.H_landmark, cov_slot_pose)).reshape(n, -1)
    hp_map = _small_matmul(rows.H_pose, cov.cross[None])
    hp_map = (hp_map + _small_matmul(rows.H_landmark, cov_slot_map)).reshape(n, -1)
    # H P H^T: columns of the pose, then those of each measurement's landmark.
    hp_slot = slot_columns(hp_map, slot)  # (N, M, 2)
    s = total(
        hp_pose[:, None, None, k] * rows.H_pose[None, ..., k] for k in range(rows.H_pose.shape[-1])
    )
    s += total(hp_slot[:, :, None, k] * rows.H_landmark[None, ..., k] for k in range(2))
    eye = jnp.eye(slot.size, dtype=s.dtype)[:, None, :, None]
    s = s.reshape(-1, 2, n // 2, 2) + eye * rows.R[:, :, None]
    return Columns(hp_pose, hp_map), s.reshape(n, n)


def _small_matmul(h: Array, x: Array) -> Array:
    """Product (..., 2, n) of h (..., 2, k) and x (..., k, n), as a sum of k terms: k is small."""
    return total(h[..., k, None] * x[..., None, k, :] for k in range(h.shape[-1]))


def _fwd(
    cov: CovarianceBlocks, rows: LinearizedMeasurements, known: Innovation | None
) -> tuple[UpdateResult, Saved]:
    if known is None:
        (by_pose, by_map), s = project(cov, rows)
        known = Innovation(by_pose, by_map, *inverse_cholesky(s))
    inv_root, logdet, good = known[2:]
    w = jnp.sum(inv_root * rows.residual.reshape(-1)[None], axis=1)
    good &= jnp.all(jnp.isfinite(w))
    # A = 0 makes Y = 0 and K = 0: nothing is changed, and the derivatives are finite too.
    inv_root, w = jnp.where(good, inv_root, 0.0), jnp.where(good, w, 0.0)
    y_pose = transposed_matmul(inv_root.T, known.by_pose)
    y_map = transposed_matmul(inv_root.T, known.by_map)
    after = CovarianceBlocks(
        pose=add_outer_products(cov.pose, y_pose, y_pose, sign=-1),
        cross=add_outer_products(cov.cross, y_pose, y_map, sign=-1),
        map=downdate(cov.map, y_map, good & jnp.any(rows.H_landmark != 0.0)),
    )
    saved = Saved(
        inv_root=inv_root,
        Y=Columns(y_pose, y_map),
        w=w,
        cov_pose=after.pose,
        cov_cross=after.cross,
        cov_slot_pose=jnp.moveaxis(slot_columns(after.cross, rows.slot), 0, 2),
        cov_slot_map=slot_rows(after.map, rows.slot),
        rows=rows,
    )
    return UpdateResult(shift_of(saved.Y, w), after, jnp.sum(w * w), logdet, good), saved


def _bwd(saved: Saved, grad: UpdateResult) -> tuple[CovarianceBlocks, LinearizedMeasurements, None]:
    by_cov, by_rows = grad_update(
        saved, cov=grad.cov, shift=grad.shift, nis=grad.nis, logdet=grad.logdet
    )
    return by_cov, by_rows, None


_update.defvjp(_fwd, _bwd)
