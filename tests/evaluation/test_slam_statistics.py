import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import Config, NoiseParams, filter_episodes
from jaxslam.core import se2_np
from jaxslam.core.episode import measurements_of
from jaxslam.evaluation import filter_with_statistics, report_metrics, slam_consistency
from jaxslam.filtering import slam_filter
from jaxslam.filtering.adaptation import AdaptationSpec
from jaxslam.filtering.config import init
from jaxslam.filtering.motion_model import odometry_cov
from jaxslam.pipeline.episodes import episode_from_arrays
from jaxslam.pipeline.stacking import stack_episodes
from jaxslam.tuning import fitting, losses

LANDMARKS = np.array([[3.0, 1.0], [-2.5, 3.0], [0.5, -2.5], [0.0, 5.0]])
CONFIG = Config.for_landmark_sensor(4, 2)
PARAMS = NoiseParams(
    odometry_coefficients=jnp.array([0.02, 0.01, 0.01, 0.02]),
    range_std=jnp.asarray(0.02),
    bearing_std=jnp.asarray(0.01),
    feature_std_scale=jnp.asarray(1e-6),
    wall_angle_std=jnp.asarray(0.01),
)
TRIALS, STEPS = 40, 30


def drive(rng):
    """One drive around four landmarks, whose noise is just what `PARAMS` says."""
    increment = np.array([0.3, 0.0, 0.15])
    true = np.tile(increment, (STEPS, 1))
    true[0] = 0.0
    poses = np.zeros((STEPS, 3))
    for t in range(1, STEPS):
        poses[t] = se2_np.compose(poses[t - 1], true[t])
    cov = np.asarray(odometry_cov(PARAMS.odometry_coefficients, jnp.asarray(increment)))
    odometry = true.copy()
    odometry[1:] += rng.multivariate_normal(np.zeros(3), cov, STEPS - 1)
    ids = np.stack([rng.permutation(4)[:2] for _ in range(STEPS)])
    ids[rng.uniform(size=ids.shape) < 0.3] = -1
    polar = np.zeros((STEPS, 2, 2))
    for t, pose in enumerate(poses):
        offset = LANDMARKS[ids[t]] - pose[:2]
        polar[t, :, 0] = np.hypot(*offset.T) + rng.normal(0, 0.02, 2)
        polar[t, :, 1] = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2] + rng.normal(0, 0.01, 2)
    polar[..., 1] = (polar[..., 1] + np.pi) % (2 * np.pi) - np.pi
    return episode_from_arrays(odometry, polar, ids, poses)


@pytest.fixture(scope="module")
def drives():
    rng = np.random.default_rng(0)
    return stack_episodes([drive(rng) for _ in range(TRIALS)])


@pytest.fixture(scope="module")
def correct(drives):
    return filter_with_statistics(CONFIG, PARAMS, drives)


def test_results_are_those_of_the_filter_alone(drives, correct):
    alone = filter_episodes(CONFIG, PARAMS, drives)
    for name, mine, theirs in zip(alone._fields, correct[0], alone, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-12, err_msg=name)


def test_its_loss_is_that_which_is_tuned(drives):
    loss = filter_with_statistics(CONFIG, PARAMS, drives, loss=losses.pose_nll)[1].loss
    expected = fitting.values(CONFIG, PARAMS, drives, losses.pose_nll)
    np.testing.assert_allclose(loss, expected, rtol=1e-9)


def test_a_filter_whose_noise_is_that_of_its_drives_is_consistent(correct):
    report = slam_consistency(*correct)
    assert report.consistent, report.verdicts
    white = report.whiteness
    has = np.asarray(correct[1].corrected)
    w = np.asarray(correct[1].correction)
    assert has.sum(axis=(0, 1)).min() > 400
    for k in range(3):
        values = w[..., k][has[..., k]]
        assert abs(np.mean(values**2) - 1.0) < 4.0 * np.std(values**2) / np.sqrt(values.size)
    both = has[..., 0] & has[..., 1]
    product = (w[..., 0] * w[..., 1])[both]
    assert abs(product.mean()) < 4.0 / np.sqrt(product.size), "components are independent"
    assert np.all(np.abs(white.autocorrelation[:, 1:6]) < 4.5 / np.sqrt(white.num_pairs[:, 1:6]))
    numbers = report_metrics(report)
    assert list(numbers["autocorrelation"]) == ["heading", "to the left", "ahead"]
    np.testing.assert_array_equal(np.isfinite(report.nees.values[:, 0]), False)


@pytest.mark.parametrize(
    "field, factor, size, sign",
    [
        ("odometry_coefficients", 0.2, "over-confident", "+"),
        ("bearing_std", 0.3, "over-confident", "-"),
    ],
)
def test_wrong_noise_shows_in_the_sign_of_the_corrections(drives, field, factor, size, sign):
    params = PARAMS._replace(**{field: factor * getattr(PARAMS, field)})
    report = slam_consistency(*filter_with_statistics(CONFIG, params, drives))
    assert report.nis.score > 5.0 and any(size in line for line in report.verdicts)
    line = next(line for line in report.verdicts if " correlated at lag" in line)
    assert f" {sign}0." in line, report.verdicts


def test_corrections_equal_the_updates_of_the_filter_step_by_step(drives):
    """With biases of odometry and noise that adapts, which change what is predicted."""
    config = CONFIG.filter._replace(
        linearisation="first_estimates",
        odometry_bias_std=(0.05, 0.05, 0.01),
        adaptation=AdaptationSpec(memory=10.0),
    )
    two = jax.tree.map(lambda x: x[:2], drives)
    _, statistics = filter_with_statistics(CONFIG._replace(filter=config), PARAMS, two)
    found, has = np.asarray(statistics.correction[1]), np.asarray(statistics.corrected[1])
    episode = jax.tree.map(lambda x: x[1], drives)
    measurements, start = measurements_of(episode), init(config, episode.truth[0])
    measurements = jax.tree.map(np.asarray, measurements)
    belief, count = start, 0
    for t in range(STEPS):
        now = jax.tree.map(lambda x, t=t: x[t], measurements)
        unseen = now._replace(
            features=jax.tree.map(np.zeros_like, now.features),
            landmark_ids=np.full_like(now.landmark_ids, -1),
        )
        predicted, _ = slam_filter.step(config, PARAMS, belief, unseen)
        belief, _ = slam_filter.step(config, PARAMS, belief, now)
        if not has[t].all():
            continue
        before, after = np.asarray(predicted.mean)[:3], np.asarray(belief.mean)[:3]
        c, s = np.cos(before[2]), np.sin(before[2])
        turn = np.array([[0, 0, 1], [-s, c, 0], [c, s, 0]])
        shift = turn @ (after - before)
        taken = np.asarray(predicted.pose_cov) - np.asarray(belief.pose_cov)
        taken = turn @ taken @ turn.T
        expected = np.linalg.solve(np.linalg.cholesky(taken), shift)
        np.testing.assert_allclose(found[t], expected, rtol=1e-5, atol=1e-6)
        count += 1
    assert count > STEPS // 3 and not found[~has].any()


def test_trials_that_are_not_finite_and_drives_without_updates_are_left_out(correct):
    results, statistics = correct
    whole = report_metrics(slam_consistency(results, statistics))
    broken = results._replace(
        finite=np.where(np.arange(TRIALS) == 3, False, results.finite),
        truth_mask=np.zeros_like(results.truth_mask),
    )
    spoiled = statistics._replace(nis=np.array(statistics.nis))
    spoiled.nis[3] = np.nan
    fewer = report_metrics(slam_consistency(broken, spoiled))
    number = int(np.sum(np.asarray(statistics.dof[3]) > 0))
    assert fewer["nis_count"] == whole["nis_count"] - number and "nees_count" not in fewer
    blind = statistics._replace(dof=np.zeros_like(statistics.dof))
    assert slam_consistency(results, blind) is None
