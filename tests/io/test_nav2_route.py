"""map.geojson as nav2_route reads it: its rules, and what a user's values do to ours."""

import json
import math
import re

import numpy as np
import pytest
from nav2_rules import nav2_graph
from small_building import building, planner, regions

from jaxslam.cli import report
from jaxslam.io import annotated_map
from jaxslam.io.nav2_metadata import speed_limit
from jaxslam.io.route_graph import route_graph


def written(path, graph=None, with_regions=True, old=None):
    """Content of a file that `write_map` writes, and its notes."""
    more = {"regions": regions(), "planner": planner()} if with_regions else {}
    notes, _ = report.write_map(path, building() if graph is None else graph, old, **more)
    return json.loads(path.read_text()), notes


def test_nav2_route_reads_classes_speeds_and_doors(tmp_path):
    content, notes = written(tmp_path / "map.geojson")
    nodes, edges = nav2_graph(content)
    assert notes == () and sorted(nodes) == [5, 7, 8, 11, 30]
    assert re.search(r'"speed_limit": \d+\.\d+', (tmp_path / "map.geojson").read_text())
    found = {key: value["metadata"] for key, value in nodes.items()}
    assert found[8] == {
        "kind": "node",
        "clearance": 1.2,
        "region": "room_2",
        "class": "corridor",
    }
    assert found[7] == {"kind": "corner"} and found[30] == {"kind": "frontier"}
    assert found[11] == {"kind": "node", "region": "room_1", "class": "room"}
    by_arc = {}
    for edge in edges.values():
        by_arc.setdefault(edge["metadata"]["arc"], []).append(edge)
    assert sorted(by_arc) == [0, 1, 2, 3, 4] and all(len(pair) == 2 for pair in by_arc.values())
    for pair in by_arc.values():  # an edge is for one direction
        there, back = pair
        assert (there["startid"], there["endid"]) == (back["endid"], back["startid"])
        assert there["metadata"] == back["metadata"]
    of_door = by_arc[0][0]
    assert of_door["metadata"] == {
        "arc": 0,
        "length": 8.0,
        "clearance": 0.45,
        "region": "room_2",
        "class": "door",
        "door": "door_3,door_4",
        "speed_limit": 56.2,
    }
    assert by_arc[0][1]["operations"] == of_door["operations"]
    assert of_door["operations"]["open_door_4"] == {
        "type": "OpenDoor",
        "trigger": "ON_ENTER",
        "metadata": {"door": "door_4", "service_name": "door_4/open"},
    }
    assert by_arc[1][0]["metadata"]["class"] == "corridor"
    limits = {arc: pair[0]["metadata"]["speed_limit"] for arc, pair in by_arc.items()}
    assert limits == {0: 56.2, 1: 100.0, 2: 20.0, 3: 37.5, 4: 20.0}
    assert all("operations" not in edge for arc in (1, 2, 3, 4) for edge in by_arc[arc])


@pytest.mark.parametrize(
    "clearance, limit",
    [(2.0, 100.0), (0.8, 100.0), (0.4, 50.0), (0.1, 20.0), (math.nan, 20.0), (math.inf, 100.0)],
)
def test_speed_is_full_from_a_comfortable_clearance_on(clearance, limit):
    assert speed_limit(clearance) == limit and isinstance(speed_limit(clearance), float)


def test_without_regions_there_are_speeds_alone(tmp_path):
    _, edges = nav2_graph(written(tmp_path / "map.geojson", with_regions=False)[0])
    keys = {key for edge in edges.values() for key in edge["metadata"]}
    assert keys == {"arc", "length", "clearance", "speed_limit"}
    _, arcs = route_graph(building(), regions(), planner(), with_operations=False)
    assert not any(arc.operations for arc in arcs) and arcs[0].metadata["door"] == "door_3,door_4"


def test_an_open_end_is_a_node_at_the_end_of_its_line(tmp_path):
    content, _ = written(tmp_path / "map.geojson")
    (point,) = [f for f in content["features"] if f["properties"]["id"] == 30]
    assert point["geometry"]["coordinates"] == [-1.0, -2.0]
    there, back = [f for f in content["features"] if f["properties"].get("cost") == 3.0]
    assert (there["properties"]["startid"], there["properties"]["endid"]) == (5, 30)
    assert there["geometry"]["coordinates"] == [[[0.0, 0.0], [-1.0, 0.0], [-1.0, -2.0]]]
    assert back["geometry"]["coordinates"][0][0] == [-1.0, -2.0]
    without = building()._replace(frontier_id=np.zeros(0, int))  # as maps of earlier versions
    assert len(route_graph(without)[0]) == 4


def test_what_is_ours_changes_with_the_map_and_no_user_is_asked(tmp_path):
    path = tmp_path / "map.geojson"
    first, _ = written(path)
    again, notes = written(path, old=annotated_map.read(path))
    assert notes == () and again == first
    closed = building()._replace(frontiers=(), frontier_node=[], frontier_id=np.zeros(0, int))
    later, notes = written(path, closed, with_regions=False, old=annotated_map.read(path))
    nodes, edges = nav2_graph(later)
    assert notes == () and sorted(nodes) == [5, 7, 8, 11]
    left = [*nodes.values(), *edges.values()]
    assert not any({"region", "class", "door"} & set(p["metadata"]) for p in left)
    assert not any(p.get("operations") for p in left)


def test_a_door_before_an_open_end_is_opened(tmp_path):
    data = planner()._replace(frontier_doors=((1,),))
    report.write_map(tmp_path / "map.geojson", building(), None, 0, regions(), data)
    _, edges = nav2_graph(json.loads((tmp_path / "map.geojson").read_text()))
    ends = [edge for edge in edges.values() if 30 in (edge["startid"], edge["endid"])]
    assert len(ends) == 2
    for edge in ends:
        assert edge["metadata"]["door"] == "door_4" and "open_door_4" in edge["operations"]
    with pytest.raises(ValueError, match="frontier_doors has 2 entries of 1"):
        route_graph(building(), regions(), data._replace(frontier_doors=((1,), ())))


def test_a_users_values_stay_and_an_open_end_that_was_annotated_is_noted(tmp_path):
    path = tmp_path / "map.geojson"
    content, _ = written(path)
    edge = next(
        f for f in content["features"] if "open_door_3" in f["properties"].get("operations", {})
    )
    theirs = edge["properties"]
    theirs["metadata"] |= {"class": "ward", "speed_limit": 30.0}
    theirs["operations"]["open_door_3"]["metadata"]["service_name"] = "/lobby/open"
    theirs["operations"]["ring"] = {"type": "Ring", "trigger": "ON_EXIT"}
    for feature in content["features"]:
        if feature["properties"]["id"] == 30:
            feature["properties"]["name"] = "to be explored"
    path.write_text(json.dumps(content))
    found, notes = written(path, old=annotated_map.read(path))
    assert notes == () and found == content
    closed = building()._replace(frontiers=(), frontier_node=[], frontier_id=np.zeros(0, int))
    found, (note,) = written(path, closed, with_regions=False, old=annotated_map.read(path))
    assert "annotations of 1 nodes: ids 30" in note
    _, edges = nav2_graph(found)
    kept = edges[theirs["id"]]
    assert kept["metadata"]["class"] == "ward" and kept["metadata"]["speed_limit"] == 30.0
    assert sorted(kept["operations"]) == ["open_door_3", "ring"]


def test_classes_of_a_user_alone_stay(tmp_path):
    """Without a region beside it, a class is the user's, whatever it is."""
    path = tmp_path / "map.geojson"
    content, _ = written(path, with_regions=False)
    content["features"][0]["properties"]["metadata"]["class"] = "corridor"
    content["features"][-1]["properties"]["operations"] = [{"type": "Ring", "trigger": "NODE"}]
    path.write_text(json.dumps(content))
    found, _ = written(path, with_regions=False, old=annotated_map.read(path))
    assert found == content
    found, _ = written(path, old=annotated_map.read(path))
    assert found["features"][0]["properties"]["metadata"]["class"] == "corridor"


def test_operations_of_a_user_in_an_array_stay_beside_ours(tmp_path):
    path = tmp_path / "map.geojson"
    content, _ = written(path, with_regions=False)
    edge = next(f for f in content["features"] if f["properties"].get("cost") == 8.0)
    edge["properties"]["operations"] = [{"type": "Ring", "trigger": "ON_EXIT"}]
    path.write_text(json.dumps(content))
    for _ in range(2):
        found, _ = written(path, old=annotated_map.read(path))
        nav2_graph(found)
        edge = next(f for f in found["features"] if f["properties"].get("cost") == 8.0)
        types = [each["type"] for each in edge["properties"]["operations"]]
        assert types == ["OpenDoor", "OpenDoor", "Ring"]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"node_region": np.zeros(3, int)}, r"node_region is \(3,\), not \(4,\)"),
        ({"arc_region": np.array([0, 0, 0, 2])}, "arc_region has 0 to 2 of 2 regions"),
        ({"arc_doors": ((2,), (), (), ())}, "arc_doors has an index of none of 2 doors"),
        ({"arc_doors": ()}, "arc_doors has 0 entries"),
        ({"arc_widths": ()}, "arc_widths has 0 entries of 4"),
    ],
)
def test_data_of_another_map_are_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        route_graph(building(), regions(), planner()._replace(**change))


def test_geopandas_reads_points_and_lines_with_their_properties(tmp_path):
    geopandas = pytest.importorskip("geopandas", reason="pip install 'jaxslam[test]'")
    written(tmp_path / "map.geojson")
    frame = geopandas.read_file(tmp_path / "map.geojson")
    points = frame[frame.geometry.geom_type == "Point"].set_index("id")
    lines = frame[frame.geometry.geom_type == "MultiLineString"].set_index("id")
    assert len(points) == 5 and len(lines) == 10
    assert points.loc[11].geometry.coords[0] == (6.0, 8.0)
    as_object = lambda x: json.loads(x) if isinstance(x, str) else x  # noqa: E731
    assert as_object(points.loc[8, "metadata"])["class"] == "corridor"
    for _, line in lines.iterrows():
        whole = line.geometry.geoms[0]
        assert whole.coords[0] == points.loc[int(line.startid)].geometry.coords[0]
        assert whole.coords[-1] == points.loc[int(line.endid)].geometry.coords[0]
    doors = [as_object(x).get("door") for x in lines["metadata"]]
    assert sorted(filter(None, doors)) == ["door_3,door_4"] * 2
