"""Drives among four landmarks with known data association, for which the filter's model is true."""

from functools import partial

import jax
import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import compose, range_bearing, relative, wrap_angle
from jaxslam.core.types import JUNCTION
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.motion_model import odometry_cov
from jaxslam.filtering.noise import NoiseParams, measurement_cov
from jaxslam.filtering.odometry_bias import correct_odometry
from jaxslam.frontend.features import features_from_range_bearing

LANDMARKS = jnp.array([[3.0, 0.5], [1.0, 4.0], [-2.0, 3.0], [2.0, -2.0]])
COMMAND = jnp.array([0.2, 0.0, 0.06])  # a circle
CONFIG = FilterConfig(max_landmarks=4, max_updates=4, max_new=4, landmark_kinds=(JUNCTION,))
PARAMS = NoiseParams(
    *(jnp.asarray(x, float) for x in ([0.02, 0.01, 0.02, 0.02], 0.02, 0.01, 1.0, 0.01))
)


def drive(key, params=PARAMS, bias=None, *, steps):
    """True poses (T, 3) from the origin, and measurements [T], of one drive.

    Args:
        key: Of the noise.
        params: Of Q, by its coefficients, and of R.
        bias: (3,) of the odometry.
        steps: T.
    """

    def body(pose, key):
        keys = jax.random.split(key, 2)
        root = jnp.linalg.cholesky(odometry_cov(params.odometry_coefficients, COMMAND))
        reported = COMMAND if bias is None else correct_odometry(bias, COMMAND)
        pose = compose(pose, reported + root @ jax.random.normal(keys[0], (3,)))
        offsets = jax.vmap(lambda p: relative(pose, jnp.append(p, 0.0))[:2])(LANDMARKS)
        polar = jax.vmap(range_bearing)(offsets)
        exact = Measurement(COMMAND, features_from_range_bearing(polar, jnp.ones(4, bool)))
        R = measurement_cov(params, exact.features, exact)
        std = jnp.sqrt(jnp.diagonal(R, axis1=1, axis2=2))
        polar += std * jax.random.normal(keys[1], polar.shape)
        polar = jnp.stack([polar[:, 0], wrap_angle(polar[:, 1])], axis=1)
        return pose, (pose, features_from_range_bearing(polar, jnp.ones(4, bool)))

    _, (poses, features) = jax.lax.scan(body, jnp.zeros(3), jax.random.split(key, steps))
    ids = jnp.broadcast_to(jnp.arange(4, dtype=jnp.int32), (steps, 4))
    odometry = jnp.broadcast_to(COMMAND, (steps, 3))
    return poses, Measurement(odometry, Features(*features), ids)


@partial(jax.jit, static_argnames=("count", "steps"))
def drives(key, params=PARAMS, bias=None, *, count, steps):
    """[B] of `drive`."""
    keys = jax.random.split(key, count)
    return jax.vmap(lambda key: drive(key, params, bias, steps=steps))(keys)
