"""Tune Q and R by gradient descent on a loss of the filter.

Features are extracted once; each evaluation runs the filter on them and differentiates it. All
fields of `NoiseParams` are smooth and tuned, as logarithms. Data association is not smooth: it is
found anew at every evaluation, and the gradient is that of the filter with its matches held fixed.
Parameters that act on the matches alone, above all the probability of the association gate
(`AssociationSpec.gate`), have no gradient, and are not tuned here.
"""

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxslam.core.devices import DeviceMap
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.types import Array, as_count
from jaxslam.filtering import config as config_module
from jaxslam.filtering import slam_filter
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.tuning.inputs import as_params, check_alike, prepare
from jaxslam.tuning.losses import Loss, pose_nll
from jaxslam.tuning.optimizers import default_optimizer
from jaxslam.tuning.parameters import constrain, trainable_mask, unconstrain, unflatten_params
from jaxslam.tuning.tune_state import TuneResult as TuneResult
from jaxslam.tuning.tune_state import TuneState as TuneState
from jaxslam.tuning.tune_state import check_state, record, stalled
from jaxslam.tuning.tune_state import init as init
from jaxslam.tuning.tune_state import result as result

EPISODE_BATCH = 4  # episodes that a device differentiates together; bounds memory


def _value(config: Config, loss: Loss, theta: NoiseParams, episode: Episode) -> Array:
    """Loss () of one episode."""
    start = config_module.init(config.filter, episode.truth[0])
    measurements = measurements_of(episode)
    _, info = slam_filter.run_filter(config.filter, constrain(theta), start, measurements)
    return loss(info, episode)


def _value_and_gradient(
    config: Config, loss: Loss, theta: NoiseParams, episode: Episode
) -> tuple[Array, Array]:
    """Loss () of one episode and its gradient (P,) in the logarithms of the noise."""
    value, gradient = jax.value_and_grad(_value, argnums=2)(config, loss, theta, episode)
    return value, ravel_pytree(gradient)[0]


_VALUES = DeviceMap(_value, size=EPISODE_BATCH, static=2)
_GRADIENTS = DeviceMap(_value_and_gradient, size=EPISODE_BATCH, static=2)


def values(
    config: Config, params: NoiseParams, episodes: Episode, loss: Loss | str = pose_nll
) -> np.ndarray:
    """Loss (B,) float64 of each episode [B].

    Raises:
        ValueError: As `tune`.
    """
    params, stacked, function = prepare(config, params, episodes, loss)
    return np.asarray(_VALUES(config, function, unconstrain(params), stacked), np.float64)


def gradients(
    config: Config, params: NoiseParams, episodes: Episode, loss: Loss | str = pose_nll
) -> tuple[np.ndarray, np.ndarray]:
    """Loss (B,) of each episode and its gradient (B, P) in the logarithms of the noise, float64.

    Raises:
        ValueError: As `tune`.
    """
    params, stacked, function = prepare(config, params, episodes, loss)
    value, gradient = _GRADIENTS(config, function, unconstrain(params), stacked)
    return np.asarray(value, np.float64), np.asarray(gradient, np.float64)


def mean_gradient(values: np.ndarray, each: np.ndarray) -> tuple[float, np.ndarray, int]:
    """Means of losses (B,) and gradients (B, P) over the episodes where both are finite.

    Returns:
        Mean loss, NaN if no episode is left; mean gradient (P,), 0 if none is left; number of
        episodes left out.
    """
    good = np.isfinite(values) & np.isfinite(each).all(axis=1)
    if not good.any():
        return np.nan, np.zeros(each.shape[1]), len(good)
    return values[good].mean(), each[good].mean(axis=0), int(np.sum(~good))


def draw_batch(seed: int, step: int, num_episodes: int, batch_size: int) -> np.ndarray:
    """Minibatch of a step: sorted numbers (batch_size,) of episodes, drawn without replacement.

    Steps take the next `batch_size` numbers of a sequence of permutations of all episodes, one for
    each epoch, which depend on the seed alone: a step can be drawn without the steps before it.
    """
    position = step * batch_size + np.arange(batch_size)
    epoch, offset = (position // num_episodes).tolist(), (position % num_episodes).tolist()
    order = {e: np.random.default_rng([seed, e]).permutation(num_episodes) for e in set(epoch)}
    return np.sort([order[e][k] for e, k in zip(epoch, offset, strict=True)])


def tune(
    config: Config,
    params: NoiseParams,
    episodes: Episode | list[Episode],
    *,
    loss: Loss | str = pose_nll,
    optimizer: optax.GradientTransformation | None = None,
    num_updates: int = 30,
    batch_size: int | None = None,
    seed: int = 0,
    frozen: Collection[str] = (),
    heldout: Episode | list[Episode] | None = None,
    evaluate_every: int = 1,
    patience: int | None = None,
    state: TuneState | None = None,
    callback: Callable[[TuneState], Any] | None = None,
) -> TuneResult:
    """Tune the noise on episodes by gradient descent.

        for step in 0 .. num_updates:
            loss, gradient = mean over the episodes of this step (all, or a minibatch)
            if it is due: heldout = mean loss over the held-out episodes
            record them
            theta <- theta + update of the optimiser, free parameters only
            call `callback` with the state
            stop if the last `patience` values of heldout are no better than one before

    The update after the last evaluation is part of the state but not of the result.

    Args:
        config: Its filter is the one that is tuned.
        params: Where to start.
        episodes: [B] training episodes, or a list of single ones.
        loss: Its mean over episodes is minimised; one of `losses`, also by its name, or any
            function of the step infos of the filter on an episode, and the episode.
        optimizer: Of the logarithms of the free parameters; `optimizers.default_optimizer` by
            default.
        num_updates: Number of updates.
        batch_size: Episodes of a minibatch; all of them by default.
        seed: Of the order of minibatches.
        frozen: Names of parameters, or fields of the noise, that are not tuned.
        heldout: [H] episodes for validation, which nothing is tuned on.
        evaluate_every: Evaluations from one validation to the next.
        patience: Validations without improvement after which it stops; by default it does not.
        state: State of an earlier call with the same arguments, to continue from; the result is
            the same as without the interruption.
        callback: Called with the state after each evaluation.

    Returns:
        The result. Its noise is the best: on the held-out episodes if there are any, else on all
        training episodes; with minibatches and no held-out episodes, whose losses are not
        comparable, the last.

    Raises:
        ValueError: Before anything is compiled: an argument has another type; a field of the noise
            or of an episode another shape or kind; the noise is not finite and positive; there are
            no episodes; the loss needs ground truth and an episode has none; scan matches are
            given, and no `scan_match_std_scale`; held-out episodes have other fields; a
            parameter's name is unknown; a number is out of range; the state is of another call.
    """
    params, training, function = prepare(config, params, episodes, loss)
    params = as_params(params)
    validation = None
    if heldout is not None:
        validation = prepare(config, params, heldout, loss, name="heldout")[1]
        check_alike(training, validation)
    num_updates = as_count("num_updates", num_updates, least=0)
    seed = as_count("seed", seed, least=0)
    as_count("evaluate_every", evaluate_every)
    as_count("patience", 1 if patience is None else patience)
    trainable, count = trainable_mask(params, frozen), training.odometry.shape[0]
    size = count if batch_size is None else min(count, as_count("batch_size", batch_size))
    whole = size == count
    if optimizer is None:
        optimizer = default_optimizer(num_updates, whole=whole)
    optimizer = optax.with_extra_args_support(optimizer)
    if state is None:
        state = init(params, num_updates=num_updates, frozen=frozen, optimizer=optimizer)
    check_state(state, trainable.size, num_updates)

    while state.step <= num_updates and not stalled(state, patience):
        current, step = unflatten_params(state.theta, params), int(state.step)
        batch = training if whole else _take(draw_batch(seed, step, count, size), training)
        value, gradient, skipped = mean_gradient(*gradients(config, current, batch, function))
        heldout_loss = np.nan
        if validation is not None and (step % evaluate_every == 0 or step == num_updates):
            heldout_loss = _finite_mean(values(config, current, validation, function))
        state = record(state, value, heldout_loss, skipped)
        state = _update_theta(state, optimizer, value, gradient, trainable)
        if callback is not None:
            callback(state)
    return result(state, params, whole=whole)


def _update_theta(
    state: TuneState, optimizer: Any, value: float, gradient: np.ndarray, trainable: np.ndarray
) -> TuneState:
    """Update the trainable parameters (P,) bool by the optimiser."""
    theta = jnp.asarray(state.theta[trainable])
    slope = jnp.asarray(gradient[trainable], theta.dtype)
    with jax.numpy_dtype_promotion("standard"):  # optax needs it
        loss = jnp.asarray(value, theta.dtype)
        change, inner = _optimizer_update(optimizer, slope, state.optimizer_state, theta, loss)
    updated = state.theta.copy()
    updated[trainable] += np.asarray(change, np.float64)
    return state._replace(theta=updated, optimizer_state=inner)


@partial(jax.jit, static_argnums=0)
def _optimizer_update(
    optimizer: Any, gradient: Array, state: Any, theta: Array, value: Array
) -> tuple[Array, Any]:
    return optimizer.update(gradient, state, theta, value=value)


def _take(indices: np.ndarray, episodes: Episode) -> Episode:
    """Some of the episodes, by number."""
    return jax.tree.map(lambda x: x[indices], episodes)


def _finite_mean(values: np.ndarray) -> float:
    good = np.isfinite(values)
    return values[good].mean() if good.any() else np.nan
