import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.cli import tune_report
from jaxslam.evaluation import consistency_of_nis
from jaxslam.filtering.heteroscedastic import MeasurementWeights
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import noise_file
from jaxslam.tuning import parameters
from jaxslam.tuning.standard_errors import StandardErrors

START = NoiseParams.for_landmark_sensor()
NAMES = parameters.param_names(START)


def report(errors=None, consistency=None, start=START):
    return tune_report.TuneReport(
        before=consistency,
        after=consistency,
        start=start,
        found=jax.tree.map(lambda x: x / 2, start),
        frozen=np.array([name.startswith("wall") for name in parameters.param_names(start)]),
        errors=errors,
    )


@pytest.fixture
def errors():
    relative = np.full(len(NAMES), 0.1)
    covariance = np.diag(relative**2)
    covariance[0, 1] = covariance[1, 0] = -0.004
    relative[4], covariance[4] = np.inf, 0.0  # the data do not determine the range
    covariance[:, 4] = 0.0
    relative[7], covariance[7, 7] = np.nan, 0.0
    sure = np.isfinite(relative)
    return StandardErrors(NAMES, relative, covariance, sure, ("not identifiable: range",))


def test_numbers_of_all_kinds_are_estimates_by_their_keys():
    start = START._replace(
        odometry_cov_rate=jnp.diag(jnp.array([0.01, 0.04, 0.01])),
        measurement_weights=MeasurementWeights(range=jnp.array([0.0, -0.2, 0.1])),
    )
    names = parameters.param_names(start)
    theta_error = np.full(len(names), 0.1)
    of_params = jax.tree.map(lambda x: jnp.full_like(x, 0.3), start)
    whole = StandardErrors(
        names, theta_error, np.eye(len(names)), np.ones(len(names), bool), (), of_params
    )
    found = {each.name: each for each in tune_report.estimates_of(report(whole, start=start))}
    assert list(found)[:5] == ["odometry[0]", "odometry[1]", "odometry[2]", "odometry[3]", "range"]
    assert found["bearing"].positive and found["bearing"].std_error == 0.1
    assert found["bearing"].before == pytest.approx(0.03) and found["bearing"].unit == "rad"
    weight = found["measurement_weights.range[1]"]
    assert (weight.before, weight.after, weight.positive) == pytest.approx((-0.2, -0.1, False))
    assert weight.std_error == pytest.approx(0.3), "its own, not that of its logarithm"
    factor = [each for name, each in found.items() if name.startswith("odometry_cov_rate[")]
    assert len(factor) == 6 and not factor[0].positive
    change = [each.after - each.before for each in factor]
    assert sorted(change) == pytest.approx([-np.log(2) / 2] * 3 + [0.0] * 3), "half the covariance"


def test_parameters_that_are_not_identifiable_or_frozen_are_marked(errors):
    blocks = tune_report.report_blocks(report(errors))
    parameters = blocks["parameters"]
    assert parameters["range"]["identifiable"] is False and parameters["range"]["interval"] is None
    assert parameters["wall"]["frozen"] and parameters["wall"]["identifiable"]
    assert parameters["bearing"] == {
        "before": pytest.approx(0.03),
        "value": pytest.approx(0.015),
        "interval": pytest.approx([0.015 * np.exp(-0.1959964), 0.015 * np.exp(0.1959964)]),
        "identifiable": True,
        "frozen": False,
    }


def test_correlations_are_those_of_the_parameters_that_were_tuned(errors):
    correlations = tune_report.report_blocks(report(errors))["correlations"]
    keys = map(noise_file.key_of, NAMES)
    assert correlations["names"] == [key for key in keys if key != "wall"]
    matrix = np.array(correlations["matrix"])
    assert matrix[0, 1] == pytest.approx(-0.4) and matrix[0, 2] == 0.0
    assert np.isnan(matrix[4]).all() and np.isnan(matrix[:, 4]).all()
    known = np.arange(7) != 4
    np.testing.assert_allclose(np.diagonal(matrix)[known], 1.0)


def test_without_standard_errors_or_measurements_there_is_still_a_report():
    blocks = tune_report.report_blocks(report())
    assert blocks["correlations"] is None
    assert blocks["consistency"] == {"before": None, "after": None}
    assert all(each["interval"] is None for each in blocks["parameters"].values())
    some = report(consistency=consistency_of_nis(np.ones(30), 1))
    found = tune_report.report_blocks(some)["consistency"]["after"]
    assert found["nis_per_dof"] == 1.0 and found["nis_per_dof_interval"] == [1.0, 1.0]
