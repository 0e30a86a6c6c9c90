"""Standard errors of tuned noise parameters, from the curvature of the loss.

Sandwich estimator. The parameters theta, logarithms of the noise, minimise the mean loss of B
independent episodes, (1/B) sum_b l_b(theta). With g_b the gradient of l_b at the true minimum
theta_0, H the mean of the Hessians of l_b, and the mean gradient zero at the estimate theta,

    0 = mean_b g_b + H (theta - theta_0)    =>    theta - theta_0 = -H^-1 mean_b g_b

to first order. The mean gradient has the covariance J / B with J = mean_b g_b g_b^T, so

    C = cov(theta) = H^-1 (J / B) H^-1

An episode whose loss or gradient is not finite does not count: H and J are means over the others,
and B is the number of these.

This holds for any smooth loss. If the loss is the negative log-likelihood of a correct model then
J = H, and C = H^-1 / B, the inverse Fisher information.

Along an eigenvector v of H, with eigenvalue c, the variance is v^T C v = (v^T J v / B) / c^2. The
data determine the direction if c > 0 and this is below 1: a standard error of theta below 1, a
factor of e in the noise. H is inverted on the determined directions only.
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from jaxslam.core.episode import Episode
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.tuning import fitting, parameters
from jaxslam.tuning.inputs import as_params, prepare
from jaxslam.tuning.losses import Loss, pose_nll

DIFFERENCE_STEP = 0.1  # step of a logarithm for central differences of the gradient
# Relative standard error from which a parameter counts as not identifiable.
IDENTIFIABLE_BELOW = 0.5
# Squared component in undetermined directions from which it does so, too.
MAX_UNKNOWN_SHARE = 0.1


class StandardErrors(NamedTuple):
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
    config: Config,
    params: NoiseParams,
    episodes: Episode | list[Episode],
    *,
    loss: Loss | str = pose_nll,
    frozen: Collection[str] = (),
) -> StandardErrors:
    """Standard errors of tuned parameters by the sandwich estimator, C = H^-1 J H^-1 / B.

    The module's docstring derives it. The model need not be correct. B is the number of episodes
    whose loss and gradient are finite, over which H and J are means, too; fewer than two of these
    determine nothing.

    Args:
        config: Its filter is the one that was tuned.
        params: Minimum of the mean loss over the episodes, as `fitting.tune` found it.
        episodes: [B] episodes that it was tuned on, or a list of single ones.
        loss: The loss that it was tuned by.
        frozen: Names of parameters, or fields of the noise, that were not tuned.

    Raises:
        ValueError: Fewer than two episodes, or as `fitting.tune`.

    References:
        White (1982), "Maximum likelihood estimation of misspecified models".
    """
    params, stacked, function = prepare(config, params, episodes, loss)
    params = as_params(params)
    trainable = parameters.trainable_mask(params, frozen)
    if len(stacked.odometry) < 2:
        raise ValueError("standard errors need two episodes or more; episodes has 1")
    hessian, gradients = second_derivatives(config, params, stacked, loss=function, frozen=frozen)
    used = len(gradients)
    outer = gradients.T @ gradients / max(used, 1)
    if used < 2:
        hessian, outer = np.zeros_like(hessian), np.zeros_like(outer)
    return _errors(parameters.param_names(params), trainable, hessian, outer, used)


def second_derivatives(
    config: Config,
    params: NoiseParams,
    episodes: Episode,
    *,
    loss: Loss,
    frozen: Collection[str] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Mean Hessian over episodes in the F free parameters, by differences of the gradient.

    Args:
        config: Its filter is run.
        params: Where to evaluate it.
        episodes: [B] episodes.
        loss: The loss.
        frozen: Names of parameters, or fields of the noise, that are not free.

    Returns:
        The Hessian (F, F), symmetric, of the logarithms of the parameters; and the gradients
        (G, F) of the G episodes whose loss and gradient are finite.
    """
    indices = np.flatnonzero(parameters.trainable_mask(params, frozen))
    values, gradients = fitting.gradients(config, params, episodes, loss)
    good = np.isfinite(values) & np.isfinite(gradients).all(axis=1)

    def gradient_beside(parameter: int, offset: float) -> np.ndarray:
        beside = parameters.scale_param(params, parameter, offset)
        return fitting.mean_gradient(*fitting.gradients(config, beside, episodes, loss))[1][indices]

    rows = [
        (gradient_beside(i, DIFFERENCE_STEP) - gradient_beside(i, -DIFFERENCE_STEP))
        / (2 * DIFFERENCE_STEP)
        for i in indices.tolist()
    ]
    hessian = np.stack(rows)
    return (hessian + hessian.T) / 2, gradients[good][:, indices]


def _invert_determined(
    hessian: np.ndarray, outer: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Invert H on the directions that the data determine.

    Args:
        hessian: (F, F) H.
        outer: (F, F) J.
        count: B, the episodes that count.

    Returns:
        The pseudo-inverse (F, F), and each parameter's squared component (F,) in the undetermined
        directions, from 0 to 1.
    """
    curvature, direction = np.linalg.eigh(hessian)
    gradient_variance = np.einsum("ik,ij,jk->k", direction, outer, direction) / max(count, 1)
    determined = (curvature > 0.0) & (gradient_variance < curvature**2)
    kept = direction[:, determined]
    inverse = kept / curvature[determined] @ kept.T
    return inverse, np.sum(direction[:, ~determined] ** 2, axis=1)


def _errors(
    names: tuple[str, ...],
    trainable: np.ndarray,
    hessian: np.ndarray,
    outer: np.ndarray,
    count: int,
) -> StandardErrors:
    """Standard errors of P parameters from H and J (F, F) of the F that are trainable (P,) bool."""
    inverse, undetermined = _invert_determined(hessian, outer, count)
    own = inverse @ outer @ inverse / max(count, 1)
    own_relative = np.where(undetermined < MAX_UNKNOWN_SHARE, np.sqrt(np.diag(own)), np.inf)

    size = len(trainable)
    covariance, relative = np.zeros((size, size)), np.full(size, np.nan)
    covariance[np.ix_(trainable, trainable)] = own
    relative[trainable] = own_relative
    identifiable = np.zeros(size, bool)
    identifiable[trainable] = own_relative < IDENTIFIABLE_BELOW
    unidentifiable = [names[i] for i in np.flatnonzero(trainable & ~identifiable)]
    if not unidentifiable:
        return StandardErrors(names, relative, covariance, identifiable, ())
    advice = "freeze some, or take more episodes or another loss"
    warning = f"not identifiable from these {count} episodes: {', '.join(unidentifiable)}; {advice}"
    return StandardErrors(names, relative, covariance, identifiable, (warning,))
