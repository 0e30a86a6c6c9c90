import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_calibration import censi

from experiments import calibration
from experiments.calibration_drives import HURT
from experiments.closed_form_calibration import closed_form
from jaxslam.core.calibration import Calibration, calibrate_odometry
from jaxslam.simulation.robot import wheel_increment

BASE = HURT.wheel_base
KNOWN = HURT.calibration()._replace(time_offset=np.zeros(()))


def increments(seed, count, noise):
    """What the wheels turn by (N, 2), odometry (N, 3), and the scanner's motion (N, 3)."""
    rng = np.random.default_rng(seed)
    wheels = rng.uniform(-0.1, 0.3, (count, 2))
    odometry = jax.vmap(lambda both: wheel_increment(both[0], both[1], BASE))(jnp.asarray(wheels))
    padded = np.concatenate([np.zeros((1, 3)), odometry])
    scanner = calibrate_odometry(KNOWN, padded, wheel_base=BASE)[1:]
    return wheels, np.asarray(odometry), scanner + noise * rng.normal(size=scanner.shape)


@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_it_is_that_of_the_paper(noise):
    wheels, odometry, scanner = increments(0, 60, noise)
    found = closed_form(odometry, scanner, wheel_base=BASE)
    left, right, base, *mount = censi(wheels, scanner)
    exact = Calibration.of_wheels(left, right, base / BASE, wheel_base=BASE)
    for ours, other in zip(found, exact._replace(mount=np.array(mount)), strict=True):
        np.testing.assert_allclose(ours, other, atol=1e-7)
    if not noise:
        for ours, known in zip(found, KNOWN, strict=True):
            np.testing.assert_allclose(ours, known, atol=1e-9)


def test_newton_solves_a_quadratic_at_once_along_what_is_curved():
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    hessian = axes * np.array([3.0, 1.0, 0.5, 1e-9]) @ axes.T
    least, start = 0.1 * rng.normal(size=(2, 4))  # nearer than the largest change
    optimizer = calibration.newton(hessian)
    slope = jnp.asarray(hessian @ (start - least))
    change, _ = optimizer.update(slope, optimizer.init(start))
    left = axes.T @ (start + change - least)
    np.testing.assert_allclose(left[:3], 0.0, atol=1e-12)
    np.testing.assert_allclose(left[3], axes[:, 3] @ (start - least), atol=1e-12)


def test_starts_are_off_within_their_units():
    """Each differs in all numbers; the calibration is about none, the noise of odometry larger."""
    truth = calibration.true_params()
    starts = [calibration.start_of(0, number) for number in range(3)]
    for given in starts:
        assert np.abs(given.calibration.mount - np.zeros(3)).max() <= 0.1
        assert abs(float(given.calibration.distance_scale) - 1.0) < 0.06
        ratio = given.noise.odometry_coefficients / truth.noise.odometry_coefficients
        assert np.all((ratio > 2.4) & (ratio < 10.1))
    assert not np.allclose(starts[0].calibration.mount, starts[1].calibration.mount)
