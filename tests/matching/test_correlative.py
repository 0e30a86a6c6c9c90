import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxslam.core import se2_np
from jaxslam.core.se2 import relative
from jaxslam.matching import correlative
from jaxslam.matching.correlative import CorrelativeSpec

likelihood_field = jax.jit(correlative.likelihood_field, static_argnums=0)
window_scores = jax.jit(correlative.window_scores, static_argnums=(0, 2))
SPEC = CorrelativeSpec(
    extent=6.0, max_displacement=0.5, max_turn=0.4, turn_step=0.1, max_points=40, num_candidates=3
)


def room(seed=0, count=400):
    """Points (count, 2) on the walls of a room that is not symmetric, with two pillars."""
    rng = np.random.default_rng(seed)
    corners = np.array([[-3, -2], [4, -2], [4, 1], [2, 1], [2, 2.5], [-3, 2.5], [-3, -2]], float)
    side = rng.integers(0, len(corners) - 1, count)
    along = rng.random((count, 1))
    points = corners[side] + along * (corners[side + 1] - corners[side])
    points[:40] = np.array([1.0, -0.5]) + 0.2 * rng.standard_normal((40, 2))
    return points + 0.01 * rng.standard_normal(points.shape)


def slow_field(points):
    """Gaussian of the distance between the cells of the grid and the nearest occupied one."""
    half = round(SPEC.extent / SPEC.cell)
    occupied = np.unique(np.round(points / SPEC.cell), axis=0)
    axis = np.arange(-half, half + 1)
    cells = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    distance = SPEC.cell * cKDTree(occupied).query(cells)[0]
    return np.exp(-0.5 * (distance / SPEC.std) ** 2)


def slow_scores(points, scan):
    """Score of every pose of the window, one after the other."""
    field, half = slow_field(points), round(SPEC.extent / SPEC.cell)
    headings = SPEC.turn_step * np.arange(-4, 5)
    shifts = np.arange(-5, 6)
    scores = np.zeros((9, 11, 11))
    for a, heading in enumerate(headings):
        c, s = np.cos(heading), np.sin(heading)
        cell = np.round(scan @ np.array([[c, s], [-s, c]]) / SPEC.cell).astype(int) + half
        for i, dx in enumerate(shifts):
            for j, dy in enumerate(shifts):
                scores[a, i, j] = field[cell[:, 0] + dx, cell[:, 1] + dy].mean()
    return scores


def test_the_field_is_a_gaussian_of_the_distance_to_the_nearest_point():
    points = room()
    field = likelihood_field(SPEC, jnp.asarray(points), jnp.ones(len(points), bool))
    slow = slow_field(points)
    near = slow > np.exp(-0.5 * 2.0**2)  # up to two standard deviations
    np.testing.assert_allclose(np.asarray(field)[near], slow[near], atol=1e-6)
    assert (np.asarray(field)[~near] <= np.exp(-0.5 * 2.0**2) + 1e-6).all()


def test_points_that_do_not_exist_or_are_far_off_leave_no_trace():
    points = np.concatenate([room(), [[0.0, 0.0], [-50.0, 0.0], [0.0, 6.06], [1e6, 1e6]]])
    valid = np.arange(len(points)) < 400
    given = likelihood_field(SPEC, jnp.asarray(points), jnp.asarray(valid))
    alone = likelihood_field(SPEC, jnp.asarray(room()), jnp.ones(400, bool))
    np.testing.assert_array_equal(given, alone)
    outside = jnp.asarray(points[401:])
    assert not likelihood_field(SPEC, outside, jnp.ones(3, bool)).any()


def test_scores_are_those_of_brute_force():
    points, scan = room(), room(seed=1, count=40) * 0.95
    field = jnp.asarray(slow_field(points))
    hit = jnp.arange(41) < 40
    padded = jnp.asarray(np.concatenate([scan, [[0.0, 0.0]]]))
    alike = jnp.sum  # of nothing: all poses are as likely
    no_prior = SPEC._replace(score_scale=0.0)
    found = window_scores(no_prior, field, alike, padded, hit, jnp.asarray(False))
    middle = len(found) // 2
    slow = slow_scores(points, scan)
    np.testing.assert_allclose(found[middle - 4 : middle + 5], slow, atol=1e-6)
    assert np.isneginf(found[: middle - 4]).all() and np.isneginf(found[middle + 5 :]).all()
    whole = window_scores(no_prior, field, alike, padded, hit, jnp.asarray(True))
    assert np.isfinite(whole).all() and len(whole) * SPEC.turn_step > 2 * np.pi - 0.1
    np.testing.assert_allclose(whole[middle - 4 : middle + 5], slow, atol=1e-6)


@jax.jit
def search_of(points, guess, expected, scan, every_heading):
    def log_density(pose):
        off = jax.vmap(relative, (None, 0))(pose, expected)
        off = off / jnp.array([[0.5, 0.5, 0.75]])
        return -0.5 * jnp.min(jnp.sum(off**2, axis=1))

    valid, hit = jnp.ones(len(points), bool), jnp.ones(len(scan), bool)
    return correlative.search(SPEC, points, valid, guess, log_density, scan, hit, every_heading)


def search(points, guess, expected, scan, every_heading=False):
    """The search, with every point there is, near poses (E, 3) as likely as a Gaussian says."""
    given = jnp.asarray(points), jnp.asarray(guess), jnp.asarray(expected), jnp.asarray(scan)
    return jax.tree.map(np.asarray, search_of(*given, jnp.asarray(every_heading)))


@pytest.mark.parametrize("offset", [[0.0, 0.0, 0.0], [0.4, -0.3, 0.3], [-0.45, 0.2, -0.4]])
def test_a_pose_within_the_window_is_found(offset):
    true = np.array([0.2, 0.1, 0.5])
    guess = se2_np.compose(true, np.array(offset))
    scan = se2_np.inverse_transform(true, room())
    found = search(room(), guess, guess[None], scan)
    off = se2_np.relative(true, found.poses[0])
    assert np.hypot(*off[:2]) < 0.1 and abs(off[2]) < 0.06
    assert found.score[0] > found.score[1]


def test_the_result_moves_with_guess_and_submap():
    moved = np.array([7.0, -3.0, 2.1])
    guess, expected = np.array([0.1, 0.2, 0.3]), np.array([[0.2, 0.2, 0.3], [-0.1, 0.0, 0.1]])
    scan = room(seed=3, count=60)
    here = search(room(), guess, expected, scan)
    points = se2_np.transform(moved, room())
    there = search(points, se2_np.compose(moved, guess), se2_np.compose(moved, expected), scan)
    np.testing.assert_allclose(there.score, here.score, atol=0.02)  # points at borders of cells
    off = se2_np.relative(se2_np.compose(moved, here.poses[0]), there.poses[0])
    assert np.hypot(*off[:2]) < 1e-6 and abs(off[2]) < 1e-6


def test_candidates_are_different_places_and_those_expected_come_first():
    x = np.arange(-5.0, 5.0, 0.05)  # a bare corridor: every place along it fits
    walls = np.concatenate([np.stack([x, np.full_like(x, y)], axis=1) for y in (-1.0, 1.2)])
    scan = walls[np.abs(walls[:, 0]) < 4.0]
    expected = np.array([[0.3, 0.0, 0.0]])
    found = search(walls, np.zeros(3), expected, scan)
    np.testing.assert_allclose(found.poses[0], expected[0], atol=0.051)
    for a in range(3):
        for b in range(a):
            apart = np.abs(found.poses[a] - found.poses[b])
            assert np.hypot(*apart[:2]) >= SPEC.distinct[0] or apart[2] >= SPEC.distinct[1]


def test_where_all_headings_are_searched_a_robot_that_looks_back_is_found():
    true = np.array([0.2, 0.1, 0.5])
    guess = se2_np.compose(true, np.array([0.2, 0.1, 3.0]))
    scan = se2_np.inverse_transform(true, room())
    for every, near in ((True, True), (False, False)):
        off = se2_np.relative(true, search(room(), guess, guess[None], scan, every).poses[0])
        assert (np.hypot(*off[:2]) < 0.15 and abs(off[2]) < 0.06) == near


def test_surprise_grows_with_the_logarithm_of_the_density_and_ends():
    np.testing.assert_allclose(correlative.surprise(SPEC, jnp.zeros(())), 0.0)
    np.testing.assert_allclose(correlative.surprise(SPEC, -jnp.ones(())), SPEC.score_scale)
    np.testing.assert_allclose(correlative.surprise(SPEC, -1e6 * jnp.ones(())), SPEC.max_penalty)
