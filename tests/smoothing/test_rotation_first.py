"""Pose graphs whose guess is metres and radians off."""

import numpy as np
import pytest

from jaxslam.core.se2_np import compose, dead_reckoning, relative, wrap_angle
from jaxslam.smoothing.rotation_first import Factors, solve_rotation_first

STD = np.array([0.02, 0.01, 0.004])


def drive(rounds=2, steps=40):
    """Poses (T, 3) of a robot that drives several times around a block."""
    step = np.tile([[0.5, 0.0, 0.0]] * 9 + [[0.5, 0.0, np.pi / 2]], (rounds * steps // 10, 1))
    return dead_reckoning(np.array([2.0, -1.0, 0.4]), step)


def factors_of(poses, pairs, noise=0.0, seed=0):
    """The steps of a drive, and the relative poses of pairs (N, 2) after them."""
    rng = np.random.default_rng(seed)
    first = np.concatenate([np.arange(len(poses) - 1), pairs[:, 0]])
    second = np.concatenate([np.arange(1, len(poses)), pairs[:, 1]])
    between = relative(poses[first], poses[second])
    between += noise * STD * rng.normal(size=between.shape)
    return Factors(first, second, between, np.tile(np.diag(STD**2), (len(first), 1, 1)))


def assert_same(found, poses, atol):
    np.testing.assert_allclose(found[:, :2], poses[:, :2], atol=atol)
    np.testing.assert_allclose(wrap_angle(found[:, 2] - poses[:, 2]), 0.0, atol=atol)


def test_exact_factors_give_the_poses_whatever_the_guess():
    poses = drive()
    guess = poses + np.random.default_rng(1).normal(size=poses.shape) * [20.0, 20.0, 0.7]
    guess[0] = poses[0]
    found = solve_rotation_first(guess, factors_of(poses, np.array([[0, 40], [3, 60]])))
    assert_same(found.poses, poses, 1e-9)
    np.testing.assert_allclose(found.weight, 1.0)


def test_small_noise_gives_the_linear_least_squares_solution():
    poses = drive()
    factors = factors_of(poses, np.array([[0, 40], [20, 61]]), noise=0.5)
    found = solve_rotation_first(poses, factors)
    turn = np.zeros((len(factors.first), len(poses)))
    rows = np.arange(len(turn))
    turn[rows, factors.second] += 1.0
    turn[rows, factors.first] -= 1.0
    off = relative(poses[factors.first], poses[factors.second])[:, 2]
    goal = wrap_angle(factors.relative_pose[:, 2] - off)
    expected = np.linalg.lstsq(turn[:, 1:], goal, rcond=None)[0]
    turned = wrap_angle(found.poses[:, 2] - poses[:, 2])
    # The kernel hardly weighs residuals of less than one standard deviation.
    np.testing.assert_allclose(turned[1:], expected, atol=0.1 * STD[2])
    assert found.weight.min() > 0.5


@pytest.mark.parametrize("step", [7, 33, 58])
@pytest.mark.parametrize("error", [(3.0, 0.0, 0.0), (0.2, -0.4, 1.0), (0.0, 0.0, 0.5)])
def test_the_one_step_that_was_wrong_is_found(step, error):
    poses = drive()
    pairs = np.stack([np.arange(40), np.arange(40, 80)], axis=1)
    factors = factors_of(poses, pairs, noise=0.5)
    wrong = factors.relative_pose.copy()
    wrong[step] = compose(wrong[step], np.array(error))
    guess = np.concatenate([poses[:1], dead_reckoning(poses[0], wrong[: len(poses) - 1])])
    found = solve_rotation_first(guess, factors._replace(relative_pose=wrong))
    assert np.flatnonzero(found.weight.min(axis=1) < 0.1).tolist() == [step]
    assert_same(found.poses, poses, 0.3)


def test_wrong_closures_among_right_ones_are_rejected():
    poses = drive()
    pairs = np.stack([np.arange(40), np.arange(40, 80)], axis=1)
    factors = factors_of(poses, pairs, noise=0.5)
    wrong = factors.relative_pose.copy()
    last = len(wrong) - 4
    wrong[[last, last - 4]] += [[4.0, 1.0, 0.3], [-3.0, 2.0, -0.4]]
    found = solve_rotation_first(poses, factors._replace(relative_pose=wrong))
    assert np.flatnonzero(found.weight.min(axis=1) < 0.1).tolist() == [last - 4, last]
    assert_same(found.poses, poses, 0.3)


def test_one_pose_without_factors_stays_where_it_is():
    none = Factors(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    found = solve_rotation_first(drive()[:1], none)
    np.testing.assert_array_equal(found.poses, drive()[:1])


def test_factors_that_do_not_fit_are_refused():
    poses = drive()
    factors = factors_of(poses, np.array([[0, 40]]))
    apart = Factors(*(np.delete(x, 20, axis=0)[:-1] for x in factors))
    with pytest.raises(ValueError, match="pose 21 is not joined to the first one"):
        solve_rotation_first(poses, apart)
    with pytest.raises(ValueError, match="factors.relative_pose is not finite"):
        solve_rotation_first(poses, factors._replace(relative_pose=factors.relative_pose * np.nan))
    with pytest.raises(ValueError, match=r"factors\.cov"):
        solve_rotation_first(poses, factors._replace(cov=factors.cov[:-1]))
    with pytest.raises(ValueError, match="poses"):
        solve_rotation_first(poses[:, :2], factors)
