"""Calibration of a log by its own scans, from wheels and mounts that are off by known amounts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import wheel_drives
from office_drive import LIDAR, scans_along

from jaxslam.core.calibration import Calibration
from jaxslam.core.logs import LaserLog
from jaxslam.core.se2_np import compose, dead_reckoning, relative
from jaxslam.pipeline import log_input, motion_spans, self_calibration
from jaxslam.simulation import drives, path_following, worlds
from jaxslam.simulation.robot import Robot
from jaxslam.smoothing.odometry_calibration import flat

NO_TIME = np.zeros(3)
HURT = Robot(
    wheel_scales=(1.05, 0.97), wheel_base_scale=1.04, mount=(0.25, 0.05, 0.05), time_offset=0.08
)


def test_times_that_cannot_be_trusted():
    back = np.arange(10.0)
    back[4] = 1.0
    assert motion_spans.usable_times(back) is None
    assert motion_spans.usable_times(np.full(10, 7.0)) is None
    some = np.repeat(np.arange(200.0), 2)
    some[7] = 0.0
    found = motion_spans.usable_times(some)
    assert np.all(np.diff(found) > 0) and np.abs(found - np.maximum.accumulate(some)).max() < 1e-3


@pytest.mark.parametrize(
    "place", [[0.0, 0.0, 0.0], [-0.25, 0.0, -0.05], [0.1, 0.0, 1.6], [0.0, 0.0, -1.5]]
)
def test_the_frame_between_the_wheels_is_found(place):
    """From how the poses of a scanner move sideways, a tenth of them by anything."""
    rng = np.random.default_rng(0)
    turn = 0.3 * rng.normal(size=300)
    chord = rng.uniform(0.1, 0.4, 300) * np.sinc(turn / (2 * np.pi))
    wheels = np.stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn], axis=1)
    wheels[:, 1] += 0.002 * rng.normal(size=300)
    wheels[::10, 1] += 0.2 * rng.normal(size=30)
    moved = compose(compose(relative(np.array(place), NO_TIME), wheels), np.array(place))
    found = motion_spans.wheel_frame(moved, np.zeros(3), np.ones(300, bool))
    np.testing.assert_allclose(found, place, atol=2e-3)
    # The same robot, whose log says where its scanner is.
    mount = np.array([0.1, 0.3, 1.0])
    on_robot = motion_spans.wheel_frame(
        compose(compose(relative(mount, NO_TIME), moved), mount), mount, np.ones(300, bool)
    )
    np.testing.assert_allclose(on_robot, compose(np.array(place), mount), atol=2e-3)


def test_a_robot_that_drives_to_all_sides_keeps_its_frame():
    moved = np.random.default_rng(1).normal(size=(300, 3)) * [0.3, 0.3, 0.2]
    mount = np.array([0.3, 0.1, 0.2])
    found = motion_spans.wheel_frame(moved, mount, np.ones(300, bool))
    np.testing.assert_array_equal(found, mount)


def test_scans_without_wheels_are_refused():
    log = LaserLog.from_arrays([0.0], [[0.0, 0.0, 0.0]], np.ones((1, LIDAR.num_beams)), LIDAR)
    with pytest.raises(ValueError, match="no odometry to calibrate: the log"):
        self_calibration.require_wheels(log._replace(has_odometry=False))
    with pytest.raises(ValueError, match="where scans alone are matched"):
        self_calibration.require_wheels(log, "scans-only")


def test_rounds_that_close_in_slowly_are_cut_short():
    share, end = np.array([0.0, 0.5, 0.7]), np.array([1.0, -2.0, 3.0])
    x0 = np.zeros(3)
    f0 = (1 - share) * (end - x0)
    x1 = x0 + f0
    f1 = (1 - share) * (end - x1)
    np.testing.assert_allclose(x1 + f1 + self_calibration.left_over([(x0, f0), (x1, f1)]), end)
    np.testing.assert_array_equal(self_calibration.left_over([(x0, f0)]), 0.0)
    apart = self_calibration.left_over([(x0, f0), (x1, -f0)])  # these rounds do not close in
    assert np.all(np.abs(apart) <= 4 * np.abs(f0))
    held = self_calibration.left_over([(x0, 0 * f0), (x0, 0 * f0)])
    np.testing.assert_array_equal(held, 0.0)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"usable": np.zeros(39, bool)}, "no motion to calibrate by: no two scans"),
        ({"increment": np.tile([0.0, 0.4, 0.3], (39, 1))}, "as its scans show at 39 of 39 spans"),
    ],
)
def test_wheels_that_say_nothing_of_the_motion_are_refused(wrong, message):
    spans = wheel_drives.drive(np.random.default_rng(0), 40)
    self_calibration.require_agreement(wheel_drives.TRUE, spans)
    with pytest.raises(ValueError, match=message):
        self_calibration.require_agreement(wheel_drives.TRUE, spans._replace(**wrong))


def test_a_mirrored_scanner_is_named():
    mirrored = wheel_drives.TRUE._replace(turn_scale=np.asarray(-1.0))
    spans = wheel_drives.drive(np.random.default_rng(0), 40, true=mirrored)
    with pytest.raises(ValueError, match=r"turn against its wheels, .* see --upside-down"):
        self_calibration.require_agreement(mirrored, spans)


@pytest.mark.parametrize("step, noted", [(0.0, True), (0.5, False)])
def test_a_time_offset_that_cannot_be_used_is_noted(step, noted):
    poses = np.outer(np.arange(4), [0.3, 0.0, 0.1])
    ranges = np.full((4, LIDAR.num_beams), 3.0)
    log = LaserLog.from_arrays(step * np.arange(4), poses, ranges, LIDAR)
    given = log_input.from_laser_log(log)
    offset = Calibration.identity()._replace(time_offset=np.asarray(0.1))
    moved = self_calibration.calibrated(log, given, offset, NO_TIME)
    assert any("time offset is not used" in note for note in moved.notes) == noted
    assert np.array_equal(moved.increments.round(9), given.increments.round(9)) == noted
    none = self_calibration.calibrated(log, given, Calibration.identity(), NO_TIME)
    assert none.notes == given.notes


@pytest.fixture(scope="module")
def office_log():
    """A drive through the office by a robot that is off; and the true poses of its scanner."""
    path = jnp.asarray(path_following.densify(worlds.waypoints("office")))
    count = drives.num_scans_of_drive(HURT, path)
    poses, odometry = drives.drive(jax.random.key(7), HURT, path, num_scans=count)
    poses = np.asarray(poses)
    scans = scans_along(worlds.named("office"), poses, 7)
    ranges = np.where(scans.hit, scans.ranges, np.inf)
    times = HURT.scan_period * np.arange(count)
    reported = dead_reckoning(np.zeros(3), np.asarray(odometry))
    return LaserLog.from_arrays(times, reported, ranges, LIDAR), poses


@pytest.mark.slow
def test_a_drive_through_the_office_calibrates_itself(office_log):
    log, poses = office_log
    given = log_input.from_laser_log(log)
    found = self_calibration.calibrate_log(log, given, mount=np.zeros(3))
    one = found.estimate
    assert one.not_determined == () and found.is_settled and found.num_rounds >= 2
    truth = HURT.calibration().without_base(HURT.wheel_base)
    off = flat(one.calibration) - flat(truth)
    assert np.all(np.abs(off) < 4 * flat(one.standard_errors))
    assert np.all(flat(one.standard_errors) < [2e-3, 6e-3, 6e-3, 4e-3, 4e-3, 4e-3, 4e-3])
    moved = self_calibration.calibrated(log, given, one.calibration, found.mount)
    path = relative(poses[0], poses)[:, :2]
    errors = [np.hypot(*(x[:, :2] - path).T).max() for x in (given.odom_poses, moved.odom_poses)]
    assert errors[1] < 0.15 * errors[0]
    identity = self_calibration.calibrated(log, given, Calibration.identity(), found.mount)
    np.testing.assert_allclose(identity.increments, given.increments, atol=1e-9)
