"""Tune Q and R by gradient descent on a loss of the filter.

Features are extracted once; each evaluation runs the filter on them and differentiates it. All
fields of `Noise` are smooth and tuned, as logarithms. Data association is not smooth: it is found
anew at every evaluation, and the gradient is that of the filter with its matches held fixed.
Parameters that act on the matches alone, above all the probability of the association gate
(`MatchSpec.gate`), have no gradient, and are not tuned here.
"""

from collections.abc import Callable, Collection
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxslam import losses, slam
from jaxslam.batches import Spread
from jaxslam.descent import usual
from jaxslam.losses import Loss, calibrated
from jaxslam.monte_carlo import Log, inputs_of
from jaxslam.slam import Config, Noise
from jaxslam.types import Array

GROUP = 4  # runs that a device differentiates together; bounds memory


class State(NamedTuple):
    """State of a tuning, with all that it needs to continue. P parameters, N updates in all.

    Attributes:
        step: () int64 number of evaluations so far.
        theta: (P,) float64 logarithms of the noise to be evaluated next.
        optimiser: State of the optimiser, of the free parameters.
        thetas: (N + 1, P) float64 logarithms that each evaluation used; NaN: not yet.
        loss: (N + 1,) float64 mean over the runs of each evaluation; NaN: not yet.
        heldout: (N + 1,) float64 mean over the held-out runs; NaN: not evaluated.
        skipped: (N + 1,) int64 runs left out of the mean because a value was not finite.
    """

    step: np.ndarray
    theta: np.ndarray
    optimiser: Any
    thetas: np.ndarray
    loss: np.ndarray
    heldout: np.ndarray
    skipped: np.ndarray


class Fit(NamedTuple):
    """Result of `tune`. N evaluations: one more than updates, or fewer when it stopped early.

    Attributes:
        noise: The best noise.
        best: Number of the evaluation it is from.
        loss: (N,) mean over the runs of each evaluation.
        heldout: (N,) mean over the held-out runs; NaN where not evaluated.
        history: [N] noise that each evaluation used.
        skipped: (N,) runs left out of the mean because a value was not finite.
    """

    noise: Noise
    best: int
    loss: np.ndarray
    heldout: np.ndarray
    history: Noise
    skipped: np.ndarray


def unconstrain(noise: Noise) -> Noise:
    """Logarithms of the noise: the numbers that the optimiser sees."""
    return jax.tree.map(jnp.log, noise)


def constrain(theta: Noise) -> Noise:
    """Noise from its logarithms; the inverse of `unconstrain`."""
    return jax.tree.map(jnp.exp, theta)


def theta_of(noise: Noise) -> np.ndarray:
    """Logarithms (P,) float64 of the parameters."""
    return np.log(np.asarray(ravel_pytree(noise)[0], np.float64))


def noise_of(theta: Any, like: Noise) -> Noise:
    """Noise from logarithms (P,), with the fields and precision of another."""
    flat, unravel = ravel_pytree(like)
    return constrain(unravel(jnp.asarray(theta, flat.dtype)))


def names(noise: Noise) -> tuple[str, ...]:
    """Names of the P parameters: `range`, or `odometry[2]` of several."""
    return tuple(
        f"{field}[{i}]" if np.ndim(value) else field
        for field, value in noise._asdict().items()
        if value is not None
        for i in range(np.size(value))
    )


def free(noise: Noise, frozen: Collection[str] = ()) -> np.ndarray:
    """Mask (P,) bool of the parameters that are tuned.

    Args:
        noise: The noise.
        frozen: Names of parameters that are not tuned, or of fields: `odometry` is all four.

    Raises:
        ValueError: There is no such parameter, or none is left to tune.
    """
    known = names(noise)
    unknown = set(frozen) - set(known) - set(noise._fields)
    if unknown:
        raise ValueError(
            f"no parameter is called {sorted(unknown)[0]!r}; known: {', '.join(known)}"
        )
    trainable = np.array([not {name, name.split("[")[0]} & set(frozen) for name in known])
    if not trainable.any():
        raise ValueError("all parameters are frozen: nothing is left to tune")
    return trainable


def scaled(noise: Noise, parameter: int, by: float) -> Noise:
    """The noise with one of its P parameters multiplied by exp(by)."""
    flat, unravel = ravel_pytree(noise)
    return unravel(flat.at[parameter].multiply(jnp.exp(jnp.asarray(by, flat.dtype))))


def _value(config: Config, loss: Loss, theta: Noise, log: Log) -> Array:
    """Loss () of one run."""
    start = slam.init(config, log.truth[0])
    _, info = slam.run(config, constrain(theta), start, inputs_of(log))
    return loss(info, log)


def _value_and_gradient(config: Config, loss: Loss, theta: Noise, log: Log) -> tuple[Array, Array]:
    """Loss () of one run and its gradient (P,) in the logarithms of the noise."""
    value, gradient = jax.value_and_grad(_value, argnums=2)(config, loss, theta, log)
    return value, ravel_pytree(gradient)[0]


_VALUES = Spread(_value, size=GROUP, static=2)
_GRADIENTS = Spread(_value_and_gradient, size=GROUP, static=2)


def values(noise: Noise, config: Config, logs: Log, loss: Loss = calibrated) -> np.ndarray:
    """Loss (B,) float64 of each run."""
    return np.asarray(_VALUES(config, loss, unconstrain(noise), logs), np.float64)


def gradients(
    noise: Noise, config: Config, logs: Log, loss: Loss = calibrated
) -> tuple[np.ndarray, np.ndarray]:
    """Loss (B,) of each run and its gradient (B, P) in the logarithms of the noise, float64."""
    both = _GRADIENTS(config, loss, unconstrain(noise), logs)
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


def draw(seed: int, step: int, runs: int, batch: int) -> np.ndarray:
    """Minibatch of a step: sorted numbers (batch,) of runs, drawn without replacement.

    Steps take the next `batch` numbers of a sequence of permutations of all runs, one for each
    epoch, which depend on the seed alone: a step can be drawn without the steps before it.
    """
    position = step * batch + np.arange(batch)
    epoch, offset = position // runs, position % runs
    order = {e: np.random.default_rng([seed, e]).permutation(runs) for e in set(epoch.tolist())}
    return np.sort([order[e][k] for e, k in zip(epoch, offset, strict=True)])


def tune(
    noise: Noise,
    config: Config,
    logs: Log,
    *,
    loss: Loss = calibrated,
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 30,
    batch: int | None = None,
    seed: int = 0,
    frozen: Collection[str] = (),
    heldout: Log | None = None,
    every: int = 1,
    patience: int | None = None,
    state: State | None = None,
    report: Callable[[State], Any] | None = None,
) -> Fit:
    """Tune the noise on runs by gradient descent.

        for step in 0 .. steps:
            loss, gradient = mean over the runs of this step (all, or a minibatch)
            if it is due: heldout = mean loss over the held-out runs
            record them
            theta <- theta + update of the optimiser, free parameters only
            call `report` with the state
            stop if the last `patience` values of heldout are no better than one before

    The update after the last evaluation is part of the state but not of the result.

    Args:
        noise: Where to start.
        config: Of the filter.
        logs: [B] training runs.
        loss: Its mean over runs is minimised; one of `losses`, or any function of the step infos
            of the filter on a run, and its log.
        optimiser: Of the logarithms of the free parameters; `descent.usual` by default.
        steps: Number of updates.
        batch: Runs of a minibatch; all of them by default.
        seed: Of the order of minibatches.
        frozen: Names of parameters, or fields of the noise, that are not tuned.
        heldout: [H] runs for validation, which nothing is tuned on.
        every: Evaluations from one validation to the next.
        patience: Validations without improvement after which it stops; by default it does not.
        state: State of an earlier call with the same arguments, to continue from; the result is
            the same as without the interruption.
        report: Callback with the state after each evaluation.

    Returns:
        The fit. Its noise is the best: on the held-out runs if there are any, else on all training
        runs; with minibatches and no held-out runs, whose losses are not comparable, the last.

    Raises:
        ValueError: There are no runs, or the loss needs ground truth and a run has none; a
            parameter's name is unknown, a number is out of range, or the noise is not positive.
    """
    losses.check(loss, logs)
    if heldout is not None:
        losses.check(loss, heldout, what="heldout")
    for name, number in (("batch", batch), ("every", every), ("patience", patience)):
        if number is not None and number < 1:
            raise ValueError(f"{name} is {number}; it must be 1 or more")
    noise = jax.tree.map(lambda x: jnp.asarray(x, float), noise)
    trainable, runs = free(noise, frozen), logs.motion.shape[0]
    whole = batch is None or batch >= runs
    optimiser = usual(steps, whole=whole) if optimiser is None else optimiser
    optimiser = optax.with_extra_args_support(optimiser)
    if state is None:
        state = begin(noise, steps=steps, frozen=frozen, optimiser=optimiser)

    while state.step <= steps and not _stalled(state, patience):
        current, step = noise_of(state.theta, noise), int(state.step)
        training = logs if whole else _take(draw(seed, step, runs, batch), logs)
        value, gradient, skipped = mean_gradient(*gradients(current, config, training, loss))
        validation = np.nan
        if heldout is not None and (step % every == 0 or step == steps):
            validation = _finite_mean(values(current, config, heldout, loss))
        state = _record(state, value, validation, skipped)
        state = _update_theta(state, optimiser, value, gradient, trainable)
        if report is not None:
            report(state)
    return result(state, noise, whole=whole)


def begin(
    noise: Noise,
    *,
    steps: int,
    optimiser: optax.GradientTransformation,
    frozen: Collection[str] = (),
) -> State:
    """The state before the first evaluation; the arguments are those of `tune`.

    Raises:
        ValueError: The noise is not positive, or a parameter's name is unknown.
    """
    start = np.asarray(ravel_pytree(noise)[0], np.float64)
    if not (np.isfinite(start) & (start > 0.0)).all():
        raise ValueError(f"the noise to start from is not positive: {noise}")
    theta, not_yet = np.log(start), np.full(steps + 1, np.nan)
    return State(
        step=np.int64(0),
        theta=theta,
        optimiser=optimiser.init(jnp.asarray(theta[free(noise, frozen)])),
        thetas=np.full((steps + 1, theta.size), np.nan),
        loss=not_yet,
        heldout=not_yet,
        skipped=np.zeros(steps + 1, np.int64),
    )


def result(state: State, noise: Noise, *, whole: bool = True) -> Fit:
    """Result of the evaluations so far.

    Args:
        state: After one evaluation at least.
        noise: Any noise with the same parameters, for its fields and precision.
        whole: Whether each step evaluated all runs, so that their losses are comparable.
    """
    count = int(state.step)
    like, unravel = ravel_pytree(noise)
    thetas = jnp.asarray(state.thetas[:count], like.dtype)
    best = _best(state, whole)
    return Fit(
        noise=constrain(unravel(thetas[best])),
        best=best,
        loss=state.loss[:count],
        heldout=state.heldout[:count],
        history=constrain(jax.vmap(unravel)(thetas)),
        skipped=state.skipped[:count],
    )


def _record(state: State, value: float, validation: float, skipped: int) -> State:
    """Record an evaluation; the arrays of the state before are not changed."""

    def put(old: np.ndarray, new: Any) -> np.ndarray:
        changed = np.array(old)
        changed[state.step] = new
        return changed

    return state._replace(
        step=state.step + 1,
        thetas=put(state.thetas, state.theta),
        loss=put(state.loss, value),
        heldout=put(state.heldout, validation),
        skipped=put(state.skipped, skipped),
    )


def _update_theta(
    state: State, optimiser: Any, value: float, gradient: np.ndarray, trainable: np.ndarray
) -> State:
    """Update the trainable parameters (P,) bool by the optimiser."""
    theta = jnp.asarray(state.theta[trainable])
    slope = jnp.asarray(gradient[trainable], theta.dtype)
    with jax.numpy_dtype_promotion("standard"):  # optax needs it
        loss = jnp.asarray(value, theta.dtype)
        change, inner = _optimiser_update(optimiser, slope, state.optimiser, theta, loss)
    updated = state.theta.copy()
    updated[trainable] += np.asarray(change, np.float64)
    return state._replace(theta=updated, optimiser=inner)


@partial(jax.jit, static_argnums=0)
def _optimiser_update(
    optimiser: Any, gradient: Array, state: Any, theta: Array, value: Array
) -> tuple[Array, Any]:
    return optimiser.update(gradient, state, theta, value=value)


def _take(indices: np.ndarray, logs: Log) -> Log:
    """Some of the runs, by number."""
    return jax.tree.map(lambda x: x[indices], logs)


def _finite_mean(values: np.ndarray) -> float:
    good = np.isfinite(values)
    return values[good].mean() if good.any() else np.nan


def _best(state: State, whole: bool) -> int:
    """Number of the best evaluation: by held-out loss, else by comparable losses, else the last."""
    for series in (state.heldout, state.loss) if whole else (state.heldout,):
        if np.isfinite(series).any():
            return int(np.nanargmin(series))
    return int(state.step) - 1


def _stalled(state: State, patience: int | None) -> bool:
    """Whether the best validation is `patience` or more validations ago."""
    validations = state.heldout[np.isfinite(state.heldout)]
    since_best = len(validations) - 1 - np.argmin([*validations, np.inf])
    return patience is not None and since_best >= patience
