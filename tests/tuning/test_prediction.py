"""Losses that need no truth: predicted maps, closures, NIS."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from jaxslam import Config, NoiseParams, episode_from_arrays
from jaxslam.core.episode import measurements_of
from jaxslam.filtering.config import init
from jaxslam.filtering.slam_filter import run_filter
from jaxslam.pipeline.stacking import stack_episodes
from jaxslam.tuning import Model, WeightedLoss, fitting, innovation_nll, prediction, run_model
from jaxslam.tuning.prediction import ClosureNll, NisConsistency, PredictionNll, run_twice

T, PART = 12, 4
LANDMARKS = np.array([1.0, -2.0, 0.5])
SEEN = np.array([[0, 1], [1, 2], [0, 2], [0, 1]])[np.arange(T) % 4]  # (T, 2) landmarks of a step


class Info(NamedTuple):
    """What the losses need."""

    log_likelihood: np.ndarray
    nis: np.ndarray
    dof: np.ndarray


def line_init(params, sequence):
    """A robot on a line, at 0, and three landmarks that are not in the map yet."""
    return jnp.zeros(4), jnp.zeros((4, 4)), jnp.zeros(3, bool)


def line_step(params, state, now):
    """A Kalman filter, one measurement (landmark less robot) after the other."""
    q, r = params["q"] ** 2, params["r"] ** 2
    mean, cov, known = state
    mean, cov = mean.at[0].add(now["moved"]), cov.at[0, 0].add(q)
    nis, density, dof = jnp.zeros(()), jnp.zeros(()), jnp.int32(0)
    for k in range(2):
        i = now["seen"][k] + 1
        H = jnp.zeros(4).at[0].set(-1.0).at[i].add(1.0)
        v, s = now["y"][k] - H @ mean, H @ cov @ H + r
        gain = cov @ H / s
        used = known[i - 1]
        # A new landmark is where it is measured from the robot.
        new_mean = mean.at[i].set(mean[0] + now["y"][k])
        row = cov[0].at[i].set(cov[0, 0] + r)
        new_cov = cov.at[i].set(row).at[:, i].set(row)
        mean = jnp.where(used, mean + gain * v, new_mean)
        cov = jnp.where(used, cov - gain[:, None] * gain[None] * s, new_cov)
        nis += jnp.where(used, v**2 / s, 0.0)
        density -= jnp.where(used, v**2 / s + jnp.log(2 * jnp.pi * s), 0.0) / 2
        dof += used.astype(jnp.int32)
        known = known.at[i - 1].set(True)
    return (mean, cov, known), Info(density, nis, dof)


LINE = Model(line_init, line_step)
PARAMS = {"q": jnp.array(0.3), "r": jnp.array(0.2)}


@pytest.fixture(scope="module")
def sequence():
    rng = np.random.default_rng(0)
    moved = np.full(T, 0.5)
    robot = np.cumsum(moved + rng.normal(0.0, 0.3, T))
    y = LANDMARKS[SEEN] - robot[:, None] + rng.normal(0.0, 0.2, (T, 2))
    return {"moved": jnp.array(moved), "y": jnp.array(y), "seen": jnp.array(SEEN, jnp.int32)}


def dense_density(y, moved, begin, end, columns):
    """Log-density of steps begin to end, less what the first one of each column determines.

    Args:
        columns: (T, 2) copy of a landmark that each measurement is of; places of copies are flat.
    """
    steps = np.arange(begin, end)
    robot = np.cumsum(moved[steps])
    walk = 0.3**2 * (np.minimum.outer(np.arange(len(steps)), np.arange(len(steps))) + 1)
    value = (y[steps] + robot[:, None]).ravel()
    cov = np.kron(walk, np.ones((2, 2))) + 0.2**2 * np.eye(len(value))
    own = columns[steps].ravel()
    rows = []
    for copy in np.unique(own):
        first, *later = np.flatnonzero(own == copy)
        rows += [np.eye(len(value))[i] - np.eye(len(value))[first] for i in later]
    C = np.array(rows)
    return multivariate_normal.logpdf(C @ value, cov=C @ cov @ C.T), len(rows)


def test_a_predicted_map_has_its_dense_conditional_density(sequence):
    """Against joint Gaussians of all measurements, written out; no window is beyond its limit."""
    y, moved = np.asarray(sequence["y"]), np.asarray(sequence["moved"])
    loss = PredictionNll(PART)
    _, info = run_model(run_twice(LINE, loss), PARAMS, sequence)
    whole, n = dense_density(y, moved, 0, T, SEEN)
    for begin in range(0, T, PART):
        part, own = dense_density(y, moved, begin, begin + PART, SEEN)
        whole, n = whole - part, n - own
    np.testing.assert_allclose(loss(info, sequence), -whole / n, rtol=1e-10)


def test_the_whole_memory_is_that_of_the_model_alone(sequence):
    _, alone = run_model(LINE, PARAMS, sequence)
    _, info = run_model(run_twice(LINE, PredictionNll(PART)), PARAMS, sequence)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-10), info.whole, alone)


def test_the_true_noise_is_the_best_in_the_mean():
    """Expected score over 400 drives: the slope at the true noise is zero within 4 errors."""
    rng = np.random.default_rng(1)
    moved = np.full((400, T), 0.5)
    robot = np.cumsum(moved + rng.normal(0.0, 0.3, moved.shape), axis=1)
    y = LANDMARKS[SEEN] - robot[..., None] + rng.normal(0.0, 0.2, (*moved.shape, 2))
    data = {"moved": moved, "y": y, "seen": np.tile(SEEN.astype(np.int32), (400, 1, 1))}
    slopes = fitting.gradients(LINE, PARAMS, data, PredictionNll(PART))[1]
    z = slopes.mean(axis=0) / (slopes.std(axis=0) / np.sqrt(len(slopes)))
    assert np.all(np.abs(z) < 4.0), z


def test_gradients_are_those_of_differences(sequence):
    data = jax.tree.map(lambda x: x[None], sequence)
    found = fitting.gradients(LINE, PARAMS, data, PredictionNll(PART))[1][0]
    for k, name in enumerate(PARAMS):

        def value(by, name=name):
            beside = PARAMS | {name: PARAMS[name] + by}
            return fitting.values(LINE, beside, data, PredictionNll(PART))[0]

        np.testing.assert_allclose(found[k], (value(1e-5) - value(-1e-5)) / 2e-5, rtol=1e-6)


def test_nis_counts_in_full_up_to_its_quantile_and_by_its_logarithm_beyond():
    for n in (1.0, 2.0, 10.0, 40.0):
        limit = chi2.ppf(0.999, n)
        small, large = prediction._rho(jnp.array([0.5 * limit, 1e6 * limit]), jnp.array([n, n]))
        np.testing.assert_allclose(small, 0.5 * limit)
        np.testing.assert_allclose(large, limit * (1 + np.log(1e6)), rtol=0.05)
    assert prediction._rho(jnp.array([-3.0]), jnp.array([2.0]))[0] == 0.0


def test_nis_consistency_has_the_mean_one_for_a_consistent_filter():
    rng = np.random.default_rng(0)
    dof = rng.integers(0, 4, 64 * 400).astype(np.int32)
    nis = np.where(dof > 0, rng.chisquare(np.maximum(dof, 1)), 0.0)
    loss = NisConsistency(64)
    fine = loss(Info(None, jnp.array(nis), jnp.array(dof)), None)
    assert abs(fine - 1.0) < 4 * np.sqrt(2 / 400)
    assert loss(Info(None, jnp.array(1.3 * nis), jnp.array(dof)), None) > 2.0
    assert loss(Info(None, jnp.zeros(64), jnp.zeros(64, jnp.int32)), None) == 0.0


ROBOT_STEPS, VISIT = 16, np.array([0] * 4 + [1] * 8 + [0] * 4)


@pytest.fixture(scope="module")
def robot():
    """A robot that sees landmark 0, then 1, then 0 again, always 2; two drives."""
    moved = np.tile([0.1, 0.0, 0.05], (ROBOT_STEPS, 1)) * (np.arange(ROBOT_STEPS) > 0)[:, None]
    ids = np.stack([VISIT, np.full(ROBOT_STEPS, 2)], axis=1)
    where = np.array([[3.0, 1.0], [2.0, -2.0], [4.0, 0.5]])[ids]
    heading = np.cumsum(moved[:, 2])
    xy = np.cumsum(0.1 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    offset = where - xy[:, None]
    polar = np.stack([np.hypot(*offset.T).T, np.arctan2(*offset.T[::-1]).T], axis=-1)
    polar[..., 1] -= heading[:, None]

    def drive(landmark_ids):
        noise = np.random.default_rng(4).normal(0.0, 0.05, polar.shape)
        return episode_from_arrays(moved, polar + noise, landmark_ids)

    return drive, ids


CONFIG = Config.for_landmark_sensor(4, 2)
NOISE = NoiseParams.for_landmark_sensor()


def test_a_forgotten_landmark_is_a_new_one(robot):
    """With less memory, the second visit of landmark 0 is that of another landmark, 3."""
    drive, ids = robot
    renamed = np.where((ids == 0) & (np.arange(ROBOT_STEPS) > 8)[:, None], 3, ids)
    model = run_twice(fitting.as_model(CONFIG), ClosureNll(5))
    _, info = jax.jit(partial(run_model, model))(NOISE, jax.tree.map(jnp.asarray, drive(ids)))
    for expected, found in ((ids, info.whole), (renamed, info.part)):
        episode = drive(expected)
        start = init(CONFIG.filter, jnp.zeros(3))
        alone = run_filter(CONFIG.filter, NOISE, start, measurements_of(episode))[1]
        np.testing.assert_allclose(found.log_likelihood, alone.log_likelihood, rtol=1e-9)
        np.testing.assert_array_equal(found.dof, alone.dof)


def test_losses_of_one_number_are_not_taken_for_each_other():
    """Else a program compiled for one would run for the other."""
    losses = [kind(8) for kind in (PredictionNll, ClosureNll, NisConsistency)]
    assert len(set(losses)) == 3 and losses[0] == PredictionNll(8) and losses[0] != PredictionNll(9)


def test_losses_that_predict_check_their_data(robot, sequence):
    drive, ids = robot
    drives = stack_episodes([drive(ids), drive(ids)])
    with pytest.raises(ValueError, match="have 16 steps, of which PredictionNll needs more than"):
        fitting.values(CONFIG, NOISE, drives, PredictionNll(16))
    with pytest.raises(ValueError, match="no landmark of episode 0 is seen again after more"):
        fitting.values(CONFIG, NOISE, drives, ClosureNll(9))
    never = np.stack([np.arange(ROBOT_STEPS) // 8, np.full(ROBOT_STEPS, -1)], axis=1)
    with pytest.raises(ValueError, match="no landmark of episode 0 is seen in two parts of 8"):
        fitting.values(CONFIG, NOISE, stack_episodes([drive(never)]), PredictionNll(8))
    with pytest.raises(ValueError, match="steps is 0, not a whole number"):
        fitting.values(CONFIG, NOISE, drives, ClosureNll(0))
    with pytest.raises(ValueError, match="closures are of the SLAM filter"):
        fitting.values(LINE, PARAMS, jax.tree.map(lambda x: x[None], sequence), "closure_nll")
    two = WeightedLoss(((1.0, ClosureNll(2)), (1.0, PredictionNll(2))))
    with pytest.raises(ValueError, match="two losses that run the model twice"):
        fitting.values(CONFIG, NOISE, drives, two)


def test_a_sum_gives_each_loss_what_it_needs(sequence):
    both = WeightedLoss(((1.0, PredictionNll(PART)), (0.5, innovation_nll)))
    _, info = run_model(run_twice(LINE, PredictionNll(PART)), PARAMS, sequence)
    expected = PredictionNll(PART)(info, sequence) + 0.5 * innovation_nll(info.whole, sequence)
    np.testing.assert_allclose(both(info, sequence), expected, rtol=1e-12)
    data = jax.tree.map(lambda x: x[None], sequence)
    np.testing.assert_allclose(fitting.values(LINE, PARAMS, data, both)[0], expected, rtol=1e-9)
