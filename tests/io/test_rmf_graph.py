"""map.rmf.yaml by the rules of the parser of Open-RMF's fleet adapter."""

import numpy as np
import pytest
from small_building import building, planner, regions

from jaxslam.io import rmf_graph

yaml = pytest.importorskip("yaml")


def parse_graph(path):
    """Waypoints, lanes and doors as `rmf_fleet_adapter` reads them; an assert is a refusal."""
    content = yaml.safe_load(path.read_text())
    assert isinstance(content["building_name"], str) and content["lifts"] == {}
    doors = {}
    for name, door in content["doors"].items():
        doors[name] = np.array(door["endpoints"], float)
        assert doors[name].shape == (2, 2) and door["map"] in content["levels"]
    assert isinstance(content["levels"], dict)
    (level,) = content["levels"].values()
    waypoints, keys = [], {}
    for index, (x, y, options) in enumerate(level["vertices"]):
        assert isinstance(x, float) and isinstance(y, float) and isinstance(options, dict)
        waypoints.append((x, y))
        if options.get("name"):
            assert isinstance(options["name"], str) and options["name"] not in keys
            keys[options["name"]] = index
    for begin, end, options in level["lanes"]:
        assert {begin, end} <= set(range(len(waypoints))) and begin != end
        assert options.keys() <= {"door_name", "speed_limit"}
        assert options.get("door_name", next(iter(doors), None)) in {None, *doors}
        assert isinstance(options.get("speed_limit", 1.0), float)
        assert options.get("speed_limit", 1.0) > 0.0
    return np.array(waypoints), keys, level["lanes"], doors


@pytest.fixture
def read(tmp_path):
    rmf_graph.write(tmp_path / "map.rmf.yaml", building(), regions(), planner(), max_speed=2.0)
    return parse_graph(tmp_path / "map.rmf.yaml")


def test_the_fleet_adapter_reads_vertices_lanes_and_doors(read):
    waypoints, keys, lanes, doors = read
    assert sorted(keys) == ["11", "5", "8"]
    np.testing.assert_array_equal(waypoints[keys["8"]], [6.0, 0.0])
    np.testing.assert_array_equal(doors["door_4"], [[5.6, 5.2], [6.4, 5.2]])
    assert len(doors) == 2 and len(lanes) == 2 * (4 + 1 + 2 + 4)
    assert sorted((b, a) for a, b, _ in lanes) == sorted((a, b) for a, b, _ in lanes)
    limits = {options.get("speed_limit") for _, _, options in lanes}
    assert limits == {1.125, None, 0.4, 0.75}


def test_lanes_with_a_door_pass_between_its_jambs_and_no_others_do(read):
    waypoints, _, lanes, doors = read
    for begin, end, options in lanes:
        crossed = []
        for name, (p, q) in doors.items():
            a, b = waypoints[begin], waypoints[end]
            turn = lambda u, v, w: np.sign(np.cross(np.append(v - u, 0), np.append(w - u, 0))[2])  # noqa: E731
            if turn(a, b, p) != turn(a, b, q) and turn(p, q, a) != turn(p, q, b):
                crossed.append(name)
        assert crossed == ([options["door_name"]] if "door_name" in options else [])


def test_a_map_without_regions_or_arcs_is_read_too(tmp_path):
    graph = building()._replace(
        xy=np.array([[-0.00001, 0.0], [1.0, 3.0], [1e-5, 12345.67891], [6.0, 8.0]]),
        arc_ends=np.zeros((0, 2), int),
        arc_length=np.zeros(0),
        arc_clearance=np.zeros(0),
        arc_lines=(),
    )
    rmf_graph.write(tmp_path / "a.yaml", graph, building='"x": y', level="12")
    waypoints, keys, lanes, doors = parse_graph(tmp_path / "a.yaml")
    assert len(keys) == 3 and lanes == [] and doors == {}
    np.testing.assert_array_equal(waypoints, [[0.0, 0.0], [0.0, 12345.6789], [6.0, 8.0]])
    assert "-0.0" not in (tmp_path / "a.yaml").read_text()


def test_the_same_map_gives_the_same_file(tmp_path):
    for name in "ab":
        rmf_graph.write(tmp_path / name, building(), regions(), planner())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
