import gzip
from types import SimpleNamespace

import numpy as np
import pytest
import test_g2o
import test_npz
import test_ros_bags

from jaxslam.io import carmen, g2o, npz, readers
from jaxslam.io.errors import InputError

FLASER = ["PARAM robot_length 0.4"] + [
    f"FLASER 3 1 2 {3 + t} 0 0 0 {t} 0 0 {t} host {t}" for t in range(4)
]


@pytest.fixture
def files(tmp_path):
    """A log of each form, under names without a suffix."""
    (tmp_path / "a").write_text("# a comment\n\n" + "\n".join(FLASER) + "\n")
    (tmp_path / "b").write_bytes(gzip.compress((tmp_path / "a").read_bytes()))
    test_g2o.write(tmp_path / "c", test_g2o.graph())
    npz.write(tmp_path / "d.npz", test_npz.laser_log())
    (tmp_path / "d.npz").rename(tmp_path / "d")
    return tmp_path


def test_the_reader_is_found_from_the_content(files):
    for name, reader in zip("abcd", (carmen, carmen, g2o, npz), strict=True):
        assert readers.reader_of(files / name) is reader
        found, right = readers.read_log(files / name), reader.read(files / name)
        for a, b in zip(found, right, strict=True):
            np.testing.assert_array_equal(a, b)


def test_readings_from_range_max_on_are_no_return(files):
    for name in "abcd":
        found = readers.read_log(files / name, range_max=2.5)
        assert found.lidar.range_max == 2.5 and np.isinf(found.ranges).any()


def test_topics_are_those_of_bags(files, tmp_path):
    with pytest.raises(InputError, match="has no topics; name topics only for ROS bags"):
        readers.read_log(files / "a", scan_topic="/scan")
    bag = test_ros_bags.write(tmp_path / "drive.bag", 1)
    found = readers.read_log(bag, scan_topic="/scan", odometry_topic="/odom")
    assert found.source == ", scans of /scan, odometry of /odom"
    with pytest.raises(InputError, match="'/s'"):
        readers.read_log(bag, scan_topic="/s")


@pytest.mark.parametrize(
    "content, message",
    [
        (b"hello\n" * 5000, "is a log of no known format; the formats are"),
        (b"\0\1\2", "is binary"),
        (b"", "is empty"),
        (b"PK\3\4 broken", "zip archive that cannot be read"),
    ],
)
def test_a_file_that_is_no_log_is_refused(tmp_path, content, message):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        readers.read_log(tmp_path / "a")
    assert "\n" not in str(caught.value)


def test_a_log_in_a_package_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    installed = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(readers, "find_spec", lambda name: installed)
    assert readers.find_log("killian") == tmp_path / "data" / "killian.g2o.zip"
    monkeypatch.setattr(readers, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"killian: comes with .*; pip install '.\[data\]'"):
        readers.read_log("killian")
    (tmp_path / "killian").write_text("\n".join(FLASER) + "\n")
    assert len(readers.read_log("killian").ranges) == 4, "a file of this name comes first"


def test_a_path_that_is_none_and_an_impossible_range_max_are_refused(files):
    for path in (None, 5, b"a"):
        with pytest.raises(InputError, match="path is .*; name a file"):
            readers.read_log(path)
    for range_max in (0.0, -1, np.nan, "20", None):
        with pytest.raises(InputError, match="range_max .* is not a length"):
            readers.read_log(files / "a", range_max=range_max)
