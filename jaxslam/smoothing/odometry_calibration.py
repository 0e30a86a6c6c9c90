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

References:
    Censi, Franchi, Marchionni, Oriolo (2013), Simultaneous calibration of odometry and sensor
    parameters for mobile robots. Lange, Little, Taylor (1989), Robust statistical modeling using
    the t distribution. White (1982), Maximum likelihood estimation of misspecified models.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from jaxslam.core import se2, se2_np
from jaxslam.core.calibration import Calibration, calibrate_odometry, reckon
from jaxslam.matching.odometry_fusion import DEGREES_OF_FREEDOM

NOISE_LOG_STD = 1.0
"""Standard deviation of the logarithm of each number of the noise, before any drive."""

NUM_PIECES = 32
"""Of the drive, whose gradients vary as its information says, if the model is right."""

DETERMINED = 0.5
"""Standard error, of the prior's, below which a number is determined by the drive."""

MAX_ITERATIONS = 30
CONVERGED = 1e-3
"""Standard errors by which no number changes any more in the last iteration."""

DERIVATIVE_STEP = 1e-4
"""Standard deviations of the prior by which a number is changed for its derivative."""


class CalibrationNoise(NamedTuple):
    """What is left of the difference of wheels and scans; standard deviations.

    Attributes:
        coefficients: (4,) a0 [m / sqrt(m)], a1 [m / sqrt(rad)], a2 [rad / sqrt(m)], a3
            [rad / sqrt(rad)].
        floor: (2,) b0 [m], b1 [rad].
    """

    coefficients: Any
    floor: Any

    @classmethod
    def typical(cls) -> "CalibrationNoise":
        """That of robots of the usual kind, to start from."""
        return cls(np.array([0.03, 0.03, 0.03, 0.03]), np.array([0.02, 0.01]))


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


def whitened_errors(
    noise: CalibrationNoise, error: Any, driven: Any, match_cov: Any
) -> tuple[Any, Any]:
    """L^-1 e for C = L L^T, and log det C, in either namespace.

    Args:
        noise: Of wheels and scans.
        error: (..., 3, k) [m, m, rad].
        driven: (..., 2) [m], [rad] size of the motion by the wheels.
        match_cov: (..., 3, 3) of scan matching.
    """
    xp = error.__array_namespace__()
    squares, floor = noise.coefficients**2, noise.floor**2
    metres, radians = driven[..., 0], driven[..., 1]
    along = squares[0] * metres + squares[1] * radians + floor[0]
    turn = squares[2] * metres + squares[3] * radians + floor[1]
    a = xp.sqrt(match_cov[..., 0, 0] + along)
    b, c = match_cov[..., 1, 0] / a, match_cov[..., 2, 0] / a
    d = xp.sqrt(match_cov[..., 1, 1] + along - b**2)
    f = (match_cov[..., 2, 1] - b * c) / d
    g = xp.sqrt(match_cov[..., 2, 2] + turn - c**2 - f**2)
    a, b, c, d, f, g = (x[..., None] for x in (a, b, c, d, f, g))
    first = error[..., 0, :] / a
    second = (error[..., 1, :] - b * first) / d
    third = (error[..., 2, :] - c * first - f * second) / g
    log_det = 2.0 * xp.log(a * d * g)[..., 0]
    return xp.stack([first, second, third], axis=-2), log_det


def log_density(noise: CalibrationNoise, error: Any, driven: Any, match_cov: Any) -> Any:
    """Log densities (...) of errors (..., 3) of spans, and their squared Mahalanobis norms (...).

    Args:
        noise: As of `whitened_errors`, and so are the others.
        error: (..., 3).
        driven: (..., 2).
        match_cov: (..., 3, 3).
    """
    xp, nu = error.__array_namespace__(), DEGREES_OF_FREEDOM
    whitened, log_det = whitened_errors(noise, error[..., None], driven, match_cov)
    square = xp.sum(whitened[..., 0] ** 2, axis=-1)
    constant = float(gammaln((nu + 3) / 2) - gammaln(nu / 2) - 1.5 * np.log(nu * np.pi))
    return constant - log_det / 2 - (nu + 3) / 2 * xp.log1p(square / nu), square


def estimate_calibration(
    spans: MotionSpans, mean: Calibration | None = None, prior_std: Calibration | None = None
) -> CalibrationEstimate:
    """The calibration of greatest probability, and its standard errors.

    These are those of the sandwich estimator F^-1 V F^-1, with the Fisher information F, and V the
    sum of the squared gradients of pieces of the drive, and of the prior; or those of F^-1 where
    they are larger, as pieces of a drive without turns say nothing of the turns of another.

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
    middle, scale, nu = flat(mean), flat(prior_std), DEGREES_OF_FREEDOM
    own = np.flatnonzero(spans.usable)
    of_spans = spans.driven[own], spans.match_cov[own]

    def errors(z: np.ndarray) -> np.ndarray:
        return motion_error(unflat(middle + scale * z), spans)[own]

    def derivative(z: np.ndarray) -> np.ndarray:
        steps = DERIVATIVE_STEP * np.eye(len(z))
        columns = [(errors(z + h) - errors(z - h)) / (2 * DERIVATIVE_STEP) for h in steps]
        return np.stack(columns, axis=-1)

    noise, z = CalibrationNoise.typical(), np.zeros(len(scale))
    for _ in range(MAX_ITERATIONS):
        error = errors(z)
        noise = _noise_of(noise, error, *of_spans)
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
    variance = np.diagonal(cov)
    if len(own) >= NUM_PIECES:
        pieces = np.stack([x.sum(axis=0) for x in np.array_split(gradients, NUM_PIECES)])
        sandwich = cov @ (pieces.T @ pieces + np.eye(len(z))) @ cov
        variance = np.maximum(variance, np.diagonal(sandwich))
    return CalibrationEstimate(
        unflat(middle + scale * z), unflat(scale * np.sqrt(variance)), prior_std, noise, len(own)
    )


def _noise_of(
    start: CalibrationNoise, error: np.ndarray, driven: np.ndarray, match_cov: np.ndarray
) -> CalibrationNoise:
    """The noise of greatest probability, of errors (N, 3)."""
    typical, nu = np.log(np.concatenate(CalibrationNoise.typical())), DEGREES_OF_FREEDOM
    table = np.concatenate([error[..., None], np.tile(np.eye(3), (len(error), 1, 1))], axis=-1)
    ones = np.ones(len(driven))
    along = np.stack([driven[:, 0], driven[:, 1], 0 * ones, 0 * ones, ones, 0 * ones], axis=1)
    turn = np.stack([0 * ones, 0 * ones, driven[:, 0], driven[:, 1], 0 * ones, ones], axis=1)

    def noise(logs: np.ndarray) -> CalibrationNoise:
        return CalibrationNoise(np.exp(logs[:4]), np.exp(logs[4:]))

    def cost(logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative log posterior, and its gradient.

        Of log p, by an element q of the diagonal of C: (w (C^-1 e)^2 - C^-1) / 2.
        """
        whitened, log_det = whitened_errors(noise(logs), table, driven, match_cov)
        residual, root = whitened[..., 0], whitened[..., 1:]
        square = np.sum(residual**2, axis=-1)
        value = np.sum(log_det + (nu + 3) * np.log1p(square / nu)) / 2
        pull = np.einsum("nai,na->ni", root, residual)
        weight = (nu + 3) / (nu + square)
        slope = (np.sum(root**2, axis=1) - weight[:, None] * pull**2) / 2
        by_variance = along.T @ (slope[:, 0] + slope[:, 1]) + turn.T @ slope[:, 2]
        off = (logs - typical) / NOISE_LOG_STD
        gradient = by_variance * 2 * np.exp(2 * logs) + off / NOISE_LOG_STD
        return float(value + np.sum(off**2) / 2), gradient

    start_logs = np.log(np.concatenate(start))
    return noise(minimize(cost, start_logs, jac=True, method="L-BFGS-B").x)
