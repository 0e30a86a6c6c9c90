"""Derivative of the Kalman update in reverse mode, written by hand, with its derivation.

Beside the gradient of the covariance nothing as large as the covariance is made or kept.
"""

import operator
from collections.abc import Iterable
from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.linalg import add_outer_products
from jaxslam.core.types import Array
from jaxslam.filtering.covariance import DeferredCovariance
from jaxslam.filtering.joint_covariance import CovarianceBlocks, LinearizedMeasurements


class Columns(NamedTuple):
    """A matrix with the columns of pose and map, or a vector (D,), in two parts."""

    pose: Array  # (N, 3) or (3,)
    map: Array  # (N, 2 L) or (2 L,)


class Saved(NamedTuple):
    """What `grad_update` needs of an update, N = 2 M; all of it is smaller than the covariance."""

    inv_root: Array  # (N, N) A with A S A^T = I
    Y: Columns  # (N, D) A H P
    w: Array  # (N,) A v
    cov_pose: Array  # (3, 3) P', pose with pose
    cov_cross: Array  # (3, 2 L) P', pose with map
    cov_slot_pose: Array  # (M, 2, 3) P', rows of the measured landmarks, columns of the pose
    cov_slot_map: Array  # (M, 2, 2 L) P', rows of the measured landmarks, columns of the map
    rows: LinearizedMeasurements


class _CovarianceGradient(NamedTuple):
    """Derivative of a loss by a covariance, in its blocks."""

    pose: Array  # (3, 3)
    cross: Array  # (3, 2 L)
    map: Array  # (2 L, 2 L)


class _Factors(NamedTuple):
    """Products that the derivatives by P, H, R and v share; symbols as in `grad_update`."""

    gain: Columns  # (N, D) K^T
    Q: Columns  # (N, D) K^T G
    u: Array  # (N,) S^-1 v
    r: Array  # (N,) K^T g


def total(terms: Iterable[Array]) -> Array:
    """Sum of a few arrays, in their order."""
    return reduce(operator.add, terms)


def transposed_matmul(left: Array, right: Array) -> Array:
    """left^T right (n, k) for left (n, n) and right (n, k)."""
    return add_outer_products(jnp.zeros_like(right), left, right)


def slot_columns(x: Array, slot: Array) -> Array:
    """Columns (r, M, 2) of the slots (M,), of a matrix (r, 2 L)."""
    return x.reshape(len(x), -1, 2)[:, slot]


def _weighted_sum(weight: Array, rows: Array) -> Array:
    """rows^T weight (n,) for rows (k, n) and weights (k,)."""
    return total(weight[k] * rows[k] for k in range(len(weight)))


def shift_of(Y: Columns, w: Array) -> Array:
    """Change of the mean (D,), Y^T w = K v."""
    return jnp.concatenate([_weighted_sum(w, Y.pose), _weighted_sum(w, Y.map)])


def grad_update(
    saved: Saved, *, cov: CovarianceBlocks, shift: Array, nis: Array, logdet: Array
) -> tuple[CovarianceBlocks, LinearizedMeasurements]:
    """Derivatives of a loss by the arguments of `kalman_update`, of those by its results.

    Given: G by P' (symmetric), g by shift, n by nis, l by logdet. Wanted: by P, H, R and v.

    Forward, with K = P H^T S^-1 and u = S^-1 v,

        S = H P H^T + R,   P' = P - K S K^T,   shift = K v = P H^T u,   nis = v^T u.

    Step 1, differentials. With J = I - K H, P' = J P, dS = dH P H^T + H P dH^T + H dP H^T + dR:

        dP'      = J dP J^T - P' dH^T K^T - K dH P' + K dR K^T
        du       = S^-1 (dv - dS u)
        d shift  = J dP H^T u + P' dH^T u - K dH shift - K dR u + K dv
        d nis    = 2 u^T dv - u^T H dP H^T u - 2 u^T dH shift - u^T dR u
        d logdet = tr(S^-1 H dP H^T) + 2 tr(K dH) + tr(S^-1 dR)

    (dP' is that of Joseph's form J P J^T + K R K^T; dK drops out of it, as K is its minimum.)

    Step 2, collect. The loss changes by tr(G dP') + g^T d shift + n d nis + l d logdet. With the
    products Q = K^T G (N, D) and r = K^T g (N,), the factors of dv, dR, dH are

        grad_v = r + 2 n u
        grad_R = Q K - (r u^T + u r^T) / 2 - n u u^T + l S^-1
        grad_H = -2 Q P' + u (P' g)^T - grad_v shift^T + 2 l K^T

    and that of dP, where J^T G J = G - H^T Q - Q^T H + H^T Q K H and J^T g = g - H^T r,

        grad_P = G + H^T X + X^T H,     X = -Q + u g^T / 2 + grad_R H / 2.

    Step 3, symmetry. P is symmetric, so only the symmetric part of grad_P counts, and the code
    returns G + 2 H^T X: the transpose of a map-sized matrix is never taken. For the same reason
    G is made symmetric where it meets Y, not before (`_factors`). The block `cross` stands for
    itself and its transpose: its derivative is the sum of both blocks.

    The symbols are the names in the code: `gain` is K^T (N, D), A is `inv_root`, and as
    S^-1 = A^T A and K^T = A^T Y, all products start from A, Y and w = A v.

    Cost: two products of Y with a matrix (2 L, 2 L), in `_factors`; the rest is O(N^2 L).
    """
    rows, m = saved.rows, saved.rows.slot.size
    if isinstance(cov.map, DeferredCovariance):
        raise ValueError("cov.map is deferred, which has no derivatives: flush it first")
    # Half of the stored block belongs to pose and map, half to map and pose.
    grad_pose = (cov.pose + cov.pose.T) / 2
    G = _CovarianceGradient(grad_pose, cov.cross / 2, cov.map)
    width = rows.H_pose.shape[-1]
    g = Columns(shift[:width], shift[width:])
    factors = _factors(saved, G, g)
    grad_v = factors.r + 2 * nis * factors.u
    grad_R = _grad_R(saved.inv_root, factors, nis, logdet)
    grad_P = _grad_P(G, g, grad_R, factors, rows)
    grad_H_pose, grad_H_slot = _grad_H(saved, g, grad_v, factors, logdet)
    grad_rows = LinearizedMeasurements(
        residual=grad_v.reshape(m, 2),
        H_pose=grad_H_pose,
        H_landmark=grad_H_slot,
        # R has blocks on its diagonal only.
        R=grad_R.reshape(m, 2, m, 2)[jnp.arange(m), :, jnp.arange(m)],
        slot=None,  # type: ignore[arg-type]  # an integer has no derivative
    )
    return grad_P, grad_rows


def _factors(saved: Saved, G: _CovarianceGradient, g: Columns) -> _Factors:
    """K^T, Q = K^T G, u = S^-1 v and r = K^T g, each as A^T times a product of Y or w."""
    inv_root, Y = saved.inv_root, saved.Y
    # Y G by blocks of columns; G.map is made symmetric here, as (Y G + (G Y^T)^T) / 2.
    yg_map = (Y.map @ G.map + (G.map @ Y.map.T).T) / 2
    yg_map += add_outer_products(jnp.zeros_like(Y.map), Y.pose.T, G.cross)
    yg_pose = Y.pose @ G.pose + Y.map @ G.cross.T
    Q = Columns(transposed_matmul(inv_root, yg_pose), transposed_matmul(inv_root, yg_map))
    gain = Columns(transposed_matmul(inv_root, Y.pose), transposed_matmul(inv_root, Y.map))
    u = jnp.sum(inv_root * saved.w[:, None], axis=0)
    r = gain.pose @ g.pose + gain.map @ g.map
    return _Factors(gain, Q, u, r)


def _grad_R(inv_root: Array, factors: _Factors, grad_nis: Array, grad_logdet: Array) -> Array:
    """Q K - (r u^T + u r^T) / 2 - n u u^T + l S^-1, (N, N)."""
    gain, Q, u, r = factors
    grad_R = Q.pose @ gain.pose.T + Q.map @ gain.map.T - grad_nis * u[:, None] * u[None]
    grad_R -= (r[:, None] * u[None] + u[:, None] * r[None]) / 2
    return grad_R + grad_logdet * transposed_matmul(inv_root, inv_root)


def _grad_P(
    G: _CovarianceGradient,
    g: Columns,
    grad_R: Array,
    factors: _Factors,
    rows: LinearizedMeasurements,
) -> CovarianceBlocks:
    """G + 2 H^T X with X = -Q + u g^T / 2 + grad_R H / 2, by blocks; not symmetric.

    H is never dense: it has the columns of the pose and, for each measurement, two of its slot. A
    product with H on the right is scattered to columns of slots, one with H^T on the left to rows.
    """
    _, Q, u, _ = factors
    m, n, slot = rows.slot.size, 2 * rows.slot.size, rows.slot
    size, width = G.map.shape[1] // 2, rows.H_pose.shape[-1]

    # X (N, D). The last term's columns are those of the pose, and of the measured slots.
    grad_R_by_row = grad_R.reshape(n, m, 2)
    x_pose = u[:, None] * g.pose[None] / 2 - Q.pose
    x_pose += total(grad_R_by_row[:, :, i] @ rows.H_pose[:, i] for i in range(2)) / 2
    x_slot = total(grad_R_by_row[:, :, i, None] * rows.H_landmark[None, :, i] for i in range(2)) / 2
    x_map = u[:, None] * g.map[None] / 2 - Q.map
    x_map = x_map.reshape(n, size, 2).at[:, slot].add(x_slot).reshape(n, -1)

    # H^T X: rows of the pose, and of the measured slots.
    h_pose = rows.H_pose.reshape(n, width)
    slot_pose = _slot_rows(rows.H_landmark, x_pose.reshape(m, 2, width))
    slot_map = _slot_rows(rows.H_landmark, x_map.reshape(m, 2, -1))
    map_pose = jnp.zeros((size, 2, width), x_pose.dtype).at[slot].add(slot_pose)
    map_pose = map_pose.reshape(-1, width)
    return CovarianceBlocks(
        pose=G.pose + add_outer_products(jnp.zeros_like(G.pose), h_pose, 2 * x_pose),
        cross=2 * (add_outer_products(G.cross, h_pose, x_map) + map_pose.T),
        map=G.map.reshape(size, 2, -1).at[slot].add(2 * slot_map).reshape(G.map.shape),
    )


def _slot_rows(by_slot: Array, x: Array) -> Array:
    """Rows (M, 2, k) of H^T X at the slots, for rows x (M, 2, k) of the measurements."""
    return total(by_slot[:, i, :, None] * x[:, i, None] for i in range(2))


def _grad_H(
    saved: Saved, g: Columns, grad_v: Array, factors: _Factors, grad_logdet: Array
) -> tuple[Array, Array]:
    """-2 Q P' + u (P' g)^T - grad_v shift^T + 2 l K^T, where H is not zero.

    Returns:
        Columns of the pose (M, 2, 3), and of each measurement's own slot (M, 2, 2).
    """
    gain, slot = factors.gain, saved.rows.slot
    m = slot.size
    size, width = gain.map.shape[1] // 2, gain.pose.shape[1]
    q_pose, q_map = factors.Q.pose.reshape(m, 2, width), factors.Q.map.reshape(m, 2, -1)
    u, grad_v = factors.u.reshape(m, 2), grad_v.reshape(m, 2)
    shift = shift_of(saved.Y, saved.w)

    pg_pose = saved.cov_pose @ g.pose + saved.cov_cross @ g.map  # (3,) P' g
    by_pose = -2 * (q_pose @ saved.cov_pose + q_map @ saved.cov_cross.T)
    by_pose += u[..., None] * pg_pose[None, None] - grad_v[..., None] * shift[None, None, :width]
    by_pose += 2 * grad_logdet * gain.pose.reshape(m, 2, width)

    pg_slot = saved.cov_slot_pose @ g.pose + saved.cov_slot_map @ g.map  # (M, 2) P' g
    shift_slot = shift[width:].reshape(-1, 2)[slot]
    gain_slot = gain.map.reshape(m, 2, size, 2)[jnp.arange(m), :, slot]
    by_slot = -2 * (
        jnp.einsum("mip,mjp->mij", q_pose, saved.cov_slot_pose)
        + jnp.einsum("mid,mjd->mij", q_map, saved.cov_slot_map)
    )
    by_slot += u[..., None] * pg_slot[:, None] - grad_v[..., None] * shift_slot[:, None]
    by_slot += 2 * grad_logdet * gain_slot
    return by_pose, by_slot
