"""Online adaptation: Q and R scaled while the robot goes, from a window of innovations.

Let S = H P H^T + R be the innovation covariance of a step, v the innovations and u = S^-1 v. Scales
exp(a) of Q and exp(b) of R, on the variances, enter S by

    A_Q = H_pose Q H_pose^T,     A_R = R,      dS / da = A_Q,      dS / db = A_R

with Q and R scaled already. For i of Q and R, the derivative of the log-likelihood and its Fisher
information are

    g_i = (u^T A_i u - tr(A_i S^-1)) / 2,      F_ij = tr(A_i S^-1 A_j S^-1) / 2

The mean of v v^T - S is what innovations say about the noise (Mehra); it is zero where g is zero in
the mean. A window that forgets (Akhlaghi et al.), here of Fisher information, turns g into a step,

    F <- (1 - 1 / memory) F + F_step,       (a, b) <- (a, b) + (F + I / prior_std^2)^-1 g

a recursive maximum-likelihood estimate, positive by construction. Where innovations say nothing
about a scale, F is small beside the prior and the scale stays. With n scans of information F_step
each, the standard deviation of (a, b) about the truth is the root of (F_step)^-1 / (2 memory - 1).

Only this step's Q enters A_Q: that of earlier steps is in P, as it was scaled then. The scale of Q
therefore converges slowly where P is large beside Q. A weight of `robust` is part of R: outliers do
not raise the scale.

References:
    Mehra (1970), On the identification of variances and adaptive Kalman filtering. Akhlaghi, Zhou,
    Huang (2017), Adaptive adjustment of noise covariance in Kalman filter for dynamic state
    estimation.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.types import Array
from jaxslam.filtering.joint_covariance import CovarianceBlocks, LinearizedMeasurements
from jaxslam.filtering.kalman import innovation_cov


class AdaptationSpec(NamedTuple):
    """How Q and R adapt; static under jit.

    Attributes:
        memory: Scans after which innovations are forgotten; at least 2.
        prior_std: Standard deviation of the logarithm of a variance's scale before anything is
            known.
        max_factor: Largest factor on a standard deviation, and its inverse the smallest.
    """

    memory: float = 200.0
    prior_std: float = 1.0
    max_factor: float = 30.0


class Adaptation(NamedTuple):
    """Scales of the noise, part of the belief.

    Attributes:
        log_variance: (2,) logarithms of the scales of the variances of Q and of R.
        information: (2, 2) F, their Fisher information in the window.
    """

    log_variance: Array
    information: Array

    @property
    def factors(self) -> Array:
        """Factors (2,) on the standard deviations of Q and of R."""
        return jnp.exp(self.log_variance / 2)


def check_adaptation(name: str, spec: AdaptationSpec) -> None:
    """Raise ValueError, naming the field, unless the numbers of a specification are possible."""
    if not isinstance(spec, AdaptationSpec):
        raise ValueError(f"{name} is {type(spec).__name__}, not AdaptationSpec")
    for field, least in (("memory", 2.0), ("prior_std", 0.0), ("max_factor", 1.0)):
        value = getattr(spec, field)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not least <= value < math.inf or value == 0.0:
            above = f"at least {least:g}" if least else "above 0"
            raise ValueError(f"{name}.{field} is {value!r}, not a finite number {above}")


def initial_adaptation(dtype: Any) -> Adaptation:
    """Scales of 1, of which nothing is known."""
    return Adaptation(jnp.zeros(2, dtype), jnp.zeros((2, 2), dtype))


def adapt(
    spec: AdaptationSpec,
    adaptation: Adaptation,
    cov: CovarianceBlocks,
    rows: LinearizedMeasurements,
    size: Array,
    odometry_cov: Array,
) -> Adaptation:
    """The scales after the innovations of a step; the module's docstring has the equations.

    Args:
        spec: How they adapt.
        adaptation: Before the step.
        cov: Covariance of the predicted belief.
        rows: Linearised measurements (K), their R scaled.
        size: (K,) int32 numbers of each that count: 2, 1 for a wall, 0 where it is not used.
        odometry_cov: (3, 3) Q of the step, scaled, map frame.

    Returns:
        The scales; as they were where S is not positive definite.
    """
    s = innovation_cov(cov, rows)
    count = len(s)
    root, _, good = inverse_cholesky(s)
    inverse = root.T @ root
    u = inverse @ rows.residual.reshape(-1)
    by_pose = rows.H_pose.reshape(count, -1)[:, :3]
    by_odometry = by_pose @ odometry_cov @ by_pose.T
    counts = jnp.arange(2, dtype=jnp.int32)[None] < size[:, None]  # (K, 2)
    own = rows.R * (counts[:, :, None] & counts[:, None]).astype(s.dtype)
    index = jnp.arange(len(own), dtype=jnp.int32)
    by_features = jnp.zeros((len(own), 2, len(own), 2), s.dtype).at[index, :, index].set(own)
    A = jnp.stack([by_odometry, by_features.reshape(count, count)])  # (2, 2 K, 2 K)
    whitened = A @ inverse[None]
    score = (jnp.einsum("n,inm,m->i", u, A, u) - jnp.trace(whitened, axis1=1, axis2=2)) / 2
    fisher = jnp.einsum("inm,jmn->ij", whitened, whitened) / 2
    good &= jnp.all(jnp.isfinite(score)) & jnp.all(jnp.isfinite(fisher))
    score, fisher = jnp.where(good, score, 0.0), jnp.where(good, fisher, 0.0)
    information = (1.0 - 1.0 / spec.memory) * adaptation.information + fisher
    prior = jnp.eye(2, dtype=s.dtype) / spec.prior_std**2
    step_root = inverse_cholesky(information + prior)[0]
    limit = 2 * math.log(spec.max_factor)
    moved = adaptation.log_variance + step_root.T @ (step_root @ score)
    return Adaptation(jnp.clip(moved, -limit, limit), information)
