import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.smoothing import arrowhead
from jaxslam.smoothing.arrowhead import Jacobian

T, M, L = 7, 3, 4


@jax.jit
def jitted(jacobian, prior, right):
    return arrowhead.solve_arrowhead(jacobian, prior, right)


def solve(*problem):
    return [np.asarray(x) for x in jitted(*jax.tree.map(jnp.asarray, problem))]


def jacobian_of(seed):
    """Odometry, one step of it sharp, and features, some masked; landmark 3 has none."""
    rng = np.random.default_rng(seed)
    root = np.tril(rng.normal(size=(T, 3, 3))) + 3 * np.eye(3)
    root[2] *= 100.0
    transition = np.eye(3) + rng.normal(size=(T, 3, 3)) * np.array(
        [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    )
    masked = rng.random((T, M, 1, 1)) < 0.3
    return Jacobian(
        odometry_root=root,
        transition=transition,
        odometry_cov=np.linalg.inv(root.swapaxes(1, 2) @ root),
        J_pose=np.where(masked, 0.0, rng.normal(size=(T, M, 2, 3))),
        J_landmark=np.where(masked, 0.0, rng.normal(size=(T, M, 2, 2))),
        landmark_index=rng.integers(0, L - 1, (T, M)).astype(np.int32),
    )


def dense(jacobian):
    """J (R, 3 T + 2 L), by the definition of a row, one at a time."""
    odometry, features = np.zeros((T, 3, 3 * T + 2 * L)), np.zeros((T, M, 2, 3 * T + 2 * L))
    for t in range(T):
        odometry[t, :, 3 * t : 3 * t + 3] = jacobian.odometry_root[t]
        if t:
            odometry[t, :, 3 * t - 3 : 3 * t] = -jacobian.odometry_root[t] @ jacobian.transition[t]
        for m in range(M):
            first = 3 * T + 2 * jacobian.landmark_index[t, m]
            features[t, m, :, 3 * t : 3 * t + 3] = jacobian.J_pose[t, m]
            features[t, m, :, first : first + 2] += jacobian.J_landmark[t, m]
    return np.concatenate([odometry.reshape(3 * T, -1), features.reshape(2 * T * M, -1)])


def flat(state):
    return np.concatenate([np.ravel(x) for x in state])


@pytest.mark.parametrize("seed", range(3))
def test_it_solves_the_dense_normal_equations(seed):
    rng, r = np.random.default_rng(seed), jacobian_of(seed)
    j, step = dense(r), (rng.normal(size=(T, 3)), rng.normal(size=(L, 2)))
    np.testing.assert_allclose(flat(arrowhead.apply_jacobian(r, step)), j @ flat(step), atol=1e-9)
    residuals = rng.normal(size=(T, 3)), rng.normal(size=(T, M, 2))
    found = flat(arrowhead.apply_transpose(r, residuals, num_landmarks=L))
    np.testing.assert_allclose(found, j.T @ flat(residuals), atol=1e-9)
    normal, index = j.T @ j, 3 * T + 2 * np.arange(L)
    prior = np.tile([[2.0, 0.5], [0.5, 1.0]], (L, 1, 1))
    blocks = arrowhead.landmark_blocks(r, num_landmarks=L)
    for k, first in enumerate(index):
        own = slice(first, first + 2)
        np.testing.assert_allclose(blocks[k], normal[own, own])
        normal[own, own] += prior[k]
    x = flat(solve(r, prior, step))
    np.testing.assert_allclose(x, np.linalg.solve(normal, flat(step)), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("path", ["tumbling", "straight"])
def test_single_precision_is_enough_for_sharp_odometry(path):
    """Sharp in some directions, vague in others, as of a robot that stands still or skids."""
    count = 40 * T
    if path == "tumbling":
        side = np.linalg.qr(np.random.default_rng(1).normal(size=(count, 3, 3)))[0]
        root = np.array([1e4, 1e4, 30.0])[:, None] * side
    else:
        c, s = np.cos(0.7), np.sin(0.7)
        root = np.array([1.0, 1e4, 1e4])[:, None] * np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        root = np.tile(root, (count, 1, 1))
    long = jax.tree.map(lambda x: np.tile(x, (40,) + (1,) * (x.ndim - 1)), jacobian_of(0))
    long = long._replace(odometry_root=root, odometry_cov=np.linalg.inv(root.swapaxes(1, 2) @ root))
    blind = np.abs(np.arange(count) - count // 2) < count // 2 - 20
    blind = blind[:, None, None, None] & (path == "straight")
    long = long._replace(
        J_pose=np.where(blind, 0.0, 20 * long.J_pose),
        J_landmark=np.where(blind, 0.0, 20 * long.J_landmark),
        transition=np.where(path == "straight", np.eye(3), long.transition),
    )

    def single(x):
        return jnp.asarray(x, jnp.int32 if x.dtype == np.int32 else jnp.float32)

    problem = long, np.tile(0.01 * np.eye(2), (L, 1, 1)), (np.ones((count, 3)), np.ones((L, 2)))
    full, half = solve(*problem), solve(*jax.tree.map(single, problem))
    for a, b in zip(full, half, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-3 * np.abs(a).max())


def test_a_matrix_that_is_not_positive_definite_gives_nan():
    right = np.ones((T, 3)), np.ones((L, 2))
    assert np.isnan(solve(jacobian_of(0), np.tile(-1e3 * np.eye(2), (L, 1, 1)), right)[1]).all()
