"""The covariance rate of odometry beside its four coefficients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxslam.core.se2 import compose
from jaxslam.filtering.inputs import check_params
from jaxslam.filtering.motion_model import odometry_cov, odometry_rate_cov
from jaxslam.filtering.noise import NoiseParams

INCREMENT = jnp.array([0.3, 0.1, 0.5])
RATE = jnp.array([[0.04, 0.01, -0.005], [0.01, 0.02, 0.003], [-0.005, 0.003, 0.01]])


@pytest.mark.parametrize("increment", [[0.3, 0.1, 0.5], [-0.2, 0.0, 0.0], [0.0, 0.0, 0.7]])
def test_a_diagonal_rate_is_two_of_the_coefficients(increment):
    increment = jnp.array(increment)
    coefficients = jnp.array([0.1, 0.0, 0.2, 0.0])
    rate = jnp.diag(jnp.array([0.1, 0.0, 0.2]) ** 2)
    np.testing.assert_allclose(
        odometry_rate_cov(rate, increment), odometry_cov(coefficients, increment), atol=1e-15
    )


def test_straight_increments_in_parts_have_the_covariance_of_the_whole():
    part, whole = jnp.array([0.1, 0.0, 0.0]), jnp.array([0.3, 0.0, 0.0])
    added = jnp.zeros((3, 3))
    for _ in range(3):  # the heading's error swings the next part
        swing = jnp.eye(3).at[1, 2].set(part[0])
        added = swing @ added @ swing.T + odometry_rate_cov(RATE, part)
    np.testing.assert_allclose(added, odometry_rate_cov(RATE, whole), atol=1e-15)


def test_it_is_the_covariance_of_errors_that_are_added_all_along_the_increment():
    """On an almost straight increment; the curvature within one is neglected."""
    increment, steps, draws = jnp.array([0.6, 0.02, 0.05]), 20, 20_000
    chord = jnp.hypot(increment[0], increment[1]) / steps
    root = jnp.linalg.cholesky(RATE * 1e-3 * chord)  # small: errors of first order

    def drive(errors):
        def body(k, pose):
            return compose(compose(pose, increment / steps), root @ errors[k])

        return jax.lax.fori_loop(0, steps, body, jnp.zeros(3))

    errors = jax.random.normal(jax.random.key(0), (draws, steps, 3))
    ends = jax.jit(jax.vmap(drive))(errors)
    sample, model = jnp.cov(ends.T), np.asarray(odometry_rate_cov(RATE * 1e-3, increment))
    spread = np.sqrt((np.outer(np.diag(model), np.diag(model)) + model**2) / draws)
    discrete = 0.06 * np.sqrt(np.outer(np.diag(model), np.diag(model)))  # of 20 steps, and curved
    assert (np.abs(sample - model) < 4 * spread + discrete).all()


def test_its_derivative_is_that_of_differences_and_finite_at_rest():
    weight = jnp.arange(9.0).reshape(3, 3)

    @jax.jit
    def value(rate, increment):
        return jnp.sum(weight * odometry_rate_cov(rate, increment))

    check_grads(value, (RATE, INCREMENT), order=1, modes=["rev"])
    grads = jax.jit(jax.grad(value, argnums=(0, 1)))(RATE, jnp.zeros(3))
    assert all(np.isfinite(g).all() for g in grads)


@pytest.mark.parametrize(
    ("rate", "problem"),
    [
        (np.eye(2), r"odometry_cov_rate is float64 \(2, 2\), not"),
        (np.diag([1.0, 1.0, -1.0]), "odometry_cov_rate is not positive semi-definite"),
        (np.eye(3) + np.triu(np.ones((3, 3)), 1), "odometry_cov_rate is not symmetric"),
    ],
)
def test_a_wrong_rate_is_refused(rate, problem):
    params = NoiseParams.for_simulated_robot()._replace(odometry_cov_rate=rate)
    with pytest.raises(ValueError, match=problem):
        check_params(params)
