from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2_np
from jaxslam.core.calibration import Calibration, calibrate_odometry
from jaxslam.filtering import motion_model
from jaxslam.filtering.noise import NoiseParams
from jaxslam.simulation import drives, kinematics, worlds
from jaxslam.simulation.arguments import as_robot
from jaxslam.simulation.path_following import GOAL_TOLERANCE, LOOKAHEAD, densify
from jaxslam.simulation.robot import Robot, arc_increment
from jaxslam.simulation.worlds import World

CAR = Robot(
    wheel_base=0.32,
    encoder_noise=0.004,
    kinematics="ackermann",
    max_steering=0.5,
    steering_noise=0.004,
)
OMNI = Robot(kinematics="holonomic", slip_noise=(0.006, 0.01, 0.02))
CART = Robot(encoder_noise=0.004)
RADIUS = kinematics.turning_radius(CAR)
QUIET = {"encoder_noise": 0.0, "steering_noise": 0.0, "slip_noise": (0.0, 0.0, 0.0)}
PATH = jnp.asarray(densify([(1.0, 0.9), (3.5, 0.9), (3.5, 3.0), (6.0, 3.0)]))
OFFICE = np.asarray(densify(worlds.waypoints("office")))
DRAWS, STANDARD_ERRORS = 20_000, 5

drive = jax.jit(drives.drive, static_argnames=("robot", "num_scans"))
jit_arc, next_motion = jax.jit(arc_increment), jax.jit(kinematics.next_motion, static_argnums=0)
odometry_cov = jax.jit(motion_model.odometry_cov)
odometry_rate_cov = jax.jit(motion_model.odometry_rate_cov)


def driven(robot, path=PATH, num_scans=60, seed=0):
    """True poses (T, 3) of the scanner and odometry (T, 3) of a drive, in NumPy."""
    found = drive(jax.random.key(seed), as_robot(robot), jnp.asarray(path), num_scans=num_scans)
    return [np.asarray(x) for x in found]


true_motion = jax.jit(kinematics.true_motion, static_argnums=0, static_argnames="part")


@partial(jax.jit, static_argnums=(0, 2))
def samples(robot, motion, steps):
    draws = jax.random.normal(jax.random.key(0), (DRAWS, steps, kinematics.num_draws(robot)))
    exact = kinematics.true_motion(robot, jnp.zeros_like(draws[0]), motion)
    return exact, jax.vmap(lambda draw: kinematics.true_motion(robot, draw, motion))(draws)


def sample(robot, motion, steps=20):
    """True motions (DRAWS, 3) when odometry reports `motion`, without and with noise."""
    return [np.asarray(x) for x in samples(robot, motion, steps)]


def spread(cov):
    """Standard error (3, 3) of each entry of a sample covariance."""
    return np.sqrt((np.outer(np.diag(cov), np.diag(cov)) + cov**2) / DRAWS)


def arc(distance, turn):
    """Motion (3,) along an arc."""
    return jit_arc(jnp.array(distance), jnp.array(turn))


def process_noise(robot, motion):
    """Q (3, 3) that the filter assumes."""
    params = kinematics.noise_params(robot)
    cov = np.asarray(odometry_cov(params.odometry_coefficients, motion))
    if params.odometry_cov_rate is not None:
        cov = cov + np.asarray(odometry_rate_cov(params.odometry_cov_rate, motion))
    return cov


@pytest.mark.parametrize("robot", [CAR, OMNI, CART], ids=lambda robot: robot.kinematics)
def test_odometry_without_noise_composes_to_the_true_poses(robot):
    truth, odometry = driven(robot._replace(**{k: QUIET[k] for k in QUIET}))
    found = se2_np.dead_reckoning(truth[0], odometry)
    np.testing.assert_allclose(se2_np.increments(truth), se2_np.increments(found), atol=1e-12)
    assert np.linalg.norm(truth[-1, :2] - truth[0, :2]) > 4.0
    noisy, same = driven(robot)
    assert np.abs(se2_np.increments(noisy) - same).max() > 1e-4


@pytest.mark.parametrize("robot", [CAR, OMNI], ids=lambda robot: robot.kinematics)
@pytest.mark.parametrize("share", [0.25, 0.6])
def test_a_first_part_of_a_motion_is_on_its_curve(robot, share):
    """Driving a part and then the rest, each at constant velocities, is the whole motion."""
    motion = jnp.array([0.2, 0.05, 0.3]) if robot is OMNI else arc(0.3, 0.25)
    rest = jnp.zeros((20, kinematics.num_draws(robot)))
    first = np.asarray(true_motion(robot, rest, motion, part=share))
    whole = np.asarray(true_motion(robot, rest, motion))
    np.testing.assert_allclose(whole, motion, atol=1e-12)
    second = se2_np.relative(first, whole)
    np.testing.assert_allclose(first[2] / whole[2], share, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(first[:2]) / np.sinc(first[2] / 2 / np.pi) / share,
        np.linalg.norm(second[:2]) / np.sinc(second[2] / 2 / np.pi) / (1 - share),
    )


@pytest.mark.parametrize(
    ("robot", "motion"),
    [
        (CAR, (0.3, 0.0, 0.0)),
        (OMNI, (0.3, 0.0, 0.0)),
        (OMNI, (0.1, 0.25, 0.0)),
        (OMNI, (0.0, 0.0, 0.4)),
        (OMNI, (0.2, -0.1, 0.3)),
    ],
)
def test_the_covariance_of_a_motion_is_that_of_the_filter(robot, motion):
    exact, true = sample(robot, jnp.array(motion))
    error = se2_np.relative(np.broadcast_to(exact, true.shape), true)
    error[:, :2] = true[:, :2] - exact[None, :2]
    cov, model = np.cov(error.T), process_noise(robot, jnp.array(motion))
    bend = motion[2] ** 2 / 12 * np.trace(model[:2, :2])  # of the curve, left out of Q
    assert np.all(np.abs(cov - model) <= STANDARD_ERRORS * spread(cov) + bend)
    assert np.all(np.abs(error.mean(0)) <= STANDARD_ERRORS * error.std(0) / np.sqrt(DRAWS) + 5e-5)


@pytest.mark.parametrize("bend", [0.0, 0.4, -0.8, 1.0])
def test_noise_of_a_car_is_bounded_by_the_filters_and_equal_at_full_lock(bend):
    """Of the turn, on circles from straight on to the smallest one; left and right alike."""
    distance, turn = 0.1, 0.1 * bend / RADIUS
    motion = arc(distance, turn)
    tan = CAR.wheel_base * bend / RADIUS
    _, true = sample(CAR, motion)
    exact = distance * (
        (CAR.steering_noise * (1 + tan**2) / CAR.wheel_base) ** 2
        + (CAR.encoder_noise * bend / RADIUS) ** 2
    )
    error = np.sqrt(2 / DRAWS) * STANDARD_ERRORS
    assert np.var(true[:, 2]) == pytest.approx(exact, rel=error)
    model = process_noise(CAR, motion)[2, 2]
    assert model > exact * (1 - 1e-3)
    if bend in (0.0, 1.0):
        assert model == pytest.approx(exact, rel=1e-3)
    assert np.var(true[:, 0]) < process_noise(CAR, motion)[0, 0] * (1 + error)


@pytest.mark.parametrize("robot", [CAR, OMNI], ids=lambda robot: robot.kinematics)
def test_noise_does_not_depend_on_the_number_of_parts(robot):
    motion = arc(0.2, 0.1)
    few, many = (np.cov(sample(robot, motion, steps)[1].T) for steps in (4, 40))
    # The parts of a curve are straight in the mean of the noise, not in each draw.
    assert np.all(np.abs(few - many) < STANDARD_ERRORS * np.sqrt(2) * spread(many) + 1e-7)


def test_noise_params_of_two_wheels_are_those_of_the_simulated_robot():
    for found, wanted in zip(
        jax.tree.leaves(kinematics.noise_params(CART)),
        jax.tree.leaves(NoiseParams.for_simulated_robot(CART.wheel_base, CART.encoder_noise)),
        strict=True,
    ):
        np.testing.assert_array_equal(found, wanted)
    for silent in (CART, CAR, OMNI):
        with pytest.raises(ValueError, match="above 0|positive"):
            kinematics.noise_params(silent._replace(**QUIET))


@pytest.mark.parametrize("robot", [CART, CAR, OMNI], ids=lambda robot: robot.kinematics)
def test_noise_params_of_a_scanner_beside_the_origin_have_its_lever(robot):
    """Straight on; the scanner moves sideways with each error of the heading."""
    robot = robot._replace(nominal_mount=(0.25, -0.1, 0.6))
    motion = jnp.array([0.3, 0.0, 0.0])
    _, true = sample(robot, motion)
    mount = np.asarray(robot.nominal_mount)

    def at_scanner(motions):
        there = se2_np.compose(motions, np.broadcast_to(mount, motions.shape))
        return se2_np.relative(np.broadcast_to(mount, motions.shape), there)

    cov = np.cov(at_scanner(true).T)
    model = process_noise(robot, jnp.asarray(at_scanner(np.asarray(motion)[None])[0]))
    assert np.all(np.abs(cov - model) < STANDARD_ERRORS * spread(cov))
    without = process_noise(robot._replace(nominal_mount=(0.0, 0.0, 0.6)), motion)
    assert np.abs(cov - without)[0, 1] > 4 * STANDARD_ERRORS * spread(cov)[0, 1]


@pytest.mark.parametrize("robot", [CAR, CAR._replace(max_steering=0.0, min_turning_radius=0.8)])
def test_a_car_follows_the_office_and_never_exceeds_its_curvature(robot):
    num_scans = drives.num_scans_of_drive(robot, OFFICE)
    truth, odometry = driven(robot._replace(**QUIET), OFFICE, num_scans + 5)
    chord, turn = np.hypot(*odometry[:, :2].T), np.abs(odometry[:, 2])
    arc = chord / np.sinc(turn / 2 / np.pi)
    radius = kinematics.turning_radius(robot)
    assert np.all(turn <= arc / radius + 1e-12) and np.any(turn > 0.99 * arc / radius)
    assert arc.max() <= 0.3 + 1e-12 and turn.max() <= 0.2 + 1e-12
    assert np.all(odometry[:, 0] >= 0.0)
    away = np.linalg.norm(truth[:, None, :2] - OFFICE[None], axis=2)
    assert away.min(axis=1).max() < drives.MAX_DEPARTURE
    assert away[-1, -1] < LOOKAHEAD and np.all(odometry[num_scans:] == 0.0)


def test_a_robot_that_slides_drives_sideways_and_turns_meanwhile():
    path = densify([(0.0, 0.0), (0.3, 0.0), (0.3, 4.0)])
    truth, odometry = driven(OMNI._replace(**QUIET), path, 40)
    assert np.abs(odometry[:, 1]).max() > 0.2
    assert np.hypot(*odometry[:, :2].T).max() <= 0.3 + 1e-12
    assert np.abs(odometry[:, 2]).max() <= 0.2 + 1e-12
    assert truth[-1, 2] == pytest.approx(np.pi / 2, abs=0.05)
    assert np.linalg.norm(truth[-1, :2] - path[-1]) < GOAL_TOLERANCE
    first = drives.num_scans_of_drive(CART, path), drives.num_scans_of_drive(OMNI, path)
    assert first[1] < first[0]  # without turning on the spot


def test_a_path_with_bends_that_are_too_tight_is_refused():
    wide = CAR._replace(max_steering=0.1)
    with pytest.raises(ValueError, match=r"robot leaves the path by .* turning radius is 3.19 m"):
        drives.num_scans_of_drive(wide, PATH)


@pytest.mark.parametrize(
    "end, mount, message",
    [
        ((3.0, 1.9), 0.0, None),
        (
            (2.78, 2.25),
            0.0,
            r"following the path, the robot goes through a wall at x 2.78, y 2.[12]\d m; keep",
        ),
        ((3.0, 1.9), 0.8, r"the scanner, at its mount, goes through a wall at x 3.00"),
    ],
)
def test_a_robot_that_goes_through_a_wall_in_a_bend_is_refused(end, mount, message):
    """A path around the end of a wall; pure pursuit cuts its bends by some centimetres."""
    path = densify([(0.0, 0.0), (2.7, 0.0), (2.7, 2.3), (3.3, 2.3), (3.3, 0.0)])
    world = World(np.array([[end[0], 0.5, *end]]))
    robot = CART._replace(nominal_mount=(mount, 0.0, 0.0))
    if message is None:
        found = drives.num_scans_of_drive(robot, path, world)
        assert found == drives.num_scans_of_drive(robot, path)
        return
    with pytest.raises(ValueError, match=message):
        drives.num_scans_of_drive(robot, path, world)


HURT = {"wheel_scales": (1.05, 1.05), "wheel_base_scale": 0.96, "mount": (0.05, -0.02, 0.03)}


@pytest.mark.parametrize("robot", [CAR, OMNI, CART], ids=lambda robot: robot.kinematics)
@pytest.mark.parametrize("late", [0.0, 0.3, -0.7])
def test_the_true_calibration_makes_odometry_exact(robot, late):
    robot = robot._replace(
        **QUIET, **HURT, time_offset=late, nominal_mount=(0.2, 0.1, 0.4), scan_period=0.4
    )
    truth, odometry = driven(robot)
    found = calibrate_odometry(
        robot.calibration(),
        odometry,
        times=robot.scan_period * np.arange(len(odometry)),
        mount=np.asarray(robot.nominal_mount),
        wheel_base=robot.wheel_base,
    )
    np.testing.assert_allclose(found, se2_np.increments(truth), atol=1e-11)
    wrong = calibrate_odometry(Calibration.identity(), odometry, mount=np.array([0.2, 0.1, 0.4]))
    assert np.abs(wrong - se2_np.increments(truth)).max() > 0.01


def test_a_steering_offset_turns_a_car_and_has_no_calibration():
    robot = CAR._replace(**QUIET, steering_offset=0.05)
    rest = jnp.zeros((4, 2))
    ahead = true_motion(robot, rest, jnp.array([0.2, 0.0, 0.0]))
    assert ahead[2] == pytest.approx(0.2 * np.tan(0.05) / CAR.wheel_base)
    read = np.arctan(CAR.wheel_base * 0.1 / 0.2)
    bent = true_motion(robot, rest, arc(0.2, 0.1))
    assert bent[2] == pytest.approx(0.2 * np.tan(read + 0.05) / CAR.wheel_base)
    with pytest.raises(ValueError, match="robot.steering_offset is 0.05: it has no calibration"):
        robot.calibration()


@pytest.mark.parametrize("rate", [2.5, 4.0, 7.0, 50.0, 2000.0])
def test_odometry_of_a_rate_is_that_of_its_samples(rate):
    """At a scan it is on the arc between two samples, each of which is a true pose of it."""
    robot = OMNI._replace(**QUIET, scan_period=0.25)
    _, exact = driven(robot)
    truth, odometry = driven(robot._replace(odometry_rate=rate))
    reckoned, whole = (se2_np.dead_reckoning(np.zeros(3), x) for x in (odometry, exact))
    every = rate * robot.scan_period
    at_samples = [k for k in range(len(whole)) if abs(k * every - round(k * every)) < 1e-9]
    assert len(at_samples) > 4
    np.testing.assert_allclose(reckoned[at_samples], whole[at_samples], atol=1e-9)
    np.testing.assert_allclose(reckoned[-1], whole[-1], atol=0.05)
    apart = np.abs(odometry - exact).max()
    assert apart > 1e-3 if rate in (2.5, 7.0) else apart < 2e-2
    np.testing.assert_array_equal(odometry[0], np.zeros(3))


@pytest.mark.parametrize("robot", [CART, CAR, OMNI], ids=lambda robot: robot.kinematics)
def test_speed_and_rate_give_the_motion_between_scans(robot):
    slow = robot._replace(**QUIET, max_speed=0.3, max_turn_rate=0.9, scan_period=0.1)
    _, odometry = driven(slow, num_scans=60)
    arc = np.hypot(*odometry[:, :2].T) / np.sinc(odometry[:, 2] / 2 / np.pi)
    assert arc.max() == pytest.approx(0.03, rel=0.02)
    assert np.abs(odometry[:, 2]).max() <= 0.09 + 1e-12


@pytest.mark.parametrize("robot", [CART, OMNI], ids=lambda robot: robot.kinematics)
def test_a_robot_turns_around_at_its_turn_rate(robot):
    slow = robot._replace(max_turn_rate=0.9, scan_period=0.1)
    motion, _ = next_motion(slow, PATH, jnp.int32(0), jnp.array([1.0, 0.9, 2.5]))
    assert motion[2] == pytest.approx(-0.09)


def test_twice_the_rate_takes_twice_the_scans():
    slow = CART._replace(max_speed=0.3, max_turn_rate=0.9)
    counts = [
        drives.num_scans_of_drive(slow._replace(scan_period=period), PATH) for period in (0.1, 0.2)
    ]
    assert counts[0] == pytest.approx(2 * counts[1], rel=0.1)


@pytest.mark.parametrize("robot", [CAR, OMNI], ids=lambda robot: robot.kinematics)
def test_gradients_are_finite_at_rest(robot):
    rest, draws = jnp.zeros(3), jnp.ones((4, kinematics.num_draws(robot)))
    found = jax.jit(jax.jacrev(lambda motion: kinematics.true_motion(robot, draws, motion)))(rest)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(true_motion(robot, draws, rest), rest)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (Robot(kinematics="tracked"), "robot.kinematics is 'tracked', not one of differential, "),
        (Robot(kinematics=3), "robot.kinematics is int, not str"),
        (CAR._replace(max_steering=0.0), "robot.max_steering and robot.min_turning_radius are 0"),
        (CAR._replace(max_steering=1.6), "robot.max_steering is 1.6 and .*, not in"),
        (CAR._replace(wheel_scales=(1.0, 1.1)), "robot.wheel_scales is .* ackermann both are"),
        (CAR._replace(steering_offset=1.2), "robot.steering_offset is 1.2; with the largest"),
        (CAR._replace(slip_noise=(0, 0, 0.1)), "robot.slip_noise is .* drive that is holonomic"),
        (OMNI._replace(slip_noise=(0, -1, 0)), "robot.slip_noise is .* of 0 or more"),
        (OMNI._replace(max_steering=0.3), "robot.max_steering is 0.3: .* that is ackermann"),
        (CART._replace(steering_noise=0.1), "robot.steering_noise is 0.1: .* ackermann"),
        (CART._replace(max_speed=2.0), "robot moves 1.00 m and turns 0.20 rad from scan to scan"),
        (CART._replace(max_turn_rate=4.0), "robot moves 0.30 m and turns 2.00 rad"),
        (CART._replace(max_speed=0.0), "robot.max_speed is 0.0, not above 0"),
        (CART._replace(odometry_rate=-1.0), "robot.odometry_rate is -1.0, not 0 or more"),
        (CART._replace(radius=np.nan), "robot.radius is nan, not 0 or more"),
        (CART._replace(nominal_mount=(0, 0, np.inf)), "robot.nominal_mount is .*, not finite"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(robot, message):
    with pytest.raises(ValueError, match=message):
        as_robot(robot)
