import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import linalg


@pytest.mark.parametrize("size", [1, 6, 7])
def test_the_inverse_cholesky_factor_is_that_of_numpy(size):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    s = root @ root.T + 0.1 * np.eye(size)
    inverse, logdet, good = jax.jit(linalg.inverse_cholesky)(jnp.array(s))
    np.testing.assert_allclose(inverse, np.linalg.inv(np.linalg.cholesky(s)), atol=1e-10)
    np.testing.assert_allclose(logdet, np.linalg.slogdet(s)[1], rtol=1e-10)
    assert good


@pytest.mark.parametrize("bad", [[[1.0, 2.0], [2.0, 1.0]], [[0.0, 0.0], [0.0, 1.0]], np.nan])
def test_a_matrix_that_is_not_positive_definite_has_no_factor(bad):
    s = jnp.full((2, 2), bad) if np.ndim(bad) == 0 else jnp.array(bad)
    inverse, logdet, good = linalg.inverse_cholesky(s)
    assert not good and not inverse.any() and logdet == 0


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("count", [1, 4, 11])
def test_outer_products_are_added(sign, count):
    rng = np.random.default_rng(count)
    start, left, right = (rng.normal(size=s) for s in ((3, 5), (count, 3), (count, 5)))
    added = jax.jit(linalg.add_outer_products, static_argnames="sign")
    result = added(start, left, right, sign=sign)
    np.testing.assert_allclose(result, start + sign * left.T @ right, atol=1e-13)


def batch_of_rows(seed=0, batch=3, size=6, count=2):
    """Symmetric matrices, rows for them, and where these go: to two places, to one, to none."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(batch, size, size))
    rows = rng.normal(size=(batch, count, size))
    at = np.array([[4, 1], [size, 3], [size, size]], np.int32)
    return jnp.array(matrix + matrix.swapaxes(1, 2)), jnp.array(rows), jnp.array(at)


def slow_put_rows(matrix, rows, at):
    matrix = np.array(matrix)
    for row, i in zip(rows, at, strict=True):
        if i < len(matrix):
            matrix[i] = row
    for row, i in zip(rows, at, strict=True):
        if i < len(matrix):
            matrix[:, i] = row
    return matrix


def slow_downdate(matrix, y, wanted):
    return matrix - y.T @ y if wanted else matrix


def members(batched):
    """The arguments of each member of a batch."""
    return list(zip(*batched, strict=True))


def test_rows_are_put_into_some_members_of_a_batch_or_none():
    given = batch_of_rows()
    right = [slow_put_rows(*one) for one in members(given)]
    np.testing.assert_array_equal(jax.jit(jax.vmap(linalg.put_rows))(*given), right)
    for one, want in zip(members(given), right, strict=True):
        np.testing.assert_array_equal(linalg.put_rows(*one), want)
    nowhere = given[0], given[1], jnp.full((3, 2), 6, jnp.int32)
    np.testing.assert_array_equal(jax.vmap(linalg.put_rows)(*nowhere), given[0])


def test_some_members_of_a_batch_are_downdated_or_none():
    matrix, y, _ = batch_of_rows(1)
    for wanted in ([True, False, True], [False] * 3):
        wanted = jnp.array(wanted)
        y = jnp.where(wanted[:, None, None], y, 0.0)
        right = [slow_downdate(*one) for one in members((matrix, y, wanted))]
        np.testing.assert_allclose(
            jax.jit(jax.vmap(linalg.downdate_rarely))(matrix, y, wanted), right
        )


@pytest.mark.parametrize("batched", [False, True])
def test_derivatives_of_rare_updates_are_those_of_the_formulas(batched):
    matrix, rows, at = batch_of_rows(2)
    weight = jnp.array(np.random.default_rng(3).normal(size=matrix.shape))

    def many(f):
        return jax.vmap(f) if batched else lambda *x: jnp.stack([f(*one) for one in members(x)])

    def formula(matrix, rows, at):
        return matrix.at[at].set(rows, mode="drop").at[:, at].set(rows.T, mode="drop")

    def downdated(matrix, y, at):
        wanted = jnp.any(at < 6)
        return linalg.downdate_rarely(matrix, jnp.where(wanted, y, 0.0), wanted)

    def formula_of_downdate(matrix, y, at):
        y = jnp.where(jnp.any(at < 6), y, 0.0)
        return matrix - y.T @ y

    def gradient(f):
        def total(matrix, rows):
            return jnp.sum(weight * many(f)(matrix, rows, at))

        return jax.jit(jax.grad(total, (0, 1)))(matrix, rows)

    for f, expected in ((linalg.put_rows, formula), (downdated, formula_of_downdate)):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12),
            gradient(f),
            gradient(expected),
        )
