"""Wrong matches of submaps are taken back, right ones stay, and the map is not bent."""

import numpy as np
import pytest
from submap_circles import COUNT, OWN, circle, numbered

from jaxslam.smoothing.submap_gate import join_consistent
from jaxslam.smoothing.submap_joining import join_submaps


def wrongly_matched(index, kind):
    """Indices where landmarks of one submap are taken for others, and which of its landmarks."""
    index = [one.copy() for one in index]
    if kind == "one":  # an own landmark of submap 30 for one that is 15 m away
        wrong = np.array([6])
        index[30][wrong] = OWN * 8 + 5
    else:  # all that submap 30 holds of its own, for those of a place on the other side
        wrong = np.arange(OWN)
        index[30][wrong] = OWN * ((30 + COUNT // 2) % COUNT) + wrong
    return index, wrong


@pytest.mark.parametrize("kind", ["one", "submap"])
def test_wrong_matches_do_not_bend_the_map(kind):
    submaps, index, origins, landmarks = circle(0, 2 * COUNT)
    right = join_submaps(submaps, index, origins, landmarks)
    wrong_index, wrong = wrongly_matched(index, kind)
    bent = join_submaps(submaps, wrong_index, origins, landmarks)
    found, found_index = join_consistent(submaps, wrong_index, origins, landmarks)

    def error(joined):
        return np.linalg.norm(joined.origins[:, :2] - origins[:, :2], axis=1).max()

    assert error(bent) > 3 * error(right)
    assert error(found) < 1.5 * error(right)
    expected = [one.copy() for one in wrong_index]
    expected[30][wrong] = len(landmarks) + wrong
    np.testing.assert_array_equal(_partition(found_index), _partition(expected))
    assert found.cost[-1] / found.dof < 1.3


def _partition(index):
    """For each landmark of each submap the first that has the same number."""
    _, first, label = np.unique(np.concatenate(index), return_index=True, return_inverse=True)
    return first[label]


@pytest.mark.parametrize("seed", range(4))
def test_right_matches_stay(seed):
    submaps, index, origins, landmarks = circle(seed, 2 * COUNT)
    found, found_index = join_consistent(submaps, index, origins, landmarks)
    for one, given in zip(found_index, index, strict=True):
        np.testing.assert_array_equal(one, given)
    wanted = join_submaps(submaps, index, origins, landmarks)
    np.testing.assert_array_equal(found.origins, wanted.origins)


def test_a_step_that_is_still_missing_is_no_contradiction():
    """Chained as measured, the end of the round is metres off; one step does not close the loop."""
    submaps, index, origins, landmarks = circle(5, COUNT + 2)
    bent = origins.copy()
    bent[COUNT // 2 :, 0] += 30.0
    bent[COUNT // 2 :, 2] += 1.0
    index, kept = numbered(index)
    _, found_index = join_consistent(submaps, index, bent, landmarks[kept], max_iterations=1)
    for one, given in zip(found_index, index, strict=True):
        np.testing.assert_array_equal(one, given)
