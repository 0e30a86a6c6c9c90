"""Small bags with one thing wrong each, all of one drive; they are not part of the project."""

import functools
import tarfile

import numpy as np
import pytest

from jaxslam.core.se2_np import compose, relative
from jaxslam.core.time_series import interpolate_poses
from jaxslam.io import readers, ros_map, tum

# What must be noted of each, and how close its odometry must come to that of the good bag.
CASES = {
    "00-base": (None, 1e-9),
    "02-count-varies": ("have 453 to 457 beams", 1e-9),
    "02b-first-odd": ("another step between beams are left out: 1", 1e-9),
    "02c-step-jitters": ("differ in their angles", 1e-9),
    "03-range-max-inf": (None, 1e-9),
    "04b-upside-down-no-child": ("taken to be 'base_link'", 1e-9),
    "04c-backwards-namespaced": ("'robot1/base_link', by the odometry", 1e-9),
    "04d-backwards-footprint": ("'base_footprint', by the odometry", 1e-9),
    "04e-upside-down-0-2pi": (None, 1e-9),
    "07-odom-reset": ("odometry restarts (1 x)", 0.2),
    "09-odom-late": ("left out: 39 before it begins", 1e-6),
    "10-zero-to-2pi": (None, 1e-9),
    "11-yaw-in-z": ("no quaternions", 1e-9),
    "12c-tf-two-children": ("has the children base_footprint, base_link", 1e-9),
}


@pytest.fixture(scope="module")
def unpack(shared_data, tmp_path_factory):
    """Function that unpacks a case and returns its folder."""
    place = tmp_path_factory.mktemp("cases")

    def folder(name):
        if not (place / name).exists():
            archive = shared_data.parent / "cases" / f"{name}.tar.xz"
            if not archive.is_file():
                pytest.skip("no cases in ../shared/cases beside the repository")
            with tarfile.open(archive) as file:
                file.extractall(place, filter="data")
        return place / name

    return folder


@pytest.fixture(scope="module")
def read(unpack):
    """Function that reads a case, once."""
    return functools.cache(lambda name: readers.read_log(unpack(name) / "bag"))


def base_poses(log):
    """Poses (T, 3) of the robot."""
    return compose(log.odom_poses, relative(log.mount, np.zeros(3)))


@pytest.mark.parametrize("name", CASES)
def test_cases_are_read_as_the_good_one_is(read, name):
    note, near = CASES[name]
    good, log = read("00-base"), read(name)
    assert log.has_odometry and len(log.notes) == (note is not None), log.notes
    assert note is None or note in log.notes[0]
    kept = np.isin(good.times, log.times)
    assert kept.sum() == len(log.times) > 0.9 * len(good.times)
    found, right = (base_poses(one) for one in (log, good))
    right = right[kept]
    found, right = relative(found[0], found), relative(right[0], right)
    np.testing.assert_allclose(found[:, :2], right[:, :2], atol=near)
    assert log.odometry_guessed.sum() <= 1
    assert -np.pi - 0.1 < log.lidar.angle_min < -np.pi + 0.1


def points(log, folder):
    """Ends (N, 2) [m] of all beams, placed by the true poses of the scanner."""
    poses = interpolate_poses(log.times, *tum.read(folder / "truth.tum"))
    angles = log.lidar.angle_min + log.lidar.angle_increment * np.arange(log.lidar.num_beams)
    world, hit = poses[:, 2:] + angles, np.isfinite(log.ranges)
    x = (poses[:, :1] + log.ranges * np.cos(world))[hit]
    return np.stack([x, (poses[:, 1:2] + log.ranges * np.sin(world))[hit]], axis=1)


@pytest.mark.parametrize("name", CASES)
def test_walls_stand_where_they_are_whatever_the_mount(unpack, read, name):
    """Walls of the flat, seen from the true poses, are those of the good bag within 10 cm."""
    good = np.floor(points(read("00-base"), unpack("00-base"))[::7] / 0.1).astype(int) + 200
    is_wall = np.zeros((400, 400), bool)
    for dx, dy in np.ndindex(3, 3):
        is_wall[tuple((good + [dx - 1, dy - 1]).T)] = True
    found = np.floor(points(read(name), unpack(name))[::7] / 0.1).astype(int) + 200
    assert is_wall[tuple(found.clip(0, 399).T)].mean() > 0.99


def test_an_odometry_that_stands_still_is_none(unpack):
    log = readers.read_log(unpack("08-odom-identity") / "bag")
    assert not log.has_odometry and log.notes[0].startswith("no odometry: its pose is the same")


def test_unknown_cells_of_nav2_stay_unknown(shared_data):
    folder = shared_data.parent / "cases" / "20-nav2-map"
    if not folder.is_dir():
        pytest.skip("no cases in ../shared/cases beside the repository")
    found, right = (ros_map.read(folder / f"my_map{end}.yaml") for end in ("", "-0.196"))
    np.testing.assert_array_equal(found.free, right.free)
    np.testing.assert_array_equal(found.occupied, right.occupied)
    assert len(found.notes) == 1 and "stay unknown" in found.notes[0] and right.notes == ()
    beside = ros_map.read(shared_data.parent / "cases" / "21-absolute-path" / "map.yaml")
    assert "'/home/robot/maps/map.pgm' is taken to be 'map.pgm'" in beside.notes[0]
