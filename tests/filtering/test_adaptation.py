"""Scales of Q and R from innovations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.filtering.adaptation import Adaptation, AdaptationSpec, adapt, initial_adaptation
from jaxslam.filtering.config import FilterConfig, check_config, init, with_options
from jaxslam.filtering.joint_covariance import CovarianceBlocks, LinearizedMeasurements
from jaxslam.filtering.kalman import innovation_cov

SPEC = AdaptationSpec(memory=100.0)
adapt_once = jax.jit(partial(adapt, SPEC))
SIZE = jnp.array([2, 2, 1], jnp.int32)  # two points and a wall
Q = jnp.diag(jnp.array([0.02, 0.01, 0.005]))
TRUE = jnp.array([1.2, -0.8])  # logarithms of the variances' scales, of Q and R


def rows_of(seed=0):
    """Rows without innovations, R not scaled."""
    rng = np.random.default_rng(seed)
    H_pose, H_landmark = rng.normal(size=(3, 2, 3)), 0.2 * rng.normal(size=(3, 2, 2))
    R = np.tile(np.diag([0.01, 0.02]), (3, 1, 1))
    H_pose[2, 1], H_landmark[2, 1], R[2, 1, 1] = 0.0, 0.0, 1.0
    arrays = map(jnp.array, (np.zeros((3, 2)), H_pose, H_landmark, R))
    return LinearizedMeasurements(*arrays, jnp.arange(3, dtype=jnp.int32))


@jax.jit
def scaled(log_variance):
    """Covariance of a prediction with the scaled Q, scaled Q, and rows with scaled R."""
    by_q, by_r = jnp.exp(log_variance)
    rng = np.random.default_rng(1)
    root = rng.normal(size=(9, 9)) / 40
    cov = jnp.array(root @ root.T)
    rows = rows_of()
    blocks = CovarianceBlocks(cov[:3, :3] + by_q * Q, cov[:3, 3:], cov[3:, 3:])
    return blocks, by_q * Q, rows._replace(R=by_r * rows.R)


def innovations(key, steps):
    """Innovations (T, 3, 2) of a filter whose true scales are TRUE."""
    cov, _, rows = scaled(TRUE)
    root = jnp.linalg.cholesky(innovation_cov(cov, rows))
    v = (root[None] @ jax.random.normal(key, (steps, 6, 1))).reshape(steps, 3, 2)
    return v.at[:, 2, 1].set(0.0)  # a wall has one number


@partial(jax.jit, static_argnames="steps")
def adapted(key, *, steps):
    """Scales (2,) after T steps from nothing, and the information (2, 2) of the window."""

    def body(state, v):
        cov, own_q, rows = scaled(state.log_variance)
        return adapt(SPEC, state, cov, rows._replace(residual=v), SIZE, own_q), None

    start = initial_adaptation(float)
    end, _ = jax.lax.scan(body, start, innovations(key, steps))
    return end


def test_it_converges_to_the_true_scales_with_the_stated_spread():
    count = 100
    keys = jax.random.split(jax.random.key(0), count)
    end = jax.jit(jax.vmap(partial(adapted, steps=600)))(keys)
    error = np.asarray(end.log_variance) - np.asarray(TRUE)
    one_step = np.asarray(end.information.mean(axis=0)) / SPEC.memory
    expected = np.linalg.inv(one_step) / (2 * SPEC.memory - 1)
    # The bias of a maximum-likelihood estimate is of the order of its variance.
    limit = 4 * np.sqrt(np.diag(expected) / count) + 2 * np.diag(expected)
    assert (np.abs(error.mean(axis=0)) < limit).all()
    ratio = error.var(axis=0) / np.diag(expected)
    assert (np.abs(ratio - 1.0) < 4 * np.sqrt(2 / count) + 0.1).all()


def test_the_step_is_the_derivative_of_the_likelihood():
    """By autodiff of the Gaussian log-density of the numbers that count."""
    v = jax.jit(innovations, static_argnums=1)(jax.random.key(1), 1)[0]
    at = jnp.array([0.3, 0.2])

    @jax.jit
    def log_density(theta):
        cov, _, rows = scaled(theta)
        s = innovation_cov(cov, rows)[:5, :5]
        white = jnp.linalg.solve(s, v.reshape(-1)[:5])
        return -0.5 * (v.reshape(-1)[:5] @ white + jnp.linalg.slogdet(s)[1])

    cov, own_q, rows = scaled(at)
    rows = rows._replace(residual=v)
    start = Adaptation(at, 50.0 * jnp.eye(2))
    end = adapt_once(start, cov, rows, SIZE, own_q)
    metric = end.information + jnp.eye(2) / SPEC.prior_std**2
    step = metric @ (end.log_variance - at)
    np.testing.assert_allclose(step, jax.jit(jax.grad(log_density))(at), rtol=1e-9)


def test_innovations_that_are_not_finite_or_none_change_nothing():
    cov, own_q, rows = scaled(jnp.zeros(2))
    start = initial_adaptation(float)
    bad = rows._replace(residual=rows.residual.at[0, 0].set(jnp.nan))
    end = adapt_once(start, cov, bad, SIZE, own_q)
    np.testing.assert_array_equal(end.log_variance, start.log_variance)
    none = LinearizedMeasurements(*(jnp.zeros_like(x) for x in rows))._replace(
        R=jnp.tile(jnp.eye(2), (3, 1, 1))
    )
    end = adapt_once(start, cov, none, jnp.zeros(3, jnp.int32), own_q)
    np.testing.assert_array_equal(end.log_variance, start.log_variance)


def test_scales_keep_within_their_limits():
    cov, own_q, rows = scaled(jnp.zeros(2))
    far = rows._replace(residual=rows.residual + 1e3)
    end = adapt_once(initial_adaptation(float), cov, far, SIZE, own_q)
    assert np.exp(np.abs(end.log_variance) / 2).max() <= SPEC.max_factor * (1 + 1e-12)


def test_a_belief_has_scales_where_they_are_configured():
    plain = FilterConfig(max_landmarks=4)
    config = plain._replace(adaptation=SPEC)
    belief = init(config, jnp.zeros(3))
    np.testing.assert_array_equal(belief.adaptation.factors, [1.0, 1.0])
    assert init(plain, jnp.zeros(3)).adaptation is None
    assert with_options(plain, belief).adaptation is None


@pytest.mark.parametrize(
    ("spec", "problem"),
    [
        (3.0, "config.adaptation is float, not AdaptationSpec"),
        (SPEC._replace(memory=1.0), "config.adaptation.memory is 1.0, not a finite number at le"),
        (SPEC._replace(prior_std=0.0), "adaptation.prior_std is 0.0, not a finite number above 0"),
    ],
)
def test_a_wrong_specification_is_refused(spec, problem):
    with pytest.raises(ValueError, match=problem):
        check_config(FilterConfig(adaptation=spec))
