"""Other libraries that find the parameters of small models: part of `experiments.tuning`.

All start at the same parameters, on the same simulated sequences of a pendulum and of a linear
model. Adam takes ten times as many updates as this library's L-BFGS, searches evaluate 25 times as
often, kalman-py takes what it takes by default. The clock starts after a short call of each
method, which compiles what can be kept; dynamax's own fit and kalman-py compile anew each time.

dynamax fits no parameters of nonlinear models, so Adam descends its likelihood. Its own SGD fits
the linear model, motion and measurement fixed; its EM cannot: it fits all parameters or none.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments import model_tasks
from experiments.common import Numbers, ResultCache
from experiments.model_tasks import Task
from experiments.noise_search import METHODS
from jaxslam.core.types import Array
from jaxslam.tuning import fitting

FACTOR = 3.0  # each parameter starts this far from the truth, and is searched as far around there
ADAM_RATE, ADAM_UPDATES, SEARCHED = 0.05, 10, 25  # updates and evaluations, by those of L-BFGS

Tuner = Callable[[Any, int], Any]
"""Where to start, and a number of updates, to the parameters found."""


def start_of(task: Task, seed: int) -> Any:
    """Parameters off by `FACTOR`, each up or down."""
    signs = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], len(task.params))
    offsets = dict(zip(task.params, signs * np.log(FACTOR), strict=True))
    return {name: value + offsets[name].item() for name, value in task.params.items()}


def _own(task: Task, seed: int) -> Tuner:
    def tune(start: Any, num_updates: int) -> Any:
        return fitting.tune(task.model, start, task.data, num_updates=num_updates).params

    return tune


def _dynamax_adam(task: Task, seed: int) -> Tuner:
    likelihood = jax.vmap(task.dynamax(), (None, 0))
    optimizer = optax.adam(ADAM_RATE)

    def loss(params: Any) -> Array:
        return -jnp.sum(likelihood(params, task.data)) / task.data.measurements.size

    @jax.jit
    def update(params: Any, state: Any) -> tuple[Any, Any]:
        change, state = optimizer.update(jax.grad(loss)(params), state)
        return optax.apply_updates(params, change), state

    def tune(start: Any, num_updates: int) -> Any:
        params, state = start, optimizer.init(start)
        for _ in range(ADAM_UPDATES * num_updates):
            params, state = update(params, state)
        return params

    return tune


def linear_matrices(task: Task) -> tuple[np.ndarray, np.ndarray]:
    """F (n, n) and H (m, n) of a linear model."""
    zero = jnp.zeros(len(task.spec.mean))
    functions = (task.spec.motion, task.spec.measure)
    F, H = (jax.jacfwd(lambda x, f=f: f(task.params, x))(zero) for f in functions)
    return np.asarray(F, float), np.asarray(H, float)


def _from_matrices(Q: Any, R: Any) -> dict[str, float]:
    """Parameters of the linear model by full matrices, which others fit: their mean variances."""
    names = ("motion_std", "measurement_std")
    return {k: np.log(np.trace(x) / len(x)) / 2 for k, x in zip(names, (Q, R), strict=True)}


def _dynamax_sgd(task: Task, seed: int) -> Tuner:
    library = import_module("dynamax.linear_gaussian_ssm")
    trees = import_module("dynamax.parameters")
    F, H = (jnp.asarray(x, float) for x in linear_matrices(task))
    (m, n), std = H.shape, task.spec.std
    own = library.LinearGaussianSSM(n, m)

    def tune(start: Any, num_updates: int) -> Any:
        variance = {name: jnp.exp(2 * jnp.asarray(value, float)) for name, value in start.items()}
        params, properties = own.initialize(
            initial_mean=jnp.asarray(task.spec.mean, float),
            initial_covariance=std**2 * jnp.eye(n),
            dynamics_weights=F,
            dynamics_covariance=variance["motion_std"] * jnp.eye(n),
            dynamics_bias=jnp.zeros(n),
            emission_weights=H,
            emission_bias=jnp.zeros(m),
            emission_covariance=variance["measurement_std"] * jnp.eye(m),
        )
        fixed = jax.tree.map(
            lambda x: trees.ParameterProperties(trainable=False, constrainer=x.constrainer),
            properties,
            is_leaf=lambda x: isinstance(x, trees.ParameterProperties),
        )
        free = fixed._replace(
            dynamics=fixed.dynamics._replace(cov=properties.dynamics.cov),
            emissions=fixed.emissions._replace(cov=properties.emissions.cov),
        )
        found, _ = own.fit_sgd(
            params,
            free,
            task.data.measurements,
            optimizer=optax.adam(ADAM_RATE),
            batch_size=len(task.data.measurements),
            num_epochs=ADAM_UPDATES * num_updates,
        )
        return _from_matrices(found.dynamics.cov, found.emissions.cov)

    return tune


def _search(method: str) -> Callable[[Task, int], Tuner]:
    def of(task: Task, seed: int) -> Tuner:
        def tune(start: Any, num_updates: int) -> Any:
            sampler, best = METHODS[method](len(start), seed), (np.inf, start)
            for _ in range(SEARCHED * num_updates):
                point = np.log(2 * FACTOR) * sampler.propose()
                moved = zip(start.items(), point.tolist(), strict=True)
                params = {name: value + by for (name, value), by in moved}
                loss = fitting.values(task.model, params, task.data).mean()
                sampler.observe(loss)
                best = min(best, (loss, params), key=lambda pair: pair[0])
            return best[1]

        return tune

    return of


def _kalman_py(method: str) -> Callable[[Task, int], Tuner]:
    def of(task: Task, seed: int) -> Tuner:
        learning = import_module("kalman_py.learning")
        F, H = linear_matrices(task)
        # Its prior is that before the first motion, here the prior before it.
        prior = np.linalg.inv(F) * task.spec.std

        def tune(start: Any, num_updates: int) -> Any:
            variance = {name: float(np.exp(2 * value)) for name, value in start.items()}
            with jax.enable_x64(True):  # which it recommends
                fit = learning.fit_noise(
                    F,
                    H,
                    np.asarray(task.data.measurements[0], float),
                    np.asarray(task.spec.mean),
                    prior @ prior.T,
                    Q0=variance["motion_std"] * np.eye(len(F)),
                    R0=variance["measurement_std"] * np.eye(len(H)),
                    method=method,
                )
            return _from_matrices(fit.Q, fit.R)

        return tune

    return of


TUNERS: dict[str, Callable[[Task, int], Tuner]] = {
    "jaxslam": _own,
    "dynamax, Adam": _dynamax_adam,
    "random": _search("random"),
    "optuna": _search("bayesian"),
}
LINEAR_TUNERS = TUNERS | {
    "dynamax, SGD": _dynamax_sgd,
    "kalman-py, EM": _kalman_py("em"),
    "kalman-py, gradient": _kalman_py("gradient"),
}


def rows_of(
    name: str, task: Task, tuners: Any, seed: int, num_updates: int, cache: ResultCache
) -> list[Numbers]:
    """A row for each method: loss, the largest error of a parameter (a logarithm), and seconds.

    The loss is the negative log-likelihood for each number measured. A method whose library is
    missing is left out, with a line that says so.
    """
    rows = [_row(task, "truth", task.params, 0.0)]
    for method, make in tuners.items():
        try:
            own = partial(_timed, task, method, make, seed, num_updates)
            rows.append(cache(f"{name} {method}", own))
        except ImportError as error:
            print(f"left out: {method}, as {error.name} is missing; pip install '.[bench]'")
    return rows


def _timed(
    task: Task, method: str, make: Callable[[Task, int], Tuner], seed: int, num_updates: int
) -> Numbers:
    """The row of a method, after a short call of it."""
    tune, start = make(task, seed), start_of(task, seed)
    tune(start, 1)  # compiles
    begin = perf_counter()
    found = jax.tree.map(float, tune(start, num_updates))
    return _row(task, method, found, perf_counter() - begin)


def _row(task: Task, method: str, params: Any, seconds: float) -> Numbers:
    """Loss of parameters, and how far they are from the truth."""
    params = {key: jnp.asarray(value, float) for key, value in params.items()}
    off = [float(params[key] - task.params[key]) for key in task.params]
    loss = float(fitting.values(task.model, params, task.data).mean())
    return {"method": method, "loss": loss, "error": float(np.abs(off).max()), "seconds": seconds}


def compute(
    seed: int, num_sequences: int, num_steps: int, num_updates: int, cache: ResultCache
) -> Numbers:
    """Rows of the pendulum, by many sequences, and of the linear model, by one that is long."""
    pendulum = model_tasks.task(
        model_tasks.MODELS["pendulum"], seed=seed, num_trials=num_sequences, num_steps=num_steps
    )
    line = model_tasks.task(model_tasks.LINEAR, seed=seed, num_trials=1, num_steps=5 * num_steps)
    given = (("pendulum", pendulum, TUNERS), ("linear", line, LINEAR_TUNERS))
    return {
        name: rows_of(name, task, tuners, seed, num_updates, cache) for name, task, tuners in given
    }
