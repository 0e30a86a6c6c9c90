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
def filtered():
    """Step infos of T steps and their episode, whose truth is partly unknown; and pose errors."""
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
    truth_mask = rng.random(T) < 0.7
    truth_mask[0] = True
    blind = np.where(truth_mask[:, None], truth, 99.0)
    return (
        StepInfo(**rest),
        Episode(jnp.array(blind), None, None, None, jnp.array(truth_mask)),
        error,
    )


def test_pose_mse_is_the_mean_square_error_where_the_truth_is_known(filtered):
    info, episode, error = filtered
    square = error[np.asarray(episode.truth_mask)] ** 2
    right = np.mean(square[:, 0] + square[:, 1] + losses.HEADING_WEIGHT * square[:, 2])
    np.testing.assert_allclose(losses.pose_mse(info, episode), right)


def density(info, episode, error):
    """Mean negative log-density, by SciPy, without its constant and the certain first pose."""
    use = np.flatnonzero(np.asarray(episode.truth_mask))[1:]
    each = [multivariate_normal.logpdf(error[t], cov=np.asarray(info.pose_cov[t])) for t in use]
    return -np.mean(each) - 1.5 * np.log(2 * np.pi)


def test_pose_nll_is_the_negative_log_density_of_the_truth(filtered):
    np.testing.assert_allclose(losses.pose_nll(*filtered[:2]), density(*filtered), rtol=1e-8)


def test_pose_nll_is_least_for_the_covariance_scale_with_the_expected_nees(filtered):
    info, episode, error = filtered
    use = np.flatnonzero(np.asarray(episode.truth_mask))[1:]
    nees = np.mean([error[t] @ np.linalg.solve(info.pose_cov[t], error[t]) for t in use]) / 3

    def scaled(factor):
        return float(losses.pose_nll(info._replace(pose_cov=factor * info.pose_cov), episode))

    assert scaled(nees) < min(scaled(nees * 1.05), scaled(nees / 1.05))


def test_innovation_nll_is_per_scalar_measurement(filtered):
    info, episode, _ = filtered
    right = -np.asarray(info.log_likelihood).sum() / np.asarray(info.dof).sum()
    np.testing.assert_allclose(losses.innovation_nll(info, episode), right)
    nothing = info._replace(dof=0 * info.dof, log_likelihood=0 * info.log_likelihood)
    assert losses.innovation_nll(nothing, episode) == 0


def test_an_episode_without_truth_has_zero_loss(filtered):
    info, episode, _ = filtered
    blind = episode._replace(truth_mask=jnp.zeros(T, bool))
    assert losses.pose_mse(info, blind) == 0 and losses.pose_nll(info, blind) == 0


def test_a_weighted_sum_of_losses_is_a_loss(filtered):
    both = WeightedLoss(((2.0, losses.pose_mse), (0.5, losses.innovation_nll)))
    right = 2.0 * losses.pose_mse(*filtered[:2]) + 0.5 * losses.innovation_nll(*filtered[:2])
    np.testing.assert_allclose(both(*filtered[:2]), right)
    assert hash(both) == hash(WeightedLoss(both.terms)) and losses.needs_truth(both)
    assert not losses.needs_truth(WeightedLoss(((1.0, losses.innovation_nll),)))
    assert not losses.needs_truth(lambda info, episode: info.nis.sum())


def test_losses_have_the_names_that_tune_takes():
    named = {
        "pose_nll": losses.pose_nll,
        "pose_mse": losses.pose_mse,
        "innovation_nll": losses.innovation_nll,
        "prediction_nll": losses.prediction_nll,
        "closure_nll": losses.closure_nll,
    }
    assert dict(losses.BY_NAME) == named
    assert [losses.name_of(loss) for loss in named.values()] == list(named)
    with pytest.raises(ValueError, match="none of pose_nll, pose_mse, innovation_nll"):
        losses.name_of(print)
