import numpy as np
import pytest

from jaxslam.core.se2_np import compose, relative
from jaxslam.io import odometry_checks, quaternions

T = 80
TIMES = 0.2 * np.arange(T)


def drive(count=T, step=0.2):
    t = step * np.arange(count)
    return np.column_stack([0.5 * t, np.sin(0.5 * t), 0.6 * np.sin(0.4 * t)])


def check(poses, times=TIMES):
    return odometry_checks.check_odometry(times, poses)


def test_good_odometry_is_handed_on_as_it_is():
    poses = drive()
    found = check(poses)
    assert found.poses is poses and found.notes == () and not found.is_stale.any() and found.usable


def test_stopping_and_starting_needs_no_note():
    for stop in range(1, 12):
        times = np.minimum(TIMES, 5.0) + np.maximum(TIMES - 5.0 - 0.2 * stop, 0.0)
        poses = np.column_stack([0.5 * times, np.sin(0.5 * times), 0.1 * times])
        assert check(poses).notes == ()


@pytest.mark.parametrize("offset", [(9.0, 0.0, 0.0), (0.0, 0.0, 2.5)])
def test_a_leap_that_no_robot_makes_is_left_out(offset):
    poses = drive()
    broken = poses.copy()
    broken[40:] = compose(np.array(offset), poses[40:])
    found = check(broken)
    moved, wanted = (relative(x[:-1], x[1:]) for x in (found.poses, poses))
    np.testing.assert_allclose(np.delete(moved, 39, 0), np.delete(wanted, 39, 0), atol=1e-9)
    assert found.restarts == 1 and np.flatnonzero(found.is_stale).tolist() == [40]


def test_a_restart_near_the_start_is_found():
    """It is within what a robot could drive, but it goes to where the odometry began."""
    poses = drive() * [0.2, 0.2, 1.0]
    poses[40:] = relative(poses[40], poses[40:])
    found = check(poses)
    assert found.restarts == 1 and "restarts (1 x)" in found.notes[0]


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_poses_that_hardly_change_are_no_odometry(noise):
    rng = np.random.default_rng(0)
    found = check(np.array([3.0, 4.0, 1.0]) + noise * rng.uniform(size=(T, 3)))
    assert not found.usable and found.is_stale.all() and "no odometry" in found.notes[0]
    assert (found.poses == found.poses[0]).all()


def test_missing_spans_are_those_in_which_the_robot_moved():
    times, poses = np.delete(TIMES, range(20, 50)), np.delete(drive(), range(20, 50), axis=0)
    np.testing.assert_array_equal(np.flatnonzero(odometry_checks.missing_spans(times, poses)), [19])
    still = poses.copy()
    still[20:] = compose(still[19], relative(still[20], still[20:]))
    assert not odometry_checks.missing_spans(times, still).any()


def unit(yaw):
    return np.column_stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)])


YAW = np.linspace(-3.0, 3.0, 21)


def test_unit_quaternions_give_their_headings():
    heading, valid, notes = quaternions.headings(unit(YAW))
    np.testing.assert_allclose(heading, YAW, atol=1e-12)
    assert valid.all() and notes == []


def test_quaternions_of_another_length_are_scaled():
    heading, valid, notes = quaternions.headings(unit(YAW) * np.linspace(0.2, 3.0, 21)[:, None])
    np.testing.assert_allclose(heading, YAW, atol=1e-12)
    assert valid.all() and "not of unit length" in notes[0]


def test_a_yaw_in_z_is_taken_for_what_it_is():
    found = quaternions.headings(np.column_stack([0 * YAW, 0 * YAW, YAW, 0 * YAW]))
    np.testing.assert_array_equal(found[0], YAW)
    assert found[1].all() and "z is taken for the yaw" in found[2][0]


def test_a_robot_that_faces_backwards_throughout_is_no_yaw_in_z():
    heading, _, notes = quaternions.headings(np.tile([0.0, 0.0, 1.0, 0.0], (5, 1)))
    np.testing.assert_allclose(np.abs(heading), np.pi)
    assert notes == []


def test_quaternions_of_zeros_have_no_heading():
    some = unit(YAW)
    some[:2] = 0.0
    _, valid, notes = quaternions.headings(some)
    np.testing.assert_array_equal(valid, [False, False, *[True] * 19])
    assert "2 poses of the odometry have no orientation" in notes[0]
