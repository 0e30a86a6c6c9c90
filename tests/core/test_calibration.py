import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_calibration import censi

from jaxslam.core import se2, se2_np
from jaxslam.core.calibration import Calibration, calibrate_odometry, scale_increments
from jaxslam.simulation.robot import Robot, wheel_distances, wheel_increment

BASE = 0.4
HURT = Robot(BASE, 0.0, (1.05, 0.97), 1.04, (0.25, 0.05, 0.05), 0.08).calibration()
TAKEN = np.array([0.1, -0.2, 0.7])
STANDARD_ERRORS = 4


@jax.jit
def arcs(wheels, scales=(1.0, 1.0, 1.0)):
    """Increments (N, 3) of wheels (N, 2), of which each and the base is longer than reported."""
    left, right, base = scales
    return jax.vmap(lambda both: wheel_increment(left * both[0], right * both[1], base * BASE))(
        wheels
    )


def to_jax(calibration):
    return jax.tree.map(jnp.asarray, calibration)


def some_odometry(seed=0, num_scans=14):
    """Increments (T, 3) and times (T,) of scans that are not equally far apart."""
    rng = np.random.default_rng(seed)
    odometry = rng.normal(0.0, [0.2, 0.02, 0.15], (num_scans, 3))
    odometry[0] = 0.0
    return odometry, np.cumsum(rng.uniform(0.2, 0.6, num_scans))


@pytest.fixture(scope="module")
def on_jax():
    """`calibrate_odometry` of a robot with wheels `BASE` apart, compiled."""
    return jax.jit(
        lambda calibration, odometry, times, mount: calibrate_odometry(
            calibration, odometry, times=times, mount=mount, wheel_base=BASE
        )
    )


def test_a_robot_without_errors_stays_as_it_is(on_jax):
    odometry, times = some_odometry()
    given = Calibration.identity()
    for taken in (None, TAKEN):
        same = calibrate_odometry(given, odometry, times=times, mount=taken, wheel_base=BASE)
        np.testing.assert_allclose(same, odometry, atol=1e-14)
    same = on_jax(to_jax(given), jnp.asarray(odometry), jnp.asarray(times), jnp.asarray(TAKEN))
    np.testing.assert_allclose(same, odometry, atol=1e-14)


@pytest.mark.parametrize("wheels", [(1.0, 1.0, 1.0), (1.05, 0.97, 1.04), (0.8, 1.1, 0.7)])
def test_wheels_invert_of_wheels(wheels):
    found = Calibration.of_wheels(*wheels, wheel_base=BASE).wheels(BASE)
    np.testing.assert_allclose(found, wheels, atol=1e-14)


def test_scales_are_exact_for_two_wheels():
    rolled = jnp.array([(0.3, 0.3), (0.1, 0.4), (-0.2, 0.3), (-0.3, 0.3), (0.0, 0.0)])
    scales = 1.05, 0.97, 1.04
    given = Calibration.of_wheels(*scales, wheel_base=BASE)
    found = scale_increments(given, np.asarray(arcs(rolled)), wheel_base=BASE)
    np.testing.assert_allclose(found, arcs(rolled, scales), atol=1e-14)


def test_without_the_wheel_base_there_is_a_calibration_that_does_the_same():
    rolled = np.random.default_rng(4).uniform(-0.2, 0.3, (12, 2))
    odometry, times = np.array(arcs(rolled)), 0.5 * np.arange(12.0)
    odometry[0] = 0.0
    expected = calibrate_odometry(HURT, odometry, times=times, wheel_base=BASE)
    found = calibrate_odometry(HURT.without_base(BASE), odometry, times=times)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    with_sizes = HURT.without_base(BASE).mount[1] - HURT.mount[1]
    assert abs(with_sizes - 0.0082) < 1e-4  # (0.97 - 1.05) BASE 1.04 / 4, to the right
    assert to_jax(HURT).without_base(BASE).mount.dtype == jnp.float64


def test_the_scanner_moves_as_its_mount_does():
    """Of a robot at r, a scanner at `TAKEN` (+) mount is at r (+) `TAKEN` (+) mount."""
    odometry, _ = some_odometry()
    given = Calibration.identity()._replace(mount=np.array([0.25, 0.05, 0.3]))
    robot = se2_np.dead_reckoning(np.array([1.0, 2.0, 0.5]), odometry)
    taken = se2_np.compose(robot, TAKEN)
    found = calibrate_odometry(given, se2_np.increments(taken), mount=TAKEN)
    true = se2_np.increments(se2_np.compose(taken, given.mount))
    np.testing.assert_allclose(found, true, atol=1e-13)


def smooth(times):
    """Poses (T, 3) of a robot that goes smoothly, with a speed that never stays the same."""
    x, y = np.sin(times), 0.5 * np.cos(0.7 * times)
    return np.stack([x, y, np.arctan2(-0.35 * np.sin(0.7 * times), np.cos(times))], axis=1)


@pytest.mark.parametrize("offset", [0.0531, -0.0472, 0.1713])
def test_a_shift_is_the_motion_between_shifted_times(offset):
    """What remains is that the robot goes on arcs between scans: of second order in time."""
    worst = []
    for count in (101, 201):
        times = np.linspace(0.3, 1.3, count)
        given = Calibration.identity()._replace(time_offset=np.asarray(offset))
        found = calibrate_odometry(given, se2_np.increments(smooth(times)), times=times)
        held = np.clip(times + offset, times[0], times[-1])  # still before and after the drive
        true = se2_np.increments(smooth(held))
        reached = se2_np.dead_reckoning(smooth(held[:1])[0], found)
        np.testing.assert_allclose(reached[[0, -1]], smooth(held[[0, -1]]), atol=1e-3)
        worst.append(np.abs(reached - smooth(held)).max())
        assert np.abs(found - true).max() < 0.01 * np.abs(true).max()
    assert worst[0] < 1e-4 and worst[1] < worst[0] / 2.2


def test_both_namespaces_agree(on_jax):
    odometry, times = some_odometry()
    for offset in (0.08, -0.7, 0.0):
        given = HURT._replace(time_offset=np.asarray(offset))
        exact = calibrate_odometry(given, odometry, times=times, mount=TAKEN, wheel_base=BASE)
        args = jnp.asarray(odometry), jnp.asarray(times), jnp.asarray(TAKEN)
        found = on_jax(to_jax(given), *args)
        np.testing.assert_allclose(found, exact, atol=1e-13)
        assert found.dtype == jnp.float64 and isinstance(exact, np.ndarray)


def test_single_precision_stays_single(on_jax):
    odometry, times = some_odometry()
    exact = calibrate_odometry(HURT, odometry, times=times, mount=TAKEN, wheel_base=BASE)
    given = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (HURT, odometry, times, TAKEN))
    found = on_jax(*given)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, exact, atol=3e-6)


@pytest.mark.parametrize("moving", [True, False])
def test_gradients_are_those_of_finite_differences(on_jax, moving):
    odometry, times = (jnp.asarray(x) for x in some_odometry())
    odometry = odometry if moving else jnp.zeros_like(odometry)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=odometry.shape))
    leaves, tree = jax.tree.flatten(to_jax(HURT))
    sizes = np.cumsum([x.size for x in leaves])[:-1]

    def value(flat, odometry):
        parts = jnp.split(flat, sizes)
        given = tree.unflatten([p.reshape(x.shape) for p, x in zip(parts, leaves, strict=True)])
        return jnp.sum(weights * on_jax(given, odometry, times, jnp.asarray(TAKEN)))

    flat = jnp.concatenate([x.ravel() for x in leaves])
    by_flat, by_odometry = jax.jit(jax.grad(value, argnums=(0, 1)))(flat, odometry)
    step = 1e-6
    for i in range(flat.size):
        high, low = (value(flat.at[i].add(sign * step), odometry) for sign in (1, -1))
        np.testing.assert_allclose(by_flat[i], (high - low) / (2 * step), atol=1e-7)
    assert np.isfinite(by_odometry).all() and np.any(by_odometry != 0.0)


def test_the_gradient_by_the_offset_is_whole_where_it_is_zero(on_jax):
    """Every search starts there. The robot speeds up: its motion is what the next scan has."""
    times = jnp.arange(6.0)
    odometry = jnp.zeros((6, 3)).at[1:, 0].set(jnp.arange(1.0, 6.0))
    still = to_jax(Calibration.identity())

    def third(offset):
        moved = on_jax(still._replace(time_offset=offset), odometry, times, jnp.zeros(3))
        return se2.dead_reckoning(jnp.zeros(3), moved)[3, 0]

    np.testing.assert_allclose(jax.jit(jax.grad(third))(jnp.asarray(0.0)), 4.0 - 1.0 / 2)


def robot_increments(rng, count, noise=0.0):
    """Wheels (T, 2) and increments (T, 3) of the scanner of the robot `HURT`, with noise."""
    wheels = rng.uniform(-0.1, 0.3, (count, 2))
    reported = np.asarray(arcs(jnp.asarray(wheels)))
    given = HURT._replace(time_offset=np.zeros(()))
    padded = np.concatenate([np.zeros((1, 3)), reported])
    scanner = calibrate_odometry(given, padded, wheel_base=BASE)[1:]
    return wheels, scanner + noise * rng.normal(size=scanner.shape)


def known():
    """What the closed form should find."""
    left, right, base = HURT.wheels(BASE)
    return np.array([left, right, base * BASE, *HURT.mount])


def test_the_closed_form_finds_a_calibration_exactly():
    found = censi(*robot_increments(np.random.default_rng(0), 30))
    np.testing.assert_allclose(found, known(), atol=1e-7)


def test_the_closed_form_of_noisy_increments_is_near():
    """Its mean over repetitions is within standard errors of what is true."""
    rng = np.random.default_rng(1)
    found = np.array([censi(*robot_increments(rng, 200, noise=1e-3)) for _ in range(40)])
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert np.all(np.abs(found.mean(axis=0) - known()) < STANDARD_ERRORS * error)
    assert np.all(error < 0.005)


def test_least_squares_of_the_calibration_agrees_with_the_closed_form():
    """By autodiff's Gauss-Newton on the noisy increments of the scanner, within the noise."""
    wheels, scanner = robot_increments(np.random.default_rng(2), 400, noise=1e-3)
    reported = jax.jit(arcs)(jnp.asarray(wheels))
    padded = jnp.asarray(np.concatenate([np.zeros((1, 3)), reported]))

    @jax.jit
    def residuals(theta):
        given = Calibration.of_wheels(*theta[:3], wheel_base=BASE)._replace(mount=theta[3:])
        return (calibrate_odometry(given, padded, wheel_base=BASE)[1:] - scanner).ravel()

    theta, both = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), jax.jit(jax.jacfwd(residuals))
    for _ in range(6):
        slope = np.asarray(both(theta))
        theta = theta - np.linalg.lstsq(slope, np.asarray(residuals(theta)))[0]
    error = 1e-3 * np.sqrt(np.diag(np.linalg.inv(slope.T @ slope)))
    found = censi(wheels, scanner) / np.array([1, 1, BASE, 1, 1, 1])
    assert np.all(np.abs(found - theta) < STANDARD_ERRORS * error)
    np.testing.assert_allclose(wheel_distances(reported[0], BASE), wheels[0], atol=1e-12)
