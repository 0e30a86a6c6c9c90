"""The Kalman update and its derivative, against the textbook's formulas and theirs."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.linalg import inverse_cholesky
from jaxslam.filtering import covariance
from jaxslam.filtering.joint_covariance import CovarianceBlocks, LinearizedMeasurements
from jaxslam.filtering.kalman import Innovation, kalman_update, project

L, M = 5, 3
WEIGHT = np.random.default_rng(9).normal(size=(2, 3 + 2 * L, 3 + 2 * L))


def problem(seed, *, used=M):
    """A covariance (D, D) and M measurements, of which `used` are not padding."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3 + 2 * L, 3 + 2 * L))
    r = rng.normal(size=(M, 2, 2))
    keep = (np.arange(M) < used)[:, None]
    rows = LinearizedMeasurements(
        residual=np.where(keep, rng.normal(size=(M, 2)), 0.0),
        H_pose=np.where(keep[..., None], rng.normal(size=(M, 2, 3)), 0.0),
        H_landmark=np.where(keep[..., None], rng.normal(size=(M, 2, 2)), 0.0),
        R=np.where(keep[..., None], r @ r.transpose(0, 2, 1) + np.eye(2), np.eye(2)),
        slot=np.where(keep[:, 0], rng.permutation(L)[:M], 0).astype(np.int32),
    )
    return jnp.array(root @ root.T), jax.tree.map(jnp.asarray, rows)


def blocks(cov):
    return CovarianceBlocks(cov[:3, :3], cov[:3, 3:], cov[3:, 3:])


def whole(cov):
    return jnp.block([[cov.pose, cov.cross], [cov.cross.T, cov.map]])


def textbook(cov, rows):
    """Shift, covariance, nis and log det by dense matrices and an inverse."""
    h = jnp.zeros((2 * M, len(cov)))
    for k in range(M):
        at = 3 + 2 * rows.slot[k] + jnp.arange(2, dtype=jnp.int32)
        h = h.at[2 * k : 2 * k + 2, :3].set(rows.H_pose[k])
        h = h.at[2 * k : 2 * k + 2, at].set(rows.H_landmark[k])
    r = jax.scipy.linalg.block_diag(*rows.R)
    s, v = h @ cov @ h.T + r, rows.residual.ravel()
    gain = cov @ h.T @ jnp.linalg.inv(s)
    after = cov - gain @ s @ gain.T
    return gain @ v, after, v @ jnp.linalg.inv(s) @ v, jnp.linalg.slogdet(s)[1]


def ours(cov, rows):
    result = kalman_update(blocks(cov), rows)
    return result.shift, whole(result.cov), result.nis, result.logdet


@pytest.mark.parametrize("large", [0, 10**6], ids=["zeros left out", "all at once"])
@pytest.mark.parametrize("used", [M, 1, 0])
def test_the_update_equals_the_textbook(used, large, monkeypatch):
    monkeypatch.setattr(covariance, "LARGE_MAP", large)
    cov, rows = problem(used, used=used)

    def traced_anew(cov, rows):  # what was compiled before has another `LARGE_MAP`
        return ours(cov, rows)

    for mine, theirs in zip(jax.jit(traced_anew)(cov, rows), textbook(cov, rows), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-10)


@pytest.mark.parametrize("used", [M, 1])
def test_an_innovation_that_is_known_gives_the_same_update_and_derivative(used):
    cov, rows = problem(used, used=used)

    @partial(jax.jit, static_argnums=0)
    def update_and_slope(is_known, cov, rows):
        def update(cov, rows):
            known = None
            if is_known:
                products, s = jax.lax.stop_gradient(project(blocks(cov), rows))
                known = Innovation(*products, *inverse_cholesky(s))
            return kalman_update(blocks(cov), rows, known)

        def loss(cov, residual):
            result = update(cov, rows._replace(residual=residual))
            return (
                result.nis + result.logdet + jnp.sum(jnp.sin(result.shift)) + result.cov.map[1, 2]
            )

        return update(cov, rows), jax.grad(loss, argnums=(0, 1))(cov, rows.residual)

    same = partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
    jax.tree.map(same, update_and_slope(True, cov, rows), update_and_slope(False, cov, rows))


@partial(jax.jit, static_argnums=0)
def slopes(step, mix, cov, rows, slot):
    """Derivative by covariance and rows of a mixture of all results of two updates."""

    def loss(cov, rows):
        # Symmetric, whatever the derivative is taken by.
        cov = (cov + cov.T) / 2
        noise = (rows.R + jnp.swapaxes(rows.R, 1, 2)) / 2
        rows, total = rows._replace(R=noise, slot=slot), 0.0
        for part in mix:
            shift, cov, nis, logdet = step(cov, rows)
            terms = [shift @ WEIGHT[0, 0], jnp.sum(cov * WEIGHT[1]), nis, logdet]
            total += part @ jnp.stack(terms)
            rows = rows._replace(residual=rows.residual + jnp.sin(shift[None, :2]))
        return total

    return jax.grad(loss, argnums=(0, 1))(cov, rows)


@pytest.mark.parametrize("part", range(5), ids=["shift", "cov", "nis", "log det", "all, twice"])
@pytest.mark.parametrize("used", [M, 2])
def test_the_derivative_equals_that_of_the_textbook(part, used):
    cov, rows = problem(10 + used, used=used)
    mix = jnp.ones((2, 4)) if part == 4 else jnp.zeros((2, 4)).at[0, part].set(1.0)
    # By leaves of floating point; the slots are integers.
    data = cov, rows._replace(slot=None), rows.slot
    mine, theirs = (slopes(step, mix, *data) for step in (ours, textbook))
    keep = np.arange(M) < used  # the residual and noise of padding mean nothing

    def cut(gradient):
        return gradient[0], jax.tree.map(lambda x: x[keep], gradient[1])

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9), cut(mine), cut(theirs)
    )


def test_an_update_that_is_not_positive_definite_changes_nothing_nor_its_neighbours():
    cov, rows = problem(3)
    bad = rows._replace(R=rows.R.at[1].set(-1e4 * jnp.eye(2)))
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), bad, rows)

    def loss(noise):
        shift, after, nis, logdet = jax.vmap(ours, (None, 0))(cov, both._replace(R=noise))
        return jnp.sum(shift) + jnp.sum(after) + jnp.sum(nis + logdet), (shift, after)

    (_, (shift, after)), slope = jax.jit(jax.value_and_grad(loss, has_aux=True))(both.R)
    assert not shift[0].any()
    np.testing.assert_array_equal(after[0], cov)
    np.testing.assert_allclose(after[1], textbook(cov, rows)[1], atol=1e-10)
    assert np.isfinite(slope).all() and not slope[0].any() and slope[1].any()
    good = jax.jit(jax.vmap(lambda rows: kalman_update(blocks(cov), rows).ok))(both)
    np.testing.assert_array_equal(good, [False, True])
