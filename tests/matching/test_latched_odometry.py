import numpy as np
import pytest
from simulated_scans import LIDAR

from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import dead_reckoning
from jaxslam.matching.latched_odometry import equal_increments, share_out_leaps


def scans(count, changes):
    """Scans [count], every beam of which changes by 0.5 m from scan to scan, or none."""
    ranges = 3.0 + 0.5 * changes * (np.arange(count)[:, None] % 2) + np.zeros(LIDAR.num_beams)
    return Scan(ranges, np.ones_like(ranges, bool))


def drive(count=40):
    """Increments (count, 3) of a drive in which every scan moves a little differently."""
    rng = np.random.default_rng(0)
    odometry = rng.normal([0.3, 0.0, 0.05], [0.02, 0.01, 0.1], (count, 3))
    odometry[0] = 0.0
    return odometry


def latched(odometry, first, count):
    """The same, where `count` increments are reported at once, by the last of them."""
    whole = dead_reckoning(np.zeros(3), odometry[first : first + count])[-1]
    hurt = odometry.copy()
    hurt[first : first + count] = 0.0
    hurt[first + count - 1] = whole
    return hurt


@pytest.mark.parametrize("motion", [[1.0, 0.2, 0.7], [0.5, 0.0, 0.0], [0.0, 0.0, -2.0]])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_equal_increments_make_up_the_motion(motion, count):
    steps = np.tile(equal_increments(np.array(motion), count), (count, 1))
    np.testing.assert_allclose(dead_reckoning(np.zeros(3), steps)[-1], motion, atol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_leap_is_shared_out_and_the_poses_after_it_stay(count):
    true = drive()
    hurt = latched(true, 20, count)
    shared, is_share, num_leaps = share_out_leaps(hurt, scans(40, changes=False))
    assert num_leaps == 1
    np.testing.assert_array_equal(np.flatnonzero(is_share), np.arange(20, 20 + count))
    assert np.abs(shared - true).max() < 0.25 < np.abs(hurt - true).max()
    poses, expected = (dead_reckoning(np.zeros(3), x) for x in (shared, true))
    np.testing.assert_allclose(poses[20 + count :], expected[20 + count :], atol=1e-9)
    np.testing.assert_array_equal(
        np.delete(shared, np.s_[20 : 20 + count], 0), np.delete(true, np.s_[20 : 20 + count], 0)
    )


def test_a_robot_that_stands_and_drives_on_is_left_alone():
    for start in (0.05, 0.3):
        odometry = drive()
        odometry[20:23] = 0.0
        odometry[23] = [start, 0.0, 0.0]
        shared, is_share, num_leaps = share_out_leaps(odometry, scans(40, changes=False))
        assert num_leaps == 0 and not is_share.any()
        np.testing.assert_array_equal(shared, odometry)


def test_scans_that_change_while_the_wheels_stand_say_that_it_is_a_leap():
    odometry = drive()
    odometry[20], odometry[21] = 0.0, [0.35, 0.0, 0.0]
    assert share_out_leaps(odometry, scans(40, changes=False))[2] == 0
    assert share_out_leaps(odometry, scans(40, changes=True))[2] == 1


def test_logs_without_motion_or_without_scans_are_left_alone():
    still = np.zeros((9, 3))
    np.testing.assert_array_equal(share_out_leaps(still, scans(9, changes=True))[0], still)
    assert share_out_leaps(np.zeros((0, 3)), scans(0, changes=True))[2] == 0
