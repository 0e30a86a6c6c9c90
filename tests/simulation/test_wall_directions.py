import math

import numpy as np
import pytest

from jaxslam.simulation import kinematics, named
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.wall_directions import MIN_LENGTH, direction_std
from jaxslam.simulation.worlds import World

RNG = np.random.default_rng(5)


def walls_of(directions, lengths):
    """Walls (S, 4) with these directions and lengths, anywhere and either end first."""
    start = RNG.uniform(-20, 20, (len(directions), 2))
    along = np.stack([np.cos(directions), np.sin(directions)], axis=1) * lengths[:, None]
    ends = np.concatenate([start, start + along], axis=1)
    return np.where(RNG.random((len(ends), 1)) < 0.5, ends, ends[:, [2, 3, 0, 1]])


def by_pairs(walls, min_length, max_angle):
    """The definition, pair by pair."""
    along = walls[:, 2:] - walls[:, :2]
    length = np.hypot(*along.T)
    squares = pairs = 0.0
    for i in np.flatnonzero(length >= min_length):
        for j in np.flatnonzero(length >= min_length):
            angle = math.atan2(*along[i][::-1]) - math.atan2(*along[j][::-1])
            angle = (angle + math.pi / 2) % math.pi - math.pi / 2
            if abs(angle) < max_angle:
                squares += length[i] * length[j] * angle**2
                pairs += length[i] * length[j]
    return math.sqrt(squares / (2 * pairs))


@pytest.mark.parametrize("max_angle", [0.05, 0.26, 1.0])
def test_direction_std_is_that_of_all_pairs(max_angle):
    walls = walls_of(RNG.uniform(0, 2 * math.pi, 60), RNG.uniform(0.5, 8, 60))
    found = direction_std(walls, min_length=2.0, max_angle=max_angle)
    assert found == pytest.approx(by_pairs(walls, 2.0, max_angle), rel=1e-9)


def test_direction_std_of_walls_about_two_directions():
    std, count = 0.02, 4000
    base = np.where(RNG.random(count) < 0.5, 0.0, math.pi / 2)
    walls = walls_of(base + std * RNG.standard_normal(count), np.full(count, 3.0))
    assert abs(direction_std(walls) - std) < 5 * std / math.sqrt(2 * count)


def test_parallel_walls_have_no_spread_and_short_ones_do_not_count():
    for turn in (0.0, 0.3):
        base = turn + np.array([0.0, math.pi / 2, math.pi])
        long, short = walls_of(base, np.full(3, 4.0)), walls_of(base + 0.1, np.full(3, 1.9))
        assert direction_std(np.concatenate([long, short])) == pytest.approx(0.0, abs=1e-7)
    assert direction_std(np.zeros((0, 4))) == direction_std(short) == 0.0
    assert MIN_LENGTH == 2.0


def test_noise_of_wall_directions_is_that_of_the_building():
    robot, walls = Robot(), walls_of(0.03 * RNG.standard_normal(30), np.full(30, 3.0))
    own = float(kinematics.noise_params(robot).wall_angle_std)
    found = kinematics.noise_params(robot, World(walls))
    assert float(found.wall_angle_std) == pytest.approx(math.hypot(own, direction_std(walls)))
    office = kinematics.noise_params(robot, named("office"))
    assert float(office.wall_angle_std) == pytest.approx(own)
    changed = [
        name
        for name, x, y in zip(found._fields, found, kinematics.noise_params(robot), strict=True)
        if x is not y and not np.array_equal(x, y)
    ]
    assert changed == ["wall_angle_std"]
