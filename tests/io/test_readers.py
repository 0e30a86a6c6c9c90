import gzip
from types import SimpleNamespace

import numpy as np
import pytest
import test_bags
import test_g2o
import test_npz

from jaxslam.io import carmen, g2o, npz, readers
from jaxslam.io.errors import InputError

FLASER = ["PARAM robot_length 0.4"] + [
    f"FLASER 3 1 2 {3 + t} 0 0 0 {t} 0 0 {t} host {t}" for t in range(4)
]


@pytest.fixture
def files(tmp_path):
    """A log of each form, under names that tell nothing."""
    (tmp_path / "a").write_text("# a comment\n\n" + "\n".join(FLASER) + "\n")
    (tmp_path / "b").write_bytes(gzip.compress((tmp_path / "a").read_bytes()))
    test_g2o.write(tmp_path / "c", test_g2o.graph())
    npz.write(tmp_path / "d.npz", test_npz.recording())
    (tmp_path / "d.npz").rename(tmp_path / "d")
    return tmp_path


def test_the_file_tells_its_reader(files):
    for name, reader in zip("abcd", (carmen, carmen, g2o, npz), strict=True):
        assert readers.reader_of(files / name) is reader
        found, right = readers.read(files / name), reader.read(files / name)
        for a, b in zip(found, right, strict=True):
            np.testing.assert_array_equal(a, b)


def test_readings_from_the_reach_on_are_none(files):
    for name in "abcd":
        found = readers.read(files / name, range_max=2.5)
        assert found.lidar.range_max == 2.5 and np.isinf(found.ranges).any()


def test_topics_are_those_of_bags(files, tmp_path):
    with pytest.raises(InputError, match="has no topics; name topics only for ROS bags"):
        readers.read(files / "a", scan_topic="/scan")
    bag = test_bags.write(tmp_path / "drive.bag", 1)
    found = readers.read(bag, scan_topic="/scan", odometry_topic="/odom")
    assert found.source == ", scans of /scan, odometry of /odom"
    with pytest.raises(InputError, match="'/s'"):
        readers.read(bag, scan_topic="/s")


@pytest.mark.parametrize(
    "content, message",
    [
        (b"hello\n" * 5000, "is a log of no known format; the formats are"),
        (b"\0\1\2", "is binary"),
        (b"", "is empty"),
        (b"PK\3\4 broken", "zip archive that cannot be read"),
    ],
)
def test_what_is_no_log_is_told(tmp_path, content, message):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        readers.read(tmp_path / "a")
    assert "\n" not in str(caught.value)


def test_a_log_that_a_package_brings_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    brought = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(readers, "find_spec", lambda name: brought)
    assert readers.find("killian") == tmp_path / "data" / "killian.g2o.zip"
    monkeypatch.setattr(readers, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"killian: comes with .*; pip install '.\[data\]'"):
        readers.read("killian")
    (tmp_path / "killian").write_text("\n".join(FLASER) + "\n")
    assert len(readers.read("killian").ranges) == 4, "a file of this name comes first"
