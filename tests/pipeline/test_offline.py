"""What `run_slam`, `online.init` and `online.update` take and refuse, before anything compiles."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2_np
from jaxslam.core.scan import Lidar, Scan
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.registration import LoopClosureSpec
from jaxslam.pipeline import arguments, chunks, offline, online
from jaxslam.pipeline.config import LOG_CONFIRM_COUNT, MAX_LANDMARKS, Config

LIDAR = Lidar(num_beams=91, angle_min=-math.pi / 2, angle_increment=math.pi / 90)
CONFIG = Config.for_laser_log(LIDAR)
PARAMS = NoiseParams.for_laser_log(match_scans=True)
T = 30
PART = np.arange(T) / T
POSES = np.stack([8 * np.sin(3 * PART), 4 - 4 * np.cos(3 * PART), 3 * PART], axis=1)
ODOMETRY, RANGES = se2_np.increments(POSES), np.full((T, 91), 3.0)
UNLIKE = CONFIG._replace(frontend=FrontendConfig(lidar=LIDAR._replace(angle_min=0.0)))
HITS = np.ones(RANGES.shape, bool)


class Compiled(Exception):
    """Raised where the first program would be compiled."""


@pytest.fixture(autouse=True)
def nothing_compiles(monkeypatch):
    def stop(*_, **__):
        raise Compiled

    monkeypatch.setattr(online, "_init", stop)
    monkeypatch.setattr(chunks, "extract_chunk", stop)


def run(**changes):
    given = {"config": CONFIG, "params": PARAMS, "odometry": ODOMETRY, "ranges": RANGES}
    return offline.run_slam(**given | changes)


@pytest.mark.parametrize(
    "changes, line",
    [
        ({"odometry": POSES}, "odometry looks like absolute poses.*se2_np.increments"),
        ({"odometry": POSES + 1.0}, r"odometry\[0\] is .*, not zero: increments are expected"),
        ({"odometry": ODOMETRY[:, :2]}, r"odometry is float64 \(30, 2\), not \(T, 3\)"),
        ({"odometry": ODOMETRY[:-1]}, "odometry has 29 rows and ranges 30 scans"),
        ({"odometry": np.full((T, 3), "a")}, "odometry is <U1 .*, not numbers"),
        ({"odometry": ODOMETRY + np.inf}, "odometry.* which is not finite"),
        ({"ranges": RANGES[:, ::2]}, "ranges has 46 beams, config.frontend.lidar 91"),
        ({"ranges": RANGES[0]}, r"ranges is float64 \(91,\), not \(T, R\)"),
        ({"ranges": 1e3 * RANGES}, "no beam of 30 scans hit .* are they in metres?"),
        ({"ranges": Scan(RANGES, HITS[:, 1:])}, r"ranges.hit is bool \(30, 90\)"),
        ({"ranges": Scan(RANGES[1:], HITS[1:])}, "30 rows and ranges.ranges 29 scans"),
        ({"params": NoiseParams.for_laser_log()}, r"std_scale is None.*\(match_scans=True\)"),
        ({"params": PARAMS._replace(range_std=-1.0)}, "params.range_std is -1.0"),
        ({"params": 0.1}, "params is float, not NoiseParams"),
        ({"config": LIDAR}, "config is Lidar, not Config"),
        ({"config": UNLIKE}, r"field_of_view is .*make the configuration with Config.for_lidar"),
        ({"start": [0.0, 1.0]}, r"start is float64 \(2,\), not \(3,\)"),
        ({"start": [0.0, 1.0, np.nan]}, "start is .*not finite"),
    ],
)
def test_a_log_that_cannot_be_run_is_refused_before_anything_compiles(changes, line):
    with pytest.raises(ValueError, match=line):
        run(**changes)


@pytest.mark.parametrize("speed", [0.05, 1.0, 5.0])
def test_increments_of_constant_speed_are_not_taken_for_poses(speed):
    odometry = np.zeros((T, 3))
    odometry[1:, 0] = speed
    with pytest.raises(Compiled):
        run(odometry=odometry)
    poses = se2_np.dead_reckoning(np.zeros(3), odometry)
    if speed * T > 2 * arguments.POSE_RANGE:
        with pytest.raises(ValueError, match="looks like absolute poses"):
            run(odometry=poses)


@pytest.mark.parametrize("convert", [np.float32, jnp.asarray, np.ndarray.tolist])
def test_lists_and_arrays_of_either_precision_are_the_same_log(convert):
    odometry, ranges = (np.float32(x).astype(float) for x in (ODOMETRY, RANGES))
    np.testing.assert_array_equal(arguments.as_log_odometry(convert(odometry)), odometry)
    found = arguments.as_scans(LIDAR, convert(ranges), T)
    for given in (ranges, Scan(convert(ranges), HITS)):
        expected = arguments.as_scans(LIDAR, given, T)
        np.testing.assert_array_equal(found.ranges, expected.ranges)
        np.testing.assert_array_equal(found.hit, expected.hit)
        assert found.ranges.dtype == expected.ranges.dtype == np.float64
    np.testing.assert_array_equal(arguments.as_start(convert(POSES[3])), convert(POSES[3]))


def test_readings_that_are_no_return_are_none():
    ranges = RANGES.copy()
    ranges[0, :5] = np.nan, np.inf, 0.0, -1.0, LIDAR.range_max
    scans = arguments.as_scans(LIDAR, ranges, T)
    assert not scans.hit[0, :5].any() and scans.hit[0, 5:].all() and scans.hit[1:].all()
    assert (scans.ranges[0, :5] == LIDAR.range_max).all()


def test_whole_numbers_are_numbers():
    assert arguments.as_log_odometry(np.zeros((2, 3), int)).dtype == np.float64
    assert arguments.as_start([1, 2, 3]).dtype == jnp.float64


def test_a_state_begins_only_with_a_configuration_that_fits():
    with pytest.raises(ValueError, match="make the configuration with Config.for_lidar"):
        online.init(UNLIKE)
    with pytest.raises(ValueError, match=r"start is float64 \(4,\), not \(3,\)"):
        online.init(CONFIG, [1, 2, 3, 4])
    with pytest.raises(Compiled):
        online.init(CONFIG)


STATE = online.SlamState(None, None, None)


@pytest.mark.parametrize(
    "changes, line",
    [
        ({"odometry": ODOMETRY[:1]}, "odometry has 1 rows and ranges 30 scans"),
        ({"odometry": np.zeros((65, 3))}, "odometry has 65 rows; a chunk has 64 at most"),
        ({"ranges": RANGES[:, 1:]}, "ranges has 90 beams"),
        ({"config": UNLIKE}, "Config.for_lidar"),
        (
            {"params": NoiseParams.for_laser_log(), "state": STATE._replace(submap=())},
            r"scan_match_std_scale is None.*\(match_scans=True\)",
        ),
    ],
)
def test_an_update_that_cannot_be_made_is_refused_before_anything_compiles(changes, line):
    given = {"config": CONFIG, "params": PARAMS, "state": STATE}
    given |= {"odometry": ODOMETRY, "ranges": RANGES}
    with pytest.raises(ValueError, match=line):
        online.update(**given | changes)
    with pytest.raises(Compiled):
        online.update(CONFIG, PARAMS, STATE, ODOMETRY, RANGES)


def test_the_preset_for_logs_is_that_of_the_command_line():
    assert CONFIG.filter.max_landmarks == MAX_LANDMARKS == 2048
    assert CONFIG.filter.confirm_count == LOG_CONFIRM_COUNT == 3
    assert CONFIG == Config.for_lidar(
        LIDAR,
        filter=FilterConfig(max_landmarks=2048, confirm_count=3),
        keyframe_distance=(0.3, 0.3),
    )
    assert Config.for_lidar(LIDAR).keyframe_distance is None


@pytest.mark.parametrize(
    "make, line",
    [
        (lambda: Config.for_lidar("SICK"), "lidar is a str"),
        (lambda: Config.for_lidar(LIDAR._replace(num_beams=0)), "lidar.num_beams is 0"),
        (lambda: Config(frontend=FrontendConfig(lidar=LIDAR._replace(range_max=0.0))), "range_max"),
        (lambda: Config(frontend=FrontendConfig(labels="runs")), "labels"),
        (lambda: Config(filter=FilterConfig(max_landmarks=0)), "max_landmarks is 0"),
        (lambda: Config(scan_matching=ScanMatchSpec(window_scans=0)), "window_scans is 0"),
        (lambda: Config(loop_closure=LoopClosureSpec(submap_scans=0)), "submap_scans is 0"),
        (lambda: Config(keyframe_distance=(0.3, 0.0)), r"keyframe_distance is \(0.3, 0.0\)"),
        (lambda: Config(keyframe_distance=(-0.3, 0.3)), "not a tuple of two positive numbers"),
        (lambda: Config(keyframe_distance=(math.nan, 0.3)), "keyframe_distance"),
        (lambda: Config(keyframe_distance=0.3), "keyframe_distance is 0.3"),
    ],
)
def test_a_configuration_that_is_not_possible_is_refused(make, line):
    with pytest.raises(ValueError, match=line):
        make().check()
