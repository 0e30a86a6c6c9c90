"""All options of the noise at once: neutral ones change nothing, and derivatives of each."""

from functools import partial

import jax
import jax.numpy as jnp
import landmark_drives
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxslam.filtering import run_filter
from jaxslam.filtering.adaptation import AdaptationSpec
from jaxslam.filtering.config import init
from jaxslam.filtering.heteroscedastic import MeasurementWeights, OdometryWeights
from jaxslam.filtering.noise_model import NoiseModel


def scale_measurement(custom, features, measurement, R):
    return R * jnp.exp(custom["R"])


def scale_odometry(custom, measurement, Q):
    return Q * jnp.exp(custom["Q"])


MODEL = NoiseModel(scale_measurement, scale_odometry)
CONFIG = landmark_drives.CONFIG._replace(
    noise_model=MODEL, odometry_bias_std=(0.05, 0.03, 0.05), adaptation=AdaptationSpec(memory=20.0)
)
NEUTRAL = CONFIG._replace(
    odometry_bias_std=(0.0, 0.0, 0.0), adaptation=AdaptationSpec(prior_std=1e-9)
)
ZERO = jnp.zeros(3)


def options(**changes):
    """Parameters with every option on and without effect, but for the changes."""
    neutral = landmark_drives.PARAMS._replace(
        odometry_cov_rate=jnp.zeros((3, 3)),
        odometry_weights=OdometryWeights(distance=ZERO, turn=ZERO),
        measurement_weights=MeasurementWeights(range=ZERO, turn=ZERO),
        student_dof=jnp.array(1e9),
        odometry_bias_walk=ZERO,
        custom={"R": jnp.zeros(()), "Q": jnp.zeros(())},
    )
    return neutral._replace(**changes)


@pytest.fixture(scope="module")
def measurements():
    drives = landmark_drives.drives(jax.random.key(2), count=1, steps=8)
    return jax.tree.map(lambda x: x[0], drives[1])


@pytest.mark.slow
def test_neutral_options_change_nothing(measurements):
    plain = landmark_drives.CONFIG
    start = init(plain, ZERO)
    belief, info = run_filter(plain, landmark_drives.PARAMS, start, measurements)
    same, same_info = run_filter(NEUTRAL, options(), init(NEUTRAL, ZERO), measurements)
    np.testing.assert_allclose(same.mean, belief.mean, atol=1e-7)
    np.testing.assert_allclose(same.cov, belief.cov, atol=1e-9)
    np.testing.assert_allclose(same_info.log_likelihood, info.log_likelihood, atol=1e-5)
    np.testing.assert_allclose(same_info.nis, info.nis, atol=1e-5)
    np.testing.assert_array_equal(same_info.dof, info.dof)
    assert info.odometry_bias is None and info.noise_factors is None


@pytest.mark.slow
def test_derivatives_by_every_parameter_are_those_of_differences(measurements):
    params = options(
        odometry_cov_rate=1e-4 * jnp.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 1.5]]),
        odometry_weights=OdometryWeights(distance=ZERO + 0.2, turn=ZERO - 0.3),
        measurement_weights=MeasurementWeights(range=ZERO + 0.1, turn=ZERO + 0.2),
        student_dof=jnp.array(5.0),
        odometry_bias_walk=ZERO + 0.02,
        custom={"R": jnp.array(0.1), "Q": jnp.array(-0.2)},
    )
    flat, unravel = ravel_pytree(params)
    start = init(CONFIG, ZERO)

    @jax.jit
    def value(numbers):
        info = run_filter(CONFIG, unravel(numbers), start, measurements)[1]
        others = jnp.sum(info.pose) + jnp.sum(info.noise_factors) + jnp.sum(info.odometry_bias)
        return jnp.sum(info.log_likelihood) + others

    gradient = np.asarray(jax.jit(jax.grad(value))(flat))
    step = 1e-5 * np.maximum(np.abs(np.asarray(flat)), 1e-4)
    beside = jnp.diag(jnp.asarray(step))
    differences = np.array([value(flat + e) - value(flat - e) for e in beside]) / (2 * step)
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient, differences, rtol=2e-4, atol=1e-4)
    # Each is used, but for the factor on scan matching, of walls, and of the front end's own noise.
    unused = ravel_pytree(
        jax.tree.map(jnp.zeros_like, params)._replace(
            feature_std_scale=jnp.array(1.0),
            wall_angle_std=jnp.array(1.0),
            odometry_weights=OdometryWeights(ZERO.at[2].set(1.0), ZERO.at[2].set(1.0)),
            measurement_weights=MeasurementWeights(
                range=ZERO.at[2].set(1.0), turn=ZERO.at[2].set(1.0)
            ),
        )
    )[0]
    assert ((gradient == 0.0) == np.asarray(unused, bool)).all()


def test_parameters_without_their_model_are_refused(measurements):
    plain = landmark_drives.CONFIG
    params = landmark_drives.PARAMS._replace(custom={"R": ZERO})
    with pytest.raises(ValueError, match="params.custom is given, but config.noise_model is None"):
        run_filter(plain, params, init(plain, ZERO), measurements)
    bad = options(custom={"R": jnp.array(np.nan), "Q": jnp.zeros(())})
    with pytest.raises(ValueError, match=r"params.custom\['R'\] holds numbers that are not finite"):
        run_filter(CONFIG, bad, init(CONFIG, ZERO), measurements)
    wrong = CONFIG._replace(noise_model=scale_odometry)
    with pytest.raises(ValueError, match="config.noise_model is .*, not a NoiseModel of functions"):
        init(wrong, ZERO)


def returns_a_vector(custom, measurement, Q):
    return jnp.ones(3)


def returns_nan(custom, features, measurement, R):
    return R.at[0].set(jnp.nan)


def test_a_model_must_return_the_shape_and_what_is_not_finite_is_not_taken(measurements):
    start = partial(init, pose=ZERO)
    vector = landmark_drives.CONFIG._replace(noise_model=NoiseModel(odometry=returns_a_vector))
    with pytest.raises(ValueError, match=r"noise_model.odometry\(...\) is float64 \(3,\), not fl"):
        run_filter(vector, landmark_drives.PARAMS, start(vector), measurements)
    holes = landmark_drives.CONFIG._replace(noise_model=NoiseModel(measurement=returns_nan))
    found = run_filter(holes, landmark_drives.PARAMS, start(holes), measurements)[0]
    plain = landmark_drives.CONFIG
    expected = run_filter(plain, landmark_drives.PARAMS, start(plain), measurements)[0]
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-12)
