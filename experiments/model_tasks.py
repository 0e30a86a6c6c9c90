"""Small models and simulated data of them, for `experiments.any_model` and `experiments.tuning`.

Parameters are logarithms.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array
from jaxslam.tuning.ekf_model import EkfSequence, ekf_model
from jaxslam.tuning.model import Model, run_model

DT = 0.05  # [s]
BEACONS = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 8.0], [0.0, 8.0]])  # [m]
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
