"""Pose errors, NEES and its chi-square bounds."""

import jax.numpy as jnp
from scipy.special import chdtri

from jaxslam.core.se2 import wrap_angle
from jaxslam.core.types import Array


def pose_error(estimate: Array, truth: Array) -> Array:
    """Error (..., 3) [m, m, rad] of poses (..., 3), in the world frame, heading wrapped."""
    error = estimate - truth
    return error.at[..., 2].set(wrap_angle(error[..., 2]))


def nees(error: Array, cov: Array) -> Array:
    """Normalised estimation error squared, e^T P^-1 e.

    Over many trials of a consistent filter it is chi-square distributed with k degrees of freedom;
    it is not divided by k. It is computed by elimination: with P = L D L^T, L unit lower
    triangular, and y = L^-1 e,

        e^T P^-1 e = y^T D^-1 y = sum_j y_j^2 / d_j

    where column j is eliminated from the columns after it,

        y_i -= f y_j,    P_im -= f P_mj,    f = P_ij / d_j,    d_j = P_jj    for j < m <= i

    written out for each element: array operations on whole batches, fast on any device for small k.

    Args:
        error: (..., k).
        cov: (..., k, k) symmetric P; only its lower triangle is read.

    Returns:
        (...), inf where P is not positive definite or anything is NaN or infinite; gradients are
        0 there.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications, section 5.4.
    """
    size = error.shape[-1]
    good = jnp.isfinite(error).all(axis=-1) & jnp.isfinite(cov).all(axis=(-2, -1))
    rest = [jnp.where(good, error[..., i], 0.0) for i in range(size)]  # y
    lower = [
        [jnp.where(good, cov[..., i, j], float(i == j)) for j in range(i + 1)] for i in range(size)
    ]
    total = jnp.zeros_like(rest[0])
    for j in range(size):
        positive = lower[j][j] > 0.0
        good = good & positive
        pivot = jnp.where(positive, lower[j][j], 1.0)
        total = total + rest[j] ** 2 / pivot
        for i in range(j + 1, size):
            factor = lower[i][j] / pivot
            rest[i] = rest[i] - factor * rest[j]
            for m in range(j + 1, i + 1):
                lower[i][m] = lower[i][m] - factor * lower[m][j]
    return jnp.where(good, total, jnp.inf)


def rmse(values: Array, mask: Array) -> Array:
    """Root mean square () of the `values` (...) whose `mask` (...) is True.

    Values outside the mask may be NaN. The result is NaN if the mask is empty; the gradient is 0
    then, and also where the result is exactly 0.
    """
    count = jnp.sum(mask, dtype=values.dtype)
    square = jnp.sum(jnp.where(mask, values, 0.0) ** 2) / jnp.maximum(count, 1.0)
    positive = square > 0.0
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
    return jnp.where(count > 0.0, root, jnp.nan)


def chi_square_bounds(dof: int, count: int, probability: float = 0.95) -> tuple[float, float]:
    """Interval of the mean of `count` independent chi-square values, for consistency tests.

    Args:
        dof: Degrees of freedom of each value: 3 for the NEES of a pose.
        count: Number of values that are averaged.
        probability: That the mean lies in the interval; both tails are equal.

    Returns:
        Lower and upper bound of the mean, on either side of `dof`.
    """
    tail = (1.0 - probability) / 2.0
    lower, upper = (float(chdtri(dof * count, above)) / count for above in (1.0 - tail, tail))
    return lower, upper


CERTAIN_TRACE = (
    1e-12  # trace of the covariance below which a pose is known exactly, as the first is
)
