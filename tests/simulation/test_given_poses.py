"""Odometry and scans at given poses: the poses are those, and the wheels report them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, dead_reckoning
from jaxslam.simulation import Robot, WheelFaults, World, densify, given_poses, life_in
from jaxslam.simulation.ray_casting import cast
from jaxslam.simulation.robot import wheel_increment

LIDAR = Lidar(num_beams=31, angle_min=-1.5, angle_increment=0.1, range_max=9.0, range_std=0.0)
BOX = World(np.array([[-5, -4, 5, -4], [5, -4, 5, 4], [5, 4, -5, 4], [-5, 4, -5, -4.0]]))
EXACT = Robot(encoder_noise=0.0)
KEY = jax.random.key(3)


def arcs(count, seed=0):
    """Poses (count, 3) after arcs, as a robot of two wheels drives them."""
    rng = np.random.default_rng(seed)
    wheels = rng.uniform(-0.1, 0.3, (count - 1, 2))
    steps = np.stack([wheel_increment(*pair, 0.4) for pair in wheels])
    return dead_reckoning(np.array([-2.0, 1.0, 0.4]), np.vstack([np.zeros(3), steps]))


def test_scans_are_taken_at_the_given_poses_and_the_wheels_report_them():
    poses = arcs(12)
    odometry, scans = given_poses.simulate_at_poses(KEY, LIDAR, EXACT, BOX, poses)
    found = dead_reckoning(poses[0], np.asarray(odometry))
    np.testing.assert_allclose(found[:, :2], poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.cos(found[:, 2] - poses[:, 2]), 1.0, atol=1e-12)
    for k in (0, 5, 11):
        exact = cast(LIDAR, World(jnp.asarray(BOX.walls)), jnp.asarray(poses[k]))
        np.testing.assert_allclose(scans.ranges[k], exact.ranges, atol=1e-9)
        np.testing.assert_array_equal(scans.hit[k], exact.hit)


def test_the_poses_are_those_of_the_scanner_wherever_it_is_mounted():
    """Odometry is that of the scanner at its nominal mount, as of a drive that is steered."""
    mount = np.array([0.3, -0.1, 0.5])
    robot = EXACT._replace(nominal_mount=tuple(mount))
    poses = compose(arcs(12), mount)
    odometry, _ = given_poses.simulate_at_poses(KEY, LIDAR, robot, BOX, poses)
    found = dead_reckoning(poses[0], np.asarray(odometry))
    np.testing.assert_allclose(found[:, :2], poses[:, :2], atol=1e-9)


def test_systematic_errors_are_those_of_the_encoders():
    """A wheel that rolls 2 % further than its encoder reads: the encoder reads the less."""
    poses = dead_reckoning(np.zeros(3), np.vstack([np.zeros(3), [[0.5, 0.0, 0.0]] * 3]))
    robot = EXACT._replace(wheel_scales=(1.02, 1.0))
    odometry, _ = given_poses.simulate_at_poses(KEY, LIDAR, robot, BOX, poses)
    left, right = 0.5 / 1.02, 0.5
    np.testing.assert_allclose(odometry[1:, 2], (right - left) / 0.4, rtol=1e-9)


def test_the_noise_is_that_of_the_wheels():
    """Of 1 m ahead: variance s^2 / 2 of the distance and 2 s^2 / base^2 of the turn."""
    count, noise = 3000, 0.02
    poses = np.zeros((count, 3))
    poses[:, 0] = np.arange(count) % 2  # to and fro
    robot = Robot(encoder_noise=noise)
    tiny = LIDAR._replace(num_beams=2)
    odometry, _ = given_poses.simulate_at_poses(KEY, tiny, robot, BOX, poses)
    steps = np.asarray(odometry)[1:]
    distance = np.hypot(steps[:, 0], steps[:, 1])
    for found, std in ((distance - 1.0, noise / np.sqrt(2)), (steps[:, 2], noise * 2**0.5 / 0.4)):
        assert abs(found.std() / std - 1.0) < 4.5 / np.sqrt(2 * count)
        assert abs(found.mean()) < 4.5 * std / np.sqrt(count) + std**2


def test_a_wheel_that_slips_reports_more_than_it_moves():
    poses = dead_reckoning(np.zeros(3), np.vstack([np.zeros(3), [[0.02, 0.0, 0.0]] * 60]))
    path = densify([(0.0, 0.0), (1.2, 0.0)])
    faults = WheelFaults(slip=0.5, slip_share=0.1)
    life = life_in(BOX, path, wheels=faults)
    odometry, _ = given_poses.simulate_at_poses(KEY, LIDAR, EXACT, BOX, poses, life=life)
    steps = np.asarray(odometry)[1:]
    left, right = steps[:, 0] - 0.2 * steps[:, 2], steps[:, 0] + 0.2 * steps[:, 2]
    slipped = np.concatenate([left, right]) > 0.02 + 1e-9
    assert min(left.min(), right.min()) > 0.0199 and steps[:, 0].max() < 0.2
    assert abs(slipped.mean() - 0.5) < 4.5 * 0.5 / np.sqrt(120)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"poses": np.zeros((3, 2))}, "poses"),
        ({"poses": np.full((3, 3), np.nan)}, "poses: one pose at least .* finite numbers"),
        ({"times": np.zeros(4)}, "times"),
        ({"velocities": np.full((3, 3), np.inf)}, "velocities"),
        ({"robot": Robot(odometry_rate=10.0)}, "robot: at given poses it has two wheels"),
        ({"life": life_in(BOX, BOX.walls[:, :2])._replace(materials=np.zeros(2))}, "life.materi"),
        (
            {"life": life_in(BOX, BOX.walls[:, :2], wheels=WheelFaults(carried=0.1))},
            "life.wheels.carried is not 0",
        ),
    ],
)
def test_what_is_not_possible_is_refused(given, message):
    own = {"robot": EXACT, "poses": np.zeros((3, 3)), "times": None, "life": None} | given
    robot, poses = own.pop("robot"), own.pop("poses")
    with pytest.raises(ValueError, match=message):
        given_poses.simulate_at_poses(KEY, LIDAR, robot, BOX, poses, **own)
