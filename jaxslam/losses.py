"""What is to be small: losses of one filtered run, for `fit.tune`.

A loss takes the info of a filtered run and its log, and returns a number (). Any function that
does so will do; these are the usual ones.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.linalg import inverse_root
from jaxslam.metrics import pose_error
from jaxslam.monte_carlo import Log
from jaxslam.slam import Info
from jaxslam.types import Array

Loss = Callable[[Info, Log], Array]

HEADING = 1.0  # [m^2 / rad^2] what a squared heading error weighs beside a squared position error
CERTAIN = 1e-12  # trace of the covariance of a pose that is known for certain, as the first is


def localisation(info: Info, log: Log) -> Array:
    """Mean squared position error [m^2], and heading error weighed by `HEADING`; needs truth.

    A common factor on all noise leaves the filter's gains as they are: this loss finds the ratios
    of the noise, not its size.
    """
    error = pose_error(info.pose, log.truth)
    square = jnp.sum(error[:, :2] ** 2, axis=1) + HEADING * error[:, 2] ** 2
    return _mean(square, _judged(log))


def likelihood(info: Info, log: Log) -> Array:
    """Negative log-likelihood [nats] of the innovations, per number observed; needs no truth.

    Matches decide what is observed: the likelihood of different matches does not compare.
    """
    count = jnp.maximum(jnp.sum(info.dof), 1).astype(info.nis.dtype)
    return -jnp.sum(info.log_likelihood) / count


def calibrated(info: Info, log: Log) -> Array:
    """Negative log-density [nats] of the true pose under the belief, mean over steps; needs truth.

        (e^T P^-1 e + log det P) / 2

    Of all P that differ by a factor the best is that with NEES at its expected value, and of all
    that have it the one with the smallest error: localisation, with NEES held where it belongs.

    References:
        Gneiting, Raftery (2007), "Strictly proper scoring rules": the logarithmic score.
    """
    error = pose_error(info.pose, log.truth)
    unsure = jnp.trace(info.pose_cov, axis1=1, axis2=2) > CERTAIN
    eye = jnp.eye(3, dtype=error.dtype)
    safe = jnp.where(unsure[:, None, None], info.pose_cov, eye)
    root, logdet, good = jax.vmap(inverse_root)(safe)
    square = jnp.sum(jnp.einsum("tij,tj->ti", root, error) ** 2, axis=1)
    return _mean((square + logdet) / 2, _judged(log) & unsure & good)


class Weighted(NamedTuple):
    """A weighted sum of losses; itself a loss."""

    parts: tuple[tuple[float, Loss], ...]  # weight and loss

    def __call__(self, info: Info, log: Log) -> Array:
        """The sum."""
        return sum(weight * loss(info, log) for weight, loss in self.parts)


BY_NAME = {f.__name__: f for f in (localisation, likelihood, calibrated)}


def needs_truth(loss: Loss) -> bool:
    """Whether a loss of this module, or a sum of them, needs to know where the robot was."""
    if isinstance(loss, Weighted):
        return any(needs_truth(part) for _, part in loss.parts)
    return loss in (localisation, calibrated)


def check(loss: Loss, logs: Log, *, what: str = "logs") -> None:
    """Raise ValueError where a loss cannot be had of runs [B], before any work starts.

    Raises:
        ValueError: There are no runs, or one has no truth and the loss needs it.
    """
    if not logs.motion.shape[0]:
        raise ValueError(f"{what}: no runs to tune on")
    if needs_truth(loss) and logs.judged is not None:
        blind = np.flatnonzero(~np.asarray(logs.judged).any(axis=1))
        if blind.size:
            raise ValueError(
                f"{what}: run {blind[0]} has no reference, which this loss needs; "
                "give one, or use the likelihood"
            )


def _judged(log: Log) -> Array:
    """Steps (T,) bool whose truth is known."""
    return jnp.ones(len(log.truth), bool) if log.judged is None else log.judged


def _mean(x: Array, use: Array) -> Array:
    """Mean () of the numbers (T,) that are used; 0 of none."""
    return jnp.sum(jnp.where(use, x, 0.0)) / jnp.maximum(jnp.sum(use), 1).astype(x.dtype)
