"""Multilevel splitting against tails that are known, and trials as functions of their noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxslam import Config, NoiseParams
from jaxslam.core.scan import Lidar
from jaxslam.pipeline.episodes import filter_episodes
from jaxslam.simulation import Robot, densify, named
from jaxslam.simulation.trial_noise import simulate_from_noise
from jaxslam.study import rare_failures
from jaxslam.study.rare_failures import combine, describe, move_noise, rare_failure
from jaxslam.study.runner import Variant
from jaxslam.study.trials_from_noise import TrialsFromNoise, largest_error

PARTS = 20  # of the noise, normals and keys each


@jax.jit
def draw(keys):
    """Normals, and keys of which one normal each is drawn."""

    def one(key):
        of_x, of_keys = jax.random.split(key)
        return {"x": jax.random.normal(of_x, (PARTS,)), "k": jax.random.split(of_keys, PARTS)}

    return jax.vmap(one)(keys)


@jax.jit
def total(noise):
    """A standard normal score."""
    drawn = jax.vmap(jax.vmap(jax.random.normal))(noise["k"])
    return (noise["x"].sum(axis=1) + drawn.sum(axis=1)) / np.sqrt(2 * PARTS)


def found(seed, **changes):
    given = {"threshold": float(stats.norm.isf(1e-4)), "level_trials": 300} | changes
    return rare_failure(jax.random.key(seed), draw, total, **given)


@pytest.fixture(scope="module")
def repeated():
    return [found(seed) for seed in range(16)]


def test_the_tail_of_a_normal_is_found_with_few_trials(repeated):
    """Mean, spread, standard errors and intervals of 16 repetitions, each of 1,200 trials."""
    estimates = np.array([one.probability.value for one in repeated])
    spread = estimates.std(ddof=1)
    logs, errors = np.log(estimates), np.array([one.relative_error for one in repeated])
    expected = 1e-4 * np.sqrt(np.mean(errors**2))
    assert abs(estimates.mean() - 1e-4) < 4 * expected / np.sqrt(len(repeated))
    assert spread < 1.2e-4
    # Within four standard errors of the logarithm of the standard deviation of 16 values.
    ratio = np.sqrt(np.mean(errors**2)) / logs.std(ddof=1)
    assert abs(np.log(ratio)) < 4 / np.sqrt(2 * (len(logs) - 1))
    holds = [one.probability.low < 1e-4 < one.probability.high for one in repeated]
    # With thirty chains, intervals of 95 % hold in 90 %.
    assert np.sum(holds) >= stats.binom.ppf(0.001, len(repeated), 0.9)
    assert all(1110 <= one.num_trials <= 1650 for one in repeated)
    assert np.median([one.plain_trials / one.num_trials for one in repeated]) > 15


def test_results_are_combined_by_their_spread(repeated):
    mean, low, high = combine(repeated)
    values = [one.probability.value for one in repeated]
    wanted = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    np.testing.assert_allclose([mean, low, high], [np.mean(values), *wanted])
    missed = repeated[0]._replace(probability=repeated[0].probability, scores=np.zeros(0))
    assert np.isclose(combine([repeated[1], missed]).value, values[1] / 2)
    with pytest.raises(ValueError, match="one result"):
        combine(repeated[:1])


def test_failures_are_noise_whose_trials_fail(repeated):
    one = repeated[0]
    assert one.reached and len(one.scores) >= 25
    np.testing.assert_allclose(np.asarray(total(one.failures)), one.scores, rtol=1e-12)
    assert one.scores.min() > one.threshold
    np.testing.assert_allclose(one.probability.value, np.prod([x.share for x in one.levels]))


def test_the_same_key_gives_the_same_result():
    first, second = found(3), found(3)
    assert first.probability == second.probability and first.levels == second.levels
    assert first.probability != found(4).probability


def test_counts_are_exact_and_a_frequent_failure_takes_plain_trials():
    calls = []

    def counted(noise):
        calls.append(len(noise["x"]))
        return total(noise)

    one = rare_failure(jax.random.key(0), draw, counted, threshold=1.0, level_trials=300)
    assert one.num_trials == sum(calls) == 300 and len(one.levels) == 1
    assert one.probability.low < stats.norm.sf(1.0) < one.probability.high
    assert "more than 1 m: 0.1" in describe(one)


@pytest.mark.parametrize("most", [2.0, 0.5])
def test_a_threshold_that_no_trial_reaches_is_said(most):
    """The score is at most `most`; the bound on the probability is that of the highest level."""
    one = rare_failure(
        jax.random.key(0), draw, lambda x: jnp.minimum(total(x), most), threshold=3.0
    )
    assert not one.reached and np.isnan(one.probability.value) and not len(one.scores)
    assert one.probability.high >= stats.norm.sf(most)
    assert "3 m were not reached in" in describe(one) and "\n" not in describe(one)


def test_what_is_not_finite_is_a_failure():
    one = rare_failure(
        jax.random.key(0),
        draw,
        lambda noise: jnp.where(total(noise) > 2.5, jnp.nan, total(noise)),
        threshold=100.0,
    )
    assert one.probability.low < stats.norm.sf(2.5) < one.probability.high


@pytest.mark.parametrize("size", [0.1, 1.0])
def test_a_move_keeps_the_distribution_of_the_noise(size):
    noise = draw(jax.random.split(jax.random.key(1), 4000))
    moved = move_noise(jax.random.key(2), size, noise)
    x, y = np.asarray(noise["x"]).ravel(), np.asarray(moved["x"]).ravel()
    assert stats.kstest(y, "norm").pvalue > 1e-4
    assert abs(np.mean(x * y) - (1 - size)) < 4 / np.sqrt(len(x))
    same = np.all(
        np.asarray(jax.random.key_data(noise["k"])) == np.asarray(jax.random.key_data(moved["k"])),
        axis=-1,
    )
    assert abs(same.mean() - (1 - size)) < 4 * np.sqrt(0.25 / same.size)
    assert stats.kstest(np.asarray(total(moved)), "norm").pvalue > 1e-4


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"level_trials": 50}, "level_trials is 50"),
        ({"chain_length": 1}, "chain_length is 1"),
        ({"threshold": np.nan}, "threshold is nan"),
        ({"least": 0.0}, "least is 0.0"),
    ],
)
def test_impossible_arguments_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        found(0, **changes)


def test_noise_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="draw returns int"):
        rare_failure(jax.random.key(0), lambda k: jnp.zeros(len(k), int), total, threshold=1.0)
    with pytest.raises(ValueError, match="draw returns an array"):
        rare_failure(jax.random.key(0), lambda k: jnp.zeros(3), total, threshold=1.0)
    with pytest.raises(ValueError, match="score returns"):
        rare_failure(jax.random.key(0), draw, lambda x: jnp.zeros(3), threshold=1.0)


def test_half_the_trials_of_a_family_count_as_one_draw():
    above = np.array([True, True, False, False, False, False])
    share, error = rare_failures._share(above, np.array([0, 0, 1, 1, 2, 2]))
    assert share == 1 / 3
    # Three families with the shares 1, 0, 0: sum of ((share - 1/3) / 3 / (1/3))^2.
    assert np.isclose(error, np.sqrt((2 / 3) ** 2 + 2 * (1 / 3) ** 2))


LIDAR = Lidar(num_beams=61, angle_min=-1.5, angle_increment=0.05)
CONFIG = Config.for_lidar(LIDAR)
CONFIG = CONFIG._replace(filter=CONFIG.filter._replace(max_landmarks=16))
ROBOT = Robot()
VARIANT = Variant(
    "a",
    {},
    CONFIG,
    NoiseParams.for_simulated_robot(),
    ROBOT,
    named("office"),
    densify([(1.0, 0.9), (2.5, 0.9)]),
    4,
)


@pytest.mark.slow
def test_trials_of_a_variant_are_functions_of_their_noise():
    """Each trial is that of its own noise in any company, and its score that of its result."""
    trials = TrialsFromNoise(VARIANT)
    noise = trials.plain_noise(0, np.arange(6))
    scores, results = trials.score(noise), trials.results(noise)
    np.testing.assert_allclose(scores, jax.vmap(largest_error)(results), rtol=1e-6)
    some = trials.plain_noise(0, np.array([5, 2]))
    np.testing.assert_allclose(trials.score(some), scores[[5, 2]], rtol=1e-6)
    world = jax.tree.map(jnp.asarray, VARIANT.world)
    one = jax.tree.map(lambda x: x[2], noise)
    episode = simulate_from_noise(one, CONFIG.frontend, ROBOT, world, jnp.asarray(VARIANT.path))
    alone = filter_episodes(CONFIG, VARIANT.params, [episode])
    np.testing.assert_allclose(alone.estimate[0], results.estimate[2], atol=1e-6)
    still = noise._replace(wheels=0 * noise.wheels)
    truth = trials.results(still).truth
    np.testing.assert_allclose(truth[0], truth[1], atol=1e-9)
