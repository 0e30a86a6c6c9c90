"""The probability that a pose is right, of what is known of it: a logistic model."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array

RIGHT = (0.25, float(np.radians(5.0)))
"""[m], [rad] from the true pose within which a pose is right."""

ODDS = (-5.0, 8.0)
"""Least and largest log odds that make a difference."""

COEFFICIENTS = (-12.66, 0.03, 17.72, 1.45, -15.19)
"""Of the model: constant, then of the features in their order. Of most likelihood, with wrong poses
weighed three times, on ACES, Intel, Freiburg 101 and MIT CSAIL, each mapped to its middle and then
driven on, inside and outside of that map: trials as in `experiments.localisation_probability`,
which also says how far they hold on a log that they were not fitted to.
"""


def features(log_odds: Array, score: Array, windows: Array, std: Array) -> Array:
    """Features (4,) of a pose.

    Args:
        log_odds: () against all other hypotheses.
        score: () mean score of its path.
        windows: () evidence of that mean, in windows.
        std: () [m] largest std of its position.
    """
    evidence = jnp.log(jnp.maximum(windows, 1.0))
    return jnp.stack([log_odds.clip(*ODDS), score, evidence, jnp.minimum(std, 1.0)])


def probability(values: Array) -> Array:
    """Probability () of a pose with these features (4,)."""
    constant, *weights = COEFFICIENTS
    return jax.nn.sigmoid(constant + values @ jnp.array(weights, values.dtype))
