"""What is believed of matches, and the life of landmarks."""

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
PLACES = np.array([[3.0, 0.0], [3.2, 0.0], [0.0, 3.0], [-3.0, 0.0], [0.0, -3.0]])


def known(*, std=0.05, pose_std=0.0):
    """A belief in five nodes of clearance 1 m, seen twice; pose errors are theirs alone."""
    cov = jnp.diag(jnp.full(3, pose_std**2))
    belief = initial_belief(jnp.zeros(3), max_landmarks=L, cov=cov)
    belief = add_known_landmarks(
        belief, jnp.array(PLACES), jnp.tile(std**2 * jnp.eye(2), (5, 1, 1))
    )
    return belief._replace(
        num_seen=jnp.array([2, 2, 2, 2, 2, 0], jnp.int32), descriptor=jnp.ones(L), step=jnp.int32(9)
    )


def reference(s, residual, rank, rounds):
    """Take out, one at a time, the pair without which the rest makes most sense."""
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


def test_greedy_joint_compatibility_is_its_definition():
    fast, sizes = jax.jit(jointly_compatible), []
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
        np.testing.assert_array_equal(fast(s, residual, rank), expected)
    assert min(sizes) < 4 and max(sizes) == 4


@jax.jit
def look(belief, polar, slot):
    nodes = features_from_range_bearing(polar, jnp.ones(len(polar), bool))
    r = jnp.tile(jnp.diag(jnp.array([0.01, 0.005]) ** 2), (len(polar), 1, 1))
    rows = ekf.linearize(belief, nodes, r, slot)
    s = innovation_cov(ekf.covariance_blocks(belief), rows)
    return match_verification.verify_matches(AssociationSpec(), belief, nodes, rows, s)


def looked(belief, polar, slot):
    polar = np.concatenate([polar, np.ones((2 - len(polar), 2))])
    slot = [*slot, *[L] * (2 - len(slot))]
    believed, looks = look(belief, jnp.array(polar), jnp.array(slot, jnp.int32))
    used = np.array(slot) < L
    return np.asarray(believed)[used], np.asarray(looks)


def test_a_place_in_a_wide_gate_needs_a_witness_or_a_second_look():
    lost = known(pose_std=0.5)
    believed, looks = looked(lost, [[3.1, 0.1]], [0])
    assert not believed[0] and looks[0] == 1
    assert looked(lost._replace(num_pending=jnp.array(looks)), [[3.1, 0.1]], [0])[0][0]
    # Two that lie as the map says vouch for each other; a pair that does not fit is left.
    assert looked(lost, [[3.0, 0.1], [3.0, np.pi / 2 + 0.1]], [0, 2])[0].all()
    assert not looked(lost, [[3.0, 0.1], [4.0, np.pi / 2 + 0.1]], [0, 2])[0].any()
    assert looked(known(), [[3.02, 0.0]], [0])[0][0]  # who is not lost needs no witness


def test_dropped_rows_stand_for_nothing():
    belief = known(pose_std=0.1)
    nodes = features_from_range_bearing(jnp.array([[3.0, 0.1], [3.1, 1.5]]), jnp.ones(2, bool))
    r = jnp.tile(1e-4 * jnp.eye(2), (2, 1, 1))

    @jax.jit
    def updated(slot, keep):
        return ekf.update(belief, mask_measurements(ekf.linearize(belief, nodes, r, slot), keep))

    mine = updated(jnp.array([0, 2], jnp.int32), jnp.array([True, False]))
    none = updated(jnp.array([0, L], jnp.int32), jnp.array([True, True]))
    jax.tree.map(np.testing.assert_array_equal, mine, none)


def test_the_twin_of_a_landmark_is_like_it_and_where_it_is():
    find = jax.jit(
        lambda belief, slot: match_verification.find_duplicate(AssociationSpec(), belief, slot)
    )
    near, slot = known(std=0.1), jnp.int32
    assert find(near, slot(0)) == 1 and find(near, slot(1)) == 0
    assert find(near, slot(2)) == L and find(near, slot(L)) == L
    assert find(known(std=0.01), slot(0)) == L  # apart, and known to be
    other = lambda **change: near._replace(**change)
    assert find(other(shape=near.descriptor.at[1].set(2.0)), slot(0)) == L
    assert find(other(kind=near.kind.at[1].set(CORNER)), slot(0)) == L
    assert find(other(kind=jnp.full(L, WALL, jnp.int32)), slot(0)) == L
    assert find(other(seen=near.num_seen.at[1].set(0)), slot(0)) == L


def test_merging_conditions_on_one_place_and_leaves_one_landmark():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(15, 15))
    cov = jnp.array(root @ root.T)
    belief = known()._replace(pose_cov=cov[:3, :3], cross_cov=cov[:3, 3:], map_cov=cov[3:, 3:])
    after = jax.jit(map_management.merge)(belief, jnp.int32(1), jnp.int32(3))
    h = np.zeros((2, 15))
    h[:, 5:7], h[:, 9:11] = np.eye(2), -np.eye(2)
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + 1e-4 * np.eye(2))
    np.testing.assert_allclose(after.mean, belief.mean - gain @ h @ belief.mean, atol=1e-10)
    np.testing.assert_allclose(after.cov, cov - gain @ h @ cov, atol=1e-9)
    np.testing.assert_array_equal(after.num_seen, [2, 4, 2, 0, 2, 0])
    same = jax.jit(map_management.merge)(belief, jnp.int32(1), jnp.int32(L))
    jax.tree.map(np.testing.assert_array_equal, same, belief)


def test_worth_is_nothing_of_free_slots_and_all_of_what_counts():
    belief = known()._replace(
        num_seen=jnp.array([1, 1, 2, 5, 1, 0], jnp.int32),
        last_seen=jnp.array([2, 1, 1, 1, 8, 0], jnp.int32),
    )
    value = np.asarray(eviction_cost(belief, belief.num_seen > 3, evict_after=5))
    assert value[5] == 0 and np.isinf(value[[3, 4]]).all()  # free; counts; seen just now
    assert 0 < value[1] < value[0] < value[2] < np.inf  # longest unseen, then least seen


@pytest.mark.parametrize("bad", ["asymmetric", "indefinite", "nan", "too many"])
def test_what_is_known_beforehand_is_checked(bad):
    cov = np.tile(np.eye(2), (5, 1, 1))
    if bad == "asymmetric":
        cov[2, 0, 1] = 0.5
    elif bad == "indefinite":
        cov[2] = [[1.0, 2.0], [2.0, 1.0]]
    elif bad == "nan":
        cov[2, 0, 0] = np.nan
    told = {
        "asymmetric": r"cov\[2\] is not symmetric: \[0, 1\] is 0.5, \[1, 0\] 0",
        "indefinite": r"cov\[2\] is not positive definite: its smallest eigenvalue is -1",
        "nan": r"cov\[2\] holds numbers that are not finite",
        "too many": "5 positions for a map of 4 landmarks",
    }
    blank = initial_belief(jnp.zeros(3), max_landmarks=4 if bad == "too many" else L)
    with pytest.raises(ValueError, match=told[bad]):
        add_known_landmarks(blank, jnp.array(PLACES), jnp.array(cov))
    with pytest.raises(ValueError, match="cov is not positive semi-definite"):
        initial_belief(jnp.zeros(3), max_landmarks=L, cov=jnp.diag(jnp.array([1.0, 1.0, -1.0])))


@pytest.mark.parametrize("bearing, due", [(0.0, True), (np.pi, False)])
def test_a_node_is_overdue_when_the_robot_is_inside_its_circle_and_looks_there(bearing, due):
    belief = known()._replace(descriptor=jnp.full(L, 8.0), kind=jnp.full(L, JUNCTION, jnp.int32))
    belief = belief._replace(mean=belief.mean.at[2].set(-bearing))
    half = match_verification.missed_detection(belief, (-np.pi / 2, np.pi / 2))
    assert bool(half[0]) is due and not half[5]  # a free slot is no node
    assert match_verification.missed_detection(belief, (-np.pi, np.pi))[0]
    assert not match_verification.missed_detection(
        belief._replace(descriptor=jnp.ones(L)), (-np.pi, np.pi)
    ).any()
    assert not match_verification.missed_detection(
        belief._replace(kind=jnp.full(L, CORNER, jnp.int32)), (-4, 4)
    )[0]
