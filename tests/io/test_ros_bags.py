import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from bag_messages import FIRST, LEAST, MOST, START, STEP, TRANSFORMS, Maker, quaternion
from rosbags import rosbag1, rosbag2

from jaxslam.core.se2 import compose
from jaxslam.io import readers, ros_bags
from jaxslam.io.errors import InputError

SCANS, BEAMS = 8, 6
MOUNT = np.array([0.25, -0.1, 0.3])  # of the scanner on the robot


def ranges():
    return np.random.default_rng(0).uniform(0.5, 9.0, (SCANS, BEAMS)).astype(np.float32)


def pose_at(t):
    """Pose of the robot by odometry at a time since the start."""
    return np.interp(t, [0, 2, 9], [0, 1, 4]), 0.1 * t, 0.2 * t


def write(path, ros, *, poses="odometry", mount=True, roll=0.0, scans=SCANS, **how):
    """A bag of scans at 0.5, 1.5 ... and poses at 0, 1, 2 ... seconds."""
    make = Maker(ros)
    said = []  # time, topic, type, message
    if mount:
        said.append((0.0, "/tf_static", TRANSFORMS,
                     make.transform(0.0, "base_link", "mount", (0.1, 0.0, 0.0))))  # fmt: skip
        rest = (MOUNT[0] - 0.1, MOUNT[1], MOUNT[2])
        said.append((0.0, "/tf_static", TRANSFORMS,
                     make.transform(0.0, "mount", "laser", rest, roll)))  # fmt: skip
    for t in np.arange(0.0, scans + 1.0):
        if poses == "odometry":
            said.append((t, "/odom", ros_bags.ODOMETRY, make.odometry(t, pose_at(t))))
        if poses == "tf":
            one = make.transform(t, "odom", "base_link", pose_at(t))
            said.append((t, "/tf", TRANSFORMS, one))
    for i in range(scans):
        one = make.scan(i + 0.5, ranges()[i % SCANS], **how)
        said.append((i + 0.5, "/scan", ros_bags.SCAN, one))
    if ros == 1:
        writer = rosbag1.Writer(path)
        pack = make.store.serialize_ros1
    else:
        writer = rosbag2.Writer(path, version=9)
        pack = make.store.serialize_cdr
    with writer:
        known = {}
        for t, topic, kind, message in sorted(said, key=lambda one: one[0]):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=make.store)
            writer.write(known[topic], int(1e9 * (START + t)), pack(message, kind))
    return path


@pytest.fixture(params=[1, 2], ids=["ros1", "ros2"])
def ros(request):
    return request.param


def place(tmp_path, ros):
    return tmp_path / ("drive.bag" if ros == 1 else "drive")


@pytest.mark.parametrize("poses", ["odometry", "tf"])
def test_scans_and_poses_of_the_scanner_are_read(tmp_path, ros, poses):
    path = write(place(tmp_path, ros), ros, poses=poses)
    found = ros_bags.read(path)
    np.testing.assert_array_equal(found.ranges, ranges())
    np.testing.assert_allclose(found.times - START, np.arange(SCANS) + 0.5, atol=1e-6)
    for i in range(SCANS):
        before, after = (
            compose(jnp.array(pose_at(float(t))), jnp.asarray(MOUNT)) for t in (i, i + 1)
        )
        np.testing.assert_allclose(found.odom_poses[i], (before + after) / 2, atol=1e-9)
    np.testing.assert_allclose(found.lidar[:4], (BEAMS, FIRST, STEP, MOST), rtol=1e-6)
    assert found.num_skipped == 0 and len(found.odom_stream_times) == SCANS + 1
    for a, b in zip(readers.read_log(path), found, strict=True):
        np.testing.assert_array_equal(a, b)
    right = "/odom" if poses == "odometry" else "/tf"
    assert ros_bags.topics(path) == ("/scan", right)


def test_a_file_of_a_folder_stands_for_it(tmp_path):
    path = write(tmp_path / "drive", 2)
    (file,) = path.glob("*.db3")
    np.testing.assert_array_equal(ros_bags.read(file).ranges, ros_bags.read(path).ranges)


def test_without_transforms_the_scanner_is_the_robot(tmp_path, ros):
    found = ros_bags.read(write(place(tmp_path, ros), ros, mount=False))
    np.testing.assert_allclose(found.odom_stream_poses[3], pose_at(3.0), atol=1e-12)


@pytest.mark.parametrize("roll", [0.0, np.pi])
@pytest.mark.parametrize("step", [STEP, -STEP])
def test_beams_go_from_right_to_left_however_the_scanner_hangs(tmp_path, roll, step):
    """Each reading stays at the point where it was, in the frame of the robot."""
    found = ros_bags.read(write(tmp_path / "drive", 2, roll=roll, step=step))
    angles = FIRST + step * np.arange(BEAMS)
    local = np.stack([np.cos(angles), np.sin(angles), 0 * angles]) * ranges()[0]
    x, y, z, w = quaternion(MOUNT[2], roll)
    q = np.array([x, y, z])
    turned = local + 2 * np.cross(q, np.cross(q, local.T) + w * local.T).T
    right = turned[:2].T + MOUNT[:2]
    lidar = found.lidar
    seen = lidar.angle_min + lidar.angle_increment * np.arange(BEAMS) + MOUNT[2]
    ours = MOUNT[:2] + found.ranges[0][:, None] * np.stack([np.cos(seen), np.sin(seen)], axis=1)
    assert lidar.angle_increment > 0

    def in_order(points):
        return points[np.lexsort(points.T.round(6))]

    np.testing.assert_allclose(in_order(ours), in_order(right), atol=1e-5)


def test_what_returned_nothing_is_infinite(tmp_path):
    bag = write(tmp_path / "drive", 2)
    found = ros_bags.read(bag, range_max=3.0)
    assert np.array_equal(np.isinf(found.ranges), ranges() >= 3.0) and found.lidar.range_max == 3.0


def test_scans_outside_the_time_of_the_odometry_are_left_out_and_counted(tmp_path):
    found = ros_bags.read(write(tmp_path / "drive", 2, scans=30))
    assert len(found.ranges) == 30
    path = tmp_path / "late"
    make, scans = Maker(2), 30
    with rosbag2.Writer(path, version=9) as writer:
        odom = writer.add_connection("/odom", ros_bags.ODOMETRY, typestore=make.store)
        scan = writer.add_connection("/scan", ros_bags.SCAN, typestore=make.store)
        for i in range(scans):
            one = make.scan(float(i), ranges()[0])
            writer.write(scan, i + 1, make.store.serialize_cdr(one, ros_bags.SCAN))
            if i < scans - 1:
                one = make.odometry(float(i), pose_at(i))
                writer.write(odom, i + 1, make.store.serialize_cdr(one, ros_bags.ODOMETRY))
    late = ros_bags.read(path)
    assert len(late.ranges) == scans - 1 and late.num_skipped == 1


def test_topics_can_be_named_and_wrong_ones_are_refused(tmp_path, ros):
    path = write(place(tmp_path, ros), ros)
    named = ros_bags.read(path, scan_topic="/scan", odometry_topic="/odom")
    np.testing.assert_array_equal(named.ranges, ranges())
    with pytest.raises(InputError, match=r"scans: there is no .*LaserScan in '/s'; .*: /scan"):
        ros_bags.read(path, scan_topic="/s")
    with pytest.raises(InputError, match="odometry: there is no"):
        ros_bags.read(path, odometry_topic="/scan")


def test_bags_without_odometry_are_read_and_those_without_scans_refused(tmp_path, ros):
    for mount in (False, True):
        name = f"a{mount}.bag" if ros == 1 else f"a{mount}"
        found = ros_bags.read(write(tmp_path / name, ros, poses="none", mount=mount))
        assert not found.has_odometry and len(found.ranges) == SCANS and not found.odom_poses.any()
        assert "no odometry: the log has none" in found.notes
    name = "b.bag" if ros == 1 else "b"
    with pytest.raises(InputError, match="has no sensor_msgs/msg/LaserScan; .*topics are: /odom"):
        ros_bags.read(write(tmp_path / name, ros, scans=0))
    with pytest.raises(InputError, match="does not exist"):
        ros_bags.read(tmp_path / "none.bag")


def test_damaged_bags_never_end_in_a_traceback(tmp_path, ros):
    whole = write(place(tmp_path, ros), ros)
    rng = np.random.default_rng(0)
    for number in range(25):
        path = tmp_path / f"{number}" / whole.name
        path.parent.mkdir()
        copy = shutil.copy if ros == 1 else shutil.copytree
        copy(whole, path)
        file = path if ros == 1 else sorted(path.iterdir())[number % 2]
        data = bytearray(file.read_bytes())
        for at in rng.integers(len(data), size=rng.integers(1, 8)):
            data[at] = rng.integers(256)
        file.write_bytes(data[: rng.integers(len(data))] if number % 5 == 0 else data)
        try:
            assert np.isfinite(ros_bags.read(path).odom_poses).all()
        except InputError as error:
            assert "\n" not in str(error)


def write_messages(path, said, ros=2):
    """A bag of (time, topic, type, message)."""
    store = Maker(ros).store
    with rosbag2.Writer(path, version=9) as writer:
        known = {}
        for t, topic, kind, message in said:
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], int(1e9 * (START + t)), store.serialize_cdr(message, kind))
    return path


def with_wheels(*makers, count=12):
    """Messages of the wheels, and of each function (i, time) a (topic, type, message)."""
    make, said = Maker(2), []
    for i in range(count):
        said.append((float(i), "/odom", ros_bags.ODOMETRY, make.odometry(float(i), pose_at(i))))
        said += [
            (i + 0.5 - 0.5 * (i == count - 1), *one) for one in (f(make, i) for f in makers) if one
        ]
    return said


def scan_from(frame, topic="/scan", every=1, offset=0.0):
    def message(make, i):
        if i % every:
            return None
        return topic, ros_bags.SCAN, make.scan(i + 0.4, ranges()[i % SCANS] + offset, frame=frame)

    return message


def test_two_scanners_on_one_topic_are_not_mixed(tmp_path):
    said = with_wheels(scan_from("front"), scan_from("rear", every=2, offset=1.0))
    path = write_messages(tmp_path / "a", said)
    found = readers.read_log(path)
    assert len(found.times) == 11 and np.array_equal(found.ranges[:8], ranges())
    assert any("scans of 'front' are used, not those of 'rear' (6)" in x for x in found.notes)
    rear = readers.read_log(path, scan_frame="/rear")
    assert len(rear.times) == 6 and np.array_equal(rear.ranges[0], ranges()[0] + 1)


def test_of_two_scanners_the_one_with_most_scans_is_named(tmp_path):
    said = with_wheels(scan_from("front", every=3), scan_from("rear", "/scan_rear"))
    path = write_messages(tmp_path / "a", said)
    found = readers.read_log(path)
    assert ", scans of /scan_rear" in found.source
    assert any("not of /scan (4); --scan-topic chooses" in note for note in found.notes)
    assert len(readers.read_log(path, scan_topic="/scan").times) == 4


def test_of_several_echoes_the_first_is_read(tmp_path):
    def message(make, i):
        echo, one = make.of["sensor_msgs/msg/LaserEcho"], make.scan(i + 0.4, ranges()[i % SCANS])
        beams = [echo(np.array([r, r + 1], np.float32)) for r in one.ranges]
        beams[2] = echo(np.zeros(0, np.float32))
        many = make.of[ros_bags.MULTI_ECHO](
            one.header, one.angle_min, one.angle_max, one.angle_increment, 0.0, 0.1, LEAST, MOST,
            beams, [],
        )  # fmt: skip
        return "/echoes", ros_bags.MULTI_ECHO, many

    found = ros_bags.read(write_messages(tmp_path / "a", with_wheels(message)))
    right = ranges().copy()
    right[:, 2] = np.inf
    np.testing.assert_array_equal(found.ranges[:8], right)


@pytest.mark.parametrize("range_max", [np.inf, 0.0, np.nan])
def test_a_range_max_that_is_not_stated_is_the_usual_one(tmp_path, range_max):
    def message(make, i):
        one = make.scan(i + 0.4, ranges()[i % SCANS])
        one.range_max = range_max
        return "/scan", ros_bags.SCAN, one

    path = write_messages(tmp_path / "a", with_wheels(message))
    found = ros_bags.read(path)
    assert found.lidar.range_max == 20.0 and np.array_equal(found.ranges[:8], ranges())
    assert ros_bags.read(path, range_max=30.0).lidar.range_max == 30.0
    with pytest.raises(InputError, match="and the log states none"):
        ros_bags.read(path, range_max=np.inf)


def test_a_step_that_is_not_stated_follows_from_the_angles(tmp_path):
    def message(make, i):
        one = make.scan(i + 0.4, ranges()[i % SCANS])
        one.angle_increment = 0.0
        return "/scan", ros_bags.SCAN, one

    found = ros_bags.read(write_messages(tmp_path / "a", with_wheels(message)))
    assert found.lidar.angle_increment == pytest.approx(STEP) and found.num_skipped == 1


def test_scans_without_angles_are_broken(tmp_path):
    def message(make, i):
        one = make.scan(i + 0.4, ranges()[i % SCANS])
        one.angle_min = np.nan
        return "/scan", ros_bags.SCAN, one

    path = write_messages(tmp_path / "a", with_wheels(message))
    with pytest.raises(InputError, match="12 of 12 scans of /scan are broken"):
        ros_bags.read(path)
