from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2 as se2_module
from jaxslam.core import se2_np

SEEDS = range(5)
se2 = SimpleNamespace(
    **{k: jax.jit(f) for k, f in vars(se2_module).items() if hasattr(se2_np, k) and callable(f)},
    **{k: jax.jit(getattr(se2_module, k)) for k in ("cross", "dot", "range_bearing", "rotation")},
    **{k: jax.jit(getattr(se2_module, k)) for k in ("unit_vector", "wrap_direction")},
)


def poses(seed):
    """Three poses (3, 3) up to some metres from the origin, with any heading."""
    return np.random.default_rng(seed).uniform(-3.1, 3.1, (3, 3))


def matrix(pose):
    """Homogeneous matrix (3, 3) of a pose."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])


@pytest.mark.parametrize("seed", SEEDS)
def test_compose_multiplies_matrices(seed):
    a, b, _ = poses(seed)
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_compose_is_a_group(seed):
    a, b, c = poses(seed)
    zero = jnp.zeros(3)
    left, right = se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c))
    np.testing.assert_allclose(se2.relative(left, right), zero, atol=1e-12)
    np.testing.assert_allclose(se2.compose(a, zero), a, atol=1e-12)
    np.testing.assert_allclose(se2.compose(zero, a), a, atol=1e-12)
    np.testing.assert_allclose(se2.compose(a, se2.relative(a, zero)), zero, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_relative_is_the_inverse_of_compose(seed):
    a, b, _ = poses(seed)
    np.testing.assert_allclose(se2.compose(a, se2.relative(a, b)), b, atol=1e-12)
    np.testing.assert_allclose(se2.relative(a, se2.compose(a, b)), b, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_inverse_transform_is_the_inverse_of_transform(seed):
    pose = poses(seed)[0]
    points = np.random.default_rng(seed + 100).normal(size=(4, 7, 2))
    there = se2.transform(pose, points)
    np.testing.assert_allclose(se2.inverse_transform(pose, there), points, atol=1e-12)
    np.testing.assert_allclose(there[2, 3], (matrix(pose) @ [*points[2, 3], 1])[:2], atol=1e-12)
    turned = se2.rotation(pose[2]) @ points[2, 3] + pose[:2]
    np.testing.assert_allclose(there[2, 3], turned, atol=1e-12)


def test_wrap_angle_keeps_the_direction_and_the_slope():
    angles = np.linspace(-20, 20, 401)
    wrapped = se2.wrap_angle(angles)
    assert np.all((wrapped >= -np.pi) & (wrapped < np.pi))
    np.testing.assert_allclose(se2.unit_vector(wrapped), se2.unit_vector(angles), atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(se2.wrap_angle)))(angles), 1.0)


def test_wrap_direction_keeps_the_line():
    angles = np.linspace(-20, 20, 401)
    wrapped = se2.wrap_direction(angles)
    assert np.all((wrapped >= -np.pi / 2) & (wrapped < np.pi / 2))
    np.testing.assert_allclose(
        se2.unit_vector(2 * wrapped), se2.unit_vector(2 * angles), atol=1e-12
    )
    np.testing.assert_allclose(se2.wrap_direction(angles + np.pi), wrapped, atol=1e-12)


def test_range_bearing_is_polar_form():
    offset = jnp.array([-1.0, 1.0])
    np.testing.assert_allclose(se2.range_bearing(offset), [np.sqrt(2), 3 * np.pi / 4])


def test_gradients_are_finite_at_the_origin():
    zero = jnp.zeros(3)
    np.testing.assert_array_equal(se2.range_bearing(jnp.zeros(2)), jnp.zeros(2))
    for derivative in (
        jax.jit(jax.jacrev(se2.range_bearing))(jnp.zeros(2)),
        jax.jit(jax.jacfwd(se2.range_bearing))(jnp.zeros(2)),
        jax.jit(jax.jacrev(se2.compose, argnums=(0, 1)))(zero, zero),
        jax.jit(jax.jacrev(se2.relative, argnums=(0, 1)))(zero, zero),
    ):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(derivative))


def test_cross_and_dot_are_sine_and_cosine():
    a, b = np.array([0.3, 1.1]), np.array([[2.0, -0.4], [0.5, 0.5]])
    np.testing.assert_allclose(
        se2.cross(se2.unit_vector(a), se2.unit_vector(a + b[0])), np.sin(b[0]), atol=1e-12
    )
    np.testing.assert_allclose(
        se2.dot(se2.unit_vector(a), se2.unit_vector(a + b[0])), np.cos(b[0]), atol=1e-12
    )


def test_wrapped_zero_keeps_float32():
    assert se2.compose(jnp.zeros(3, jnp.float32), jnp.ones(3, jnp.float32)).dtype == jnp.float32


def test_dead_reckoning_composes_increments():
    start, steps = poses(0)[0], poses(1)
    found = se2.dead_reckoning(start, steps)
    pose = start
    for t in range(3):
        pose = se2.compose(pose, steps[t])
        np.testing.assert_allclose(found[t], pose, atol=1e-12)


@pytest.mark.parametrize("module", [se2, se2_np])
def test_increments_are_the_inverse_of_dead_reckoning(module):
    path = np.concatenate([poses(seed) for seed in SEEDS])
    path = path if module is se2_np else jnp.asarray(path)
    steps = module.increments(path)
    assert steps.shape == path.shape and not steps[0].any()
    np.testing.assert_allclose(module.dead_reckoning(path[0], steps), path, atol=1e-11)


@pytest.mark.parametrize("seed", SEEDS)
def test_numpy_and_jax_agree(seed):
    a, b, c = poses(seed)
    points = np.random.default_rng(seed).normal(size=(4, 7, 2))
    for name, args in (
        ("wrap_angle", (np.linspace(-20, 20, 401),)),
        ("compose", (a, b)),
        ("relative", (a, b)),
        ("transform", (a, points)),
        ("inverse_transform", (a, points)),
        ("dead_reckoning", (a, np.stack([b, c]))),
        ("increments", (np.stack([a, b, c]),)),
    ):
        expected = getattr(se2, name)(*args)
        found = getattr(se2_np, name)(*map(np.asarray, args))
        assert isinstance(found, np.ndarray) and found.dtype == np.float64
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_numpy_takes_many_poses_at_once():
    a, b = poses(0), poses(1)
    for name in ("compose", "relative"):
        expected = jax.jit(jax.vmap(getattr(se2, name)))(a, b)
        np.testing.assert_allclose(getattr(se2_np, name)(a, b), expected, atol=1e-12)
    for name in ("transform", "inverse_transform"):
        expected = jax.jit(jax.vmap(getattr(se2, name)))(a, b[:, :2])
        np.testing.assert_allclose(getattr(se2_np, name)(a, b[:, :2]), expected, atol=1e-12)
