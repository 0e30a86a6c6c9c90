"""What a user adds to map.geojson, and ids of arcs, over sessions; bad files."""

import json

import numpy as np
import pytest

from jaxslam.cli import report
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.io import annotated_map, geojson, strict_json
from jaxslam.io.carry_over import carry_over
from jaxslam.io.errors import InputError
from jaxslam.io.geojson import Arc, Node

NODES = [
    Node(4, 0.0, 0.0, "node", 0.5),
    Node(7, 4.0, 0.0, "node", 0.75),
    Node(9, 2.0, 3.0, "corner", np.nan),
]


def bow(height, start=(0.0, 0.0), end=(4.0, 0.0), count=9):
    """A line between two points, bent by `height` [m]."""
    along = np.linspace(0.0, 1.0, count)[:, None]
    line = np.array(start)[None] * (1 - along) + np.array(end)[None] * along
    return line + np.array([[0.0, height]]) * np.sin(np.pi * along)


def loop(turn, count=33):
    """A ring that starts at node 4 into direction `turn` [rad], with a bulge on its first half."""
    angle = np.linspace(0.0, 2 * np.pi, count)
    radius = np.where(angle < np.pi, 2.0, 1.0)
    ring = np.stack([np.cos(angle + turn), np.sin(angle + turn)], axis=1) * radius[:, None]
    return ring - ring[:1]


def arc(index, start, end, line):
    return Arc(index, start, end, float(len(line)), 0.4, line)


ARCS = [arc(0, 4, 7, bow(2.0)), arc(1, 4, 7, bow(-2.0)), arc(2, 4, 4, loop(0.0))]
GIFTS = [
    {
        "name": "Küche \U0001f680 \ud800",
        "speed": 0.1,
        "deep": {"a": [1, None, {"b": [True, 1e-300]}]},
    },
    {"metadata": {"door": {"wide": 0.9}}, "operations": {"stop": {"type": "Stop", "n": 2**53 + 1}}},
    {"operations": [{"type": "Horn"}], "": "", "cost": 3},
    {"abs_speed_limit": 0.25, "metadata": {"class": "narrow", "list": []}},
    {"one way": False},
]


def features_of(path):
    return json.loads(path.read_text())["features"]


@pytest.fixture
def path(tmp_path):
    geojson.write(tmp_path / "map.geojson", NODES, ARCS)
    return tmp_path / "map.geojson"


def edit(path, change):
    """Change the content of a file in place, as `change` does, and write it compactly."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def give(content):
    """Add what users add: properties of nodes and edges, features, members of the file."""
    for feature, gift in zip(content["features"], GIFTS, strict=False):
        for key, value in gift.items():
            if isinstance(value, dict) and key in feature["properties"]:
                feature["properties"][key].update(value)
            else:
                feature["properties"][key] = value
    content["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}
    content["name"] = "first floor"
    content["bbox"] = [0, 0, 4, 3]  # of the old features: it is left out
    content["features"][3:3] = OWN


OWN = [
    {
        "type": "Feature",
        "id": "a",
        "properties": {"metadata": {"kind": "dock"}, "id": 900},
        "geometry": {"type": "Point", "coordinates": [1, 2, 0]},
        "style": {"fill": "red"},
    },
    {"type": "Feature", "properties": None, "geometry": None},
    {
        "type": "Feature",
        "properties": {"id": 4, "metadata": {"arc": 0}},
        "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]},
    },
    {
        "type": "Feature",
        "properties": {"id": 901, "startid": 900, "endid": 7},
        "geometry": {"type": "LineString", "coordinates": [[1, 2], [4, 0]]},
    },
    {"type": "Feature", "properties": {"x": 1}, "geometry": {"type": "Spline", "knots": [1]}},
]


def next_session(path, nodes=NODES, arcs=ARCS):
    """Read the file, write the next map there; its content, and the notes."""
    old = annotated_map.read(path)
    kept = carry_over(old, nodes, arcs)
    geojson.write(path, kept.nodes, kept.arcs, features=kept.features, members=kept.members)
    return json.loads(path.read_text()), kept.notes


def by_id(content):
    """Properties of nodes and edges by their ids, all different."""
    found = [f["properties"] for f in content["features"] if "frame" in (f["properties"] or {})]
    found += [f["properties"] for f in content["features"] if "cost" in (f["properties"] or {})]
    assert len({p["id"] for p in found}) == len({json.dumps(p) for p in found})
    return {p["id"]: p for p in found}


def test_without_annotations_nothing_of_ours_changes(path):
    before = path.read_bytes()
    for _ in range(2):
        _, notes = next_session(path)
        assert notes == () and path.read_bytes() == before


def test_a_round_trip_keeps_what_a_user_added_exactly(path):
    edit(path, give)
    before = json.loads(path.read_text())
    after, notes = next_session(path)
    assert notes == ()
    ours = [f for f in before["features"] if f not in OWN]
    assert after["features"] == [*ours, *OWN]
    assert json.dumps(after["features"][len(ours) :]) == json.dumps(OWN)
    members = {key: value for key, value in after.items() if key not in ("features", "jaxslam")}
    assert members == {
        key: value for key, value in before.items() if key not in ("features", "bbox")
    }
    again, notes = next_session(path)
    assert notes == () and again == json.loads(path.read_text()) == {**again, **members}


def test_our_keys_win_and_keep_their_values(path):
    expected = by_id(json.loads(path.read_text()))

    def change(content):
        for feature in content["features"]:
            properties = feature["properties"]
            properties["mine"] = 1
            for key in ("cost", "overridable", "frame"):
                if key in properties:
                    properties[key] = "edited"
            for key in ("clearance", "length")[: 1 + ("cost" in properties)]:
                properties["metadata"][key] = -1.0

    edit(path, change)
    found = by_id(next_session(path)[0])
    assert found == {key: {**value, "mine": 1} for key, value in expected.items()}


def test_numbers_and_objects_as_editors_write_them(path):
    edit(path, lambda content: content["features"][0]["properties"].update(name="hall"))
    expected, _ = next_session(path)

    def change(content):
        for number, feature in enumerate(content["features"]):
            properties = feature["properties"]
            for key in ("id", "startid", "endid"):
                if key in properties:
                    properties[key] = (str, float, "{}.000".format)[number % 3](properties[key])
                else:
                    properties[key] = None
            properties["metadata"] = json.dumps(properties["metadata"])
            properties["operations"] = "{}" if number % 2 else None
            properties.setdefault("frame", None)
            if number % 2:
                feature["id"] = properties.pop("id")

    edit(path, change)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert next_session(path) == (expected, ())


def test_parallel_arcs_and_loops_keep_ids_and_annotations_by_geometry(path):
    """They come in another order and direction, bent, on nodes that moved."""

    def name(content):
        for feature in content["features"][3:]:
            p = feature["properties"]
            p["sign"] = [p["metadata"]["arc"], p["id"]]

    edit(path, name)
    moved = [node._replace(x=node.x + 3.0 * node.id, y=node.y - 2.0) for node in NODES]
    end = (4.0 + 21.0, -2.0)
    low = bow(-2.3, (12.0, -2.0), end, 30)[::-1]
    high = bow(1.8, (12.0, -2.0), end, 5)
    middle = bow(0.0, (12.0, -2.0), end)
    ring = (1.1 * loop(0.1) + np.array([[12.0, -2.0]]))[::-1]
    arcs = [arc(0, 4, 4, ring), arc(1, 7, 4, low), arc(2, 4, 7, middle), arc(3, 4, 7, high)]
    found, notes = next_session(path, moved, arcs)
    edges = [f["properties"] for f in found["features"][3:]]
    assert notes == ()
    assert [p["metadata"]["arc"] for p in edges] == [2, 2, 1, 1, 3, 3, 0, 0]
    assert [p.get("sign") for p in edges] == [
        *([2, 15], [2, 14], [1, 13], [1, 12], None, None, [0, 10], [0, 11]),
    ]
    assert [p["id"] for p in edges] == [15, 14, 13, 12, 16, 17, 10, 11]
    assert [(p["startid"], p["endid"]) for p in edges[2:4]] == [(7, 4), (4, 7)]


def test_one_arc_between_two_nodes_is_the_same_wherever_it_runs(path):
    other = [Node(3, 9.0, 9.0, "node", 1.0)]
    geojson.write(path, NODES, ARCS[:1])
    edit(path, lambda content: content["features"][3]["properties"].update(sign=1))
    found, notes = next_session(path, NODES + other, [arc(0, 4, 7, bow(9.0))])
    assert notes == () and found["features"][4]["properties"]["sign"] == 1
    # One of two in a new map is the one that is near the old one, or none.
    arcs = [arc(0, 4, 7, bow(9.0)), arc(1, 4, 7, bow(-9.0))]
    for second, ids in ((bow(8.5), [1, 0]), (bow(3.0), [1, 2])):
        geojson.write(path, NODES, ARCS[:1])
        edit(path, lambda content: content["features"][3]["properties"].update(sign=1))
        next_session(path, NODES, arcs[:1])
        found, notes = next_session(path, NODES, [arcs[1], arc(1, 4, 7, second)])
        assert [f["properties"]["metadata"]["arc"] for f in found["features"][3::2]] == ids
        assert ("0 nodes and of 1 arcs: arcs 0 are gone" in "".join(notes)) == (2 in ids)


def test_lines_that_nav2_route_did_not_save_are_replaced_by_lengths(path):
    arcs = [a._replace(length=length) for a, length in zip(ARCS, (6.0, 7.5, 9.0), strict=True)]
    geojson.write(path, NODES, arcs)

    def change(content):
        for feature in content["features"][3:]:
            del feature["geometry"]["coordinates"]

    edit(path, change)
    new = [arcs[1]._replace(length=7.3), arcs[0]._replace(length=6.4), arcs[2]]
    found, notes = next_session(path, NODES, new)
    assert notes == ()
    assert [f["properties"]["metadata"]["arc"] for f in found["features"][3::2]] == [1, 0, 2]


def test_what_is_gone_is_noted_and_its_ids_never_come_back(path):
    edit(path, lambda content: content["features"][1]["properties"].update(name="x"))
    edit(path, lambda content: content["features"][8]["properties"].update(speed=0.5))
    edit(path, lambda content: content["features"][2]["properties"].update(empty=None))
    found, notes = next_session(path, NODES[:1], [])
    assert len(notes) == 1
    assert "annotations of 1 nodes: ids 7 and of 1 arcs: arcs 2 are gone" in notes[0]
    assert [f["properties"]["id"] for f in found["features"]] == [4]
    found, notes = next_session(path)
    edges = [f["properties"] for f in found["features"][3:]]
    assert notes == () and [p["id"] for p in edges] == [16, 17, 18, 19, 20, 21]
    assert [p["metadata"]["arc"] for p in edges[::2]] == [3, 4, 5]
    # The counters are there as long as they say more than the file.
    assert "jaxslam" not in found


def test_a_node_of_another_kind_gets_nothing(path):
    edit(path, lambda content: content["features"][0]["properties"].update(name="x"))
    found, notes = next_session(path, [NODES[0]._replace(kind="corner"), *NODES[1:]])
    assert "name" not in found["features"][0]["properties"]
    assert len(notes) == 1 and "annotations of 1 nodes: ids 4 " in notes[0]


def test_new_landmarks_take_no_ids_from_next_id_on(path):
    edit(path, give)
    old = annotated_map.read(path)
    assert old.next_id == 902 and old.next_arc == 3
    new = Node(old.next_id, 8.0, 0.0, "node", 1.0)
    arcs = [*ARCS, arc(3, 7, new.id, bow(1.0, end=(8.0, 0.0)))]
    before = by_id(json.loads(path.read_text()))
    found, notes = next_session(path, [*NODES, new], arcs)
    added = by_id(found).keys() - before.keys()
    assert notes == () and before.keys() <= by_id(found).keys()
    assert added == {902, 903, 904}


def test_ids_that_new_landmarks_take_are_given_anew(path):
    edit(path, give)
    new = [Node(11, 8.0, 0.0, "node", 1.0), Node(900, 8.0, 8.0, "node", 1.0)]
    found, notes = next_session(path, [*NODES, *new], ARCS)
    assert len(notes) == 1 and "11 is now 902, 900 is now 903" in notes[0]
    graph = [f for f in found["features"] if (f["geometry"] or {}).get("type") != "Polygon"]
    ids = [p["id"] for f in graph if "id" in (p := f["properties"] or {})]
    assert len(set(ids)) == len(ids) == 3 + 2 + 6 + 2
    by = {p["id"]: p for f in graph if "id" in (p := f["properties"] or {})}
    assert by[902]["startid"] == 7 and by[902]["metadata"]["arc"] == 0  # the edge that was 11
    assert by[902]["one way"] is False
    assert by[903]["metadata"] == {"kind": "dock"}
    assert (by[901]["startid"], by[901]["endid"]) == (903, 7)
    assert next_session(path, [*NODES, *new], ARCS)[1] == ()


def test_a_deleted_direction_and_an_edge_without_a_node_are_noted(path):
    def change(content):
        give(content)
        content["features"] = [
            f for f in content["features"] if (f["properties"] or {}).get("id") != 13
        ]

    edit(path, change)
    nodes = [NODES[0], NODES[2], Node(8, 4.0, 0.0, "node", 1.0)]
    found, notes = next_session(path, nodes, [arc(0, 4, 8, bow(0.0)), ARCS[2]])
    assert len(notes) == 3
    assert "1 nodes: ids 7 and of 1 arcs: arcs 0 are gone" in notes[0]
    assert "arcs 1, of one direction only, are gone" in notes[1]
    assert "your edges 901 end at nodes that are gone" in notes[2]
    assert OWN[3] in found["features"]
    geojson.write(path, NODES, ARCS)
    edit(path, change)
    found, notes = next_session(path)
    assert len(notes) == 1 and "arcs 1 had one direction only" in notes[0]
    edges = [p for p in by_id(found).values() if "startid" in p]
    assert sorted(p["id"] for p in edges) == [10, 11, 12, 14, 15, 902]


def test_no_file_is_no_annotations(tmp_path):
    assert annotated_map.read(tmp_path / "map.geojson") is None
    assert annotated_map.read(tmp_path / "none" / "map.geojson") is None


def test_write_map_takes_the_map_before(tmp_path):
    ends = np.array([[0, 1], [0, 1]])
    graph = TopologicalMap(
        id=np.array([4, 7, 9]),
        xy=np.array([[0.0, 0.0], [4.0, 0.0], [2.0, 3.0]]),
        kind=np.array([JUNCTION, JUNCTION, CORNER]),
        clearance=np.array([0.5, 0.75, 0.0]),
        arc_ends=ends,
        arc_length=np.array([5.0, 6.0]),
        arc_clearance=np.array([0.4, np.nan]),
        arc_lines=(bow(2.0), bow(-2.0)),
    )
    path = tmp_path / "map.geojson"
    assert report.write_map(path, graph)[0] == ()
    first = path.read_bytes()
    assert report.write_map(path, graph, annotated_map.read(path))[0] == ()
    assert path.read_bytes() == first
    edit(path, lambda content: content["features"][0]["properties"].update(name="hall"))
    edit(path, lambda content: content["features"][3]["properties"].update(name="aisle"))
    turned = graph._replace(
        arc_length=graph.arc_length[::-1], arc_lines=graph.arc_lines[::-1], arc_ends=ends
    )
    assert report.write_map(path, turned, annotated_map.read(path))[0] == ()
    names = {f["properties"]["id"]: f["properties"].get("name") for f in features_of(path)}
    assert names == {4: "hall", 7: None, 9: None, 10: "aisle", 11: None, 12: None, 13: None}
    without = graph._replace(
        arc_ends=ends[:0],
        arc_length=graph.arc_length[:0],
        arc_clearance=graph.arc_clearance[:0],
        arc_lines=(),
    )
    (note,), _ = report.write_map(path, without, annotated_map.read(path))
    assert "annotations of 0 nodes and of 1 arcs: arcs 0 are gone" in note


def test_write_refuses_edges_with_the_ids_of_nodes(tmp_path):
    with pytest.raises(ValueError, match="ids of nodes and edges must differ"):
        geojson.write(tmp_path / "map.geojson", NODES, [ARCS[0]._replace(edges=(7, 20))])


def refused(path):
    with pytest.raises(InputError) as caught:
        annotated_map.read(path)
    line = str(caught.value)
    assert line.startswith(f"{path}:") and "\n" not in line and len(line) < 300 + len(str(path))
    assert "; " in line  # advice
    return line.removeprefix(f"{path}:").strip()


@pytest.mark.parametrize(
    "content, problem",
    [
        (b"", "1: is not JSON (Expecting value)"),
        (b"{\n 1", "2: is not JSON (Expecting property name"),
        (b"[]", "type: is no FeatureCollection"),
        (b"null", "type: is no FeatureCollection"),
        (b'{"type": "Feature"}', "type: is no FeatureCollection"),
        (b'{"type": "FeatureCollection"}', "features: missing or no array"),
        (b'{"type": "FeatureCollection", "features": {}}', "features: missing or no array"),
        (b'{"type": "FeatureCollection", "features": [], "a": NaN}', "is not JSON (NaN is no"),
        (b'{"type": "FeatureCollection", "features": [], "a": -Infinity}', "is not JSON (-Inf"),
        (b'{"type": "FeatureCollection", "features": [], "a": 1e999}', "is not JSON (1e999 is"),
        (b'{"a": {"b": 1, "b": 2}}', "is not JSON (an object has the key 'b' twice)"),
        (b'{"a": 1' + 5000 * b"0" + b"}", "is not JSON (a number has 5001 digits)"),
        (b'{"a": ' + 65 * b"[" + 65 * b"]" + b"}", "is nested more than 64 deep"),
        (100_000 * b"[", "is nested more than 64 deep"),
        ("{}".encode("utf-16"), "is not UTF-8; save"),
        (b'{"type": "FeatureCollection", "features": [], "jaxslam": 3}', "jaxslam: is not an"),
        (
            b'{"type": "FeatureCollection", "features": [], "jaxslam": {"next_id": -3}}',
            "jaxslam: is not an object of next_id",
        ),
        (b'{"type": "FeatureCollection", "features": [3]}', "features[0]: is no Feature"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, content, problem):
    path = tmp_path / "map.geojson"
    path.write_bytes(content)
    assert refused(path).startswith(problem)


def set_property(number, **values):
    """Change properties of a feature; None removes one."""

    def change(content):
        properties = content["features"][number]["properties"]
        properties.update(values)
        for key in [key for key, value in values.items() if value is None]:
            del properties[key]

    return change


def set_member(number, **values):
    return lambda content: content["features"][number].update(values)


@pytest.mark.parametrize(
    "change, problem",
    [
        (set_property(1, id=None), "features[1].properties.id: missing; write the number"),
        (set_property(4, id=None), "features[4].properties.id: missing"),
        (set_property(1, id=7.5), "features[1].properties.id: 7.5 is no whole number"),
        (set_property(1, id="7a"), "features[1].properties.id: '7a' is no whole number"),
        (set_property(1, id="7.5"), "features[1].properties.id: '7.5' is no whole"),
        (set_property(1, id="\u0667"), "features[1].properties.id: '\u0667' is no whole"),
        (set_property(1, id=True), "features[1].properties.id: True is no whole number"),
        (set_property(1, id=-7), "features[1].properties.id: -7 is no whole number"),
        (set_property(1, id=2**31), "features[1].properties.id: 2147483648 is no whole number"),
        (set_property(1, id=10**299), "features[1].properties.id: 1000"),
        (set_property(1, id=[7]), "features[1].properties.id: [7] is no whole number"),
        (set_property(1, id={"a": 99 * "b\n"}), "features[1].properties.id: {'a': 'b\\nb"),
        (set_property(1, id="4"), "features[1].properties.id: 4 is also that of features[0]"),
        (set_property(4, id=9), "features[4].properties.id: 9 is also that of features[2]"),
        (
            lambda content: content["features"].append(OWN[0] | {"properties": {"id": 11}}),
            "features[9].properties.id: 11 is also that of features[4]",
        ),
        (set_property(3, startid=None), "features[3].properties.startid: missing"),
        (set_property(3, endid="b"), "features[3].properties.endid: 'b' is no whole number"),
        (
            set_property(3, metadata={"arc": 0.5}),
            "features[3].properties.metadata.arc: 0.5 is no whole number",
        ),
        (
            set_property(5, metadata={"arc": 0}),
            "features[5].properties.metadata.arc: 0 is also that of features[3] and features[4]",
        ),
        (
            set_property(4, startid=4),
            "features[4].properties.metadata.arc: 0 is also that of features[3], and an arc has",
        ),
        (
            set_property(3, startid=77),
            "features[3].properties.startid: 77 is the id of no node; wr",
        ),
        (set_property(4, endid=77), "features[4].properties.endid: 77 is the id of no node; wr"),
        (set_member(2, properties=[]), "features[2].properties: is list, not an object"),
        (set_member(2, properties="a"), "features[2].properties: is str, not an object"),
        (set_member(2, geometry=3), "features[2].geometry: is int, not an object"),
        (set_member(2, type="feature"), "features[2]: is no Feature"),
        (
            set_member(3, geometry={"type": "MultiLineString", "coordinates": [[["a", 2], [3]]]}),
            "features[3].geometry.coordinates: are no points",
        ),
        (
            set_member(3, geometry={"type": "LineString", "coordinates": [[1, 2]]}),
            "features[3].geometry.coordinates: are no points",
        ),
        (
            set_member(3, geometry={"type": "LineString", "coordinates": [[1, 2], ["nan", 1]]}),
            "features[3].geometry.coordinates: are no points",
        ),
        (
            lambda content: [f["properties"].pop("metadata") for f in content["features"]],
            "features: no Point has metadata.kind; an editor dropped it",
        ),
    ],
)
def test_bad_features_are_refused_in_one_line(path, change, problem):
    edit(path, change)
    assert refused(path).startswith(problem)


def test_a_folder_and_a_large_file_are_refused(tmp_path, monkeypatch):
    (tmp_path / "map.geojson").mkdir()
    assert refused(tmp_path / "map.geojson").startswith("cannot be read (Is a directory)")
    monkeypatch.setattr(strict_json, "MAX_BYTES", 2**20)
    (tmp_path / "b.geojson").write_bytes((2**20 + 1) * b" ")
    assert refused(tmp_path / "b.geojson").startswith("is larger than 1 MiB")
