import re

import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.tuning import fitting, standard_errors
from jaxslam.tuning.model import Model
from jaxslam.tuning.optimizers import MAX_CHANGE, newton
from jaxslam.tuning.transforms import POSITIVE

HESSIAN = np.array([[2.0, 1.8], [1.8, 2.0]])


def minimised(optimizer, gradient, start, updates):
    state, theta = optimizer.init(jnp.asarray(start)), jnp.asarray(start)
    for _ in range(updates):
        change, state = optimizer.update(gradient(theta), state, theta)
        assert jnp.abs(change).max() <= MAX_CHANGE * (1 + 1e-12)
        theta = theta + change
    return theta


def test_a_correlated_quadratic_is_minimised_in_one_step_within_reach():
    best = jnp.array([0.1, -0.2])
    found = minimised(newton(HESSIAN), lambda x: HESSIAN @ (x - best), [0.0, 0.0], 1)
    np.testing.assert_allclose(found, best, atol=1e-14)
    far = minimised(newton(HESSIAN), lambda x: HESSIAN @ (x - best), [3.0, -2.0], 9)
    np.testing.assert_allclose(far, best, atol=1e-14)


def test_flat_directions_stay():
    flat = np.outer([1.0, 1.0], [1.0, 1.0])
    found = minimised(newton(flat), lambda x: flat @ x + jnp.array([0.01, -0.01]), [0.1, 0.1], 3)
    np.testing.assert_allclose(found, [0.0, 0.0], atol=1e-14)


def test_the_hessian_of_a_problem_finishes_its_tuning():
    """The variance of normal numbers, whose best value has a closed form."""
    data = jnp.asarray(np.random.default_rng(0).normal(0.0, 3.0, (40, 5)))
    model = Model(lambda params, x: 0.0, lambda params, state, x: (state, (params["std"], x)))

    def nll(info, data):
        std, x = info
        return jnp.mean(jnp.log(std) + 0.5 * (x / std) ** 2)

    near = {"std": jnp.float64(2.4)}
    problem = fitting.prepare(model, near, data, nll, transforms=POSITIVE)
    hessian, _ = standard_errors.second_derivatives(
        problem, np.log([2.4]), np.ones(1, bool), POSITIVE
    )
    found = fitting.tune(
        *(model, near, data),
        loss=nll,
        transforms=POSITIVE,
        num_updates=8,
        optimizer=newton(hessian),
    )
    np.testing.assert_allclose(found.params["std"], jnp.sqrt(jnp.mean(data**2)), rtol=1e-4)


@pytest.mark.parametrize(
    "hessian, message",
    [
        (np.eye(3)[:2], "hessian has the shape (2, 3), not (F, F)"),
        (np.full((2, 2), np.nan), "hessian is not finite"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "hessian is not symmetric"),
        (-np.eye(2), "no positive eigenvalue"),
    ],
)
def test_what_is_no_hessian_of_a_minimum_is_refused(hessian, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        newton(hessian)
