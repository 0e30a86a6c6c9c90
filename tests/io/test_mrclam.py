import cmath
import math
import time

import numpy as np
import pytest

from jaxslam.io import mrclam
from jaxslam.io.errors import InputError

START = 1248444187.125  # [s] as in the data sets: a float32 would know it to two minutes

GOOD = {
    "Barcodes.dat": "# Subject Barcode\n 1  5\n 2 14\n 6 63\n 7 81\n 9 70\n",
    "Landmark_Groundtruth.dat": "# s x y sx sy\n6 1 2 0 0\n 9 -3 4.5 0 0\n7 0.5 -1 0 0\n",
    "Robot1_Odometry.dat": [(0, 0.5, 0.0), (2, 0.25, 0.5), (4, 0, 0), (5, 0, 0)],
    "Robot1_Measurement.dat": [(0.5, 70, 2.5, 0.25), (1, 63, 1.5, -0.5), (1, 81, 3, 0.5)],
    "Robot1_Groundtruth.dat": [(0.1 * i, 0.05 * i, 1, 0.5) for i in range(60)],
}


def save(folder, **changes):
    """The folder of a small data set in which `Robot1_x=...` replaces a table, None leaves out."""
    folder.mkdir(exist_ok=True)
    changed = {f"{name}.dat": content for name, content in changes.items()}
    for name, content in (GOOD | changed).items():
        if isinstance(content, list):
            lines = [f"{START + t:.3f} \t " + " ".join(map(str, rest)) for t, *rest in content]
            content = "\n".join(["# UTIAS", "# Time [s]", *lines, ""])
        if content is not None:
            (folder / name).write_text(content)
    return folder


def complaint(path, *given, **options):
    """The reader's complaint, which must be one line that begins with the file or folder."""
    with pytest.raises(InputError) as caught:
        mrclam.read(path, *(given or [1]), **options)
    text = str(caught.value)
    assert "\n" not in text and text.startswith(str(path))
    return text.removeprefix(str(path))


def slow_poses(odometry, times, *, hold=math.inf, part=0.01):
    """Poses (T, 3) at `times`, by the midpoint rule over short parts of time; zero at the first."""
    begins = [t for t, *_ in odometry[1:]] + [math.inf]  # of the line after
    place, heading, now, line, poses = 0j, 0.0, times[0], 0, []
    for time_of_step in times:
        while now < time_of_step:
            while begins[line] <= now:
                line += 1
            t, v, omega = odometry[line]
            stops = t + hold if now < t + hold else math.inf
            until = min(time_of_step, begins[line], stops, now + part)
            if now < t + hold:
                turn = omega * (until - now)
                place += v * (until - now) * cmath.exp(1j * (heading + turn / 2))
                heading += turn
            now = until
        poses.append((place.real, place.imag, heading))
    return np.array(poses)


def chained(motion):
    """Poses (T, 3) that motions (T, 3) lead to, by composition."""
    poses = [np.zeros(3)]
    for x, y, turn in motion[1:]:
        a, b, heading = poses[-1]
        c, s = math.cos(heading), math.sin(heading)
        poses.append(np.array([a + c * x - s * y, b + s * x + c * y, heading + turn]))
    return np.array(poses)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def test_reads_every_value(tmp_path):
    drive = mrclam.read(save(tmp_path / "a"), 1)
    np.testing.assert_array_equal(drive.times, [START + 0.5, START + 1])
    np.testing.assert_allclose(drive.odometry, [[0, 0, 0], [0.25, 0, 0]], atol=1e-12)
    np.testing.assert_array_equal(drive.valid, [[True, False], [True, True]])
    np.testing.assert_array_equal(drive.landmark_index, [[1, -1], [0, 2]])
    np.testing.assert_array_equal(
        drive.range_bearing, [[[2.5, 0.25], [0, 0]], [[1.5, -0.5], [3, 0.5]]]
    )
    np.testing.assert_allclose(drive.truth, [[0.25, 1, 0.5], [0.5, 1, 0.5]], atol=1e-6)
    assert drive.truth_mask.all() and drive.num_skipped == 0
    np.testing.assert_array_equal(drive.landmark_names, [6, 9, 7])
    np.testing.assert_array_equal(drive.landmark_positions, [[1, 2], [-3, 4.5], [0.5, -1]])
    names = "times odometry truth landmark_positions range_bearing landmark_index landmark_names"
    kinds = (names + " valid truth_mask").split()
    types = [np.float64] * 4 + [np.float32] + [np.int32] * 2 + [np.bool_] * 2
    assert [getattr(drive, kind).dtype for kind in kinds] == types


def test_robots_are_no_landmarks_and_what_cannot_be_is_counted(tmp_path):
    seen = [
        (0.4, 14, 1.0, 0.0),  # another robot, alone: no step
        (0.5, 70, 2.5, 0.25),
        (0.5, 14, 1.0, 0.0),  # another robot
        (0.5, 99, 1.0, 0.0),  # nobody's bar code
        (0.5, 63.5, 1.0, 0.0),  # no bar code at all
        (0.5, 70, 7.0, 0.75),  # a second time
        (0.9, 99, 1.0, 0.0),  # alone: no step
        (1, 70, 2.0, 0.5),
    ]
    drive = mrclam.read(save(tmp_path / "a", Robot1_Measurement=seen), 1)
    np.testing.assert_array_equal(drive.times, [START + 0.5, START + 1])
    np.testing.assert_array_equal(drive.landmark_index, [[1], [1]])
    np.testing.assert_array_equal(drive.range_bearing, [[[2.5, 0.25]], [[2.0, 0.5]]])
    assert drive.num_skipped == 4


def test_a_robot_can_be_read_without_reference(tmp_path):
    folder = save(tmp_path / "a", Robot1_Groundtruth=None)
    drive, other = mrclam.read(folder, 1), mrclam.read(save(tmp_path / "b"), 1)
    assert not drive.truth_mask.any() and not drive.truth.any()
    names = "times odometry range_bearing valid landmark_index landmark_positions landmark_names"
    for name in names.split():
        np.testing.assert_array_equal(getattr(drive, name), getattr(other, name))


def test_measurements_at_the_first_and_the_last_line_of_odometry_count(tmp_path):
    seen = [(t, 63, 1.0, 0.0) for t in (-0.001, 0, 5, 5.001)]
    drive = mrclam.read(save(tmp_path / "a", Robot1_Measurement=seen), 1, max_gap=math.inf)
    np.testing.assert_array_equal(drive.times, [START, START + 5])
    turn = 0.5 * mrclam.MAX_HOLD
    far = 0.5 * mrclam.MAX_HOLD + 0.5 * math.sin(turn)
    motion = far, 0.5 - 0.5 * math.cos(turn), turn
    np.testing.assert_allclose(drive.odometry, [(0, 0, 0), motion], atol=1e-9)


def random_log(seed, count=80):
    """Odometry with uneven and equal times, and measurements that do not meet them."""
    rng = np.random.default_rng(seed)
    t = np.round(np.cumsum(rng.choice([0.0, 0.01, 0.25, 0.8], count)), 3)
    odometry = np.column_stack([t, rng.uniform(-0.5, 1, count), rng.normal(0, 1.5, count)])
    odometry[::5, 2] = 0.0
    when = np.unique(np.round(rng.uniform(-1, t[-1] + 1, count), 3))
    return odometry.tolist(), [(s, 63, 1.0, 0.0) for s in when.tolist()]


@pytest.mark.parametrize("seed", range(3))
def test_motion_is_that_of_a_slow_integration(tmp_path, seed):
    odometry, seen = random_log(seed)
    folder = save(
        tmp_path / "a",
        Robot1_Odometry=odometry,
        Robot1_Measurement=seen,
        Robot1_Groundtruth=None,
    )
    drive = mrclam.read(folder, 1, max_gap=math.inf)
    within = [t for t, *_ in seen if odometry[0][0] <= t <= odometry[-1][0]]
    np.testing.assert_allclose(drive.times - START, within, atol=1e-6)
    expected = slow_poses([tuple(line) for line in odometry], within, part=0.001)
    expected -= [0, 0, expected[0, 2]]
    np.testing.assert_allclose(chained(drive.odometry), expected, atol=2e-5)
    assert not drive.odometry[0].any() and np.abs(drive.odometry[1:]).max() > 0.5
    finer = mrclam.read(folder, 1, max_gap=0.05)
    steps = np.searchsorted(finer.times, drive.times)
    np.testing.assert_allclose(chained(finer.odometry)[steps], chained(drive.odometry), atol=1e-9)


def test_a_whole_circle_comes_home(tmp_path):
    lines = [(0, 0.1, 0.0), (1, 0.5, math.pi), (2, 0.5, math.pi), (3, 0, 0)]
    seen = [(t, 63, 1.0, 0.0) for t in (1, 2, 3)]
    folder = save(tmp_path / "a", Robot1_Odometry=lines, Robot1_Measurement=seen)
    motion = mrclam.read(folder, 1, max_gap=9).odometry
    np.testing.assert_allclose(motion[1:], [[0, 1 / math.pi, math.pi]] * 2, atol=1e-12)
    folder = save(tmp_path / "a", Robot1_Odometry=lines, Robot1_Measurement=seen[::2])
    motion = mrclam.read(folder, 1, max_gap=9).odometry
    np.testing.assert_allclose(motion[1], [0, 0, 2 * math.pi], atol=1e-12)


def test_where_the_log_is_silent_the_robot_stops(tmp_path):
    lines = [(0, 0.5, 0.0), (1, 0.5, 0.2), (9, 0.25, 0.0), (10, 0.0, 0.0)]
    seen = [(t, 63, 1.0, 0.0) for t in (1, 2, 2.5, 8.5, 9.5)]
    folder = save(tmp_path / "a", Robot1_Odometry=lines, Robot1_Measurement=seen)
    drive = mrclam.read(folder, 1, max_gap=math.inf)
    np.testing.assert_allclose(
        drive.odometry[:, 2], [0, 0.2, 0.2 * (mrclam.MAX_HOLD - 1), 0, 0], atol=1e-9
    )
    expected = slow_poses(lines, [1, 2, 2.5, 8.5, 9.5], hold=mrclam.MAX_HOLD)
    np.testing.assert_allclose(chained(drive.odometry), expected, atol=1e-6)


def test_no_step_is_longer_than_asked_and_none_misses_motion_to_and_fro(tmp_path):
    lines = [(0, 0, 0.0), (1, 0, 0.5), (2, 0, 0.5), (3, 0, -0.5), (4, 0, -0.5), (5, 0, 0)]
    seen = [(0.5, 63, 1.0, 0.0), (0.9, 63, 1.0, 0.0), (5, 70, 1.0, 0.0)]
    folder = save(tmp_path / "a", Robot1_Odometry=lines, Robot1_Measurement=seen)
    drive = mrclam.read(folder, 1, max_gap=1.1)
    np.testing.assert_allclose(drive.times - START, [0.5, 0.9, 1.925, 2.95, 3.975, 5], atol=1e-6)
    np.testing.assert_array_equal(drive.valid.sum(1), [1, 1, 0, 0, 0, 1])
    turns = mrclam.read(folder, 1, max_gap=0.3).odometry[:, 2]
    assert abs(turns.sum()) < 1e-9 and np.abs(turns).sum() == pytest.approx(2.0, abs=0.3)
    coarse = mrclam.read(folder, 1, max_gap=math.inf)
    assert coarse.times.size == 3 and np.abs(coarse.odometry[:, 2]).sum() < 1e-9
    for longest in (0.01, 0.3, 1.0):
        gaps = np.diff(mrclam.read(folder, 1, max_gap=longest).times)
        assert gaps.min() > 0.0 and gaps.max() <= longest + 1e-6


def test_reference_is_interpolated_by_the_shorter_turn_and_not_over_gaps(tmp_path):
    poses = [(1, 0, 0, 3.1), (1.2, 2, -4, -3.1), (1.5, 3, 3, 0), (1.6, 4, 5, 1)]
    when = (0.5, 0.9, 1.05, 1.15, 1.2, 1.35, 1.5, 1.575, 1.7)
    seen = [(t, 63, t, 0.0) for t in when]
    folder = save(tmp_path / "a", Robot1_Groundtruth=poses, Robot1_Measurement=seen)
    drive = mrclam.read(folder, 1)
    np.testing.assert_allclose(drive.times - START, when[2:], atol=1e-6)
    np.testing.assert_allclose(drive.range_bearing[:, 0, 0], when[2:], rtol=1e-6)
    assert not drive.odometry[0].any() and drive.truth_mask[0]
    np.testing.assert_array_equal(drive.truth_mask, [True] * 3 + [False] + [True] * 2 + [False])
    gap = 2 * math.pi - 6.2
    truth = [
        (0.5, -1, 3.1 + gap / 4),
        (1.5, -3, -3.1 - gap / 4),
        (2, -4, -3.1),
        (0, 0, 0),
        (3, 3, 0),
        (3.75, 4.5, 0.75),
        (0, 0, 0),
    ]
    np.testing.assert_allclose(drive.truth[:, :2], np.array(truth)[:, :2], atol=2e-5)
    np.testing.assert_allclose(wrapped(drive.truth[:, 2] - np.array(truth)[:, 2]), 0, atol=2e-5)
    assert (np.abs(drive.truth[:, 2]) <= math.pi).all()


def test_padding_is_invisible(tmp_path):
    crowd = [(1.5, code, 9.0, 0.125) for code in (63, 81, 70)]
    seen = GOOD["Robot1_Measurement.dat"]
    few = mrclam.read(save(tmp_path / "a"), 1)
    many = mrclam.read(save(tmp_path / "b", Robot1_Measurement=[*seen, *crowd]), 1)
    assert few.valid.shape == (2, 2) and many.valid.shape == (3, 3)
    for drive in (few, many):
        assert (np.diff(drive.valid.astype(int), axis=1) <= 0).all()  # padding comes last
        assert (drive.landmark_index[~drive.valid] == -1).all()
        assert not drive.range_bearing[~drive.valid].any()
        assert (drive.landmark_index[drive.valid] >= 0).all()
        assert (drive.range_bearing[drive.valid][:, 0] > 0).all()
    for name in ("range_bearing", "valid", "landmark_index"):
        np.testing.assert_array_equal(getattr(many, name)[:2, :2], getattr(few, name))
    assert not many.valid[:2, 2].any()


def test_robots_of_a_folder(tmp_path):
    folder = save(tmp_path / "a", Robot12_Odometry="", Robot2_Odometry="", RobotX_Odometry="")
    save(folder, Robot3_Measurement="", Robot02_Odometry="")
    assert mrclam.robots(folder) == mrclam.robots(str(folder)) == [1, 2, 12]
    assert complaint(folder, 3) == ": has no robot 3; choose from 1, 2, 12"
    assert complaint(tmp_path / "none").startswith(": does not exist; name the folder")
    assert complaint(folder / "Barcodes.dat").startswith(": is no folder; name the folder")
    (tmp_path / "b").mkdir()
    assert complaint(tmp_path / "b").startswith(": holds no RobotN_Odometry.dat; name the folder")


ODOMETRY, SEEN, POSES = (
    GOOD[f"Robot1_{k}.dat"] for k in ("Odometry", "Measurement", "Groundtruth")
)
CODES, PLACES = GOOD["Barcodes.dat"], GOOD["Landmark_Groundtruth.dat"]
BAD = {
    "a field less": ("Robot1_Odometry", [*ODOMETRY[:2], (3, 0.5)], ":5: 2 fields instead of 3"),
    "a field more": ("Robot1_Measurement", [(*SEEN[0], 7), SEEN[1]], ":3: 5 fields instead of 4"),
    "fields less throughout": ("Robot1_Odometry", [(0, 1), (1, 1)], ":3: 2 fields instead of 3"),
    "a word": ("Robot1_Groundtruth", [*POSES, (7, 1, "x", 0)], ":63: y: 'x' is not a number"),
    "NaN": ("Robot1_Measurement", [*SEEN, (3, 63, 1, "nan")], ":6: bearing: nan is not finite"),
    "infinity": ("Robot1_Odometry", [(0, "inf", 0)], ":3: v: inf is not finite"),
    "time of odometry": ("Robot1_Odometry", [*ODOMETRY, (4.9, 0, 0)], ":7: t: runs backwards"),
    "time of measurements": ("Robot1_Measurement", SEEN[::-1], ":5: t: runs backwards"),
    "time of poses": ("Robot1_Groundtruth", [*POSES, (1, 0, 0, 0)], ":63: t: runs backwards"),
    "negative range": ("Robot1_Measurement", [(1, 14, -2, 0)], ":3: range: is not positive"),
    "no range": ("Robot1_Measurement", [*SEEN, (2, 63, 0, 0)], ":6: range: is not positive"),
    "a bar code twice": ("Barcodes", CODES + "10 5\n", ":7: barcode: is not an integer, or occurs"),
    "a subject twice": ("Barcodes", CODES + "6 44\n", ":7: subject: is not an integer, or occurs"),
    "part of a subject": ("Barcodes", CODES + "6.5 44\n", ":7: subject: is not an integer"),
    "a huge bar code": ("Barcodes", CODES + "10 1e300\n", ":7: barcode: is not an integer"),
    "a landmark twice": (
        "Landmark_Groundtruth",
        PLACES + "6 1 2 0 0\n",
        ":5: subject: is not an integer",
    ),
    "only comments": ("Robot1_Measurement", [], ": holds only comments"),
    "empty": ("Barcodes", "", ": is empty"),
    "no landmark": (
        "Robot1_Measurement",
        [(1, 14, 1, 0)],
        ": no landmark is measured within the time of the odometry",
    ),
    "too early": (
        "Robot1_Measurement",
        [(-1, 63, 1, 0)],
        ": no landmark is measured within the time of the odometry",
    ),
    "too late": (
        "Robot1_Measurement",
        [(5.1, 63, 1, 0)],
        ": no landmark is measured within the time of the odometry",
    ),
    "another clock": ("Robot1_Groundtruth", [(99, 0, 0, 0)], ": has no pose at any time at which"),
    "too few poses": ("Robot1_Groundtruth", POSES[::20], ": has no pose at any time at which"),
}


@pytest.mark.parametrize("name, content, reason", BAD.values(), ids=BAD.keys())
def test_a_bad_table_is_named_with_its_line(tmp_path, name, content, reason):
    folder = save(tmp_path / "a")
    mrclam.read(folder, 1)
    text = complaint(save(folder, **{name: content}))
    assert text.startswith(f"/{name}.dat{reason}") and "; " in text


@pytest.mark.parametrize("name", ["Barcodes", "Landmark_Groundtruth", "Robot1_Measurement"])
def test_a_missing_table(tmp_path, name):
    folder = save(tmp_path / "a", **{name: None})
    assert complaint(folder) == f"/{name}.dat: does not exist; check the name"


@pytest.mark.parametrize("longest", [0.0, -1.0, 0.001, math.nan])
def test_impossible_step(tmp_path, longest):
    with pytest.raises(InputError, match="longest .* give at least"):
        mrclam.read(save(tmp_path / "a"), 1, max_gap=longest)


def plain(path):
    """Numbers of a table, as simply as possible."""
    lines = [line.split() for line in path.read_text().splitlines()]
    return [[float(field) for field in fields] for fields in lines if fields[0][0] != "#"]


@pytest.mark.parametrize("robot", [1, 2, 3, 4, 5])
def test_recorded_drives(shared_data, robot):
    folder = shared_data / "mrclam-6"
    assert mrclam.robots(folder) == [1, 2, 3, 4, 5]
    began = time.perf_counter()
    drive = mrclam.read(folder, robot)
    assert time.perf_counter() - began < 5.0  # some 0.25 s on an idle machine
    assert drive.num_skipped == [1, 0, 2, 3, 0][robot - 1]
    gaps = np.diff(drive.times)
    assert gaps.min() > 5e-4 and gaps.max() <= 1.0 + 1e-6

    subject = {code: int(subject) for subject, code in plain(folder / "Barcodes.dat")}
    seen = plain(folder / f"Robot{robot}_Measurement.dat")
    last = plain(folder / f"Robot{robot}_Odometry.dat")[-1][0]
    seen = [s for s in seen if subject.get(s[1], 0) > 5 and drive.times[0] <= s[0] <= last]
    step, slot = np.nonzero(drive.valid)
    np.testing.assert_array_equal(drive.times[step], [s[0] for s in seen])
    names = drive.landmark_names[drive.landmark_index[step, slot]]
    np.testing.assert_array_equal(names, [subject[s[1]] for s in seen])
    np.testing.assert_array_equal(
        drive.range_bearing[step, slot], np.float32([s[2:] for s in seen])
    )

    known = drive.truth_mask[step]
    pose, polar = drive.truth[step[known]], drive.range_bearing[step, slot][known]
    angle = pose[:, 2] + polar[:, 1]
    found = pose[:, :2] + polar[:, :1] * np.column_stack([np.cos(angle), np.sin(angle)])
    position = drive.landmark_positions[drive.landmark_index[step, slot][known]]
    error = np.hypot(*(found - position).T)
    assert np.median(error) < 0.16 and np.percentile(error, 95) < 0.5
    bearing = np.arctan2(*(position - pose[:, :2]).T[::-1])
    assert np.median(np.abs(wrapped(bearing - angle))) < 0.02

    both = drive.truth_mask[1:] & drive.truth_mask[:-1]  # odometry and cameras agree
    distance = np.hypot(*np.diff(drive.truth[:, :2], axis=0).T)
    far, turn = np.hypot(*drive.odometry[1:, :2].T), np.diff(drive.truth[:, 2])
    assert distance[both].sum() == pytest.approx(far[both].sum(), rel=0.15)
    assert np.corrcoef(wrapped(turn)[both], drive.odometry[1:, 2][both])[0, 1] > 0.85


def test_a_recorded_drive_has_the_motion_of_a_slow_integration(shared_data):
    folder = shared_data / "mrclam-6"
    drive = mrclam.read(folder, 4)
    lines = plain(folder / "Robot4_Odometry.dat")
    begin = drive.times[0]
    lines = [(t - begin, v, omega) for t, v, omega in lines]
    poses = slow_poses(lines, (drive.times - begin).tolist(), part=0.1)
    np.testing.assert_allclose(chained(drive.odometry), poses, atol=1e-3)


def test_recorded_reference_has_gaps(shared_data):
    folder = shared_data / "mrclam-6"
    drive = mrclam.read(folder, 4)
    poses = plain(folder / "Robot4_Groundtruth.dat")
    gaps = [(a[0], b[0]) for a, b in zip(poses, poses[1:], strict=False) if b[0] - a[0] > 0.2]
    assert len(gaps) == 7 and max(b - a for a, b in gaps) == pytest.approx(2.03, abs=0.001)
    inside = np.zeros(drive.times.size, bool)
    for a, b in gaps:
        inside |= (drive.times > a) & (drive.times < b)
    assert inside.sum() >= 2
    np.testing.assert_array_equal(drive.truth_mask, ~inside & (drive.times <= poses[-1][0]))
