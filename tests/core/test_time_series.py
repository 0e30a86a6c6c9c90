import numpy as np

from jaxslam.core import time_series


def test_match_times_pairs_nearest_once():
    times = np.array([5.0, 1.0, 1.02, 3.0, 9.0])
    reference = np.array([3.04, 1.03, 4.97, 2.0, 8.9])
    pairs = time_series.match_times(times, reference, 0.05)
    np.testing.assert_array_equal(pairs, [[0, 2], [2, 1], [3, 0]])
    assert time_series.match_times(times, np.array([])).shape == (0, 2)


def test_match_times_equals_brute_force():
    rng = np.random.default_rng(3)
    times, reference = rng.permutation(40) + rng.uniform(-0.1, 0.1, 40), rng.permutation(50) * 1.0
    gaps = np.abs(times[:, None] - reference)
    expected = [[i, gaps[i].argmin()] for i in range(40) if gaps[i].min() <= 0.06]
    np.testing.assert_array_equal(time_series.match_times(times, reference, 0.06), expected)
    assert 0 < len(expected) < 40


def test_sorting_by_time_is_stable_and_in_float64():
    times, poses = time_series.sort_by_time(np.float32([2, 1, 2, 0]), np.arange(12).reshape(4, 3))
    np.testing.assert_array_equal(times, [0, 1, 2, 2])
    np.testing.assert_array_equal(poses[:, 0], [9, 3, 0, 6])
    assert times.dtype == poses.dtype == np.float64


def test_headings_are_interpolated_through_the_smaller_angle():
    poses = np.array([[0.0, 0.0, 3.0], [2.0, 4.0, -3.0]])
    found = time_series.interpolate_poses(np.array([0.5]), np.array([0.0, 1.0]), poses)
    np.testing.assert_allclose(found, [[1.0, 2.0, np.pi]])
