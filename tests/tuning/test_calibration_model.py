"""The calibration as a model to tune: the same estimate as by Gauss-Newton steps."""

import jax
import numpy as np
import pytest
import wheel_drives

from jaxslam.smoothing.calibration_noise import log_density
from jaxslam.smoothing.odometry_calibration import estimate_calibration, flat, motion_error
from jaxslam.tuning import calibration_model
from jaxslam.tuning.calibration_model import CALIBRATION_MODEL, CalibrationParams
from jaxslam.tuning.model import run_model


def test_pieces_hold_all_spans_once():
    rng = np.random.default_rng(0)
    drives = [wheel_drives.drive(rng, steps=50), wheel_drives.drive(rng, steps=33)]
    pieces = calibration_model.cut_into_pieces(drives, 8)
    assert len(pieces.usable) >= 8 and pieces.usable.sum() == 49 + 32
    whole = np.concatenate([motion_error(wheel_drives.TRUE, spans) for spans in drives])
    each = [
        motion_error(wheel_drives.TRUE, jax.tree.map(lambda x, k=k: x[k], pieces))[usable]
        for k, usable in enumerate(pieces.usable)
    ]
    # At the ends of a drive the odometry before and after it is not known.
    np.testing.assert_allclose(np.concatenate(each)[1:-1], whole[1:-1], atol=1e-9)


def test_a_piece_has_the_density_of_its_spans():
    spans = wheel_drives.drive(np.random.default_rng(1), steps=30)
    usable = np.arange(29) != 7
    found = estimate_calibration(spans)
    params = CalibrationParams(found.calibration, found.noise)
    on_device = jax.tree.map(jax.numpy.asarray, (params, spans._replace(usable=usable)))
    info = run_model(CALIBRATION_MODEL, *on_device)[1]
    error = motion_error(found.calibration, spans)
    density, square = log_density(found.noise, error, spans.driven, spans.match_cov)
    np.testing.assert_allclose(info.log_likelihood, np.where(usable, density, 0.0), rtol=1e-9)
    np.testing.assert_allclose(info.nis, np.where(usable, square, 0.0), rtol=1e-9)
    np.testing.assert_array_equal(info.dof, np.where(usable, 3, 0))
    loss = calibration_model.span_nll(info, on_device[1])
    np.testing.assert_allclose(loss, -density[usable].sum() / 29, rtol=1e-9)


@pytest.mark.slow
def test_tuning_finds_what_gauss_newton_steps_find():
    """Two drives of one robot, from an estimate of the first: that of all their spans."""
    rng = np.random.default_rng(2)
    drives = [wheel_drives.drive(rng, steps=150) for _ in range(2)]
    start = estimate_calibration(drives[0])
    found = calibration_model.tune_calibration(drives, start)
    off = flat(found.calibration) - flat(wheel_drives.TRUE)
    sure = flat(found.standard_errors)
    assert np.all(np.abs(off) < 4 * sure) and not found.not_determined
    # Of twice as many spans: about 0.7 of the standard errors of one drive.
    ratio = sure / flat(start.standard_errors)
    assert np.all(ratio < 1.3) and np.median(ratio) < 1.0
    one = calibration_model.tune_calibration(drives[:1], start)
    change = flat(one.calibration) - flat(start.calibration)
    assert np.all(np.abs(change) < 0.1 * flat(start.standard_errors))
