"""What is tuned: a model, its loss, parameters and data, checked before anything is compiled."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.episode import Episode
from jaxslam.pipeline.config import Config
from jaxslam.tuning import parameters
from jaxslam.tuning.inputs import check_alike
from jaxslam.tuning.losses import Loss, check_loss, default_loss, model_for, resolve
from jaxslam.tuning.model import Model
from jaxslam.tuning.model_checks import check_model
from jaxslam.tuning.slam_model import SlamCheck, as_model
from jaxslam.tuning.transforms import Transform, of_leaves

NOT_FINITE = (
    "look for numbers in the data that are not finite or too large, covariances that are not "
    "positive definite, and parameters to start from that are far off"
)


class StartError(ValueError):
    """There is nothing to minimise where a tuning starts; known after the first evaluation."""


class Problem(NamedTuple):
    """What is tuned, checked.

    Attributes:
        model: The model.
        loss: The loss.
        transforms: Of each leaf of the parameters.
        params: The parameters as arrays.
        data: [B] sequences as arrays.
        theta: (P,) the unconstrained numbers to evaluate it at; None for those of `params`. Near
            the edge of a domain they say more than parameters of single precision.
    """

    model: Model
    loss: Loss
    transforms: tuple[Transform, ...]
    params: Any
    data: Any
    theta: np.ndarray | None = None


def prepare(
    model: Model | Config,
    params: Any,
    data: Any,
    loss: Loss | str | None = None,
    *,
    transforms: Any = None,
    name: str | None = None,
    like: Any = None,
) -> Problem:
    """The arguments of `tune`, checked and converted; ValueError unless all fits together.

    Args:
        model: The model.
        params: Its parameters.
        data: [B] sequences.
        loss: The loss; None for the default one.
        transforms: Of the parameters.
        name: What the data are called in messages; by default episodes, where they are such.
        like: Sequences that are tuned on, where the data are those held out.
    """
    model = as_model(model)
    if name is None:
        is_slam = isinstance(model.check, SlamCheck) or isinstance(data, Episode)
        name = "episodes" if is_slam else "data"
    params, stacked = model.check(params, data, name)
    if like is not None:
        check_alike(like, stacked)
    used = of_leaves(params, transforms)
    arrays = parameters.as_params(params, transforms)
    if not isinstance(stacked, Episode):  # the filter's functions fit, and take long to trace
        check_model(model, arrays, jax.tree.map(lambda x: x[0], stacked))
    function = default_loss(stacked) if loss is None else resolve(loss)
    check_loss(function, stacked, name=name)
    return Problem(model_for(function, model), function, used, arrays, stacked)


def check_start(
    values: np.ndarray, each: np.ndarray, trainable: np.ndarray, *, alone: bool = True
) -> None:
    """Raise StartError unless there is something to minimise where the tuning starts.

    Args:
        values: (B,) losses.
        each: (B, P) gradients.
        trainable: (P,) bool, which parameters are tuned.
        alone: Whether nothing but the data says what the parameters are.
    """
    good = np.isfinite(values) & np.isfinite(each).all(axis=1)
    if not good.any():
        raise StartError(
            f"the loss and gradient of none of {len(good)} sequences are finite; {NOT_FINITE}"
        )
    if alone and not each[good][:, trainable].any():
        raise StartError(
            "the loss depends on no parameter that is tuned: its gradient is 0; is there anything "
            "in the data that the loss compares, and does the model use its parameters?"
        )
