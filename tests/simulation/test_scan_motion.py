"""Scans that take time: each beam is measured from where the scanner is at its own time."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.se2_np import compose
from jaxslam.simulation import World, given_poses, scan_motion
from jaxslam.simulation.ray_casting import cast
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.scanners import Scanner, pieces

SCANNER = Scanner(
    "test",
    91,
    -math.pi / 4,
    math.pi / 180,
    10.0,
    0.0,
    30.0,
    range_noise=pieces((0.0, 0.0, 0.0)),
    turn_time=1 / 75,
    num_turns=2,
)
BOX = World(jnp.array([[-5, -4, 5, -4], [5, -4, 5, 4], [5, 4, -5, 4], [-5, 4, -5, -4.0]]))
POSE, VELOCITY = np.array([0.5, -0.7, 0.3]), np.array([0.6, 0.1, 0.8])


def scan(scanner, velocity):
    robot = Robot(scanner=scanner)
    given = scanner.lidar(), robot, BOX, POSE[None]
    _, found = given_poses.simulate_at_poses(jax.random.key(0), *given, velocities=velocity[None])
    return np.asarray(found.ranges)[0]


def test_the_beams_of_a_turn_follow_each_other_and_turns_alternate():
    times = scan_motion.beam_times(SCANNER)
    assert abs(times.mean()) < 1e-12
    even, odd = times[::2], times[1::2]
    np.testing.assert_allclose(np.diff(even), 2 / 360 / 75)
    np.testing.assert_allclose(odd - even[: len(odd)], (1 + 1 / 360) / 75)
    assert not scan_motion.beam_times(SCANNER._replace(turn_time=None)).any()


def test_each_beam_is_measured_from_its_own_pose():
    """Against a scan of its own for each beam; both walls at a corner are seen, and no third."""
    times = scan_motion.beam_times(SCANNER)
    poses = compose(POSE, np.outer(times, VELOCITY))
    many = jax.jit(jax.vmap(lambda pose: cast(SCANNER.lidar(), BOX, pose).ranges))
    own = np.diag(many(jnp.asarray(poses)))  # beam k of the scan from pose k
    found, still = scan(SCANNER, VELOCITY), scan(SCANNER._replace(turn_time=None), VELOCITY)
    error = np.abs(found - own)
    assert np.median(error) < 2e-4 and np.sort(error)[-4] < 1e-3  # but at corners
    assert np.median(np.abs(still - own)) > 2e-3


def test_a_scanner_that_stands_still_sees_what_it_sees_at_once():
    still = scan(SCANNER, np.zeros(3))
    np.testing.assert_allclose(still, scan(SCANNER._replace(turn_time=None), VELOCITY), atol=1e-9)


def test_velocities_are_those_from_pose_to_pose():
    poses = np.stack([POSE, compose(POSE, 0.5 * VELOCITY), compose(POSE, 0.5 * VELOCITY)])
    found = scan_motion.velocities(jnp.asarray(poses), jnp.array([0.0, 0.5, 0.7]))
    np.testing.assert_allclose(found, [VELOCITY, np.zeros(3), np.zeros(3)], atol=1e-12)
