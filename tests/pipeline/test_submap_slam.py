"""SLAM in submaps: one submap is the filter, several have the statistics of their model."""

import jax
import numpy as np
import pytest
from landmark_drives import CONFIG, LANDMARKS, PARAMS, drives
from scipy.stats import chi2

from jaxslam.core import se2_np
from jaxslam.core.measurement import ScanMatch
from jaxslam.filtering.config import init
from jaxslam.filtering.slam_filter import run_filter
from jaxslam.pipeline import submap_slam
from jaxslam.pipeline.submap_slam import SubmapSpec, run_submaps
from jaxslam.smoothing.submap_joining import relative_poses

STEPS, COUNT = 80, 12
FILTER = CONFIG._replace(max_landmarks=12)
START = np.array([2.0, -1.0, 2.0])
SPEC = SubmapSpec(max_distance=3.7)  # 20 scans of 0.2 m


@pytest.fixture(scope="module")
def all_drives():
    """True poses (B, T, 3) and measurements [B, T], without correspondences."""
    truth, measurements = drives(jax.random.key(0), count=COUNT, steps=STEPS)
    return np.asarray(truth), jax.tree.map(np.asarray, measurements._replace(landmark_ids=None))


def take(measurements, index):
    return jax.tree.map(lambda x: x[index], measurements)


@pytest.fixture(scope="module")
def results(all_drives):
    """Of each drive in submaps."""
    _, measurements = all_drives
    return [
        run_submaps(FILTER, PARAMS, np.zeros(3), take(measurements, i), spec=SPEC)
        for i in range(COUNT)
    ]


def test_one_submap_is_the_filter_from_the_same_start(all_drives):
    measurements = take(all_drives[1], 0)
    spec = SPEC._replace(max_distance=100.0)
    found = run_submaps(FILTER, PARAMS, START, measurements, spec=spec)
    belief, info = run_filter(FILTER, PARAMS, init(FILTER, START), measurements)
    assert len(found.submaps) == 1 and found.joined.dof == 0
    for poses in (found.poses, found.online_poses):
        np.testing.assert_allclose(poses, info.pose, atol=1e-9)
    index = found.landmark_index[0][np.argsort(found.submaps[0].id)]
    mapped = np.flatnonzero(belief.num_seen)
    mapped = mapped[np.argsort(np.asarray(belief.id)[mapped])]
    wanted = np.asarray(belief.landmark_positions)[mapped]
    np.testing.assert_allclose(found.joined.landmark_positions[index], wanted, atol=1e-9)
    np.testing.assert_array_equal(found.landmark_id, info.id)


def test_a_landmark_of_several_submaps_is_one(results):
    for found in results:
        assert len(found.submaps) == 4
        np.testing.assert_array_equal(np.bincount(found.submap), [20, 20, 20, 20])
        distance = found.joined.landmark_positions[:, None] - np.asarray(LANDMARKS)[None]
        nearest = np.linalg.norm(distance, axis=2).argmin(axis=0)
        assert len(found.joined.landmark_positions) == 4 and len(set(nearest)) == 4


def test_costs_and_errors_have_the_statistics_of_the_model(results, all_drives):
    """Nothing is counted twice, and nothing is lost: NEES and cost are chi-square."""
    costs, nees = [], []
    for found, truth in zip(results, all_drives[0], strict=True):
        costs.append(found.joined.cost[-1] / found.joined.dof)
        pose, cov = relative_poses(found.joined, np.array([0]), 4)
        error = pose[0] - truth[-1]
        error[2] = se2_np.wrap_angle(error[2])
        nees.append(error @ np.linalg.solve(cov[0], error) / 3)
    for values, dof in ((costs, COUNT * results[0].joined.dof), (nees, COUNT * 3)):
        low, high = chi2.ppf([1e-3, 1 - 1e-3], dof) / dof
        assert low < np.mean(values) < high


def test_errors_are_those_of_the_filter_with_one_map(results, all_drives):
    """The landmarks of joined submaps are no worse than those of the filter that has one map."""
    truth, measurements = all_drives
    errors = []
    for i, found in enumerate(results):
        belief, info = run_filter(FILTER, PARAMS, init(FILTER, np.zeros(3)), take(measurements, i))
        positions = np.asarray(belief.landmark_positions)[np.asarray(belief.num_seen) > 0]
        both = []
        for estimate in (found.joined.landmark_positions, positions):
            distance = np.linalg.norm(estimate[:, None] - np.asarray(LANDMARKS)[None], axis=2)
            both.append(np.mean(distance.min(axis=0) ** 2))
        poses = (np.asarray(found.poses), np.asarray(info.pose))
        both += [np.mean((x - truth[i])[:, :2] ** 2) for x in poses]
        errors.append(both)
    landmarks, of_filter, poses, poses_of_filter = np.sqrt(np.mean(errors, axis=0))
    assert landmarks < 1.15 * of_filter
    assert poses < 1.3 * poses_of_filter


def test_submaps_that_are_solved_by_their_surroundings_are_one_map_in_the_end():
    """Windows of three submaps and all submaps at each closing lead to the same map."""
    _, measurements = drives(jax.random.key(3), count=1, steps=320)
    measurements = take(measurements._replace(landmark_ids=None), 0)
    found, solved = [], []
    for window in (3, 100):
        of_window: list[tuple[int, int]] = []

        def follow(_, state, of_window=of_window):
            of_window.append((len(state.submaps), state.num_solved))

        spec = SPEC._replace(window=window)
        run = run_submaps(FILTER, PARAMS, START, measurements, spec=spec, callback=follow)
        found.append(run)
        solved.append(np.array(of_window))
    assert np.all(solved[1][:, 0] == solved[1][:, 1])
    assert np.count_nonzero(solved[0][:, 0] > solved[0][:, 1]) > 4
    for one, other in zip(found[0].landmark_index, found[1].landmark_index, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(found[0].poses, found[1].poses, atol=1e-4)
    online = np.linalg.norm((found[0].online_poses - found[1].online_poses)[:, :2], axis=1)
    assert online.max() < 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_distance": 0.0}, "spec.max_distance is 0.0"),
        ({"search_distance": -1.0}, "spec.search_distance is -1.0"),
        ({"max_candidates": 0}, "spec.max_candidates is 0"),
        ({"min_matches": 0.5}, "spec.min_matches is 0.5"),
        ({"window": 0}, "spec.window is 0"),
    ],
)
def test_wrong_numbers_are_refused(all_drives, change, message):
    with pytest.raises(ValueError, match=message):
        run_submaps(FILTER, PARAMS, START, take(all_drives[1], 0), spec=SPEC._replace(**change))


def test_known_correspondences_and_scan_matches_are_refused(all_drives):
    measurements, state = take(all_drives[1], 0), submap_slam.init(FILTER, START)
    ids = np.zeros((STEPS, 4), np.int32)
    match = ScanMatch(np.zeros((STEPS, 3)), np.zeros((STEPS, 3, 3)), np.zeros(STEPS))
    for name, value in (("landmark_ids", ids), ("scan_match", match)):
        with pytest.raises(ValueError, match=f"measurements.{name} is given"):
            submap_slam.update(FILTER, PARAMS, state, measurements._replace(**{name: value}))
    with pytest.raises(ValueError, match="measurements holds no scan"):
        run_submaps(FILTER, PARAMS, START, take(measurements, slice(0, 0)))
