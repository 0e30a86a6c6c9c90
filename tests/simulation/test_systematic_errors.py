from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2_np
from jaxslam.core.calibration import Calibration, calibrate_odometry
from jaxslam.simulation import drives, worlds
from jaxslam.simulation.arguments import as_robot
from jaxslam.simulation.path_following import GOAL_TOLERANCE, densify
from jaxslam.simulation.robot import Robot

STILL = Robot(encoder_noise=0.0)
HURT = Robot(0.4, 0.0, (1.05, 0.97), 1.04, (0.25, 0.05, np.deg2rad(3.0)), 0.08)
PATH = jnp.asarray(densify([(1.0, 0.9), (3.5, 0.9), (3.5, 3.0)]))
SCANS = 40

drive = jax.jit(drives.drive, static_argnames=("robot", "num_scans"))


def driven(robot, path=PATH, num_scans=SCANS, seed=0):
    """True poses (T, 3) of the scanner and odometry (T, 3) of a drive, in NumPy."""
    return [np.asarray(x) for x in drive(jax.random.key(seed), robot, path, num_scans=num_scans)]


@pytest.mark.parametrize(
    "robot",
    [
        HURT,
        HURT._replace(time_offset=-0.08),
        HURT._replace(time_offset=1.3, wheel_scales=(0.9, 0.95)),
        HURT._replace(time_offset=-0.5, scan_period=0.25),
        STILL._replace(wheel_base_scale=0.9),
    ],
)
def test_the_true_calibration_makes_odometry_exact(robot):
    """At all scans, the first and the last too: the robot stands still before and after them."""
    truth, odometry = driven(robot)
    times = robot.scan_period * np.arange(SCANS)
    found = calibrate_odometry(
        robot.calibration(), odometry, times=times, wheel_base=robot.wheel_base
    )
    np.testing.assert_allclose(found, se2_np.increments(truth), atol=1e-12)
    wrong = calibrate_odometry(Calibration.identity(), odometry)
    assert np.abs(wrong - se2_np.increments(truth)).max() > 0.01


def test_a_robot_has_no_systematic_errors_by_default():
    for found, none in zip(Robot().calibration(), Calibration.identity(), strict=True):
        np.testing.assert_array_equal(found, none)


@pytest.mark.parametrize(
    "robot",
    [HURT, STILL._replace(wheel_scales=(1.2, 0.85)), STILL._replace(wheel_base_scale=1.25)],
)
def test_the_path_through_the_office_is_followed_to_its_end(robot):
    path = jnp.asarray(densify(worlds.waypoints("office")))
    num_scans = drives.num_scans_of_drive(robot, path)
    centre = robot._replace(mount=(0.0, 0.0, 0.0), time_offset=0.0)
    poses, odometry = driven(centre, path, num_scans)
    away = np.linalg.norm(poses[:, None, :2] - np.asarray(path)[None], axis=2)
    assert away[-1, -1] < GOAL_TOLERANCE and away.min(axis=1).max() < 0.25
    assert np.any(odometry[1:] != 0.0, axis=1).all()
    scanner = driven(centre._replace(mount=HURT.mount), path, num_scans)[0]
    np.testing.assert_allclose(scanner, se2_np.compose(poses, np.array(HURT.mount)), atol=1e-12)


def test_a_scan_between_two_poses_has_the_encoder_noise_up_to_there():
    """Late by a whole period it is at the next pose, and a little less than that is near it."""
    robot = HURT._replace(encoder_noise=0.02, time_offset=0.0)
    at_stamp, _ = driven(robot)
    next_one, near, middle = (
        driven(robot._replace(time_offset=share * robot.scan_period))[0]
        for share in (1.0, 1.0 - 1e-7, 0.5)
    )
    np.testing.assert_array_equal(next_one[:-1], at_stamp[1:])
    np.testing.assert_array_equal(next_one[-1], at_stamp[-1])
    np.testing.assert_allclose(near, next_one, atol=1e-6)
    moved = np.linalg.norm(np.diff(at_stamp[:, :2], axis=0), axis=1)
    halves = [np.linalg.norm((middle - x)[:-1, :2], axis=1) for x in (at_stamp, next_one)]
    assert np.all(halves[0] + halves[1] < moved + 0.01) and np.all(halves[0] < 0.8 * moved + 1e-3)


def test_a_wheel_errs_in_proportion_to_what_it_truly_rolls():
    """The noise of the drive that is calibrated is that of encoders, with 5 standard errors."""
    robot = HURT._replace(encoder_noise=0.02, time_offset=0.0, mount=(0.0, 0.0, 0.0))
    keys = jax.random.split(jax.random.key(1), 64)
    many = jax.jit(jax.vmap(partial(drives.drive, robot=robot, path=PATH, num_scans=SCANS)))
    truth, odometry = (np.asarray(x) for x in many(keys))
    given = robot.calibration()
    error, spread = [], []
    for poses, reported in zip(truth, odometry, strict=True):
        exact = calibrate_odometry(given, reported, wheel_base=robot.wheel_base)
        moves = np.any(reported != 0.0, axis=1)
        base = robot.wheel_base * robot.wheel_base_scale
        chord = np.hypot(exact[:, 0], exact[:, 1])
        turn = np.abs(exact[:, 2])
        rolled = np.maximum(2 * chord / np.sinc(turn / 2 / np.pi), base * turn)  # both wheels
        error.append((se2_np.increments(poses) - exact)[moves, 2])
        spread.append((robot.encoder_noise * np.sqrt(rolled) / base)[moves])
    z = np.concatenate(error) / np.concatenate(spread)
    assert z.size > 1000
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / z.size)


def test_a_robot_that_does_not_arrive_is_refused():
    with pytest.raises(ValueError, match=r"robot does not arrive .* wheel_scales are \(0.1, 0.1\)"):
        drives.num_scans_of_drive(STILL._replace(wheel_scales=(0.1, 0.1)), PATH)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"wheel_scales": (1.0, 0.0)},
            r"robot.wheel_scales is \(1.0, 0.0\), not two numbers",
        ),
        ({"wheel_scales": 1.0}, "robot.wheel_scales is 1.0, not 2 numbers"),
        ({"wheel_base_scale": np.nan}, "robot.wheel_base_scale is nan, not above 0"),
        ({"mount": (0.1, 0.2)}, r"robot.mount is \(0.1, 0.2\), not 3 numbers"),
        ({"mount": (0.1, np.inf, 0.0)}, r"robot.mount is \(0.1, inf, 0.0\), not finite"),
        ({"time_offset": np.nan}, "robot.time_offset is nan, not finite"),
        ({"scan_period": 0.0}, "robot.scan_period is 0.0, not above 0"),
        ({"scan_period": "slow"}, "robot.scan_period is 'slow', not a number"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        as_robot(Robot()._replace(**change))


def test_fields_of_any_kind_become_static():
    given = Robot(np.float32(0.5), 0, [1, np.float32(1.5)], 2, np.zeros(3), np.int32(1))
    robot = as_robot(given)
    assert hash(robot) == hash(Robot(0.5, 0.0, (1.0, 1.5), 2.0, (0.0, 0.0, 0.0), 1.0))
