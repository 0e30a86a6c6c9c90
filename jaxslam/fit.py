"""Noise that is tuned, not guessed: gradient descent on the localisation error of runs.

Front end and data come first, the noise after: features are computed once, and only the filter is
run again and differentiated. Matches are integers, so the gradient is that of the filter with its
matches held fixed; they are found anew at every evaluation.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxslam import slam
from jaxslam.batches import map_batches
from jaxslam.metrics import pose_error
from jaxslam.monte_carlo import Log
from jaxslam.slam import Config, Inputs, Noise
from jaxslam.types import Array

GROUP = 4  # runs that are differentiated together; bounds memory
HEADING = 1.0  # [m^2 / rad^2] what a squared heading error weighs beside a squared position error


class Fit(NamedTuple):
    """Result of `tune`."""

    noise: Noise  # the best seen on the training runs
    loss: np.ndarray  # (steps + 1,) over the runs of each step
    history: Noise  # [steps + 1] what each step evaluated
    skipped: np.ndarray  # (steps + 1,) runs left out because they gave no finite gradient


Loss = Callable[[Config, Noise, Log], Array]


def unconstrain(noise: Noise) -> Noise:
    """Logarithms of the noise: the numbers that the optimiser sees."""
    return jax.tree.map(jnp.log, noise)


def constrain(theta: Noise) -> Noise:
    """Noise of its logarithms; the inverse of `unconstrain`."""
    return jax.tree.map(jnp.exp, theta)


def localisation(config: Config, noise: Noise, log: Log) -> Array:
    """Mean squared position error [m^2] of one run, and its heading error weighed by `HEADING`."""
    start = slam.init(config, log.truth[0])
    _, info = slam.run(config, noise, start, Inputs(log.motion, log.nodes))
    error = pose_error(info.pose, log.truth)
    return jnp.mean(jnp.sum(error[:, :2] ** 2, axis=1) + HEADING * error[:, 2] ** 2)


def likelihood(config: Config, noise: Noise, log: Log) -> Array:
    """Mean negative log-likelihood [nats] a step of the innovations of one run; needs no truth."""
    start = slam.init(config, log.truth[0])
    _, info = slam.run(config, noise, start, Inputs(log.motion, log.nodes))
    return -jnp.mean(info.log_likelihood)


@partial(jax.jit, static_argnames=("config", "loss"))
def value_and_gradient(
    theta: Noise, config: Config, logs: Log, loss: Loss
) -> tuple[Array, Noise, Array]:
    """Loss over runs and its gradient in the logarithms of the noise.

    Runs whose loss or gradient is not finite are left out.

    Returns:
        Mean loss (), its gradient, and the number () of runs left out.
    """

    def one(log: Log) -> tuple[Array, Noise]:
        return jax.value_and_grad(lambda t: loss(config, constrain(t), log))(theta)

    values, gradients = map_batches(one, logs, size=GROUP)
    good = jnp.isfinite(values)
    for leaf in jax.tree.leaves(gradients):
        good &= jnp.all(jnp.isfinite(leaf.reshape(leaf.shape[0], -1)), axis=1)
    count = jnp.maximum(jnp.sum(good), 1).astype(values.dtype)

    def mean(x: Array) -> Array:
        keep = good.reshape((-1,) + (1,) * (x.ndim - 1))
        return jnp.sum(jnp.where(keep, x, jnp.zeros_like(x)), axis=0) / count

    return mean(values), jax.tree.map(mean, gradients), jnp.sum(~good)


def tune(
    noise: Noise,
    config: Config,
    logs: Log,
    *,
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 30,
    loss: Loss = localisation,
    batch: int | None = None,
    seed: int = 0,
    report: Callable[[int, float], Any] | None = None,
) -> Fit:
    """Fit the noise to runs by gradient descent.

    Args:
        noise: Where to start.
        config: Of the filter.
        logs: [B] training runs.
        optimiser: Adam with a step of 0.1, which decays to a tenth, unless given.
        steps: Number of updates.
        loss: Mean of this over runs is made small; `localisation`, `likelihood`, or any function
            of (config, noise, log).
        batch: Runs a step, drawn at random; all of them unless given.
        seed: Of that draw.
        report: Called with the step and its loss, to show progress.

    Returns:
        The fit; its noise is the best evaluated (the last, when runs are drawn for each step).
    """
    if optimiser is None:
        optimiser = optax.adam(optax.cosine_decay_schedule(0.1, steps, alpha=0.1))
    theta = unconstrain(noise)
    state = optimiser.init(theta)
    update = jax.jit(optimiser.update)
    runs = logs.motion.shape[0]
    draw = np.random.default_rng(seed)
    values, thetas, skipped = [], [], []
    for step in range(steps + 1):
        some = logs
        if batch is not None and batch < runs:
            chosen = np.sort(draw.choice(runs, batch, replace=False))
            some = jax.tree.map(lambda x: x[chosen], logs)  # noqa: B023
        value, gradient, bad = value_and_gradient(theta, config, some, loss)
        values.append(float(value))
        thetas.append(theta)
        skipped.append(int(bad))
        if report is not None:
            report(step, values[-1])
        if step < steps:
            change, state = update(gradient, state, theta)
            theta = optax.apply_updates(theta, change)
    whole = batch is None or batch >= runs
    best = thetas[int(np.nanargmin(values))] if whole else thetas[-1]
    history = jax.tree.map(lambda *x: jnp.stack(x), *map(constrain, thetas))
    return Fit(constrain(best), np.array(values), history, np.array(skipped))
