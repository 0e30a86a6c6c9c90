"""map.lif.json by the rules of the published JSON schema of LIF 1.0.0, and of its document."""

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from small_building import building, planner, regions

from jaxslam.io import lif

TURNS = ("NONE", "CCW", "CW", "BOTH")
ACTION = {
    "actionType": str,
    "actionDescription?": str,
    "requirementType?": ("REQUIRED", "CONDITIONAL", "OPTIONAL"),
    "blockingType": ("NONE", "SOFT", "HARD"),
    "actionParameters?": [{"key": str, "value": str}],
}
# A key with ? may be missing; a tuple lists all values, a list has the form of all items.
LIF = {
    "metaInformation": {
        "projectIdentification": str,
        "creator": str,
        "exportTimestamp": str,
        "lifVersion": str,
    },
    "layouts": [
        {
            "layoutId": str,
            "layoutName?": str,
            "layoutVersion": str,
            "layoutLevelId?": str,
            "layoutDescription?": str,
            "nodes": [
                {
                    "nodeId": str,
                    "nodeName?": str,
                    "nodeDescription?": str,
                    "mapId?": str,
                    "nodePosition": {"x": float, "y": float},
                    "vehicleTypeNodeProperties": [
                        {"vehicleTypeId": str, "theta?": float, "actions?": [ACTION]}
                    ],
                }
            ],
            "edges": [
                {
                    "edgeId": str,
                    "edgeName?": str,
                    "edgeDescription?": str,
                    "startNodeId": str,
                    "endNodeId": str,
                    "vehicleTypeEdgeProperties": [
                        {
                            "vehicleTypeId": str,
                            "vehicleOrientation?": float,
                            "orientationType?": ("GLOBAL", "TANGENTIAL"),
                            "rotationAllowed": bool,
                            "rotationAtStartNodeAllowed?": TURNS,
                            "rotationAtEndNodeAllowed?": TURNS,
                            "maxSpeed?": float,
                            "maxRotationSpeed?": float,
                            "minHeight?": float,
                            "maxHeight?": float,
                            "loadRestriction?": {
                                "unloaded": bool,
                                "loaded": bool,
                                "loadSetNames?": [str],
                            },
                            "actions?": [ACTION],
                            "trajectory?": {
                                "degree?": float,
                                "knotVector": [float],
                                "controlPoints": [{"x": float, "y": float, "weight?": float}],
                            },
                            "reentryAllowed?": bool,
                        }
                    ],
                }
            ],
            "stations": [
                {
                    "stationId": str,
                    "interactionNodeIds": [str],
                    "stationName?": str,
                    "stationDescription?": str,
                    "stationHeight?": float,
                    "stationPosition?": {"x": float, "y": float, "theta?": float},
                }
            ],
        }
    ],
}


def check(value, form, where="file"):
    """Raise ValueError unless a value has a form, and no key that is not in it."""
    if isinstance(form, tuple):
        right = value in form
    elif isinstance(form, list):
        right = isinstance(value, list)
        for number, item in enumerate(value if right else []):
            check(item, form[0], f"{where}[{number}]")
    elif isinstance(form, dict):
        right = isinstance(value, dict)
        known = {key.rstrip("?"): key for key in form}
        needed = {key for key in form if not key.endswith("?")}
        if right and not (needed <= value.keys() <= known.keys()):
            raise ValueError(f"{where} has the keys {sorted(value)}")
        for key, item in value.items() if right else ():
            check(item, form[known[key]], f"{where}.{key}")
    elif form is float:
        right = isinstance(value, float | int) and not isinstance(value, bool)
    else:
        right = isinstance(value, form)
    if not right:
        raise ValueError(f"{where} is {value!r:.60}")


def read(path):
    """Nodes and edges by id of the layouts, by the rules of the schema and of the document."""
    content = json.loads(path.read_text())
    check(content, LIF)
    stamp = content["metaInformation"]["exportTimestamp"]
    assert datetime.fromisoformat(stamp).tzinfo is UTC and stamp.endswith("Z")
    assert content["metaInformation"]["lifVersion"] == "1.0.0"
    nodes, edges = {}, {}
    for layout in content["layouts"]:
        inside = {node["nodeId"] for node in layout["nodes"]}
        for key, items, found in (("nodeId", "nodes", nodes), ("edgeId", "edges", edges)):
            for item in layout[items]:
                assert item[key] not in found, "ids are unique across all layouts"
                found[item[key]] = item
                vehicles = [
                    v["vehicleTypeId"] for k in item if k.startswith("vehicle") for v in item[k]
                ]
                assert vehicles and len(set(vehicles)) == len(vehicles)
        assert all(edge["startNodeId"] in inside for edge in layout["edges"])
    assert all(edge["endNodeId"] in nodes for edge in edges.values())
    return nodes, edges


@pytest.fixture
def path(tmp_path):
    lif.write(tmp_path / "map.lif.json", building(), regions(), planner(), max_speed=2.0)
    return tmp_path / "map.lif.json"


def test_a_map_follows_the_schema(path):
    nodes, edges = read(path)
    assert {"5", "8", "11", "arc2_1"} <= nodes.keys() and not {"7", "30"} & nodes.keys()
    assert nodes["11"]["nodePosition"] == {"x": 6.0, "y": 8.0}
    assert nodes["11"]["nodeDescription"] == "room_1"
    assert len(edges) == 2 * (4 + 1 + 2 + 4)


def test_edges_lead_along_arcs_in_both_directions_with_their_speeds(path):
    nodes, edges = read(path)
    pairs = {(edge["startNodeId"], edge["endNodeId"]) for edge in edges.values()}
    assert {pair[::-1] for pair in pairs} == pairs
    there, back = edges["arc2_0_there"], edges["arc2_0_back"]
    assert (there["startNodeId"], there["endNodeId"]) == ("5", "arc2_1")
    assert (back["startNodeId"], back["endNodeId"]) == ("arc2_1", "5")
    speeds = {
        name: edge["vehicleTypeEdgeProperties"][0].get("maxSpeed") for name, edge in edges.items()
    }
    assert speeds["arc0_0_there"] == 1.125 and speeds["arc1_0_back"] is None
    assert speeds["arc2_1_there"] == 0.4 and speeds["arc3_0_there"] == 0.75
    assert edges["arc0_1_there"]["edgeDescription"] == "room_2, door_3"
    assert edges["arc0_0_back"]["edgeDescription"] == "room_2"
    reached, ahead = {"5"}, ["5"]
    while ahead:
        here = ahead.pop()
        more = {end for start, end in pairs if start == here} - reached
        reached |= more
        ahead += more
    assert reached == nodes.keys()


def test_time_and_names_can_be_given_and_the_file_is_then_the_same(tmp_path):
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    for file in files:
        time = datetime(2024, 3, 1, 12, 0, tzinfo=UTC)
        lif.write(file, building(), vehicle_type="maker.series", project="hall 3", time=time)
    assert files[0].read_bytes() == files[1].read_bytes()
    content = json.loads(files[0].read_text())
    read(files[0])
    assert content["metaInformation"]["exportTimestamp"] == "2024-03-01T12:00:00.000Z"
    (layout,) = content["layouts"]
    assert layout["layoutId"] == layout["nodes"][0]["mapId"] == "hall 3"
    assert layout["nodes"][0]["vehicleTypeNodeProperties"] == [{"vehicleTypeId": "maker.series"}]


@pytest.mark.parametrize(
    "change, problem",
    [
        (lambda layout: layout.pop("stations"), "has the keys"),
        (lambda layout: layout["nodes"][0].update(nodeId=5), r"nodes\[0\].nodeId is 5"),
        (
            lambda layout: layout["nodes"][0]["nodePosition"].update(x=None),
            "nodePosition.x is None",
        ),
        (
            lambda layout: layout["edges"][1]["vehicleTypeEdgeProperties"][0].update(
                orientationType="tangential"
            ),
            "orientationType is 'tangential'",
        ),
    ],
)
def test_the_check_of_the_schema_finds_what_is_wrong(path, change, problem):
    content = json.loads(path.read_text())
    change(content["layouts"][0])
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=problem):
        read(path)


def test_an_empty_map_is_a_layout_without_nodes(tmp_path):
    nothing = building()._replace(
        id=np.zeros(0, int),
        xy=np.zeros((0, 2)),
        kind=np.zeros(0, int),
        clearance=np.zeros(0),
        arc_ends=np.zeros((0, 2), int),
        arc_length=np.zeros(0),
        arc_clearance=np.zeros(0),
        arc_lines=(),
    )
    lif.write(tmp_path / "map.lif.json", nothing)
    assert read(tmp_path / "map.lif.json") == ({}, {})


def test_the_parser_of_continua_systems_reads_all_of_a_map(path):
    parser = pytest.importorskip("vdma_lif.parser", reason="pip install 'jaxslam[test]'")
    nodes, edges = read(path)
    (layout,) = parser.LIFParser.from_file(str(path)).layouts
    assert [node.node_id for node in layout.nodes] == list(nodes)
    for edge in layout.edges:
        (found,) = edge.vehicle_type_edge_properties
        written = edges[edge.edge_id]
        assert (edge.start_node_id, edge.end_node_id) == (
            written["startNodeId"],
            written["endNodeId"],
        )
        (expected,) = written["vehicleTypeEdgeProperties"]
        assert (found.max_speed, found.rotation_allowed) == (expected.get("maxSpeed"), False)
    assert len(layout.edges) == len(edges)
