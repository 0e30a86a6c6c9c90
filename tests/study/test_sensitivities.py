"""Sensitivities of a toy with a closed form, and of trials against what is known of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import Config, NoiseParams
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.simulation import Robot, densify, life_in, named
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.study.runner import Variant
from jaxslam.study.sensitivities import (
    GRADIENT,
    PAIRED,
    Parameter,
    describe,
    mean_of,
    ranked,
    sensitivities,
)
from jaxslam.study.trial_parameters import TrialErrors, features_from_pose, keeps, parameter_of

N = 4000
A, B = 0.03, 0.01  # [m] of two kinds of noise
STEERING = Parameter("a", A, "m", has_gradient=True), Parameter("b", B, "m", has_gradient=True)


def drawn(seed, scans=50):
    return np.random.default_rng(seed).normal(size=(2, N, scans))


def toy(z, jump=0.0):
    """Errors a z_1 + b z_2, and jumps where the first normal is larger than a threshold."""

    def log_errors(changes):
        a, b = np.array([A, B]) * np.exp(changes)
        error = a * z[0] + b * z[1]
        jumps = jump * (a * z[0, :, 0] > A)
        return np.log(np.mean(error**2, axis=1)) / 2 + jumps

    def gradients(changes):
        a, b = np.array([A, B]) * np.exp(changes)
        error = a * z[0] + b * z[1]
        square = np.mean(error**2, axis=1)
        slopes = [np.mean(error * own, axis=1) / square for own in (a * z[0], b * z[1])]
        return np.stack(slopes, axis=1)

    return log_errors, gradients


def test_elasticities_of_two_kinds_of_noise_are_their_shares_of_the_variance():
    """Of many scans the RMSE is sqrt(a^2 + b^2): d log / d log a = a^2 / (a^2 + b^2)."""
    found = sensitivities(STEERING, *toy(drawn(0)))
    share = np.array([A**2, B**2]) / (A**2 + B**2)
    for one, wanted in zip(found, share, strict=True):
        assert one.method == GRADIENT and one.left_out == 0 and one.trials == N
        for estimate in (one.derivative, one.paired):
            assert abs(estimate.mean - wanted) < 4 * estimate.standard_error + 1e-3
        assert one.distance <= 3
    halved = 0.5 * np.log((A**2 / 4 + B**2) / (A**2 + B**2))
    effect = found[0].halved
    assert abs(effect.mean - halved) < 4 * effect.standard_error + 2e-3
    assert [one.parameter.name for one in ranked(found[::-1])] == ["a", "b"]
    assert "a: 0.9" in describe(found[0]) and "by gradient, 4000 trials, 0 left out" in describe(
        found[0]
    )


def test_standard_errors_are_those_of_repetitions():
    few = [toy(drawn(seed)[:, :400]) for seed in range(60)]
    found = [sensitivities(STEERING, *one)[0].derivative for one in few]
    spread = np.std([one.mean for one in found], ddof=1)
    ratio = np.mean([one.standard_error for one in found]) / spread
    assert abs(np.log(ratio)) < 4 / np.sqrt(2 * 59)


def test_a_gradient_that_misses_jumps_is_not_taken():
    """P(a z > A) grows by its density at 1, per logarithm of a: 0.242, times the jump."""
    found = sensitivities(STEERING, *toy(drawn(1), jump=0.5))
    density = np.exp(-0.5) / np.sqrt(2 * np.pi)
    wanted = A**2 / (A**2 + B**2) + 0.5 * density
    one = found[0]
    assert one.method == PAIRED and one.distance > 3
    assert abs(one.derivative.mean - wanted) < 4 * one.derivative.standard_error + 2e-3
    assert abs(one.gradient.mean - wanted) > 5 * one.derivative.standard_error
    assert found[1].method == GRADIENT


def test_steps_are_long_where_errors_are_noisy_and_short_where_they_curve():
    z = np.random.default_rng(2).normal(size=(2, N))
    rough = [Parameter("a", 1.0, "m", step=0.1)]

    def noisy(changes):  # a smooth part, and noise of its own at each change
        rng = np.random.default_rng(int(abs(changes[0]) * 1e6) + (changes[0] > 0))
        return 0.5 * changes[0] + rng.normal(size=N)

    def curved(changes):
        return np.exp(5 * changes[0]) + 1e-3 * z[0] * changes[0]

    assert sensitivities(rough, noisy)[0].step == 0.4
    (one,) = sensitivities(rough, curved)
    assert one.step == 0.1 and one.gradient is None and one.method == PAIRED
    assert abs(one.derivative.mean - 5 * np.sinh(0.5) / 0.5) < 1e-3


def test_one_sided_differences_and_what_to_improve_first():
    z = np.random.default_rng(4).normal(size=N)
    both = (
        Parameter("noise", 1.0, "m"),
        Parameter("period", 1.0, "s", step=0.1, one_sided=True),
        Parameter("life", 1.0, "-"),
    )

    def log_errors(changes):
        assert changes[1] >= 0.0
        return 0.2 * changes[0] + 0.5 * changes[1] + 0.1 * changes[1] ** 2 + 0.01 * z * changes[2]

    noise, period, life = found = sensitivities(both, log_errors)
    assert period.step == 0.1 and abs(period.derivative.mean - 0.51) < 1e-12
    assert abs(period.halved.mean - 0.5 * np.log(2) - 0.1 * np.log(2) ** 2) < 1e-12
    assert abs(noise.halved.mean + 0.2 * np.log(2)) < 1e-12
    assert ranked(found) == [period, noise, life]
    assert "period: 0.51 +- " in describe(period) and ", doubled 1.484" in describe(period)


@pytest.mark.parametrize("period, kept", [(1, "11111111"), (2, "10101010"), (4, "10001000")])
def test_a_longer_period_leaves_scans_out(period, kept):
    found = np.asarray(keeps(jnp.asarray(period, float), 8))
    np.testing.assert_array_equal(found, [x == "1" for x in kept])
    assert np.asarray(keeps(jnp.asarray(2**0.5), 80)).sum() == 56


def test_trials_that_diverge_are_left_out_and_counted():
    log_errors, gradients = toy(drawn(3))

    def diverging(changes):
        found = log_errors(changes)
        found[:7], found[7:10] = np.nan, np.log(5.0)
        return found

    one = sensitivities(STEERING, diverging, gradients, max_error=1.0)[0]
    assert one.left_out == 10 and one.trials == N - 10 and np.isfinite(one.derivative).all()
    with pytest.raises(ValueError, match="0 of 4000 trials count"):
        sensitivities(STEERING, lambda changes: np.full(N, np.nan))
    with pytest.raises(ValueError, match="not some that differ"):
        sensitivities(STEERING[:1] * 2, log_errors)
    assert mean_of(np.arange(8.0), "a").standard_error == np.std(np.arange(8.0), ddof=1) / 8**0.5


def test_features_are_seen_from_another_pose():
    """A point that moves with the scanner is where it was in the world; so is its covariance."""
    was, now = jnp.array([1.0, 2.0, 0.4]), jnp.array([1.3, 1.8, 0.9])
    kinds = jnp.array([JUNCTION, CORNER, WALL, JUNCTION], jnp.int32)
    zero, true = jnp.zeros(4), jnp.array([True, True, True, False])
    cov = jnp.tile(jnp.diag(jnp.array([4.0, 1.0]))[None], (4, 1, 1))
    features = Features(
        kind=kinds,
        xy=jnp.array([[1.0, 0.5], [2.0, -1.0], [0.0, 0.0], [0.0, 0.0]]),
        cov=cov,
        direction=jnp.array([0.0, 0.3, 1.5, 0.0]),
        direction_variance=zero,
        descriptor=zero,
        degree=jnp.zeros(4, jnp.int32),
        certified=true,
        trusted=true,
        valid=true,
    )
    seen = jax.jit(features_from_pose)(now, was, features)
    turn = float(was[2] - now[2])

    def world(pose, xy):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return np.asarray(xy) @ np.array([[c, s], [-s, c]]) + np.asarray(pose[:2])

    np.testing.assert_allclose(world(now, seen.xy[:2]), world(was, features.xy[:2]), atol=1e-12)
    np.testing.assert_allclose(seen.direction, [0.0, 0.3 + turn, 1.5 + turn, 0.0], atol=1e-12)
    c, s = np.cos(turn), np.sin(turn)
    rotated = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(seen.cov[0], rotated @ np.diag([4.0, 1.0]) @ rotated.T, atol=1e-12)
    np.testing.assert_array_equal(seen.xy[2:], 0.0)


LIDAR = Lidar(num_beams=61, angle_min=-1.5, angle_increment=0.05)
CONFIG = Config.for_lidar(LIDAR)
CONFIG = CONFIG._replace(filter=CONFIG.filter._replace(max_landmarks=16))
PATH = densify([(1.0, 0.9), (2.5, 0.9)])
LIFE = life_in(named("office"), PATH, ranges=RangeErrors(missing=0.1))


def variant(life=None):
    params, robot = NoiseParams.for_simulated_robot(), Robot(mount=(0.1, 0.0, 0.02))
    return Variant("a", {}, CONFIG, params, robot, named("office"), PATH, 4, life)


@pytest.mark.slow
def test_gradients_of_trials_are_those_of_their_errors():
    """Of each trial, where its features move with the scanner and association stays."""
    names = ["encoder_noise", "mount_yaw", "filter.feature_std_scale", "life.ranges.missing"]
    errors = TrialErrors(variant(LIFE), names, num_trials=16, seed=1)
    zero = np.zeros(4)
    slopes = errors.gradients(zero)
    assert slopes.shape == (16, 4) and np.isfinite(slopes).all()
    base = errors.log_errors(zero)
    assert np.isfinite(base).all()
    step = 1e-4 * np.eye(4)[2]  # nothing but the filter depends on it
    steep = (errors.log_errors(step) - errors.log_errors(-step)) / 2e-4
    np.testing.assert_allclose(slopes[:, 2], steep, rtol=1e-3, atol=1e-5)
    assert np.any(slopes[:, 0]) and np.any(slopes[:, 1])
    # As many times the noise of encoders is another drive; beams that miss are others.
    assert np.all(errors.log_errors(np.array([0.5, 0, 0, 0])) != base)
    assert np.any(errors.log_errors(np.array([0, 0, 0, 1.0])) != base)
    with pytest.raises(ValueError, match="changes are not zero"):
        errors.gradients(step)


def test_parameters_that_are_not_there_are_refused():
    assert parameter_of(variant(LIFE), "life.ranges.missing").value == pytest.approx(0.1)
    assert parameter_of(variant(), "mount_yaw")[1:4] == (0.02, "rad", False)
    assert parameter_of(variant(), "range_noise").value == 0.01
    with pytest.raises(ValueError, match="'life.ranges.missing' is not known"):
        parameter_of(variant(), "life.ranges.missing")
    with pytest.raises(ValueError, match="'speed' is not known: there are encoder_noise, range"):
        parameter_of(variant(), "speed")
    with pytest.raises(ValueError, match="life.wheels.slip is 0.0: no factor changes it"):
        parameter_of(variant(LIFE), "life.wheels.slip")
