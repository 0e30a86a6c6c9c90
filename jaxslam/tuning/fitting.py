"""Tune Q and R by gradient descent on a loss of the filter.

Features are extracted once; each evaluation runs the filter on them and differentiates it. All
fields of `NoiseParams` are smooth and tuned, as logarithms. Data association is not smooth: it is found
anew at every evaluation, and the gradient is that of the filter with its matches held fixed.
Parameters that act on the matches alone, above all the probability of the association gate
(`AssociationSpec.gate`), have no gradient, and are not tuned here.
"""

from collections.abc import Callable, Collection
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxslam.core.devices import DeviceMap
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.types import Array
from jaxslam.filtering import config as config_module
from jaxslam.filtering import slam_filter
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.tuning import losses
from jaxslam.tuning.losses import Loss, pose_nll
from jaxslam.tuning.optimizers import default_optimizer
from jaxslam.tuning.parameters import constrain, trainable_mask, unconstrain, unflatten_params

EPISODE_BATCH = 4  # runs that a device differentiates together; bounds memory


class TuneState(NamedTuple):
    """State of a tuning, with all that it needs to continue. P parameters, N updates in all.

    Attributes:
        step: () int64 number of evaluations so far.
        theta: (P,) float64 logarithms of the noise to be evaluated next.
        optimizer_state: State of the optimiser, of the free parameters.
        theta_history: (N + 1, P) float64 logarithms that each evaluation used; NaN: not yet.
        loss: (N + 1,) float64 mean over the runs of each evaluation; NaN: not yet.
        heldout: (N + 1,) float64 mean over the held-out runs; NaN: not evaluated.
        skipped: (N + 1,) int64 runs left out of the mean because a value was not finite.
    """

    step: np.ndarray
    theta: np.ndarray
    optimizer_state: Any
    theta_history: np.ndarray
    loss: np.ndarray
    heldout: np.ndarray
    skipped: np.ndarray


class TuneResult(NamedTuple):
    """Result of `tune`. N evaluations: one more than updates, or fewer when it stopped early.

    Attributes:
        params: The best noise.
        best: Number of the evaluation it is from.
        loss: (N,) mean over the runs of each evaluation.
        heldout: (N,) mean over the held-out runs; NaN where not evaluated.
        history: [N] noise that each evaluation used.
        skipped: (N,) runs left out of the mean because a value was not finite.
    """

    params: NoiseParams
    best: int
    loss: np.ndarray
    heldout: np.ndarray
    history: NoiseParams
    skipped: np.ndarray


def _value(config: Config, loss: Loss, theta: NoiseParams, log: Episode) -> Array:
    """Loss () of one run."""
    start = config_module.init(config.filter, log.truth[0])
    _, info = slam_filter.run_filter(config.filter, constrain(theta), start, measurements_of(log))
    return loss(info, log)


def _value_and_gradient(
    config: Config, loss: Loss, theta: NoiseParams, log: Episode
) -> tuple[Array, Array]:
    """Loss () of one run and its gradient (P,) in the logarithms of the noise."""
    value, gradient = jax.value_and_grad(_value, argnums=2)(config, loss, theta, log)
    return value, ravel_pytree(gradient)[0]


_VALUES = DeviceMap(_value, size=EPISODE_BATCH, static=2)
_GRADIENTS = DeviceMap(_value_and_gradient, size=EPISODE_BATCH, static=2)


def values(
    config: Config, params: NoiseParams, episodes: Episode, loss: Loss = pose_nll
) -> np.ndarray:
    """Loss (B,) float64 of each run."""
    return np.asarray(_VALUES(config, loss, unconstrain(params), episodes), np.float64)


def gradients(
    config: Config, params: NoiseParams, episodes: Episode, loss: Loss = pose_nll
) -> tuple[np.ndarray, np.ndarray]:
    """Loss (B,) of each run and its gradient (B, P) in the logarithms of the noise, float64."""
    both = _GRADIENTS(config, loss, unconstrain(params), episodes)
    return tuple(np.asarray(x, np.float64) for x in both)


def mean_gradient(values: np.ndarray, each: np.ndarray) -> tuple[float, np.ndarray, int]:
    """Means of losses (B,) and gradients (B, P) over the runs where both are finite.

    Returns:
        Mean loss, NaN if no run is left; mean gradient (P,), 0 if no run is left; number of runs
        left out.
    """
    good = np.isfinite(values) & np.isfinite(each).all(axis=1)
    if not good.any():
        return np.nan, np.zeros(each.shape[1]), len(good)
    return values[good].mean(), each[good].mean(axis=0), int(np.sum(~good))


def draw_batch(seed: int, step: int, num_episodes: int, batch_size: int) -> np.ndarray:
    """Minibatch of a step: sorted numbers (batch,) of runs, drawn without replacement.

    Steps take the next `batch_size` numbers of a sequence of permutations of all runs, one for each
    epoch, which depend on the seed alone: a step can be drawn without the steps before it.
    """
    position = step * batch_size + np.arange(batch_size)
    epoch, offset = position // num_episodes, position % num_episodes
    order = {
        e: np.random.default_rng([seed, e]).permutation(num_episodes) for e in set(epoch.tolist())
    }
    return np.sort([order[e][k] for e, k in zip(epoch, offset, strict=True)])


def tune(
    config: Config,
    params: NoiseParams,
    episodes: Episode,
    *,
    loss: Loss = pose_nll,
    optimizer: optax.GradientTransformation | None = None,
    num_updates: int = 30,
    batch_size: int | None = None,
    seed: int = 0,
    frozen: Collection[str] = (),
    heldout: Episode | None = None,
    evaluate_every: int = 1,
    patience: int | None = None,
    state: TuneState | None = None,
    callback: Callable[[TuneState], Any] | None = None,
) -> TuneResult:
    """Tune the noise on runs by gradient descent.

        for step in 0 .. steps:
            loss, gradient = mean over the runs of this step (all, or a minibatch)
            if it is due: heldout = mean loss over the held-out runs
            record them
            theta <- theta + update of the optimiser, free parameters only
            call `callback` with the state
            stop if the last `patience` values of heldout are no better than one before

    The update after the last evaluation is part of the state but not of the result.

    Args:
        params: Where to start.
        config: Of the filter.
        episodes: [B] training runs.
        loss: Its mean over runs is minimised; one of `losses`, or any function of the step infos
            of the filter on a run, and its log.
        optimizer: Of the logarithms of the free parameters; `optimizers.default_optimizer` by default.
        num_updates: Number of updates.
        batch_size: Runs of a minibatch; all of them by default.
        seed: Of the order of minibatches.
        frozen: Names of parameters, or fields of the noise, that are not tuned.
        heldout: [H] runs for validation, which nothing is tuned on.
        evaluate_every: Evaluations from one validation to the next.
        patience: Validations without improvement after which it stops; by default it does not.
        state: State of an earlier call with the same arguments, to continue from; the result is
            the same as without the interruption.
        callback: Callback with the state after each evaluation.

    Returns:
        The fit. Its noise is the best: on the held-out runs if there are any, else on all training
        runs; with minibatches and no held-out runs, whose losses are not comparable, the last.

    Raises:
        ValueError: There are no runs, or the loss needs ground truth and a run has none; a
            parameter's name is unknown, a number is out of range, or the noise is not positive.
    """
    losses.check_loss(loss, episodes)
    if heldout is not None:
        losses.check_loss(loss, heldout, name="heldout")
    for name, number in (("batch", batch_size), ("every", evaluate_every), ("patience", patience)):
        if number is not None and number < 1:
            raise ValueError(f"{name} is {number}; it must be 1 or more")
    params = jax.tree.map(lambda x: jnp.asarray(x, float), params)
    trainable, runs = trainable_mask(params, frozen), episodes.odometry.shape[0]
    whole = batch_size is None or batch_size >= runs
    optimizer = default_optimizer(num_updates, whole=whole) if optimizer is None else optimizer
    optimizer = optax.with_extra_args_support(optimizer)
    if state is None:
        state = init(params, num_updates=num_updates, frozen=frozen, optimizer=optimizer)

    while state.step <= num_updates and not _stalled(state, patience):
        current, step = unflatten_params(state.theta, params), int(state.step)
        training = episodes if whole else _take(draw_batch(seed, step, runs, batch_size), episodes)
        value, gradient, skipped = mean_gradient(*gradients(config, current, training, loss))
        validation = np.nan
        if heldout is not None and (step % evaluate_every == 0 or step == num_updates):
            validation = _finite_mean(values(config, current, heldout, loss))
        state = _record(state, value, validation, skipped)
        state = _update_theta(state, optimizer, value, gradient, trainable)
        if callback is not None:
            callback(state)
    return result(state, params, whole=whole)


def init(
    params: NoiseParams,
    *,
    num_updates: int,
    optimizer: optax.GradientTransformation,
    frozen: Collection[str] = (),
) -> TuneState:
    """The state before the first evaluation; the arguments are those of `tune`.

    Raises:
        ValueError: The noise is not positive, or a parameter's name is unknown.
    """
    start = np.asarray(ravel_pytree(params)[0], np.float64)
    if not (np.isfinite(start) & (start > 0.0)).all():
        raise ValueError(f"the noise to start from is not positive: {params}")
    theta, not_yet = np.log(start), np.full(num_updates + 1, np.nan)
    return TuneState(
        step=np.int64(0),
        theta=theta,
        optimizer_state=optimizer.init(jnp.asarray(theta[trainable_mask(params, frozen)])),
        theta_history=np.full((num_updates + 1, theta.size), np.nan),
        loss=not_yet,
        heldout=not_yet,
        skipped=np.zeros(num_updates + 1, np.int64),
    )


def result(state: TuneState, params: NoiseParams, *, whole: bool = True) -> TuneResult:
    """Result of the evaluations so far.

    Args:
        state: After one evaluation at least.
        params: Any noise with the same parameters, for its fields and precision.
        whole: Whether each step evaluated all runs, so that their losses are comparable.
    """
    count = int(state.step)
    like, unravel = ravel_pytree(params)
    thetas = jnp.asarray(state.theta_history[:count], like.dtype)
    best = _best(state, whole)
    return TuneResult(
        params=constrain(unravel(thetas[best])),
        best=best,
        loss=state.loss[:count],
        heldout=state.heldout[:count],
        history=constrain(jax.vmap(unravel)(thetas)),
        skipped=state.skipped[:count],
    )


def _record(state: TuneState, value: float, validation: float, skipped: int) -> TuneState:
    """Record an evaluation; the arrays of the state before are not changed."""

    def put(old: np.ndarray, new: Any) -> np.ndarray:
        changed = np.array(old)
        changed[state.step] = new
        return changed

    return state._replace(
        step=state.step + 1,
        theta_history=put(state.theta_history, state.theta),
        loss=put(state.loss, value),
        heldout=put(state.heldout, validation),
        skipped=put(state.skipped, skipped),
    )


def _update_theta(
    state: TuneState, optimiser: Any, value: float, gradient: np.ndarray, trainable: np.ndarray
) -> TuneState:
    """Update the trainable parameters (P,) bool by the optimiser."""
    theta = jnp.asarray(state.theta[trainable])
    slope = jnp.asarray(gradient[trainable], theta.dtype)
    with jax.numpy_dtype_promotion("standard"):  # optax needs it
        loss = jnp.asarray(value, theta.dtype)
        change, inner = _optimiser_update(optimiser, slope, state.optimizer_state, theta, loss)
    updated = state.theta.copy()
    updated[trainable] += np.asarray(change, np.float64)
    return state._replace(theta=updated, optimizer_state=inner)


@partial(jax.jit, static_argnums=0)
def _optimiser_update(
    optimiser: Any, gradient: Array, state: Any, theta: Array, value: Array
) -> tuple[Array, Any]:
    return optimiser.update(gradient, state, theta, value=value)


def _take(indices: np.ndarray, logs: Episode) -> Episode:
    """Some of the runs, by number."""
    return jax.tree.map(lambda x: x[indices], logs)


def _finite_mean(values: np.ndarray) -> float:
    good = np.isfinite(values)
    return values[good].mean() if good.any() else np.nan


def _best(state: TuneState, whole: bool) -> int:
    """Number of the best evaluation: by held-out loss, else by comparable losses, else the last."""
    for series in (state.heldout, state.loss) if whole else (state.heldout,):
        if np.isfinite(series).any():
            return int(np.nanargmin(series))
    return int(state.step) - 1


def _stalled(state: TuneState, patience: int | None) -> bool:
    """Whether the best validation is `patience` or more validations ago."""
    validations = state.heldout[np.isfinite(state.heldout)]
    since_best = len(validations) - 1 - np.argmin([*validations, np.inf])
    return patience is not None and since_best >= patience
