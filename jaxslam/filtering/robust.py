"""Robust measurement update: innovations of a Student t distribution, one weight per feature.

With S = H P H^T + R the innovation covariance of the rows and A its inverse Cholesky factor,
A S A^T = I, the whitened innovations e = A v fall apart into one e_i of n_i numbers for each
feature i (two; one for a wall). The predictive density of v is, by the chain rule,

    p(v) = |det A|  prod_i t(e_i),     t(e) = Gamma((nu + n) / 2) / Gamma(nu / 2) (nu pi)^(-n / 2)
                                              (1 + e^T e / nu)^(-(nu + n) / 2)

a normalised density, so that its logarithm is a proper score, and nu can be tuned by it. For nu to
infinity it is that of the Gaussian. S is then a matrix of scales: the covariance is
nu / (nu - 2) S for nu > 2.

The update is a step of iteratively reweighted least squares, from the prediction. A t distribution
is a Gaussian of covariance S_ii / w with a random w, which is expected to be

    w_i = (nu + n_i) / (nu + d_i^2),       d_i^2 = v_i^T S_ii^-1 v_i

What S_ii / w_i exceeds S_ii by is noise of the measurement, where w_i is below 1:

    R_i' = R_i + max(1 / w_i - 1, 0) S_ii

so that the robot follows an innovation far off by a share w_i of the gain. To divide R_i alone by
w_i would not do: where the pose is uncertain R_i is small beside S_ii, and a wrong landmark would
be followed all the same. What is near is not trusted more. Approximated are: the sum of a Gaussian
and a Student t distribution, by one t of both scales; the innovations of a scan, as uncorrelated
rather than of one common heavy tail; the posterior, by a Gaussian of one iteration. Data
association, and the test of matches, are Gaussian as before.

References:
    Lange, Little, Taylor (1989), Robust statistical modeling using the t distribution. Roth,
    Ozkan, Gustafsson (2013), A Student's t filter for heavy tailed process and measurement noise.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.types import Array
from jaxslam.filtering.joint_covariance import CovarianceBlocks, LinearizedMeasurements
from jaxslam.filtering.kalman import innovation_cov


class Score(NamedTuple):
    """How well innovations were predicted; all are 0 where S is not positive definite.

    Attributes:
        nis: () v^T S^-1 v, with the R that no weight has changed.
        log_likelihood: () [nats] log-density of the innovations.
        logdet: () log det S, of the same S.
    """

    nis: Array
    log_likelihood: Array
    logdet: Array


def reweight(
    student_dof: Array, cov: CovarianceBlocks, rows: LinearizedMeasurements, size: Array
) -> tuple[LinearizedMeasurements, Score]:
    """Rows with the R of each feature by its weight, and the score of the innovations.

    Args:
        student_dof: () nu, degrees of freedom, above 0.
        cov: Covariance of the predicted belief.
        rows: Linearised measurements (K).
        size: (K,) int32 numbers n_i of each that count: 2, 1 for a wall, 0 where it is not used.

    Returns:
        The rows, and the score.
    """
    s = innovation_cov(cov, rows)
    root, logdet, good = inverse_cholesky(s)
    white = root @ rows.residual.reshape(-1)
    square = jnp.sum(white.reshape(-1, 2) ** 2, axis=1)
    density = jnp.sum(student_log_density(student_dof, square, size)) - 0.5 * logdet
    count = len(size)
    index = jnp.arange(count, dtype=jnp.int32)
    own = s.reshape(count, 2, count, 2)[index, :, index]
    weight = student_weight(student_dof, _own_squares(own, rows.residual), size)
    excess = jnp.where(size > 0, jnp.maximum(1.0 / weight - 1.0, 0.0), 0.0)
    R = rows.R + excess[:, None, None] * own
    good &= jnp.isfinite(density)
    score = Score(*(jnp.where(good, x, 0.0) for x in (jnp.sum(square), density, logdet)))
    return rows._replace(R=R), score


def student_weight(student_dof: Array, square: Array, size: Array) -> Array:
    """Weights (...) of features by their squared Mahalanobis distances (...) of `size` numbers."""
    return (student_dof + size.astype(square.dtype)) / (student_dof + square)


def student_log_density(student_dof: Array, square: Array, size: Array) -> Array:
    """Log-density (...) [nats] of t of whitened innovations, by their squared norms (...).

    Args:
        student_dof: () nu.
        square: (...) squared norms of vectors.
        size: (...) int32 their dimensions: 0, 1 or 2.
    """
    nu = student_dof
    two = jnp.log(nu / 2)  # log Gamma(nu / 2 + 1) - log Gamma(nu / 2)
    gamma = jnp.where(size == 2, two, jnp.where(size == 1, _log_gamma_ratio(nu / 2), 0.0))
    n = size.astype(square.dtype)
    tail = (nu + n) / 2 * jnp.log1p(square / nu)
    return gamma - n / 2 * jnp.log(nu * math.pi) - tail


def _own_squares(block: Array, residual: Array) -> Array:
    """d_i^2 (K,) by the diagonal blocks (K, 2, 2) of S and the innovations (K, 2)."""
    a, b, d = block[:, 0, 0], block[:, 0, 1], block[:, 1, 1]
    x, y = residual[:, 0], residual[:, 1]
    determinant = a * d - b * b
    safe = jnp.where(determinant > 0.0, determinant, 1.0)
    square = jnp.maximum((d * x * x - 2 * b * x * y + a * y * y) / safe, 0.0)
    return jnp.where((determinant > 0.0) & jnp.isfinite(square), square, 0.0)


def _log_gamma_ratio(x: Array) -> Array:
    """Log Gamma(x + 1/2) - log Gamma(x) of x > 0, without the cancellation for large x.

    By Gamma(x + 1) = x Gamma(x) from x + 5, where Stirling's series leaves less than 2e-8.
    """
    steps = [jnp.log((x + k) / (x + k + 0.5)) for k in range(5)]
    y = x + 5.0
    series = jnp.log(y) / 2 - 1 / (8 * y) + 1 / (192 * y**3) - 1 / (640 * y**5)
    return sum(steps, start=series)
