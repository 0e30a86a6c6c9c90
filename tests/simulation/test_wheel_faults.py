"""Wheels that slip, odometry that fails, scans that are lost, robots that are carried."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxslam.simulation import wheel_faults
from jaxslam.simulation.path_following import densify
from jaxslam.simulation.wheel_faults import WheelFaults

T = 2000
ODOMETRY = jnp.asarray(np.random.default_rng(0).normal(size=(T, 3)))
carry, fail_odometry, slipped = map(
    jax.jit, (wheel_faults.carry, wheel_faults.fail_odometry, wheel_faults.slipped)
)
draw_faults, keeps_scan = (
    jax.jit(draw, static_argnums=(2, 3))
    for draw in (wheel_faults.draw_faults, wheel_faults.keeps_scan)
)
POSE, MOTION = jnp.array([0.3, 0.4, 0.1]), jnp.array([0.4, 0.0, 0.1])


def draws_of(faults, seed=0, num_scans=T):
    return draw_faults(jax.random.key(seed), faults, num_scans, jnp.float64)


def test_without_faults_all_is_as_it_was():
    faults = WheelFaults()
    draws = draws_of(faults)
    assert not draws.slip.any() and draws.carried_at == -1
    found = slipped(faults, draws, draws.slip[0], 0.4, POSE, MOTION)
    np.testing.assert_array_equal(found, MOTION)
    np.testing.assert_array_equal(fail_odometry(jax.random.key(0), faults, ODOMETRY), ODOMETRY)
    assert keeps_scan(jax.random.key(0), faults, T, jnp.float64).all()


def test_wheels_slip_as_often_and_as_far_as_they_should():
    faults = WheelFaults(slip=0.2, slip_share=0.1)
    share = np.asarray(draws_of(faults, num_scans=20001).slip)
    moved = share > 0.0
    assert abs(moved.mean() - 0.2) < 4.5 * np.sqrt(0.16 / share.size)
    below = np.minimum(0.1 * np.abs(stats.t(2).ppf([0.75, 0.85, 0.95])), 1.0)
    for limit, wanted in zip(below, (0.5, 0.7, 0.9), strict=True):
        found = (share[moved] < limit).mean()
        assert abs(found - wanted) < 4.5 * np.sqrt(wanted * (1 - wanted) / moved.sum())


def test_a_robot_turns_to_the_side_of_the_wheel_that_slips():
    """Against the arc of wheels of which one rolls less."""
    faults, straight = WheelFaults(), jnp.array([0.4, 0.0, 0.0])
    left = slipped(faults, draws_of(faults), jnp.array([0.1, 0.0]), 0.4, POSE, straight)
    np.testing.assert_allclose(left, [0.38, 0.0, 0.1], atol=1e-12)  # 0.36 m and 0.4 m, 0.4 m apart
    right = slipped(faults, draws_of(faults), jnp.array([0.0, 0.1]), 0.4, POSE, straight)
    np.testing.assert_allclose(right[2], -0.1, atol=1e-12)


def test_carpet_covers_its_share_of_the_floor_and_turns_to_one_side_in_each_patch():
    faults = WheelFaults(carpet=0.3, carpet_turn=0.05)
    draws = draws_of(faults)
    cells = np.stack(np.meshgrid(np.arange(-30, 30), np.arange(-30, 30)), -1).reshape(-1, 2)

    def turns(offset):
        poses = jnp.asarray(np.pad(wheel_faults.PATCH * (cells + offset), ((0, 0), (0, 1))))
        none = jnp.zeros(2)
        ahead = jnp.array([0.4, 0.0, 0.0])
        return np.asarray(
            jax.vmap(lambda pose: slipped(faults, draws, none, 0.4, pose, ahead)[2])(poses)
        )

    first, second = turns([0.1, 0.2]), turns([0.9, 0.7])
    np.testing.assert_array_equal(first, second)
    assert set(np.round(first, 9)) == {-0.02, 0.0, 0.02}
    assert abs((first != 0.0).mean() - 0.3) < 4.5 * np.sqrt(0.21 / len(cells))


@pytest.mark.parametrize("latched", [0.0, 1.0])
def test_odometry_that_fails_stands_or_repeats_its_last_increment(latched):
    faults = WheelFaults(lost=0.02, lost_scans=5.0, latched=latched)
    found = np.concatenate(
        [np.asarray(fail_odometry(jax.random.key(k), faults, ODOMETRY)) for k in range(10)]
    )
    given = np.tile(np.asarray(ODOMETRY), (10, 1))
    failing = np.any(found != given, axis=1)
    begins = np.flatnonzero(failing & ~np.roll(failing, 1))
    if latched:
        before = np.where(begins[:, None] % T == 0, 0.0, given[begins - 1])
        np.testing.assert_array_equal(found[begins], before)
        inside = np.flatnonzero(failing & np.roll(failing, 1) & (np.arange(len(found)) % T > 0))
        same = np.all(found[inside] == found[inside - 1], axis=1)
        assert same.mean() > 0.9  # but where one failure follows another at once
    else:
        assert np.all(found[failing] == 0.0)
    # Failing for 5 scans of every 5 + 49: a start in 50 scans that work, one of them failing.
    wanted = 5.0 / (5.0 + (1 - 0.02) / 0.02)
    assert abs(failing.mean() - wanted) < 4.5 * wanted * np.sqrt(2.0 / (len(begins)))


def test_scans_are_lost_as_often_as_they_should():
    kept = keeps_scan(jax.random.key(0), WheelFaults(dropped=0.3), 20000, jnp.float64)
    assert abs(np.asarray(kept).mean() - 0.7) < 4.5 * np.sqrt(0.21 / 20000)


def test_a_carried_robot_is_put_down_further_along_its_path():
    path = jnp.asarray(densify([(0.0, 0.0), (4.0, 0.0), (4.0, 4.0)]))
    faults = WheelFaults(carried=1.0, carry=3.0)
    at = [int(draws_of(faults, seed, 50).carried_at) for seed in range(200)]
    assert min(at) >= 0 and max(at) <= 48 and len(set(at)) > 40
    index = jnp.int32(40)  # at (2, 0)
    pose, there = carry(faults, jnp.asarray(True), path, index, jnp.array([2.0, 0.1, 0.2]))
    np.testing.assert_allclose(pose, [4.0, 1.0, np.pi / 2], atol=0.051)
    np.testing.assert_allclose(path[there], pose[:2])
    pose, there = carry(faults, jnp.asarray(False), path, index, POSE)
    np.testing.assert_array_equal(pose, POSE)
    assert there == 40
    end = carry(faults._replace(carry=99.0), jnp.asarray(True), path, index, POSE)[0]
    np.testing.assert_allclose(end, [4.0, 4.0, np.pi / 2], atol=0.06)
