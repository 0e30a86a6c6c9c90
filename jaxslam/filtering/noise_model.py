"""A noise model of one's own: functions of parameters and of what is known at the step.

    def measurement(custom, features, measurement, R): ...  # R (M, 2, 2) -> (M, 2, 2)
    def odometry(custom, measurement, Q): ...               # Q (3, 3)    -> (3, 3)

`custom` is `NoiseParams.custom`, any tree of arrays, for example the weights of a small network;
it is traced, and tuned like the rest. `R` and `Q` are the noise without the model, so that a
function may scale them, replace them, or add to them. A model is part of `FilterConfig`, which is
static: its functions belong to a module, not to a call, so that nothing is compiled again.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import Array, check_array

MeasurementFunction = Callable[[Any, Features, Measurement, Array], Array]
OdometryFunction = Callable[[Any, Measurement, Array], Array]


class NoiseModel(NamedTuple):
    """Functions that change R and Q; hashable, static under jit.

    Attributes:
        measurement: R (M, 2, 2) of (custom, features of the configured kinds, measurement of the
            step, R); None: R stays.
        odometry: Q (3, 3) of (custom, measurement of the step, Q of the odometry before it is fused
            with scan matching); None: Q stays.
    """

    measurement: MeasurementFunction | None = None
    odometry: OdometryFunction | None = None


def change_measurement_cov(
    model: NoiseModel, custom: Any, features: Features, measurement: Measurement, R: Array
) -> Array:
    """R (M, 2, 2) of a model; made symmetric, and as given where the model's is not finite.

    Raises:
        ValueError: The function returns another shape or type; while tracing.
    """
    if model.measurement is None:
        return R
    changed = model.measurement(custom, features, measurement, R)
    check_array("noise_model.measurement(...)", changed, R.shape, jnp.floating)
    return _finite_symmetric(changed.astype(R.dtype), R)


def change_odometry_cov(
    model: NoiseModel, custom: Any, measurement: Measurement, Q: Array
) -> Array:
    """Q (3, 3) of a model; made symmetric, and as given where the model's is not finite.

    Raises:
        ValueError: The function returns another shape or type; while tracing.
    """
    if model.odometry is None:
        return Q
    changed = model.odometry(custom, measurement, Q)
    check_array("noise_model.odometry(...)", changed, Q.shape, jnp.floating)
    return _finite_symmetric(changed.astype(Q.dtype), Q)


def _finite_symmetric(changed: Array, given: Array) -> Array:
    """Matrices (..., n, n), made symmetric; those `given` where one is not finite."""
    changed = (changed + jnp.swapaxes(changed, -1, -2)) / 2
    finite = jnp.all(jnp.isfinite(changed), axis=(-2, -1), keepdims=True)
    return jnp.where(finite, changed, given)
