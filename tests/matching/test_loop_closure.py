"""Scans of a later visit laid on those of an earlier one, where the truth is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from test_alignment import CORRIDOR, LIDAR, scans_of
from test_smoother import drive as told
from test_smoother import residuals, unpack
from test_sparse import guess_of, same

from jaxslam.core import se2
from jaxslam.core.se2_np import compose, relative
from jaxslam.matching import loop_closure
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.loop_closure import LoopClosures, LoopClosureSpec
from jaxslam.simulation import path_following, worlds
from jaxslam.simulation.worlds import World
from jaxslam.smoothing import sparse
from jaxslam.smoothing.problem import SmoothingResult

SPEC, ALIGN = LoopClosureSpec(), ScanMatchSpec()


def twice(way, length):
    """Poses every half metre along a path, and again between those."""
    path = path_following.densify(way)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(path, axis=0).T)))
    at = np.arange(2.0, 2.0 + length, 0.5)
    at = np.concatenate([at, at + 0.25])
    x, y, u, v = (np.interp(at + d, along, c) for d in (0.0, 0.3) for c in path.T)
    return np.stack([x, y, np.arctan2(v - y, u - x)], axis=1)


@pytest.fixture(scope="module")
def office():
    """True poses, how they drifted by the second time, and scans."""
    true = twice(worlds.waypoints("office"), 24.0)
    again = len(true) // 2
    poses = relative(true[:1], true)
    poses[again:] = compose(np.array([0.6, -0.4, 0.03]), poses[again:])
    return true, poses, scans_of(worlds.named("office"), jnp.asarray(true), LIDAR.range_std)


def test_candidates_are_the_nearest_of_long_before():
    rng = np.random.default_rng(0)
    poses = np.cumsum(rng.normal(size=(300, 3)), axis=0) * [0.5, 0.5, 1.0]
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    first, second = loop_closure.closure_candidates(SPEC, poses, along)
    assert len(first) > 20 and np.all(np.diff(along[second]) > 0.0)
    for i, j in zip(first, second, strict=True):
        costs = {}
        for k in range(j):
            away = np.hypot(*(poses[k, :2] - poses[j, :2]))
            turn = np.abs(np.angle(np.exp(1j * (poses[k, 2] - poses[j, 2]))))
            if along[j] - along[k] > SPEC.min_path_between and away < SPEC.max_distance:
                costs[k] = away + SPEC.heading_weight * turn
        assert min(costs, key=costs.get) == i
    alone = loop_closure.closure_candidates(SPEC, poses[:5], along[:5])
    assert [len(x) for x in alone] == [0, 0]


def test_two_visits_are_tied_as_they_were(office):
    """However far the way had drifted; and what is told of the error is true."""
    true, poses, scans = office
    found = loop_closure.find_loop_closures(SPEC, ALIGN, LIDAR, poses, scans, std_scale=0.3)
    assert len(found.first) >= 6
    error = relative(relative(true[found.first], true[found.second]), found.relative_pose)
    drift = relative(relative(poses[found.first], poses[found.second]), found.relative_pose)
    assert np.hypot(*error[:, :2].T).max() < 0.06 < 0.3 < np.hypot(*drift[:, :2].T).min()
    assert np.abs(error[:, 2]).max() < 0.01
    square = np.einsum("ci,cij,cj->c", error, found.information, error)
    assert 0.02 < square.mean() / 3 < 1.5


@pytest.mark.parametrize("seed", range(3))
def test_along_a_bare_corridor_little_is_tied_and_nothing_wrongly(seed):
    """Every place there is as good as the next one; across it, and in heading, they lie right."""
    x = np.arange(0.0, 10.0, 0.5)
    true = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    true = np.concatenate([true, true[::-1] + [0.0, 0.1, np.pi]])
    scans = scans_of(CORRIDOR, jnp.asarray(true), LIDAR.range_std, seed)
    spec = SPEC._replace(min_path_between=4.0, query_spacing=0.5)
    sure = loop_closure.find_loop_closures(
        spec._replace(min_margin=-1.0), ALIGN, LIDAR, true, scans, std_scale=0.3
    )
    assert len(sure.first) >= 8  # but for other places, most would do
    assert (
        len(loop_closure.find_loop_closures(spec, ALIGN, LIDAR, true, scans, std_scale=0.3).first)
        <= 7
    )
    error = relative(relative(true[sure.first], true[sure.second]), sure.relative_pose)
    assert np.abs(error[:, 1]).max() < 0.05 and np.abs(error[:, 2]).max() < 0.01
    assert np.abs(error[:, 0]).max() > 0.2
    residual = loop_closure.closure_residuals(sure, true)[0]
    assert np.sum(residual**2, axis=1).max() < 9.0


def test_the_other_side_of_a_wall_is_another_wall():
    """Two rooms with a thin wall between them, and the earlier visit was in both."""
    rooms = worlds.outline([(0.0, 0.0, 6.0, 2.0), (2.5, 0.0, 3.2, 0.4)])
    other = rooms + np.array([0.0, 2.05, 0.0, 2.05])
    place = World(jnp.asarray(np.concatenate([rooms, other])))
    x = np.linspace(0.6, 5.4, SPEC.submap_scans)
    y = np.where(np.arange(SPEC.submap_scans) % 2, 1.1, 3.15)
    visit = np.stack([x, y, np.where(x < 3.0, 0.3, np.pi - 0.3)], axis=1)
    true = np.array([1.0, 1.3, 0.5])
    scans = scans_of(place, jnp.asarray(np.concatenate([visit, true[None]])), LIDAR.range_std)
    scan, scans = jax.tree.map(lambda x: x[-1], scans), jax.tree.map(lambda x: x[:-1], scans)
    guess = true + [0.05, 0.06, 0.02]
    lay = jax.jit(loop_closure.register_scan, static_argnums=(0, 1, 2))
    pose, _, explained, _ = lay(SPEC, ALIGN, LIDAR, scans, visit, scan, guess)
    off = np.abs(relative(true, np.asarray(pose)))
    assert explained > 0.9 and off[:2].max() < 0.01 and off[2] < 0.005


def test_a_way_that_never_comes_back_has_none(office):
    true, _, scans = office
    some = slice(0, 12)
    found = loop_closure.find_loop_closures(
        SPEC, ALIGN, LIDAR, true[some], jax.tree.map(lambda x: x[some], scans)
    )
    assert [len(x) for x in found] == [0, 0, 0, 0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_a_way_that_is_nonsense_has_none(office, bad):
    _, poses, scans = office
    poses = poses.copy()
    poses[3] = bad
    found = loop_closure.find_loop_closures(SPEC, ALIGN, LIDAR, poses, scans)
    assert not len(found.first) or np.isfinite(bad)
    assert all(np.isfinite(x).all() for x in found)


def test_arguments_that_do_not_fit_are_named(office):
    true, _, scans = office
    with pytest.raises(ValueError, match=r"poses is float64 \(96, 2\)"):
        loop_closure.find_loop_closures(SPEC, ALIGN, LIDAR, true[:, :2], scans)
    with pytest.raises(ValueError, match=r"scans.ranges is float64 \(96, 181\), not"):
        loop_closure.find_loop_closures(SPEC, ALIGN, LIDAR, true[1:], scans)


def random_ties(poses, rng):
    """Closures that are a little off, and of a random information each."""
    first, second = np.array([0, 2, 1]), np.array([5, 6, 7])
    motion = relative(poses[first], poses[second]) + 0.05 * rng.normal(size=(3, 3))
    root = np.eye(3) * 8.0 + rng.normal(size=(3, 3, 3))
    return LoopClosures(first, second, motion, root @ root.swapaxes(1, 2))


def test_residuals_of_closures_and_their_derivatives():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(8, 3)) * [3.0, 3.0, 2.0]
    ties = random_ties(poses, rng)
    residual, by_first, by_second = loop_closure.closure_residuals(ties, poses)
    error = jax.vmap(se2.relative)(poses[ties.first], poses[ties.second]) - ties.relative_pose
    square = np.einsum("ci,cij,cj->c", error, ties.information, error)
    np.testing.assert_allclose(np.sum(residual**2, axis=1), square, rtol=1e-9)
    for at, by in ((ties.first, by_first), (ties.second, by_second)):
        for k in range(3):
            some = poses.copy()
            some[at, k] += 1e-6
            change = (loop_closure.closure_residuals(ties, some)[0] - residual) / 1e-6
            np.testing.assert_allclose(by[..., k], change, atol=1e-4)


def test_a_smoothed_run_with_closures_is_that_of_scipy():
    records, poses, places = told(1)
    poses, ties = np.asarray(poses), random_ties(np.asarray(poses), np.random.default_rng(1))
    records = jax.tree.map(np.asarray, records)
    found = sparse.smooth_log(records, poses, places, loop_closures=ties, robust_scale=np.inf)

    def both(x):
        state = unpack(x)
        return np.append(
            residuals(records, *state), loop_closure.closure_residuals(ties, state[0])[0]
        )

    best = least_squares(
        both, guess_of(found.poses, found.landmark_positions), "3-point", max_nfev=20
    )
    same(found, SmoothingResult(*unpack(best.x), None), 1e-4)
    np.testing.assert_allclose(found.cost[-1], 2 * best.cost, rtol=1e-5)
    plain = sparse.smooth_log(records, poses, places, robust_scale=np.inf)
    assert np.abs(plain.poses - found.poses).max() > 1e-3


def test_closures_are_doubted_as_cauchy_says():
    records, poses, places = told(1)
    poses, ties = np.asarray(poses), random_ties(np.asarray(poses), np.random.default_rng(1))
    records = jax.tree.map(np.asarray, records)
    records = records._replace(
        landmark_index=np.full_like(records.landmark_index, -1)
    )  # nothing else is
    found = sparse.smooth_log(records, poses, places, loop_closures=ties, robust_scale=1.5)

    def both(x):
        state = unpack(x)
        size = np.linalg.norm(loop_closure.closure_residuals(ties, state[0])[0], axis=1)
        return np.append(residuals(records, *state), 1.5 * np.sqrt(np.log1p((size / 1.5) ** 2)))

    best = least_squares(
        both, guess_of(found.poses, found.landmark_positions), "3-point", max_nfev=20
    )
    same(found, SmoothingResult(*unpack(best.x), None), 2e-3)
    np.testing.assert_allclose(found.cost[-1], 2 * best.cost, rtol=1e-5)


def test_a_closure_that_is_wrong_is_doubted():
    records, poses, places = told(1)
    poses = np.asarray(poses)
    ties = random_ties(poses, np.random.default_rng(1))
    right = ties._replace(relative_pose=relative(poses[ties.first], poses[ties.second]))
    wrong = right._replace(
        relative_pose=right.relative_pose + np.array([[0, 0, 0], [0, 0, 0], [3.0, 0, 0]])
    )
    smooth = lambda ties, doubt: sparse.smooth_log(
        records, poses, places, loop_closures=ties, robust_scale=doubt
    )
    off = lambda doubt: np.abs(smooth(wrong, doubt).poses - smooth(right, doubt).poses).max()
    assert off(3.0) < 0.2 * off(np.inf)
