"""A Gaussian over pose and map, conditioned on observations that each see one landmark.

The covariance is kept in blocks, of the pose (3, 3), of pose and map (3, 2 L), and of the map
(2 L, 2 L), so that a motion leaves the largest of them alone and its rows stay aligned in memory.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.covariance import Postponed, rows_at, subtract
from jaxslam.linalg import add_products, inverse_root
from jaxslam.types import Array


class Blocks(NamedTuple):
    """A symmetric matrix over pose and map."""

    pose: Array  # (3, 3)
    cross: Array  # (3, 2 L)
    map: Array | Postponed  # (2 L, 2 L)


class Rows(NamedTuple):
    """Observations to condition on; zero rows with unit noise add nothing."""

    residual: Array  # (M, 2) range [m] and bearing [rad], or direction [rad] and 0
    by_pose: Array  # (M, 2, 3) derivative of the expectation by the pose
    by_slot: Array  # (M, 2, 2) and by the landmark's two numbers
    noise: Array  # (M, 2, 2) covariance of the observation; identity where unmatched
    slot: Array  # (M,) int32, below L; no two rows that count have the same


class Conditioned(NamedTuple):
    """What conditioning changes and finds."""

    shift: Array  # (D,) of the mean
    cov: Blocks
    nis: Array  # () squared Mahalanobis norm of the residuals
    logdet: Array  # () logarithm of the determinant of their covariance S
    good: Array  # () bool, S is positive definite, all is finite; else nothing was changed


class _Kept(NamedTuple):
    """What the derivative needs of a conditioning; all of it smaller than the covariance."""

    root: Array  # (N, N) A with A S A^T = I, N = 2 M
    y_pose: Array  # (N, 3) A H P, of the pose
    y_map: Array  # (N, 2 L) and of the map
    w: Array  # (N,) A v
    after: tuple[Array, Array, Array, Array]  # rows of P' that the observations are about
    rows: Rows


def _times(h: Array, x: Array) -> Array:
    """Products (..., 2, n) of derivatives (..., 2, k) and rows (..., k, n), spelled out."""
    return sum(h[..., k, None] * x[..., None, k, :] for k in range(h.shape[-1]))


def _of_slots(x: Array, slot: Array) -> Array:
    """Columns (r, M, 2) of the slots (M,), of a matrix (r, 2 L)."""
    return x.reshape(len(x), -1, 2)[:, slot]


@jax.custom_vjp
def condition(cov: Blocks, rows: Rows) -> Conditioned:
    """Condition on all rows at once.

        S = H P H^T + R,   A S A^T = I,   Y = A H P,   P' = P - Y^T Y,   shift = Y^T A v

    P stays symmetric by construction, and positive definite for any number of steps: its diagonal
    is raised by `covariance.GUARD` units of rounding, which no derivative knows of. No inverse is
    taken. Where S is not positive definite, by rounding or nonsense, or a residual is not finite,
    nothing is changed.

    Derivatives are taken in reverse only, by hand: `_pull`. They take `cov` for symmetric.

    References:
        Paper, eqs. (14)-(16).
    """
    return _push(cov, rows)[0]


def innovation_cov(cov: Blocks, rows: Rows) -> Array:
    """S = H P H^T + R, (2 M, 2 M)."""
    return _seen(cov, rows)[2]


def log_likelihood(done: Conditioned, dof: Array) -> Array:
    """Log-likelihood () [nats] of the residuals, of which `dof` () int32 numbers count."""
    numbers = dof.astype(done.nis.dtype)
    return -0.5 * (done.nis + done.logdet + numbers * jnp.log(2 * jnp.pi).astype(done.nis.dtype))


def plus(cov: Blocks, left: tuple[Array, Array], right: tuple[Array, Array], *, sign=1) -> Blocks:
    """Add the products of rows, of pose (k, 3) and map (k, 2 L) each: cov + sign left^T right."""
    return Blocks(
        pose=add_products(cov.pose, left[0], right[0], sign=sign),
        cross=add_products(cov.cross, left[0], right[1], sign=sign),
        map=add_products(cov.map, left[1], right[1], sign=sign),
    )


def drop(rows: Rows, keep: Array) -> Rows:
    """Rows of which those that are not kept, (M,) bool, stand for nothing."""
    keep = keep[:, None, None]
    return rows._replace(
        residual=jnp.where(keep[..., 0], rows.residual, 0.0),
        by_pose=jnp.where(keep, rows.by_pose, 0.0),
        by_slot=jnp.where(keep, rows.by_slot, 0.0),
        noise=jnp.where(keep, rows.noise, jnp.eye(2, dtype=rows.noise.dtype)),
    )


def _seen(cov: Blocks, rows: Rows) -> tuple[Array, Array, Array]:
    """H P, of the pose (N, 3) and of the map (N, 2 L), and S (N, N)."""
    n, slot = 2 * rows.slot.size, rows.slot
    across = jnp.moveaxis(_of_slots(cov.cross, slot), 0, 2)  # (M, 2, 3)
    own = rows_at(cov.map, slot)  # (M, 2, 2 L)
    hp = (_times(rows.by_pose, cov.pose[None]) + _times(rows.by_slot, across)).reshape(n, 3)
    hm = (_times(rows.by_pose, cov.cross[None]) + _times(rows.by_slot, own)).reshape(n, -1)
    seen = _of_slots(hm, slot)  # (N, M, 2)
    s = sum(hp[:, None, None, k] * rows.by_pose[None, ..., k] for k in range(3))
    s += sum(seen[:, :, None, k] * rows.by_slot[None, ..., k] for k in range(2))
    eye = jnp.eye(slot.size, dtype=s.dtype)[:, None, :, None]
    s = s.reshape(-1, 2, n // 2, 2) + eye * rows.noise[:, :, None]
    return hp, hm, s.reshape(n, n)


def _push(cov: Blocks, rows: Rows) -> tuple[Conditioned, _Kept]:
    slot = rows.slot
    hp, hm, s = _seen(cov, rows)
    root, logdet, good = inverse_root(s)
    w = jnp.sum(root * rows.residual.reshape(-1)[None], axis=1)
    good &= jnp.all(jnp.isfinite(w))
    root, w = jnp.where(good, root, 0.0), jnp.where(good, w, 0.0)
    y_pose = add_products(jnp.zeros_like(hp), root.T, hp)
    y_map = add_products(jnp.zeros_like(hm), root.T, hm)
    after = Blocks(
        pose=add_products(cov.pose, y_pose, y_pose, sign=-1),
        cross=add_products(cov.cross, y_pose, y_map, sign=-1),
        map=subtract(cov.map, y_map, good & jnp.any(rows.by_slot != 0.0)),
    )
    shift = jnp.concatenate([_mix(w, y_pose), _mix(w, y_map)])
    kept = (
        after.pose,
        after.cross,
        jnp.moveaxis(_of_slots(after.cross, slot), 0, 2),
        rows_at(after.map, slot),
    )
    result = Conditioned(shift, after, jnp.sum(w * w), logdet, good)
    return result, _Kept(root, y_pose, y_map, w, kept, rows)


def _mix(weight: Array, rows: Array) -> Array:
    """Sum (n,) of rows (k, n) with weights (k,)."""
    return sum(weight[k] * rows[k] for k in range(len(weight)))


def _pull(kept: _Kept, out: Conditioned) -> tuple[Blocks, Rows]:
    """Derivative of a loss by P, H, R and v, from those by P' (G), shift (g), nis and log det.

    With K = P H^T S^-1, u = S^-1 v, Q = K^T G and N the derivative by R,

        N = Q K - (r u^T + u r^T) / 2 - nis' u u^T + logdet' S^-1,        r = K^T g
        by P:  G + 2 H^T X,   X = -Q + u g^T / 2 + N H / 2
        by H:  -2 Q P' + u (P' g)^T - (r + 2 nis' u) shift^T + 2 logdet' K^T
        by v:  r + 2 nis' u

    so that one product as large as the update's own is all it takes. Of a derivative by a symmetric
    matrix only the symmetric part counts: of G it is taken, of the result it is left to be taken.
    """
    root, yp, ym, w, (p_pose, p_cross, p_across, p_own), rows = kept
    m, n = rows.slot.size, 2 * rows.slot.size
    size = ym.shape[1] // 2
    nis, logdet = out.nis, out.logdet
    g_pose, g_map = out.shift[:3], out.shift[3:]
    pose = (out.cov.pose + out.cov.pose.T) / 2
    cross = out.cov.cross / 2
    map = out.cov.map

    k = lambda x: add_products(jnp.zeros_like(x), root, x)  # A^T x
    e_map = (ym @ map + (map @ ym.T).T) / 2 + add_products(jnp.zeros_like(ym), yp.T, cross)
    e_pose = yp @ pose + ym @ cross.T
    q_pose, q_map, k_pose, k_map = k(e_pose), k(e_map), k(yp), k(ym)
    u = jnp.sum(root * w[:, None], axis=0)
    r = k_pose @ g_pose + k_map @ g_map
    shift = jnp.concatenate([_mix(w, yp), _mix(w, ym)])
    by_v = r + 2 * nis * u
    by_s = q_pose @ k_pose.T + q_map @ k_map.T - nis * u[:, None] * u[None]
    by_s -= (r[:, None] * u[None] + u[:, None] * r[None]) / 2
    by_s += logdet * k(root)

    # X, but for the part N H / 2 in the columns of the slots.
    hs = by_s.reshape(n, m, 2)
    x_pose = u[:, None] * g_pose[None] / 2 - q_pose
    x_pose += sum(hs[:, :, i] @ rows.by_pose[:, i] for i in range(2)) / 2
    x_map = u[:, None] * g_map[None] / 2 - q_map
    part = sum(hs[:, :, i, None] * rows.by_slot[None, :, i] for i in range(2)) / 2  # (N, M, 2)
    x_map = x_map.reshape(n, size, 2).at[:, rows.slot].add(part).reshape(n, -1)
    # H^T X: rows of the pose, and of the slots that were seen.
    flat = rows.by_pose.reshape(n, 3)
    x_slot = x_pose.reshape(m, 2, 3), x_map.reshape(m, 2, -1)
    low_pose, low_map = (
        sum(rows.by_slot[:, i, :, None] * x[:, i, None] for i in range(2)) for x in x_slot
    )
    low_pose = jnp.zeros((size, 2, 3), yp.dtype).at[rows.slot].add(low_pose).reshape(-1, 3)
    by_cov = Blocks(
        pose=pose + add_products(jnp.zeros_like(pose), flat, 2 * x_pose),
        cross=2 * (add_products(cross, flat, x_map) + low_pose.T),
        map=map.reshape(size, 2, -1).at[rows.slot].add(2 * low_map).reshape(map.shape),
    )

    q_pose, q_map = q_pose.reshape(m, 2, 3), q_map.reshape(m, 2, -1)
    up, vp = u.reshape(m, 2), by_v.reshape(m, 2)
    seen = lambda x: x[3:].reshape(-1, 2)[rows.slot]
    pose_g = p_pose @ g_pose + p_cross @ g_map
    slot_g = p_across @ g_pose + p_own @ g_map
    by_pose = -2 * (q_pose @ p_pose + q_map @ p_cross.T)
    by_pose += up[..., None] * pose_g[None, None] - vp[..., None] * shift[None, None, :3]
    by_pose += 2 * logdet * k_pose.reshape(m, 2, 3)
    by_slot = -2 * (
        jnp.einsum("mip,mjp->mij", q_pose, p_across) + jnp.einsum("mid,mjd->mij", q_map, p_own)
    )
    by_slot += up[..., None] * slot_g[:, None] - vp[..., None] * seen(shift)[:, None]
    own = k_map.reshape(m, 2, size, 2)[jnp.arange(m), :, rows.slot]
    by_slot += 2 * logdet * own
    diagonal = by_s.reshape(m, 2, m, 2)[jnp.arange(m), :, jnp.arange(m)]
    return by_cov, Rows(vp, by_pose, by_slot, diagonal, None)


condition.defvjp(_push, _pull)
