"""The same drive read through every layout, right and wrong, gives the same log."""

import layouts
import numpy as np
import pytest
from layouts import LAYOUTS, STREAMS, true_poses, true_ranges, true_times

from jaxslam.core.se2_np import compose
from jaxslam.io import readers
from jaxslam.io.errors import InputError


def read(tmp_path, name, said=None, **options):
    tmp_path.mkdir(exist_ok=True)
    path = LAYOUTS[name](tmp_path / name, layouts.messages() if said is None else said)
    return readers.read_log(path, range_max=12.0, **options)


def assert_drive(log, *, times=True, atol=1e-6):
    """The log is that of the drive, which starts at zero."""
    np.testing.assert_array_equal(log.ranges, true_ranges())
    np.testing.assert_allclose(log.lidar[:3], layouts.LIDAR[:3], rtol=1e-6)
    np.testing.assert_allclose(log.odom_poses, true_poses(), atol=atol)
    assert (np.diff(log.times) > 0).all() and log.has_odometry
    if times:
        np.testing.assert_allclose(log.times, true_times(), atol=1e-6)


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_gives_the_same_log(tmp_path, name):
    log = read(tmp_path, name)
    assert_drive(log)
    assert [note for note in log.notes if "no transform" not in note] == []
    assert not log.odometry_guessed.any() and log.num_skipped == 0


def changed(change, kinds=("scan", "odometry")):
    """The messages with other stamps: `change` of the own stamp and the number of the message."""
    return [
        m._replace(own=change(m.own, i)) if m.kind in kinds else m
        for i, m in enumerate(layouts.messages())
    ]


def also_received(said):
    return [m._replace(received=m.own) for m in said]


WRONG = {
    "zero": lambda own, _: 0.0,
    "six digits": lambda own, _: float(f"{own:.6g}"),
    "whole seconds": lambda own, _: float(int(own)),
    "set back": lambda own, i: own - 5.0 * (i > 90),
    "partly zero": lambda own, i: 0.0 if i % 4 == 0 else own,
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", [name for name in LAYOUTS if name not in ("one.bag", "two")])
def test_stamps_that_cannot_be_used_change_nothing_but_the_times(tmp_path, name, wrong):
    """Where a file has one stamp alone, its order takes the place of time."""
    log = read(tmp_path, name, also_received(changed(WRONG[wrong])))
    own_poses = name not in STREAMS
    assert_drive(log, times=False, atol=1e-6 if own_poses else 0.07)
    assert any("time stamps" in note for note in log.notes)


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", ["carmen.clf", "bare.clf", "one.bag", "two"])
def test_times_of_reception_take_the_place_of_stamps(tmp_path, name, wrong):
    log = read(tmp_path, name, changed(WRONG[wrong]))
    assert_drive(log, atol=0.07)
    assert any("time stamps" in note for note in log.notes)


@pytest.mark.parametrize("name", ["bare.clf", "one.bag", "two"])
@pytest.mark.parametrize("behind", [3.0, -40.0, 1e9])
def test_a_clock_of_the_scanner_that_is_off_is_found(tmp_path, name, behind):
    log = read(tmp_path, name, changed(lambda own, _: own - behind, ("scan",)))
    assert_drive(log, atol=1e-4)
    side = "behind" if behind > 0 else "ahead of"
    assert any(f"{abs(behind):.2f} s {side} that of the odometry" in note for note in log.notes)
    other = read(tmp_path / "a", name, changed(lambda own, _: own - behind, ("odometry",)))
    assert_drive(other, atol=1e-4)
    assert any("the odometry is moved to the other" in note for note in other.notes)
    np.testing.assert_allclose(other.odom_stream_times[0], other.times[0], atol=1e-4)


@pytest.mark.parametrize("behind", [3.0, -40.0])
def test_poses_in_the_lines_of_scans_need_no_clock(tmp_path, behind):
    """The ODOM lines of another clock show no other poses."""
    said = also_received(changed(lambda own, _: own - behind, ("scan",)))
    log = read(tmp_path, "carmen.clf", said)
    assert_drive(log, times=False)
    np.testing.assert_allclose(log.times, true_times() - behind, atol=1e-6)
    assert log.notes == ()


@pytest.mark.parametrize("name", ["player.log", "two", "bare.clf"])
def test_wheels_without_stamps_are_joined_by_reception_or_order(tmp_path, name):
    log = read(tmp_path, name, changed(lambda own, _: 0.0, ("odometry",)))
    assert_drive(log, atol=0.07)
    assert any("odometry is joined to the scans by" in note for note in log.notes)


@pytest.mark.parametrize("name", LAYOUTS)
def test_single_stamps_that_run_backwards_stay_as_they_are(tmp_path, name):
    said = changed(lambda own, i: own - 0.35 * (i % 30 == 10), ("scan",))
    log = read(tmp_path, name, said)
    wanted = [m.own for m in said if m.kind == "scan"]
    np.testing.assert_allclose(log.times, wanted, atol=1e-6)
    np.testing.assert_array_equal(log.ranges, true_ranges())
    num_back = int(np.sum(np.diff(wanted) < 0.0))
    noted = [note for note in log.notes if "time stamps" in note]
    assert len(noted) == 1 and f"backwards at {num_back} of {len(wanted)}" in noted[0]


@pytest.mark.parametrize("name", STREAMS)
def test_scans_before_and_after_the_odometry_are_left_out(tmp_path, name):
    said = [m for i, m in enumerate(layouts.messages()) if m.kind == "scan" or 31 <= i < 150]
    log = read(tmp_path, name, said)
    assert log.num_skipped == 60 - len(log.times) and 38 <= len(log.times) <= 41
    assert any("10 before it begins, 10 after it ends" in note for note in log.notes) or (
        log.num_skipped in (20, 21)
    )
    kept = np.isin(true_times().round(3), log.times.round(3))
    np.testing.assert_array_equal(log.ranges, true_ranges()[kept])


@pytest.mark.parametrize("name", STREAMS)
def test_a_span_without_odometry_is_marked(tmp_path, name):
    said = [
        m for m in layouts.messages() if m.kind == "scan" or not 4.0 < m.own - layouts.START < 9.0
    ]
    log = read(tmp_path, name, said)
    assert any("odometry is missing (1 x, up to 5." in note for note in log.notes)
    stale = np.flatnonzero(log.odometry_guessed)
    assert stale[0] in (20, 21) and stale[-1] in (44, 45, 46) and len(stale) == np.ptp(stale) + 1


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_mount_and_the_step_can_be_given(tmp_path, name):
    mount = (0.3, -0.1, 1.2)
    log = read(tmp_path, name, mount=mount, angle_increment=0.35)
    assert log.lidar.angle_increment == 0.35 and log.lidar.angle_min == pytest.approx(-np.pi / 2)
    np.testing.assert_allclose(log.odom_poses, compose(true_poses(), np.array(mount)), atol=1e-6)
    np.testing.assert_array_equal(log.mount, mount)
    turned = read(tmp_path / "a", name, upside_down=True)
    np.testing.assert_array_equal(turned.ranges, true_ranges()[:, ::-1])
    assert turned.lidar.angle_min == pytest.approx(np.pi / 2 - layouts.FIELD)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"mount": (1, 2)}, r"mount: \(1, 2\) is no pose; give x y"),
        ({"mount": (0, 0, 180)}, "mount: a yaw of 180 is no angle; give the yaw in radians"),
        ({"mount": (0, 0, np.nan)}, "mount: .* is no pose"),
        ({"mount": "abc"}, "mount: 'abc' is no pose"),
        ({"angle_increment": 0.0}, "angle_increment: 0.0 rad is no step"),
        ({"scan_frame": "rear"}, "scan_frame: there are no scans of the frame 'rear'; frames of"),
    ],
)
def test_impossible_options_are_refused(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, "carmen.clf", **options)


@pytest.mark.parametrize("name", LAYOUTS)
def test_scans_that_see_nothing_and_a_single_one_make_a_note(tmp_path, name):
    path = LAYOUTS[name](tmp_path / name, layouts.messages())
    log = readers.read_log(path, range_max=0.4)
    assert any("no scan has a return below 0.4 m" in note for note in log.notes)


def test_a_log_of_one_scan_makes_a_note(tmp_path):
    said = layouts.messages()[:3]
    for name in ("carmen.clf", "two"):
        assert "there is one scan only" in read(tmp_path, name, said).notes
