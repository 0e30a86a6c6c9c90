import jax.numpy as jnp
import numpy as np
import pytest

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
        "5": {"x": 0.0, "y": 0.5, "clearance": 1.0},
        "8": {"x": 2.0, "y": 0.0},
    }
    line = "LINESTRING (0.0 0.5, 2.0 0.0)"
    (arc,) = found.get_edge_data("5", "8").values()
    assert arc == {"length": 2.5, "clearance": 0.75, "line": line}
    (loop,) = found.get_edge_data("8", "8").values()
    assert loop["length"] == 3.0 and "clearance" not in loop


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
