import numpy as np
import pytest

from experiments import drive_records, hurt_logs
from experiments.damaged_drives import simulate
from experiments.drive_records import DriveRecord
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, dead_reckoning, increments, relative
from jaxslam.io import readers

T, R = 120, 36
LIDAR = Lidar(R, -np.pi / 2, np.pi / R, 20.0, 0.02)


@pytest.fixture
def log():
    """Twice as much odometry as scans; forwards, backwards, with turns of a radian now and then."""
    rng = np.random.default_rng(0)
    steps = np.tile([0.1, 0.0, 0.02], (2 * T, 1))
    steps[60:90, 0] = -0.1
    steps[[30, 110, 190], 2] = 1.0
    steps[0] = 0.0
    poses, times = dead_reckoning(np.array([1.0, -2.0, 0.5]), steps), 1e9 + 0.1 * np.arange(2 * T)
    ranges = np.round(rng.uniform(1.0, 25.0, (T, R)), 3)
    return LaserLog.from_arrays(
        times[::2],
        poses[::2],
        ranges,
        LIDAR,
        odom_stream_times=times,
        odom_stream_poses=poses,
    )


@pytest.fixture
def record(log):
    return DriveRecord.of_log(log)


@pytest.fixture
def hurt(record):
    return lambda how, seed=3: hurt_logs.hurt(how, seed, record)


def read(path, record):
    drive_records.write(path, record)
    return readers.read_log(path)


def equal(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("how", hurt_logs.FAULTS)
def test_a_fault_depends_on_its_seed_alone_and_leaves_the_record_as_it_is(how, hurt, record):
    before = [np.copy(x) for x in record]
    first, again, other = hurt(how), hurt(how), hurt(how, 4)
    assert equal(first, again) and equal(before, record)
    assert equal(first, other) == (how not in hurt_logs.RANDOM)
    assert equal(first, record) == (how == hurt_logs.UNHURT)


@pytest.mark.parametrize("how", hurt_logs.FAULTS)
def test_shapes_fit_and_scans_keep_their_numbers(how, hurt, record):
    found = hurt(how)
    scans, messages = len(found.number), len(found.stream_stamps)
    assert found.odom_poses.shape == (scans, 3) and found.stamps.shape == (scans,)
    assert found.ranges.shape == (scans, R) and found.stream_poses.shape == (messages, 3)
    assert sorted(found.order) == list(range(scans + messages))
    assert (np.diff(found.number) > 0).all()
    if how not in ("missing", "people"):
        np.testing.assert_array_equal(found.ranges, record.ranges[found.number])
    if not how.startswith("stamps"):
        np.testing.assert_array_equal(found.stamps, record.stamps[found.number])


@pytest.mark.parametrize("how", hurt_logs.FAULTS)
def test_readers_take_every_fault_and_the_scans_are_found_again(how, hurt, tmp_path):
    found = hurt(how)
    log = read(tmp_path / "a.clf", found)
    numbers = drive_records.numbers_of(found, log)
    assert len(log.times) == len(numbers) > 0.7 * T
    index = np.searchsorted(found.number, numbers)
    expected = np.where(found.ranges < 20.0, found.ranges, np.inf)[index]
    np.testing.assert_allclose(log.ranges, expected, atol=1e-3)


def test_a_log_is_written_as_it_was(log, record, tmp_path):
    found = read(tmp_path / "a.clf", record)
    assert (tmp_path / "a.clf").read_text().startswith("ODOM")
    for name in ("times", "odom_poses", "odom_stream_times", "odom_stream_poses"):
        np.testing.assert_allclose(getattr(found, name), getattr(log, name), atol=2e-6)
    np.testing.assert_allclose(found.ranges, log.ranges, atol=1e-3)
    assert found.lidar == log.lidar and found.notes == ()


def test_scanners_that_are_no_half_circle_are_written_too(record, tmp_path):
    lidar = Lidar(R, -3.0, 0.15, 8.0, 0.02)
    ranges = np.where(record.ranges < 8.0, record.ranges, np.inf)
    found = read(tmp_path / "a.clf", record._replace(lidar=lidar, ranges=ranges))
    np.testing.assert_allclose(found.lidar, lidar, atol=1e-6)
    np.testing.assert_allclose(found.ranges, ranges, atol=1e-3)


def test_scans_that_a_reader_left_out_are_missed_by_number(log, record):
    kept = np.delete(np.arange(T), [0, 5, 6, T - 1])
    part = log._replace(times=log.times[kept], ranges=log.ranges[kept])
    np.testing.assert_array_equal(drive_records.numbers_of(record, part), kept)
    with pytest.raises(ValueError, match="not in the recording"):
        part = part._replace(ranges=part.ranges[::-1])
        drive_records.numbers_of(record, part)


def lines(record):
    """Stamps of odometry and scans in the order of the file."""
    return np.concatenate([record.stream_stamps, record.stamps])[record.order]


def test_stamps_of_all_lines_have_the_fault(hurt, record):
    was = lines(record)
    assert (np.diff(was) >= 0.0).all() and len(was) == 3 * T
    assert not lines(hurt("stamps-zero")).any()
    assert 0.03 < np.mean(lines(hurt("stamps-some-zero")) == 0.0) < 0.2
    assert len(set(lines(hurt("stamps-constant")))) == 1
    np.testing.assert_array_equal(lines(hurt("stamps-coarse")), np.floor(was))
    late = was - lines(hurt("stamps-back"))
    assert 0.0 <= late.min() and 0.2 < late.max() < 1.0 and 0.0 < np.mean(late > 0.0) < 0.08
    back = was - lines(hurt("stamps-set-back"))
    assert set(np.round(back)) == {0.0, 600.0} and (np.diff(back) >= 0.0).all()


def test_unsigned_wheels_do_not_turn_back(hurt, record):
    was, now = increments(record.odom_poses), increments(hurt("unsigned").odom_poses)
    assert was[:, 0].min() < -0.1 and now[:, 0].min() >= -1e-9
    np.testing.assert_allclose(now[:, 0], np.abs(was[:, 0]), atol=1e-9)
    np.testing.assert_allclose(now[:, 1:], was[:, 1:], atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("num_scans, count", [(120, 7), (21, 100), (6, 1)])
def test_spans_never_overlap(seed, num_scans, count):
    spans = hurt_logs.draw_spans(np.random.default_rng(seed), num_scans, count, (2, 3, 4))
    assert len(spans) == min(count, (num_scans - 1) // 4)
    assert spans.min() >= 0 and spans.max() < num_scans
    assert set(spans[:, 1] - spans[:, 0]) <= {2, 3, 4}
    assert (spans[1:, 0] >= spans[:-1, 1]).all()


def test_latched_poses_are_old_ones_and_right_again_after_the_leap(hurt, record):
    found, was = hurt("latched").odom_poses, record.odom_poses
    stale = np.flatnonzero((found != was).any(axis=1))
    assert 7 <= len(stale) <= 21
    for k in stale:
        np.testing.assert_array_equal(found[k], found[k - 1])
    runs = np.split(stale, np.flatnonzero(np.diff(stale) > 1) + 1)
    assert {len(run) for run in runs} <= {1, 2, 3}
    for run in runs:
        np.testing.assert_array_equal(found[run[-1] + 1], was[run[-1] + 1])
        np.testing.assert_array_equal(found[run], np.tile(was[run[0] - 1], (len(run), 1)))


def test_lost_turns_are_missed_by_the_wheels_alone(hurt, record):
    was, now = increments(record.odom_poses), increments(hurt("lost").odom_poses)
    gone = np.flatnonzero(np.abs(now - was).max(axis=1) > 1e-9)
    assert len(gone) == 9 and np.abs(now[gone]).max() < 1e-9  # three turns of a radian
    assert np.abs(was[gone, 2]).reshape(3, 3).sum(axis=1).min() >= hurt_logs.LOST_TURN


def test_odometry_that_stands_still_moves_a_millimetre(hurt, record):
    found = hurt("still").odom_poses
    np.testing.assert_allclose(np.hypot(*(found - found[0])[:, :2].T), [0] + [1e-3] * (T - 1))
    assert (found[:, 2] == record.odom_poses[0, 2]).all()


def test_a_carried_robot_jumps_and_its_wheels_do_not(hurt, record):
    found = hurt("carried")
    jump = np.flatnonzero(np.diff(found.number) > 1)
    assert len(jump) == 1 and len(found.number) == T - 24
    before, after = found.odom_poses[jump[0]], found.odom_poses[jump[0] + 1]
    np.testing.assert_allclose(after, before, atol=1e-9)
    assert T // 4 <= jump[0] + 1 and found.number[jump[0] + 1] <= 3 * T // 4
    true = relative(*record.odom_poses[found.number[[jump[0], jump[0] + 1]]])
    assert np.hypot(*true[:2]) > 0.1
    rest = np.delete(increments(found.odom_poses)[1:], jump[0], axis=0)
    expected = np.delete(increments(record.odom_poses[found.number])[1:], jump[0], axis=0)
    np.testing.assert_allclose(rest, expected, atol=1e-9)


def test_wheels_that_slipped_miss_metres_that_no_scan_shows(hurt, record):
    found = hurt("slipped")
    jump = np.flatnonzero(np.diff(found.number) > 1)
    assert len(jump) == 1
    true = relative(*record.odom_poses[found.number[[jump[0], jump[0] + 1]]])
    wheels = relative(*found.odom_poses[[jump[0], jump[0] + 1]])
    np.testing.assert_allclose(wheels, true * [0.25, 0.25, 1.0], atol=1e-9)
    rest = np.delete(increments(found.odom_poses)[1:], jump[0], axis=0)
    expected = np.delete(increments(record.odom_poses[found.number])[1:], jump[0], axis=0)
    np.testing.assert_allclose(rest, expected, atol=1e-9)


def test_scale_is_that_of_distances_and_of_turns(hurt, record):
    was, now = increments(record.odom_poses), increments(hurt("scale").odom_poses)
    np.testing.assert_allclose(now, was * [1.05, 1.05, 0.96], atol=1e-9)


def test_poses_of_a_robot_are_those_of_its_scanner_without_the_mount(hurt, record):
    scanner = compose(hurt("mount").odom_poses, np.array([0.25, 0.0, np.radians(3.0)]))
    np.testing.assert_allclose(scanner, record.odom_poses, atol=1e-9)


def test_missing_beams_and_scans_are_as_many_as_they_should(hurt, record):
    found = hurt("missing").ranges
    gone = np.isinf(found)
    share = gone.mean(axis=1) - np.isinf(record.ranges).mean(axis=1) * 0.7
    assert 0.2 < share.mean() < 0.5 and (gone | (found == record.ranges)).all()
    assert gone.mean(axis=1).min() >= 0.3
    kept = hurt("dropped").number
    assert 0.8 < len(kept) / T <= 0.9 and kept[0] == 0
    np.testing.assert_array_equal(hurt("dropped").odom_poses, record.odom_poses[kept])


def test_people_only_shorten_ranges(hurt, record):
    found = hurt("people").ranges
    shorter = found < record.ranges - 1e-6
    assert 0.02 < shorter.mean() < 0.6 and (found <= record.ranges + 1e-6).all()
    assert found[shorter].max() < 6.0


def test_a_fifth_of_a_simulated_drive_is_backwards():
    drive = simulate(1, reversing=True)
    ahead = increments(drive.poses)[1:, 0]
    distance = np.abs(ahead)
    assert 0.15 < distance[ahead < -1e-9].sum() / distance.sum() < 0.25
    assert distance.max() < 0.75
    record = DriveRecord.of_drive(np.random.default_rng(0), drive)
    assert record.lidar.range_max <= 20.0 and (np.diff(record.stamps) >= 0.1 - 1e-6).all()
    wheels = increments(record.odom_poses)[1:, 0]
    assert np.mean(np.sign(wheels[distance > 0.01]) == np.sign(ahead[distance > 0.01])) > 0.99
