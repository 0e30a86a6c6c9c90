import numpy as np
import pytest

from jaxslam.core.se2_np import compose, relative
from jaxslam.io import mounts
from jaxslam.io.errors import InputError
from jaxslam.io.raw_log import RawTransform

HIDDEN = np.array([0.25, -0.1, 0.5])  # of the scanner on the robot


def transform(parent, child, pose, *, roll=0.0, count=1):
    x, y, yaw = pose
    c, s, a, b = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(roll / 2), np.sin(roll / 2)
    values = (x, y, 0.2, c * b, s * b, s * a, c * a)
    stamps = [(float(i), float(i), i) for i in range(count)]
    return RawTransform(parent, child, stamps, [values] * count)


def tree(*transforms):
    return {(one.parent, one.child): one for one in transforms}


def chain(*names, roll=0.0):
    """Transforms along frames, of which the last is the scanner's, at `HIDDEN` in the first."""
    poses = [np.array([0.1 * i, 0.05, 0.3 * i]) for i in range(1, len(names) - 1)]
    total = np.zeros(3)
    for pose in poses:
        total = compose(total, pose)
    poses.append(relative(total, HIDDEN))
    pairs = list(zip(names[:-1], names[1:], strict=True))
    return [
        transform(a, b, pose, roll=roll if b == names[-1] else 0.0)
        for (a, b), pose in zip(pairs, poses, strict=True)
    ]


@pytest.mark.parametrize(
    "names, base, scan, note",
    [
        (("base_link", "laser"), "base_link", "laser", None),
        (("base_link", "mast", "head", "laser"), "base_link", "laser", None),
        (("base_footprint", "base_link", "laser"), "base_footprint", "laser", None),
        (
            ("base_link", "laser"),
            "robot1/base_link",
            "laser",
            "'robot1/base_link', by the odometry",
        ),
        (("base_link", "laser"), "base_footprint", "laser", "taken to be 'base_link'"),
        (("r1/base_link", "r1/laser"), "base_link", "laser", "taken to be 'r1/base_link'"),
        (("base_link", "laser"), "", "laser", "frame of the robot, by the odometry"),
        (("chassis", "mast", "laser"), "", "laser", "taken to be 'chassis'"),
    ],
)
@pytest.mark.parametrize("roll", [0.0, np.pi])
def test_the_mount_is_found_by_any_chain(names, base, scan, note, roll):
    found, notes = mounts.find_mount("a.bag", tree(*chain(*names, roll=roll)), scan, base)
    np.testing.assert_allclose(found.pose, HIDDEN, atol=1e-12)
    assert found.upside_down == (roll > 0)
    assert len(notes) == (note is not None) and (note is None or note in notes[0])


def test_transforms_are_followed_from_child_to_parent_too():
    """Some robots publish the footprint as a child of the base."""
    known = tree(
        *chain("base_link", "laser"), transform("base_link", "base_footprint", (0.1, 0, 0))
    )
    found, notes = mounts.find_mount("a.bag", known, "laser", "base_footprint")
    np.testing.assert_allclose(found.pose, HIDDEN - [0.1, 0, 0], atol=1e-12)
    assert notes == []


def test_the_motion_of_the_robot_is_no_mount():
    known = tree(
        *chain("base_link", "laser"), transform("odom", "base_footprint", (5, 5, 1), count=9)
    )
    known |= tree(transform("odom", "base_link", (7, 7, 2), count=9))
    found, _ = mounts.find_mount("a.bag", known, "laser", "base_footprint")
    np.testing.assert_allclose(found.pose, HIDDEN, atol=1e-12)


@pytest.mark.parametrize(
    "known",
    [{}, tree(transform("odom", "base_link", (0, 0, 0))), tree(transform("a", "b", (1, 1, 1)))],
)
def test_without_a_transform_of_the_scanner_it_is_at_the_origin_with_a_note(known):
    found, notes = mounts.find_mount("a.bag", known, "laser", "base_link")
    assert not found.pose.any() and not found.upside_down
    assert notes[0].startswith("no transform from 'base_link' to 'laser'") and "--mount" in notes[0]


def test_transforms_that_do_not_join_are_refused_by_both_names():
    known = tree(transform("mast", "laser", (1, 0, 0)), transform("base_link", "imu", (0, 0, 0)))
    with pytest.raises(
        InputError, match="a.bag: no transform joins 'base_link' to 'laser'; name --ba"
    ):
        mounts.find_mount("a.bag", known, "laser", "base_link")


def test_a_tilted_or_moving_scanner_makes_a_note():
    tilted = tree(transform("base_link", "laser", (0, 0, 0), roll=1.0))
    assert "tilted by 57 degrees" in mounts.find_mount("a", tilted, "laser", "base_link")[1][0]
    moving = transform("base_link", "laser", (0, 0, 0), count=2)
    moving.values[1] = transform("base_link", "laser", (0, 0, 0.5)).values[0]
    assert (
        "moves in 'base_link'" in mounts.find_mount("a", tree(moving), "laser", "base_link")[1][0]
    )


def moving(parent, child, count):
    poses = [np.array([0.1 * i, 0.0, 0.02 * i]) for i in range(count)]
    values = [transform(parent, child, pose).values[0] for pose in poses]
    return RawTransform(parent, child, [(float(i), np.nan, i) for i in range(count)], values)


def test_the_odometry_is_that_of_the_frame_that_carries_the_scanner():
    known = tree(moving("odom", "base_footprint", 20), moving("odom", "base_link", 9))
    known |= tree(*chain("base_link", "laser"))
    found, frame, notes = mounts.odometry_of_transforms("a", known, "laser", None)
    assert frame == "base_link" and len(found.poses) == 9
    np.testing.assert_allclose(found.poses[:, 2], 0.02 * np.arange(9), atol=1e-12)
    assert "has the children base_footprint, base_link" in notes[0]


def test_the_odometry_frame_can_have_another_name():
    known = tree(moving("r1/odom", "r1/base", 5), moving("wheels", "base_link", 4))
    assert mounts.odometry_of_transforms("a", known, "laser", None)[1] == "r1/base"
    found, frame, _ = mounts.odometry_of_transforms("a", known, "laser", "wheels")
    assert frame == "base_link" and len(found.poses) == 4
    with pytest.raises(
        InputError, match="a: --odom-frame: there is no transform from 'map'; .*r1/odom"
    ):
        mounts.odometry_of_transforms("a", known, "laser", "map")
    none = mounts.odometry_of_transforms("a", tree(transform("a", "b", (0, 0, 0))), "laser", None)
    assert none == (None, "", [])
