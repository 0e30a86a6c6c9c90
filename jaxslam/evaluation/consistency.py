"""Pose errors, NEES and its chi-square bounds."""

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.core.arguments import as_float
from jaxslam.core.se2 import wrap_angle
from jaxslam.core.types import AnyArray, Array

# Trace of the covariance below which a pose is known exactly, as the first of a drive is.
CERTAIN_TRACE = 1e-12


def pose_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Error (..., 3) [m, m, rad] of poses, in the world frame, heading wrapped to [-pi, pi).

    Args:
        estimate: (..., 3) [m, m, rad].
        truth: (..., 3) [m, m, rad], of the same shape.

    Raises:
        ValueError: One of them holds no poses, or their shapes differ.
    """
    estimate = as_float("estimate", estimate, (..., 3))
    truth = as_float("truth", truth, estimate.shape)
    error = estimate - truth
    return error.at[..., 2].set(wrap_angle(error[..., 2]))


def nees(error: ArrayLike, cov: ArrayLike) -> Array:
    """Normalised estimation error squared, e^T P^-1 e.

    Over many trials of a consistent filter it is chi-square distributed with k degrees of freedom,
    with mean k: 3 for a pose. `nees_per_dof` divides it by k. It is computed by elimination: with
    P = L D L^T, L unit lower triangular, and y = L^-1 e,

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

    Raises:
        ValueError: One of them holds no numbers, or their shapes do not fit; while tracing.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications, section 5.4.
    """
    error = as_float("error", error, (..., "k"))
    size = error.shape[-1]
    cov = as_float("cov", cov, (*error.shape, size))
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


@jax.jit  # one program instead of thirty of one operation each
def pose_nees(estimate: ArrayLike, truth: ArrayLike, cov: ArrayLike) -> Array:
    """`nees` (...) of the `pose_error` of poses (..., 3) with covariances (..., 3, 3)."""
    return nees(pose_error(estimate, truth), cov)


def nees_per_dof(values: AnyArray | float, dof: int = 3) -> AnyArray | float:
    """NEES per degree of freedom: 1 for a consistent filter, above if it is over-confident.

    Args:
        values: (...) NEES as of `nees`, their mean, or bounds as of `chi_square_bounds`. Of a mean
            over trials, the result is called ANEES.
        dof: Degrees of freedom: 3 for a pose.
    """
    return values / dof


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

    Raises:
        ValueError: An argument is out of its range.
    """
    from scipy.special import chdtri  # imported here, because it is slow to import

    for name, number in (("dof", dof), ("count", count)):
        if number < 1:
            raise ValueError(f"{name} is {number}, not a number >= 1")
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability is {probability}, not between 0 and 1")
    tail = (1.0 - probability) / 2.0
    lower, upper = (float(chdtri(dof * count, above)) / count for above in (1.0 - tail, tail))
    return lower, upper
