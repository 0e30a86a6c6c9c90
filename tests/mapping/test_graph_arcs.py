import numpy as np
import pytest

from jaxslam.mapping import graph_arcs


@pytest.mark.parametrize(
    "xs, pairs",
    [
        ([0.0, 0.5, 0.0], []),  # never out of a circle
        ([0.0, 0.5, 2.0, 0.5, 0.0], [(0, 0)]),  # out of it and back into it
        ([0.0, 2.0, 4.0], [(0, 1)]),
        ([4.0, 2.0, 0.0, 4.0], [(1, 0), (0, 1)]),
        ([0.0, 4.0, 6.0, 8.0, 0.0], [(0, 1), (1, 2), (2, 0)]),
        ([2.0, 6.0], []),  # in no circle
        ([7.4, 7.6], [(3, 2)]),  # in two: the nearer counts
    ],
)
def test_driven_arcs_go_from_circle_to_circle(xs, pairs):
    xy = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [7.0, 0.0]])
    poses = np.array([[x, 0.0, 1.0] for x in xs])
    found = graph_arcs.driven_arcs(xy, np.array([1.0, 1.0, 0.9, 0.9]), poses)
    assert [(drive.start, drive.end) for drive in found] == pairs
    for drive in found:
        np.testing.assert_allclose(drive.polyline[[0, -1]], xy[[drive.start, drive.end]])
