"""Biases of odometry as states of the filter."""

from functools import partial

import jax
import jax.numpy as jnp
import landmark_drives
import numpy as np
import pytest

from jaxslam.filtering import run_filter
from jaxslam.filtering.belief import grow_belief
from jaxslam.filtering.config import FilterConfig, check_config, init
from jaxslam.filtering.odometry_bias import correct_odometry, walk
from jaxslam.mapping.saved_map import used_landmarks

CONFIG = landmark_drives.CONFIG._replace(odometry_bias_std=(0.05, 0.03, 0.05))
TRUE = jnp.array([0.03, 0.0, 0.0])  # the robot drives 3 % more than it reports
TRIALS, STEPS = 60, 50


@partial(jax.jit, static_argnames="config")
def filtered(config, params, measurements):
    """Beliefs and infos [B] at the end of drives [B]."""

    def run(one):
        belief, info = run_filter(config, params, init(config, jnp.zeros(3)), one)
        return belief, jax.tree.map(lambda x: x[-1], info)

    return jax.vmap(run)(measurements)


@pytest.fixture(scope="module")
def drives():
    key = jax.random.key(0)
    return landmark_drives.drives(key, bias=TRUE, count=TRIALS, steps=STEPS)


@pytest.fixture(scope="module")
def beliefs(drives):
    return filtered(CONFIG, landmark_drives.PARAMS, drives[1])[0]


def state_error(belief, truth):
    """Errors (B, 6 + 8) of pose, biases and landmarks, and their covariances."""
    bias = belief.bias
    pose = np.asarray(belief.pose) - np.asarray(truth[:, -1])
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    landmarks = np.asarray(belief.landmark_positions - landmark_drives.LANDMARKS[None])
    error = [pose, np.asarray(bias.mean) - np.asarray(TRUE), landmarks.reshape(len(pose), -1)]
    row = [
        np.concatenate([belief.pose_cov, np.swapaxes(bias.pose_cov, 1, 2), belief.cross_cov], 2),
        np.concatenate([bias.pose_cov, bias.cov, bias.map_cov], 2),
        np.concatenate(
            [np.swapaxes(belief.cross_cov, 1, 2), np.swapaxes(bias.map_cov, 1, 2), belief.map_cov],
            2,
        ),
    ]
    return np.concatenate(error, 1), np.concatenate(row, 1)


def test_a_scale_error_is_tracked_and_the_covariance_is_right(drives, beliefs):
    """NEES of pose and biases together, and of all with the map, in standard errors."""
    error, cov = state_error(beliefs, drives[0])
    for size in (6, 14):
        e, P = error[:, :size], cov[:, :size, :size]
        nees = np.einsum("bi,bij,bj->b", e, np.linalg.inv(P), e)
        assert abs(nees.mean() - size) < 4 * np.sqrt(2 * size / TRIALS)
    scale, std = np.asarray(beliefs.bias.mean[:, 0]), np.sqrt(cov[:, 3, 3])
    assert std.max() < 0.01  # it is observed, from 0.05 at first
    assert abs(scale.mean() - 0.03) < 4 * scale.std() / np.sqrt(TRIALS)
    assert abs(((scale - 0.03) ** 2 / std**2).mean() - 1.0) < 4 * np.sqrt(2 / TRIALS)


def test_biases_that_are_certain_change_nothing(drives):
    """And they stay zero: a wider block of zeros."""
    one = jax.tree.map(lambda x: x[:1], drives[1])
    none = CONFIG._replace(odometry_bias_std=(0.0, 0.0, 0.0))
    belief, info = filtered(none, landmark_drives.PARAMS, one)
    plain, plain_info = filtered(landmark_drives.CONFIG, landmark_drives.PARAMS, one)
    np.testing.assert_allclose(belief.mean, plain.mean, atol=1e-12)
    np.testing.assert_allclose(belief.map_cov, plain.map_cov, atol=1e-14)
    np.testing.assert_allclose(info.log_likelihood, plain_info.log_likelihood, atol=1e-9)
    assert not np.asarray(belief.bias.mean).any()


def test_the_model_is_the_calibration_of_the_robot():
    bias = jnp.array([0.1, -0.2, 0.3])
    correct = jax.jit(correct_odometry)
    straight = correct(bias, jnp.array([0.5, 0.0, 0.0]))
    turn = 0.3 * 0.5
    arc = 1.1 * 0.5 * np.sinc(turn / 2 / np.pi)
    expected = [arc * np.cos(turn / 2), arc * np.sin(turn / 2), turn]
    np.testing.assert_allclose(straight, expected, rtol=1e-12)
    on_the_spot = correct(bias, jnp.array([0.0, 0.0, 0.5]))
    np.testing.assert_allclose(on_the_spot, [0.0, 0.0, 0.4], atol=1e-15)
    np.testing.assert_allclose(correct(0 * bias, jnp.array([0.3, 0.1, 0.2]))[2], 0.2)
    jacobian = jax.jit(jax.jacobian(correct, argnums=(0, 1)))(bias, jnp.zeros(3))
    assert all(np.isfinite(x).all() for x in jacobian)


def test_a_walk_adds_variance_with_the_distance():
    bias = init(CONFIG, jnp.zeros(3)).bias
    std = jnp.array([0.01, 0.0, 0.02])
    walked = walk(bias, std, jnp.array([0.3, 0.4, 1.0]))
    np.testing.assert_allclose(
        walked.cov - bias.cov, np.diag(0.5 * np.asarray(std) ** 2), atol=1e-15
    )


def test_a_belief_grows_with_its_biases_and_a_saved_map_has_none(beliefs):
    one = jax.tree.map(lambda x: x[0], beliefs)
    grown = grow_belief(one, 6)
    np.testing.assert_array_equal(grown.bias.map_cov[:, :8], one.bias.map_cov)
    assert grown.bias.map_cov.shape == (3, 12) and not np.asarray(grown.bias.map_cov[:, 8:]).any()
    saved = used_landmarks(one)
    assert saved.bias is None and saved.adaptation is None


def test_a_belief_without_what_the_configuration_has_is_refused(drives):
    measurements = jax.tree.map(lambda x: x[0], drives[1])
    plain = init(landmark_drives.CONFIG, jnp.zeros(3))
    with pytest.raises(
        ValueError, match="odometry_bias_std is given, but belief.bias is None; mak"
    ):
        run_filter(CONFIG, landmark_drives.PARAMS, plain, measurements)
    with pytest.raises(ValueError, match="odometry_bias_std is None, but belief.bias is given"):
        belief = init(CONFIG, jnp.zeros(3))
        run_filter(landmark_drives.CONFIG, landmark_drives.PARAMS, belief, measurements)
    params = landmark_drives.PARAMS._replace(odometry_bias_walk=jnp.zeros(3))
    with pytest.raises(ValueError, match="odometry_bias_walk is given, but config.odometry_bias_s"):
        run_filter(landmark_drives.CONFIG, params, plain, measurements)
    for std in (0.1, (0.1, 0.1), (0.1, 0.1, -0.1), (0.1, 0.1, np.inf)):
        with pytest.raises(ValueError, match="odometry_bias_std is .*, not a tuple of 3 finite"):
            check_config(FilterConfig(odometry_bias_std=std))
