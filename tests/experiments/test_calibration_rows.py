"""Calibration by `tune` beside the closed form, and noise that adapts, as rows of `tuning`."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from experiments import (
    adaptation,
    calibration,
    calibration_drives,
    calibration_rows,
    common,
    exact_model,
)
from experiments.calibration_drives import HURT
from jaxslam.core import se2_np
from jaxslam.core.calibration import calibrate_odometry
from jaxslam.core.episode import Episode
from jaxslam.filtering.adaptation import AdaptationSpec
from jaxslam.simulation.robot import wheel_increment
from jaxslam.tuning import fitting, parameters


def exact_drives(key, robot, *, num_trials):
    """Wheels without noise, clocks that agree, and the scanner's true motion; no measurements."""
    wheels = np.random.default_rng(0).uniform(-0.1, 0.3, (num_trials, 20, 2))
    turned = [wheel_increment(a, b, robot.wheel_base) for a, b in wheels.reshape(-1, 2)]
    odometry = np.array(turned).reshape(num_trials, 20, 3)
    odometry[:, 0] = 0.0
    known = robot.calibration()._replace(time_offset=np.zeros(()))
    scanner = [calibrate_odometry(known, own, wheel_base=robot.wheel_base) for own in odometry]
    truth = [se2_np.dead_reckoning(np.zeros(3), np.asarray(own)) for own in scanner]
    return Episode(np.array(truth), odometry, None)


def test_the_closed_form_and_tune_start_alike_and_are_evaluated_on_other_drives(
    monkeypatch, tmp_path
):
    asked = []

    def heldout(params, drives):
        asked.append((params, len(drives.odometry)))
        return {"heldout_rmse_m": 0.01 * len(asked), "nees": 1.0}

    def tune(model, params, drives, **options):
        tuned.append((params, options))
        return SimpleNamespace(params=params._replace(noise="tuned"))

    def approach(loss, params, train):
        assert loss == "innovation_nll" and len(train.odometry) == 3
        return params._replace(calibration=HURT.calibration())

    tuned = []
    monkeypatch.setattr(calibration_drives, "drives", exact_drives)
    monkeypatch.setattr(calibration, "heldout", heldout)
    monkeypatch.setattr(calibration, "approach", approach)
    monkeypatch.setattr(fitting, "tune", tune)
    cache = common.ResultCache(tmp_path / "cache", "x")
    rows = calibration_rows.compute(0, 3, 2, cache)
    noise_by_gradient = "closed form, noise by gradient"
    methods = ["truth", "hand", "noise by gradient", "closed form", noise_by_gradient, "gradient"]
    assert [row["method"] for row in rows] == methods and all(n == 2 for _, n in asked)
    error = {row["method"]: row["error"] for row in rows}
    truth = HURT.calibration()
    np.testing.assert_allclose(error["hand"]["mount"], -np.asarray(truth.mount), rtol=1e-6)
    np.testing.assert_allclose(error["gradient"]["mount"], 0.0)
    for field in ("distance_scale", "turn_scale", "turn_per_distance", "mount"):
        np.testing.assert_allclose(error["closed form"][field], 0.0, atol=1e-8)
    np.testing.assert_allclose(error["closed form"]["time_offset"], -HURT.time_offset)
    assert error["closed form"] == error[noise_by_gradient]
    hand = parameters.flatten_params(calibration.uncalibrated().noise)
    given = dict(zip(methods, (params for params, _ in asked), strict=True))
    for method in ("hand", "closed form", "gradient"):
        np.testing.assert_allclose(parameters.flatten_params(given[method].noise), hand)
    assert given[noise_by_gradient].noise == given["noise by gradient"].noise == "tuned"
    assert error["noise by gradient"] == common.plain(error["hand"])
    frozen = [options["frozen"] for _, options in tuned if "frozen" in options]
    assert frozen == 2 * [("calibration",)]
    count = len(asked)
    again = calibration_rows.compute(0, 3, 2, cache)
    assert [row["method"] for row in again] == methods and len(asked) == count + 2  # the known


@pytest.mark.slow
def test_a_filter_that_adapts_finds_the_factor_on_r():
    truth = exact_model.true_params()
    drives = exact_model.drives(jax.random.key(2), truth, num_trials=4, num_scans=60)
    config = exact_model.CONFIG.filter
    off = adaptation.scaled(truth, 1.0, 3.0)
    found = adaptation.heldout(config, off, drives)
    assert found["r_factor"] == pytest.approx(1 / 3, rel=0.1) and 0.4 < found["q_factor"] < 2.5
    adapting = config._replace(adaptation=AdaptationSpec())
    own = adaptation.run(adapting, off, drives)
    assert found["heldout_rmse_m"] == pytest.approx(own["position_rmse_m"], rel=1e-6)
    assert np.exp(own["log_r"]["mean"]) == pytest.approx(found["r_factor"], rel=1e-6)
