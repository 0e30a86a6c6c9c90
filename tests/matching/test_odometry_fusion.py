import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2_np
from jaxslam.core.measurement import ScanMatch
from jaxslam.matching import odometry_fusion
from jaxslam.matching.odometry_fusion import fuse_odometry, mount_cov, student_weight


def some_match(rank):
    a = np.random.default_rng(1).normal(size=(rank, 3)) * 30
    return ScanMatch(jnp.array([0.52, 0.03, 0.4]), jnp.asarray(a.T @ a), jnp.asarray(0.9))


def test_a_fused_increment_is_that_of_a_kalman_update():
    wheels, scale = jnp.array([0.5, 0.0, 0.3]), 0.7
    noise = np.diag([0.03, 0.02, 0.05]) ** 2 + 1e-5
    match = some_match(3)
    fused, cov = fuse_odometry(jnp.asarray(scale), wheels, jnp.asarray(noise), match)
    prior = noise + np.diag(
        [*[odometry_fusion.FUSION_STD_FLOOR[0] ** 2] * 2, odometry_fusion.FUSION_STD_FLOOR[1] ** 2]
    )
    prior += mount_cov(wheels)
    r = scale**2 * np.linalg.inv(match.information)
    e = np.asarray(match.increment - wheels)
    square = e @ np.linalg.solve(prior + r, e)
    prior = prior / min(1.0, 6.0 / (3.0 + square))  # Student t
    gain = prior @ np.linalg.inv(prior + r)
    np.testing.assert_allclose(fused, wheels + gain @ (match.increment - wheels), rtol=1e-9)
    np.testing.assert_allclose(cov, prior - gain @ prior, rtol=1e-7)


def test_fusing_with_nothing_changes_nothing_and_headings_are_wrapped():
    wheels, noise = jnp.array([0.5, 0.0, 3.1]), jnp.diag(jnp.array([1e-4, 2e-4, 3e-4]))
    nothing = some_match(3)._replace(information=jnp.zeros((3, 3)))
    fused, cov = fuse_odometry(jnp.asarray(1.0), wheels, noise, nothing)
    np.testing.assert_array_equal(fused, wheels)
    np.testing.assert_array_equal(cov, noise)
    beyond = some_match(3)._replace(increment=jnp.array([0.5, 0.0, -3.1]))
    fused, _ = fuse_odometry(jnp.asarray(1.0), wheels, noise, beyond)
    assert 3.1 < fused[2] < 2 * np.pi - 3.1


@pytest.mark.parametrize("rank", [0, 1, 3])
def test_gradients_of_a_fused_increment_are_finite_and_right(rank):
    wheels = jnp.array([0.5, 0.1, 0.3])
    match = some_match(max(rank, 1))
    match = match if rank else match._replace(information=jnp.zeros((3, 3)))

    @jax.jit
    def value(scale, variance):
        noise = jnp.diag(variance * jnp.array([1.0, 0.5, 2.0]))
        fused, cov = fuse_odometry(scale, wheels, noise, match)
        return jnp.sum(fused**2) + jnp.sum(cov)

    given = jnp.asarray(0.7), jnp.asarray(1e-3)
    slope = jax.jit(jax.grad(value, argnums=(0, 1)))(*given)
    for i in range(2):
        step = 1e-4 * given[i]
        up, down = (list(given) for _ in range(2))
        up[i], down[i] = given[i] + step, given[i] - step
        expected = (value(*up) - value(*down)) / (2 * step)
        np.testing.assert_allclose(slope[i], expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0, 100.0])
def test_wheels_that_are_far_off_lose_their_weight(factor):
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 3, 3))
    Q, H, e = a @ a.T + np.eye(3), b @ b.T + np.eye(3), factor * rng.normal(size=3)
    square = e @ np.linalg.solve(Q + np.linalg.inv(H), e)
    weight = student_weight(jnp.asarray(np.linalg.inv(Q)), jnp.asarray(H), jnp.asarray(e))
    np.testing.assert_allclose(weight, min(1.0, 6.0 / (3.0 + square)), rtol=1e-6)


def test_a_direction_that_the_scan_does_not_show_says_nothing_about_the_wheels():
    H = jnp.diag(jnp.array([0.0, 1e4, 1e5]))  # a corridor along x
    weight = student_weight(100.0 * jnp.eye(3), H, jnp.array([50.0, 0.0, 0.0]))
    np.testing.assert_allclose(weight, 1.0, rtol=1e-6)


def test_wheels_that_stand_still_do_not_hold_a_moving_robot():
    """Odometry of no motion has no noise; the scan that moved by 0.2 m is kept all the same."""
    match = ScanMatch(
        jnp.array([0.2, 0.0, 0.2]), jnp.diag(jnp.array([1e3, 1e3, 1e4])), jnp.ones(())
    )
    fused, _ = fuse_odometry(jnp.asarray(0.3), jnp.zeros(3), jnp.zeros((3, 3)), match)
    np.testing.assert_allclose(fused, match.increment, atol=0.02)


def test_what_is_expected_takes_the_place_of_the_odometry():
    match = some_match(3)
    wheels, noise = jnp.array([0.0, 0.0, 0.0]), jnp.diag(jnp.array([1e-4, 1e-4, 1e-4]))
    expected, variance = jnp.array([0.5, 0.0, 0.3]), jnp.array([0.04, 0.01, 0.09])
    replaced = match._replace(expected=expected, expected_variance=variance)
    found = fuse_odometry(jnp.asarray(0.7), wheels, noise, replaced)
    alone = fuse_odometry(
        jnp.asarray(0.7), expected, noise + jnp.diag(variance) - mount_cov(expected), match
    )
    np.testing.assert_allclose(found[0], alone[0], rtol=1e-9)
    np.testing.assert_allclose(found[1], alone[1], rtol=1e-7)


def test_the_covariance_of_an_unknown_mount_is_that_of_many_draws():
    rng, increment = np.random.default_rng(0), np.array([0.7, 0.1, 0.5])
    std = odometry_fusion.MOUNT_STD
    mount = rng.normal(0, [std[0], std[0], std[1]], (100_000, 3))
    moved = se2_np.compose(np.broadcast_to(increment, mount.shape), mount)
    error = se2_np.relative(mount, moved) - increment
    np.testing.assert_allclose(np.cov(error.T), mount_cov(jnp.asarray(increment)), atol=5e-4)
    assert not np.asarray(mount_cov(jnp.zeros(3))).any()
