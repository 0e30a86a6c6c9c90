"""What is left between calibrated wheels and scan matching: its density, and noise of it.

The density is that of `odometry_calibration`; the noise (a, b) of greatest probability is found
by L-BFGS.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from jaxslam.matching.odometry_fusion import DEGREES_OF_FREEDOM

NOISE_LOG_STD = 1.0
"""Standard deviation of the logarithm of each number of the noise, before any drive."""


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


def log_prior(noise: CalibrationNoise) -> float:
    """Log density of a noise before any drive, but for a constant."""
    typical = np.concatenate(CalibrationNoise.typical())
    off = np.log(np.concatenate(noise) / typical) / NOISE_LOG_STD
    return float(-np.sum(off**2) / 2)


def fit_noise(
    start: CalibrationNoise, error: np.ndarray, driven: np.ndarray, match_cov: np.ndarray
) -> CalibrationNoise:
    """The noise of greatest probability.

    Args:
        start: To start from.
        error: (N, 3) [m, m, rad].
        driven: (N, 2) as of `whitened_errors`.
        match_cov: (N, 3, 3).
    """
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
