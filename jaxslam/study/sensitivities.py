"""How much the error of a robot's position depends on each parameter, over many trials.

The error of a trial is the logarithm of its position RMSE, so that derivatives with respect to the
logarithm of a parameter are elasticities: 0.5 says that half the noise gives 0.7 times the error.
All values of a parameter are tried on the same noise, trial by trial:

    paired differences    (e(t + h) - e(t - h)) / (2 h),  its mean and standard error over trials

with the step h that has the least sum of squares of standard error and bias; the bias of a central
difference, C h^2, or of a one-sided one, C h, is known from that of twice the step. A gradient has
no step, but where data association switches with a parameter the error jumps, of which a gradient
knows nothing. So each is compared with paired differences on the same trials, and where they differ
by more than `AGREEMENT` standard errors the differences are what counts.

References:
    Asmussen, Glynn (2007), "Stochastic simulation", chapter VII: finite differences with common
    random numbers, and when a pathwise derivative is biased.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.types import as_float64, as_size

AGREEMENT = 2.0  # standard errors; a right gradient is refused one time in twenty
MIN_TRIALS = 8
TINY = 1e-9  # of a standard error, where gradient and differences are the same
STEPS = 1.0, 2.0, 4.0  # that are tried, in those of the parameter
GRADIENT, PAIRED = "gradient", "paired differences"

LogErrors = Callable[[np.ndarray], Any]
"""Of changes (P,) of all parameters: logarithms (N,) of the errors of trials, always of the same
noise; not finite where a trial diverges."""


class Parameter(NamedTuple):
    """A parameter that may be changed.

    Attributes:
        name: Of the parameter.
        value: What it is.
        unit: Of the value.
        is_log: Whether it is changed by a factor, exp(change); else the change is added.
        step: Least change that is tried.
        has_gradient: Whether errors may be differentiable with respect to it.
        one_sided: Whether only changes above 0 are possible: differences are then one-sided, and
            the effect is that of twice the parameter.
    """

    name: str
    value: float
    unit: str
    is_log: bool = True
    step: float = 0.05
    has_gradient: bool = False
    one_sided: bool = False


class Estimate(NamedTuple):
    """A mean over trials, and its standard error."""

    mean: float
    standard_error: float


class Sensitivity(NamedTuple):
    """What a parameter does to the error.

    Attributes:
        parameter: The parameter.
        method: `GRADIENT` or `PAIRED`: which one `derivative` is by.
        derivative: Of the logarithm of the RMSE, by the logarithm of the parameter, or by its unit.
        paired: By paired differences.
        gradient: By gradient; None where there is none.
        distance: [-] of the gradient from the paired differences, in standard errors of the
            difference, with the bias of the step; None where there is no gradient.
        step: Of the paired differences.
        halved: Change of the logarithm of the RMSE if the parameter is halved, or doubled where
            differences are one-sided; None where it is not changed by a factor.
        trials: That count.
        left_out: Those that diverged, or were not finite, at one of the values.
    """

    parameter: Parameter
    method: str
    derivative: Estimate
    paired: Estimate
    gradient: Estimate | None
    distance: float | None
    step: float
    halved: Estimate | None
    trials: int
    left_out: int


def sensitivities(
    parameters: Sequence[Parameter],
    log_errors: LogErrors,
    gradients: LogErrors | None = None,
    *,
    max_error: float = np.inf,
) -> list[Sensitivity]:
    """Sensitivity to each of P parameters.

    Args:
        parameters: In the order of the changes.
        log_errors: Errors of N trials with all parameters changed.
        gradients: Of changes (P,): derivatives (N, P) of `log_errors`; those of parameters without
            `has_gradient` are not looked at.
        max_error: A trial whose error is larger has diverged.

    Raises:
        ValueError: An argument is not possible, or fewer than `MIN_TRIALS` trials count.
    """
    names = [one.name for one in parameters]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"parameters are {names}, not some that differ")
    limit = np.log(as_size("max_error", max_error, positive=True) if max_error < np.inf else np.inf)

    def errors(change: np.ndarray) -> np.ndarray:
        found = as_float64("log_errors of a change", np.asarray(log_errors(change)), ("N",))
        return np.where(np.isfinite(found) & (found <= limit), found, np.nan)

    zero = np.zeros(len(parameters))
    base, slopes = errors(zero), None
    if gradients is not None and any(one.has_gradient for one in parameters):
        slopes = as_float64("gradients", np.asarray(gradients(zero)), ("N", len(parameters)))
    found = []
    for number, one in enumerate(parameters):
        axis = np.eye(len(parameters))[number]

        def along(change: float, axis: np.ndarray = axis) -> np.ndarray:
            return errors(change * axis) if change else base

        slope = None if slopes is None else slopes[:, number]
        found.append(_sensitivity(one, along, slope))
    return found


def ranked(found: Sequence[Sensitivity]) -> list[Sensitivity]:
    """Those that have an effect of halving, or doubling, the largest first: what to improve first.

    Of a parameter that is doubled, as the period of the scans, the error would fall by as much.
    """

    def gain(one: Sensitivity) -> float:
        mean = one.halved.mean if one.halved else 0.0
        return mean if one.parameter.one_sided else -mean

    return sorted((one for one in found if one.halved is not None), key=gain, reverse=True)


def describe(one: Sensitivity) -> str:
    """A sensitivity in one line."""
    by = "%" if one.parameter.is_log else one.parameter.unit
    amount = f"{one.derivative.mean:.3g} +- {one.derivative.standard_error:.2g}"
    text = f"{one.parameter.name}: {amount} % per {by}" if by == "%" else ""
    text = text or f"{one.parameter.name}: {amount} per {by}"
    if one.halved is not None:
        factor, error = np.exp(one.halved.mean), one.halved.standard_error
        change = "doubled" if one.parameter.one_sided else "halved"
        text += f", {change} {factor:.3f} +- {factor * error:.2g} times the error"
    return f"{text}; by {one.method}, {one.trials} trials, {one.left_out} left out"


def mean_of(values: np.ndarray, name: str) -> Estimate:
    """Mean of the finite ones of values (N,).

    Raises:
        ValueError: They are fewer than `MIN_TRIALS`.
    """
    good = values[np.isfinite(values)]
    if len(good) < MIN_TRIALS:
        raise ValueError(
            f"{name}: {len(good)} of {len(values)} trials count, fewer than {MIN_TRIALS}; "
            "try more of them, or a drive on which fewer diverge"
        )
    return Estimate(float(good.mean()), float(good.std(ddof=1) / np.sqrt(len(good))))


def _sensitivity(
    own: Parameter,
    errors: Callable[[float], np.ndarray],
    slope: np.ndarray | None,
) -> Sensitivity:
    """Sensitivity to one parameter, from errors (N,) at a change of it, and derivatives (N,)."""
    sizes = own.step * np.array(STEPS)
    if own.one_sided:
        differences = [(errors(h) - errors(0.0)) / h for h in sizes]
    else:
        differences = [(errors(h) - errors(-h)) / (2 * h) for h in sizes]
    best, bias = _best_step(own.name, differences, order=1 if own.one_sided else 2)
    step, difference = float(sizes[best]), differences[best]
    paired = derivative = mean_of(difference, own.name)
    method, gradient, distance = PAIRED, None, None
    counts = np.isfinite(difference)
    if slope is not None and own.has_gradient:
        counts &= np.isfinite(slope)
        gradient = mean_of(np.where(counts, slope, np.nan), own.name)
        gap = mean_of(slope - difference, own.name)
        distance = abs(gap.mean) / max(float(np.hypot(gap.standard_error, bias)), TINY)
        if distance <= AGREEMENT:
            method, derivative = GRADIENT, gradient
    halved = None
    if own.is_log:
        factor = 2.0 if own.one_sided else 0.5
        halved = mean_of(errors(np.log(factor)) - errors(0.0), own.name)
    trials = int(counts.sum())
    return Sensitivity(
        own,
        method,
        derivative,
        paired,
        gradient,
        distance,
        step,
        halved,
        trials,
        len(counts) - trials,
    )


def _best_step(name: str, differences: list[np.ndarray], order: int) -> tuple[int, float]:
    """Number of the step whose standard error and bias have the least sum of squares; its bias.

    Each step is twice the one before, and its bias 2^order times as large.
    """
    gaps = [mean_of(b - a, name) for a, b in zip(differences[:-1], differences[1:], strict=True)]
    # What may be chance is none.
    known = [np.sqrt(max(gap.mean**2 - gap.standard_error**2, 0.0)) for gap in gaps]
    bias = [gap / (2**order - 1) for gap in known]
    bias.append(2**order * bias[-1])
    variance = [mean_of(one, name).standard_error ** 2 for one in differences]
    best = int(np.argmin(np.square(bias) + variance))
    return best, float(bias[best])
