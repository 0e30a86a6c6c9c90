import json

import jax.numpy as jnp
import numpy as np
import pytest
from small_building import ARC_WIDTHS, building, planner, regions

from jaxslam.cli import report
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.types import JUNCTION
from jaxslam.io import graphml
from jaxslam.io.errors import InputError

networkx = pytest.importorskip("networkx")


def topological_map():
    return TopologicalMap(
        id=np.array([5, 8]),
        xy=np.array([[0.0, 0.5], [2.0, 0.0]]),
        kind=np.array([JUNCTION, JUNCTION]),
        clearance=np.array([1.0, np.inf]),
        arc_ends=np.array([[0, 1], [1, 1]]),
        arc_length=np.array([2.5, 3.0]),
        arc_clearance=np.array([0.75, np.nan]),
        arc_lines=(np.array([[0.0, 0.5], [2.0, 0.0]]), np.array([[2.0, 0.0], [2.0, 0.0]])),
    )


@pytest.mark.parametrize("convert", [np.asarray, np.ndarray.tolist, jnp.asarray])
def test_networkx_reads_the_map(tmp_path, convert):
    graph = topological_map()
    numbers = graph._replace(arc_lines=tuple(map(convert, graph.arc_lines)))
    for field in ("id", "xy", "clearance", "arc_ends", "arc_length", "arc_clearance"):
        numbers = numbers._replace(**{field: convert(getattr(graph, field))})
    graphml.write(tmp_path / "map.graphml", numbers)
    found = networkx.read_graphml(tmp_path / "map.graphml", force_multigraph=True)
    assert dict(found.nodes(data=True)) == {
        "5": {"name": "5", "kind": "node", "x": 0.0, "y": 0.5, "clearance": 1.0},
        "8": {"name": "8", "kind": "node", "x": 2.0, "y": 0.0},
    }
    line = "LINESTRING (0.0 0.5, 2.0 0.0)"
    (arc,) = found.get_edge_data("5", "8").values()
    names = {"arc": 0, "start": "5", "end": "8"}
    more = {"length": 2.5, "clearance": 0.75, "line": line, "speed_limit": 93.8}
    assert arc == names | more
    (loop,) = found.get_edge_data("8", "8").values()
    assert loop["length"] == 3.0 and "clearance" not in loop and loop["arc"] == 1


def test_networkx_reads_regions_doors_and_widths(tmp_path):
    graphml.write(tmp_path / "map.graphml", building(), regions(), planner())
    found = networkx.read_graphml(tmp_path / "map.graphml", force_multigraph=True)
    nodes = {name: (data.get("region"), data.get("class")) for name, data in found.nodes.items()}
    corridor, room = ("room_2", "corridor"), ("room_1", "room")
    none = (None, None)
    assert nodes == {"5": corridor, "7": none, "8": corridor, "11": room, "30": none}
    arcs = {data["arc"]: data for *_, data in found.edges(data=True)}
    assert (arcs[0]["region"], arcs[0]["class"]) == ("room_2", "door")
    assert arcs[0]["door"] == "door_3,door_4" and "door" not in arcs[1]
    widths = [float(width) for width in arcs[1]["widths"].split(",")]
    np.testing.assert_array_equal(widths, ARC_WIDTHS[1])
    assert arcs[0]["clearance"] == 0.45 and "clearance" not in arcs[2] and "class" not in arcs[2]


def test_open_ends_are_nodes_as_in_the_geojson(tmp_path):
    line = np.array([[2.0, 0.0], [3.0, 0.0], [3.0, 2.0]])
    graph = topological_map()._replace(
        frontiers=(line,), frontier_node=np.array([1]), frontier_id=np.array([9])
    )
    report.write_map(tmp_path / "map.geojson", graph)
    graphml.write(tmp_path / "map.graphml", graph)
    found = networkx.read_graphml(tmp_path / "map.graphml", node_type=int, force_multigraph=True)
    assert found.nodes[9] == {"name": "9", "kind": "frontier", "x": 3.0, "y": 2.0}
    (arc,) = found.get_edge_data(8, 9).values()
    assert (arc["arc"], arc["start"], arc["end"], arc["length"]) == (2, "8", "9", 3.0)
    features = json.loads((tmp_path / "map.geojson").read_text())["features"]
    points = {
        f["properties"]["id"]: f["properties"]["metadata"]["kind"]
        for f in features
        if f["geometry"]["type"] == "Point"
    }
    assert points == dict(found.nodes(data="kind"))
    assert len(features) == len(found) + 2 * found.number_of_edges()


def test_igraph_reads_all_nodes_and_arcs_by_their_names(tmp_path):
    """Its edges' own ids are those of nodes, which is why arcs have attributes for all of it."""
    igraph = pytest.importorskip("igraph", reason="pip install 'jaxslam[test]'")
    rng = np.random.default_rng(0)
    count = 40
    ends = np.concatenate([rng.integers(0, count, (60, 2)), [[3, 3], [3, 3], [1, 2], [2, 1]]])
    graph = building()._replace(
        id=rng.permutation(100)[:count],  # some are numbers of arcs, too
        xy=rng.normal(size=(count, 2)),
        kind=np.full(count, JUNCTION),
        clearance=rng.uniform(size=count),
        arc_ends=ends,
        arc_length=rng.uniform(size=len(ends)),
        arc_clearance=rng.uniform(size=len(ends)),
        arc_lines=tuple(rng.normal(size=(len(ends), 3, 2))),
        frontiers=(),
        frontier_node=np.zeros(0, int),
        frontier_id=np.zeros(0, int),
    )
    graphml.write(tmp_path / "map.graphml", graph)
    found = igraph.Graph.Read_GraphML(str(tmp_path / "map.graphml"))
    assert found.vcount() == count and found.ecount() == len(ends)
    for node, (x, y) in zip(graph.id.tolist(), graph.xy.tolist(), strict=True):
        vertex = found.vs.find(name=str(node))
        assert (vertex["x"], vertex["y"]) == (x, y)
    for arc, pair in enumerate(ends.tolist()):
        edge = found.es.find(arc=arc)
        start, end = (str(graph.id[k]) for k in pair)
        assert {found.vs[k]["name"] for k in edge.tuple} == {start, end}
        assert (edge["start"], edge["end"]) == (start, end)
        assert edge["length"] == graph.arc_length[arc]
        assert edge["line"] == graphml._well_known_text(graph.arc_lines[arc])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"xy": np.zeros((2, 3))}, r"xy is .* \(2, 3\), not \(N, 2\)"),
        ({"clearance": np.ones(3)}, r"clearance is .* \(3,\), not \(2,\)"),
        ({"arc_ends": [[0, 2], [1, 1]]}, "arc_ends has indices 0 to 2 of 2 nodes"),
        ({"arc_length": ["a", "b"]}, "arc_length is <U1"),
        ({"arc_lines": ()}, "arc_lines has 0 lines, arc_ends 2 arcs"),
        ({"arc_lines": (np.zeros((2, 2)), np.zeros(2))}, r"arc_lines\[1\] is"),
    ],
)
def test_what_is_no_map_is_not_written(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        graphml.write(tmp_path / "map.graphml", topological_map()._replace(**change))
    assert not list(tmp_path.iterdir())


def test_without_networkx_the_line_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr(graphml, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'jaxslam\[graph\]'"):
        graphml.write(tmp_path / "map.graphml", topological_map())
