import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.io import npz
from jaxslam.io.errors import InputError

T, R = 7, 5


def laser_log():
    rng = np.random.default_rng(0)
    ranges = rng.uniform(0.5, 9.0, (T, R)).astype(np.float32)
    ranges[1, 2] = np.inf
    return LaserLog(
        times=np.sort(rng.uniform(0, 9, T)),
        odom_poses=np.cumsum(rng.normal(0.0, 0.1, (T, 3)), axis=0),
        ranges=ranges,
        lidar=Lidar(R, -1.0, 0.5, 10.0, 0.03),
        num_skipped=0,
        odom_stream_times=np.sort(rng.uniform(0, 9, 20)),
        odom_stream_poses=np.cumsum(rng.normal(0.0, 0.1, (20, 3)), axis=0),
        odometry_guessed=np.zeros(T, bool),
        mount=np.array([0.1, 0.2, 0.3]),
    )


def arrays(**changes):
    one = laser_log()
    whole = {"format": npz.FORMAT, "version": npz.VERSION}
    whole |= {"times": one.times, "odometry": one.odom_poses, "ranges": one.ranges}
    whole |= {"first": -1.0, "step": 0.5, "reach": 10.0} | changes
    return {name: value for name, value in whole.items() if value is not None}


@pytest.fixture
def file(tmp_path):
    return tmp_path / "drive.npz"


def test_what_is_written_is_read(file):
    npz.write(file, laser_log())
    for a, b in zip(npz.read(file), laser_log(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert [one.name for one in file.parent.iterdir()] == [file.name]


def test_a_file_made_by_hand_needs_no_more_than_the_scans(file):
    np.savez(file, **arrays(times=np.arange(T), ranges=np.full((T, R), 3)))
    found = npz.read(file)
    assert found.lidar == Lidar(R, -1.0, 0.5, 10.0, 0.02) and found.times.dtype == np.float64
    assert found.ranges.dtype == np.float32 and (found.ranges == 3).all()
    np.testing.assert_array_equal(found.odom_stream_poses, found.odom_poses)


def test_what_returned_nothing_is_infinite(file):
    ranges = np.tile([np.nan, 0.0, -1.0, 10.0, 2.0], (T, 1))
    np.savez(file, **arrays(ranges=ranges))
    assert np.isinf(npz.read(file).ranges[0]).tolist() == [True] * 4 + [False]
    assert np.isinf(npz.read(file, range_max=1.0).ranges).all()
    assert npz.read(file, range_max=1.0).lidar.range_max == 1.0


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"times": None}, "times: missing"),
        ({"extra": 1.0}, "extra: unknown array"),
        ({"format": "another"}, "format: is another 1, not jaxslam-recording 1"),
        ({"version": 2}, "format: is jaxslam-recording 2"),
        ({"odometry": np.zeros((T, 2))}, r"odometry: is float64 \(7, 2\), not numbers \(7, 3\)"),
        ({"ranges": np.zeros((T + 1, R))}, r"ranges: is float64 \(8, 5\), not numbers \(7, any\)"),
        ({"ranges": np.zeros((T, 1))}, r"ranges: has the shape \(7, 1\)"),
        ({"times": np.array(["x"] * T)}, "times: is <U1"),
        ({"odometry": np.full((T, 3), np.nan)}, "odometry: holds NaN"),
        ({"step": 0.0}, "step: 0 is not between"),
        ({"reach": -1.0}, "reach: -1 is not between"),
        ({"noise": np.inf}, "noise: holds NaN or infinity"),
        ({"wheel_times": np.zeros(3)}, "wheel_poses: missing; give both or neither"),
        ({"wheel_times": np.zeros(3), "wheel_poses": np.zeros((4, 3))}, "another length"),
        ({"times": np.array([None] * T)}, "cannot|can be read|no NumPy file"),
    ],
)
def test_a_bad_array_is_reported_in_one_line(file, changes, message):
    np.savez(file, **arrays(**changes))
    with pytest.raises(InputError, match=message) as caught:
        npz.read(file)
    assert str(caught.value).startswith(f"{file}: ") and "\n" not in str(caught.value)


def test_files_of_another_kind_are_refused(tmp_path, file):
    for path, content in ((tmp_path / "a", b"x"), (tmp_path / "b", b"PK\3\4 and no more")):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is no NumPy file that can be read"):
            npz.read(path)
    with pytest.raises(InputError, match="does not exist"):
        npz.read(tmp_path / "none")
    with pytest.raises(InputError, match="is a folder"):
        npz.read(tmp_path)
    with pytest.raises(InputError, match="cannot be written"):
        npz.write(tmp_path / "no" / "such.npz", laser_log())


def test_a_damaged_file_never_ends_in_a_traceback(file):
    npz.write(file, laser_log())
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(150):
        data = bytearray(whole)
        for at in rng.integers(len(data), size=rng.integers(1, 4)):
            data[at] = rng.integers(256)
        file.write_bytes(data[: rng.integers(len(data))] if rng.random() < 0.2 else data)
        try:
            assert np.isfinite(npz.read(file).odom_poses).all()
        except InputError as error:
            assert "\n" not in str(error)


def test_lists_numpy_and_jax_arrays_are_written_alike(file):
    log = laser_log()
    npz.write(file, log)
    expected = npz.read(file)
    for convert in (np.ndarray.tolist, jnp.asarray):
        npz.write(
            file,
            log._replace(
                times=convert(log.times),
                odom_poses=convert(log.odom_poses),
                ranges=convert(log.ranges),
                odom_stream_times=convert(log.odom_stream_times),
                odom_stream_poses=convert(log.odom_stream_poses),
            ),
        )
        for a, b in zip(npz.read(file), expected, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"times": np.zeros(3)}, r"odom_poses is float64 \(7, 3\), not \(3, 3\)"),
        ({"odom_stream_poses": np.zeros((19, 3))}, r"odom_stream_poses is .*, not \(20, 3\)"),
        ({"lidar": Lidar(R, range_std=0.0)}, "lidar.range_std is 0, not between 1e-06 and 1000"),
        ({"lidar": Lidar(R, range_max=1e9)}, "lidar.range_max is 1e.09, not between"),
    ],
)
def test_a_log_that_could_not_be_read_again_is_not_written(file, change, message):
    with pytest.raises(ValueError, match=message):
        npz.write(file, laser_log()._replace(**change))
    assert not file.exists()


@pytest.mark.parametrize("range_max", [0.0, -1.0, np.nan, "far"])
def test_an_impossible_range_max_is_refused(file, range_max):
    npz.write(file, laser_log())
    with pytest.raises(InputError, match="range_max .* is not a length"):
        npz.read(file, range_max=range_max)
