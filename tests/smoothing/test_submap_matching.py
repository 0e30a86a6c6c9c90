"""Matches of two submaps of the same corners, whose true correspondences are known."""

import numpy as np
import pytest

from jaxslam.core import se2_np
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.submaps import Submap
from jaxslam.smoothing.submap_matching import match_submaps

RELATIVE = np.array([2.0, -1.0, 2.5])
COV = np.diag([0.05, 0.05, 0.01]) ** 2
STD = 0.02
SIZE = 12


def pair(seed, *, error=None):
    """Two submaps of the same corners; the second is permuted, and holds four others besides."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(4) * 1.5, np.arange(3) * 1.5)
    points = np.stack([x.ravel(), y.ravel()], 1) + rng.uniform(-0.3, 0.3, (SIZE, 2))
    direction = rng.uniform(-np.pi, np.pi, SIZE)
    order = rng.permutation(SIZE)
    true = RELATIVE + (np.linalg.cholesky(COV) @ rng.normal(size=3) if error is None else error)
    others = rng.uniform(10.0, 14.0, (4, 2))
    seen = np.concatenate([se2_np.inverse_transform(true, points[order]), others])
    facing = np.concatenate([direction[order] - true[2], rng.uniform(-np.pi, np.pi, 4)])
    first = submap(points + STD * rng.normal(size=points.shape), direction)
    second = submap(seen + STD * rng.normal(size=seen.shape), facing)
    return first, second, np.append(order, [-1] * 4)


def submap(positions, direction):
    count = len(positions)
    return Submap(
        last_pose=np.zeros(3),
        positions=positions,
        cov=STD**2 * np.eye(3 + 2 * count),
        id=np.arange(count, dtype=np.int32),
        kind=np.full(count, CORNER, np.int32),
        direction=direction,
        descriptor=np.full(count, np.pi / 2),
    )


def test_matches_are_the_true_ones():
    right = total = 0
    for seed in range(20):
        first, second, truth = pair(seed)
        found = match_submaps(AssociationSpec(), first, second, RELATIVE, COV)
        assert np.all((found == truth) | (found == -1))
        right, total = right + np.sum(found >= 0), total + SIZE
    assert right > 0.9 * total


def test_a_poor_guess_is_improved_by_the_matches_that_are_clear():
    """With the guess alone most are ambiguous, as all look alike: the next round has them."""
    poor, right = np.diag([0.6, 0.6, 0.02]) ** 2, []
    for seed in range(20):
        first, second, truth = pair(seed, error=np.array([0.1, -0.1, 0.01]))
        first, second = (one._replace(kind=one.kind * 0 + JUNCTION) for one in (first, second))
        found = match_submaps(AssociationSpec(), first, second, RELATIVE, poor)
        assert np.all((found == truth) | (found == -1))
        right.append(np.sum(found >= 0))
    assert np.mean(right) > 0.8 * SIZE


def test_a_match_that_contradicts_the_others_is_left_out():
    """The positions of the first submap err together, so one alone is inside of its gate."""
    first, second, truth = pair(1, error=np.zeros(3))
    together = np.tile(np.eye(2), (SIZE, 1))
    cov = first.cov.copy()
    cov[3:, 3:] += 0.15**2 * together @ together.T
    moved = int(np.flatnonzero(truth == 5)[0])
    second.positions[moved] += 0.15
    found = match_submaps(AssociationSpec(), first._replace(cov=cov), second, RELATIVE, COV)
    assert found[moved] == -1
    others = np.delete(np.arange(len(found)), moved)
    assert np.sum(found[others] >= 0) >= SIZE - 2
    assert np.all((found == truth)[others] | (found == -1)[others])


def test_a_guess_that_is_wrong_beyond_its_covariance_gives_no_match():
    first, second, _ = pair(2, error=np.array([0.7, 0.7, 0.0]))
    assert np.all(match_submaps(AssociationSpec(), first, second, RELATIVE, COV) == -1)


@pytest.mark.parametrize("change", ["kind", "direction", "descriptor"])
def test_landmarks_that_do_not_resemble_each_other_do_not_match(change):
    first, second, _ = pair(3, error=np.zeros(3))
    other = {
        "kind": np.full(len(second.kind), JUNCTION, np.int32),
        "direction": second.direction + 1.0,
        "descriptor": second.descriptor + 1.0,
    }
    second = second._replace(**{change: other[change]})
    assert np.all(match_submaps(AssociationSpec(), first, second, RELATIVE, COV) == -1)


def test_fewer_matches_than_wanted_are_none():
    first, second, truth = pair(4, error=np.zeros(3))
    found = match_submaps(AssociationSpec(), first, second, RELATIVE, COV)
    count = int(np.sum(found >= 0))
    spec = AssociationSpec()
    enough = match_submaps(spec, first, second, RELATIVE, COV, min_matches=count)
    np.testing.assert_array_equal(enough, found)
    none = match_submaps(spec, first, second, RELATIVE, COV, min_matches=count + 1)
    assert np.all(none == -1)
