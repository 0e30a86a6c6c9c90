"""Calibration of wheels, mount and clocks by scan matching: laws, references, statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
import wheel_drives
from wheel_drives import TRUE

from jaxslam.core.calibration import Calibration
from jaxslam.core.se2_np import compose, dead_reckoning, relative
from jaxslam.smoothing import calibration_noise, odometry_calibration
from jaxslam.smoothing.calibration_noise import CalibrationNoise
from jaxslam.smoothing.odometry_calibration import (
    NAMES,
    default_prior_std,
    estimate_calibration,
    flat,
    unflat,
)


def test_numbers_and_calibration_are_inverse():
    numbers = np.arange(7.0)
    np.testing.assert_array_equal(flat(unflat(numbers)), numbers)
    assert len(NAMES) == 7 and unflat(numbers).time_offset == 6.0


def test_motion_of_the_wheels_is_that_of_their_poses():
    """Dead reckoning, one step after the other, in both namespaces."""
    spans = wheel_drives.drive(np.random.default_rng(0), steps=40)
    spans = spans._replace(first=np.array([0, 3]), last=np.array([3, 39]))
    poses = dead_reckoning(np.zeros(3), spans.odometry)
    wanted = relative(poses[spans.first], poses[spans.last])
    found = odometry_calibration.wheel_motion(Calibration.identity(), spans)
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    on_device = type(spans)._make(map(jnp.asarray, spans))
    identity = Calibration._make(map(jnp.asarray, Calibration.identity()))
    same = jax.jit(odometry_calibration.wheel_motion)(identity, on_device)
    np.testing.assert_allclose(same, wanted, atol=1e-9)


def test_density_is_that_of_the_multivariate_t_distribution():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    cov, error, driven = root @ root.T, rng.normal(size=3), np.array([0.7, 0.2])
    noise = CalibrationNoise(np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.5, 0.6]))
    along = 0.1**2 * 0.7 + 0.2**2 * 0.2 + 0.5**2
    turn = 0.3**2 * 0.7 + 0.4**2 * 0.2 + 0.6**2
    scale = cov + np.diag([along, along, turn])
    density, square = calibration_noise.log_density(noise, error, driven, cov)
    reference = scipy.stats.multivariate_t(shape=scale, df=3).logpdf(error)
    np.testing.assert_allclose(density, reference, rtol=1e-12)
    np.testing.assert_allclose(square, error @ np.linalg.solve(scale, error), rtol=1e-12)


@pytest.mark.slow
def test_every_number_is_found_and_standard_errors_are_those_of_repetitions():
    """36 drives: bias within four standard errors of the mean, spread as stated."""
    rng = np.random.default_rng(2)
    found = [estimate_calibration(wheel_drives.drive(rng, steps=200)) for _ in range(36)]
    off = np.stack([flat(one.calibration) - flat(TRUE) for one in found])
    stated = np.sqrt(np.mean([flat(one.standard_errors) ** 2 for one in found], axis=0))
    spread = np.sqrt(np.mean(off**2, axis=0))
    assert np.all(np.abs(off.mean(axis=0)) < 4 * spread / 6)
    # The errors are normal and the noise is not known: a t likelihood states somewhat too much.
    assert np.all(stated / spread > 0.8) and np.all(stated / spread < 1.45), stated / spread
    assert not any(one.not_determined for one in found)


def test_a_straight_drive_leaves_turns_and_mount_open():
    """And says so by name; yaw and scale are found all the same."""
    rng = np.random.default_rng(3)
    found = estimate_calibration(wheel_drives.drive(rng, turning=0.0))
    assert set(found.not_determined) >= {"mount[0]", "mount[1]", "turn_scale"}
    assert not {"distance_scale", "turn_per_distance", "mount[2]"} & set(found.not_determined)
    error = (flat(found.calibration) - flat(TRUE)) / flat(found.standard_errors)
    assert np.all(np.abs(error[[0, 2, 5]]) < 4)


def test_wheels_that_are_lost_now_and_then_change_little():
    """A twentieth of the spans, whose wheels report nothing of the motion."""
    rng = np.random.default_rng(4)
    spans = wheel_drives.drive(rng, steps=600)
    alone = estimate_calibration(spans)
    lost = rng.choice(len(spans.increment), 30, replace=False)
    increment = spans.increment.copy()
    increment[lost] += rng.normal(size=(30, 3)) * [0.5, 0.5, 1.0]
    found = estimate_calibration(spans._replace(increment=increment))
    off = flat(found.calibration) - flat(alone.calibration)
    assert np.all(np.abs(off) < 1.5 * flat(alone.standard_errors))


def test_spans_that_are_not_usable_do_not_count():
    spans = wheel_drives.drive(np.random.default_rng(5))
    usable = np.arange(len(spans.usable)) % 3 > 0
    wrong = np.where(usable[:, None], spans.increment, 100.0)
    some = spans._replace(increment=wrong, usable=usable)
    short = spans._replace(
        **{
            name: getattr(spans, name)[usable]
            for name in ("first", "last", "increment", "match_cov", "driven", "usable")
        }
    )
    one, other = estimate_calibration(some), estimate_calibration(short)
    np.testing.assert_allclose(flat(one.calibration), flat(other.calibration), rtol=1e-9)
    assert one.num_spans == usable.sum()


def test_without_spans_the_result_is_the_prior():
    spans = wheel_drives.drive(np.random.default_rng(6), steps=20)
    found = estimate_calibration(spans._replace(usable=np.zeros(19, bool)), mean=TRUE)
    np.testing.assert_allclose(flat(found.calibration), flat(TRUE))
    np.testing.assert_allclose(flat(found.standard_errors), flat(default_prior_std()))
    assert found.not_determined == NAMES


def test_a_number_that_is_held_fixed_stays():
    """As the time offset does without stamps."""
    spans = wheel_drives.drive(np.random.default_rng(7))._replace(times=None)
    found = estimate_calibration(spans)
    assert found.calibration.time_offset == 0.0 and found.not_determined == ("time_offset",)
    std = default_prior_std()._replace(mount=np.zeros(3))
    held = estimate_calibration(spans, TRUE, std)
    np.testing.assert_array_equal(held.calibration.mount, TRUE.mount)


@pytest.mark.parametrize("weight", [0.01, 100.0])
def test_the_prior_counts_as_its_standard_deviation_says(weight):
    """A narrow one wins, a wide one loses."""
    spans = wheel_drives.drive(np.random.default_rng(8))
    prior = unflat(weight * flat(default_prior_std()) / 10)
    found = estimate_calibration(spans, prior_std=prior)
    near_prior = np.abs(flat(found.calibration) - flat(Calibration.identity()))
    near_truth = np.abs(flat(found.calibration) - flat(TRUE))
    assert np.all((near_prior < near_truth) if weight < 1 else (near_truth < near_prior))


def test_a_mount_that_is_moved_is_found_moved():
    """The wheels' poses taken at another place of the robot: the same estimate, moved as they."""
    spans, place = wheel_drives.drive(np.random.default_rng(9)), np.array([0.25, 0.0, 0.05])
    inverse = relative(place, np.zeros(3))
    # The odometry of a frame at `inverse` in that between the wheels.
    moved = compose(compose(place, spans.odometry), inverse)
    moved[0] = 0.0
    other = spans._replace(odometry=moved, mount=inverse)
    one, two = estimate_calibration(spans), estimate_calibration(other)
    np.testing.assert_allclose(
        two.calibration.mount, compose(place, one.calibration.mount), atol=2e-3
    )


@pytest.mark.parametrize("offset", [1.0, -1.5, 4.3])
def test_clocks_that_are_seconds_apart_are_found(offset):
    """Small steps alone end at a third of it, and say that they are sure."""
    true = TRUE._replace(time_offset=np.asarray(offset))
    found = estimate_calibration(wheel_drives.drive(np.random.default_rng(1), 80, true=true))
    off = (flat(found.calibration) - flat(true)) / flat(found.standard_errors)
    assert np.all(np.abs(off) < 4), off


@pytest.mark.parametrize("taken", [[0.0, 0.0, 0.0], [0.3, 0.1, 0.2]])
def test_a_scanner_that_faces_back_is_found(taken):
    """And not wheels that roll backwards; in the frame between them all is as it was."""
    true = TRUE._replace(mount=np.array([0.2, 0.05, np.pi - 0.02]))
    spans, place = wheel_drives.drive(np.random.default_rng(10), 100, true=true), np.array(taken)
    odometry = compose(compose(relative(place, np.zeros(3)), spans.odometry), place)
    odometry[0] = 0.0
    wanted = true._replace(mount=relative(place, true.mount))
    found = estimate_calibration(spans._replace(odometry=odometry, mount=place))
    off = flat(found.calibration) - flat(wanted)
    off[5] = np.arctan2(np.sin(off[5]), np.cos(off[5]))
    assert np.all(np.abs(off) < 4 * flat(found.standard_errors)), off


def test_spans_that_calibrated_wheels_contradict():
    spans = wheel_drives.drive(np.random.default_rng(11), 100)
    assert not odometry_calibration.contradicted(TRUE, spans).any()
    increment = spans.increment.copy()
    increment[[3, 7]] += [[0.5, 0.0, 0.0], [0.0, 0.0, -0.5]]
    usable = np.arange(99) != 7
    off = odometry_calibration.contradicted(TRUE, spans._replace(increment=increment))
    np.testing.assert_array_equal(np.flatnonzero(off), [3, 7])
    some = spans._replace(increment=increment, usable=usable)
    np.testing.assert_array_equal(
        np.flatnonzero(odometry_calibration.contradicted(TRUE, some)), [3]
    )
