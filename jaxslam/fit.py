"""Noise that is tuned, not guessed: gradient descent on what the filter gets wrong.

Front end and data come first, the noise after: features are computed once, and only the filter is
run again and differentiated. All of `Noise` is smooth and tuned, as logarithms. Matches are not:
they are integers, found anew at every evaluation, and the gradient is that of the filter with its
matches held fixed. So what decides on matches alone, above all the probability of the association
gate (`MatchSpec.gate`), has no gradient, and is not tuned here.
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
    """Where a tuning stands: all that it needs to go on. P parameters, N steps in all."""

    step: np.ndarray  # () int64, evaluated so far
    theta: np.ndarray  # (P,) float64, logarithms of the noise to be evaluated next
    optimiser: Any  # state of the optimiser, of the parameters that are free
    thetas: np.ndarray  # (N + 1, P) float64, what each step evaluated
    loss: np.ndarray  # (N + 1,) float64, mean over the runs of each step; NaN: not yet
    heldout: np.ndarray  # (N + 1,) float64, over the held-out runs; NaN: not evaluated
    skipped: np.ndarray  # (N + 1,) int64, runs left out because they gave no finite gradient


class Fit(NamedTuple):
    """Result of `tune`. N evaluations: steps + 1, or fewer when it stopped early."""

    noise: Noise  # the best
    best: int  # and which evaluation that is
    loss: np.ndarray  # (N,) mean over the runs of each step
    heldout: np.ndarray  # (N,) mean over the held-out runs; NaN where not evaluated
    history: Noise  # [N] what each step evaluated
    skipped: np.ndarray  # (N,) runs left out because they gave no finite gradient


def unconstrain(noise: Noise) -> Noise:
    """Logarithms of the noise: the numbers that the optimiser sees."""
    return jax.tree.map(jnp.log, noise)


def constrain(theta: Noise) -> Noise:
    """Noise of its logarithms; the inverse of `unconstrain`."""
    return jax.tree.map(jnp.exp, theta)


def theta_of(noise: Noise) -> np.ndarray:
    """Logarithms (P,) float64 of the parameters."""
    return np.log(np.asarray(ravel_pytree(noise)[0], np.float64))


def noise_of(theta: Any, like: Noise) -> Noise:
    """Noise of logarithms (P,), with the fields and precision of another."""
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
    """Which of the P parameters (P,) bool are tuned.

    Args:
        noise: The noise.
        frozen: Names of parameters that stay, or of fields: `odometry` is all four.

    Raises:
        ValueError: There is no such parameter, or none is left.
    """
    known = names(noise)
    unknown = set(frozen) - set(known) - set(noise._fields)
    if unknown:
        raise ValueError(
            f"no parameter is called {sorted(unknown)[0]!r}; known: {', '.join(known)}"
        )
    rest = np.array([not {name, name.split("[")[0]} & set(frozen) for name in known])
    if not rest.any():
        raise ValueError("all parameters are frozen: nothing is left to tune")
    return rest


def scaled(noise: Noise, parameter: int, by: float) -> Noise:
    """The noise with one of its P parameters times exp(by)."""
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
    """Means of losses (B,) and gradients (B, P) over runs, those left out where one is not finite.

    Returns:
        Mean loss, NaN of no runs; mean gradient (P,), 0 of no runs; number of runs left out.
    """
    good = np.isfinite(values) & np.isfinite(each).all(axis=1)
    if not good.any():
        return np.nan, np.zeros(each.shape[1]), len(good)
    return values[good].mean(), each[good].mean(axis=0), int(np.sum(~good))


def draw(seed: int, step: int, runs: int, batch: int) -> np.ndarray:
    """Runs (batch,) of a step: the next of a shuffled pack of all, and shuffled anew after it."""
    place = step * batch + np.arange(batch)
    pack = {
        turn: np.random.default_rng([seed, turn]).permutation(runs)
        for turn in set((place // runs).tolist())
    }
    return np.sort([pack[turn][at] for turn, at in zip(place // runs, place % runs, strict=True)])


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
    """Fit the noise to runs by gradient descent.

    Args:
        noise: Where to start.
        config: Of the filter.
        logs: [B] training runs.
        loss: Mean of this over runs is made small; one of `losses`, or any function of the info
            of a filtered run and its log.
        optimiser: Of the logarithms of the free parameters; `descent.usual` unless given.
        steps: Number of updates.
        batch: Runs a step, in turn from a shuffled pack; all of them unless given.
        seed: Of that shuffle.
        frozen: Names of parameters, or fields of the noise, that stay as they are.
        heldout: [H] runs to judge by, which nothing is tuned on.
        every: Evaluations from one judgement to the next.
        patience: Judgements without a better one after which it stops; never unless given.
        state: Where an earlier call with the same arguments stood; the result is the same.
        report: Called with the state after each evaluation: to show it, or to keep it.

    Returns:
        The fit. Its noise is the best: on the held-out runs where there are any, else on all
        training runs; or the last, where each step sees other runs and nothing compares them.

    Raises:
        ValueError: Runs are too few or lack the truth that the loss needs, a name is none of a
            parameter, a number is out of range, or the noise is not positive.
    """
    losses.check(loss, logs)
    if heldout is not None:
        losses.check(loss, heldout, what="heldout")
    for name, number in {"batch": batch, "every": every, "patience": patience}.items():
        if number is not None and number < 1:
            raise ValueError(f"{name} is {number}; it must be 1 or more")
    noise = jax.tree.map(lambda x: jnp.asarray(x, float), noise)
    moves, runs = free(noise, frozen), logs.motion.shape[0]
    whole = batch is None or batch >= runs
    optimiser = usual(steps, whole=whole) if optimiser is None else optimiser
    optimiser = optax.with_extra_args_support(optimiser)
    if state is None:
        state = begin(noise, steps=steps, frozen=frozen, optimiser=optimiser)

    while state.step <= steps and not _stalled(state, patience):
        now, step = noise_of(state.theta, noise), int(state.step)
        some = logs
        if not whole:
            some = jax.tree.map(partial(_take, draw(seed, step, runs, batch)), logs)
        value, gradient, bad = mean_gradient(*gradients(now, config, some, loss))
        judged = np.nan
        if heldout is not None and (step % every == 0 or step == steps):
            judged = _finite_mean(values(now, config, heldout, loss))
        state = _note(state, value, judged, bad)
        state = _move(state, optimiser, value, gradient, moves)
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
        ValueError: The noise is not positive, or a name is none of a parameter.
    """
    start = np.asarray(ravel_pytree(noise)[0], np.float64)
    if not (np.isfinite(start) & (start > 0.0)).all():
        raise ValueError(f"the noise to start from is not positive: {noise}")
    theta, none = np.log(start), np.full(steps + 1, np.nan)
    return State(
        step=np.int64(0),
        theta=theta,
        optimiser=optimiser.init(jnp.asarray(theta[free(noise, frozen)])),
        thetas=np.full((steps + 1, theta.size), np.nan),
        loss=none,
        heldout=none,
        skipped=np.zeros(steps + 1, np.int64),
    )


def result(state: State, noise: Noise, *, whole: bool = True) -> Fit:
    """What a state has found so far; `noise` is any with the same parameters.

    Args:
        state: After one evaluation at least.
        noise: Any noise: for its fields.
        whole: Whether each step saw all runs, so that their losses compare.
    """
    done = int(state.step)
    like, unravel = ravel_pytree(noise)
    thetas = jnp.asarray(state.thetas[:done], like.dtype)
    best = _best(state, whole)
    return Fit(
        noise=constrain(unravel(thetas[best])),
        best=best,
        loss=state.loss[:done],
        heldout=state.heldout[:done],
        history=constrain(jax.vmap(unravel)(thetas)),
        skipped=state.skipped[:done],
    )


def _note(state: State, value: float, judged: float, bad: int) -> State:
    """Write an evaluation down."""
    at = np.arange(len(state.loss)) == state.step
    put = lambda old, new: np.where(at.reshape((-1,) + (1,) * (old.ndim - 1)), new, old)
    return state._replace(
        step=state.step + 1,
        thetas=put(state.thetas, state.theta[None]),
        loss=put(state.loss, value),
        heldout=put(state.heldout, judged),
        skipped=put(state.skipped, bad),
    )


def _move(
    state: State, optimiser: Any, value: float, gradient: np.ndarray, moves: np.ndarray
) -> State:
    """Update the free parameters."""
    theta = jnp.asarray(state.theta[moves])
    slope = jnp.asarray(gradient[moves], theta.dtype)
    with jax.numpy_dtype_promotion("standard"):  # optax asks for it
        loss = jnp.asarray(value, theta.dtype)
        change, kept = _change(optimiser, slope, state.optimiser, theta, loss)
    moved = state.theta.copy()
    moved[moves] += np.asarray(change, np.float64)
    return state._replace(theta=moved, optimiser=kept)


@partial(jax.jit, static_argnums=0)
def _change(
    optimiser: Any, slope: Array, state: Any, theta: Array, value: Array
) -> tuple[Array, Any]:
    return optimiser.update(slope, state, theta, value=value)


def _take(chosen: np.ndarray, x: Array) -> Array:
    return x[chosen]


def _finite_mean(values: np.ndarray) -> float:
    good = np.isfinite(values)
    return values[good].mean() if good.any() else np.nan


def _best(state: State, whole: bool) -> int:
    """Number of the best evaluation."""
    for found in (state.heldout, state.loss) if whole else (state.heldout,):
        if np.isfinite(found).any():
            return int(np.nanargmin(found))
    return int(state.step) - 1


def _stalled(state: State, patience: int | None) -> bool:
    """Whether the last judgements, as many as the patience, all were worse than one before."""
    judged = state.heldout[np.isfinite(state.heldout)]
    return patience is not None and len(judged) - 1 - np.argmin([*judged, np.inf]) >= patience
