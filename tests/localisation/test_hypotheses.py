"""Pieces of localisation against slow versions and laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, relative
from jaxslam.localisation import LocaliseSpec, hypotheses, search
from jaxslam.localisation.config import Hypotheses
from jaxslam.localisation.probability import features, probability

SPEC, LIDAR = LocaliseSpec(), Lidar(num_beams=4)
keep_best, predict, weigh, limited, add_to_window = (
    jax.jit(f, static_argnums=0)
    for f in (
        hypotheses.keep_best,
        hypotheses.predict,
        hypotheses.weigh,
        hypotheses.limited,
        search.add_to_window,
    )
)
move_window = jax.jit(search.move_window)


def some(rng, count, spread=1.0):
    root = rng.normal(size=(count, 3, 3))
    return Hypotheses(
        jnp.asarray(rng.uniform(-spread, spread, (count, 3))),
        jnp.asarray(root @ root.swapaxes(1, 2) + 0.1 * np.eye(3)),
        jnp.asarray(np.where(rng.random(count) < 0.7, -rng.exponential(5.0, count), -np.inf)),
        jnp.asarray(rng.random(count)),
        jnp.asarray(rng.random(count)),
        jnp.asarray(rng.uniform(1.0, 9.0, count)),
        jnp.asarray(rng.exponential(5.0, count)),
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_best_of_each_place_are_kept(seed):
    pool = some(np.random.default_rng(seed), 14, spread=0.6)
    kept = jax.tree.map(np.asarray, keep_best(SPEC, pool))
    pool = jax.tree.map(np.asarray, pool)
    left = [k for k in np.argsort(-np.asarray(pool.log_weight)) if pool.log_weight[k] > -np.inf]
    for slot in range(SPEC.num_hypotheses):
        if not left:
            assert kept.log_weight[slot] == -np.inf
            continue
        off = np.asarray(pool.poses) - np.asarray(pool.poses)[left[0]]
        turn = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        same = (np.hypot(off[:, 0], off[:, 1]) < 0.5) & (turn < 0.17)
        np.testing.assert_array_equal(kept.poses[slot], pool.poses[left[0]])
        assert kept.log_weight[slot] == pool.log_weight[left[0]]
        longest = max((k for k in left if same[k]), key=lambda k: pool.driven[k])
        for field in ("path_score", "windows", "driven"):
            assert getattr(kept, field)[slot] == getattr(pool, field)[longest]
        left = [k for k in left if not same[k]]


def test_covariances_are_those_of_many_robots():
    odometry = np.array([0.6, -0.1, 0.5])
    one = hypotheses.no_hypotheses(1)
    cov = np.diag([0.05, 0.1, 0.04]) ** 2
    one = one._replace(poses=jnp.array([[3.0, 1.0, 0.8]]), cov=jnp.asarray(cov[None]))
    after = predict(SPEC, one, jnp.asarray(odometry))
    rng, count = np.random.default_rng(0), 200_000
    start = rng.multivariate_normal(np.asarray(one.poses[0]), cov, count)
    distance = np.hypot(*odometry[:2])
    std = np.hypot(SPEC.odometry_std_floor, SPEC.odometry_slip * np.array([distance, 0.5]))
    ends = compose(start, odometry) + rng.normal(size=(count, 3)) * std[[0, 0, 1]]
    np.testing.assert_allclose(after.poses[0], compose(np.array([3.0, 1.0, 0.8]), odometry))
    np.testing.assert_allclose(np.cov(ends.T), after.cov[0], atol=2e-4)
    np.testing.assert_allclose(after.driven, distance)


def test_a_robot_that_stands_gathers_no_evidence_and_one_that_drives_does():
    own, scores = some(np.random.default_rng(1), 8), jnp.full(8, 0.9)
    own = own._replace(log_weight=jnp.linspace(0.0, -3.0, 8))
    still, nowhere = weigh(SPEC, own, jnp.array(-1.0), scores, jnp.array(0.0))
    np.testing.assert_allclose(still.log_weight, own.log_weight)
    np.testing.assert_allclose([nowhere, *still.score], [-1.0, *own.score])
    np.testing.assert_allclose(still.path_score, own.path_score)
    moved, gone = weigh(SPEC, own, jnp.array(-1.0), scores, jnp.array(1.0))
    gain = SPEC.score_weight * (0.9 - SPEC.nowhere_score)
    np.testing.assert_allclose(moved.log_weight, SPEC.memory * own.log_weight)
    np.testing.assert_allclose(gone, -SPEC.memory - gain)


def test_the_score_of_a_path_is_the_mean_of_its_scans_weighed_by_their_evidence():
    rng = np.random.default_rng(4)
    own = some(rng, 8)
    total, scores = np.asarray(own.path_score * own.windows), rng.random((9, 8))
    amounts = rng.uniform(0.2, 1.0, 9)
    for now, amount in zip(scores, amounts, strict=True):
        own = weigh(SPEC, own, jnp.array(0.0), jnp.asarray(now), jnp.array(amount))[0]
        total = total + amount * now
    np.testing.assert_allclose(own.path_score * own.windows, total)
    for _ in range(200):  # long ago is forgotten
        own = weigh(SPEC, own, jnp.array(0.0), jnp.full(8, 0.7), jnp.array(1.0))[0]
    np.testing.assert_allclose(own.windows, SPEC.path_windows)
    np.testing.assert_allclose(own.path_score, 0.7, atol=1e-3)


def test_who_explains_much_less_is_given_up_but_nowhere_never():
    own = some(np.random.default_rng(1), 8)._replace(log_weight=jnp.linspace(5.0, -40.0, 8))
    after, nowhere = limited(SPEC, own, jnp.array(-99.0))
    assert after.log_weight[0] == 0.0 and nowhere == -SPEC.max_log_odds
    given_up = np.asarray(own.log_weight) <= 5.0 - SPEC.max_log_odds
    np.testing.assert_array_equal(np.isinf(after.log_weight), given_up)


def test_small_matrices_are_those_of_linear_algebra():
    cov = some(np.random.default_rng(2), 6).cov
    np.testing.assert_allclose(
        jax.jit(jax.vmap(hypotheses.inverse))(cov), np.linalg.inv(cov), rtol=1e-9
    )
    widest = np.sqrt(np.linalg.eigvalsh(np.asarray(cov)[:, :2, :2])[:, -1])
    np.testing.assert_allclose(jax.jit(jax.vmap(hypotheses.widest_std))(cov), widest)


def test_scans_of_the_window_stay_where_they_were_made():
    rng = np.random.default_rng(3)
    poses = np.array([4.0, 2.0, 3.0]) + np.cumsum(rng.uniform(-0.6, 0.9, (12, 3)), axis=0)
    window = search.empty_window(SPEC, LIDAR)
    in_window = []
    for k, pose in enumerate(poses):
        if k:
            moved = relative(poses[k - 1], pose)
            window = move_window(window, jnp.asarray(moved))
        before = int(window.num_added)
        ranges = jnp.full(LIDAR.num_beams, float(k + 1))
        window = add_to_window(SPEC, window, Scan(ranges, ranges > 0.0))
        in_window += [k] * (int(window.num_added) - before)
    chosen = in_window[-(SPEC.window_scans - 1) :]
    assert len(in_window) > SPEC.window_scans and np.asarray(window.used).all()
    order = np.argsort(np.asarray(window.scans.ranges[:, 0]))
    np.testing.assert_array_equal(window.scans.ranges[order, 0], np.array(chosen) + 1.0)
    off = np.asarray(window.poses)[order] - relative(poses[-1], poses[chosen])
    np.testing.assert_allclose((off + np.pi)[:, 2] % (2 * np.pi), np.pi, atol=1e-9)
    np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-9)


def test_a_pose_is_more_probable_the_more_speaks_for_it():
    probability_of = jax.jit(lambda *given: probability(features(*given)))

    def chance(**changed):
        known = {"odds": 3.0, "score": 0.7, "windows": 4.0, "std": 0.05} | changed
        return float(probability_of(*(jnp.array(x) for x in known.values())))

    usual = chance()
    assert 0.0 < usual < 1.0
    assert chance(odds=6.0) > usual and chance(score=0.9) > usual and chance(windows=6.0) > usual
    assert chance(std=0.02) > usual
