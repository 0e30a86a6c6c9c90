import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxslam.core.episode import Episode
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.tuning import losses
from jaxslam.tuning.losses import WeightedLoss

T = 30


@pytest.fixture(scope="module")
def run():
    """Info and log of a run: T poses, their covariances, innovations; some truth is unknown."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(T, 3)) * [3.0, 3.0, 2.0]
    root = rng.normal(size=(T, 3, 3)) * 0.1
    cov = root @ root.swapaxes(1, 2) + 1e-4 * np.eye(3)
    cov[0] = 0.0
    error = np.einsum("tij,tj->ti", root, rng.normal(size=(T, 3)))
    pose = truth + error
    pose[:, 2] += 2 * np.pi * rng.integers(-1, 2, T)
    rest = dict.fromkeys(StepInfo._fields)
    rest |= {"pose": jnp.array(pose), "pose_cov": jnp.array(cov)}
    rest |= {"log_likelihood": jnp.array(rng.normal(size=T)), "nis": jnp.ones(T)}
    rest |= {"dof": jnp.array(rng.integers(0, 9, T), jnp.int32)}
    judged = rng.random(T) < 0.7
    judged[0] = True
    blind = np.where(judged[:, None], truth, 99.0)
    return StepInfo(**rest), Episode(jnp.array(blind), None, None, None, jnp.array(judged)), error


def test_localisation_is_the_mean_square_where_the_truth_is_known(run):
    info, log, error = run
    square = error[np.asarray(log.truth_mask)] ** 2
    right = np.mean(square[:, 0] + square[:, 1] + losses.HEADING_WEIGHT * square[:, 2])
    np.testing.assert_allclose(losses.pose_mse(info, log), right)


def density(info, log, error):
    """Mean negative log-density, by SciPy, without its constant and the certain first pose."""
    use = np.flatnonzero(np.asarray(log.truth_mask))[1:]
    each = [multivariate_normal.logpdf(error[t], cov=np.asarray(info.pose_cov[t])) for t in use]
    return -np.mean(each) - 1.5 * np.log(2 * np.pi)


def test_calibrated_is_the_density_of_the_truth(run):
    np.testing.assert_allclose(losses.pose_nll(*run[:2]), density(*run), rtol=1e-8)


def test_of_all_sizes_calibrated_takes_that_with_the_expected_nees(run):
    info, log, error = run
    use = np.flatnonzero(np.asarray(log.truth_mask))[1:]
    nees = np.mean([error[t] @ np.linalg.solve(info.pose_cov[t], error[t]) for t in use]) / 3
    sized = lambda s: losses.pose_nll(info._replace(pose_cov=s * info.pose_cov), log)
    best = float(sized(nees))
    assert best < min(float(sized(nees * 1.05)), float(sized(nees / 1.05)))


def test_likelihood_is_that_of_each_number_observed(run):
    info, log, _ = run
    right = -np.asarray(info.log_likelihood).sum() / np.asarray(info.dof).sum()
    np.testing.assert_allclose(losses.innovation_nll(info, log), right)
    nothing = info._replace(dof=0 * info.dof, log_likelihood=0 * info.log_likelihood)
    assert losses.innovation_nll(nothing, log) == 0


def test_a_run_without_truth_costs_nothing(run):
    info, log, _ = run
    blind = log._replace(truth_mask=jnp.zeros(T, bool))
    assert losses.pose_mse(info, blind) == 0 and losses.pose_nll(info, blind) == 0


def test_a_weighted_sum_is_one(run):
    both = WeightedLoss(((2.0, losses.pose_mse), (0.5, losses.innovation_nll)))
    right = 2.0 * losses.pose_mse(*run[:2]) + 0.5 * losses.innovation_nll(*run[:2])
    np.testing.assert_allclose(both(*run[:2]), right)
    assert hash(both) == hash(WeightedLoss(both.terms)) and losses.needs_truth(both)
    assert not losses.needs_truth(WeightedLoss(((1.0, losses.innovation_nll),)))
    assert not losses.needs_truth(lambda info, log: info.nis.sum())
