import json
import sys
from pathlib import Path

import networkx
import numpy as np
import pytest
from PIL import Image

from jaxslam.cli import main, map_files
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.io import graphml, map_folder, rooms_file, ros_map
from jaxslam.viz import canvas, maps

FILES = {"metrics.json", "map.geojson", "map.graphml", "map.lif.json", "map.rmf.yaml", "map.png"}
FILES |= {"map.nav2.geojson", "map.yaml", "map.pgm", "rooms.json", "rooms.png"}
YAML = "image: a.pgm\nresolution: 0.1\norigin: [-2.0, 1.0, 0.0]\nnegate: 0\n"
YAML += "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
MAPS = Path(__file__).resolve().parents[3] / "shared" / "data" / "maps"


def write_map(folder, free=None):
    """A ring of corridors with a dead end, 9 m x 7 m; image rows go down."""
    if free is None:
        free = np.zeros((70, 90), bool)
        free[5:65, 5:60] = True
        free[16:54, 16:49] = False
        free[30:41, 60:85] = True
    Image.fromarray(np.where(free, 254, 0).astype(np.uint8)[::-1]).save(folder / "a.pgm")
    (folder / "a.yaml").write_text(YAML)
    return folder / "a.yaml"


@pytest.fixture
def done(tmp_path, capsys):
    assert main.main(["map", str(write_map(tmp_path)), "--out", str(tmp_path / "out")]) == 0
    return tmp_path / "out", *capsys.readouterr()


def test_map_writes_its_files_and_nothing_else(done):
    out, said, errors = done
    assert {file.name for file in out.iterdir()} == FILES
    assert {file.name for file in out.parent.iterdir()} == {"out", "a.pgm", "a.yaml"}
    assert (out / "map.png").read_bytes().startswith(b"\x89PNG")
    assert "dead ends" in said and str(out) in said and len(said.splitlines()) < 15
    assert all("/5 [" in line for line in errors.split("\r") if line)  # a bar at most


def test_map_counts_what_it_found(done):
    numbers = json.loads((done[0] / "metrics.json").read_text())
    expected = {"nodes": 2, "arcs": 2, "dead_ends": 1, "rings": 1, "regions": 1}
    assert expected.items() <= numbers.items()
    assert numbers["length_m"] == pytest.approx(2 * 4.9 + 2 * 4.4 + 2.5 - 1.0, abs=0.5)
    assert 0.4 < numbers["narrowest_m"] < 0.6 and numbers["robot_radius_m"] == 0.25
    assert 0.0 < numbers["reached_m2"] < 30.0 and numbers["left_out_m2"] == 0.0
    assert numbers["seconds"]["run"] > 0.0


def test_files_hold_one_graph_in_the_frame_of_the_map(done):
    net = networkx.read_graphml(done[0] / "map.graphml", node_type=int, force_multigraph=True)
    features = json.loads((done[0] / "map.geojson").read_text())["features"]
    points = {
        f["properties"]["id"]: f["geometry"]["coordinates"]
        for f in features
        if f["geometry"]["type"] == "Point"
    }
    assert points == {key: [node["x"], node["y"]] for key, node in net.nodes(data=True)}
    roads = [f for f in features if f["geometry"]["type"] == "MultiLineString"]
    assert len(roads) == 2 * len(net.edges) == 4
    assert networkx.is_connected(net) and sorted(dict(net.degree).values()) == [1, 3]
    (tip,) = (key for key, degree in net.degree if degree == 1)
    np.testing.assert_allclose(points[tip], [-2.0 + 8.0, 1.0 + 3.55], atol=0.3)


def graph_of_two():
    """Two nodes, three arcs: two between them and a loop, one clearance not known."""
    xy = np.array([[0.0, 0.0], [4.0, 1.0]])
    lines = (np.array([xy[0], [2.0, 3.0], xy[1]]), xy[::-1].copy(), xy[[0, 1, 0]])
    return TopologicalMap(
        id=np.array([3, 8]),
        xy=xy,
        kind=np.zeros(2, int),
        clearance=np.array([1.0, 0.5]),
        arc_ends=np.array([[0, 1], [1, 0], [0, 0]]),
        arc_length=np.array([5.5, 4.1, 8.2]),
        arc_clearance=np.array([0.4, np.nan, 0.3]),
        arc_lines=lines,
    )


def test_graphml_keeps_parallel_arcs_loops_and_lines(tmp_path):
    graph = graph_of_two()
    graphml.write(tmp_path / "map.graphml", graph)
    net = networkx.read_graphml(tmp_path / "map.graphml", node_type=int)
    assert net.is_multigraph() and not net.is_directed()
    assert sorted(net.edges()) == [(3, 3), (3, 8), (3, 8)]
    found = sorted((data["length"], data.get("clearance")) for *_, data in net.edges(data=True))
    assert found == [(4.1, None), (5.5, 0.4), (8.2, 0.3)]
    lines = {data["length"]: data["line"] for *_, data in net.edges(data=True)}
    assert lines[5.5] == "LINESTRING (0.0 0.0, 2.0 3.0, 4.0 1.0)"


def test_the_picture_shows_the_map_where_it_is():
    free = np.ones((20, 10), bool)
    grid = OccupancyMap(~free, free, 0.5, np.array([1.0, 2.0, np.pi / 2]))
    corners = maps.known_corners(grid)
    np.testing.assert_allclose(corners, [[1, 2], [1, 12], [-4, 12], [-4, 2]], atol=1e-12)
    axis = canvas.map_canvas(*canvas.extent(corners))[1]
    maps.draw_occupancy(axis, grid)
    maps.draw_topological_map(axis, graph_of_two()._replace(frontiers=(np.eye(2),)))
    (image,) = axis.images
    shown = image.get_transform() - axis.transData
    np.testing.assert_allclose(shown.transform((20, 10)), [-4.0, 12.0], atol=1e-9)
    assert [len(lines.get_segments()) for lines in axis.collections] == [3, 1]
    ends = {line.get_label(): line.get_xydata() for line in axis.lines}
    np.testing.assert_array_equal(ends["open end"], [[0.0, 1.0]])


@pytest.fixture
def refused(tmp_path, capsys):
    """Function that runs bad arguments, checks how they are refused, and returns the line."""

    def refuse(*arguments):
        before = sorted(tmp_path.rglob("*"))
        out = tmp_path / "results"
        assert main.main(["map", *map(str, arguments), "--out", str(out)]) == 2
        line = capsys.readouterr().err
        assert line.startswith("jaxslam: error: ") and line.count("\n") == 1
        assert sorted(tmp_path.rglob("*")) == before
        return line

    return refuse


def test_map_refuses_what_is_no_map(refused, tmp_path):
    assert "missing.yaml: does not exist" in refused(tmp_path / "missing.yaml")
    path = write_map(tmp_path)
    path.write_text(YAML.replace("0.1", "-0.1"))
    assert "a.yaml: resolution: -0.1" in refused(path)
    path.write_text(YAML)
    (tmp_path / "a.pgm").unlink()
    assert "a.pgm: does not exist" in refused(path)


def test_map_does_not_replace_the_map_of_a_run(refused, tmp_path):
    path = write_map(tmp_path)
    results = tmp_path / "results"
    results.mkdir()
    (results / "map.npz").write_bytes(b"")
    path = write_map(results)
    assert "results is the folder of the map, whose results would be replaced" in refused(path)


@pytest.mark.parametrize(
    "field, value, problem",
    [
        ("resolution: 0.1", "resolution: 1.0e+6", "resolution: 1e+06 is not between 0.001 and 100"),
        ("resolution: 0.1", "resolution: 1.0e-4", "resolution: 0.0001 is not between 0.001 and"),
        ("-2.0, 1.0, 0.0", "1.0e+9, 0, 0", "origin: the map has coordinates of 1e+09, beyond 1e"),
        ("-2.0, 1.0, 0.0", "0, 9999995.0, 0", "origin: the map has coordinates of 1e+07, beyond"),
        ("-2.0, 1.0, 0.0", "0, 0, 1.0e+8", "origin: 1e+08 is no yaw in radians"),
    ],
)
def test_map_refuses_what_other_commands_would(refused, tmp_path, field, value, problem):
    path = write_map(tmp_path)
    path.write_text(YAML.replace(field, value))
    assert f"a.yaml: {problem}" in refused(path)


@pytest.mark.parametrize("resolution, x", [(0.1, 9.99998e6), (100.0, -9.99e6)])
def test_what_map_writes_at_its_limits_can_be_read(tmp_path, resolution, x):
    path = write_map(tmp_path)
    path.write_text(YAML.replace("0.1\n", f"{resolution}\n").replace("-2.0", f"{x:.1f}"))
    assert run_map(path, "--out", tmp_path / "out") == 0
    known = map_folder.read_map_folder(tmp_path / "out")
    assert len(known.graph.arc_lines) >= 2 and known.regions is not None
    area = sum(region.area for region in known.regions.regions)
    assert area > 1000 * resolution**2


def test_map_refuses_a_map_without_free_space(refused, tmp_path):
    assert "a.yaml: has no free space" in refused(write_map(tmp_path, np.zeros((9, 9), bool)))
    assert "5 m" in refused(write_map(tmp_path), "--robot-radius", 5.0)


@pytest.mark.parametrize("option", ["--robot-radius", "--min-obstacle-size"])
@pytest.mark.parametrize("value", [-1, "nan", "inf"])
def test_map_refuses_bad_options(refused, tmp_path, option, value):
    assert option in refused(write_map(tmp_path), option, value)


@pytest.mark.parametrize("module, extra", [("networkx", "graph"), ("yaml", "ros")])
def test_map_says_which_extra_is_missing(refused, tmp_path, monkeypatch, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    assert f"jaxslam[{extra}]" in refused(write_map(tmp_path))


def test_an_interrupt_leaves_nothing_behind(tmp_path, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(map_files, "draw_map", stop)
    assert main.main(["map", str(write_map(tmp_path)), "--out", str(tmp_path / "out")]) == 130
    assert {file.name for file in tmp_path.iterdir()} == {"a.pgm", "a.yaml"}


@pytest.mark.parametrize("name, rings", [("willow-full", 30), ("intel", 8), ("aces", 4)])
def test_recorded_maps_become_one_connected_graph(tmp_path, name, rings):
    path = MAPS / f"{name}.yaml"
    if not path.is_file():
        pytest.skip("no recorded maps in ../shared/data/maps beside the repository")
    assert main.main(["map", str(path), "--out", str(tmp_path)]) == 0
    net = networkx.read_graphml(tmp_path / "map.graphml", force_multigraph=True)
    numbers = json.loads((tmp_path / "metrics.json").read_text())
    assert networkx.is_connected(net) and numbers["rings"] > rings
    assert numbers["reached_m2"] > 50 * numbers["left_out_m2"]


def write_rooms_plan(folder, name="plan.png"):
    """Two rooms of 5 x 4 m with a door of 1 m, white on grey, 0.05 m a pixel."""
    free = np.zeros((220, 90), bool)
    free[5:105, 5:85] = free[110:210, 5:85] = free[105:110, 30:50] = True
    shade = np.where(free, 255, 128).astype(np.uint8)
    shade[4] = shade[:, 4] = 0
    Image.fromarray(shade.T[::-1]).save(folder / name)
    return folder / name


def run_map(*arguments):
    return main.main(["map", *map(str, arguments)])


def test_rooms_of_a_map(tmp_path, capsys):
    plan = write_rooms_plan(tmp_path)
    out = tmp_path / "out"
    assert run_map(plan, "--resolution", 0.05, "--out", out) == 0
    said = capsys.readouterr().out
    assert "rooms, doors" in said and "rooms.json" in said
    numbers = json.loads((out / "metrics.json").read_text())
    assert numbers["rooms"] == 2 and numbers["doors"] == 1
    rooms = rooms_file.read_rooms(out)
    assert [region.name for region in rooms.regions] == ["room_1", "room_2"]
    assert rooms.doors[0].width == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(rooms.doors[0].xy, [107.5 * 0.05, 2.0], atol=0.1)
    picture = np.asarray(Image.open(out / "rooms.png"))
    assert picture.shape == (90, 220, 3)
    written = ros_map.read(out / "map.yaml")
    assert written.free.shape == (220, 90) and written.resolution == 0.05
    np.testing.assert_array_equal(written.free, picture[::-1].any(axis=2).T)


def test_a_plan_with_grey_walls_is_a_plan(tmp_path, capsys):
    numbers = []
    for wall in (0, 90, 128, 205):
        shade = np.asarray(Image.open(write_rooms_plan(tmp_path)))
        plan = tmp_path / f"{wall}.png"
        Image.fromarray(np.where(shade == 255, 255, wall).astype(np.uint8)).save(plan)
        assert run_map(plan, "--resolution", 0.05, "--out", tmp_path / str(wall)) == 0
        said = capsys.readouterr().out
        assert ("note: shades below " in said) == (wall > 0)
        assert said.count("note: ") == (wall > 0)
        numbers.append(json.loads((tmp_path / str(wall) / "metrics.json").read_text()))
        del numbers[-1]["seconds"]
    assert numbers[0]["rooms"] == 2 and numbers[0]["arcs"] > 0
    assert numbers[1:] == 3 * numbers[:1]


def test_rooms_without_an_arc_are_named(tmp_path, capsys):
    free = np.zeros((220, 90), bool)
    free[5:105, 5:85] = free[110:210, 5:85] = True
    free[105:110, 30:34] = True  # 0.2 m, narrower than the robot
    Image.fromarray(np.where(free, 255, 0).astype(np.uint8).T[::-1]).save(tmp_path / "a.png")
    assert run_map(tmp_path / "a.png", "--resolution", 0.05, "--out", tmp_path / "out") == 0
    names = {region.name for region in rooms_file.read_rooms(tmp_path / "out").regions}
    (line,) = [s for s in capsys.readouterr().out.splitlines() if s.startswith("note: ")]
    assert line.startswith("note: rooms without an arc: ") and len(names) == 2
    assert set(line.removeprefix("note: rooms without an arc: ").split(", ")) <= names


def test_rooms_keep_their_names_in_the_same_folder(tmp_path, capsys):
    plan, out = write_rooms_plan(tmp_path), tmp_path / "out"
    arguments = (plan, "--resolution", 0.05, "--out", out)
    assert run_map(*arguments) == 0
    text = (out / "rooms.json").read_text()
    for old, new in (("room_1", "room_41"), ("door_1", "door_5")):
        text = text.replace(f'"{old}"', f'"{new}"')
    text = text.replace('"room": 2', '"room": 60').replace('"door": 1', '"door": 7')
    (out / "rooms.json").write_text(text)
    assert run_map(*arguments) == 0
    rooms = rooms_file.read_rooms(out)
    assert {region.name for region in rooms.regions} == {"room_41", "room_2"}
    assert rooms.doors[0].name == "door_5" and rooms.last_numbers == (60, 7)
    assert "new names" not in capsys.readouterr().out
    (out / "rooms.json").write_text("{}")
    assert run_map(*arguments) == 0
    assert "note: rooms and doors get new names: " in capsys.readouterr().out
    assert rooms_file.read_rooms(out).last_numbers == (2, 1)


def test_map_does_not_overwrite_its_input(tmp_path, capsys):
    plan, out = write_rooms_plan(tmp_path), tmp_path / "out"
    assert run_map(plan, "--resolution", 0.05, "--out", out) == 0
    before = {name: (out / name).read_bytes() for name in ("map.yaml", "map.pgm", "rooms.json")}
    (out / "map.yaml").write_bytes(before["map.yaml"] + b"# mine\n")
    assert run_map(out / "map.yaml", "--out", out) == 0
    assert "map.yaml and map.pgm are not written" in capsys.readouterr().out
    assert (out / "map.yaml").read_bytes().endswith(b"# mine\n")
    for name in ("map.pgm", "rooms.json"):
        assert (out / name).read_bytes() == before[name]
    assert run_map(out / "map.pgm", "--resolution", 0.05, "--out", out) == 0
    assert "not written" in capsys.readouterr().out
    assert run_map(write_map(tmp_path), "--out", tmp_path) == 0
    assert "not written" not in capsys.readouterr().out
    assert (tmp_path / "map.yaml").is_file()


def test_map_refuses_a_resolution_that_does_not_fit(refused, tmp_path):
    plan = write_rooms_plan(tmp_path)
    assert "plan.png: is a picture, which has no resolution; add --resolution" in refused(plan)
    for value in (0, -0.05, "nan", "inf"):
        assert "--resolution: " in refused(plan, "--resolution", value)
    line = refused(write_map(tmp_path), "--resolution", 0.05)
    assert "--resolution: is for a picture alone" in line and "a.yaml" in line
    assert "none.png: does not exist" in refused(tmp_path / "none.png", "--resolution", 0.05)
    (tmp_path / "bad.png").write_bytes(b"no picture")
    assert "bad.png: is no image" in refused(tmp_path / "bad.png", "--resolution", 0.05)
