import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest
import test_ros_bags
from rosbags import rosbag2

from jaxslam.io import bag_files, readers, ros_bags
from jaxslam.io.errors import InputError


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A bag of each system."""
    place = tmp_path_factory.mktemp("bags")
    test_ros_bags.write(place / "one.bag", 1)
    test_ros_bags.write(place / "two", 2)
    return place


def same(path, bags):
    right = ros_bags.read(bags / "two")
    np.testing.assert_array_equal(readers.read_log(path).ranges, right.ranges)


def test_a_bare_file_of_ros_2_needs_no_folder(bags, tmp_path):
    file = next((bags / "two").glob("*.db3"))
    shutil.copy(file, tmp_path / "alone.db3")
    same(tmp_path / "alone.db3", bags)
    shutil.copy(file, tmp_path / "without suffix")
    same(tmp_path / "without suffix", bags)


def test_mcap_files_are_read_bare_and_in_a_folder(tmp_path, bags, monkeypatch):
    plugin = rosbag2.StoragePlugin.MCAP
    usual = rosbag2.Writer

    def writer(path, version):
        return usual(path, version=version, storage_plugin=plugin)

    monkeypatch.setattr(test_ros_bags.rosbag2, "Writer", writer)
    folder = test_ros_bags.write(tmp_path / "three", 2)
    same(folder, bags)
    (file,) = folder.glob("*.mcap")
    shutil.copy(file, tmp_path / "alone.mcap")
    same(tmp_path / "alone.mcap", bags)


def test_names_do_not_matter(bags, tmp_path):
    shutil.copytree(bags / "two", tmp_path / "drive.bag")
    same(tmp_path / "drive.bag", bags)
    shutil.copy(bags / "one.bag", tmp_path / "drive")
    same(tmp_path / "drive", bags)
    shutil.copy(bags / "one.bag", tmp_path / "drive.bag.active")
    same(tmp_path / "drive.bag.active", bags)


def test_a_folder_of_parts_is_one_log(bags, tmp_path):
    (tmp_path / "parts").mkdir()
    shutil.copy(bags / "one.bag", tmp_path / "parts" / "drive_0.bag")
    same(tmp_path / "parts", bags)
    (tmp_path / "split").mkdir()
    shutil.copy(next((bags / "two").glob("*.db3")), tmp_path / "split" / "drive_0.db3")
    same(tmp_path / "split", bags)


@pytest.mark.parametrize(
    "name, pack, advice",
    [
        ("drive.bag.gz", gzip.compress, "unpack it first: gunzip drive.bag.gz"),
        ("drive", gzip.compress, "unpack it first: gunzip drive"),
        ("drive.bag.bz2", lambda data: b"BZh91AY" + data, "unpack it first: bunzip2"),
        ("drive.db3.zstd", lambda data: b"\x28\xb5\x2f\xfd" + data, "unpack it first: zstd -d"),
        ("old.bag", lambda data: b"#ROSBAG V1.2\n" + data, "convert it with `rosbag fix`"),
        ("cut.bag", lambda data: b"", "reindex it"),
    ],
)
def test_packed_and_old_bags_are_refused_with_the_right_advice(bags, tmp_path, name, pack, advice):
    path = tmp_path / name
    path.write_bytes(pack((bags / "one.bag").read_bytes()))
    with pytest.raises(InputError) as caught:
        readers.read_log(path)
    assert advice in str(caught.value) and str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_bag_that_was_not_closed_is_to_be_indexed(bags, tmp_path):
    """Its header does not say where the index is."""
    data = bytearray((bags / "one.bag").read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    data[place : place + 8] = bytes(8)
    path = tmp_path / "drive.bag.active"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"it was not closed: run `rosbag reindex`"):
        readers.read_log(path)


def test_what_is_no_bag_is_no_bag(tmp_path):
    (tmp_path / "a.txt").write_text("FLASER")
    (tmp_path / "a.clf.gz").write_bytes(gzip.compress(b"FLASER"))
    (tmp_path / "folder").mkdir()
    for name in ("a.txt", "a.clf.gz", "folder", "none.clf"):
        assert not bag_files.is_bag(tmp_path / name)
    assert bag_files.is_bag(Path("none.bag"))
