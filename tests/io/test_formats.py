import json
import os
import warnings
from collections import OrderedDict
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.io import geojson, noise_file, output, relations, text, tum
from jaxslam.io.errors import InputError
from jaxslam.io.geojson import Arc, Node

LINE = "1.5 2 3 0 0 0 0 1\n"


class Noise(NamedTuple):
    odometry: jnp.ndarray
    wall: jnp.ndarray


TEMPLATE = Noise(jnp.ones(3, jnp.float32), jnp.ones((), jnp.float64))


def complaint(function, path, *given):
    """What a reader or writer says of a file: one line that begins with it."""
    with pytest.raises(InputError) as caught:
        function(path, *given)
    message = str(caught.value)
    assert "\n" not in message and message.startswith(str(path))
    return message.removeprefix(str(path))


def save(path, content):
    path.write_text(content)
    return path


def entries(folder):
    return sorted(p.name for p in folder.iterdir())


def test_input_error_is_one_line():
    error = InputError("is\nbad", path="a.clf", line=7, field="x", advice="repair it")
    assert str(error) == "a.clf:7: x: is bad; repair it"
    assert str(InputError("bad")) == "bad" and isinstance(error, ValueError)


def test_tum_gives_back_what_was_written(tmp_path):
    rng = np.random.default_rng(0)
    times = 976052890.2441 + np.cumsum(rng.uniform(0, 1, 50))
    poses = rng.normal(size=(50, 3)) * [1e3, 1e-7, 1.0]
    poses[:4, 2] = [0.0, np.pi, -3.1, 1e-9]
    tum.write(tmp_path / "a.tum", times, poses)
    again, found = tum.read(tmp_path / "a.tum")
    np.testing.assert_array_equal(again, times)
    np.testing.assert_array_equal(found[:, :2], poses[:, :2])
    np.testing.assert_allclose(found[:, 2], poses[:, 2], atol=1e-14)


def test_tum_takes_lists_and_arrays_of_numpy_and_jax_alike(tmp_path):
    times, poses = [0, 1], [[1, 2, 0.5], [3, 4, -0.25]]
    tum.write(tmp_path / "a.tum", times, poses)
    for n, convert in enumerate((np.asarray, np.float32, jnp.asarray, jnp.float32)):
        tum.write(tmp_path / f"{n}.tum", convert(times), convert(poses))
        assert (tmp_path / f"{n}.tum").read_text() == (tmp_path / "a.tum").read_text()


def test_evo_reads_the_same_trajectory(tmp_path):
    times, poses = np.array([1e9, 1e9 + 0.25]), np.array([[1.0, -2.0, 3.0], [1e-5, 4.0, -0.5]])
    tum.write(tmp_path / "a.tum", times, poses)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from evo.tools import file_interface

        seen = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
        headings = [matrix[:2, :2] for matrix in seen.poses_se3]
    np.testing.assert_array_equal(seen.timestamps, times)
    np.testing.assert_array_equal(seen.positions_xyz, [[1.0, -2.0, 0.0], [1e-5, 4.0, 0.0]])
    for turned, (_, _, heading) in zip(headings, poses, strict=True):
        c, s = np.cos(heading), np.sin(heading)
        np.testing.assert_allclose(turned, [[c, -s], [s, c]], atol=1e-12)


def test_tum_heading_of_a_tilted_pose(tmp_path):
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_euler("ZYX", [[2.5, 0.2, -0.1], [-1.0, -0.3, 0.4]])
    content = "".join(
        f"{i} 0 0 5 {' '.join(map(repr, q))}\n" for i, q in enumerate(turns.as_quat().tolist())
    )
    _, poses = tum.read(save(tmp_path / "a.tum", "# comment\n\n" + content))
    np.testing.assert_allclose(poses, [[0, 0, 2.5], [0, 0, -1.0]], atol=1e-12)


@pytest.mark.parametrize(
    "content, problem",
    [
        ("", ": is empty"),
        ("# only\n", ": holds only comments; name a file of a TUM trajectory"),
        (LINE + "1 2 3\n", ":2: 3 fields instead of 8; a line of a TUM trajectory is: t x y z"),
        (LINE + LINE.replace("2", "two"), ":2: x: 'two' is not a number"),
        ("#\n" + LINE.replace("3", "nan"), ":2: y: nan is not finite"),
        (LINE + "1 2 3 0 0 0 0 0\n", ":2: qx qy qz qw: quaternion of length 0 instead of 1"),
        ("1 2 3 0 0 0 1 1\n", ":1: qx qy qz qw: quaternion of length 1.41 instead of 1"),
        ("\0\1\2", ": is binary"),
    ],
)
def test_tum_errors_say_where(tmp_path, content, problem):
    assert complaint(tum.read, save(tmp_path / "a.tum", content)).startswith(problem)


def test_tum_missing_file_and_folder(tmp_path):
    assert complaint(tum.read, tmp_path / "none.tum") == ": does not exist; check the name"
    assert complaint(tum.read, tmp_path).startswith(": is a folder")


def tum_file(path, order, headings):
    """A path along a circle; quaternions of these headings, in this order of x y z w."""
    rows = []
    for i, yaw in enumerate(headings):
        parts = {"x": 0.0, "y": 0.0, "z": np.sin(yaw / 2), "w": np.cos(yaw / 2)}
        place = f"{np.cos(0.3 * i):.6f} {np.sin(0.3 * i):.6f} 0"
        rows.append(f"{i} {place} {' '.join(repr(float(parts[name])) for name in order)}")
    return save(path, "\n".join(rows) + "\n")


HEADINGS = 0.3 * np.arange(20) + 1.0


def test_a_reference_with_w_first_or_without_heading_has_no_headings(tmp_path):
    (_, right), notes = tum.read_reference(tum_file(tmp_path / "a", "xyzw", HEADINGS))
    np.testing.assert_allclose(np.cos(right[:, 2]), np.cos(HEADINGS))
    assert notes == ()
    for name, order, headings in (("b", "wxyz", HEADINGS), ("c", "xyzw", 0 * HEADINGS)):
        (times, poses), notes = tum.read_reference(tum_file(tmp_path / name, order, headings))
        assert np.isnan(poses[:, 2]).all() and len(notes) == 1 and "heading" in notes[0]
        np.testing.assert_array_equal(poses[:, :2], right[:, :2])
        np.testing.assert_array_equal(times, np.arange(20))
    assert "w first" in tum.read_reference(tmp_path / "b")[1][0]


def test_a_straight_drive_has_the_heading_zero(tmp_path):
    path = save(tmp_path / "a", "".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(9)))
    assert tum.read_reference(path)[1] == () and not tum.read(path)[1][:, 2].any()
    path = save(tmp_path / "b", "".join(f"{i} {i} 0 0 1 0 0 0\n" for i in range(9)))
    assert "w first" in tum.read_reference(path)[1][0]


def test_tum_writes_nothing_that_is_not_finite(tmp_path):
    path = save(tmp_path / "a.tum", "before")
    poses = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]])
    assert complaint(tum.write, path, [1, 2], poses).startswith(": pose 1 is not finite")
    with pytest.raises(ValueError, match=r"poses is .* \(2, 3\), not \(3, 3\)"):
        tum.write(path, [1, 2, 3], poses)
    with pytest.raises(ValueError, match="times is <U1"):
        tum.write(path, ["a"], poses)
    assert path.read_text() == "before" and entries(tmp_path) == ["a.tum"]


def test_relations(tmp_path):
    content = "# c\n10.5 11.5 1 2 9 8 7 -0.5\n3 4 5 6 0 0 0 1.5\n"
    found = relations.read(save(tmp_path / "a.relations", content))
    np.testing.assert_array_equal(found.t1, [10.5, 3])
    np.testing.assert_array_equal(found.t2, [11.5, 4])
    np.testing.assert_array_equal(found.relative_pose, [[1, 2, -0.5], [5, 6, 1.5]])
    broken = save(tmp_path / "b.relations", content + "3 4 5 inf 0 0 0 1\n")
    assert complaint(relations.read, broken).startswith(":4: y: inf is not finite; a line of rel")


def test_lines_are_read_one_by_one(tmp_path):
    path = save(tmp_path / "a", "one\ntwo\n\nfour")
    assert list(text.lines(path)) == [(1, b"one\n"), (2, b"two\n"), (3, b"\n"), (4, b"four")]


def test_folder_appears_whole(tmp_path):
    final = tmp_path / "a" / "out"
    with output.folder(final) as work:
        (work / "x.txt").write_text("x")
        (work / "sub").mkdir()
        (work / "sub" / "y.txt").write_text("y")
        assert not (tmp_path / "a").exists()
    assert entries(tmp_path) == ["a"] and entries(final) == ["sub", "x.txt"]
    assert (final / "sub" / "y.txt").read_text() == "y"


def test_folder_replaces_files_of_the_same_name_only(tmp_path):
    save(tmp_path / "old.txt", "old")
    save(tmp_path / "new.txt", "old")
    with output.folder(tmp_path) as work:
        (work / "new.txt").write_text("new")
        assert (tmp_path / "new.txt").read_text() == "old"
    assert entries(tmp_path) == ["new.txt", "old.txt"]
    assert (tmp_path / "new.txt").read_text() == "new"


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_nothing_appears_after_an_error(tmp_path, error):
    for final in (tmp_path / "a" / "out", tmp_path):
        with pytest.raises(error):
            with output.folder(final) as work:
                (work / "x.txt").write_text("half")
                raise error
        assert entries(tmp_path) == []


def test_folder_that_cannot_be(tmp_path, monkeypatch):
    file = save(tmp_path / "file", "kept")
    for path in (file, file / "below"):
        with pytest.raises(InputError, match="file: is a file; name a folder"):
            with output.folder(path):
                raise AssertionError("the block must not run")
    (tmp_path / "taken").mkdir()
    with pytest.raises(InputError, match="taken: is a folder; remove"):
        with output.folder(tmp_path) as work:
            (work / "taken").write_text("x")
            (work / "also").write_text("x")
    assert entries(tmp_path) == ["file", "taken"] and file.read_text() == "kept"

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    with pytest.raises(InputError, match=r"out: cannot be written \(Permission denied\)"):
        with output.folder(tmp_path / "out"):
            raise AssertionError("the block must not run")


def test_json_has_plain_values(tmp_path):
    value = OrderedDict(
        a=np.float32(0.5), b=jnp.arange(3), c=[np.nan, -np.inf, jnp.array(np.nan), 1.5], d=np.True_
    )
    value |= {"e": TEMPLATE, 7: (None, "text", np.int64(2)), "f": np.array([[1.0, np.inf]])}
    output.write_json(tmp_path / "a.json", value)
    written = (tmp_path / "a.json").read_text()
    assert "NaN" not in written and "Infinity" not in written and '\n "a": 0.5' in written
    assert json.loads(written) == {
        "a": 0.5,
        "b": [0, 1, 2],
        "c": [None, None, None, 1.5],
        "d": True,
        "e": {"odometry": [1, 1, 1], "wall": 1},
        "7": [None, "text", 2],
        "f": [[1.0, None]],
    }


def test_json_is_not_half_written(tmp_path, monkeypatch):
    path = save(tmp_path / "a.json", "before")
    with pytest.raises(TypeError, match="object has no JSON form"):
        output.write_json(path, {"a": 1, "b": object()})
    assert path.read_text() == "before"
    assert "cannot be written (No such file" in complaint(
        output.write_json, tmp_path / "b" / "c", 1
    )

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    assert "No space left" in complaint(output.write_json, path, {})
    assert path.read_text() == "before" and entries(tmp_path) == ["a.json"]


def test_noise_gives_back_what_was_written(tmp_path):
    given = Noise(jnp.array([0.1, 0.2, 1e-9], jnp.float32), jnp.array(1 / 3))
    noise_file.write(tmp_path / "noise.json", given)
    found = noise_file.read(tmp_path / "noise.json", TEMPLATE)
    assert isinstance(found, Noise)
    for a, b in zip(found, given, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype


def noise_text(**fields):
    return json.dumps({"format": "jaxslam-noise", "version": 1, "noise": fields})


GOOD = {"odometry": [1, 2, 3], "wall": 0.5}


@pytest.mark.parametrize(
    "content, problem",
    [
        ('{"format":\n oops}', ":2: is not JSON (Expecting value); name a noise.json"),
        (b"\xff\xfe{", ": is not JSON"),
        ("[1]", ": format: is no jaxslam-noise file"),
        ('{"format": "jaxslam-noise", "version": 2}', ": version: 2 instead of 1"),
        ('{"format": "jaxslam-noise", "version": 1}', ": noise: missing"),
        (noise_text(wall=1), ": odometry: missing; add it"),
        (noise_text(**GOOD, what=1), ": what: unknown field; the fields are odometry, wall"),
        (noise_text(**GOOD | {"wall": [0.5]}), ": wall: is not a number"),
        (noise_text(**GOOD | {"wall": "0.5"}), ": wall: is not a number"),
        (noise_text(**GOOD | {"wall": None}), ": wall: is not a number"),
        (noise_text(**GOOD | {"wall": True}), ": wall: is not a number"),
        (noise_text(**GOOD | {"odometry": [1, 2]}), ": odometry: is not numbers of shape (3,)"),
        (noise_text(**GOOD | {"odometry": [1, [2], 3]}), ": odometry: is not numbers of shape"),
        (noise_text(**GOOD | {"odometry": [1, 0, 3]}), ": odometry: [1.0, 0.0, 3.0] is not pos"),
        (noise_text(**GOOD | {"wall": -0.5}), ": wall: -0.5 is not positive; standard dev"),
        (noise_text(**GOOD | {"wall": float("nan")}), ": wall: nan is not positive"),
        (noise_text(**GOOD | {"wall": float("inf")}), ": wall: inf is not positive"),
    ],
)
def test_noise_errors_name_the_field(tmp_path, content, problem):
    path = tmp_path / "noise.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert complaint(noise_file.read, path, TEMPLATE).startswith(problem)


def test_noise_that_is_not_positive_is_not_written(tmp_path):
    path = tmp_path / "noise.json"
    bad = TEMPLATE._replace(wall=jnp.array(jnp.nan))
    assert complaint(noise_file.write, path, bad).startswith(": wall: nan is not positive")
    assert entries(tmp_path) == []


NODES = [
    Node(4, np.float32(1.5), 2.0, "junction", 0.5),
    Node(7, 3.0, 2.0, "end", np.inf),
]
ARC = Arc(2, 4, 7, 1.8, 0.4, np.array([[1.5, 2.0], [2.0, 2.5], [3.0, 2.0]]))


def test_geojson_is_a_directed_route_graph(tmp_path):
    geojson.write(tmp_path / "map.geojson", NODES, [ARC], frame="odom")
    graph = json.loads((tmp_path / "map.geojson").read_text())
    assert graph["type"] == "FeatureCollection"
    a, b, there, back = graph["features"]
    assert a["geometry"] == {"type": "Point", "coordinates": [1.5, 2.0]}
    metadata = {"kind": "junction", "clearance": 0.5}
    named = {"id": 4, "frame": "odom", "metadata": metadata, "operations": {}}
    assert a["properties"] == named
    assert b["properties"]["metadata"] == {"kind": "end"}  # null would stop nav2_route
    line = [[1.5, 2.0], [2.0, 2.5], [3.0, 2.0]]
    assert there["geometry"] == {"type": "MultiLineString", "coordinates": [line]}
    assert back["geometry"] == {"type": "MultiLineString", "coordinates": [line[::-1]]}
    ends = [(edge["properties"]["startid"], edge["properties"]["endid"]) for edge in (there, back)]
    assert ends == [(4, 7), (7, 4)]
    ids = [feature["properties"]["id"] for feature in graph["features"]]
    assert len(set(ids)) == 4 and all(isinstance(i, int) and i >= 0 for i in ids)
    for edge in (there, back):
        assert edge["properties"]["cost"] == 1.8 and edge["properties"]["overridable"] is True
        assert edge["properties"]["metadata"] == {"arc": 2, "length": 1.8, "clearance": 0.4}


@pytest.mark.parametrize(
    "nodes, arcs, problem",
    [
        (NODES, [ARC._replace(end=5)], "arc 2 joins 4 and 5"),
        (NODES, [ARC, ARC], "arc ids must differ"),
        ([NODES[0], NODES[0]], [], "node ids must differ"),
        ([(4, 1.5, 2.0)], [], r"nodes\[0\] is tuple, not Node"),
        (NODES, NODES, r"arcs\[0\] is Node, not Arc"),
        ([NODES[0]._replace(id=-1)], [], "node ids must differ and not be negative"),
        ([NODES[0]._replace(x=np.nan)], [], "node 4 is at"),
        (NODES, [ARC._replace(length=np.inf)], "arc 2 has a point or length that is not finite"),
        (NODES, [ARC._replace(points=np.zeros((1, 2)))], r"arc 2 has points \(1, 2\)"),
    ],
)
def test_geojson_refuses_what_is_no_graph(tmp_path, nodes, arcs, problem):
    with pytest.raises(ValueError, match=problem):
        geojson.write(tmp_path / "map.geojson", nodes, arcs)
    assert entries(tmp_path) == []


def test_geojson_of_an_empty_map(tmp_path):
    geojson.write(tmp_path / "map.geojson", [], [])
    assert json.loads((tmp_path / "map.geojson").read_text())["features"] == []


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_long_table_is_read_as_a_short_one(tmp_path, end):
    content = ["# a b", "1 2.5", "", "  # 3 4", " -1e-3\t1248444187.156 ", "\t7 0"]
    path = save(tmp_path / "a.dat", "\ufeff" + end.join(content))
    numbers, values = text.table(path, ("a", "b"), "pairs")
    slow = text.rows(path, ("a", "b"), "pairs")
    assert list(zip(numbers.tolist(), values.tolist(), strict=True)) == slow and len(slow) == 3


BROKEN_TABLES = [
    "1 2\n3\n",
    "1 2\n3 4 # x\n",
    "1 2\nx 4\n",
    "nan 1\n",
    "1 inf\n",
    "1\n2\n",
    "# x\n",
]


@pytest.mark.parametrize("content", [*BROKEN_TABLES, "", "1 \u00e4\n", "1 2\r3 4\n"])
def test_a_long_table_is_refused_as_a_short_one(tmp_path, content):
    path = save(tmp_path / "a.dat", content)
    said = [complaint(read, path, ("a", "b"), "pairs") for read in (text.rows, text.table)]
    assert said[0] == said[1]


def test_json_in_rows_is_the_same_json(tmp_path):
    content = {"a": [{"b": [1, float("nan")]}, 2.5], "c": [], "d": {"e": np.arange(3)}, "f": "g\n"}
    output.write_json(tmp_path / "a.json", content)
    output.write_json_rows(tmp_path / "b.json", content)
    one, other = ((tmp_path / name).read_text() for name in ("a.json", "b.json"))
    assert json.loads(one) == json.loads(other)
    assert other.splitlines()[:3] == ["{", '"a": [', '{"b": [1, null]},']
