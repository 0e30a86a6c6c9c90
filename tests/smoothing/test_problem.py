"""The batch problem made of a filter's measurements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smoothing_problems import START, L, M, T, drive

from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.features import features_from_range_bearing
from jaxslam.smoothing.problem import ODOMETRY_STD_FLOOR, LandmarkPrior, build_problem

NOISE = NoiseParams(*(jnp.array(x) for x in ([0.04, 0.0, 0.02, 0.0], 0.1, 0.03, 1.0, 1.0)))


def measurements_of(num_steps, num_features):
    """Measurements of a robot at rest, all of range 1 m and bearing 1 rad."""
    polar = jnp.ones((num_steps, num_features, 2))
    seen = jax.vmap(features_from_range_bearing)(polar, jnp.ones(polar.shape[:2], bool))
    return Measurement(jnp.zeros((num_steps, 3)), seen)


def test_features_that_are_not_valid_or_hold_nan_have_no_landmark():
    seen = jax.vmap(features_from_range_bearing)(
        jnp.ones((2, 3, 2)), jnp.array([[True, True, False]] * 2)
    )
    seen = seen._replace(xy=seen.xy.at[1, 0].set(jnp.nan))
    measurements = Measurement(jnp.array([[0.0, 0.0, 0.0], [0.25, 0.0, 0.1]]), seen)
    index = jnp.array([[0, 2, 1]] * 2, jnp.int32)
    problem = jax.jit(build_problem)(NOISE, jnp.zeros(3), measurements, index)
    np.testing.assert_array_equal(problem.landmark_index, [[0, 2, -1], [-1, 2, -1]])
    for numbers in (problem.measurement, problem.measurement_cov, problem.odometry_cov):
        assert np.isfinite(numbers).all()
    np.testing.assert_allclose(problem.measurement[0, 0], [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(problem.measurement_cov[1, 1], np.diag([0.1, 0.03]) ** 2, atol=1e-12)
    floor = ODOMETRY_STD_FLOOR**2 * np.eye(3)
    np.testing.assert_allclose(problem.odometry_cov[0], floor, atol=1e-15)


def test_lists_numpy_and_jax_of_either_precision_give_the_same():
    measurements, index = measurements_of(T, M), drive(0)[0].landmark_index
    expected = build_problem(NOISE, [0, 0, 1], measurements, index)
    numpy = jax.tree.map(np.asarray, measurements)
    lists = Measurement(
        measurements.odometry.tolist(),
        jax.tree.map(lambda x: x.tolist(), numpy.features),
    )
    single = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, numpy)
    params = NoiseParams(*(None if x is None else np.asarray(x).tolist() for x in NOISE))
    found = build_problem(params, np.array([0.0, 0.0, 1.0]), numpy, np.asarray(index, np.int64))
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    found = build_problem(NOISE, jnp.array([0, 0, 1]), lists, index.tolist())
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    found = build_problem(NOISE, [0, 0, 1], single, index)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-7), found, expected)


def test_wrong_arguments_are_refused_by_name():
    measurements, index = measurements_of(T, M), drive(0)[0].landmark_index
    with pytest.raises(ValueError, match=r"landmark_index is int32 \(12, 4\), not"):
        build_problem(NOISE, START, measurements, index[:, :4])
    with pytest.raises(ValueError, match=r"landmark_index is float64 \(12, 5\), not integer"):
        build_problem(NOISE, START, measurements, index.astype(float))
    with pytest.raises(ValueError, match=r"start is float64 \(2,\), not .*\(3,\)"):
        build_problem(NOISE, START[:2], measurements, index)
    with pytest.raises(ValueError, match=r"measurements.odometry is .*\(12, 2\), not"):
        wrong = measurements._replace(odometry=np.zeros((T, 2)))
        build_problem(NOISE, START, wrong, index)
    with pytest.raises(
        ValueError, match=r"measurements.features.kind is .*\(12, 5\), not .*\(4, M\)"
    ):
        wrong = measurements._replace(odometry=np.zeros((4, 3)))
        build_problem(NOISE, START, wrong, index)
    with pytest.raises(ValueError, match="measurements is a Features, not a Measurement"):
        build_problem(NOISE, START, measurements.features, index)
    with pytest.raises(ValueError, match="params is list, not NoiseParams"):
        build_problem([0.1], START, measurements, index)
    with pytest.raises(ValueError, match="params.scan_match_std_scale is None"):
        match = ScanMatch(np.zeros((T, 3)), np.zeros((T, 3, 3)), np.ones(T))
        build_problem(NOISE, START, measurements._replace(scan_match=match), index)
    with pytest.raises(ValueError, match="untrusted_inflation is 0.0, not a finite number"):
        build_problem(NOISE, START, measurements, index, untrusted_inflation=0.0)
    with pytest.raises(ValueError, match=r"prior.information is .*\(6, 2\), not .*\(6, 2, 2\)"):
        prior = LandmarkPrior(np.zeros((L, 2)), np.zeros((L, 2)))
        build_problem(NOISE, START, measurements, index, prior=prior)
