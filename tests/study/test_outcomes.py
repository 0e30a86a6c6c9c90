"""Outcomes of trials, of errors that are made up, and sums over them."""

import json

import numpy as np
import pytest

from jaxslam.evaluation import nees, nees_per_dof
from jaxslam.pipeline.episodes import TrialResult
from jaxslam.study.outcomes import compare, failures_by_place, outcomes_of, summarise

N, T = 30, 20


def results(scale=0.1, seed=0, far=(), broken=()):
    """Trials along a line of 1 m a scan; those in `far` are 2 m off from scan 7 on."""
    rng = np.random.default_rng(seed)
    truth = np.zeros((N, T, 3))
    truth[..., 0] = np.arange(T)
    estimate = truth + scale * rng.normal(size=truth.shape)
    for trial in far:
        estimate[trial, 7:, 1] += 2.0
    for trial in broken:
        estimate[trial, 12:] = np.nan
    return TrialResult(
        truth,
        estimate,
        np.tile(np.eye(3) * scale**2, (N, T, 1, 1)),
        truth,
        np.full((N, T), 3),
        np.full(N, 9),
        np.isin(np.arange(N), broken, invert=True),
        np.ones((N, T), bool),
        np.full(N, T),
    )


def test_outcomes_are_the_errors_of_the_trials():
    given = results()
    found = outcomes_of(given)
    error = given.estimate - given.truth
    np.testing.assert_allclose(found.error, np.hypot(error[..., 0], error[..., 1]), rtol=1e-6)
    own = [nees_per_dof(nees(e, c).mean()) for e, c in zip(error, given.cov, strict=True)]
    np.testing.assert_allclose(found.nees, own, rtol=1e-6)
    assert found.finite.all() and np.all(found.matches == 3.0)


def test_a_summary_counts_failures_and_says_when_and_where_they_happened():
    found = outcomes_of(results(far=(2, 5), broken=(9,)))
    numbers = summarise(found, success_distance=1.0, scan_period=0.5)
    assert numbers["failed_trials"] == [2, 5, 9] and numbers["nonfinite"] == 1
    assert numbers["success"]["value"] == 27 / 30
    assert numbers["time_to_failure_s"]["times"] == [3.5, 6.0]
    np.testing.assert_allclose(
        numbers["time_to_failure_s"]["share_without_failure"], [28 / 30, 27 / 30]
    )
    assert numbers["position_rmse_m"]["p99"]["high"] is None  # no trial is sure to be above it
    places = failures_by_place(found, success_distance=1.0, cell=0.5)
    failures = np.array(places["failures"])
    assert failures.sum() == 3 and failures[14].sum() == 2 and failures[24].sum() == 1
    visits = np.array(places["visits"]).sum(axis=1)
    assert visits[0] == N and visits[14] == N and visits[16] == N - 2 and visits[26] == N - 3
    json.dumps([numbers, places], allow_nan=False)


def test_variants_are_compared_by_trials_with_the_same_numbers():
    first, second = outcomes_of(results(0.1)), outcomes_of(results(0.2, far=(4,)))
    found = compare(first, second, success_distance=1.0)
    assert found["success"]["mean"] == -1 / N
    alike = compare(first, outcomes_of(results(0.2)), success_distance=1.0)
    np.testing.assert_allclose(alike["position_rmse_ratio"], 2.0, rtol=1e-5)
    assert alike["log_position_rmse"]["standard_error"] < 1e-6
    assert alike["log_position_rmse"]["unpaired_standard_error"] > 1e-3


def test_a_variant_of_which_all_trials_fail_has_numbers():
    broken = outcomes_of(results(broken=range(N)))
    numbers = summarise(broken, success_distance=1.0, scan_period=0.5)
    assert numbers["success"]["value"] == 0.0 and numbers["nonfinite"] == N
    assert numbers["position_rmse_m"]["p50"]["value"] is None
    found = compare(broken, broken, success_distance=1.0)
    assert found["success"]["mean"] == 0.0 and found["log_position_rmse"]["pairs"] == 0


@pytest.mark.parametrize("distance", [0.05, 5.0])
def test_the_limit_of_success_is_the_users(distance):
    found = summarise(outcomes_of(results()), success_distance=distance, scan_period=0.5)
    assert found["success"]["value"] == float(distance > 1.0)
