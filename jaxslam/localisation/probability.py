"""The probability that a pose is right, of what is known of it: a logistic model."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array

RIGHT = (0.25, float(np.radians(5.0)))
"""[m], [rad] from the true pose within which a pose is right."""

ODDS = (-5.0, 8.0)
"""Least and largest log odds that are told apart."""

COEFFICIENTS = (-12.0, 0.06, 16.8, 1.0, 0.6, -15.6)
"""Of the model: constant, then of the features in their order. Of most likelihood on ACES, Intel,
Freiburg 101: each log in its own map, and in that of its first half, also where that shows nothing.
"""


def features(log_odds: Array, score: Array, windows: Array, driven: Array, std: Array) -> Array:
    """Features (5,) of a pose.

    Args:
        log_odds: () against all other hypotheses.
        score: () mean score of its path.
        windows: () evidence of that mean, in windows.
        driven: () [m] since it was found.
        std: () [m] largest std of its position.
    """
    evidence, path = jnp.log(jnp.maximum(windows, 1.0)), jnp.log1p(jnp.minimum(driven, 10.0))
    return jnp.stack([log_odds.clip(*ODDS), score, evidence, path, jnp.minimum(std, 1.0)])


def probability(values: Array) -> Array:
    """Probability () of a pose with these features (5,)."""
    constant, *weights = COEFFICIENTS
    return jax.nn.sigmoid(constant + values @ jnp.array(weights, values.dtype))
