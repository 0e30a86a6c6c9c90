import numpy as np
import pytest

from jaxslam.cli import tune_report
from jaxslam.evaluation import consistency_of_nis
from jaxslam.filtering.noise import NoiseParams
from jaxslam.tuning.standard_errors import StandardErrors


def report(errors=None, consistency=None):
    names, start = tune_report.numbers_of(NoiseParams.for_landmark_sensor())
    return tune_report.TuneReport(
        before=consistency,
        after=consistency,
        names=names,
        start=start,
        found=0.5 * start,
        frozen=np.array([name == "wall" for name in names]),
        errors=errors,
    )


@pytest.fixture
def errors():
    names, values = tune_report.numbers_of(NoiseParams.for_landmark_sensor())
    relative = np.full(len(names), 0.1)
    covariance = np.diag(relative**2)
    covariance[0, 1] = covariance[1, 0] = -0.004
    relative[4], covariance[4] = np.inf, 0.0  # the data do not determine the range
    covariance[:, 4] = 0.0
    relative[7], covariance[7, 7] = np.nan, 0.0
    sure = np.isfinite(relative)
    return StandardErrors(names, relative, covariance, sure, ("not identifiable: range",))


def test_numbers_of_noise_are_named_by_their_keys():
    names, values = tune_report.numbers_of(NoiseParams.for_landmark_sensor())
    assert names == (*(f"odometry[{i}]" for i in range(4)), "range", "bearing", "scale", "wall")
    np.testing.assert_allclose(values, [0.1] * 4 + [0.15, 0.03, 1.0, 0.03])
    laser = tune_report.numbers_of(NoiseParams.for_laser_log(match_scans=True))
    assert laser[0][-1] == "alignment" and laser[1].shape == (9,)


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
    assert correlations["names"] == [name for name in report().names if name != "wall"]
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
