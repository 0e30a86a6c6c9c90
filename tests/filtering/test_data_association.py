"""Matches that are verified, duplicates, missed detections, and the tracks of landmarks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering import ekf, map_management, match_verification
from jaxslam.filtering.belief import add_known_landmarks, eviction_cost, initial_belief
from jaxslam.filtering.compatibility import jointly_compatible
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.joint_covariance import mask_measurements
from jaxslam.filtering.kalman import innovation_cov
from jaxslam.frontend.features import features_from_range_bearing

L = 6
POSITIONS = np.array([[3.0, 0.0], [3.2, 0.0], [0.0, 3.0], [-3.0, 0.0], [0.0, -3.0]])


def five_landmarks(*, std=0.05, pose_std=0.0):
    """A belief with five junctions of clearance 1 m, observed twice, independent of the pose."""
    cov = jnp.diag(jnp.full(3, pose_std**2))
    belief = initial_belief(jnp.zeros(3), max_landmarks=L, cov=cov)
    belief = add_known_landmarks(
        belief, jnp.array(POSITIONS), jnp.tile(std**2 * jnp.eye(2), (5, 1, 1))
    )
    return belief._replace(
        num_seen=jnp.array([2, 2, 2, 2, 2, 0], jnp.int32), descriptor=jnp.ones(L), step=jnp.int32(9)
    )


def reference(s, residual, rank, rounds):
    """Remove, one at a time, the match without which the distance of the others is smallest."""
    left = [k for k in range(len(rank)) if rank[k] > 0]
    for _ in range(rounds):

        def norm(pairs):
            rows = [2 * k + i for k in pairs for i in range(2)]
            v = residual.reshape(-1)[rows]
            return v @ np.linalg.solve(s[np.ix_(rows, rows)], v) if rows else 0.0

        if norm(left) <= chi2.ppf(0.999, max(1, sum(rank[k] for k in left))):
            break
        left.remove(min(left, key=lambda k: norm([i for i in left if i != k])))
    return np.isin(np.arange(len(rank)), left)


def all_but_first(passed):
    return passed & (jnp.arange(passed.size) > 0)


def test_greedy_joint_compatibility_equals_its_definition():
    sizes: list[int] = []

    @partial(jax.jit, static_argnums=3)
    def fast(s, residual, rank, review=None):
        return jointly_compatible(s, residual, rank, review=review)

    for seed in range(40):
        rng = np.random.default_rng(seed)
        root, m = rng.normal(size=(10, 10)), 5
        s, residual = root @ root.T + 0.5 * np.eye(10), np.zeros((m, 2))
        residual[:4] = (root @ rng.normal(size=10)).reshape(m, 2)[:4]
        residual[rng.integers(4)] += rng.choice([0.0, 4.0, 8.0])
        s[8:], s[:, 8:] = 0.0, 0.0
        s[8:, 8:] = np.eye(2)
        rank = np.array([2, 2, 2, 2, 0], np.int32)
        expected = reference(s, residual, rank, 3)
        sizes.append(expected.sum())
        found = fast(s, residual, rank)
        np.testing.assert_array_equal(found.kept, expected)
        np.testing.assert_array_equal(found.passed, expected)
        # Its factor is of what is left, and a review leaves out what it does not keep.
        reviewed = fast(s, residual, rank, all_but_first)
        np.testing.assert_array_equal(reviewed.passed, expected)
        np.testing.assert_array_equal(reviewed.kept, expected & (np.arange(m) > 0))
        for matches in (found, reviewed):
            rows = np.repeat(matches.kept, 2)
            left = np.where(rows[:, None] & rows[None], s, np.eye(2 * m))
            root, logdet, is_definite = matches.factor
            np.testing.assert_allclose(root @ left @ root.T, np.eye(2 * m), atol=1e-10)
            np.testing.assert_allclose(logdet, np.linalg.slogdet(left)[1], atol=1e-10)
            assert is_definite
    assert min(sizes) < 4 and max(sizes) == 4


@jax.jit
def verify(belief, polar, slot):
    features = features_from_range_bearing(polar, jnp.ones(len(polar), bool))
    r = jnp.tile(jnp.diag(jnp.array([0.01, 0.005]) ** 2), (len(polar), 1, 1))
    rows = ekf.linearize(belief, features, r, slot)
    s = innovation_cov(ekf.covariance_blocks(belief), rows)
    found, pending = match_verification.verify_matches(AssociationSpec(), belief, features, rows, s)
    return found.kept, pending


def verified(belief, polar, slot):
    """The accepted matches, and the numbers of pending ones, of one or two features."""
    polar = np.concatenate([polar, np.ones((2 - len(polar), 2))])
    slot = [*slot, *[L] * (2 - len(slot))]
    accepted, num_pending = verify(belief, jnp.array(polar), jnp.array(slot, jnp.int32))
    used = np.array(slot) < L
    return np.asarray(accepted)[used], np.asarray(num_pending)


def test_a_match_in_a_wide_gate_needs_a_second_match_or_a_second_scan():
    uncertain = five_landmarks(pose_std=0.5)
    accepted, num_pending = verified(uncertain, [[3.1, 0.1]], [0])
    assert not accepted[0] and num_pending[0] == 1
    again = uncertain._replace(num_pending=jnp.array(num_pending))
    assert verified(again, [[3.1, 0.1]], [0])[0][0]
    # Two at the distance of the map support each other; a pair at another distance is rejected.
    assert verified(uncertain, [[3.0, 0.1], [3.0, np.pi / 2 + 0.1]], [0, 2])[0].all()
    assert not verified(uncertain, [[3.0, 0.1], [4.0, np.pi / 2 + 0.1]], [0, 2])[0].any()
    assert verified(five_landmarks(), [[3.02, 0.0]], [0])[0][0]  # a certain pose needs no support


def test_masked_measurements_change_nothing():
    belief = five_landmarks(pose_std=0.1)
    polar = jnp.array([[3.0, 0.1], [3.1, 1.5]])
    features = features_from_range_bearing(polar, jnp.ones(2, bool))
    r = jnp.tile(1e-4 * jnp.eye(2), (2, 1, 1))

    @jax.jit
    def updated(slot, keep):
        return ekf.update(belief, mask_measurements(ekf.linearize(belief, features, r, slot), keep))

    masked = updated(jnp.array([0, 2], jnp.int32), jnp.array([True, False]))
    unmatched = updated(jnp.array([0, L], jnp.int32), jnp.array([True, True]))
    jax.tree.map(np.testing.assert_array_equal, masked, unmatched)


def test_a_duplicate_resembles_the_landmark_and_is_at_its_position():
    find = jax.jit(
        lambda belief, slot: match_verification.find_duplicate(AssociationSpec(), belief, slot)
    )
    near, slot = five_landmarks(std=0.1), jnp.int32
    assert find(near, slot(0)) == 1 and find(near, slot(1)) == 0
    assert find(near, slot(2)) == L and find(near, slot(L)) == L
    assert find(five_landmarks(std=0.01), slot(0)) == L  # certainly apart
    for other in (
        near._replace(descriptor=near.descriptor.at[1].set(2.0)),
        near._replace(kind=near.kind.at[1].set(CORNER)),
        near._replace(kind=jnp.full(L, WALL, jnp.int32)),
        near._replace(num_seen=near.num_seen.at[1].set(0)),
    ):
        assert find(other, slot(0)) == L


def test_merging_conditions_on_one_position_and_leaves_one_landmark():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(15, 15))
    cov = jnp.array(root @ root.T)
    belief = five_landmarks()._replace(
        pose_cov=cov[:3, :3], cross_cov=cov[:3, 3:], map_cov=cov[3:, 3:]
    )
    after = jax.jit(map_management.merge)(belief, jnp.int32(1), jnp.int32(3))
    h = np.zeros((2, 15))
    h[:, 5:7], h[:, 9:11] = np.eye(2), -np.eye(2)
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + 1e-4 * np.eye(2))
    np.testing.assert_allclose(after.mean, belief.mean - gain @ h @ belief.mean, atol=1e-10)
    np.testing.assert_allclose(after.cov, cov - gain @ h @ cov, atol=1e-9)
    np.testing.assert_array_equal(after.num_seen, [2, 4, 2, 0, 2, 0])
    same = jax.jit(map_management.merge)(belief, jnp.int32(1), jnp.int32(L))
    jax.tree.map(np.testing.assert_array_equal, same, belief)


def test_eviction_costs_nothing_for_free_slots_and_is_infinite_for_confirmed_landmarks():
    belief = five_landmarks()._replace(
        num_seen=jnp.array([1, 1, 2, 5, 1, 0], jnp.int32),
        last_seen=jnp.array([2, 1, 1, 1, 8, 0], jnp.int32),
    )
    value = np.asarray(eviction_cost(belief, belief.num_seen > 3, evict_after=5))
    assert value[5] == 0 and np.isinf(value[[3, 4]]).all()  # free; confirmed; observed just now
    assert 0 < value[1] < value[0] < value[2] < np.inf  # oldest, then least observed


@pytest.mark.parametrize("bad", ["asymmetric", "indefinite", "nan", "too many"])
def test_known_landmarks_are_checked(bad):
    cov = np.tile(np.eye(2), (5, 1, 1))
    if bad == "asymmetric":
        cov[2, 0, 1] = 0.5
    elif bad == "indefinite":
        cov[2] = [[1.0, 2.0], [2.0, 1.0]]
    elif bad == "nan":
        cov[2, 0, 0] = np.nan
    message = {
        "asymmetric": r"cov\[2\] is not symmetric: \[0, 1\] is 0.5, \[1, 0\] 0",
        "indefinite": r"cov\[2\] is not positive definite: its smallest eigenvalue is -1",
        "nan": r"cov\[2\] holds numbers that are not finite",
        "too many": "positions holds 5 landmarks, and the belief has 4 slots",
    }
    blank = initial_belief(jnp.zeros(3), max_landmarks=4 if bad == "too many" else L)
    with pytest.raises(ValueError, match=message[bad]):
        add_known_landmarks(blank, jnp.array(POSITIONS), jnp.array(cov))
    with pytest.raises(ValueError, match="cov is not positive semi-definite"):
        initial_belief(jnp.zeros(3), max_landmarks=L, cov=jnp.diag(jnp.array([1.0, 1.0, -1.0])))


@pytest.mark.parametrize("bearing, missed", [(0.0, True), (np.pi, False)])
def test_a_detection_is_missed_when_the_robot_is_inside_the_circle_and_faces_the_junction(
    bearing, missed
):
    belief = five_landmarks()._replace(
        descriptor=jnp.full(L, 8.0), kind=jnp.full(L, JUNCTION, jnp.int32)
    )
    belief = belief._replace(mean=belief.mean.at[2].set(-bearing))
    half = match_verification.missed_detection(belief, (-np.pi / 2, np.pi / 2))
    assert bool(half[0]) is missed and not half[5]  # a free slot is no landmark
    assert match_verification.missed_detection(belief, (-np.pi, np.pi))[0]
    assert not match_verification.missed_detection(
        belief._replace(descriptor=jnp.ones(L)), (-np.pi, np.pi)
    ).any()
    assert not match_verification.missed_detection(
        belief._replace(kind=jnp.full(L, CORNER, jnp.int32)), (-4, 4)
    )[0]
