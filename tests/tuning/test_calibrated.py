"""Systematic errors tuned beside the noise, on drives of a simulated robot that has them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import calibration_drives
from experiments.calibration_drives import CONFIG, HURT
from jaxslam.core.calibration import Calibration, calibrate_odometry
from jaxslam.tuning import fitting, parameters, priors, transforms
from jaxslam.tuning.calibrated import (
    CalibratedParams,
    calibrate_episode,
    calibrated_slam_model,
    default_prior,
)

TRUTH = CalibratedParams(calibration_drives.measurement_noise(), HURT.calibration())
START = TRUTH._replace(calibration=Calibration.identity())
OWN = {"scan_period": HURT.scan_period, "wheel_base": HURT.wheel_base}
B, STEPS = 24, 30
LOSS = "innovation_nll"


@pytest.fixture(scope="module", autouse=True)
def one_device():
    """Each device compiles its own program; `test_batching` asserts that their results agree."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "devices", lambda real=jax.devices: real()[:1])
        yield


@pytest.fixture(scope="module")
def episodes():
    key = jax.random.key(3)
    return calibration_drives.drives(key, HURT, num_trials=B, num_scans=STEPS)


def one_of(episodes):
    return jax.tree.map(lambda x: jnp.asarray(x[0]), episodes)


def test_an_episode_is_calibrated_as_its_odometry_is(episodes):
    given = jax.tree.map(jnp.asarray, TRUTH.calibration)
    found = jax.jit(partial(calibrate_episode, **OWN))(given, one_of(episodes))
    exact = calibrate_odometry(
        TRUTH.calibration,
        episodes.odometry[0],
        times=HURT.scan_period * np.arange(STEPS),
        wheel_base=HURT.wheel_base,
    )
    np.testing.assert_allclose(found.odometry, exact, atol=1e-13)
    np.testing.assert_array_equal(found.truth, episodes.truth[0])
    timeless = jax.jit(partial(calibrate_episode, wheel_base=HURT.wheel_base))
    without = timeless(given, one_of(episodes))
    late = given._replace(time_offset=given.time_offset + 1.0)
    other = timeless(late, one_of(episodes))
    np.testing.assert_array_equal(without.odometry, other.odometry)


def test_a_model_is_one_object_for_the_same_robot():
    """Another object would be compiled again."""
    assert calibrated_slam_model(CONFIG, **OWN) is calibrated_slam_model(CONFIG, **OWN)
    assert calibrated_slam_model(CONFIG, **OWN) != calibrated_slam_model(CONFIG)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"scan_period": 0.0}, "scan_period is 0.0, not above 0"),
        ({"scan_period": np.nan}, "scan_period is nan, not above 0"),
        ({"wheel_base": -0.4}, "wheel_base is -0.4, not 0 or more"),
    ],
)
def test_an_impossible_robot_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        calibrated_slam_model(CONFIG, **given)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (TRUTH.noise, "params is NoiseParams, not CalibratedParams"),
        (TRUTH._replace(calibration=None), "params.calibration is NoneType, not Calibration"),
        (
            TRUTH._replace(calibration=TRUTH.calibration._replace(mount=np.zeros(2))),
            r"params.calibration.mount .*\(2,\)",
        ),
        (
            TRUTH._replace(calibration=TRUTH.calibration._replace(turn_scale=np.array(-1.0))),
            r"params.calibration.turn_scale is -1.0, not positive and finite",
        ),
    ],
)
def test_parameters_that_do_not_fit_are_refused_before_anything_compiles(episodes, params, message):
    with pytest.raises(ValueError, match=message):
        fitting.tune(calibrated_slam_model(CONFIG, **OWN), params, episodes, loss=LOSS)


def test_parameters_have_names_units_and_priors():
    names = parameters.param_names(TRUTH)
    assert names[-7:] == (
        *("calibration.distance_scale", "calibration.turn_scale"),
        *("calibration.turn_per_distance", "calibration.mount[0]", "calibration.mount[1]"),
        *("calibration.mount[2]", "calibration.time_offset"),
    )
    theta = parameters.flatten_params(TRUTH)
    back = parameters.unflatten_params(theta, TRUTH)
    for found, exact in zip(jax.tree.leaves(back), jax.tree.leaves(TRUTH), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-12)
    centre = parameters.flatten_params(START)
    flat = priors.flatten_prior(default_prior(), TRUTH)
    np.testing.assert_allclose(flat.mean[-7:], centre[-7:], atol=1e-12)
    np.testing.assert_array_equal(flat.precision[:-7], 0.0)
    np.testing.assert_allclose(flat.precision[-7:], 1.0)  # the units of the transforms


def test_a_scaled_positive_transform_is_a_logarithm_in_its_units():
    own = transforms.positive(0.05)
    x = np.array([0.9, 1.0, 1.2])
    theta = own.inverse(x, *own.constants)
    np.testing.assert_allclose(theta, np.log(x) / 0.05)
    np.testing.assert_allclose(own.forward(theta, *own.constants), x)
    with pytest.raises(ValueError, match="scale is 0.0, not positive and finite"):
        transforms.positive(0.0)


@pytest.mark.slow
def test_the_likelihood_determines_the_calibration(episodes):
    """Its slope is that of finite differences, 0 at the truth (4.5 standard errors), and leads to
    it from a robot that is taken to have no errors."""
    model, own = calibrated_slam_model(CONFIG, **OWN), slice(-7, None)
    _, each = fitting.gradients(model, TRUTH, episodes, LOSS)
    z = each.mean(axis=0) / (each.std(axis=0, ddof=1) / np.sqrt(B))
    assert np.abs(z[own]).max() < 4.5, z
    step = 1e-5
    for i in range(each.shape[1] - 7, each.shape[1]):
        up, down = (
            fitting.values(model, parameters.shift_param(TRUTH, i, by), episodes, LOSS)
            for by in (step, -step)
        )
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(each[:, i], slope, rtol=2e-5, atol=2e-6, err_msg=str(i))
    found = fitting.tune(model, START, episodes, loss=LOSS, num_updates=40, frozen=("noise",))
    off = parameters.flatten_params(found.params) - parameters.flatten_params(TRUTH)
    assert np.abs(off[own]).max() < 0.1, off  # of 5 %, 10 cm, 0.05 rad or 0.1 s; 3.8 at the start
