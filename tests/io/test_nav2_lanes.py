"""The route graph of straight edges: it leads along the arcs, and opens each door where it is."""

import json

import numpy as np
from nav2_rules import nav2_graph
from small_building import building, planner, regions

from jaxslam.core import polylines
from jaxslam.io import nav2_lanes
from jaxslam.io.straight_lanes import TOLERANCE, straight_lanes


def written(path):
    nav2_lanes.write(path, building(), straight_lanes(building(), regions(), planner()))
    return json.loads(path.read_text())


def test_straight_edges_lie_along_the_arcs(tmp_path):
    content, graph = written(tmp_path / "lanes.geojson"), building()
    nodes, edges = nav2_graph(content)
    assert {5, 8, 11} <= nodes.keys() and not {7, 30} & nodes.keys()
    at = {
        f["properties"]["id"]: f["geometry"]["coordinates"]
        for f in content["features"]
        if f["geometry"]["type"] == "Point"
    }
    np.testing.assert_array_equal(at[8], graph.xy[2])
    length = np.zeros(len(graph.arc_lines))
    for edge in edges.values():
        arc = edge["metadata"]["map_arc"]
        ends = np.array([at[edge["startid"]], at[edge["endid"]]])
        dense = polylines.refine(ends, 0.05)
        assert polylines.project(dense, graph.arc_lines[arc])[0].max() <= TOLERANCE + 1e-9
        length[arc] += 0.5 * edge["cost"]  # there and back
    np.testing.assert_allclose(length, [polylines.length(x) for x in graph.arc_lines], rtol=0.01)


def test_lanes_name_the_arcs_of_the_map(tmp_path):
    lanes = straight_lanes(building(), arc_ids=[40, 7, 9, 12, 30])
    nav2_lanes.write(tmp_path / "lanes.geojson", building(), lanes)
    _, edges = nav2_graph(json.loads((tmp_path / "lanes.geojson").read_text()))
    assert {edge["metadata"]["map_arc"] for edge in edges.values()} == {40, 7, 9, 12}
    assert {name.split("_")[0] for name in lanes.names if name.startswith("arc")} <= {
        f"arc{k}" for k in (40, 7, 9, 12)
    }


def test_a_door_is_opened_by_short_edges_alone(tmp_path):
    _, edges = nav2_graph(written(tmp_path / "lanes.geojson"))
    opened = {}
    for edge in edges.values():
        for each in edge.get("operations", {}).values():
            opened.setdefault(each["metadata"]["door"], []).append(edge["cost"])
            assert edge["metadata"]["map_arc"] == 0
        is_door = edge["metadata"].get("class") == "door"
        assert is_door == bool(edge.get("operations")) == ("door" in edge["metadata"])
    assert set(opened) == {"door_3", "door_4"}
    assert all(sum(costs) / 2 <= 2.0 for costs in opened.values())
