"""The dense batch smoother, beside SciPy's least squares on residuals written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter
from scipy.optimize import least_squares
from smoothing_problems import (
    KINDS,
    POINT_COV,
    L,
    M,
    T,
    assert_same,
    drive,
    pack,
    residuals,
    unpack,
)

from experiments import smoothing
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import JUNCTION, WALL
from jaxslam.filtering import motion_model, slam_filter
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import features
from jaxslam.smoothing import numbering
from jaxslam.smoothing.dense import smooth_trial
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem, build_problem

ITERATIONS = 10


def smooth(problem, poses, positions):
    return jax.tree.map(np.asarray, smooth_trial(problem, poses, positions, iterations=ITERATIONS))


@pytest.mark.parametrize("seed", range(2))
def test_it_finds_what_dense_least_squares_finds(seed):
    problem, poses, positions = drive(seed)
    result = smooth(problem, poses, positions)
    start = pack(np.asarray(poses), np.asarray(positions))
    best = least_squares(
        lambda x: residuals(problem, *unpack(x)), start, "3-point", xtol=1e-14, ftol=1e-14
    )
    assert np.abs(unpack(best.x)[0] - poses).max() > 0.1  # there was something to do
    assert_same(result, unpack(best.x), 1e-6)
    assert np.all(result.landmark_positions[KINDS == WALL, 1] == 0.0)
    assert np.all(np.abs(result.poses[:, 2]) <= np.pi)
    assert np.all(np.abs(result.landmark_positions[KINDS == WALL, 0]) <= np.pi / 2)
    np.testing.assert_allclose(result.cost[-1], 2 * best.cost, rtol=1e-9)
    first = np.sum(residuals(problem, np.asarray(poses), np.array(positions)) ** 2)
    np.testing.assert_allclose(result.cost[0], first, rtol=1e-9)


def test_the_cost_never_rises_and_the_optimum_stays():
    problem, poses, positions = drive(3)
    rng = np.random.default_rng(3)
    far = positions + rng.normal(size=(L, 2)) * np.where(KINDS == WALL, 0.3, 3.0)[:, None]
    result = smooth(problem, poses + rng.normal(size=(T, 3)), far)
    assert np.all(np.diff(result.cost) <= 1e-12 * result.cost[:-1]) and result.cost[0] > 1e5
    best = smooth(problem, poses, positions)
    again = smooth(problem, best.poses, best.landmark_positions)
    np.testing.assert_allclose(again.poses, best.poses, atol=1e-9)
    np.testing.assert_allclose(again.landmark_positions, best.landmark_positions, atol=1e-9)


def padded(problem, poses, positions):
    """The same with features of no landmark and not finite, unseen landmarks, steps at rest."""

    def add(x, y, axis=0):
        return jnp.concatenate([x, jnp.asarray(y, x.dtype)], axis=axis)

    def fill(value, *shape):
        return np.full(shape, value)

    index = np.tile(np.array([-1, L + 2, 0, 1, 2, 3], np.int32), (T, 1))
    z, r = fill(2.0, T, 6, 2), np.tile(POINT_COV, (T, 6, 1, 1))
    z[:, 2], z[:, 3, 1], r[:, 0], r[:, 4, 0], r[:, 5] = np.inf, np.nan, np.nan, np.inf, -1.0
    problem = problem._replace(
        odometry=add(problem.odometry, fill(0.0, 2, 3)),
        odometry_cov=add(problem.odometry_cov, np.tile(1e-4 * np.eye(3), (2, 1, 1))),
        measurement=add(add(problem.measurement, z, 1), fill(3.0, 2, M + 6, 2)),
        measurement_cov=add(
            add(problem.measurement_cov, r, 1), np.tile(POINT_COV, (2, M + 6, 1, 1))
        ),
        kind=add(add(problem.kind, fill(WALL, T, 6), 1), fill(JUNCTION, 2, M + 6)),
        landmark_index=add(add(problem.landmark_index, index, 1), fill(-1, 2, M + 6)),
        prior=LandmarkPrior(
            add(problem.prior.positions, fill(7.0, 2, 2)),
            add(problem.prior.information, fill(0.0, 2, 2, 2)),
        ),
    )
    return problem, add(poses, np.tile(poses[-1:] + 0.1, (2, 1))), add(positions, fill(1.0, 2, 2))


@jax.jit
def smooth_function(result):
    """A smooth function of a result: headings and directions count by their sines."""
    total = jnp.sum(result.poses[:T, :2] ** 2) + jnp.sum(jnp.sin(result.poses[:T, 2]))
    return total + jnp.sum(jnp.sin(2 * result.landmark_positions[:L])) + result.cost[-1]


def test_padding_is_invisible_in_values_and_gradients():
    problem, *guess = drive(4)
    names = ("start", "odometry", "odometry_cov", "measurement", "measurement_cov")
    more, *more_guess = padded(problem, *guess)

    @jax.jit
    @jax.value_and_grad
    def padded_loss(numbers):
        full = more._replace(**numbers)
        return smooth_function(smooth_trial(full, *more_guess, iterations=ITERATIONS))

    loss, slope = padded_loss({name: getattr(more, name) for name in names})
    np.testing.assert_allclose(loss, smooth_function(smooth(problem, *guess)), rtol=1e-10)
    rng = np.random.default_rng(0)
    for name in names:
        value, inside = getattr(problem, name), slope[name]
        assert np.isfinite(inside).all(), name
        if name.startswith("measurement"):
            assert np.all(inside[T:] == 0.0) and np.all(inside[:, M:] == 0.0)
            inside = inside[:T, :M]
        side = 1e-6 * rng.normal(size=value.shape)
        if name.endswith("cov"):
            side = side * np.abs(value)
            side = (side + side.swapaxes(-1, -2)) / 2
        ends = [
            smooth_function(smooth(problem._replace(**{name: value + d}), *guess))
            for d in (side, -side)
        ]
        found = jnp.sum(inside[: len(value)] * side)
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2, rtol=1e-4, err_msg=name)


TRIALS, STEPS, LANDMARKS, FEATURES = 24, 100, 24, 4
NOISE = NoiseParams(*(jnp.array(x) for x in ([0.04, 0.0, 0.02, 0.0], 0.1, 0.03, 1.0, 1.0)))
CONFIG = FilterConfig(max_landmarks=LANDMARKS, max_updates=FEATURES, max_new=FEATURES)


def rings(rng):
    """True poses (B, T, 3) of robots that go round among landmarks, and what they measure.

    That is odometry, range and bearing of the nearest landmarks within 6 m, and which they are.
    """
    angle = np.linspace(0, 2 * np.pi, LANDMARKS, endpoint=False)
    angle = angle + rng.uniform(-0.08, 0.08, LANDMARKS)
    radius = np.where(np.arange(LANDMARKS) % 2 == 0, 2.6, 5.6)
    radius = radius + rng.uniform(-0.6, 0.6, (TRIALS, LANDMARKS))
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle) + 4.0], axis=-1)
    odometry = np.tile([0.25, 0.0, 0.06], (TRIALS, STEPS, 1))
    odometry[:, 0] = 0.0
    increment = jnp.array(odometry[0, 1])
    q = np.array(motion_model.odometry_cov(NOISE.odometry_coefficients, increment))
    motion = odometry + rng.multivariate_normal(np.zeros(3), q, (TRIALS, STEPS))
    motion[:, 0] = 0.0
    poses = np.zeros((TRIALS, STEPS, 3))
    for trial in range(TRIALS):
        for t in range(1, STEPS):
            poses[trial, t] = reference_filter.compose(poses[trial, t - 1], motion[trial, t])
    offset = positions[:, None] - poses[:, :, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - poses[..., 2:]
    polar = np.stack([np.hypot(offset[..., 0], offset[..., 1]), bearing], axis=-1)
    nearest = np.argsort(polar[..., 0], axis=-1)[..., :FEATURES]
    measured = np.take_along_axis(polar, nearest[..., None], axis=2)
    valid = measured[..., 0] < 6.0
    measured += rng.normal(size=measured.shape) * [0.1, 0.03]
    ids = np.where(valid, nearest, -1).astype(np.int32)
    return poses, tuple(jnp.array(x) for x in (odometry, measured, valid, ids))


def single(tree):
    """The same in single precision."""

    def convert(x):
        return x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(convert, tree)


def test_it_is_better_than_the_filter_and_its_cost_is_chi_square():
    truth, log = rings(np.random.default_rng(0))

    @jax.jit
    @jax.vmap
    def filtered(odometry, measured, valid, ids):
        seen = jax.vmap(features.features_from_range_bearing)(measured, valid)
        measurements = Measurement(odometry, seen, ids)
        start = init(CONFIG, jnp.zeros(3))
        return measurements, slam_filter.run_filter(CONFIG, NOISE, start, measurements)[1]

    @jax.jit
    @jax.vmap
    def smoothed(measurements, index, poses, positions):
        start = jnp.zeros(3, jnp.float32)
        problem = build_problem(single(NOISE), start, measurements, index)
        return smooth_trial(problem, poses, positions, iterations=5)

    measurements, info = jax.tree.map(np.asarray, filtered(*log))
    landmarks = []
    for trial in range(TRIALS):
        seen = jax.tree.map(lambda x, trial=trial: x[trial], measurements.features)
        landmarks.append(
            numbering.number_landmarks(info.id[trial], info.pose[trial], seen, capacity=LANDMARKS)
        )
    landmarks = jax.tree.map(lambda *x: np.stack(x), *landmarks)
    guess = landmarks.landmark_index, info.pose, landmarks.positions
    result = smoothed(*single((measurements, *guess)))
    assert all(x.dtype == jnp.float32 for x in result)

    def rmse(poses):
        error = (np.asarray(poses) - truth)[..., :2]
        return np.sqrt(np.mean(np.sum(error**2, axis=-1)))

    assert rmse(result.poses) < 0.8 * rmse(info.pose)
    # Of two numbers a feature, two a landmark estimate its position; odometry estimates the poses.
    dof = 2 * np.sum(landmarks.landmark_index < LANDMARKS) - 2 * np.sum(landmarks.id >= 0)
    assert abs(float(jnp.sum(result.cost[:, -1])) - dof) < 4 * np.sqrt(2 * dof)


def test_without_a_finite_cost_the_guess_comes_back():
    problem, poses, positions = drive(5)
    problem = problem._replace(odometry=problem.odometry.at[3].set(jnp.nan))
    result = smooth(problem, poses, positions)
    np.testing.assert_allclose(np.sin(result.poses), np.sin(poses), atol=1e-12)
    points = result.landmark_positions[KINDS != WALL], positions[KINDS != WALL]
    np.testing.assert_array_equal(*points)
    assert np.isnan(result.cost).all()


def test_lists_numpy_and_jax_of_either_precision_give_the_same():
    given = jax.tree.map(np.asarray, single(drive(2)))
    double = jax.tree.map(lambda x: x.astype(float) if x.dtype == np.float32 else x, given)
    expected = smooth(*double)
    problem, poses, positions = double
    lists = [x.tolist() for x in problem[:-1]]
    prior = LandmarkPrior(*(x.tolist() for x in problem.prior))
    to_list = SmoothingProblem(*lists, prior), poses.tolist(), positions.tolist()
    mixed = jax.tree.map(jnp.asarray, given[0]), jnp.asarray(poses), positions
    for other in (given, to_list, jax.tree.map(jnp.asarray, double), mixed):
        jax.tree.map(np.testing.assert_array_equal, smooth(*other), expected)


def test_wrong_arguments_are_refused_by_name():
    problem, poses, positions = drive(0)
    cov, kind = problem.odometry_cov[:, :2], problem.kind[:, :4]
    for name, wrong in (("odometry_cov", cov), ("kind", kind), ("start", poses)):
        with pytest.raises(ValueError, match=rf"problem.{name} is .*, not"):
            smooth(problem._replace(**{name: wrong}), poses, positions)
    with pytest.raises(ValueError, match=r"problem.prior.positions is .*\(6, 2\), not .*\(5, 2\)"):
        smooth(problem, poses, positions[:5])
    with pytest.raises(ValueError, match=r"problem.landmark_index is int32 \(12, 5\), not"):
        smooth(problem, poses[:4], positions)
    with pytest.raises(ValueError, match=r"problem.kind is float64 \(12, 5\), not"):
        smooth(problem._replace(kind=problem.kind.astype(float)), poses, positions)
    with pytest.raises(ValueError, match="problem is a ArrayImpl, not a SmoothingProblem"):
        smooth(poses, problem, positions)
    with pytest.raises(ValueError, match=r"landmark_positions is .*\(0, 2\): there is nothing"):
        smooth(problem, poses, positions[:0])
    with pytest.raises(ValueError, match="iterations is -1, not a whole number"):
        smooth_trial(problem, poses, positions, iterations=-1)


@pytest.mark.slow
def test_on_drives_past_known_landmarks_its_error_is_less_than_the_filters():
    errors = smoothing.compute(0, 16)
    ratio = errors["filter"]["position_rmse_m"] / errors["smoother"]["position_rmse_m"]
    assert np.log(ratio) > 2 / np.sqrt(2 * 16)  # two standard errors of independent trials
    assert errors["runs_better"] > 0.5
    assert len(errors["filter"]["position_rmse_by_step_m"]) == 200
