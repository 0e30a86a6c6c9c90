"""What `to_saved_map` takes and refuses; what it makes of a run is tested with the command line."""

from types import SimpleNamespace

import numpy as np
import pytest
from small import CONFIG, LIDAR

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.scan import Scan
from jaxslam.filtering.belief import initial_belief
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.arc_table import empty_arcs
from jaxslam.pipeline import SlamResult, to_saved_map

T, KEYFRAMES = 9, np.array([0, 4, 8])
K, R = len(KEYFRAMES), LIDAR.num_beams
PARAMS = NoiseParams.for_laser_log()
POSES = np.random.default_rng(0).normal(size=(T, 3))
HIT = np.arange(K * R).reshape(K, R) % 3 > 0
SCANS = Scan(np.where(HIT, 2.5, np.inf), HIT)


def result(**changes):
    none = np.zeros(0, np.int32)
    graph = TopologicalMap(
        none,
        np.zeros((0, 2)),
        none,
        np.zeros(0),
        np.zeros((0, 2), int),
        *(np.zeros(0), np.zeros(0), ()),
    )
    made = SlamResult(
        poses=POSES,
        online_poses=POSES + 1.0,
        keyframes=KEYFRAMES,
        belief=initial_belief(np.zeros(3), max_landmarks=4),
        info=SimpleNamespace(pose_cov=np.full((K, 3, 3), 0.25)),
        features=None,
        topological_map=graph,
        consistency=None,
        arcs=empty_arcs(capacity=8),
    )
    return made._replace(**changes)


def test_keyframes_are_kept_in_the_precision_of_the_file():
    saved = to_saved_map(CONFIG, PARAMS, result(), [1, 2, 3], SCANS)
    np.testing.assert_array_equal(saved.poses, POSES[KEYFRAMES])
    assert saved.times.dtype == np.float64 and saved.times.tolist() == [1.0, 2.0, 3.0]
    assert saved.pose_cov.dtype == saved.scans.ranges.dtype == np.float32
    assert set(saved.scans.ranges[HIT]) == {2.5} and saved.lidar == LIDAR
    assert set(saved.scans.ranges[~HIT]) == {LIDAR.range_max}  # as in every `Scan`
    assert saved.belief.mean.shape == (3,) and saved.arcs.ends.shape == (0, 2)
    assert saved.topological_map.id.dtype == np.int64


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"times": np.zeros(T)}, r"times is float64 \(9,\), not \(3,\)"),
        (
            {"scans": SCANS._replace(hit=HIT[:2])},
            r"scans.hit is bool \(2, 91\), not",
        ),
        ({"scans": SCANS._replace(ranges=np.ones(R))}, r"scans.ranges is float64 \(91,\)"),
        ({"scans": SCANS.ranges}, "scans is ndarray, not Scan"),
        ({"params": 0.1}, "params is float, not NoiseParams"),
        ({"config": LIDAR}, "config is Lidar, not Config"),
        ({"result": result(arcs=None)}, "result.arcs is None: give the result of run_slam"),
    ],
)
def test_what_does_not_fit_the_keyframes_is_refused(changes, message):
    given = {"config": CONFIG, "params": PARAMS, "result": result(), "times": np.zeros(K)}
    with pytest.raises(ValueError, match=message):
        to_saved_map(**{**given, "scans": SCANS, **changes})
