import io
import operator
import os
import zipfile

import jax
import numpy as np
import pytest

import jaxslam
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering.belief import Belief, grow_belief
from jaxslam.filtering.covariance import defer
from jaxslam.filtering.heteroscedastic import MeasurementWeights, OdometryWeights
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import map_arrays, map_file
from jaxslam.io.errors import InputError
from jaxslam.mapping.arc_table import ArcTable, grow_arcs
from jaxslam.mapping.saved_map import SavedMap, used_arcs, used_landmarks

K, R, L = 4, 5, 3
LIDAR = Lidar(R, -1.0, 0.5, 10.0, 0.03)
TIMES = np.array([3.5, 3.75, 3.25, 9.0])  # of scans in order of reception


def covariances(count, size, rng):
    factor = rng.normal(size=(count, size, size)).astype(np.float32)
    cov = factor @ factor.swapaxes(1, 2)
    return np.triu(cov) + np.triu(cov, 1).swapaxes(1, 2)


def belief(rng, count=L):
    def floats(*shape):
        return rng.normal(size=shape).astype(np.float32)

    def tracks():
        return rng.integers(1, 9, count).astype(np.int32)

    return Belief(
        mean=floats(3 + 2 * count),
        first_estimate=floats(3 + 2 * count),
        pose_cov=covariances(1, 3, rng)[0],
        cross_cov=floats(3, 2 * count),
        map_cov=covariances(1, 2 * count, rng)[0],
        num_seen=tracks(),
        last_seen=tracks(),
        num_missed=tracks(),
        num_pending=tracks(),
        kind=np.array([JUNCTION, WALL, CORNER], np.int32)[:count],
        id=np.array([7, 2, 11], np.int32)[:count],
        direction=floats(count),
        descriptor=floats(count),
        step=np.int32(40),
        next_id=np.int32(12),
    )


def graph(rng):
    lines = rng.normal(size=(2, 4, 2)), rng.normal(size=(5, 2))
    return TopologicalMap(
        id=np.array([7, 11]),
        xy=rng.normal(size=(2, 2)),
        kind=np.array([JUNCTION, CORNER]),
        clearance=np.array([0.75, 0.0]),
        arc_ends=np.array([[0, 0], [0, 0]]),
        arc_length=np.array([3.0, 2.5]),
        arc_clearance=np.array([0.5, np.nan]),  # the second was driven, not observed
        arc_lines=(lines[0][0], lines[1]),
        frontiers=(lines[0][1],),
        frontier_node=np.array([0]),
    )


def saved_map():
    rng = np.random.default_rng(0)
    hit = rng.random((K, R)) < 0.7
    ranges = np.where(hit, rng.uniform(0.5, 9.0, (K, R)), 10.0).astype(np.float32)
    arcs = ArcTable(
        ends=np.array([[2, 7], [7, -1]], np.int32),
        polyline=rng.normal(size=(2, 9, 2)).astype(np.float32),
        length=np.array([1.0, 2.0], np.float32),
        clearance=np.array([0.5, 0.25], np.float32),
        num_seen=np.array([3, 1], np.int32),
    )
    params = NoiseParams.for_laser_log(match_scans=True)._replace(
        odometry_cov_rate=np.diag([1e-3, 2e-3, 3e-3]),
        odometry_weights=OdometryWeights(*rng.normal(size=(4, 3))),
        measurement_weights=MeasurementWeights(*rng.normal(size=(5, 3))),
        student_dof=4.0,
        odometry_bias_walk=np.array([0.0, 0.1, 0.2]),
    )
    params = jax.tree.map(lambda x: np.asarray(x, float), params)
    poses, cov = rng.normal(size=(K, 3)), covariances(K, 3, rng)
    scans = Scan._make((ranges, hit))
    return SavedMap(LIDAR, params, TIMES, poses, cov, scans, belief(rng), arcs, graph(rng))


def without_landmarks():
    """A map of which nothing but scans is known."""
    whole = saved_map()
    empty = TopologicalMap(*(x[:0] for x in whole.topological_map))
    return whole._replace(
        params=jax.tree.map(np.asarray, NoiseParams.for_laser_log()),
        belief=belief(np.random.default_rng(1), count=0),
        arcs=jax.tree.map(lambda x: x[:0], whole.arcs),
        topological_map=empty,
    )


def check_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.asarray(a).dtype == np.asarray(b).dtype


@pytest.fixture
def file(tmp_path):
    return tmp_path / "map.npz"


@pytest.fixture
def arrays(file):
    """The arrays of a good file, by name."""
    map_file.write(file, saved_map())
    with np.load(file, allow_pickle=False) as content:
        return dict(content)


def refused(path, read=map_file.read):
    """The line that a file is refused with, without its name."""
    with pytest.raises(InputError) as caught:
        read(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and "\n" not in line and len(line) < 300
    return line.removeprefix(f"{path}: ")


@pytest.mark.parametrize("make", [saved_map, without_landmarks])
def test_what_is_written_is_read(file, make):
    map_file.write(file, make())
    check_equal(map_file.read(file), make())
    assert [one.name for one in file.parent.iterdir()] == [file.name]
    assert isinstance(map_file.read(file).lidar.num_beams, int)  # hashable, static under jit


def test_every_field_of_the_records_is_in_the_file(arrays):
    own = {name.split(".")[0] for name in arrays}
    assert own == {*SavedMap._fields, "format", "version"}
    for name, kind in {"belief": Belief, "arcs": ArcTable, "params": NoiseParams}.items():
        fields = {array.split(".")[1] for array in arrays if array.startswith(f"{name}.")}
        assert fields == set(kind._fields) - {"bias", "adaptation", "custom"}  # of one drive
    assert not any(array.dtype.hasobject for array in arrays.values())


def test_a_folder_or_its_file_is_loaded(tmp_path, file, monkeypatch):
    map_file.write(file, saved_map())
    for path in (tmp_path, file, str(tmp_path)):
        check_equal(jaxslam.load_map(path), saved_map())
    monkeypatch.chdir(tmp_path)
    check_equal(jaxslam.load_map("."), saved_map())


def test_a_path_in_an_error_is_as_it_was_typed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkdir("out")
    assert refused("./out", jaxslam.load_map).startswith("holds no map.npz; name an output folder")
    assert refused("none", jaxslam.load_map) == "does not exist; " + map_file._OURS
    (tmp_path / "out" / "map.npz").write_bytes(b"x")
    with pytest.raises(InputError, match=r"^\./out/map\.npz: is no NumPy file"):
        jaxslam.load_map("./out")
    assert refused("./out").startswith("is a folder")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"format": None}, "format: missing: this is no jaxslam-map; name a map.npz"),
        ({"format": "jaxslam-recording"}, "format: is 'jaxslam-recording', not 'jaxslam-map'"),
        ({"format": np.array(["a", "b"])}, "format: is \"['a' 'b']\""),
        ({"version": None}, "version: missing"),
        ({"version": 2}, "version: is 2, and this jaxslam reads 1; install a newer jaxslam"),
        ({"version": 0}, "version: is 0, and this jaxslam reads 1; make the map again"),
        ({"version": 1.5}, "version: is float64 (), not a whole number"),
        ({"extra": 1.0}, "extra: unknown array"),
        ({"poses": np.full((K, 3), np.nan)}, "poses: holds NaN or infinity"),
        ({"poses": np.zeros((K, 2))}, "poses: is float64 (4, 2), not float64 (4, 3)"),
        ({"poses": np.zeros((K, 3), np.float32)}, "poses: is float32 (4, 3), not float64"),
        ({"poses": np.zeros(K)}, "poses: is float64 (4,), not float64 (4, 3)"),
        ({"poses": np.array([["x"] * 3] * K)}, "poses: is <U1"),
        ({"times": np.zeros(K + 1)}, "poses: is float64 (4, 3), not float64 (5, 3)"),
        ({"times": np.zeros(())}, "times: is float64 (), not float64 ('K',)"),
        ({"pose_cov": np.full((K, 3, 3), np.inf, np.float32)}, "pose_cov: holds NaN"),
        ({"scans.ranges": np.zeros((K, R + 1), np.float32)}, "scans.ranges: is float32 (4, 6)"),
        ({"scans.ranges": np.full((K, R), 10.5, np.float32)}, "scans.ranges: is not in [0, range"),
        ({"scans.ranges": np.full((K, R), -1.0, np.float32)}, "scans.ranges: is not in [0, range"),
        ({"lidar.range_max": 0.0}, "lidar.range_max is 0.0, not above 0"),
        ({"lidar.range_max": np.ones(2)}, "lidar.range_max: is float64 (2,), not a number"),
        ({"lidar.angle_min": np.nan}, "lidar.angle_min is nan, not a finite number"),
        ({"lidar.num_beams": 10**15}, "scans.ranges: is float32 (4, 5), not float32 (4, 10000000"),
        ({"lidar.num_beams": 5.5}, "lidar.num_beams is 5.5, not an integer"),
        ({"params.range_std": np.float64(-1.0)}, "params.range_std: a standard deviation is below"),
        ({"params.bearing_std": np.float32(1.0)}, "params.bearing_std: is float32 (), not float64"),
        ({"belief.id": np.array([7, 7, 2], np.int32)}, "belief.id: an id occurs twice"),
        ({"belief.id": np.array([7, 2, 12], np.int32)}, "belief.id: an id is negative, or not"),
        ({"belief.id": np.array([7, 2, -1], np.int32)}, "belief.id: an id is negative, or not"),
        ({"belief.id": np.array([7, 2, 11])}, "belief.id: is int64 (3,), not int32 (3,)"),
        ({"belief.id": np.arange(10**6, dtype=np.int32)}, "belief.kind: is int32 (3,), not int32"),
        ({"belief.kind": np.array([0, 1, 3], np.int32)}, "belief.kind: is none of the kinds"),
        ({"belief.num_seen": np.array([0, 1, 3], np.int32)}, "belief.num_seen: a slot is free"),
        ({"belief.mean": np.zeros(9)}, "belief.first_estimate: is float32 (9,), not float64 (9,)"),
        ({"belief.map_cov": np.zeros((6, 6), np.float32)}, "belief.map_cov: is float32 (6, 6)"),
        ({"arcs.num_seen": np.array([0, 1], np.int32)}, "arcs.num_seen: a slot is free"),
        ({"arcs.ends": np.array([[-1, 7], [2, 7]], np.int32)}, "arcs.ends: is no pair of landmark"),
        ({"arcs.polyline": np.zeros((2, 8, 2), np.float32)}, "arcs.polyline: is float32 (2, 8, 2)"),
        ({"topological_map.id": np.array([7, 7])}, "topological_map.id: an id occurs twice"),
        ({"topological_map.id": np.array([7, 99])}, "topological_map.id: an id is negative, or"),
        ({"topological_map.kind": np.array([0, 2])}, "topological_map.kind: is none of the kinds"),
        ({"topological_map.arc_ends": np.array([[0, 2], [0, 0]])}, "arc_ends: is no index of a"),
        ({"topological_map.frontier_node": np.array([-1])}, "frontier_node: is no index of a node"),
        ({"topological_map.arc_lines.size": np.array([1, 8])}, "does not share out 9 points, 2 or"),
        ({"topological_map.frontiers.size": np.array([5])}, "does not share out 4 points, 2 or"),
        ({"poses": np.array([[None] * 3] * K)}, "poses: is damaged (ValueError)"),  # pickled
    ],
)
def test_a_bad_array_is_refused_in_one_line(file, arrays, changes, message):
    arrays |= changes
    np.savez(file, **{name: value for name, value in arrays.items() if value is not None})
    assert message in refused(file)


@pytest.mark.parametrize("name", [*map_arrays.LAYOUT])
def test_an_array_is_missing(file, arrays, name):
    np.savez(file, **{key: value for key, value in arrays.items() if key != name})
    if name in map_arrays.OPTIONAL:
        value = operator.attrgetter(name)(map_file.read(file))
        assert value is None or not len(value)
    else:
        assert refused(file).startswith(f"{name}: missing; copy the file again, or make it by")


@pytest.mark.parametrize("name", [n for n in map_arrays.LAYOUT if "size" not in n])
def test_an_array_is_of_another_kind_or_shape(file, arrays, name):
    for other in (np.array("text"), np.zeros((1, 1, 1, 1)), arrays[name].astype(complex)):
        np.savez(file, **(arrays | {name: other}))
        assert refused(file).startswith(f"{name}: is {other.dtype} {other.shape}, not ")


def test_files_of_another_kind_are_refused(tmp_path):
    one = tmp_path / "one"
    contents = {b"": "BadZipFile", b"x": "BadZipFile", b"PK\3\4 and no more": "BadZipFile"}
    with io.BytesIO() as array:
        np.save(array, np.zeros(3))
        contents[array.getvalue()] = "BadZipFile"
    for content, name in contents.items():
        one.write_bytes(content)
        assert refused(one).startswith(
            f"is no NumPy file that can be read ({name}); name a map.npz"
        )
    with zipfile.ZipFile(one, "w") as archive:
        archive.writestr("readme.txt", "a zip archive, but no NumPy file")
    assert refused(one).startswith("format: missing")
    np.savez(one, leaf0=np.zeros(3), about="{}")  # a checkpoint
    assert refused(tmp_path / "one.npz").startswith("format: missing")


def test_a_truncated_file_is_refused_wherever_it_ends(file, arrays):
    whole = file.read_bytes()
    for size in range(0, len(whole), 97):
        file.write_bytes(whole[:size])
        assert refused(file).startswith("is no NumPy file that can be read")


def test_a_flipped_byte_is_found_or_does_not_matter(file, arrays):
    whole, expected, found = file.read_bytes(), saved_map(), 0
    for at in np.random.default_rng(0).integers(len(whole), size=200):
        changed = bytearray(whole)
        changed[at] ^= 0x41
        file.write_bytes(changed)
        try:
            check_equal(map_file.read(file), expected)
        except InputError as error:
            found += 1
            assert "\n" not in str(error) and len(str(error)) < 300
    assert found > 100


def test_a_flipped_byte_of_an_array_names_it(file, arrays):
    with zipfile.ZipFile(file) as archive:
        member = archive.getinfo("belief.map_cov.npy")
    changed = bytearray(file.read_bytes())
    changed[member.header_offset + 200] ^= 0xFF
    file.write_bytes(changed)
    assert refused(file).startswith("belief.map_cov: is damaged (")


def test_absurd_sizes_are_refused_before_they_are_read(file, arrays, monkeypatch):
    monkeypatch.setattr(map_file, "MAX_BYTES", 2**20)
    np.savez_compressed(file, **(arrays | {"poses": np.zeros((2**22, 3))}))
    assert file.stat().st_size < 2**19
    monkeypatch.setattr(map_file, "_array", lambda *_: pytest.fail("it is read"))
    assert refused(file).startswith("has 0.1 GiB of arrays, more than 0.000976562 GiB; make a map")


def test_an_array_that_claims_to_be_huge_is_refused(file, arrays):
    header = io.BytesIO()
    claim = {"descr": "<f8", "fortran_order": False, "shape": (10**14, 3)}
    np.lib.format.write_array_header_1_0(header, claim)
    del arrays["poses"]
    np.savez(file, **arrays)
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("poses.npy", header.getvalue() + b"\0" * 100)
    assert refused(file).startswith("poses: is damaged (")


def test_what_cannot_be_read_again_is_not_written(file, monkeypatch):
    good = saved_map()
    none = good.scans._replace(hit=np.ones((K, R), bool), ranges=np.zeros((K, R), np.float32))
    for changes, message in (
        ({"poses": np.full((K, 3), np.nan)}, "poses: holds NaN or infinity; make the map by"),
        ({"times": np.zeros(3)}, r"poses: is float64 \(4, 3\), not float64 \(3, 3\)"),
        ({"scans": none}, "scans.ranges: a beam hit something at 0 m"),
        ({"lidar": LIDAR._replace(range_max=-1.0)}, "lidar.range_max is -1.0"),
        ({"belief": good.belief._replace(map_cov=np.zeros((6, 5)))}, "belief.map_cov is float64"),
    ):
        with pytest.raises(ValueError, match=message):
            map_file.write(file, good._replace(**changes))
    with pytest.raises(ValueError, match="saved_map is TopologicalMap, not SavedMap"):
        map_file.write(file, good.topological_map)
    monkeypatch.setattr(map_file, "MAX_BYTES", 100)
    with pytest.raises(InputError, match="GiB of arrays, more than"):
        map_file.write(file, good)
    with pytest.raises(InputError, match="cannot be written"):
        monkeypatch.setattr(map_file, "MAX_BYTES", 2**30)
        map_file.write(file.parent / "no" / "such.npz", good)
    assert not list(file.parent.iterdir())


def test_a_file_is_replaced_completely_or_stays(file, monkeypatch):
    map_file.write(file, saved_map())
    before = file.read_bytes()

    def fail(stream, **_):
        stream.write(b"PK")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(InputError, match=r"cannot be written \(No space left"):
        map_file.write(file, saved_map())
    assert file.read_bytes() == before and [one.name for one in file.parent.iterdir()] == [
        "map.npz"
    ]


def test_free_slots_are_left_out_and_can_be_given_again(single_precision):
    """Slots of landmarks stay with their landmarks, whatever slots were free between them."""
    compact, arcs = saved_map().belief, saved_map().arcs
    wide = jax.jit(grow_belief, static_argnums=1)(compact, 5)
    wide = jax.tree.map(np.asarray, wide)
    order = np.array([0, 3, 1, 4, 2])  # free slots are those that were 3 and 4
    numbers = (2 * order[:, None] + [0, 1]).ravel()
    state = np.concatenate([[0, 1, 2], 3 + numbers])
    tracks = "num_seen last_seen num_missed num_pending kind id direction descriptor".split()
    mixed = wide._replace(
        mean=wide.mean[state],
        first_estimate=wide.first_estimate[state],
        cross_cov=wide.cross_cov[:, numbers],
        map_cov=wide.map_cov[np.ix_(numbers, numbers)],
        **{name: getattr(wide, name)[order] for name in tracks},
    )
    mixed = jax.tree.map(jax.numpy.asarray, mixed)
    check_equal(used_landmarks(mixed), compact)
    check_equal(used_landmarks(mixed._replace(map_cov=defer(mixed.map_cov))), compact)
    check_equal(used_arcs(grow_arcs(arcs, 7)), arcs)
