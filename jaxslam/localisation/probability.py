"""The probability that a pose is right, of what is known of it: a logistic model."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array

RIGHT = (0.25, float(np.radians(5.0)))
"""[m], [rad] from the true pose within which a pose is right."""

COEFFICIENTS = (-8.6, 0.13, 11.6, 1.4, -31.0)
"""Of the model: constant, then of the features in their order. Of most likelihood on ACES, Intel,
Freiburg 101: each log in its own map, and in that of its first half, also where that shows nothing.
"""


def features(log_odds: Array, score: Array, driven: Array, std: Array) -> Array:
    """Features (4,) of a pose.

    Args:
        log_odds: () against all other hypotheses.
        score: () mean score of the last scans.
        driven: () [m] since it was found.
        std: () [m] largest std of its position.
    """
    path = jnp.log1p(jnp.minimum(driven, 10.0))
    return jnp.stack([log_odds, score, path, jnp.minimum(std, 1.0)])


def probability(values: Array) -> Array:
    """Probability () of a pose with these features (4,)."""
    constant, *weights = COEFFICIENTS
    return jax.nn.sigmoid(constant + values @ jnp.array(weights, values.dtype))
