import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.se2_np import compose, dead_reckoning
from jaxslam.filtering import motion_model
from jaxslam.filtering.motion_model import wheel_coefficients
from jaxslam.simulation import robot
from jaxslam.simulation.robot import Robot

ROBOT = Robot()
COEFFICIENTS = wheel_coefficients(*ROBOT[:2])
DRAWS = 20_000
STANDARD_ERRORS = 5


@jax.jit
def batched_roll(given):
    draws = jax.random.normal(jax.random.key(0), (DRAWS, 20, 2))
    return jax.vmap(lambda draw: robot.true_increment(ROBOT, draw, given))(draws)


wheel_increment = jax.jit(robot.wheel_increment)
odometry_cov = jax.jit(motion_model.odometry_cov)


def rolled(left, right):
    return wheel_increment(jnp.array(left), jnp.array(right), ROBOT.wheel_base)


def sample(given):
    """Motions (DRAWS, 3) that are rolled when the encoders read `given`."""
    return np.asarray(batched_roll(given))


def spread(cov):
    """Standard error (3, 3) of each entry of a sample covariance."""
    return np.sqrt((np.outer(np.diag(cov), np.diag(cov)) + cov**2) / DRAWS)


@pytest.mark.parametrize("wheels", [(0.3, 0.3), (0.1, 0.4), (-0.2, 0.3), (-0.3, 0.3), (0.0, 0.0)])
def test_increment_is_many_small_straight_steps(wheels):
    steps = 2000
    forward = np.array([sum(wheels) / 2 / steps, 0.0, 0.0])
    turn = np.array([0.0, 0.0, (wheels[1] - wheels[0]) / ROBOT.wheel_base / steps / 2])
    step = compose(compose(turn, forward), turn)  # half the turn before, half after
    pose = dead_reckoning(np.zeros(3), np.tile(step, (steps, 1)))[-1]
    np.testing.assert_allclose(rolled(*wheels), pose, atol=1e-7)


@pytest.mark.parametrize("wheels", [(0.3, 0.3), (0.1, 0.4), (-0.2, -0.4), (-0.3, 0.3), (0.0, 0.0)])
def test_wheels_inverts_increment(wheels):
    np.testing.assert_allclose(
        robot.wheel_distances(rolled(*wheels), ROBOT.wheel_base), wheels, atol=1e-12
    )


def test_an_undisturbed_roll_is_what_odometry_reads():
    given = rolled(0.2, 0.35)
    np.testing.assert_allclose(
        robot.true_increment(ROBOT, jnp.zeros((7, 2)), given), given, atol=1e-12
    )


@pytest.mark.parametrize("wheels", [(0.3, 0.3), (-0.3, -0.3), (-0.04, 0.04), (0.04, -0.04)])
def test_noise_straight_and_on_the_spot_is_that_of_the_wheels(wheels):
    given = rolled(*wheels)
    cov = np.cov(sample(given).T)
    model = np.asarray(odometry_cov(COEFFICIENTS, given))
    bend = given[2] ** 2 / 12 * model[0, 0]  # the bend of the arc, which the model leaves out
    assert np.all(np.abs(cov - model) < STANDARD_ERRORS * spread(cov) + bend)


@pytest.mark.parametrize("wheels", [(0.26, 0.34), (0.34, 0.26), (0.12, 0.2)])
def test_noise_on_an_arc_is_a_near_upper_bound(wheels):
    given = rolled(*wheels)
    cov = np.cov(sample(given).T)
    model = np.asarray(odometry_cov(COEFFICIENTS, given))
    slack = 1 + ROBOT.wheel_base * abs(given[2]) / sum(wheels)  # (2 d + base t) / (|l| + |r|)
    low, high = 1 - STANDARD_ERRORS * np.sqrt(2 / DRAWS), 1 + STANDARD_ERRORS * np.sqrt(2 / DRAWS)
    turned = np.diag(model)[2] / np.diag(cov)[2]
    assert low * slack < turned < high * slack
    assert np.all(np.diag(model) > low * np.diag(cov))
    assert np.all(np.diag(model) < high * slack * 1.05 * np.diag(cov))


def test_the_robot_that_rolls_straight_is_not_biased():
    error = sample(rolled(0.3, 0.3)) - np.asarray(rolled(0.3, 0.3))
    bend = np.array([0.3 * 0.02**2 / 6, 0, 0])  # E[chord] < arc, to the order of var_t
    assert np.all(np.abs(error.mean(0)) < STANDARD_ERRORS * error.std(0) / np.sqrt(DRAWS) + bend)


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_positive_definite_once_moving(seed):
    given = 0.3 * np.random.default_rng(seed).normal(size=3)
    cov = odometry_cov(jnp.array([0.02, 0.01, 0.03, 0.04]), given)
    np.testing.assert_allclose(cov, cov.T, atol=1e-18)
    assert np.linalg.eigvalsh(cov).min() > 0


def test_noise_of_many_small_motions_is_that_of_one():
    steps, part = 50, np.array([0.3 / 50, 0.0, 0.0])
    cov, ahead = np.zeros((3, 3)), np.eye(3)
    ahead[1, 2] = part[0]
    for _ in range(steps):
        cov = ahead @ cov @ ahead.T + np.asarray(odometry_cov(COEFFICIENTS, part))
    whole = odometry_cov(COEFFICIENTS, steps * part)
    np.testing.assert_allclose(cov, whole, atol=1e-12)


def test_gradients_are_finite_at_rest():
    rest = jnp.zeros(3)
    noise = jax.jacrev(motion_model.odometry_cov, argnums=(0, 1))
    true = jax.jacrev(lambda given: robot.true_increment(ROBOT, jnp.ones((4, 2)), given))
    turned = jax.jacrev(lambda both: robot.wheel_increment(both[0], both[1], ROBOT.wheel_base))
    coefficients = jax.jacrev(lambda k: wheel_coefficients(ROBOT.wheel_base, k))
    pairs = (noise, COEFFICIENTS, rest), (true, rest), (turned, rest), (coefficients, 0.0)
    for derivative, *given in pairs:
        for leaf in jax.tree.leaves(jax.jit(derivative)(*given)):
            assert np.isfinite(leaf).all()
    np.testing.assert_array_equal(odometry_cov(COEFFICIENTS, rest), jnp.zeros((3, 3)))
