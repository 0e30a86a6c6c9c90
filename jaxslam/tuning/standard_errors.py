"""Standard errors of tuned parameters, from the curvature of the loss.

Sandwich estimator. The unconstrained numbers theta of the parameters minimise the mean loss of B
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
factor of e in a standard deviation. H is inverted on the determined directions only. Along the
others the variance is 1 or more, and counts as 1: a parameter that has a part in one has no smaller
standard error than that part.

A prior with precision P, a diagonal matrix, counts as w = 1 / (B T) of the loss, with T steps:

    C = A^-1 (J / B + w^2 P) A^-1,    A = H + w P

which is P^-1 where the data say nothing, and as above where they say all. Which parameters the data
determine is answered without it.
"""

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.episode import Episode
from jaxslam.pipeline.config import Config
from jaxslam.tuning import fitting, parameters
from jaxslam.tuning.fitting import Problem
from jaxslam.tuning.losses import Loss
from jaxslam.tuning.model import Model, num_steps
from jaxslam.tuning.parameters import theta_shape
from jaxslam.tuning.priors import flatten_prior
from jaxslam.tuning.sequences import mean_gradient
from jaxslam.tuning.transforms import REAL, of_leaves

DIFFERENCE_STEP = 0.1  # step of a logarithm for central differences of the gradient
# Relative standard error from which a parameter counts as not identifiable.
IDENTIFIABLE_BELOW = 0.5
# Squared component in undetermined directions from which it does so, too.
MAX_UNKNOWN_SHARE = 0.1


class StandardErrors(NamedTuple):
    """Standard errors of the unconstrained numbers theta of P parameters.

    Attributes:
        names: (P,) names of the parameters.
        relative: (P,) standard errors of theta: of the logarithm of a positive parameter, so 0.1 is
            ten percent; NaN where frozen, inf where not determined.
        covariance: (P, P) of theta, at least, as that of undetermined directions counts as 1; zero
            where frozen.
        identifiable: (P,) bool; False where frozen.
        warnings: Messages about free parameters that are not identifiable, and where the loss has
            no minimum; empty if all is well.
        of_params: Standard errors of the parameters themselves, in their units and their tree.
    """

    names: tuple[str, ...]
    relative: np.ndarray
    covariance: np.ndarray
    identifiable: np.ndarray
    warnings: tuple[str, ...]
    of_params: Any = None


def standard_errors(
    model: Model | Config,
    params: Any,
    data: Any,
    *,
    loss: Loss | str | None = None,
    transforms: Any = None,
    prior: Any = None,
    frozen: Collection[str] = (),
) -> StandardErrors:
    """Standard errors of tuned parameters by the sandwich estimator, C = H^-1 J H^-1 / B.

    The module's docstring derives it. The model need not be correct. B is the number of sequences
    whose loss and gradient are finite, over which H and J are means, too; fewer than two of these
    determine nothing.

    Args:
        model: The model that was tuned; a `Config` stands for its SLAM filter.
        params: Minimum of the mean loss over the sequences, as `fitting.tune` found it.
        data: [B] sequences that it was tuned on, or a list of single episodes.
        loss: The loss that it was tuned by.
        transforms: Of the parameters, as of `fitting.tune`.
        prior: Of the parameters, as of `fitting.tune`.
        frozen: Names of parameters, or of what they are part of, that were not tuned.

    Raises:
        ValueError: Fewer than two sequences, or as `fitting.tune`.

    References:
        White (1982), "Maximum likelihood estimation of misspecified models".
    """
    problem = fitting.prepare(model, params, data, loss, transforms=transforms)
    params = problem.params
    trainable = parameters.trainable_mask(params, frozen, transforms)
    count = len(jax.tree.leaves(problem.data)[0])
    kind = "episodes" if isinstance(problem.data, Episode) else "sequences"
    if count < 2:
        raise ValueError(f"standard errors need two {kind} or more; {kind} has 1")
    theta = parameters.flatten_params(params, transforms)
    steps = num_steps(problem.model, params, problem.data)
    penalty = flatten_prior(prior, params, transforms)
    precision = penalty.precision[trainable]
    hessian, gradients = second_derivatives(problem, theta, trainable, transforms)
    used = len(gradients)
    outer = gradients.T @ gradients / max(used, 1)
    if used < 2:
        hessian, outer = np.zeros_like(hessian), np.zeros_like(outer)
    own, unknown = _covariance(hessian, outer, used, precision / (count * steps), count * steps)
    pull = penalty.value_and_gradient(theta)[1][trainable] / (count * steps)
    found = _errors(params, transforms, theta, trainable, own, unknown, f"{used} {kind}")
    slopes = _slope_text(np.array(found.names)[trainable], gradients, pull)
    return found._replace(warnings=found.warnings + slopes)


def _slope_text(names: np.ndarray, gradients: np.ndarray, pull: np.ndarray) -> tuple[str, ...]:
    """A message about where the loss is not at its minimum, which all of this is about.

    The mean gradient is compared with its standard error sqrt(J / B), in any units.

    Args:
        names: (F,) of the free parameters.
        gradients: (G, F) of the sequences.
        pull: (F,) gradient of the prior.
    """
    if len(gradients) < 2:
        return ()
    slope = np.abs(gradients.mean(axis=0) + pull)
    steep = slope > np.sqrt(np.mean(gradients**2, axis=0) / len(gradients))
    if not steep.any():
        return ()
    found = ", ".join(names[steep])
    return (
        f"no minimum of the loss: it still falls along {found} by more than its own standard "
        "error; tune for more updates before these standard errors are used",
    )


def second_derivatives(
    problem: Problem, theta: np.ndarray, trainable: np.ndarray, transforms: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean Hessian over sequences in the F free parameters, by differences of the gradient.

    Args:
        problem: The model, its loss and the data.
        theta: (P,) where to evaluate it.
        trainable: (P,) bool, which are free.
        transforms: Of the parameters.

    Returns:
        The Hessian (F, F), symmetric; and the gradients (G, F) of the G sequences whose loss and
        gradient are finite.
    """
    indices = np.flatnonzero(trainable)
    values, gradients = fitting.gradients_of(problem)
    good = np.isfinite(values) & np.isfinite(gradients).all(axis=1)

    def gradient_beside(index: int, offset: float) -> np.ndarray:
        beside = theta + offset * (np.arange(len(theta)) == index)
        params = parameters.unflatten_params(beside, problem.params, transforms)
        each = fitting.gradients_of(problem._replace(params=params, theta=beside))
        return mean_gradient(*each)[1][indices]

    rows = [
        (gradient_beside(i, DIFFERENCE_STEP) - gradient_beside(i, -DIFFERENCE_STEP))
        / (2 * DIFFERENCE_STEP)
        for i in indices.tolist()
    ]
    hessian = np.stack(rows)
    return (hessian + hessian.T) / 2, gradients[good][:, indices]


def _covariance(
    hessian: np.ndarray, outer: np.ndarray, count: int, precision: np.ndarray, total: int
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (F, F), and each parameter's squared component (F,) in unknown directions.

    Args:
        hessian: (F, F) H.
        outer: (F, F) J.
        count: B, the sequences that count.
        precision: (F,) w P of the priors; all zero for none.
        total: 1 / w.
    """
    inverse, undetermined = _invert_determined(hessian, outer, count)
    unknown = np.sum(undetermined**2, axis=1)
    if precision.any():
        curvature, direction = np.linalg.eigh(hessian)  # the noise of H makes some negative
        hessian = direction * np.maximum(curvature, 0.0) @ direction.T + np.diag(precision)
        outer = outer + max(count, 1) * np.diag(precision) / total
        inverse, undetermined = _invert_determined(hessian, outer, count)
    determined = inverse @ outer @ inverse / max(count, 1)
    return determined + undetermined @ undetermined.T, unknown


def _invert_determined(
    hessian: np.ndarray, outer: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Invert H on the directions that the data determine.

    Args:
        hessian: (F, F) H.
        outer: (F, F) J.
        count: B, the episodes that count.

    Returns:
        The pseudo-inverse (F, F), and the undetermined directions (F, K).
    """
    curvature, direction = np.linalg.eigh(hessian)
    gradient_variance = np.einsum("ik,ij,jk->k", direction, outer, direction) / max(count, 1)
    determined = (curvature > 0.0) & (gradient_variance < curvature**2)
    kept = direction[:, determined]
    inverse = kept / curvature[determined] @ kept.T
    return inverse, direction[:, ~determined]


def _errors(
    params: Any,
    transforms: Any,
    theta: np.ndarray,
    trainable: np.ndarray,
    own: np.ndarray,
    unknown: np.ndarray,
    data: str,
) -> StandardErrors:
    """Standard errors of P parameters, from the covariance (F, F) of those that are trainable."""
    names = parameters.param_names(params, transforms)
    own_relative = np.where(unknown < MAX_UNKNOWN_SHARE, np.sqrt(np.diag(own)), np.inf)

    size = len(trainable)
    covariance, relative = np.zeros((size, size)), np.full(size, np.nan)
    covariance[np.ix_(trainable, trainable)] = own
    relative[trainable] = own_relative
    identifiable = np.zeros(size, bool)
    identifiable[trainable] = own_relative < IDENTIFIABLE_BELOW
    of_params = _of_params(params, transforms, theta, covariance, relative)
    unidentifiable = [names[i] for i in np.flatnonzero(trainable & ~identifiable)]
    warnings = []
    if unidentifiable:
        advice = f"freeze some, or take more {data.split()[1]} or another loss"
        found = ", ".join(unidentifiable)
        used = zip(jax.tree.leaves(params), of_leaves(params, transforms), strict=True)
        unscaled = [np.full(math.prod(theta_shape(x, one)), one == REAL) for x, one in used]
        if np.any(np.concatenate(unscaled) & trainable & ~identifiable):
            advice += ", or say by transforms.real(scale) which change of one is large"
        warnings = [f"not identifiable from these {data}: {found}; {advice}"]
    return StandardErrors(names, relative, covariance, identifiable, tuple(warnings), of_params)


def _of_params(
    params: Any, transforms: Any, theta: np.ndarray, covariance: np.ndarray, relative: np.ndarray
) -> Any:
    """Standard errors in the tree of the parameters, to first order.

    NaN where all that a number depends on is frozen, inf where some of it is not determined.
    """
    jacobian = parameters.natural_jacobian(theta, params, transforms)
    depends = jacobian != 0.0
    with np.errstate(invalid="ignore"):
        flat = np.sqrt(np.einsum("np,pq,nq->n", jacobian, covariance, jacobian))
    flat[(depends & np.isinf(relative)).any(axis=1)] = np.inf
    flat[~(depends & ~np.isnan(relative)).any(axis=1)] = np.nan
    leaves = jax.tree.leaves(params)
    parts = np.split(flat, np.cumsum([np.size(x) for x in leaves])[:-1])
    shaped = [x.reshape(np.shape(y)) for x, y in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(params), shaped)
