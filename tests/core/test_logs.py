import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar

LIDAR = Lidar(num_beams=3, angle_min=-0.5, angle_increment=0.5, range_max=8.0)
TIMES = [1_600_000_000.25, 1_600_000_001.5]
POSES = [[0, 0, 0], [1, 0.5, -0.25]]
RANGES = [[1, 2, 3], [0, 9, -1]]


def test_arrays_and_lists_become_the_same_log():
    log = LaserLog.from_arrays(TIMES, POSES, RANGES, LIDAR)
    np.testing.assert_array_equal(log.times, TIMES)
    np.testing.assert_array_equal(log.odom_poses, POSES)
    np.testing.assert_array_equal(log.ranges, [[1, 2, 3], [np.inf] * 3])
    np.testing.assert_array_equal(log.odom_stream_poses, POSES)
    kinds = (log.times.dtype, log.odom_poses.dtype, log.ranges.dtype)
    assert kinds == (np.float64, np.float64, np.float32) and log.lidar == LIDAR
    for convert in (np.asarray, jnp.asarray):
        other = LaserLog.from_arrays(convert(TIMES), convert(POSES), convert(RANGES), LIDAR)
        single = LaserLog.from_arrays(TIMES, np.float32(POSES), jnp.float32(RANGES), LIDAR)
        for a, b, c in zip(log, other, single, strict=True):
            np.testing.assert_array_equal(a, b)
            np.testing.assert_array_equal(a, c)


def test_a_log_does_not_share_memory_with_what_it_was_made_of():
    times = np.array(TIMES)
    log = LaserLog.from_arrays(times, POSES, RANGES, LIDAR)
    times[:] = 0.0
    assert log.times[0] == TIMES[0]


def test_the_odometry_stream_may_have_more_poses():
    stream = np.zeros((5, 3))
    log = LaserLog.from_arrays(
        TIMES, POSES, RANGES, LIDAR, odom_stream_times=range(5), odom_stream_poses=stream
    )
    assert log.odom_stream_times.tolist() == [0, 1, 2, 3, 4]
    assert log.odom_stream_poses.shape == (5, 3)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"times": 5.0}, r"times is .* \(\), not \(T,\)"),
        ({"times": []}, "times is empty"),
        ({"times": ["a", "b"]}, "times is <U1 .*, not numbers"),
        ({"times": [0.0, np.nan]}, r"times\[1\] is nan, not a finite number"),
        ({"odom_poses": [[0, 0], [1, 1]]}, r"odom_poses is .* \(2, 2\), not \(2, 3\)"),
        ({"odom_poses": [[0, 0, 0], [1, 1]]}, "odom_poses is not an array: its parts differ"),
        ({"odom_poses": [[0, 0, 0], [0, np.inf, 0]]}, r"odom_poses\[1, 1\] is inf"),
        ({"ranges": np.ones((2, 4))}, r"ranges is .* \(2, 4\), not \(2, 3\)"),
        ({"ranges": np.ones((3, 3))}, r"ranges is .* \(3, 3\), not \(2, 3\)"),
        ({"lidar": 3}, "lidar is a int, not a Lidar"),
        ({"lidar": Lidar(num_beams=1)}, "lidar.num_beams is 1, not an integer of at least 2"),
        ({"lidar": LIDAR._replace(num_beams=2.5)}, "lidar.num_beams is 2.5"),
        ({"lidar": LIDAR._replace(angle_increment=-0.1)}, "lidar.angle_increment is -0.1"),
        ({"lidar": LIDAR._replace(range_max=np.nan)}, "lidar.range_max is nan, not a finite"),
        ({"lidar": LIDAR._replace(range_max="far")}, "lidar.range_max is <U3"),
        ({"lidar": LIDAR._replace(range_std=-1.0)}, "lidar.range_std is -1.0, which is below 0"),
        ({"odom_stream_times": [0.0]}, "give both or neither"),
        (
            {"odom_stream_times": [0.0], "odom_stream_poses": np.zeros((2, 3))},
            r"odom_stream_poses is .* \(2, 3\), not \(1, 3\)",
        ),
    ],
)
def test_a_bad_argument_is_named(change, message):
    arguments = {"times": TIMES, "odom_poses": POSES, "ranges": RANGES, "lidar": LIDAR}
    with pytest.raises(ValueError, match=message):
        LaserLog.from_arrays(**arguments | change)
