"""A deferred covariance, against the same operations on a dense matrix, one by one."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.filtering import covariance
from jaxslam.filtering.covariance import DeferredCovariance

L, K = 6, 4
OPERATIONS = "downdate", "downdate_rarely", "put_rows", "slot_rows", "slot_blocks", "flush"


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Capacity for few rows, so that it is flushed now and then, in two strips and a remainder."""
    monkeypatch.setattr(covariance, "MAX_DEFERRED_ROWS", 11)
    monkeypatch.setattr(covariance, "STRIP_ROWS", 5)


def assert_close(a, b):
    np.testing.assert_allclose(a, b, atol=1e-10)


def start(rng):
    root = rng.normal(size=(2 * L, 2 * L))
    return root @ root.T + np.eye(2 * L)


@pytest.fixture(scope="module")
def jitted():
    """The operations, compiled; `MAX_DEFERRED_ROWS` is looked up when they are traced."""
    jitted = SimpleNamespace()
    for name in OPERATIONS:
        setattr(jitted, name, jax.jit(getattr(covariance, name)))
    jitted.flush_if_full = jax.jit(covariance.flush_if_full, static_argnums=1)
    return jitted


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("deferred", [False, True])
def test_a_deferred_covariance_equals_the_dense_matrix(seed, deferred, jitted):
    rng = np.random.default_rng(seed)
    dense = start(rng)
    cov = covariance.defer(jnp.asarray(dense)) if deferred else jnp.asarray(dense)
    for _ in range(25):
        cov = jitted.flush_if_full(cov, K)
        operation = rng.integers(3)
        if operation == 0:
            y = 0.1 * rng.normal(size=(K, 2 * L)) * (rng.random(K) < 0.6)[:, None]
            dense = dense - y.T @ y
            cov = jitted.downdate(cov, y, np.bool_(False))
        elif operation == 1:
            wanted = rng.random() < 0.5
            y = 0.1 * rng.normal(size=(2, 2 * L)) * wanted
            dense = dense - y.T @ y
            cov = jitted.downdate_rarely(cov, y, np.bool_(wanted))
        else:
            at = np.where(rng.random(K) < 0.5, rng.permutation(2 * L)[:K], 2 * L).astype(np.int32)
            rows, inside = rng.normal(size=(K, 2 * L)), at < 2 * L
            block = rng.normal(size=(K, K))
            rows[:, at[inside]] = (block + block.T)[:, inside]
            dense[at[inside]] = rows[inside]
            dense[:, at[inside]] = rows[inside].T
            cov = jitted.put_rows(cov, rows, at)
        slot = rng.integers(0, L, 3).astype(np.int32)
        blocks = dense.reshape(L, 2, L, 2)
        assert_close(jitted.slot_rows(cov, slot), dense.reshape(L, 2, -1)[slot])
        assert_close(jitted.slot_blocks(cov), blocks[np.arange(L), :, np.arange(L)])
        assert_close(jitted.flush(cov), dense)
    assert isinstance(cov, DeferredCovariance) == deferred


@pytest.mark.parametrize("deferred", [False, True])
def test_in_single_precision_it_stays_positive_definite(deferred):
    """Many updates in four directions whose variance is almost gone."""
    rng = np.random.default_rng(0)
    cov = jnp.asarray(start(rng), jnp.float32)
    H = jnp.asarray(rng.normal(size=(4, 2 * L)), jnp.float32)

    def update(_, cov):
        cov = covariance.flush_if_full(cov, 4)
        whole = covariance.slot_rows(cov, jnp.arange(L, dtype=jnp.int32)).reshape(2 * L, 2 * L)
        hp = H @ whole
        s = hp @ H.T + 1e-5 * jnp.eye(4, dtype=jnp.float32)
        y = jnp.linalg.solve(jnp.linalg.cholesky(s), hp)
        y = jnp.where(jnp.all(jnp.isfinite(y)), y, 0.0)  # as `kalman_update` leaves out what fails
        return covariance.downdate(cov, y, jnp.bool_(True))

    run = jax.jit(lambda cov: covariance.flush(jax.lax.fori_loop(0, 30_000, update, cov)))
    after = np.asarray(run(covariance.defer(cov) if deferred else cov), np.float64)
    assert np.linalg.eigvalsh(after).min() > 0.0
    np.testing.assert_allclose(after, after.T, atol=1e-6)
