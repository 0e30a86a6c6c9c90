import gzip
import math
import time

import numpy as np
import pytest

from jaxslam.core import logs
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, relative
from jaxslam.frontend.lidar import beam_angles
from jaxslam.io import carmen
from jaxslam.io.errors import InputError

TAIL = "host 0.5"


def flaser(t, *, n=4, pose=None, ranges=None):
    """A FLASER line whose first pose differs from its odometry pose."""
    x, y, theta = (0.1 * t, -0.2 * t, 0.01 * t) if pose is None else pose
    ranges = [1.0 + 0.5 * i for i in range(n)] if ranges is None else ranges
    readings = " ".join(map(str, ranges))
    return f"FLASER {len(ranges)} {readings} 9 9 9 {x} {y} {theta} {t} {TAIL}"


def odom(t):
    return f"ODOM {0.1 * t} {-0.2 * t} {0.01 * t} 0.3 0.1 0 {t} {TAIL}"


def good(count=40):
    """Lines of a good log: a FLASER line, then an ODOM line, and so on."""
    return [line for t in range(count // 2) for line in (flaser(t), odom(t + 0.5))]


def save(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def complaint(path, **options):
    """The reader's complaint, which must be one line that begins with the file."""
    with pytest.raises(InputError) as caught:
        carmen.read(path, **options)
    text = str(caught.value)
    assert "\n" not in text and text.startswith(str(path))
    return text


def test_reads_every_value(tmp_path):
    lines = ["# a comment", "PARAM robot_width 0.5 x 0 h 0", flaser(3.25), odom(3.5), "SYNC tag 1"]
    log = carmen.read(save(tmp_path / "a.clf", lines + ["", flaser(4.25, pose=(2, 1, -1.5))]))
    np.testing.assert_array_equal(log.times, [3.25, 4.25])
    np.testing.assert_allclose(log.odom_poses, [[0.325, -0.65, 0.0325], [2, 1, -1.5]])
    np.testing.assert_array_equal(log.ranges, [[1.0, 1.5, 2.0, 2.5]] * 2)
    np.testing.assert_array_equal(log.odom_stream_times, [3.5])
    np.testing.assert_allclose(log.odom_stream_poses, [[0.35, -0.7, 0.035]])
    assert log.num_skipped == 0 and log.lidar.num_beams == 4 and log.lidar.range_max == 20.0
    kinds = [log.times.dtype, log.odom_poses.dtype, log.odom_stream_poses.dtype, log.ranges.dtype]
    assert kinds == [np.float64, np.float64, np.float64, np.float32]


def test_without_odom_lines_the_scans_are_the_odometry_stream(tmp_path):
    log = carmen.read(save(tmp_path / "a.clf", [flaser(1), flaser(2), flaser(3)]))
    np.testing.assert_array_equal(log.odom_stream_times, log.times)
    np.testing.assert_array_equal(log.odom_stream_poses, log.odom_poses)


def test_file_order_is_kept_when_time_runs_backwards(tmp_path):
    log = carmen.read(save(tmp_path / "a.clf", [flaser(t) for t in (5, 7, 6, 8)]))
    np.testing.assert_array_equal(log.times, [5, 7, 6, 8])
    np.testing.assert_allclose(log.odom_poses[:, 0], [0.5, 0.7, 0.6, 0.8])


def test_readings_from_range_max_on_or_not_positive_are_no_return(tmp_path):
    readings = [0.0, -1.0, 7.9, 8.0, 81.91, "inf", "-inf", 7.999999999999, 1e300]
    path = save(tmp_path / "a.clf", [flaser(1, ranges=readings), flaser(2, ranges=readings)])
    log = carmen.read(path, range_max=8.0)
    inf = np.inf
    np.testing.assert_array_equal(log.ranges[0], np.float32([inf, inf, 7.9, *[inf] * 6]))
    assert log.lidar.range_max == 8.0 and log.num_skipped == 0


@pytest.mark.parametrize(
    "n, step, last", [(180, 1, 89), (181, 1, 90), (360, 0.5, 89.5), (361, 0.5, 90), (4, 45, 45)]
)
def test_beam_layout(n, step, last):
    lidar = carmen.half_circle_lidar(n, 20.0)
    angles = np.degrees(beam_angles(lidar))
    assert math.degrees(lidar.angle_increment) == pytest.approx(step)
    np.testing.assert_allclose(angles[[0, -1]], [-90, last], atol=1e-9)


def test_gzip_byte_order_mark_and_windows_line_ends(tmp_path):
    text = ("\ufeff" + "\r\n".join(good())).encode()
    (tmp_path / "a.clf").write_bytes(text)
    (tmp_path / "b.clf.gz").write_bytes(gzip.compress(text))
    a, b = carmen.read(tmp_path / "a.clf"), carmen.read(tmp_path / "b.clf.gz")
    assert a.times.size == 20 and a.num_skipped == 0
    np.testing.assert_array_equal(a.odom_poses, b.odom_poses)
    np.testing.assert_array_equal(a.ranges, b.ranges)


BROKEN = {
    "cut before the poses": (" ".join(flaser(3).split()[:7]), "cut or damaged: 7 fields"),
    "cut in the readings": (" ".join(flaser(3).split()[:4]), "cut or damaged: 4 fields"),
    "cut before the host": (" ".join(flaser(3).split()[:-2]), "cut or damaged: 13 fields"),
    "cut after the keyword": ("FLASER", "is not a beam count"),
    "cut ODOM": ("ODOM 0.1 0.2", "cut or damaged: 3 fields instead of 10"),
    "two lines in one": (flaser(3) + flaser(4), "cut or damaged"),
    "NaN range": (flaser(3, ranges=[1, 2, "nan", 3]), "field 5 (range 3): nan is not finite"),
    "word for a range": (flaser(3, ranges=[1, 2, 3, "x1"]), "field 6 (range 4): 'x1' is not a num"),
    "word for the count": ("FLASER many 1 2", "field 2 (n): 'many' is not a number"),
    "part of a beam": ("FLASER 1.5 1 2", "field 2 (n): 1.5 is not a beam count"),
    "infinite pose": (flaser(3, pose=(1, "inf", 2)), "field 11 (odom_y): inf is not finite"),
    "NaN ODOM pose": (odom(3).replace("0.03", "nan"), "field 4 (theta): nan is not finite"),
    "NaN time": (flaser("nan", pose=(1, 2, 3)), "field 13 (ipc_time): nan is not finite"),
    "no poses": ("FLASER 4 1 2 3 4 0.3 host 0.5", "no odometry"),
}


@pytest.mark.parametrize("line, reason", BROKEN.values(), ids=BROKEN.keys())
def test_one_broken_line_is_skipped_and_too_many_are_named(tmp_path, line, reason):
    lines = good()
    lines[6] = line  # instead of the scan at 3 s: 1 of 40 lines is broken
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert log.num_skipped == 1 and len(log.times) == 19 and len(log.odom_stream_times) == 20
    np.testing.assert_array_equal(log.times[2:4], [2, 4])
    assert np.isfinite(log.odom_poses).all() and np.isfinite(log.ranges).all()
    text = complaint(save(tmp_path / "b.clf", ["# first", *lines[:8]]))
    assert text.startswith(f"{tmp_path / 'b.clf'}:8: ") and reason in text
    assert "(1 of 8 lines of scans and odometry are broken)" in text
    assert "; repair them, each is: " + line.split()[0] + " " in text


def test_tolerance_is_five_percent_of_the_lines(tmp_path):
    lines = good()
    lines[5] = lines[9] = "ODOM cut"
    assert carmen.read(save(tmp_path / "a.clf", lines)).num_skipped == 2
    lines[20] = "FLASER cut"
    text = complaint(save(tmp_path / "b.clf", lines))
    assert "b.clf:6: cut or damaged" in text and "(3 of 40 " in text


def test_first_scan_may_be_the_odd_one(tmp_path):
    lines = good()
    lines[0] = flaser(0, n=9)  # 22.5 degrees apart, instead of 45
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert log.num_skipped == 1 and log.ranges.shape == (19, 4) and log.lidar.num_beams == 4
    assert len(log.notes) == 1 and "another step between beams are left out: 1" in log.notes[0]


def test_a_file_that_ends_in_the_middle_of_a_line(tmp_path):
    path = tmp_path / "a.clf"
    path.write_text("\n".join(good())[:-15])
    assert carmen.read(path).num_skipped == 1


def test_beam_count_that_changes_for_good(tmp_path):
    lines = [flaser(t, n=5 if t < 12 else 4) for t in range(20)]
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert log.lidar == carmen.half_circle_lidar(5, 20.0) and log.num_skipped == 0
    np.testing.assert_array_equal(log.ranges[:12], [[1.0, 1.5, 2.0, 2.5, 3.0]] * 12)
    np.testing.assert_array_equal(log.ranges[12:], [[1.0, 1.5, 2.0, 2.5, np.inf]] * 8)
    assert "scans have 4 to 5 beams" in log.notes[0]


@pytest.mark.parametrize("tail", ["{t} host 0.5", ""])
def test_log_without_odometry(tmp_path, tail):
    lines = [f"FLASER 4 1 2 3 4 {tail.format(t=t)}" for t in range(20)]
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert not log.has_odometry and not log.odom_poses.any() and log.odometry_guessed.all()
    assert len(log.times) == 20 and (np.diff(log.times) > 0).all()
    assert "no odometry: the log has none" in log.notes
    lines = [line for t in range(20) for line in (lines[t], odom(t - 0.5), odom(t + 0.5))]
    log = carmen.read(save(tmp_path / "b.clf", lines))
    assert log.has_odometry and log.num_skipped <= 1
    steps = relative(log.odom_poses[:-1], log.odom_poses[1:])
    assert (np.abs(np.hypot(*steps[1:-1, :2].T) - np.hypot(0.1, 0.2)) < 0.02).all()


def test_odometry_that_never_or_hardly_changes_is_none(tmp_path):
    for shift in (0.0, 1e-3):
        lines = [flaser(t, pose=(1 + shift * (t > 0), 2, 3)) for t in range(20)]
        log = carmen.read(save(tmp_path / "a.clf", lines))
        assert not log.has_odometry and "the same in all 20" in log.notes[0]
        assert np.ptp(log.odom_poses, axis=0).max() == 0.0
    wheels = [odom(t + 0.5) for t in range(-1, 20)]
    log = carmen.read(save(tmp_path / "b.clf", lines + wheels))
    assert log.has_odometry and "ODOM lines are used" in log.notes[-1]
    np.testing.assert_allclose(log.odom_poses[:, 0], 0.1 * np.arange(20), atol=1e-9)


def test_one_scan_needs_no_motion(tmp_path):
    log = carmen.read(save(tmp_path / "a.clf", [flaser(1)]))
    assert log.times.shape == (1,) and log.ranges.shape == (1, 4)


def test_log_without_scans(tmp_path):
    text = complaint(save(tmp_path / "a.clf", [odom(t) for t in range(20)]))
    assert "no usable FLASER line among its 20" in text and "; name a log that" in text
    lines = [odom(t) for t in range(20)] + ["FLASER 4 1"]
    assert "no usable FLASER line" in complaint(save(tmp_path / "b.clf", lines))


def test_files_that_are_no_log(tmp_path, monkeypatch):
    assert "does not exist" in complaint(tmp_path / "none.clf")
    assert "is a folder" in complaint(tmp_path)
    (tmp_path / "empty.clf").write_text("")
    assert "is empty" in complaint(tmp_path / "empty.clf")
    (tmp_path / "blank.clf").write_text(" \n\n")
    assert "is empty" in complaint(tmp_path / "blank.clf")
    (tmp_path / "binary.clf").write_bytes(bytes(range(256)) * 8)
    assert "is binary" in complaint(tmp_path / "binary.clf")
    text = complaint(save(tmp_path / "poem.clf", ["Shall I compare thee", "to a summer's day?"]))
    assert "neither FLASER nor ODOM lines" in text and "; name a CARMEN log" in text
    (tmp_path / "cut.clf.gz").write_bytes(gzip.compress("\n".join(good(400)).encode())[:-40])
    assert "damaged gzip" in complaint(tmp_path / "cut.clf.gz")
    locked = save(tmp_path / "locked.clf", good())

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("builtins.open", refuse)
    assert "cannot be read (Permission denied)" in complaint(locked)


@pytest.mark.parametrize("range_max", [0.0, -1.0, math.inf, math.nan, "far", None, True])
def test_an_impossible_range_max_is_refused(tmp_path, range_max):
    with pytest.raises(InputError, match="range_max .* give a positive number"):
        carmen.read(save(tmp_path / "a.clf", good()), range_max=range_max)


@pytest.mark.parametrize(
    "name, scans, beams, wheels, none",
    [
        ("intel", 910, 180, 13530, 81),
        ("aces", 440, 180, 7237, 50),
        ("freiburg-101", 292, 360, 4286, 81),
    ],
)
def test_recorded_logs(shared_data, name, scans, beams, wheels, none):
    path = shared_data / name / f"{name}.clf"
    began = time.perf_counter()
    log = carmen.read(path, range_max=40.0)
    assert time.perf_counter() - began < 5.0  # some 0.2 s on an idle machine
    assert log.ranges.shape == (scans, beams) and log.odom_stream_poses.shape == (wheels, 3)
    assert log.num_skipped == 0
    lines = [line.split() for line in path.read_text().splitlines() if line.startswith("FLASER")]
    raw = np.array([line[2 : 2 + beams] for line in lines], float)
    np.testing.assert_array_equal(np.isinf(log.ranges), (raw >= 40.0) | (raw <= 0.0))
    assert np.isinf(log.ranges[raw >= none]).all() and (raw >= none).any()
    seen = np.isfinite(log.ranges)
    np.testing.assert_allclose(log.ranges[seen], raw[seen], rtol=1e-6)
    np.testing.assert_array_equal(log.odom_poses[:, 2], [float(line[-4]) for line in lines])


def robotlaser(t, pose=(1.0, 2.0, 0.5), ranges=(1, 2, 30, 4), step=0.5):
    beams = " ".join(map(str, ranges))
    poses = f"{pose[0]} {pose[1]} {pose[2]} 9 9 9"
    head = f"ROBOTLASER1 0 -0.75 2.0 {step} 8.0 0.01 0 {len(ranges)} {beams} 0"
    return f"{head} {poses} 0.1 0.2 0.3 0.4 1e6 {t} host {t}"


def test_scans_of_the_newer_toolkit_are_read(tmp_path):
    lines = [robotlaser(t, pose=(0.1 * t, 0.0, 0.2)) for t in range(5)]
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert log.lidar == lidar_of(4, -0.75, 0.5, 8.0)
    np.testing.assert_array_equal(log.ranges[0], [1, 2, np.inf, 4])
    np.testing.assert_allclose(log.odom_poses[:, 0], 0.1 * np.arange(5))
    np.testing.assert_array_equal(log.odom_stream_times, np.arange(5))
    assert carmen.read(tmp_path / "a.clf", range_max=3.0).lidar.range_max == 3.0


def lidar_of(*numbers):
    return Lidar(*numbers, logs.DEFAULT_RANGE_STD)


def test_scans_that_are_there_twice_count_once(tmp_path):
    lines = [line for t in range(5) for line in (flaser(t), robotlaser(t), "ROBOTLASER1 cut")]
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert len(log.times) == 5 and log.num_skipped == 0 and log.lidar.angle_min == -np.pi / 2


def test_broken_scans_of_the_newer_toolkit_are_reported(tmp_path):
    good = [robotlaser(t, pose=(t, 0, 0)) for t in range(40)]
    lines = [*good, robotlaser(50, step=0.4)]
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert log.num_skipped == 1 and log.lidar.angle_increment == 0.5 and len(log.notes) == 1
    text = complaint(save(tmp_path / "b.clf", [*good[:3], "ROBOTLASER1 0 1 2"]))
    assert ":4: cut or damaged: 4 fields (1 of 4" in text and "ROBOTLASER1 type first" in text
    still = save(tmp_path / "c.clf", [robotlaser(t) for t in range(4)])
    assert not carmen.read(still).has_odometry


def test_raw_scans_take_their_odometry_from_odom_lines(tmp_path):
    scan = "RAWLASER1 0 -0.75 2.0 0.5 8.0 0.01 0 4 1 2 30 4 1 0.5"
    lines = [line for t in range(20) for line in (odom(t), f"{scan} {t + 0.5} host {t}")]
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert log.lidar == lidar_of(4, -0.75, 0.5, 8.0) and len(log.times) == 19
    np.testing.assert_allclose(log.odom_poses[:, 0], 0.1 * (np.arange(19) + 0.5))
    assert log.num_skipped == 1 and "1 after it ends" in log.notes[0]
    twice = [line for t in range(20) for line in (robotlaser(t, pose=(t, 0, 0)), lines[2 * t + 1])]
    assert len(carmen.read(save(tmp_path / "b.clf", twice)).times) == 20


@pytest.mark.parametrize("name", ["robot_frontlaser", "laser_front_laser"])
def test_parameters_place_the_front_laser(tmp_path, name):
    lines = [
        f"PARAM {name}_offset 0.25 976052857.2 host 0.1",
        f"PARAM {name}_side_offset -0.1 976052857.2 host 0.1",
        f"PARAM {name}_angular_offset 0.5 976052857.2 host 0.1",
        f"PARAM {name}_offset",
        "PARAM robot_name pioneer 0 host 0",
    ]
    mount = np.array([0.25, -0.1, 0.5])
    log = carmen.read(save(tmp_path / "a.clf", lines + drive(true_pose, true_pose)))
    np.testing.assert_allclose(log.mount, mount)
    wanted = compose(np.array([true_pose(t) for t in log.times]), mount)
    np.testing.assert_allclose(relative(log.odom_poses, wanted), 0.0, atol=1e-9)


def true_pose(t):
    """A drive of 1 m/s along an arc."""
    return np.array([10 * np.sin(0.1 * t), 10 - 10 * np.cos(0.1 * t), 0.1 * t])


def odom_line(t, pose):
    """An ODOM line of a pose."""
    x, y, theta = pose
    return f"ODOM {x} {y} {theta} 1 0.1 0 {t} {TAIL}"


def drive(pose_of_scan, pose_of_wheels, count=60):
    """A log of a scan each second, between two readings of the wheels."""
    lines = []
    for t in range(count):
        lines += [odom_line(t, pose_of_wheels(t)), flaser(t + 0.25, pose=pose_of_scan(t + 0.25))]
        lines.append(odom_line(t + 0.5, pose_of_wheels(t + 0.5)))
    return lines


def test_poses_that_were_corrected_are_replaced_by_odometry(tmp_path):

    def drifting(t):
        return true_pose(t) + np.array([0.05 * t, 0.0, 0.0])

    log = carmen.read(save(tmp_path / "a.clf", drive(true_pose, drifting)))
    wanted = np.array([drifting(t) for t in log.times])
    np.testing.assert_allclose(log.odom_poses, wanted, atol=0.02)
    assert len(log.notes) == 1 and "ODOM lines are used" in log.notes[0]


def test_poses_of_a_scanner_off_the_centre_are_kept(tmp_path):

    def mounted(t):
        return compose(true_pose(t), np.array([0.3, -0.1, np.pi]))

    log = carmen.read(save(tmp_path / "a.clf", drive(mounted, true_pose)))
    wanted = np.array([mounted(t) for t in log.times])
    np.testing.assert_allclose(log.odom_poses, wanted, atol=1e-9)
    assert log.notes == ()


def test_odometry_that_restarts_goes_on_where_it_was(tmp_path):
    start = true_pose(30.5)

    def anew(t):
        return true_pose(t) if t < 31 else relative(start, true_pose(t))

    log = carmen.read(save(tmp_path / "a.clf", drive(anew, anew)))
    moved = relative(log.odom_poses[:-1], log.odom_poses[1:])
    wanted = np.array([relative(true_pose(t), true_pose(t + 1)) for t in log.times[:-1]])
    assert np.abs(moved[32:] - wanted[32:]).max() < 0.01
    assert np.hypot(*moved[29:32, :2].T).max() < 1.1  # it stood still for half a second
    assert len(log.notes) == 1 and "restarts (1 x)" in log.notes[0]
    alone = [line for line in drive(anew, anew) if line.startswith("FLASER")]
    log = carmen.read(save(tmp_path / "b.clf", alone))
    assert len(log.notes) == 1 and np.hypot(*np.diff(log.odom_poses, axis=0).T[:2]).max() < 1.1


def test_keyframes_far_apart_without_stamps_are_no_jumps(tmp_path):
    lines = [flaser(0, pose=true_pose(3.0 * t)) for t in range(40)]
    log = carmen.read(save(tmp_path / "a.clf", lines))
    assert log.has_odometry and len(log.notes) == 1 and "s apart" in log.notes[0]
    np.testing.assert_allclose(log.odom_poses, [true_pose(3.0 * t) for t in range(40)])


def test_odometry_that_jumps_all_the_time_is_none(tmp_path):

    def thrown(t):
        return np.array([100 * np.sin(t * t), 0.0, 0.0])

    log = carmen.read(save(tmp_path / "a.clf", drive(thrown, thrown)))
    assert not log.has_odometry and "it jumps" in log.notes[0]


def test_logs_of_real_robots_need_no_odometry_repair(shared_data):
    for name in ("aces/aces", "freiburg-101/freiburg-101"):
        assert carmen.read(shared_data / f"{name}.clf").notes == ()
    notes = carmen.read(shared_data / "intel" / "intel.clf").notes
    assert len(notes) == 1 and "run backwards at 4 of 910" in notes[0]
