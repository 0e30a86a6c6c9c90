import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.stats import chi2

from jaxslam.evaluation import consistency

nees, rmse = jax.jit(consistency.nees), jax.jit(consistency.rmse)
slope_of_rmse = jax.jit(jax.grad(consistency.rmse))


def covariances(seed, count, k):
    """Well-conditioned covariances (count, k, k)."""
    a = np.random.default_rng(seed).normal(size=(count, k, k))
    return a @ a.transpose(0, 2, 1) + 0.1 * np.eye(k)


def test_pose_error_wraps_the_heading_only():
    error = consistency.pose_error(jnp.array([[9.0, 1.0, 3.1]]), jnp.array([[1.0, 2.0, -3.1]]))
    np.testing.assert_allclose(error, [[8.0, -1.0, 6.2 - 2 * np.pi]])


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_nees_equals_solving(k):
    cov = covariances(k, 50, k)
    error = np.random.default_rng(9).normal(size=(50, k))
    expected = np.sum(error * np.linalg.solve(cov, error[..., None])[..., 0], axis=-1)
    found = nees(jnp.array(error), jnp.array(cov))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(nees(jnp.array(error[7]), jnp.array(cov[7])), expected[7])


def test_nees_in_single_precision_with_unequal_scales():
    scale = np.array([3e-2, 2.0, 1e-3])  # std of a pose known well along one direction only
    corr = np.array([[1.0, 0.99, -0.9], [0.99, 1.0, -0.9], [-0.9, -0.9, 1.0]])
    cov = corr * np.outer(scale, scale)
    error = scale * np.array([0.5, -0.4, 1.2])
    found = nees(jnp.array(error, jnp.float32), jnp.array(cov, jnp.float32))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, error @ np.linalg.solve(cov, error), rtol=1e-4)


def test_nees_of_invalid_numbers_is_infinite_with_zero_gradient():
    cov = np.stack([np.eye(3)] * 5)
    error = np.ones((5, 3))
    error[0, 1] = np.nan
    cov[1, 2, 2] = np.inf
    cov[2, 0, 0] = -1.0
    cov[3] = 1.0  # singular
    found = nees(jnp.array(error), jnp.array(cov))
    np.testing.assert_array_equal(found, [np.inf] * 4 + [3.0])

    def total(error, cov):
        values = consistency.nees(error, cov)
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0.0))

    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))
    by_error, by_cov = slopes(jnp.array(error), jnp.array(cov))
    np.testing.assert_array_equal(by_error, [[0.0] * 3] * 4 + [[2.0] * 3])
    assert jnp.isfinite(by_cov).all() and not by_cov[:4].any() and by_cov[4].any()


def test_nees_gradient_matches_finite_differences():
    error, cov = jnp.array([0.3, -0.2, 0.1]), jnp.array(covariances(4, 1, 3)[0])
    check_grads(lambda scale: nees(error, scale * cov), (1.3,), order=1, rtol=1e-5)


def test_rmse_ignores_what_the_mask_leaves_out():
    values, mask = jnp.array([3.0, jnp.nan, 4.0, 100.0]), jnp.array([True, False, True, False])
    np.testing.assert_allclose(rmse(values, mask), np.sqrt(12.5))
    slope = slope_of_rmse(values, mask)
    np.testing.assert_allclose(slope, np.array([3.0, 0.0, 4.0, 0.0]) / 2 / np.sqrt(12.5))


def test_rmse_of_nothing_and_of_no_error():
    values, none = jnp.array([1.0, 2.0]), jnp.array([False, False])
    assert jnp.isnan(rmse(values, none))
    assert not slope_of_rmse(values, none).any()
    zero, everything = jnp.zeros(2), jnp.array([True, True])
    assert rmse(zero, everything) == 0.0
    assert not slope_of_rmse(zero, everything).any()


@pytest.mark.parametrize("dof, count, probability", [(3, 1, 0.95), (3, 100, 0.95), (2, 7, 0.99)])
def test_chi_square_bounds_equal_the_quantiles(dof, count, probability):
    low, high = consistency.chi_square_bounds(dof, count, probability)
    assert low < dof < high
    np.testing.assert_allclose(chi2.cdf(low * count, dof * count), (1 - probability) / 2)
    np.testing.assert_allclose(chi2.sf(high * count, dof * count), (1 - probability) / 2)


def test_nees_per_dof_of_a_consistent_filter_is_about_one():
    cov, rng = covariances(5, 1, 3)[0], np.random.default_rng(5)
    error = rng.multivariate_normal(np.zeros(3), cov, 4000)
    values = np.asarray(nees(error, np.tile(cov, (4000, 1, 1))))
    low, high = consistency.chi_square_bounds(3, 4000, 0.999)
    assert low < values.mean() < high
    assert consistency.nees_per_dof(values.mean()) == values.mean() / 3
    assert abs(consistency.nees_per_dof(values.mean()) - 1.0) < 0.05
    np.testing.assert_array_equal(consistency.nees_per_dof(values, dof=2), values / 2)


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"error": np.zeros((4, 2))}, r"cov is float64 \(4, 3, 3\), not floating \(4, 2, 2\)"),
        ({"error": np.zeros((5, 3))}, r"cov is float64 \(4, 3, 3\), not floating \(5, 3, 3\)"),
        ({"error": 1.0}, r"error is .* \(\), not floating \(..., k\)"),
        ({"error": "none"}, "error is .*, not numbers"),
        ({"cov": np.zeros((4, 3))}, r"cov is float64 \(4, 3\), not floating \(4, 3, 3\)"),
    ],
)
def test_nees_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"error": np.zeros((4, 3)), "cov": np.stack([np.eye(3)] * 4)}
    with pytest.raises(ValueError, match=problem):
        consistency.nees(**{**given, **wrong})


@pytest.mark.parametrize(
    "estimate, truth, problem",
    [
        (np.zeros((4, 2)), np.zeros((4, 2)), r"estimate is float64 \(4, 2\), not .*\(..., 3\)"),
        (np.zeros((4, 3)), np.zeros((5, 3)), r"truth is float64 \(5, 3\), not .*\(4, 3\)"),
        (np.zeros((4, 3)), np.zeros((4, 3), bool), r"truth is bool \(4, 3\), not numbers"),
    ],
)
def test_pose_error_names_the_argument_that_does_not_fit(estimate, truth, problem):
    with pytest.raises(ValueError, match=problem):
        consistency.pose_error(estimate, truth)


@pytest.mark.parametrize(
    "arguments, problem",
    [
        ((0, 1), "dof is 0, not a number >= 1"),
        ((3, 0), "count is 0, not a number >= 1"),
        ((3, 1, 1.0), "probability is 1.0, not between 0 and 1"),
    ],
)
def test_chi_square_bounds_name_the_argument_that_does_not_fit(arguments, problem):
    with pytest.raises(ValueError, match=problem):
        consistency.chi_square_bounds(*arguments)


def test_lists_numpy_and_jax_arrays_give_the_same_nees():
    error, cov = np.array([[0.5, -1.0, 0.25], [1, 2, 3]]), np.stack([np.diag([1.0, 2.0, 4.0])] * 2)
    want = consistency.nees(jnp.asarray(error), jnp.asarray(cov))
    for convert in (np.ndarray.tolist, np.float32, np.float64):
        np.testing.assert_array_equal(consistency.nees(convert(error), convert(cov)), want)
        found = consistency.pose_error(convert(error), convert(error[::-1]))
        np.testing.assert_array_equal(found, consistency.pose_error(error, error[::-1]))
    np.testing.assert_array_equal(consistency.nees([1, 2, 3], np.eye(3, dtype=int)), 14.0)
