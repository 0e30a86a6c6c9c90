import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simulated_scans import CORRIDOR, LIDAR, odometry_of, scans_of

from jaxslam.core.se2 import compose, relative
from jaxslam.matching import motion_prior, wide_search
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.scan_matching import empty_submap, match_scans
from jaxslam.matching.wide_search import MatchedPose
from jaxslam.simulation import path_following, worlds

SPEC = ScanMatchSpec(window_scans=8)
SCANS_ONLY = SPEC._replace(use_odometry=False)


@pytest.fixture(scope="module")
def drive():
    """A quarter of a metre a scan through the office, where it turns as well."""
    path = path_following.densify(worlds.waypoints("office"))
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    driven = 8.0 + 0.25 * np.arange(30)
    x, y = (np.interp(driven, along, column) for column in path.T)
    ahead = [np.interp(driven + 0.3, along, column) for column in path.T]
    poses = jnp.stack([x, y, np.arctan2(ahead[1] - y, ahead[0] - x)], axis=1)
    return poses, scans_of(worlds.named("office"), poses, LIDAR.range_std)


def matches_of(spec, scans, odometry, start=None):
    submap = empty_submap(spec, LIDAR)
    if start is not None:
        submap = submap._replace(last_pose=start)
    return match_scans(spec, LIDAR, submap, scans, odometry)[1]


def errors_of(poses, found):
    error = np.asarray(jax.vmap(relative)(odometry_of(poses), found.increment))
    return np.hypot(*error[:, :2].T).max(), np.abs(error[:, 2]).max()


def latched(odometry):
    """No motion for three scans, and then that of four at once, twice."""
    hurt = np.array(odometry)
    for k in (8, 19):
        whole = np.zeros(3)
        for step in hurt[k : k + 4]:
            whole = np.asarray(compose(jnp.asarray(whole), jnp.asarray(step)))
        hurt[k : k + 4] = 0.0
        hurt[k + 3] = whole
    return jnp.asarray(hurt)


def test_latched_wheels_do_not_move_the_scans(drive):
    poses, scans = drive
    found = matches_of(SPEC, scans, latched(odometry_of(poses)))
    distance, turn = errors_of(poses, found)
    assert distance < 0.03 and turn < 0.01
    weight = np.asarray(found.odometry_weight)
    assert (weight[[8, 9]] == 0.0).all() and weight[11] < 0.6 and weight[:7].min() == 1.0


def test_without_odometry_what_the_wheels_say_does_not_matter(drive):
    poses, scans = drive
    found = matches_of(SCANS_ONLY, scans, jnp.zeros_like(poses))
    distance, turn = errors_of(poses, found)
    assert distance < 0.03 and turn < 0.01
    other = matches_of(SCANS_ONLY, scans, jnp.ones_like(poses))
    np.testing.assert_array_equal(other.increment, found.increment)
    assert not np.asarray(found.odometry_weight).any()


def test_the_search_does_not_depend_on_the_pose_in_the_world(drive):
    poses, scans = drive
    hurt = latched(odometry_of(poses))
    once = matches_of(SPEC, scans, hurt)
    moved = matches_of(SPEC, scans, hurt, start=jnp.array([5.0, -3.0, 2.0]))
    np.testing.assert_allclose(moved.increment, once.increment, atol=1e-3)


def test_a_bare_corridor_leaves_the_position_along_it_to_the_wheels():
    """Wheels that slow down at once, in a corridor: a leap that the scans cannot deny."""
    steps = np.array([0.0] + 8 * [0.5] + 8 * [0.1])
    poses = jnp.stack([jnp.cumsum(jnp.asarray(steps)), jnp.zeros(17), jnp.zeros(17)], axis=1)
    found = matches_of(SPEC, scans_of(CORRIDOR, poses, 0.005), odometry_of(poses))
    np.testing.assert_allclose(found.increment[:, 0], steps, atol=0.06)
    information = np.asarray(found.information)[1:]
    assert (information[:, 0, 0] < 0.01 * information[:, 1, 1]).all()


def test_information_is_that_of_a_gaussian_over_both_places():
    a = np.random.default_rng(0).normal(size=(5, 3)) * 20
    match = MatchedPose(jnp.array([1.0, 2.0, 3.1]), jnp.asarray(a.T @ a), jnp.ones(()))
    other, advantage = jnp.array([1.4, 2.1, -3.1]), -0.5 * wide_search.PROBABILITY_SCALE
    p = 1.0 / (1.0 + np.exp(0.5))
    d = np.array([0.4, 0.1, 2 * np.pi - 6.2])
    cov = np.linalg.inv(a.T @ a) + p * (1 - p) * np.outer(d, d)
    found = wide_search.spread_over(match, other, jnp.asarray(advantage))
    np.testing.assert_allclose(found, np.linalg.inv(cov), rtol=1e-6)
    certain = wide_search.spread_over(match, other, jnp.asarray(-1.0))
    np.testing.assert_allclose(certain, match.information, rtol=1e-6)


def test_equal_places_are_ambiguous_rather_than_guessed():
    match = MatchedPose(jnp.zeros(3), 1e6 * jnp.eye(3), jnp.ones(()))
    found = wide_search.spread_over(match, jnp.array([0.6, 0.0, 0.0]), jnp.zeros(()))
    np.testing.assert_allclose(found[0, 0], 1.0 / 0.3**2, rtol=1e-3)
    np.testing.assert_allclose(found[1, 1], 1e6, rtol=1e-6)


def test_distrust_grows_with_contradictions_and_is_forgotten():
    history = motion_prior.first_history()
    wheels, moved = jnp.array([0.0, 0.0, 0.0]), jnp.array([0.3, 0.0, 0.0])
    assert motion_prior.contradicts(SPEC, wheels, moved)
    assert not motion_prior.contradicts(SPEC, moved, moved)
    for _ in range(20):
        history = motion_prior.next_history(history, moved, jnp.ones(()), jnp.asarray(True))
    distrusted = motion_prior.expected_motion(SPEC, history, wheels, history.distrust)
    np.testing.assert_allclose(distrusted.increment, moved, atol=0.01)
    for _ in range(30):
        history = motion_prior.next_history(history, moved, jnp.ones(()), jnp.asarray(False))
    assert history.distrust < 0.01
    trusted = motion_prior.expected_motion(SPEC, history, moved + 0.01, history.distrust)
    np.testing.assert_allclose(trusted.increment, moved + 0.01, atol=1e-3)


def test_a_leap_is_one_of_wheels_and_far_beyond_what_is_usual():
    history = motion_prior.first_history()
    for k in range(40):
        step = jnp.array([0.2 + 0.01 * (k % 2), 0.0, 0.05])
        history = motion_prior.next_history(history, step, jnp.ones(()), jnp.asarray(False))
    assert not motion_prior.is_leap(history, step + 0.02)
    assert motion_prior.is_leap(history, jnp.zeros(3))
    assert not motion_prior.is_leap(history._replace(distrust=jnp.ones(())), jnp.zeros(3))
