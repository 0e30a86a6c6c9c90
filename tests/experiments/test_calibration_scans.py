import jax
import numpy as np

from experiments import calibration_scans


def test_a_summary_compares_spread_and_standard_errors():
    rng, size = np.random.default_rng(0), len(calibration_scans.NAMES)
    rows = [
        {"off": 0.01 * rng.normal(size=size), "standard_errors": np.full(size, 0.01)}
        for _ in range(400)
    ]
    found = calibration_scans.summary(rows)
    np.testing.assert_allclose(found["error_per_spread"], 1.0, atol=4 / np.sqrt(800))
    np.testing.assert_allclose(found["rms_error"], 0.01, rtol=4 / np.sqrt(800))
    expected = 0.9973**size  # of 400, of which all numbers are within 3
    error = np.sqrt(expected * (1 - expected) / 400)
    assert abs(found["within_3_se"] / 400 - expected) < 4 * error


def test_a_log_has_the_errors_of_the_robot():
    log = calibration_scans.log_of(jax.random.key(0))
    assert log.has_odometry and log.ranges.shape[1] == calibration_scans.LIDAR.num_beams
    assert np.all(np.diff(log.times) == calibration_scans.HURT.scan_period)
