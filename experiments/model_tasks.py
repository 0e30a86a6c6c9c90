"""Models and data of `experiments.any_model`, and other libraries that tune them.

All start at the same parameters, on the same simulated sequences. Parameters are logarithms.
"""

from collections.abc import Callable
from importlib import import_module
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.common import Numbers
from experiments.noise_search import METHODS
from jaxslam.core.types import Array
from jaxslam.tuning import fitting
from jaxslam.tuning.ekf_model import EkfSequence, ekf_model
from jaxslam.tuning.model import Model, run_model

DT = 0.05  # [s]
BEACONS = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 8.0], [0.0, 8.0]])  # [m]
FACTOR = 3.0  # each parameter starts this far from the truth, and is searched as far around there
Likelihood = Callable[[Any, EkfSequence], Array]


class Spec(NamedTuple):
    """A model: log parameters, and functions of the parameters, state and input.

    Attributes:
        truth: Logarithms of the parameters.
        mean: (n,) of the prior, which is that of the first measurement.
        std: () of the prior.
        motion: Parameters and state to the state after it.
        measure: Parameters and state to the measurement.
        angles: Of the state.
    """

    truth: dict[str, float]
    mean: tuple[float, ...]
    std: float
    motion: Callable[[Any, Array], Array]
    measure: Callable[[Any, Array], Array]
    angles: tuple[int, ...] = ()


def _swing(params: Any, x: Array) -> Array:
    turn = x[1] - DT * (jnp.exp(params["gravity"]) * jnp.sin(x[0]) + jnp.exp(params["drag"]) * x[1])
    return jnp.stack([x[0] + DT * x[1], turn])


def _drive(params: Any, x: Array) -> Array:
    speed, turn = jnp.exp(params["scale"]) * x[3], x[4]
    ahead = DT * speed * jnp.stack([jnp.cos(x[2]), jnp.sin(x[2])])
    return jnp.concatenate([x[:2] + ahead, jnp.stack([x[2] + DT * turn, x[3], turn])])


def _ranges(params: Any, x: Array) -> Array:
    return jnp.sqrt(jnp.sum((x[None, :2] - jnp.asarray(BEACONS, x.dtype)) ** 2, axis=1))


def _straight(params: Any, x: Array) -> Array:
    return jnp.stack([x[0] + DT * x[1], x[1]])


_NOISE = {"motion_std": np.log(0.03), "measurement_std": np.log(0.1)}
MODELS = {
    "pendulum": Spec(
        {"gravity": np.log(9.8), "drag": np.log(0.3)} | _NOISE,
        (0.8, 0.0),
        0.3,
        _swing,
        lambda params, x: jnp.sin(x[:1]),
    ),
    "beacons": Spec({"scale": 0.0} | _NOISE, (3.0, 3.0, 0.3, 1.0, 0.2), 0.3, _drive, _ranges),
}
LINEAR = Spec(_NOISE, (0.0, 0.0), 1.0, _straight, lambda params, x: x[:1])


def _noise(name: str, params: Any, size: int) -> Array:
    return jnp.exp(2 * params[name]) * jnp.eye(size, dtype=params[name].dtype)


def model_of(spec: Spec) -> Model:
    """The model of a specification."""
    n = len(spec.mean)

    def init(params: Any, sequence: EkfSequence) -> tuple[Array, Array]:
        dtype = sequence.measurements.dtype
        return jnp.asarray(spec.mean, dtype), spec.std**2 * jnp.eye(n, dtype=dtype)

    return ekf_model(
        init=init,
        motion=lambda params, x, _: spec.motion(params, x),
        measure=spec.measure,
        motion_cov=lambda params, x, _: _noise("motion_std", params, n),
        measurement_cov=lambda params, x: _noise(
            "measurement_std", params, jax.eval_shape(spec.measure, params, x).size
        ),
        predict_first=False,
    )


class Task(NamedTuple):
    """A model, its true parameters as arrays, and data [B]."""

    spec: Spec
    model: Model
    params: Any
    data: EkfSequence

    def likelihoods(self) -> tuple[Likelihood, Likelihood]:
        """Log-likelihood of a sequence by this library and by dynamax.

        Raises:
            ImportError: dynamax is not installed.
        """
        return self.own, self.dynamax()

    def own(self, params: Any, sequence: EkfSequence) -> Array:
        """Log-likelihood () of a sequence."""
        return jnp.sum(run_model(self.model, params, sequence)[1].log_likelihood)

    def dynamax(self) -> Likelihood:
        """The same by dynamax, which keeps no more than it is asked for: the likelihood."""
        library, spec = import_module("dynamax.nonlinear_gaussian_ssm"), self.spec
        n, m = len(spec.mean), self.data.measurements.shape[2]

        def likelihood(params: Any, sequence: EkfSequence) -> Array:
            y = sequence.measurements
            given = library.ParamsNLGSSM(
                initial_mean=jnp.asarray(spec.mean, y.dtype),
                initial_covariance=spec.std**2 * jnp.eye(n, dtype=y.dtype),
                dynamics_function=lambda x: spec.motion(params, x),
                dynamics_covariance=_noise("motion_std", params, n),
                emission_function=lambda x: spec.measure(params, x),
                emission_covariance=_noise("measurement_std", params, m),
            )
            found = library.extended_kalman_filter(given, y, output_fields=[])
            return found.marginal_loglik

        return likelihood


def task(spec: Spec, *, seed: int, num_trials: int, num_steps: int) -> Task:
    """Simulate a model with its true parameters; NumPy's generator, so any precision is alike."""
    rng, n = np.random.default_rng(seed), len(spec.mean)
    params = jax.tree.map(lambda x: jnp.asarray(x, float), spec.truth)
    motion, measure = (jax.jit(jax.vmap(f, (None, 0))) for f in (spec.motion, spec.measure))
    std = {name: np.exp(value) for name, value in spec.truth.items()}
    x, measured = np.array(spec.mean) + spec.std * rng.normal(size=(num_trials, n)), []
    for _ in range(num_steps):
        y = np.asarray(measure(params, jnp.asarray(x, float)))
        measured.append(y + std["measurement_std"] * rng.normal(size=y.shape))
        moved = np.asarray(motion(params, jnp.asarray(x, float)))
        x = moved + std["motion_std"] * rng.normal(size=x.shape)
    data = EkfSequence(None, jnp.asarray(np.stack(measured, axis=1), float))
    return Task(spec, model_of(spec), params, data)


def _start(task: Task, seed: int) -> Any:
    """Parameters off by `FACTOR`, each up or down."""
    signs = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], len(task.params))
    offsets = dict(zip(task.params, signs * np.log(FACTOR), strict=True))
    return {name: value + offsets[name].item() for name, value in task.params.items()}


def _own_tune(task: Task, start: Any, num_updates: int, seed: int) -> Any:
    return fitting.tune(task.model, start, task.data, num_updates=num_updates).params


def _dynamax_sgd(task: Task, start: Any, num_updates: int, seed: int) -> Any:
    """Adam on dynamax's likelihood: of its nonlinear models it fits no parameters by itself."""
    likelihood = jax.vmap(task.dynamax(), (None, 0))
    optimizer = optax.adam(0.05)

    def loss(params: Any) -> Array:
        return -jnp.sum(likelihood(params, task.data)) / task.data.measurements.size

    @jax.jit
    def update(params: Any, state: Any) -> tuple[Any, Any]:
        change, state = optimizer.update(jax.grad(loss)(params), state)
        return optax.apply_updates(params, change), state

    params, state = start, optimizer.init(start)
    for _ in range(10 * num_updates):
        params, state = update(params, state)
    return params


def _search(method: str) -> Callable[[Task, Any, int, int], Any]:
    def run(task: Task, start: Any, num_updates: int, seed: int) -> Any:
        sampler, best = METHODS[method](len(start), seed), (np.inf, start)
        for _ in range(5 * num_updates):
            point = np.log(2 * FACTOR) * sampler.propose()
            moved = zip(start.items(), point.tolist(), strict=True)
            params = {name: value + by for (name, value), by in moved}
            loss = fitting.values(task.model, params, task.data).mean()
            sampler.observe(loss)
            best = min(best, (loss, params), key=lambda pair: pair[0])
        return best[1]

    return run


TUNERS: dict[str, Callable[[Task, Any, int, int], Any]] = {
    "jaxslam": _own_tune,
    "dynamax, Adam": _dynamax_sgd,
    "random": _search("random"),
    "optuna": _search("bayesian"),
}


def _kalman_py(method: str) -> Callable[[Task, Any, int, int], Any]:
    def run(task: Task, start: Any, num_updates: int, seed: int) -> Any:
        learning = import_module("kalman_py.learning")
        F = np.asarray(jax.jacfwd(lambda x: task.spec.motion(start, x))(jnp.zeros(2)), float)
        zs = np.asarray(task.data.measurements[0], float)
        variance = {name: float(np.exp(2 * value)) for name, value in start.items()}
        # Its prior is that before the first motion, here the prior before it.
        prior = np.linalg.inv(F) * task.spec.std
        fit = learning.fit_noise(
            F,
            np.eye(1, 2),
            zs,
            np.zeros(2),
            prior @ prior.T,
            Q0=variance["motion_std"] * np.eye(2),
            R0=variance["measurement_std"] * np.eye(1),
            method=method,
        )
        motion = np.log(np.trace(fit.Q) / 2) / 2  # it fits a full matrix
        return {"motion_std": motion, "measurement_std": np.log(fit.R[0, 0]) / 2}

    return run


LINEAR_TUNERS = TUNERS | {
    "kalman-py, EM": _kalman_py("em"),
    "kalman-py, gradient": _kalman_py("gradient"),
}


def tuned(task: Task, tuners: Any, seed: int, num_updates: int) -> list[Numbers]:
    """A row for each method: log-likelihood for each number measured, error, seconds."""
    start, rows = _start(task, seed), []
    for name, tune in tuners.items():
        begin = perf_counter()
        try:
            params = tune(task, start, num_updates, seed)
        except ImportError:
            rows.append({"method": name, "missing": True})
            continue
        seconds = perf_counter() - begin
        params = jax.tree.map(lambda x: jnp.asarray(x, float), params)
        off = [float(params[key] - task.params[key]) for key in task.params]
        loss = fitting.values(task.model, params, task.data).mean()
        rows.append({"method": name, "loss": loss, "error": np.abs(off).max(), "seconds": seconds})
    truth = fitting.values(task.model, task.params, task.data).mean()
    return [{"method": "truth", "loss": truth, "error": 0.0, "seconds": 0.0}, *rows]
