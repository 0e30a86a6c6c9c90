"""Standard errors of tuned noise parameters, from the curvature of the loss.

Sandwich estimator. The parameters theta, logarithms of the noise, minimise the mean loss of B
independent runs, (1/B) sum_b l_b(theta). With g_b the gradient of l_b at the true minimum theta_0,
H the mean of the Hessians of l_b, and the mean gradient zero at the estimate theta,

    0 = mean_b g_b + H (theta - theta_0)    =>    theta - theta_0 = -H^-1 mean_b g_b

to first order. The mean gradient has the covariance J / B with J = mean_b g_b g_b^T, so

    C = cov(theta) = H^-1 (J / B) H^-1

This holds for any smooth loss. If the loss is the negative log-likelihood of a correct model then
J = H, and C = H^-1 / B, the inverse Fisher information.

Along an eigenvector v of H, with eigenvalue c, the variance is v^T C v = (v^T J v / B) / c^2. The
data determine the direction if c > 0 and this is below 1: a standard error of theta below 1, a
factor of e in the noise. H is inverted on the determined directions only.
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from jaxslam import fit
from jaxslam.losses import Loss, calibrated, check
from jaxslam.monte_carlo import Log
from jaxslam.slam import Config, Noise

STEP = 0.1  # step of a logarithm for central differences of the gradient
SURE = 0.5  # relative standard error from which a parameter counts as not identifiable
SHARE = 0.1  # squared component in undetermined directions from which it does so, too


class Errors(NamedTuple):
    """Standard errors of the logarithms of P parameters: 0.1 is ten percent.

    Attributes:
        names: (P,) names of the parameters.
        relative: (P,) standard errors; NaN where frozen, inf where not determined.
        covariance: (P, P) in the determined directions; zero where frozen.
        identifiable: (P,) bool; False where frozen.
        warnings: Messages about free parameters that are not identifiable; empty if all are.
    """

    names: tuple[str, ...]
    relative: np.ndarray
    covariance: np.ndarray
    identifiable: np.ndarray
    warnings: tuple[str, ...]


def standard_errors(
    noise: Noise,
    config: Config,
    logs: Log,
    *,
    loss: Loss = calibrated,
    frozen: Collection[str] = (),
) -> Errors:
    """Standard errors of tuned parameters by the sandwich estimator, C = H^-1 J H^-1 / B.

    The module's docstring derives it. The model need not be correct.

    Args:
        noise: Minimum of the mean loss over the runs, as `fit.tune` found it.
        config: Of the filter.
        logs: [B] runs that it was tuned on.
        loss: The loss that it was tuned by.
        frozen: Names of parameters, or fields of the noise, that were not tuned.

    Raises:
        ValueError: Fewer than two runs, or as `fit.tune`.

    References:
        White (1982), "Maximum likelihood estimation of misspecified models".
    """
    check(loss, logs)
    runs = logs.motion.shape[0]
    if runs < 2:
        raise ValueError("standard errors need two runs or more")
    hessian, gradients = second_derivatives(noise, config, logs, loss=loss, frozen=frozen)
    outer = gradients.T @ gradients / len(gradients)
    return _errors(fit.names(noise), fit.free(noise, frozen), hessian, outer, runs)


def second_derivatives(
    noise: Noise, config: Config, logs: Log, *, loss: Loss, frozen: Collection[str] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Mean Hessian over runs in the F free parameters, by central differences of the gradient.

    Args:
        noise: Where to evaluate it.
        config: Of the filter.
        logs: [B] runs.
        loss: The loss.
        frozen: Names of parameters, or fields of the noise, that are not free.

    Returns:
        The Hessian (F, F), symmetric, of the logarithms of the parameters; and the gradients
        (G, F) of the G runs whose loss and gradient are finite.
    """
    indices = np.flatnonzero(fit.free(noise, frozen))
    values, gradients = fit.gradients(noise, config, logs, loss)
    good = np.isfinite(values) & np.isfinite(gradients).all(axis=1)

    def gradient_beside(parameter: int, offset: float) -> np.ndarray:
        beside = fit.scaled(noise, parameter, offset)
        return fit.mean_gradient(*fit.gradients(beside, config, logs, loss))[1][indices]

    rows = [(gradient_beside(i, STEP) - gradient_beside(i, -STEP)) / (2 * STEP) for i in indices]
    hessian = np.stack(rows)
    return (hessian + hessian.T) / 2, gradients[good][:, indices]


def _invert_determined(
    hessian: np.ndarray, outer: np.ndarray, runs: int
) -> tuple[np.ndarray, np.ndarray]:
    """Invert H on the directions that the data determine.

    Args:
        hessian: (F, F) H.
        outer: (F, F) J.
        runs: B.

    Returns:
        The pseudo-inverse (F, F), and each parameter's squared component (F,) in the undetermined
        directions, from 0 to 1.
    """
    curvature, direction = np.linalg.eigh(hessian)
    gradient_variance = np.einsum("ik,ij,jk->k", direction, outer, direction) / runs
    determined = (curvature > 0.0) & (gradient_variance < curvature**2)
    kept = direction[:, determined]
    inverse = kept / curvature[determined] @ kept.T
    return inverse, np.sum(direction[:, ~determined] ** 2, axis=1)


def _errors(
    names: tuple[str, ...], trainable: np.ndarray, hessian: np.ndarray, outer: np.ndarray, runs: int
) -> Errors:
    """Standard errors of P parameters from H and J (F, F) of the F that are trainable (P,) bool."""
    inverse, undetermined = _invert_determined(hessian, outer, runs)
    own = inverse @ outer @ inverse / runs
    own_relative = np.where(undetermined < SHARE, np.sqrt(np.diag(own)), np.inf)

    size = len(trainable)
    covariance, relative = np.zeros((size, size)), np.full(size, np.nan)
    covariance[np.ix_(trainable, trainable)] = own
    relative[trainable] = own_relative
    identifiable = np.zeros(size, bool)
    identifiable[trainable] = own_relative < SURE
    unidentifiable = [names[i] for i in np.flatnonzero(trainable & ~identifiable)]
    if not unidentifiable:
        return Errors(names, relative, covariance, identifiable, ())
    advice = "freeze some, or take more runs or another loss"
    warning = f"not identifiable from these {runs} runs: {', '.join(unidentifiable)}; {advice}"
    return Errors(names, relative, covariance, identifiable, (warning,))
