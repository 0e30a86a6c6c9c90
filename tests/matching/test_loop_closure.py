"""Scans of a later visit registered against those of an earlier one, where the truth is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simulated_scans import CORRIDOR, LIDAR, item, scans_of

from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import compose, relative
from jaxslam.matching import loop_closure
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.loop_closure import closure_candidates, find_loop_closures
from jaxslam.matching.registration import LoopClosureSpec, register_scan
from jaxslam.simulation import path_following, worlds
from jaxslam.simulation.worlds import World
from jaxslam.smoothing.loop_closure_factors import closure_residuals

SPEC, SCAN_MATCHING = LoopClosureSpec(), ScanMatchSpec()


def find(poses, scans, spec=SPEC):
    return find_loop_closures(spec, SCAN_MATCHING, LIDAR, poses, scans, std_scale=0.3)


def two_visits(waypoints, length):
    """Poses every half metre along a path, and again between those."""
    path = path_following.densify(waypoints)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(path, axis=0).T)))
    driven = np.arange(2.0, 2.0 + length, 0.5)
    driven = np.concatenate([driven, driven + 0.25])
    x, y, u, v = (np.interp(driven + d, along, c) for d in (0.0, 0.3) for c in path.T)
    return np.stack([x, y, np.arctan2(v - y, u - x)], axis=1)


@pytest.fixture(scope="module")
def office():
    """True poses, how they drifted by the second visit, and scans."""
    true = two_visits(worlds.waypoints("office"), 24.0)
    again = len(true) // 2
    poses = relative(true[:1], true)
    poses[again:] = compose(np.array([0.6, -0.4, 0.03]), poses[again:])
    return true, poses, scans_of(worlds.named("office"), jnp.asarray(true), LIDAR.range_std)


@pytest.fixture(scope="module")
def closures(office):
    _, poses, scans = office
    return find(poses, scans)


def test_candidates_are_the_nearest_poses_of_long_before():
    rng = np.random.default_rng(0)
    poses = np.cumsum(rng.normal(size=(300, 3)), axis=0) * [0.5, 0.5, 1.0]
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    first, second = closure_candidates(SPEC, poses, along)
    assert len(first) > 20 and np.all(np.diff(along[second]) > 0.0)
    for i, j in zip(first, second, strict=True):
        costs = {}
        for k in range(j):
            away = np.hypot(*(poses[k, :2] - poses[j, :2]))
            turn = np.abs(np.angle(np.exp(1j * (poses[k, 2] - poses[j, 2]))))
            if along[j] - along[k] > SPEC.min_path_between and away < SPEC.max_distance:
                costs[k] = away + SPEC.heading_weight * turn
        assert min(costs, key=costs.get) == i
    alone = closure_candidates(SPEC, poses[:5], along[:5])
    assert [len(x) for x in alone] == [0, 0]


def test_relative_poses_of_two_visits_are_found(office, closures):
    """However far the trajectory had drifted; and the information agrees with the errors."""
    true, poses, _ = office
    found = closures
    assert len(found.first) >= 6
    error = relative(relative(true[found.first], true[found.second]), found.relative_pose)
    drift = relative(relative(poses[found.first], poses[found.second]), found.relative_pose)
    assert np.hypot(*error[:, :2].T).max() < 0.06 < 0.3 < np.hypot(*drift[:, :2].T).min()
    assert np.abs(error[:, 2]).max() < 0.01
    square = np.einsum("ci,cij,cj->c", error, found.information, error)
    assert 0.02 < square.mean() / 3 < 1.5


@pytest.mark.parametrize("seed", range(3))
def test_along_a_bare_corridor_few_closures_are_accepted_and_none_wrongly(seed):
    """Every place there is as good as the next one; across it, and in heading, they are right."""
    x = np.arange(0.0, 10.0, 0.5)
    true = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    true = np.concatenate([true, true[::-1] + [0.0, 0.1, np.pi]])
    scans = scans_of(CORRIDOR, jnp.asarray(true), LIDAR.range_std, seed)
    spec = SPEC._replace(min_path_between=4.0, query_spacing=0.5)
    ambiguous = find(true, scans, spec._replace(min_margin=-1.0))
    assert len(ambiguous.first) >= 8  # but for other places, most would do
    assert len(find(true, scans, spec).first) <= 7
    true_motion = relative(true[ambiguous.first], true[ambiguous.second])
    error = relative(true_motion, ambiguous.relative_pose)
    assert np.abs(error[:, 1]).max() < 0.05 and np.abs(error[:, 2]).max() < 0.01
    assert np.abs(error[:, 0]).max() > 0.2
    residual = closure_residuals(true, ambiguous)[0]
    assert np.sum(residual**2, axis=1).max() < 9.0


def test_the_other_side_of_a_wall_is_another_wall():
    """Two rooms with a thin wall between them, and the earlier visit was in both."""
    rooms = worlds.outline([(0.0, 0.0, 6.0, 2.0), (2.5, 0.0, 3.2, 0.4)])
    other = rooms + np.array([0.0, 2.05, 0.0, 2.05])
    world = World(jnp.asarray(np.concatenate([rooms, other])))
    x = np.linspace(0.6, 5.4, SPEC.submap_scans)
    y = np.where(np.arange(SPEC.submap_scans) % 2, 1.1, 3.15)
    visit = np.stack([x, y, np.where(x < 3.0, 0.3, np.pi - 0.3)], axis=1)
    true = np.array([1.0, 1.3, 0.5])
    scans = scans_of(world, jnp.asarray(np.concatenate([visit, true[None]])), LIDAR.range_std)
    scan, scans = item(scans, -1), item(scans, np.s_[:-1])
    guess = true + [0.05, 0.06, 0.02]
    register = jax.jit(register_scan, static_argnums=(0, 1, 2))
    found = register(SPEC, SCAN_MATCHING, LIDAR, scans, visit, guess, scan)
    off = np.abs(relative(true, np.asarray(found.pose)))
    assert found.inlier_fraction > 0.9 and off[:2].max() < 0.01 and off[2] < 0.005


def test_a_trajectory_that_never_comes_back_has_none(office):
    true, _, scans = office
    some = slice(0, 12)
    assert [len(x) for x in find(true[some], item(scans, some))] == [0, 0, 0, 0]
    assert [len(x) for x in find(true[:0], item(scans, np.s_[:0]))] == [0, 0, 0, 0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_a_trajectory_that_is_not_finite_has_none(office, bad):
    _, poses, scans = office
    poses = poses.copy()
    poses[3] = bad
    found = find(poses, scans)
    assert not len(found.first) or np.isfinite(bad)
    assert all(np.isfinite(x).all() for x in found)


def test_results_do_not_depend_on_the_batch_size(office, closures, monkeypatch):
    _, poses, scans = office
    monkeypatch.setattr(loop_closure, "BATCH", 5)
    found = find(poses, scans)
    np.testing.assert_array_equal(found.second, closures.second)
    np.testing.assert_allclose(found.relative_pose, closures.relative_pose, atol=1e-9)
    np.testing.assert_allclose(found.information, closures.information, rtol=1e-6, atol=1e-3)


def test_lists_numpy_and_jax_of_either_precision_give_the_same(office, closures):
    _, poses, scans = office
    to_list = Scan(scans.ranges.tolist(), scans.hit.tolist())
    jax.tree.map(np.testing.assert_array_equal, find(poses.tolist(), to_list), closures)
    single = jax.tree.map(np.asarray, scans._replace(ranges=scans.ranges.astype(np.float32)))
    by_numpy = find(jnp.asarray(poses), single)
    by_jax = find(poses, jax.tree.map(jnp.asarray, single))
    jax.tree.map(np.testing.assert_array_equal, by_numpy, by_jax)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(spec=SPEC._replace(query_spacing=0.0)), "spec.query_spacing is 0.0, not a finite"),
        (dict(spec=SPEC._replace(submap_scans=0)), "spec.submap_scans is 0, not 1 or more"),
        (dict(spec=SPEC._replace(guess_std=[1.0, 0.1])), "spec must hold tuples"),
        (dict(spec=SCAN_MATCHING), "spec is a ScanMatchSpec, not a LoopClosureSpec"),
        (dict(scan_matching=SPEC), "scan_matching is a LoopClosureSpec, not a ScanMatchSpec"),
        (dict(lidar=None), "lidar is a NoneType, not a Lidar"),
        (dict(lidar=LIDAR._replace(num_beams=91)), r"scans.ranges is .*\(96, 181\), not .*91\)"),
        (dict(poses=np.zeros((96, 2))), r"poses is float64 \(96, 2\)"),
        (dict(poses=np.zeros((95, 3))), r"scans.ranges is float64 \(96, 181\), not .*\(95, 181\)"),
        (dict(std_scale=0.0), "std_scale is 0.0, not a finite number above 0"),
    ],
)
def test_wrong_arguments_are_refused_by_name(office, wrong, message):
    true, _, scans = office
    right = dict(spec=SPEC, scan_matching=SCAN_MATCHING, lidar=LIDAR, poses=true, scans=scans)
    with pytest.raises(ValueError, match=message):
        find_loop_closures(**right | wrong)


def test_register_scan_refuses_scans_and_poses_of_different_number():
    scans = Scan(np.ones((4, 181)), np.ones((4, 181), bool))
    scan, guess = item(scans, 0), np.zeros(3)
    with pytest.raises(ValueError, match=r"submap_scans.ranges is .*\(4, 181\), not .*\(5, 181\)"):
        register_scan(SPEC, SCAN_MATCHING, LIDAR, scans, np.zeros((5, 3)), guess, scan)
    with pytest.raises(ValueError, match=r"scan.ranges is .*\(4, 181\), not .*\(181,\)"):
        register_scan(SPEC, SCAN_MATCHING, LIDAR, scans, np.zeros((4, 3)), guess, scans)
    with pytest.raises(ValueError, match=r"guess is .*\(2,\), not .*\(3,\)"):
        register_scan(SPEC, SCAN_MATCHING, LIDAR, scans, np.zeros((4, 3)), guess[:2], scan)
