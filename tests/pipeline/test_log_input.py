import numpy as np
import pytest

from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import dead_reckoning
from jaxslam.pipeline import log_input, offline

LIDAR = Lidar(num_beams=32, angle_increment=np.pi / 31, range_max=8.0)


@pytest.fixture
def log():
    poses = np.array([[1.0, 2.0, 0.5], [1.1, 2.0, 0.6], [1.2, 2.1, 0.6]])
    ranges = np.full((3, 32), 2.0)
    ranges[:, 3] = np.inf
    return LaserLog.from_arrays(np.arange(3.0), poses, ranges, LIDAR)


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
    assert options == {"match_scans": source == "scan", "smooth": False, "callback": None}
    assert (params.scan_match_std_scale is None) == (source == "wheels")
