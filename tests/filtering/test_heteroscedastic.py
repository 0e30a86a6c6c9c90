"""Factors on the standard deviations of Q and R, by features of the step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering import heteroscedastic, noise
from jaxslam.filtering.heteroscedastic import MAX_EXPONENT, MeasurementWeights, OdometryWeights
from jaxslam.filtering.inputs import check_params
from jaxslam.filtering.noise import NoiseParams

XY = np.array([[3.0, 4.0], [2.0, -1.0], [0.0, 0.0], [1.0, 1.0]])
ANGLES = np.array([0.7, -2.0])  # [rad] of the two walls of the corner, away from it
FREE = ANGLES[0] - ANGLES[1]  # [rad] between them, on the side of the robot
WEIGHTS = jnp.array([0.3, -0.2, 0.5])
PARAMS = NoiseParams.for_laser_log(match_scans=True)
incidence, measurement_cov, motion_estimate = map(
    jax.jit, (heteroscedastic.incidence, noise.measurement_cov, noise.motion_estimate)
)


def measurement(inlier_fraction=0.8):
    features = Features(
        kind=np.array([JUNCTION, CORNER, WALL, JUNCTION], np.int32),
        xy=XY,
        cov=np.tile(1e-4 * np.eye(2), (4, 1, 1)),
        direction=np.array([0.0, ANGLES.mean(), 0.4, 0.0]),
        direction_variance=np.full(4, 1e-5),
        descriptor=np.array([1.5, FREE, 0.0, 0.5]),
        degree=np.full(4, 3, np.int32),
        certified=np.ones(4, bool),
        trusted=np.ones(4, bool),
        valid=np.array([True, True, True, False]),
    )
    match = ScanMatch(np.array([0.3, 0.0, 0.1]), 1e4 * np.eye(3), np.array(inlier_fraction))
    given = Measurement(np.array([0.3, 0.4, -0.1]), features, scan_match=match)
    return jax.tree.map(jnp.asarray, given)


def test_the_incidence_of_a_corner_is_the_larger_of_its_walls():
    beam = XY[1] / np.linalg.norm(XY[1])
    normals = np.stack([-np.sin(ANGLES), np.cos(ANGLES)], axis=1)
    found = np.asarray(incidence(measurement().features))
    np.testing.assert_allclose(found[1], np.arccos(np.abs(normals @ beam)).max(), rtol=1e-12)
    assert not found[[0, 2, 3]].any()


VALUES = {  # of the four features
    "range": [5.0, np.hypot(2.0, 1.0), 0.0, np.hypot(1.0, 1.0)],
    "incidence": None,  # of the filter's own function, in the test
    "turn": [0.1] * 4,
    "clearance": [1.5, 0.0, 0.0, 0.0],
    "unexplained": [0.2] * 4,
}


@pytest.mark.parametrize("name", MeasurementWeights._fields)
def test_each_standard_deviation_of_a_feature_has_its_factor(name):
    given = measurement()
    constant = np.asarray(measurement_cov(PARAMS, given.features, given))
    weighted = PARAMS._replace(measurement_weights=MeasurementWeights(**{name: WEIGHTS}))
    found = np.asarray(measurement_cov(weighted, given.features, given))
    values = VALUES[name] or [0.0, float(incidence(given.features)[1]), 0.0, 0.0]
    for i, value in enumerate(values):
        factors = np.exp(value * np.asarray(WEIGHTS))
        factors = np.array([factors[2], 1.0]) if i == 2 else factors[:2]
        np.testing.assert_allclose(found[i], np.outer(factors, factors) * constant[i], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "value"), [("distance", 0.5), ("turn", 0.1), ("clearance", 1.5), ("unexplained", 0.2)]
)
def test_each_standard_deviation_of_odometry_has_its_factor(name, value):
    given = measurement()
    rate = 1e-3 * jnp.diag(jnp.array([1.0, 2.0, 3.0]))
    params = PARAMS._replace(odometry_cov_rate=rate)
    distance, heading, matching = np.exp(value * np.asarray(WEIGHTS))
    each = np.array([distance, distance, heading])
    by_hand = params._replace(
        odometry_coefficients=params.odometry_coefficients * each[[0, 0, 2, 2]],
        odometry_cov_rate=jnp.asarray(np.outer(each, each)) * rate,
        scan_match_std_scale=params.scan_match_std_scale * matching,
    )
    weighted = params._replace(odometry_weights=OdometryWeights(**{name: WEIGHTS}))
    expected, found = motion_estimate(by_hand, given), motion_estimate(weighted, given)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-12)


def test_weights_of_zero_are_constant_noise_bit_for_bit():
    given, zero = measurement(), jnp.zeros(3)
    params = PARAMS._replace(
        measurement_weights=MeasurementWeights(*[zero] * 5),
        odometry_weights=OdometryWeights(*[zero] * 4),
    )
    expected = measurement_cov(PARAMS, given.features, given)
    np.testing.assert_array_equal(measurement_cov(params, given.features, given), expected)
    for a, b in zip(motion_estimate(params, given), motion_estimate(PARAMS, given), strict=True):
        np.testing.assert_array_equal(a, b)


def test_options_that_are_off_are_no_leaves():
    assert len(jax.tree.leaves(PARAMS)) == 6
    weighted = PARAMS._replace(measurement_weights=MeasurementWeights(range=WEIGHTS))
    assert len(jax.tree.leaves(weighted)) == 7


def test_a_factor_does_not_overflow():
    given = measurement()
    weights = MeasurementWeights(range=jnp.array([1e6, -1e6, 0.0]))
    found = measurement_cov(PARAMS._replace(measurement_weights=weights), given.features, given)
    ratio = jnp.sqrt(found / measurement_cov(PARAMS, given.features, given))[0]
    np.testing.assert_allclose(
        [ratio[0, 0], ratio[1, 1]], np.exp([MAX_EXPONENT, -MAX_EXPONENT]), rtol=1e-9
    )


def test_derivatives_are_those_of_differences():
    given = measurement()

    @jax.jit
    def value(r_weights, q_weights):
        params = PARAMS._replace(
            measurement_weights=MeasurementWeights(*r_weights),
            odometry_weights=OdometryWeights(*q_weights),
        )
        R = measurement_cov(params, given.features, given)
        increment, Q = motion_estimate(params, given)
        return 1e4 * (jnp.sum(jnp.sin(R)) + jnp.sum(increment) + jnp.sum(Q))

    both = 0.1 * jax.random.normal(jax.random.key(0), (9, 3))
    check_grads(value, (list(both[:5]), list(both[5:])), order=1, modes=["rev"], rtol=1e-5)


@pytest.mark.parametrize(
    ("weights", "problem"),
    [
        ({"measurement_weights": WEIGHTS}, "measurement_weights is ArrayImpl, not Measurem"),
        (
            {"measurement_weights": MeasurementWeights(turn=jnp.zeros(2))},
            r"measurement_weights.turn is float64 \(2,\), not",
        ),
        (
            {"odometry_weights": OdometryWeights(turn=jnp.array([0.0, np.nan, 0.0]))},
            r"odometry_weights.turn is \[0.0, nan, 0.0\], not finite",
        ),
    ],
)
def test_wrong_weights_are_refused(weights, problem):
    with pytest.raises(ValueError, match=problem):
        check_params(PARAMS._replace(**weights))
