import json

import numpy as np
import pytest
from small_building import building

from experiments import export_readers
from jaxslam.cli import map_files, report
from jaxslam.core.se2_np import dead_reckoning
from jaxslam.io import g2o_writer
from jaxslam.mapping.pose_graph import PoseGraph

for needed in ("gtsam", "igraph", "vdma_lif"):
    pytest.importorskip(needed, reason=f"{needed} is not installed: pip install 'jaxslam[test]'")


@pytest.fixture
def folder(tmp_path):
    """Files of a run: a square that is driven one and a half times."""
    steps = np.tile([[1.0, 0.0, np.pi / 2]], (6, 1))
    graph = PoseGraph(
        poses=dead_reckoning(np.zeros(3), np.concatenate([np.zeros((1, 3)), 1.03 * steps])),
        landmark_positions=np.ones((1, 2)),
        odometry=1.03 * steps,
        odometry_information=np.tile(np.diag([400.0, 900.0, 2500.0]), (6, 1, 1)),
        pose_index=np.array([2]),
        landmark_index=np.array([0]),
        landmark_xy=np.ones((1, 2)),
        landmark_information=np.eye(2)[None],
        closure_ends=np.array([[1, 5]]),
        closure_pose=np.zeros((1, 3)),
        closure_information=np.diag([1e4, 1e4, 1e5])[None],
    )
    g2o_writer.write(tmp_path / "graph.g2o", graph)
    report.write_map(tmp_path / "map.geojson", building())
    map_files.write_exports(tmp_path, building())
    return tmp_path


def test_all_that_is_written_arrives(folder):
    arguments = ["--data", str(folder), "--out", str(folder / "figures")]
    assert export_readers.main(arguments) == 0
    found = json.loads((folder / "figures" / "export_readers.json").read_text())
    g2o = found["g2o"]
    assert (g2o["factors_read"], g2o["edges"], g2o["edges_of_landmarks"]) == (7, 7, 1)
    assert g2o["moved_m"] > 0.05 and g2o["difference_m"] < 0.002
    assert found["graphml"] == {"nodes": 5, "arcs": 5, "right_nodes": 5, "right_arcs": 5}
    assert found["lif"]["edges"] == found["rmf"]["lanes"] > 0


def test_arcs_of_other_lengths_or_ends_are_counted_as_wrong(folder):
    content = json.loads((folder / "map.geojson").read_text())
    for feature in content["features"]:
        properties = feature["properties"]
        if properties.get("metadata", {}).get("arc") == 1:
            properties["cost"] += 1.0
        if properties["id"] == 5:
            feature["geometry"]["coordinates"][0] += 1.0
    found = export_readers.read_graphml(folder / "map.graphml", content["features"])
    assert found == {"nodes": 5, "arcs": 5, "right_nodes": 4, "right_arcs": 4}
