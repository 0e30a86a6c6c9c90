import numpy as np
import pytest

from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import dead_reckoning
from jaxslam.pipeline import log_input, offline
from jaxslam.pipeline.config import Config

LIDAR = Lidar(num_beams=32, angle_increment=np.pi / 31, range_max=8.0)


def drive(num_scans):
    """A log of a few scans."""
    steps = np.arange(float(num_scans))[:, None]
    ranges = np.full((num_scans, 32), 2.0) + 0.01 * steps
    ranges[:, 3] = np.inf
    poses = np.array([1.0, 2.0, 0.5]) + np.array([0.1, 0.05, 0.05]) * steps
    return LaserLog.from_arrays(steps[:, 0], poses, ranges, LIDAR)


@pytest.fixture
def log():
    return drive(3)


def test_odometry_starts_at_the_first_scan_and_increments_lead_to_it(log):
    found = log_input.from_laser_log(log)
    assert not found.odom_poses[0].any() and not found.increments[0].any()
    poses = dead_reckoning(log.odom_poses[0], found.increments)
    np.testing.assert_allclose(poses, log.odom_poses, atol=1e-12)
    assert found.scans.hit.sum() == 3 * 31 and found.notes == () and found.match_scans


@pytest.mark.parametrize(
    "has_odometry, source, used",
    [
        (True, "scan", "scan"),
        (False, "scan", "scans-only"),
        (True, "scans-only", "scans-only"),
        (True, "wheels", "wheels"),
    ],
)
def test_scans_alone_are_matched_where_there_is_no_odometry(log, has_odometry, source, used):
    found = log_input.from_laser_log(log._replace(has_odometry=has_odometry), source)
    assert found.odometry_source == used and found.match_scans == (used != "wheels")
    assert found.config.scan_matching.use_odometry == (used != "scans-only")
    assert len(found.notes) == (used != source)


def test_a_log_without_returns_is_refused(log):
    with pytest.raises(ValueError, match="no beam"):
        log_input.from_laser_log(log._replace(ranges=np.full((3, 32), np.inf, np.float32)))


@pytest.mark.parametrize("source", ["scan", "wheels"])
def test_all_goes_to_run_slam(log, source, monkeypatch):
    monkeypatch.setattr(offline, "run_slam", lambda *given, **options: (given, options))
    found = log_input.from_laser_log(log, source)
    (config, params, increments, scans), options = log_input.run(found, smooth=False)
    assert config is found.config and increments is found.increments and scans is found.scans
    assert options.pop("odometry_guessed") is found.guessed is log.odometry_guessed
    assert options.pop("after_pause") is found.after_pause and not found.after_pause.any()
    assert options.pop("new_drive") is found.new_drive and not found.new_drive.any()
    assert options.pop("saved_map") is None
    assert options == {"match_scans": source == "scan", "smooth": False, "callback": None}
    assert (params.scan_match_std_scale is None) == (source == "wheels")


def test_several_logs_become_one_with_a_new_drive_at_each():
    one, other = (log_input.from_laser_log(drive(n)) for n in (3, 5))
    both = log_input.combine([one, other, one])
    np.testing.assert_array_equal(np.flatnonzero(both.new_drive), [3, 8])
    np.testing.assert_array_equal(both.increments[3:8], other.increments)
    np.testing.assert_array_equal(both.scans.ranges[8:], one.scans.ranges)
    assert len(both.after_pause) == len(both.guessed) == 11
    assert log_input.combine([one]) is one


def test_logs_that_cannot_be_one_map_are_refused():
    log = log_input.from_laser_log(drive(3))
    other = log._replace(config=Config.for_laser_log(LIDAR._replace(range_max=7.0)))
    with pytest.raises(ValueError, match="log 2 has a scanner with range_max 7, log 1 one with"):
        log_input.combine([log, other])
    with pytest.raises(ValueError, match="log 2 uses odometry 'scans-only', log 1 'scan'"):
        log_input.combine([log, log._replace(odometry_source="scans-only")])
    wheels = log._replace(odometry_source="wheels")
    with pytest.raises(ValueError, match="another odometry than wheels"):
        log_input.combine([wheels, wheels])
    with pytest.raises(ValueError, match="logs is empty"):
        log_input.combine([])
