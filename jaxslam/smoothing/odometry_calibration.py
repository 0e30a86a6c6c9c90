"""Systematic errors of odometry and scanner, estimated from what wheels and scans say of one drive.

A drive is cut into N spans between keyframes. Of each, the wheels have the motion w(c), which
depends on the calibration c, and scan matching has the motion m, with the covariance S of the scans
alone, large in directions that they do not show, as along a corridor. The error e = m - w(c) has a
Student t distribution of nu degrees of freedom, which gives little weight to spans where wheels
slip, hang, or were reset:

    log p(e) = const - log det C / 2 - (nu + 3) / 2 log(1 + e^T C^-1 e / nu)
    C = S + diag(q_xy, q_xy, q_t),  q_xy = a0^2 d + a1^2 |t| + b0^2,  q_t = a2^2 d + a3^2 |t| + b1^2

for d metres and t radians by the wheels. Calibration and noise (a, b) have priors; the greatest
probability of both is found in turns:

    repeat until c stays the same:
        noise = argmax of the posterior, by L-BFGS
        c    += Gauss-Newton step, each span weighted by (nu + 3) / (nu + e^T C^-1 e)

Clocks that are off by more than the robot takes for a turn are not found by small steps. So the
mean of the prior, and the best of a grid of time offsets, are both climbed from, and the higher
maximum is taken.

References:
    Censi, Franchi, Marchionni, Oriolo (2013), Simultaneous calibration of odometry and sensor
    parameters for mobile robots. Lange, Little, Taylor (1989), Robust statistical modeling using
    the t distribution. White (1982), Maximum likelihood estimation of misspecified models.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core import se2, se2_np
from jaxslam.core.calibration import Calibration, calibrate_odometry, reckon
from jaxslam.matching.odometry_fusion import DEGREES_OF_FREEDOM
from jaxslam.smoothing.calibration_noise import (
    CalibrationNoise,
    fit_noise,
    log_density,
    log_prior,
    whitened_errors,
)

NUM_PIECES = 32
"""Of the drive, whose gradients vary as its information says, if the model is right."""

DETERMINED = 0.5
"""Standard error, of the prior's, below which a number is determined by the drive."""

MAX_ITERATIONS = 30
CONVERGED = 1e-3
"""Standard errors by which no number changes any more in the last iteration."""

DERIVATIVE_STEP = 1e-4
"""Standard deviations of the prior by which a number is changed for its derivative."""

CLOCKS_APART, CLOCK_STEP = 6.0, 0.25
"""[s] by which clocks may be off to be found, and between two that are tried."""

LEFT_SHARE, LEFT_OVER = 0.3, 0.05
"""Share of a motion, and [m] or [rad], up to which wheels and scans say the same."""


class MotionSpans(NamedTuple):
    """T scans of a drive, and the N spans that they are cut into.

    Attributes:
        times: (T,) [s] of the scans, increasing; None where they are not to be trusted.
        odometry: (T, 3) [m, m, rad] increments since the scan before, zero at the first, of the
            scanner at `mount` by uncalibrated wheels.
        mount: (3,) [m, m, rad] where the scanner was taken to be, in the frame between the wheels.
        first: (N,) int32 scan that each span begins with.
        last: (N,) int32 scan that it ends with.
        increment: (N, 3) [m, m, rad] motion of the scanner by scan matching.
        match_cov: (N, 3, 3) its covariance, large where the scans do not show the motion.
        driven: (N, 2) [m], [rad] the size of the motion by the wheels.
        usable: (N,) bool; others are padding, or not to be learned from.
    """

    times: Any
    odometry: Any
    mount: Any
    first: Any
    last: Any
    increment: Any
    match_cov: Any
    driven: Any
    usable: Any


class CalibrationEstimate(NamedTuple):
    """A calibration, NumPy, and how sure it is.

    Attributes:
        calibration: Of the greatest probability.
        standard_errors: Of each number of it, in the same record.
        prior_std: Standard deviations of the prior; 0 where a number was held fixed.
        noise: What is left of the difference of wheels and scans.
        num_spans: Number of spans it is from.
    """

    calibration: Calibration
    standard_errors: Calibration
    prior_std: Calibration
    noise: CalibrationNoise
    num_spans: int

    @property
    def not_determined(self) -> tuple[str, ...]:
        """Names of the numbers of which the drive says little: they are about as the prior's."""
        errors, priors = flat(self.standard_errors), flat(self.prior_std)
        sure = errors < DETERMINED * priors
        return tuple(name for name, is_sure in zip(NAMES, sure, strict=True) if not is_sure)


NAMES = (
    "distance_scale",
    "turn_scale",
    "turn_per_distance",
    "mount[0]",
    "mount[1]",
    "mount[2]",
    "time_offset",
)
"""Names of the numbers of a calibration, in the order of `flat`."""


def flat(calibration: Calibration) -> np.ndarray:
    """The numbers (7,) of a calibration."""
    return np.concatenate([np.ravel(np.asarray(x, np.float64)) for x in calibration])


def unflat(numbers: Any) -> Calibration:
    """The calibration of numbers (7,), of NumPy or JAX; the inverse of `flat`."""
    return Calibration(numbers[0], numbers[1], numbers[2], numbers[3:6], numbers[6])


def default_prior_std() -> Calibration:
    """Standard deviations of a calibration before any drive: of robots as people build them."""
    return unflat(np.array([0.1, 0.1, 0.05, 0.3, 0.3, 0.15, 0.2]))


def wheel_motion(calibration: Calibration, spans: MotionSpans) -> Any:
    """Motion (N, 3) [m, m, rad] of the scanner over each span by calibrated wheels.

    In the namespace of `spans.odometry`, NumPy or JAX.
    """
    moved = calibrate_odometry(calibration, spans.odometry, times=spans.times, mount=spans.mount)
    xp, poses = moved.__array_namespace__(), reckon(moved)
    start, end = poses[spans.first], poses[spans.last]
    gap = end - start
    cos, sin = xp.cos(start[:, 2]), xp.sin(start[:, 2])
    ahead, left = cos * gap[:, 0] + sin * gap[:, 1], cos * gap[:, 1] - sin * gap[:, 0]
    return xp.stack([ahead, left, _wrap(gap[:, 2])], axis=-1)


def motion_error(calibration: Calibration, spans: MotionSpans) -> Any:
    """Errors (N, 3) [m, m, rad] m - w(c), the angle wrapped."""
    error = spans.increment - wheel_motion(calibration, spans)
    xp = error.__array_namespace__()
    return xp.concat([error[:, :2], _wrap(error[:, 2:])], axis=-1)


def _wrap(angle: Any) -> Any:
    """The angle in [-pi, pi), in either namespace."""
    own = angle.__array_namespace__()
    return se2_np.wrap_angle(angle) if own is np else se2.wrap_angle(angle)


def contradicted(calibration: Calibration, spans: MotionSpans) -> np.ndarray:
    """The usable spans (N,) over which calibrated wheels move otherwise than the scans show.

    Args:
        calibration: Of the robot.
        spans: Of its drive, NumPy.
    """
    error = np.abs(motion_error(calibration, spans))
    far = np.hypot(error[:, 0], error[:, 1]), error[:, 2]
    moved = np.hypot(spans.increment[:, 0], spans.increment[:, 1]), np.abs(spans.increment[:, 2])
    off = [e > LEFT_SHARE * m + LEFT_OVER for e, m in zip(far, moved, strict=True)]
    return np.asarray(spans.usable & (off[0] | off[1]))


def estimate_calibration(
    spans: MotionSpans, mean: Calibration | None = None, prior_std: Calibration | None = None
) -> CalibrationEstimate:
    """The calibration of greatest probability, and its standard errors.

    These are those of the sandwich estimator F^-1 V F^-1, with the Fisher information F, and V the
    sum of the squared gradients of pieces of the drive, and of the prior; or those of F^-1 where
    they are larger, as pieces of a drive without turns say nothing of the turns of another.

    A robot that drives ahead by its scanner, and back by its wheels, is one whose scanner faces
    back: the distance scale is positive.

    Args:
        spans: Of one drive, NumPy; none usable: the result is the prior.
        mean: Of the prior; no systematic errors by default.
        prior_std: Its standard deviations, 0 for a number that is held fixed; by default
            `default_prior_std`. The time offset is held fixed without times.
    """
    mean = Calibration.identity() if mean is None else mean
    prior_std = default_prior_std() if prior_std is None else prior_std
    if spans.times is None:
        prior_std = prior_std._replace(time_offset=np.zeros(()))
    middle, scale = flat(mean), flat(prior_std)
    own = np.flatnonzero(spans.usable)
    of_spans = spans.driven[own], spans.match_cov[own]

    def errors(z: np.ndarray) -> np.ndarray:
        return motion_error(unflat(middle + scale * z), spans)[own]

    def log_posterior(z: np.ndarray, noise: CalibrationNoise) -> float:
        density, _ = log_density(noise, errors(z), *of_spans)
        return float(np.sum(density)) + log_prior(noise) - float(z @ z) / 2

    typical = CalibrationNoise.typical()
    starts = _starts(scale)
    best = starts[np.argmax([log_posterior(z, typical) for z in starts])]
    top = _climb(starts[0], errors, of_spans)
    if abs(best[6] - top.z[6]) * scale[6] > CLOCK_STEP:  # another maximum, perhaps
        other = _climb(best, errors, of_spans)
        top = max(top, other, key=lambda one: log_posterior(one.z, one.noise))
    gradients, cov = top.gradients, top.cov
    variance = np.diagonal(cov)
    if len(own) >= NUM_PIECES:
        pieces = np.stack([x.sum(axis=0) for x in np.array_split(gradients, NUM_PIECES)])
        sandwich = cov @ (pieces.T @ pieces + np.eye(len(cov))) @ cov
        variance = np.maximum(variance, np.diagonal(sandwich))
    found = _driving_ahead(unflat(middle + scale * top.z), spans.mount)
    sure = unflat(scale * np.sqrt(variance))
    return CalibrationEstimate(found, sure, prior_std, top.noise, len(own))


class _Top(NamedTuple):
    """A maximum: numbers (7,) in standard deviations, noise, gradients (n, 7), covariance."""

    z: np.ndarray
    noise: CalibrationNoise
    gradients: np.ndarray
    cov: np.ndarray


def _starts(scale: np.ndarray) -> np.ndarray:
    """Numbers (K, 7) in standard deviations to climb from, the mean of the prior first."""
    if not scale[6]:
        return np.zeros((1, len(scale)))
    offsets = np.arange(CLOCK_STEP, CLOCKS_APART + CLOCK_STEP / 2, CLOCK_STEP)
    clocks = np.concatenate([[0.0], offsets, -offsets])
    return clocks[:, None] / scale[6] * (np.arange(len(scale)) == 6)


def _climb(
    z: np.ndarray, errors: Callable[[np.ndarray], np.ndarray], of_spans: tuple[np.ndarray, ...]
) -> _Top:
    """The maximum of the posterior near numbers (7,).

    Args:
        z: In standard deviations of the prior.
        errors: Those of the spans (n, 3), of such numbers.
        of_spans: `driven` and `match_cov` of these spans.
    """
    nu = DEGREES_OF_FREEDOM

    def derivative(z: np.ndarray) -> np.ndarray:
        steps = DERIVATIVE_STEP * np.eye(len(z))
        columns = [(errors(z + h) - errors(z - h)) / (2 * DERIVATIVE_STEP) for h in steps]
        return np.stack(columns, axis=-1)

    noise = CalibrationNoise.typical()
    for _ in range(MAX_ITERATIONS):
        error = errors(z)
        noise = fit_noise(noise, error, *of_spans)
        table = np.concatenate([error[..., None], derivative(z)], axis=-1)
        whitened, _ = whitened_errors(noise, table, *of_spans)
        residual, jacobian = whitened[..., 0], whitened[..., 1:]
        weight = (nu + 3) / (nu + np.sum(residual**2, axis=-1))
        gradients = np.einsum("n,nia,ni->na", weight, jacobian, residual)
        weighted = np.einsum("n,nia,nib->ab", weight, jacobian, jacobian) + np.eye(len(z))
        step = np.linalg.solve(weighted, -gradients.sum(axis=0) - z)
        fisher = np.einsum("nia,nib->ab", jacobian, jacobian) * (nu + 3) / (nu + 5)
        cov = np.linalg.inv(fisher + np.eye(len(z)))
        z = z + step
        if np.all(np.abs(step) <= CONVERGED * np.sqrt(np.diagonal(cov))):
            break
    return _Top(z, noise, gradients, cov)


def _driving_ahead(calibration: Calibration, mount: np.ndarray) -> Calibration:
    """The same motion by a distance scale that is positive: the scanner then faces back."""
    if calibration.distance_scale >= 0.0:
        return calibration
    place = se2_np.compose(mount, np.asarray(calibration.mount))
    back = se2_np.compose(np.array([0.0, 0.0, np.pi]), place)
    scale = np.asarray(-calibration.distance_scale)
    return calibration._replace(distance_scale=scale, mount=se2_np.relative(mount, back))
