"""Losses for tuning Q and R by gradient: each is evaluated on one episode.

A loss takes the step infos [T] of the filter and the episode that it ran on, and returns a number
(). `fitting.tune` takes any function that does so; these are the usual ones, and those of
`prediction`, which run the filter a second time. All are minimised.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.episode import Episode
from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.types import Array
from jaxslam.evaluation.consistency import CERTAIN_TRACE, pose_error
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.tuning.model import Model
from jaxslam.tuning.model_checks import called, check_hashable
from jaxslam.tuning.prediction import (
    Comparison,
    Memories,
    NisConsistency,
    closure_nll,
    prediction_nll,
    run_twice,
)

Loss = Callable[[Any, Any], Array]

# [m^2 / rad^2] weight of a squared heading error, relative to a squared position error
HEADING_WEIGHT = 1.0


def pose_mse(info: StepInfo, episode: Episode) -> Array:
    """Mean squared error [m^2] of the position, plus `HEADING_WEIGHT` times that of the heading.

    It needs truth.

    A common factor on all of Q and R leaves the filter's gains unchanged: this loss determines
    the ratios of the noise parameters, not their scale.
    """
    error = pose_error(info.pose, episode.truth)
    square = jnp.sum(error[:, :2] ** 2, axis=1) + HEADING_WEIGHT * error[:, 2] ** 2
    return _mean(square, _truth_mask(episode))


def innovation_nll(info: StepInfo, episode: Episode) -> Array:
    """Negative log-likelihood [nats] of the innovations, per scalar measurement; no truth needed.

    Data association decides which measurements enter: values under different associations are not
    comparable.
    """
    count = jnp.maximum(jnp.sum(info.dof), 1).astype(info.nis.dtype)
    return -jnp.sum(info.log_likelihood) / count


def pose_nll(info: StepInfo, episode: Episode) -> Array:
    """Negative log-density [nats] of the true pose under the estimate, mean over scans.

        (e^T P^-1 e + log det P) / 2

    without the constant. It needs truth. If only the scale of P is free, it is least where NEES
    has its expected value; among filters with that NEES it is least for the smallest det P, and
    so for the smallest errors. It rewards accuracy and consistency together.

    References:
        Gneiting, Raftery (2007), "Strictly proper scoring rules": the logarithmic score.
    """
    error = pose_error(info.pose, episode.truth)
    uncertain = jnp.trace(info.pose_cov, axis1=1, axis2=2) > CERTAIN_TRACE
    eye = jnp.eye(3, dtype=error.dtype)
    safe = jnp.where(uncertain[:, None, None], info.pose_cov, eye)
    root, logdet, good = jax.vmap(inverse_cholesky)(safe)
    square = jnp.sum(jnp.einsum("tij,tj->ti", root, error) ** 2, axis=1)
    return _mean((square + logdet) / 2, _truth_mask(episode) & uncertain & good)


class WeightedLoss(NamedTuple):
    """A weighted sum of losses; itself a loss.

    Attributes:
        terms: Weight and loss of each term; one at least.
    """

    terms: tuple[tuple[float, Loss], ...]

    def __call__(self, info: StepInfo | Memories, episode: Episode) -> Array:
        """The weighted sum ()."""
        first, *rest = [weight * self._term(loss, info, episode) for weight, loss in self.terms]
        return sum(rest, start=first)

    @staticmethod
    def _term(loss: Loss, info: StepInfo | Memories, episode: Episode) -> Array:
        """A term (); what needs no comparison of memories is of the whole memory."""
        if isinstance(info, Memories) and not isinstance(loss, Comparison):
            info = info.whole
        return loss(info, episode)


BY_NAME: Mapping[str, Any] = MappingProxyType(  # of Loss, which mypy does not see in NamedTuples
    {
        "pose_nll": pose_nll,
        "pose_mse": pose_mse,
        "innovation_nll": innovation_nll,
        "prediction_nll": prediction_nll,
        "closure_nll": closure_nll,
    }
)
"""The losses by name, as `jaxslam tune --loss` takes them."""


def resolve(loss: Loss | str) -> Loss:
    """A loss itself, or that of `BY_NAME` with a name.

    Raises:
        ValueError: There is none of this name.
    """
    if isinstance(loss, str) and loss not in BY_NAME:
        raise ValueError(f"loss is {loss!r}; known names are {', '.join(BY_NAME)}")
    return BY_NAME[loss] if isinstance(loss, str) else loss


def name_of(loss: Loss) -> str:
    """Name of a loss of `BY_NAME`.

    Raises:
        ValueError: It is none of them.
    """
    for name, function in BY_NAME.items():
        if function is loss:
            return name
    raise ValueError(f"{loss!r} is none of {', '.join(BY_NAME)}")


def call_loss(loss: Loss, info: Any, sequence: Any) -> Array:
    """The loss () of a sequence; while tracing.

    Raises:
        ValueError: The loss fails, with the first line of its message, or is no float ().
    """
    name = f"loss {text_of(loss)}"
    try:
        value = called(f"{name} of infos and a sequence", loss, info, sequence)
    except ValueError as error:
        cause = error.__cause__
        if isinstance(cause, AttributeError) and cause.name and is_of_this_package(loss):
            raise ValueError(
                f"{name} needs {cause.name} in what the steps of the model return, which lacks it; "
                "give a loss of your own, a function of these and the sequence"
            ) from error
        raise
    shape, kind = np.shape(value), getattr(value, "dtype", np.result_type(type(value)))
    if shape or not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(f"{name} returns {kind} {shape} of a sequence, not one float ()")
    return value


def is_of_this_package(loss: Loss) -> bool:
    """Whether a loss, or all terms of a sum, are those of this package."""
    if isinstance(loss, WeightedLoss):
        return all(is_of_this_package(term) for _, term in loss.terms)
    return loss in BY_NAME.values() or isinstance(loss, Comparison | NisConsistency)


def text_of(loss: Any) -> str:
    """Name of a loss, for messages."""
    return getattr(loss, "__name__", None) or repr(loss)


def comparisons(loss: Loss) -> list[Comparison]:
    """The losses among the terms that compare a model with itself with less memory."""
    return [term for term in terms_of(loss) if isinstance(term, Comparison)]


def terms_of(loss: Loss) -> list[Loss]:
    """The losses of a sum, or a loss alone."""
    return [term for _, term in loss.terms] if isinstance(loss, WeightedLoss) else [loss]


def model_for(loss: Loss, model: Model) -> Model:
    """The model itself, or run twice where the loss compares it with itself with less memory."""
    return run_twice(model, found[0]) if (found := comparisons(loss)) else model


def default_loss(data: Any) -> Loss:
    """The loss that is minimised where none is named, by the data: `pose_nll` of episodes."""
    return pose_nll if isinstance(data, Episode) else innovation_nll


def needs_truth(loss: Loss) -> bool:
    """Whether a loss of this module, or a sum of them, needs ground truth."""
    if isinstance(loss, WeightedLoss):
        return any(needs_truth(term) for _, term in loss.terms)
    return loss in (pose_mse, pose_nll)


def check_loss(loss: Loss, data: Any, *, name: str = "episodes") -> None:
    """Check, before any work starts, that a loss can be evaluated on data [B].

    Args:
        loss: The loss.
        data: [B] sequences; episodes as `inputs.as_episodes` returns them.
        name: What they are called in the error message.

    Raises:
        ValueError: The loss is no function, or a sum without terms; there are no episodes, or
            none with a step; or one has no ground truth and the loss needs it, or nothing that
            the loss predicts.
    """
    if not callable(loss):
        named = f"losses.BY_NAME has {', '.join(BY_NAME)}"
        raise ValueError(f"loss is {loss!r}, not a function of step infos and an episode; {named}")
    if isinstance(loss, WeightedLoss):
        _check_terms(loss.terms)
    check_hashable("loss", loss)
    compared = comparisons(loss)
    if len(compared) > 1:
        raise ValueError("loss is a WeightedLoss of two losses that run the model twice; take one")
    if not isinstance(data, Episode):
        if needs_truth(loss):
            raise ValueError(f"loss {text_of(loss)} is of episodes, which {name} are not")
    else:
        _check_episodes(loss, data, name)
    for term in terms_of(loss):
        if isinstance(term, Comparison | NisConsistency):
            term.check(data, name)


def _check_terms(terms: Any) -> None:
    """Raise ValueError unless the terms of a `WeightedLoss` are weights and losses."""
    if isinstance(terms, tuple | list) and not terms:
        raise ValueError("loss is a WeightedLoss without terms")
    if not isinstance(terms, tuple) or not all(type(x) is tuple and len(x) == 2 for x in terms):
        raise ValueError(f"WeightedLoss.terms is {terms!r}, not a tuple of (weight, loss)")
    for weight, loss in terms:
        if not isinstance(weight, float | int | np.number) or not np.isfinite(weight):
            raise ValueError(f"WeightedLoss.terms holds the weight {weight!r}, not a finite number")
        if not callable(loss) or isinstance(loss, WeightedLoss):
            raise ValueError(f"WeightedLoss.terms holds {loss!r}, not a loss")


def _check_episodes(loss: Loss, data: Episode, name: str) -> None:
    """Raise ValueError if there are no episodes, or no ground truth that the loss needs."""
    if not np.size(data.odometry):
        raise ValueError(f"{name}: no episodes, or none with a step")
    if needs_truth(loss) and data.truth_mask is not None:
        missing = np.flatnonzero(~np.asarray(data.truth_mask).any(axis=1))
        if missing.size:
            raise ValueError(
                f"{name}: episode {missing[0]} has no reference, which this loss needs; give one, "
                "or use a loss that needs none, as losses.closure_nll"
            )


def _truth_mask(episode: Episode) -> Array:
    """Scans (T,) bool with ground truth."""
    if episode.truth_mask is None:
        return jnp.ones(len(episode.truth), bool)
    return episode.truth_mask


def _mean(values: Array, mask: Array) -> Array:
    """Mean () of the values (T,) whose mask is True; 0 if there are none."""
    count = jnp.maximum(jnp.sum(mask), 1).astype(values.dtype)
    return jnp.sum(jnp.where(mask, values, 0.0)) / count
