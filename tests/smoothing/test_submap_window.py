"""Windows of submaps: they are the whole where they hold it, and honest where they do not."""

import numpy as np
import pytest
from submap_circles import COUNT, circle, numbered

from jaxslam.smoothing.submap_joining import join_submaps, relative_poses
from jaxslam.smoothing.submap_window import choose_window, join_in_window, relative_poses_in


def joined_but_one(seed, num_submaps):
    """All submaps but the last, joined; a guess with it from there; all submaps and indices."""
    submaps, index, origins, landmarks = circle(seed, num_submaps)
    index, kept = numbered(index)
    before = max(one.max() for one in index[:-1]) + 1
    joined = join_submaps(submaps[:-1], index[:-1], origins[:-1], landmarks[kept][:before])
    guess = np.concatenate([joined.landmark_positions, landmarks[kept][before:]])
    return submaps, index, joined, (np.concatenate([joined.origins, origins[-1:]]), guess)


def test_a_window_of_all_submaps_is_the_whole():
    submaps, index, joined, guess = joined_but_one(0, COUNT + 1)
    window = np.arange(COUNT)
    found = join_in_window(window, submaps, index, *guess, joined, max_iterations=20)
    wanted = join_submaps(submaps, index, *guess)
    np.testing.assert_allclose(found.origins, wanted.origins, atol=1e-9)
    np.testing.assert_allclose(found.landmark_positions, wanted.landmark_positions, atol=1e-9)
    assert found.cost[-1] == pytest.approx(wanted.cost[-1])
    first = np.array([0, 3, COUNT - 1])
    pose, cov = relative_poses_in(window, submaps, index[:-1], joined, first, COUNT)
    wanted_pose, wanted_cov = relative_poses(joined, first, COUNT)
    np.testing.assert_allclose(pose, wanted_pose, atol=1e-12)
    np.testing.assert_allclose(cov, wanted_cov, rtol=1e-3, atol=1e-9)  # linearised a step apart
    with pytest.raises(ValueError, match="joined has no factors"):
        relative_poses(found, first, COUNT)


def test_covariances_of_a_window_are_no_less_than_those_of_the_whole():
    submaps, index, origins, landmarks = circle(1, 2 * COUNT)
    joined = join_submaps(submaps, index, origins, landmarks)
    first, last = np.array([2 * COUNT - 4, COUNT - 2]), 2 * COUNT
    window = choose_window(index, len(landmarks), last - 1, first, 8, min_shared=3)
    whole = relative_poses(joined, first, last)[1]
    for cov, least in zip(
        relative_poses_in(window, submaps, index, joined, first, last)[1], whole, strict=True
    ):
        assert np.linalg.eigvalsh(cov - least).min() > -1e-9
        assert np.trace(cov) < 3 * np.trace(least)


def test_a_window_moves_what_it_holds_alone_and_lowers_the_cost_of_all():
    submaps, index, joined, guess = joined_but_one(2, 2 * COUNT)
    num = len(joined.landmark_positions)
    nothing = np.array([], int)
    window = choose_window(index[:-1], num, 2 * COUNT - 2, nothing, 6, min_shared=3)
    found = join_in_window(window, submaps, index, *guess, joined, max_iterations=3)
    far = COUNT // 2
    np.testing.assert_array_equal(found.origins[far], joined.origins[far])
    assert np.abs(found.origins[-1] - guess[0][-1]).max() > 1e-3

    def cost(origins, positions):
        return join_submaps(submaps, index, origins, positions, max_iterations=1).cost[0]

    costs = [cost(*guess), cost(found.origins, found.landmark_positions)]
    wanted = join_submaps(submaps, index, *guess).cost[-1]
    assert wanted < costs[1] < costs[0]
    assert costs[1] - wanted < 0.1 * (costs[0] - wanted)


def test_a_loop_that_the_window_cannot_close_is_refused():
    submaps, index, joined, guess = joined_but_one(3, COUNT)
    size, num = 5, len(joined.landmark_positions)
    nothing = np.array([], int)
    window = choose_window(index[:-1], num, COUNT - 2, nothing, size, min_shared=3)
    np.testing.assert_array_equal(window, np.arange(COUNT - 1 - size, COUNT - 1))
    # The last submap holds landmarks of the first, whose poses are those of another drive.
    assert join_in_window(window, submaps, index, *guess, joined, max_iterations=20) is None
    wide = np.arange(COUNT - 1)
    assert join_in_window(wide, submaps, index, *guess, joined, max_iterations=20) is not None


def test_a_window_holds_what_is_wanted_and_the_steps_to_it():
    _, index, _, landmarks = circle(0, COUNT)
    # Without the last, which sees the first again, the steps to it lead over all of the others.
    open_index, kept = numbered(index[:-1])
    found = choose_window(open_index, len(kept), COUNT - 2, np.array([7]), 3, min_shared=3)
    np.testing.assert_array_equal(found, np.arange(7, COUNT - 1))
    found = choose_window(index, len(landmarks), COUNT - 1, np.array([2]), 1, min_shared=3)
    np.testing.assert_array_equal(found, [0, 1, 2, COUNT - 1])
    # Four landmarks are shared; where five are asked for, only the order of the submaps counts.
    found = choose_window(index, len(landmarks), COUNT - 1, np.array([2]), 1, min_shared=5)
    np.testing.assert_array_equal(found, np.arange(2, COUNT))
