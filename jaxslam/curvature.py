"""How well the data determine the noise: standard errors of fitted parameters."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from jaxslam import fit
from jaxslam.losses import Loss, calibrated, check
from jaxslam.monte_carlo import Log
from jaxslam.slam import Config, Noise

STEP = 0.1  # of a logarithm, by which curvature is measured
SURE = 0.5  # relative standard error above which a parameter counts as not identifiable
SHARE = 0.1  # part of a parameter in directions that the data say nothing of, likewise


class Errors(NamedTuple):
    """Standard errors, of the logarithms: 0.1 is ten percent. P parameters."""

    names: tuple[str, ...]  # (P,)
    relative: np.ndarray  # (P,) standard error; NaN where frozen, inf where unknown
    covariance: np.ndarray  # (P, P) of what is known; zero where frozen
    identifiable: np.ndarray  # (P,) bool; False where frozen
    warnings: tuple[str, ...]  # which free parameters the data do not tell, if any


def standard_errors(
    noise: Noise,
    config: Config,
    logs: Log,
    *,
    loss: Loss = calibrated,
    frozen: Collection[str] = (),
) -> Errors:
    """Standard errors of a fit, from the curvature of its loss and how its runs disagree.

        C = H^-1 J H^-1 / B

    with H the mean over runs of the second derivatives, by central differences of the gradient,
    and J that of the outer products of the gradients. It does not take the model for true.
    Directions along which H is not positive, or too small beside J for a standard error below a
    factor of e, are those of which the data say nothing.

    Args:
        noise: Where the mean loss over the runs is least, as `fit.tune` found it.
        config: Of the filter.
        logs: [B] runs that it was tuned on.
        loss: By which.
        frozen: Names of parameters that were not.

    Raises:
        ValueError: Fewer than two runs, or as `fit.tune`.

    References:
        White (1982), "Maximum likelihood estimation of misspecified models".
    """
    check(loss, logs)
    runs = logs.motion.shape[0]
    if runs < 2:
        raise ValueError("standard errors need two runs or more")
    h, each = second_derivatives(noise, config, logs, loss=loss, frozen=frozen)
    return _errors(fit.names(noise), fit.free(noise, frozen), h, each.T @ each / len(each), runs)


def second_derivatives(
    noise: Noise, config: Config, logs: Log, *, loss: Loss, frozen: Collection[str] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Mean second derivatives (F, F) over runs in the F free parameters, as logarithms.

    Returns:
        They, and the gradients (G, F) of those runs that have one.
    """
    at = np.flatnonzero(fit.free(noise, frozen))
    values, each = fit.gradients(noise, config, logs, loss)
    good = np.isfinite(values) & np.isfinite(each).all(axis=1)

    def slope(parameter: int, by: float) -> np.ndarray:
        beside = fit.scaled(noise, parameter, by)
        return fit.mean_gradient(*fit.gradients(beside, config, logs, loss))[1][at]

    h = np.stack([(slope(i, STEP) - slope(i, -STEP)) / (2 * STEP) for i in at])
    return (h + h.T) / 2, each[good][:, at]


def _known(h: np.ndarray, j: np.ndarray, runs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of curvature H and outer products J (F, F): what the data tell.

    Returns:
        Whether they tell of each direction (F,), the inverse (F, F) of H in those they do, and the
        share (F,) of each parameter in the others.
    """
    curvature, direction = np.linalg.eigh(h)
    variance = np.einsum("ik,ij,jk->k", direction, j, direction) / runs
    told = (curvature > 0.0) & (variance < curvature**2)
    inverse = direction[:, told] / curvature[told] @ direction[:, told].T
    return told, inverse, np.sum(direction[:, ~told] ** 2, axis=1)


def _errors(
    names: tuple[str, ...], moves: np.ndarray, h: np.ndarray, j: np.ndarray, runs: int
) -> Errors:
    """Standard errors of H and J (F, F) of the free parameters."""
    _, known, unknown = _known(h, j, runs)
    own = known @ j @ known / runs
    relative = np.where(unknown < SHARE, np.sqrt(np.diag(own)), np.inf)
    sure = relative < SURE

    size = len(moves)
    covariance, whole = np.zeros((size, size)), np.full(size, np.nan)
    covariance[np.ix_(moves, moves)] = own
    whole[moves] = relative
    identifiable = np.zeros(size, bool)
    identifiable[moves] = sure
    lost = ", ".join(names[i] for i in np.flatnonzero(moves & ~identifiable))
    advice = "freeze some, or take more runs or another loss"
    warnings = (f"not identifiable from these {runs} runs: {lost}; {advice}",) if lost else ()
    return Errors(names, whole, covariance, identifiable, warnings)
