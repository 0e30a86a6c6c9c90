"""Innovations of a Student t distribution."""

from functools import partial

import jax
import jax.numpy as jnp
import landmark_drives
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import stats

from jaxslam.filtering import kalman, robust
from jaxslam.filtering.config import init
from jaxslam.filtering.joint_covariance import CovarianceBlocks, LinearizedMeasurements
from jaxslam.filtering.slam_filter import run_filter

SIZE = jnp.array([2, 1, 2, 0], jnp.int32)  # a point, a wall, a point, nothing
reweight, innovation_cov = jax.jit(robust.reweight), jax.jit(kalman.innovation_cov)
student_log_density = jax.jit(robust.student_log_density)


def problem(seed=0):
    """Covariance of pose and three landmarks, and rows of which the last is not used."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(9, 9)) / 5
    cov = root @ root.T
    H_pose, H_landmark = rng.normal(size=(4, 2, 3)), rng.normal(size=(4, 2, 2))
    residual = rng.normal(size=(4, 2))
    R = np.tile(np.diag([0.3, 0.2]), (4, 1, 1))
    H_pose[1, 1], H_landmark[1, 1], residual[1, 1], R[1, 1, 1] = 0.0, 0.0, 0.0, 1.0
    H_pose[3], H_landmark[3], residual[3], R[3] = 0.0, 0.0, 0.0, np.eye(2)
    slot = jnp.array([0, 1, 2, 0], jnp.int32)
    rows = LinearizedMeasurements(*map(jnp.array, (residual, H_pose, H_landmark, R)), slot)
    blocks = CovarianceBlocks(cov[:3, :3], cov[:3, 3:], cov[3:, 3:])
    return jax.tree.map(jnp.array, blocks), rows


@pytest.mark.parametrize("nu", [0.7, 3.0, 40.0, 1e6])
def test_the_density_is_that_of_scipy(nu):
    square = np.array([0.0, 0.3, 2.0, 50.0])
    for n in (1, 2):
        point = np.zeros((4, n))
        point[:, 0] = np.sqrt(square)
        expected = stats.multivariate_t(shape=np.eye(n), df=nu).logpdf(point)
        found = student_log_density(jnp.array(nu), jnp.array(square), jnp.int32(n))
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_a_weight_has_the_mean_one_under_its_distribution():
    nu, draws = 4.0, 200_000
    square = 2 * stats.f(2, nu).rvs(draws, random_state=0)
    weight = np.asarray(robust.student_weight(jnp.array(nu), jnp.array(square), jnp.int32(2)))
    assert abs(weight.mean() - 1.0) < 4 * weight.std() / np.sqrt(draws)


def test_the_score_is_a_density_by_the_chain_rule():
    """Of each feature given those before it, by the textbook's conditional of a Gaussian."""
    cov, rows = problem()
    nu = 5.0
    s = np.asarray(innovation_cov(cov, rows))
    v = np.asarray(rows.residual).ravel()
    expected, before = 0.0, []
    for index in ([0, 1], [2], [4, 5]):
        gain = s[np.ix_(index, before)] @ np.linalg.inv(s[np.ix_(before, before)])
        mean = gain @ v[before]
        scale = s[np.ix_(index, index)] - gain @ s[np.ix_(before, index)]
        expected += stats.multivariate_t(loc=mean, shape=scale, df=nu).logpdf(v[index])
        before += index
    _, score = reweight(jnp.array(nu), cov, rows, SIZE)
    np.testing.assert_allclose(score.log_likelihood, expected, rtol=1e-6)
    np.testing.assert_allclose(score.nis, v @ np.linalg.solve(s, v), rtol=1e-10)


def test_many_degrees_of_freedom_are_a_gaussian():
    cov, rows = problem()
    s = np.asarray(innovation_cov(cov, rows))
    used = [0, 1, 2, 4, 5]
    gaussian = stats.multivariate_normal(cov=s[np.ix_(used, used)])
    found, score = reweight(jnp.array(1e9), cov, rows, SIZE)
    expected = gaussian.logpdf(np.asarray(rows.residual).ravel()[used])
    np.testing.assert_allclose(score.log_likelihood, expected, rtol=1e-6)
    np.testing.assert_allclose(found.R, rows.R, rtol=1e-6, atol=1e-9)


def test_the_innovation_far_off_has_the_covariance_of_its_weight():
    cov, rows = problem()
    rows = rows._replace(residual=rows.residual * jnp.array([[1.0], [9.0], [9.0], [1.0]]))
    s = np.asarray(innovation_cov(cov, rows))
    found, _ = reweight(jnp.array(3.0), cov, rows, SIZE)
    robust_s = np.asarray(innovation_cov(cov, found))
    v, far = np.asarray(rows.residual), []
    for i, n in enumerate((2, 1, 2)):
        own = slice(2 * i, 2 * i + n)
        weight = (3.0 + n) / (3.0 + v[i, :n] @ np.linalg.solve(s[own, own], v[i, :n]))
        np.testing.assert_allclose(robust_s[own, own], s[own, own] / min(weight, 1.0))
        far.append(weight < 1.0)
    assert any(far) and not all(far)
    np.testing.assert_array_equal(found.R[3], rows.R[3])


def test_an_uncertain_robot_does_not_follow_a_wrong_landmark():
    """Innovation 3, P = 0.3^2, R = 0.01^2: by R / w it would move by 2.9."""
    one = np.zeros((1, 2, 3))
    one[0, 0, 2] = 1.0
    cov = CovarianceBlocks(0.09 * np.eye(3), np.zeros((3, 2)), np.zeros((2, 2)))
    R = np.diag([1e-4, 1.0])[None]
    rows = LinearizedMeasurements(
        np.array([[3.0, 0.0]]), one, np.zeros((1, 2, 2)), R, np.zeros(1, np.int32)
    )
    found, _ = reweight(jnp.array(4.0), cov, rows, jnp.array([1], jnp.int32))
    moved = 3.0 * 0.09 / (0.09 + float(found.R[0, 0, 0]))
    np.testing.assert_allclose(moved, 3.0 * 0.09 / (0.09 + 1e-4) * 5 / (4 + 9 / 0.0901), rtol=1e-6)


def test_derivatives_are_those_of_differences():
    cov, rows = problem()

    @jax.jit
    def value(nu, R, residual):
        own = rows._replace(R=R, residual=residual)
        found, score = robust.reweight(nu, cov, own, SIZE)
        return score.log_likelihood + jnp.sum(jnp.sin(found.R)) + score.nis

    check_grads(value, (jnp.array(4.0), rows.R, rows.residual), order=1, modes=["rev"], rtol=1e-5)


def test_a_matrix_that_is_not_definite_scores_nothing():
    cov, rows = problem()
    rows = rows._replace(R=-10.0 * rows.R)
    _, score = reweight(jnp.array(4.0), cov, rows, SIZE)
    assert score.log_likelihood == 0.0 and score.nis == 0.0


@pytest.mark.slow
def test_an_outlier_moves_the_robust_filter_less():
    several = landmark_drives.drives(jax.random.key(0), count=1, steps=12)[1]
    measurements = jax.tree.map(lambda x: x[0], several)
    features = measurements.features
    wrong = features._replace(xy=features.xy.at[8, 1, 0].add(1.0))
    robust_params = landmark_drives.PARAMS._replace(student_dof=jnp.array(4.0))
    start = init(landmark_drives.CONFIG, jnp.zeros(3))

    def moved(params):
        """[m] by which the outlier moves the estimate."""
        run = partial(run_filter, landmark_drives.CONFIG, params, start)
        clean, hurt = run(measurements)[1], run(measurements._replace(features=wrong))[1]
        return float(jnp.linalg.norm(hurt.pose[8, :2] - clean.pose[8, :2]))

    assert moved(robust_params) < moved(landmark_drives.PARAMS) / 10
