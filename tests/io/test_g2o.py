import gzip
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.se2 import compose
from jaxslam.io import g2o
from jaxslam.io.errors import InputError

BEAMS, SCANS = 5, 6
FIRST, STEP, MOST = -1.0, 0.5, 8.0


def moves():
    rng = np.random.default_rng(0)
    return rng.uniform([0.1, -0.1, -1.5], [0.5, 0.1, 1.5], (SCANS - 1, 3)).round(4)


def ranges():
    return np.random.default_rng(1).uniform(0.5, 7.5, (SCANS, BEAMS)).round(3)


def laser(reads, time, *, step=STEP, remissions=0):
    beams = " ".join(map(str, reads))
    shine = " ".join(["0.5"] * remissions)
    ends = "1 2 3 4 5 6 0.1 0.2 0.3 0.4 0.5"
    head = f"ROBOTLASER1 0 {FIRST} {BEAMS * STEP} {step} {MOST} 0.1 0 {len(reads)}"
    return f"{head} {beams} {remissions} {shine} {ends} {time} host {time}"


def graph(*, names=range(SCANS)):
    """Lines of a graph whose vertices are far from the odometry."""
    text = []
    for i, name in enumerate(names):
        text += [f"VERTEX_SE2 {name} 9 9 9", laser(ranges()[i], 100.0 + i, remissions=i % 3)]
    text.append("# a comment")
    information = "500 0 0 500 0 5000"
    for (a, b), move in zip(zip(names[:-1], names[1:], strict=True), moves(), strict=True):
        text.append(f"EDGE_SE2 {a} {b} {' '.join(map(str, move))} {information}")
    return [*text, f"EDGE_SE2 {names[0]} {names[3]} 7 7 7 {information}", "VERTEX_XY 7 1 2"]


def write(path, text):
    path.write_text("\n".join(text) + "\n")
    return path


@pytest.fixture
def file(tmp_path):
    return tmp_path / "graph.g2o"


def test_scans_and_the_odometry_of_edges_are_read(file):
    found = g2o.read(write(file, graph()))
    np.testing.assert_allclose(found.ranges, ranges(), rtol=1e-6)
    np.testing.assert_allclose(found.times, 100.0 + np.arange(SCANS))
    pose = jnp.zeros(3)
    for i, move in enumerate(moves()):
        pose = compose(pose, jnp.asarray(move))
        np.testing.assert_allclose(found.odom_poses[i + 1], pose, atol=1e-12)
    assert found.lidar[:4] == (BEAMS, FIRST, STEP, MOST) and found.num_skipped == 0
    np.testing.assert_array_equal(found.odom_stream_poses, found.odom_poses)


def test_names_and_the_order_of_edges_do_not_matter(file):
    straight = g2o.read(write(file, graph()))
    text = graph(names=[7, 3, 90, 5, 1, 2])
    edges = [line for line in text if line.startswith("EDGE")]
    other = g2o.read(write(file, [line for line in text if line not in edges] + edges[::-1]))
    for a, b in zip(straight, other, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("packed", ["gz", "zip"])
def test_packed_graphs_are_unpacked(file, tmp_path, packed):
    plain = g2o.read(write(file, graph()))
    place = tmp_path / f"graph.{packed}"
    if packed == "gz":
        place.write_bytes(gzip.compress(file.read_bytes()))
    else:
        with zipfile.ZipFile(place, "w") as archive:
            archive.writestr("folder/graph.g2o", file.read_bytes())
            archive.writestr("__MACOSX/._graph.g2o", b"\0")
    np.testing.assert_array_equal(g2o.read(place).ranges, plain.ranges)


def test_what_returned_nothing_is_infinite(file):
    text = graph()
    text[1] = laser([0.0, -1.0, MOST, 30.0, 2.0], 100.0)
    found = g2o.read(write(file, text))
    assert np.isinf(found.ranges[0]).tolist() == [True] * 4 + [False]
    assert np.isinf(g2o.read(file, range_max=1.5).ranges[0]).all()
    assert g2o.read(file, range_max=1.5).lidar.range_max == 1.5


def replaced(line, text):
    lines = graph()
    lines[line] = text
    return lines


@pytest.mark.parametrize(
    "text, message",
    [
        (replaced(0, "VERTEX_SE2 0 9 9"), r"graph.g2o:1: cut or damaged: 4 fields instead of 5"),
        (replaced(0, "VERTEX_SE2 0.5 9 9 9"), r":1: field 2: 0.5 is not an integer"),
        (replaced(2, "VERTEX_SE2 0 9 9 9"), r"vertex 0 occurs twice"),
        (replaced(13, "EDGE_SE2 0 1 1 2 x 1 0 0 1 0 1"), r":14: x y theta: 'x' is not a number"),
        (replaced(13, "# none"), r"no EDGE_SE2 from vertex 0 to the next, 1"),
        (replaced(1, laser(ranges()[0], "nan")), r":2: time: nan is not finite \(1 of 6"),
        (replaced(3, laser(ranges()[0], 1.0)[:60]), r":4: cut or damaged"),
        (replaced(3, laser(["x"] * BEAMS, 1.0)), r":4: a range is not a number"),
        (replaced(3, laser(ranges()[0], 1.0, step=0.0)), r":4: fields 5 and 6: step or"),
        (graph()[0:1], r"has no ROBOTLASER1 lines; name a graph"),
        (["EDGE_SE2 0 1 1 2 3 1 0 0 1 0 1"], r"has no VERTEX_SE2 lines; name a pose graph"),
    ],
)
def test_a_broken_graph_is_reported_in_one_line(file, text, message):
    with pytest.raises(InputError, match=message) as caught:
        g2o.read(write(file, text))
    assert "\n" not in str(caught.value) and "; " in str(caught.value)


def test_few_broken_scans_are_left_out_with_their_poses_kept(tmp_path):
    names = list(range(40))
    text = []
    for name in names:
        text += [f"VERTEX_SE2 {name} 0 0 0", laser(ranges()[0], 10.0 + name)]
    text[9] = laser(["x"] * BEAMS, 14.0)
    text += [f"EDGE_SE2 {i} {i + 1} 0.5 0 0 1 0 0 1 0 1" for i in names[:-1]]
    found = g2o.read(write(tmp_path / "a", text))
    assert found.num_skipped == 1 and len(found.ranges) == 39
    np.testing.assert_allclose(found.odom_poses[:, 0], 0.5 * np.delete(np.arange(40), 4))


def test_archives_of_several_files_or_broken_ones_are_refused(tmp_path):
    place = tmp_path / "two.zip"
    with zipfile.ZipFile(place, "w") as archive:
        archive.writestr("a", b"x\n")
        archive.writestr("b", b"x\n")
    with pytest.raises(InputError, match="zip archive of 2 files; unpack it"):
        g2o.read(place)
    place.write_bytes(place.read_bytes()[:40])
    with pytest.raises(InputError, match="cannot be read"):
        g2o.read(place)


def test_a_damaged_file_never_ends_in_a_traceback(file):
    """Bytes flipped, lines cut, swapped and repeated: a log, or one line."""
    whole = ("\n".join(graph()) + "\n").encode()
    rng = np.random.default_rng(0)
    ended = set()
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            match rng.integers(4):
                case 0:
                    data[rng.integers(len(data))] = rng.integers(256)
                case 1:
                    at = rng.integers(len(data))
                    del data[at : at + rng.integers(1, 200)]
                case 2:
                    lines = bytes(data).split(b"\n")
                    i, j = rng.integers(len(lines), size=2)
                    lines[i], lines[j] = lines[j], lines[i]
                    data = bytearray(b"\n".join(lines))
                case 3:
                    at = rng.integers(len(data))
                    data[at:at] = [b"1e999", b"-", b"nan ", data[at : at + 99]][rng.integers(4)]
        file.write_bytes(data)
        try:
            found = g2o.read(file)
        except InputError as error:
            assert "\n" not in str(error)
            ended.add("refused")
        else:
            assert np.isfinite(found.odom_poses).all() and np.isfinite(found.times).all()
            ended.add("read")
    assert ended == {"refused", "read"}
