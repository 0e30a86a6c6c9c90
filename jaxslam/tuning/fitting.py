"""Tune the parameters of a model by gradient descent on a loss.

A model is any state-space model (`model.Model`), its parameters any tree of numbers; the SLAM
filter with its Q and R is one (`slam_model`), and a `Config` stands for it. Each evaluation runs
the model over the sequences and differentiates it by the unconstrained numbers that make its
parameters (`transforms`).

Data association of the SLAM filter is not smooth: it is found anew at every evaluation, and the
gradient is that of the filter with its matches held fixed. Parameters that act on the matches
alone, above all the probability of the association gate (`AssociationSpec.gate`), have no gradient,
and are not tuned here.
"""

from collections.abc import Callable, Collection
from functools import cache, partial
from typing import Any

import jax
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxslam.core.batching import BatchSize, on_device
from jaxslam.core.devices import DeviceMap
from jaxslam.core.types import Array, as_count
from jaxslam.pipeline.config import Config
from jaxslam.tuning.losses import Loss, call_loss
from jaxslam.tuning.model import Model, num_steps, run_model
from jaxslam.tuning.optimizers import check_optimizer, default_optimizer
from jaxslam.tuning.parameters import constrain, theta_tree, trainable_mask, unconstrain
from jaxslam.tuning.parameters import unflatten_params as unflatten_params
from jaxslam.tuning.priors import FlatPrior, flatten_prior
from jaxslam.tuning.problem import NOT_FINITE, StartError, check_start
from jaxslam.tuning.problem import Problem as Problem
from jaxslam.tuning.problem import as_model as as_model
from jaxslam.tuning.problem import prepare as prepare
from jaxslam.tuning.sequences import (
    draw_batch,
    finite_mean,
    joined,
    mean_gradient,
    take,
    total_steps,
)
from jaxslam.tuning.transforms import Transform
from jaxslam.tuning.tune_state import TuneResult as TuneResult
from jaxslam.tuning.tune_state import TuneState as TuneState
from jaxslam.tuning.tune_state import check_loss_of_state, check_state, record, stalled
from jaxslam.tuning.tune_state import init as init
from jaxslam.tuning.tune_state import result as result

Transforms = tuple[Transform, ...]

QUICK_STEPS = 20_000
"""Steps of all sequences up to which gradients are compiled in two thirds of the time, and run a
seventh slower. Values are not: without a gradient the filter would run three times slower."""

TOGETHER_STEPS = 50_000
"""Steps of all validations up to which they are evaluated with the gradients, by the same program:
a gradient that nobody asks for then takes less time than compiling values alone."""


def _value(model: Model, loss: Loss, transforms: Transforms, theta: Any, sequence: Any) -> Array:
    """Loss () of one sequence."""
    _, info = run_model(model, constrain(theta, transforms), sequence)
    return call_loss(loss, info, sequence)


def value_and_gradient(
    model: Model, loss: Loss, transforms: Transforms, theta: Any, sequence: Any
) -> tuple[Array, Array]:
    """Loss () of one sequence and its gradient (P,) in the unconstrained numbers; not jitted.

    Args:
        model: The model.
        loss: The loss.
        transforms: Of each leaf of the parameters.
        theta: The unconstrained numbers, as of `parameters.theta_tree`.
        sequence: One sequence.
    """
    differentiated = jax.value_and_grad(_value, argnums=3)
    value, gradient = differentiated(model, loss, transforms, theta, sequence)
    return value, ravel_pytree(gradient)[0]


@cache
def _over_devices(
    function: Callable[..., Any], batch_size: int | BatchSize, quickly: bool
) -> DeviceMap:
    """A function of one sequence over many; the same object for the same arguments."""
    return DeviceMap(function, size=batch_size, static=3, compile_quickly=quickly)


def _evaluate(function: Callable[..., Any], problem: Problem) -> Any:
    """`_value` or `value_and_gradient` of all sequences of a problem."""
    model, loss, transforms, params, data, theta = problem
    quickly = function is value_and_gradient and total_steps(data) <= QUICK_STEPS
    run = _over_devices(function, model.batch_size, quickly)
    if theta is None:
        return run(model, loss, transforms, unconstrain(params, transforms), data)
    return run(model, loss, transforms, theta_tree(theta, params, transforms), data)


def values(
    model: Model | Config,
    params: Any,
    data: Any,
    loss: Loss | str | None = None,
    *,
    transforms: Any = None,
) -> np.ndarray:
    """Loss (B,) float64 of each sequence of data [B].

    Raises:
        ValueError: As `tune`.
    """
    return values_of(prepare(model, params, data, loss, transforms=transforms))


def values_of(problem: Problem) -> np.ndarray:
    """`values` of a problem that is checked."""
    return np.asarray(_evaluate(_value, problem), np.float64)


def gradients(
    model: Model | Config,
    params: Any,
    data: Any,
    loss: Loss | str | None = None,
    *,
    transforms: Any = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Loss (B,) of each sequence and its gradient (B, P) in the unconstrained numbers, float64.

    Raises:
        ValueError: As `tune`.
    """
    return gradients_of(prepare(model, params, data, loss, transforms=transforms))


def gradients_of(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """`gradients` of a problem that is checked."""
    value, gradient = _evaluate(value_and_gradient, problem)
    return np.asarray(value, np.float64), np.asarray(gradient, np.float64)


def tune(
    model: Model | Config,
    params: Any,
    data: Any,
    *,
    loss: Loss | str | None = None,
    transforms: Any = None,
    prior: Any = None,
    optimizer: optax.GradientTransformation | None = None,
    num_updates: int = 30,
    batch_size: int | None = None,
    seed: int = 0,
    frozen: Collection[str] = (),
    heldout: Any = None,
    evaluate_every: int = 1,
    patience: int | None = None,
    state: TuneState | None = None,
    callback: Callable[[TuneState], Any] | None = None,
) -> TuneResult:
    """Tune the parameters of a model on data by gradient descent.

        for step in 0 .. num_updates:
            loss, gradient = mean over the sequences of this step (all, or a minibatch), and prior
            if it is due: heldout = mean loss over the held-out sequences
            record them
            theta <- theta + update of the optimiser, free parameters only
            call `callback` with the state
            stop if the last `patience` values of heldout are no better than one before

    The update after the last evaluation is part of the state but not of the result.

    Args:
        model: The model; a `Config` stands for the SLAM filter that it configures.
        params: Where to start: any tree of numbers; of the SLAM filter `NoiseParams`.
        data: [B] training sequences in any tree; of the SLAM filter episodes, or a list of them.
        loss: Its mean over sequences is minimised; one of `losses`, also by its name, or any
            function of what the steps of the model returned on a sequence, and the sequence.
            By default `pose_nll` where there are true poses, else `innovation_nll`.
        transforms: Of the parameters, in a tree like theirs, each for all below it; by default
            `transforms.default_transforms`.
        prior: `priors.Prior`s in a tree like the parameters, None where there is none. Their
            negative log density is divided by B and the number of steps T and added to the loss,
            as the losses here are means over steps.
        optimizer: Of the unconstrained numbers of the free parameters;
            `optimizers.default_optimizer` by default.
        num_updates: Number of updates.
        batch_size: Sequences of a minibatch; all of them by default.
        seed: Of the order of minibatches.
        frozen: Names of parameters, or of what they are part of, that are not tuned.
        heldout: [H] sequences for validation, which nothing is tuned on.
        evaluate_every: Evaluations from one validation to the next.
        patience: Validations without improvement after which it stops; by default it does not.
        state: State of an earlier call with the same arguments, to continue from; the result is
            the same as without the interruption.
        callback: Called with the state after each evaluation.

    Returns:
        The result. Its parameters are the best: on the held-out sequences if there are any, else
        on all training sequences; with minibatches and no held-out sequences, whose losses are not
        comparable, the last.

    Raises:
        ValueError: Before anything is compiled: an argument has another type; a parameter is
            outside the domain of its transform; the data do not fit the model; a step of the model
            returns another state than it is given; there are no data; the loss is no number, or
            needs ground truth and an episode has none; held-out sequences have other fields; a
            parameter's name is unknown; a number is out of range; the state is of another call.
            After the first evaluation: the loss of no sequence is finite, or it depends on no
            parameter that is tuned, or it is another than that of the state.
    """
    problem = prepare(model, params, data, loss, transforms=transforms)
    model, used_loss, _, params, training, _ = problem
    validation = None
    if heldout is not None:
        validation = prepare(
            model, params, heldout, used_loss, transforms=transforms, name="heldout", like=training
        ).data
    elif patience is not None:
        raise ValueError(f"patience is {patience}, but there is no heldout to validate on")
    if callback is not None and not callable(callback):
        raise ValueError(f"callback is {callback!r}, not a function of the state")
    num_updates = as_count("num_updates", num_updates, least=0)
    seed = as_count("seed", seed, least=0)
    as_count("evaluate_every", evaluate_every)
    as_count("patience", 1 if patience is None else patience)
    trainable = trainable_mask(params, frozen, transforms)
    count = len(jax.tree.leaves(training)[0])
    size = count if batch_size is None else min(count, as_count("batch_size", batch_size))
    whole = size == count
    penalty = flatten_prior(prior, params, transforms)
    weight = 1.0 / (count * num_steps(model, params, training))
    if optimizer is None:
        optimizer = default_optimizer(num_updates, whole=whole)
    optimizer = check_optimizer(optimizer, int(trainable.sum()))
    start = init(
        params, num_updates=num_updates, frozen=frozen, optimizer=optimizer, transforms=transforms
    )

    together = None
    if validation is not None and evaluate_every == 1:
        if (num_updates + 1) * total_steps(validation) <= TOGETHER_STEPS:
            together = joined(training, validation)
    last = count + np.arange(0 if together is None else len(jax.tree.leaves(validation)[0]))

    def evaluate(theta: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Losses and gradients of the sequences of a step, and of those validated with them."""
        batch = training if together is None else together
        if not whole:
            batch = take(np.append(draw_batch(seed, step, count, size), last), batch)
        current = unflatten_params(theta, params, transforms)
        return gradients_of(problem._replace(params=current, data=batch, theta=theta))

    if state is None:
        state = start
    else:
        check_state(state, start)
        first = state.theta_history[0]
        losses, slopes = evaluate(first, 0)
        value, gradient, _ = mean_gradient(losses[:size], slopes[:size])
        own = _with_prior(value, gradient, penalty, weight, first)[0]
        check_loss_of_state(state, own, finite_mean(np.abs(losses[:size])))

    while state.step <= num_updates and not stalled(state, patience):
        step = int(state.step)
        losses, slopes = evaluate(state.theta, step)
        each = losses[:size], slopes[:size]
        if whole and step == 0:
            check_start(*each, trainable, alone=num_updates > 0 and not penalty.precision.any())
        value, gradient, skipped = mean_gradient(*each)
        value, gradient = _with_prior(value, gradient, penalty, weight, state.theta)
        heldout_loss = np.nan
        if validation is not None and (step % evaluate_every == 0 or step == num_updates):
            if together is None:
                current = unflatten_params(state.theta, params, transforms)
                now = problem._replace(params=current, data=validation, theta=state.theta)
                heldout_loss = finite_mean(values_of(now))
            else:
                heldout_loss = finite_mean(losses[size:])
            if step == 0 and not np.isfinite(heldout_loss):
                raise StartError(f"heldout: the loss of no sequence is finite; {NOT_FINITE}")
        state = record(state, value, heldout_loss, skipped)
        state = _update_theta(state, optimizer, value, gradient, trainable)
        if callback is not None:
            callback(state)
    return result(state, params, whole=whole, transforms=transforms)


def _with_prior(
    value: float, gradient: np.ndarray, prior: FlatPrior, weight: float, theta: np.ndarray
) -> tuple[float, np.ndarray]:
    """Loss and gradient (P,) with the prior's, which counts as `weight` of it."""
    own, slope = prior.value_and_gradient(theta)
    return value + weight * own, gradient + weight * slope


def _update_theta(
    state: TuneState, optimizer: Any, value: float, gradient: np.ndarray, trainable: np.ndarray
) -> TuneState:
    """Update the trainable parameters (P,) bool by the optimiser."""
    theta, slope, loss = on_device((state.theta[trainable], gradient[trainable], value))
    with jax.numpy_dtype_promotion("standard"):  # optax needs it
        change, inner = _optimizer_update(optimizer, slope, state.optimizer_state, theta, loss)
    updated = state.theta.copy()
    updated[trainable] += np.asarray(change, np.float64)
    return state._replace(theta=updated, optimizer_state=inner)


@partial(jax.jit, static_argnums=0)
def _optimizer_update(
    optimizer: Any, gradient: Array, state: Any, theta: Array, value: Array
) -> tuple[Array, Any]:
    return optimizer.update(gradient, state, theta, value=value)
