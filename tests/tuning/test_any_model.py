"""Any model is tuned: four examples, each a few functions, data, and `tune`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxslam import standard_errors, tune
from jaxslam.core.se2 import compose
from jaxslam.io import mrclam
from jaxslam.tuning import POSITIVE, EkfSequence, ekf_model, values

DT = 0.1  # [s]
BEACONS = np.array([[0.0, 0.0], [8.0, 0.0], [4.0, 6.0]])  # [m]


def noise(*stds):
    """Covariance of independent noise."""
    return jnp.diag(jnp.stack([jnp.asarray(std) for std in stds]) ** 2)


def simulate(functions, truth, inputs, seed):
    """Measurements (B, T, m) of B sequences, by the functions of a model, with NumPy's noise."""
    rng, measured = np.random.default_rng(seed), []
    mean, cov = functions["init"](truth, None)
    x = rng.multivariate_normal(mean, cov, len(inputs))
    step = jax.jit(jax.vmap(lambda x, u: functions["motion"](truth, x, u)))
    for u in np.swapaxes(inputs, 0, 1):
        Q = functions["motion_cov"](truth, x[0], u[0])
        x = np.asarray(step(x, u)) + rng.multivariate_normal(np.zeros(len(Q)), Q, len(x))
        z = np.asarray(jax.vmap(lambda x: functions["measure"](truth, x))(x))
        R = functions["measurement_cov"](truth, x[0])
        measured.append(z + rng.multivariate_normal(np.zeros(len(R)), R, len(x)))
    return np.stack(measured, axis=1)


def check(found, model, data, truth):
    """Every parameter is known, and within 4 standard errors of the truth."""
    errors = standard_errors(model, found.params, data, transforms=POSITIVE)
    assert errors.identifiable.all() and errors.warnings == ()
    off = [float(np.log(found.params[name] / truth[name])) for name in errors.names]
    np.testing.assert_array_less(np.abs(off), 4 * errors.relative)


def test_a_unicycle_with_range_beacons():
    """Speed and turn are commanded; how far the wheels go, and the noise, is found."""

    def motion(params, pose, command):
        ahead = params["scale"] * command[0] * DT
        return compose(pose, jnp.stack([ahead, jnp.zeros_like(ahead), command[1] * DT]))

    functions = {
        "init": lambda params, sequence: (jnp.array([4.0, 2.0, 0.0]), noise(0.1, 0.1, 0.1)),
        "motion": motion,
        "measure": lambda params, pose: jnp.linalg.norm(BEACONS - pose[None, :2], axis=1),
        "motion_cov": lambda params, pose, command: noise(0.01, 0.01, params["turn_std"]),
        "measurement_cov": lambda params, pose: params["range_std"] ** 2 * jnp.eye(3),
    }
    truth = {"scale": 1.1, "turn_std": 0.03, "range_std": 0.1}
    commands = np.tile([1.0, 0.5], (16, 50, 1))
    data = EkfSequence(commands, simulate(functions, truth, commands, seed=0))
    model = ekf_model(**functions, state_angles=[2])
    start = {"scale": 0.8, "turn_std": 0.1, "range_std": 0.3}
    check(tune(model, start, data, transforms=POSITIVE), model, data, truth)


def test_gps_with_wheel_speed_and_a_gyro_with_bias():
    """State: x, y, heading, bias of the gyro. GPS comes every fifth step, as a mask says."""

    def motion(params, x, sensors):
        speed, rate = sensors[0], sensors[1] - x[3]
        step = DT * jnp.stack([speed * jnp.cos(x[2]), speed * jnp.sin(x[2]), rate])
        return x + jnp.append(step, 0.0)

    functions = {
        "init": lambda params, _: (jnp.zeros(4), noise(0.2, 0.2, 0.1, params["bias_std"])),
        "motion": motion,
        "measure": lambda params, x: x[:2],
        "motion_cov": lambda params, x, _: noise(0.02, 0.02, DT * params["gyro_std"], 1e-4),
        "measurement_cov": lambda params, x: params["gps_std"] ** 2 * jnp.eye(2),
    }
    truth = {"bias_std": 0.2, "gyro_std": 0.5, "gps_std": 0.3}
    sensors = np.tile([4.0, 0.4], (48, 60, 1))
    measured = np.tile(np.arange(60) % 5 == 0, (48, 1))
    data = EkfSequence(sensors, simulate(functions, truth, sensors, seed=1), measured)
    model = ekf_model(**functions, state_angles=[2])
    start = {"bias_std": 0.1, "gyro_std": 0.2, "gps_std": 1.0}
    check(tune(model, start, data, transforms=POSITIVE), model, data, truth)


def test_a_pendulum():
    """A camera sees the angle; length and damping are found beside the noise."""

    def motion(params, x, _):
        pull = -9.81 / params["length"] * jnp.sin(x[0]) - params["damping"] * x[1]
        return jnp.stack([x[0] + DT * x[1], x[1] + DT * pull])

    functions = {
        "init": lambda params, sequence: (jnp.array([2.0, 0.0]), noise(0.2, 0.2)),
        "motion": motion,
        "measure": lambda params, x: x[:1],
        "motion_cov": lambda params, x, _: noise(1e-3, params["push_std"]),
        "measurement_cov": lambda params, x: noise(params["camera_std"]),
    }
    truth = {"length": 2.0, "damping": 0.2, "push_std": 0.1, "camera_std": 0.05}
    data = EkfSequence(None, simulate(functions, truth, np.zeros((16, 60, 0)), seed=2))
    model = ekf_model(**functions, state_angles=[0], measurement_angles=[0])
    start = {"length": 1.5, "damping": 0.5, "push_std": 0.3, "camera_std": 0.2}
    check(tune(model, start, data, transforms=POSITIVE), model, data, truth)


L, STEPS = 5, 80  # landmarks and steps of each robot


def landmark_drive(folder, robot):
    """Odometry (T, 3), range and bearing (T, 2 L) of the robot's most seen landmarks, and mask."""
    log = mrclam.read(folder, robot)
    index = np.where(log.valid, log.landmark_index, -1)[:STEPS]
    often = np.argsort(-np.bincount(index[index >= 0], minlength=L))[:L]
    seen = index[:, :, None] == often  # (T, M, L)
    polar = np.einsum("tml,tmc->tlc", seen, log.range_bearing[:STEPS]).reshape(len(seen), -1)
    return EkfSequence(log.odometry[:STEPS], polar, np.repeat(seen.any(axis=1), 2, axis=1))


@pytest.fixture
def drives(shared_data):
    """Drives of the five robots of MRCLAM 6."""
    if not (folder := shared_data / "mrclam-6").is_dir():
        pytest.skip("no MRCLAM 6")
    return [landmark_drive(folder, robot) for robot in (1, 2, 3, 4, 5)]


@pytest.mark.slow
def test_mrclam_with_unknown_landmarks(drives):
    """State: pose and landmarks, whose priors are where they are seen first by dead reckoning."""

    def init(params, sequence):
        poses = lax.scan(lambda x, u: 2 * (compose(x, u),), jnp.zeros(3), sequence.inputs)[1]
        first = jnp.argmax(sequence.mask[:, ::2], axis=0)
        r, b = sequence.measurements.reshape(STEPS, L, 2)[first, jnp.arange(L)].T
        ahead = jnp.stack([r * jnp.cos(b), r * jnp.sin(b), b], axis=1)
        landmarks = jax.vmap(compose)(poses[first], ahead)[:, :2]
        return jnp.append(jnp.zeros(3), landmarks), noise(*[1e-3] * 3, *[1.0] * 2 * L)

    def measure(params, x):
        ahead, left = (x[3:].reshape(L, 2) - x[None, :2]).T
        return jnp.stack([jnp.hypot(ahead, left), jnp.arctan2(left, ahead) - x[2]], axis=1).ravel()

    functions = {
        "init": init,
        "motion": lambda params, x, odometry: jnp.append(compose(x[:3], odometry), x[3:]),
        "measure": measure,
        "motion_cov": lambda params, x, odometry: noise(
            *[params["drift"] * jnp.hypot(odometry[0], odometry[2]) + 1e-3] * 3, *[1e-4] * 2 * L
        ),
        "measurement_cov": lambda params, x: noise(*[params["range"], params["bearing"]] * L),
    }
    model = ekf_model(**functions, state_angles=[2], measurement_angles=range(1, 2 * L, 2))
    hand = {"drift": 0.1, "range": 0.15, "bearing": 0.03}
    found = tune(model, hand, drives[:3], transforms=POSITIVE, num_updates=12)
    assert (values(model, found.params, drives[3:]) < values(model, hand, drives[3:])).all()
