"""Losses for tuning Q and R by gradient: each is evaluated on one drive.

A loss takes the step infos [T] of the filter and its log, and returns a number (). `fit.tune`
takes any function that does so; these are the usual ones.
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

HEADING = 1.0  # [m^2 / rad^2] weight of a squared heading error, relative to a squared position
CERTAIN = 1e-12  # trace of the covariance below which a pose is known exactly, as the first is


def localisation(info: Info, log: Log) -> Array:
    """Mean squared position error [m^2] plus `HEADING` times squared heading error; needs truth.

    A common factor on all of Q and R leaves the filter's gains unchanged: this loss determines
    the ratios of the noise parameters, not their scale.
    """
    error = pose_error(info.pose, log.truth)
    square = jnp.sum(error[:, :2] ** 2, axis=1) + HEADING * error[:, 2] ** 2
    return _mean(square, _truth_mask(log))


def likelihood(info: Info, log: Log) -> Array:
    """Negative log-likelihood [nats] of the innovations, per scalar measurement; no truth needed.

    Data association decides which measurements enter: values under different associations are not
    comparable.
    """
    count = jnp.maximum(jnp.sum(info.dof), 1).astype(info.nis.dtype)
    return -jnp.sum(info.log_likelihood) / count


def calibrated(info: Info, log: Log) -> Array:
    """Negative log-density [nats] of the true pose under the estimate, mean over scans.

        (e^T P^-1 e + log det P) / 2

    without the constant. It needs truth. If only the scale of P is free, it is least where NEES
    has its expected value; among filters with that NEES it is least for the smallest det P, and
    so for the smallest errors. It rewards accuracy and consistency together.

    References:
        Gneiting, Raftery (2007), "Strictly proper scoring rules": the logarithmic score.
    """
    error = pose_error(info.pose, log.truth)
    uncertain = jnp.trace(info.pose_cov, axis1=1, axis2=2) > CERTAIN
    eye = jnp.eye(3, dtype=error.dtype)
    safe = jnp.where(uncertain[:, None, None], info.pose_cov, eye)
    root, logdet, good = jax.vmap(inverse_root)(safe)
    square = jnp.sum(jnp.einsum("tij,tj->ti", root, error) ** 2, axis=1)
    return _mean((square + logdet) / 2, _truth_mask(log) & uncertain & good)


class Weighted(NamedTuple):
    """A weighted sum of losses; itself a loss.

    Attributes:
        parts: Weight and loss of each term.
    """

    parts: tuple[tuple[float, Loss], ...]

    def __call__(self, info: Info, log: Log) -> Array:
        """The weighted sum ()."""
        return sum(weight * loss(info, log) for weight, loss in self.parts)


BY_NAME = {f.__name__: f for f in (localisation, likelihood, calibrated)}


def needs_truth(loss: Loss) -> bool:
    """Whether a loss of this module, or a sum of them, needs ground truth."""
    if isinstance(loss, Weighted):
        return any(needs_truth(term) for _, term in loss.parts)
    return loss in (localisation, calibrated)


def check(loss: Loss, logs: Log, *, what: str = "logs") -> None:
    """Check, before any work starts, that a loss can be evaluated on logs [B].

    Args:
        loss: The loss.
        logs: [B] drives.
        what: What the logs are called in the error message.

    Raises:
        ValueError: There are no logs, or one has no ground truth and the loss needs it.
    """
    if not logs.motion.shape[0]:
        raise ValueError(f"{what}: no runs to tune on")
    if needs_truth(loss) and logs.judged is not None:
        missing = np.flatnonzero(~np.asarray(logs.judged).any(axis=1))
        if missing.size:
            raise ValueError(
                f"{what}: run {missing[0]} has no reference, which this loss needs; "
                "give one, or use the likelihood"
            )


def _truth_mask(log: Log) -> Array:
    """Scans (T,) bool with ground truth."""
    return jnp.ones(len(log.truth), bool) if log.judged is None else log.judged


def _mean(values: Array, mask: Array) -> Array:
    """Mean () of the values (T,) whose mask is True; 0 if there are none."""
    count = jnp.maximum(jnp.sum(mask), 1).astype(values.dtype)
    return jnp.sum(jnp.where(mask, values, 0.0)) / count
