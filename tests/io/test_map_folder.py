import json

import numpy as np
import pytest

from jaxslam.core.maps import OccupancyMap
from jaxslam.io import geojson, ros_map
from jaxslam.io.errors import InputError
from jaxslam.io.geojson import Arc, Node
from jaxslam.io.map_folder import USERS, read_map_folder

NODES = [
    Node(3, 0.0, 0.0, "node", 0.8),
    Node(4, 4.0, 0.0, "node", 0.7),
    Node(5, 4.0, 3.0, "node", np.nan),
    Node(6, 9.0, 9.0, "corner", np.nan),
]
ARCS = [
    Arc(0, 3, 4, 4.2, 0.6, np.array([[0.0, 0.0], [2.0, 0.5], [4.0, 0.0]])),
    Arc(1, 4, 5, 3.0, np.nan, np.array([[4.0, 0.0], [4.0, 3.0]])),
]


@pytest.fixture
def folder(tmp_path):
    geojson.write(tmp_path / "map.geojson", NODES, ARCS)
    return tmp_path


def edit(folder, change):
    """Change the features of a map as a user does, and read it."""
    path = folder / "map.geojson"
    content = json.loads(path.read_text())
    change(content["features"])
    path.write_text(json.dumps(content))
    return read_map_folder(folder)


def edges(features):
    return [f for f in features if f["geometry"]["type"] == "MultiLineString"]


def test_a_written_map_is_read(folder):
    known = read_map_folder(folder)
    graph = known.graph
    assert graph.id.tolist() == [3, 4, 5, 6] and graph.kind.tolist() == [0, 0, 0, 1]
    np.testing.assert_array_equal(graph.xy, [(n.x, n.y) for n in NODES])
    np.testing.assert_array_equal(graph.clearance, [0.8, 0.7, np.nan, np.nan])
    assert graph.arc_ends.tolist() == [[0, 1], [1, 2]] and known.arc_id.tolist() == [0, 1]
    np.testing.assert_array_equal(graph.arc_clearance, [0.6, np.nan])
    np.testing.assert_allclose(graph.arc_length, [2 * np.hypot(2.0, 0.5), 3.0])
    for line, arc in zip(graph.arc_lines, ARCS, strict=True):
        np.testing.assert_array_equal(line, arc.points)
    assert not known.directed.any() and known.occupancy is None and known.regions is None
    assert known.notes == ("no map.yaml: obstacles beside the arcs are not known",)
    assert read_map_folder(folder / "map.geojson").graph.id.tolist() == [3, 4, 5, 6]


def test_the_occupancy_map_beside_it_is_read(folder):
    free = np.zeros((4, 5), bool)
    free[1:3, 2] = True
    ros_map.write(folder / "map.yaml", OccupancyMap(~free, free, 0.5, np.array([1.0, 2.0, 0.0])))
    known = read_map_folder(folder)
    np.testing.assert_array_equal(known.occupancy.free, free)
    assert known.notes == ()
    (folder / "map.pgm").unlink()
    with pytest.raises(InputError, match="map.pgm: does not exist"):
        read_map_folder(folder)


@pytest.mark.parametrize("deleted, ends", [(0, [1, 0]), (1, [0, 1])])
def test_of_a_deleted_edge_the_other_direction_is_left(folder, deleted, ends):
    known = edit(folder, lambda features: features.remove(edges(features)[deleted]))
    assert known.directed.tolist() == [True, False]
    assert known.graph.arc_ends[0].tolist() == ends
    np.testing.assert_array_equal(known.graph.arc_lines[0][[0, -1]], known.graph.xy[ends])


def test_without_both_edges_there_is_no_arc(folder):
    def change(features):
        for edge in edges(features)[:2]:
            features.remove(edge)

    assert edit(folder, change).arc_id.tolist() == [1]


def test_what_a_user_moved_and_added_counts(folder):
    def change(features):
        features[0]["geometry"]["coordinates"] = [0.0, -1.0]
        features.append(feature("Point", [8.0, 0.0], id=100))
        features.append(feature("LineString", [[4, 0], [6, 1], [8, 0]], startid=4, endid=100))
        features.append(feature("LineString", [[8, 0], [4, 0]], startid=100, endid=4))
        features.append(feature("LineString", [[4, 3], [0, 0]], startid=5, endid=3))
        features.append(feature("LineString", [[4, 3], [0, 0]]))  # of no nodes: a drawing

    known = edit(folder, change)
    assert known.graph.id.tolist() == [3, 4, 5, 6, 100]
    np.testing.assert_array_equal(known.graph.arc_lines[0][:2], [[0.0, -1.0], [0.0, 0.0]])
    assert known.arc_id.tolist() == [0, 1, USERS, USERS]
    assert known.graph.arc_ends[2:].tolist() == [[1, 4], [2, 0]]
    assert known.directed.tolist() == [False, False, False, True]
    np.testing.assert_array_equal(known.graph.arc_lines[2], [[4, 0], [6, 1], [8, 0]])


def feature(kind, coordinates, **properties):
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def test_edges_without_a_line_are_straight(folder):
    def change(features):
        for edge in edges(features):
            edge["geometry"] = None if edge["properties"]["startid"] == 4 else edge["geometry"]

    def drop(features):
        for edge in features[4:]:
            edge["geometry"] = None

    path = folder / "map.geojson"
    known = edit(folder, change)  # each has the line of its other direction
    np.testing.assert_array_equal(known.graph.arc_lines[0], ARCS[0].points)
    geojson.write(path, NODES, ARCS)
    np.testing.assert_array_equal(edit(folder, drop).graph.arc_lines[0], [[0, 0], [4, 0]])


def test_arcs_of_deleted_nodes_are_left_out_with_a_note(folder):
    known = edit(folder, lambda features: features.pop(2))
    assert known.arc_id.tolist() == [0]
    assert known.notes[0] == "arcs of map.geojson that end at no node are left out: 1"


def test_open_ends_are_nodes(folder):
    known = edit(
        folder, lambda features: features[2]["properties"]["metadata"].update(kind="frontier")
    )
    assert known.graph.id.tolist() == [3, 4, 5, 6] and known.graph.kind[2] == 0


def test_what_is_no_map_is_refused(folder):
    with pytest.raises(InputError, match="none: does not exist; name an output folder of"):
        read_map_folder(folder / "none")
    (folder / "file").write_text("")
    with pytest.raises(InputError, match="file: is no folder; name"):
        read_map_folder(folder / "file")
    advice = "correct it, or make the map anew with `jaxslam run` or `jaxslam map`"
    with pytest.raises(InputError, match=rf"features\[0\]: is no Feature; {advice}"):
        edit(folder, lambda features: features.insert(0, {}))
    geojson.write(folder / "map.geojson", NODES, ARCS)
    (folder / "rooms.json").write_text("{}")
    advice = "correct it, or remove the file to do without its rooms"
    with pytest.raises(InputError, match=f"format: is no jaxslam-rooms file; {advice}"):
        read_map_folder(folder)
    (folder / "rooms.json").unlink()
    assert read_map_folder(folder).regions is None
    with pytest.raises(
        InputError, match=r"map.geojson: node 3: has no position within 1e\+07 m of 0, 0; give"
    ):
        edit(folder, lambda features: features[0]["geometry"].update(coordinates=["a", 1]))
    geojson.write(folder / "map.geojson", NODES, ARCS)
    with pytest.raises(InputError, match=r"map.geojson: line 99: are no points of a line"):
        edit(
            folder,
            lambda features: features.append(feature("LineString", [1], id=99, startid=3, endid=4)),
        )
    (folder / "map.geojson").unlink()
    with pytest.raises(InputError, match="holds no map.geojson; name"):
        read_map_folder(folder)
