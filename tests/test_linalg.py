import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import linalg


@pytest.mark.parametrize("size", [1, 6, 7])
def test_the_inverse_root_is_that_of_cholesky(size):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    s = root @ root.T + 0.1 * np.eye(size)
    inverse, logdet, good = jax.jit(linalg.inverse_root)(jnp.array(s))
    np.testing.assert_allclose(inverse, np.linalg.inv(np.linalg.cholesky(s)), atol=1e-10)
    np.testing.assert_allclose(logdet, np.linalg.slogdet(s)[1], rtol=1e-10)
    assert good


@pytest.mark.parametrize("bad", [[[1.0, 2.0], [2.0, 1.0]], [[0.0, 0.0], [0.0, 1.0]], np.nan])
def test_a_matrix_that_is_not_positive_definite_has_no_root(bad):
    s = jnp.full((2, 2), bad) if np.ndim(bad) == 0 else jnp.array(bad)
    inverse, logdet, good = linalg.inverse_root(s)
    assert not good and not inverse.any() and logdet == 0


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("count", [1, 4, 11])
def test_products_are_added(sign, count):
    rng = np.random.default_rng(count)
    start, left, right = (rng.normal(size=s) for s in ((3, 5), (count, 3), (count, 5)))
    ours = jax.jit(linalg.add_products, static_argnames="sign")(start, left, right, sign=sign)
    np.testing.assert_allclose(ours, start + sign * left.T @ right, atol=1e-13)
