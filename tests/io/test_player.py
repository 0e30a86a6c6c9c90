import layouts
import numpy as np
import pytest

from jaxslam.io import player, readers
from jaxslam.io.errors import InputError

LASER = "{t} host 6665 laser 00 001 001 -1.0 1.0 0.5 8.0 5 1.0 0 2.0 0 3.0 0 9.0 0 0.0 0"
WHEELS = "{t} host 6665 position2d 00 001 001 {t} 0.5 0.1 0 0 0 0"


def lines(count=20, laser=LASER, wheels=WHEELS):
    return [line.format(t=t) for t in range(count) for line in (wheels, laser)]


def save(path, text):
    path.write_text("\n".join(text) + "\n")
    return path


@pytest.fixture
def file(tmp_path):
    return tmp_path / "raw.log"


def test_every_value_is_read(file):
    log = player.read(save(file, ["## Player version 2.0", *lines()]))
    assert log.lidar[:4] == (5, -1.0, 0.5, 8.0) and log.num_skipped == 0 and log.notes == ()
    np.testing.assert_array_equal(log.ranges[3], [1, 2, 3, np.inf, np.inf])
    np.testing.assert_array_equal(log.times, np.arange(20))
    np.testing.assert_allclose(log.odom_poses, [[t, 0.5, 0.1] for t in range(20)])
    assert readers.reader_of(file) is player


@pytest.mark.parametrize(
    "laser, range_max",
    [
        (LASER.replace("-1.0 1.0", "0007 -1.0 1.0"), 8.0),
        ("{t} host 6665 laser 00 -57.2958 57.2958 28.6479 5 1 0 2 0 3 0 9 0 0 0", 20.0),
        ("{t} host 6665 laser 00 {t} -57.2958 57.2958 28.6479 8 5 1 2 3 9 0", 8.0),
    ],
    ids=["with an id", "degrees", "second time, no intensities"],
)
def test_other_versions_give_the_same_scans(file, laser, range_max):
    log = player.read(save(file, lines(laser=laser)))
    np.testing.assert_allclose(log.lidar[:4], (5, -1.0, 0.5, range_max), rtol=1e-5)
    np.testing.assert_array_equal(log.ranges[3, :3], [1, 2, 3])


def test_headings_in_degrees_are_those_of_old_logs_alone(file):
    old = WHEELS.replace("position2d 00 001 001", "position 00").replace(" 0.1 ", " 90 ")
    log = player.read(save(file, lines(wheels=old)))
    np.testing.assert_allclose(log.odom_poses[:, 2], np.pi / 2)
    log = player.read(save(file, lines(wheels=WHEELS.replace(" 0.1 ", " 90 "))))
    np.testing.assert_allclose(np.cos(log.odom_poses[:, 2]), np.cos(90))


def test_other_interfaces_replies_and_a_second_scanner_are_left_out(file):
    other = ["0 host 6665 sonar 00 001 001 5 1 2 3 4 5", "0 host 6665 laser 00 004 001 0 0 0 1 1"]
    rear = [LASER.format(t=t).replace("laser 00", "laser 01") for t in range(5)]
    base = [WHEELS.format(t=t).replace("position2d 00", "position2d 01") for t in range(5)]
    log = player.read(save(file, [*other, *rear, *base, *lines()]))
    assert len(log.times) == 20 and log.num_skipped == 0
    assert any("'laser 00' are used, not those of 'laser 01' (5)" in note for note in log.notes)
    assert any("'position2d 00' is used, not of position2d 01" in note for note in log.notes)
    assert len(readers.read_log(file, scan_frame="laser 01").times) == 5


def test_few_broken_lines_are_skipped_and_many_named(file):
    broken = " ".join(LASER.format(t=3).split()[:-3])
    assert player.read(save(file, [*lines(), broken])).num_skipped == 1
    with pytest.raises(InputError, match=r"raw.log:5: count: cut or damaged: 19 fields \(1 of 5"):
        player.read(save(file, [*lines(2), broken]))
    odd = LASER.format(t=3).replace("0.5 8.0", "0.1 8.0")
    with pytest.raises(InputError, match="resolution: 5 beams do not fit between the angles"):
        player.read(save(file, [*lines(2), odd]))


def test_logs_without_scans_or_odometry(file):
    with pytest.raises(InputError, match="has no laser lines; name a log"):
        player.read(save(file, [line for line in lines() if "position" in line]))
    log = player.read(save(file, [line for line in lines() if "laser" in line]))
    assert not log.has_odometry and "no odometry: the log has none" in log.notes


def test_a_gzipped_log_is_read(tmp_path):
    import gzip

    plain = layouts.player(tmp_path / "a.log", layouts.messages())
    (tmp_path / "a.log.gz").write_bytes(gzip.compress(plain.read_bytes()))
    a, b = readers.read_log(plain), readers.read_log(tmp_path / "a.log.gz")
    np.testing.assert_array_equal(a.ranges, b.ranges)
