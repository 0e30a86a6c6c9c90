"""The batch smoother, beside SciPy's least squares on residuals written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter
from scipy.optimize import least_squares

from experiments import smoothing
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering import config, motion_model, slam_filter
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import features
from jaxslam.pipeline.config import Config
from jaxslam.smoothing import numbering, problem
from jaxslam.smoothing.dense import smooth_trial
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem

T, M, ITERATIONS = 12, 5, 10
KINDS = np.array([JUNCTION, WALL, CORNER, JUNCTION, WALL, CORNER])
PLACES = np.array([[4.0, 1.0], [0.3, 0.0], [-2.0, 3.0], [1.0, -4.0], [-1.57, 0.0], [6.0, 5.0]])
L = len(KINDS)
START = np.array([0.5, -0.3, 2.9])  # the heading passes pi
POINT, LINE = np.array([[0.01, 0.001], [0.001, 4e-4]]), np.diag([1e-4, 1.0])


def drive(seed):
    """Records of a robot that turns to the left, stands still, turns about; and a guess."""
    rng = np.random.default_rng(seed)
    root = 0.05 * rng.normal(size=(T, 3, 3))
    q = root @ root.swapaxes(1, 2) + 1e-3 * np.eye(3)
    told = np.tile([0.4, 0.05, 0.2], (T, 1))
    told[4], q[4], told[7] = 0.0, 1e-8 * np.eye(3), [0.1, 0.0, np.pi - 1e-4]
    which = np.stack([rng.permutation(L)[:M] for _ in range(T)]).astype(np.int32)
    which[rng.random((T, M)) < 0.2] = -1
    pose, poses, state = START, [], np.concatenate([START, PLACES.ravel()])
    seen = np.zeros((T, M, 2))
    for t in range(T):
        pose = reference_filter.compose(pose, rng.multivariate_normal(told[t], q[t]))
        poses.append(pose)
        state[:3] = pose
        for m in np.flatnonzero(which[t] >= 0):
            kind = KINDS[which[t, m]]
            r = LINE[:1, :1] if kind == WALL else POINT
            z, _ = reference_filter.observe(state, which[t, m], kind)
            seen[t, m, : len(z)] = z + rng.multivariate_normal(np.zeros(len(z)), r)
    kind = KINDS[which].astype(np.int32)
    r = np.where((kind == WALL)[..., None, None], LINE, POINT)
    rough = PLACES + rng.normal(size=(L, 2)) * np.where(KINDS == WALL, 0.1, 0.4)[:, None]
    information = np.zeros((L, 2, 2))
    information[0], information[4, 0, 0] = [[30.0, 5.0], [5.0, 20.0]], 900.0
    believed = PLACES - 0.05
    believed[4, 0] += np.pi  # the same line
    prior = LandmarkPrior(believed, information)
    records = SmoothingProblem(START, told, q, seen, r, kind, which, prior)
    rough[KINDS == WALL, 1] = 0.0
    poses = np.stack(poses) + rng.normal(size=(T, 3)) * 0.1
    poses[5, 2] += 2 * np.pi
    return jax.tree.map(jnp.asarray, (records, poses, rough))


def smooth(records, poses, places):
    return jax.tree.map(np.asarray, smooth_trial(records, poses, places, iterations=ITERATIONS))


def residuals(records, poses, places):
    """All whitened residuals, one loop per kind of record."""
    start, told, q, seen, r, kind, which, prior = jax.tree.map(np.asarray, records)
    white, before = [], start
    for t, pose in enumerate(poses):
        c, s = np.cos(before[2]), np.sin(before[2])
        x, y = (pose - before)[:2]
        error = np.array([c * x + s * y, c * y - s * x, pose[2] - before[2]]) - told[t]
        error[2] = reference_filter.wrap(error[2])
        white.append(np.linalg.solve(np.linalg.cholesky(q[t]), error))
        state = np.concatenate([pose, places.ravel()])
        for m in np.flatnonzero(which[t] >= 0):
            expected, _ = reference_filter.observe(state, which[t, m], kind[t, m])
            n = len(expected)
            error = reference_filter.difference(seen[t, m, :n], expected, kind[t, m])
            white.append(np.linalg.solve(np.linalg.cholesky(r[t, m, :n, :n]), error))
        before = pose
    off = places - prior.positions
    off[KINDS == WALL, 0] = reference_filter.wrap_line(off[KINDS == WALL, 0])
    for error, information in zip(off, prior.information, strict=True):
        values, vectors = np.linalg.eigh(information)
        white.append(np.sqrt(np.maximum(values, 0.0)) * (vectors.T @ error))
    return np.concatenate(white)


def unpack(x):
    places = np.zeros((L, 2))
    places[KINDS != WALL] = x[3 * T : 3 * T + 8].reshape(4, 2)
    places[KINDS == WALL, 0] = x[3 * T + 8 :]
    return x[: 3 * T].reshape(T, 3), places


@pytest.mark.parametrize("seed", range(2))
def test_it_finds_what_dense_least_squares_finds(seed):
    records, poses, places = drive(seed)
    track = smooth(records, poses, places)
    points, lines = np.asarray(places)[KINDS != WALL], np.asarray(places)[KINDS == WALL, 0]
    guess = np.concatenate([np.ravel(poses), points.ravel(), lines])
    dense = least_squares(
        lambda x: residuals(records, *unpack(x)), guess, "3-point", xtol=1e-14, ftol=1e-14
    )
    dense_poses, dense_places = unpack(dense.x)
    assert np.abs(dense_poses - poses).max() > 0.1  # there was something to do
    off = track.poses - dense_poses
    np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-6)
    np.testing.assert_allclose(reference_filter.wrap(off[:, 2]), 0.0, atol=1e-6)
    off = track.landmark_positions - dense_places
    off[KINDS == WALL] = reference_filter.wrap_line(off[KINDS == WALL])
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    assert np.all(np.abs(track.poses[:, 2]) <= np.pi)
    assert np.all(np.abs(track.landmark_positions[KINDS == WALL, 0]) <= np.pi / 2)
    np.testing.assert_allclose(track.cost[-1], 2 * dense.cost, rtol=1e-9)
    first = np.sum(residuals(records, np.asarray(poses), np.array(places)) ** 2)
    np.testing.assert_allclose(track.cost[0], first, rtol=1e-9)


def test_the_cost_never_rises_and_the_optimum_stays():
    records, poses, places = drive(3)
    rng = np.random.default_rng(3)
    far = places + rng.normal(size=(L, 2)) * np.where(KINDS == WALL, 0.3, 3.0)[:, None]
    track = smooth(records, poses + rng.normal(size=(T, 3)), far)
    assert np.all(np.diff(track.cost) <= 1e-12 * track.cost[:-1]) and track.cost[0] > 1e5
    best = smooth(records, poses, places)
    again = smooth(records, best.poses, best.landmark_positions)
    np.testing.assert_allclose(again.poses, best.poses, atol=1e-9)
    np.testing.assert_allclose(again.landmark_positions, best.landmark_positions, atol=1e-9)


def padded(records, poses, places):
    """The same with features of nothing and of nonsense, landmarks unseen, steps that stand."""
    add = lambda x, y, axis=0: jnp.concatenate([x, jnp.asarray(y, x.dtype)], axis=axis)
    fill = lambda value, *shape: np.full(shape, value)
    which = np.tile(np.array([-1, L + 2, 0, 1, 2, 3], np.int32), (T, 1))
    seen, r = fill(2.0, T, 6, 2), np.tile(POINT, (T, 6, 1, 1))
    seen[:, 2], seen[:, 3, 1], r[:, 0], r[:, 4, 0], r[:, 5] = np.inf, np.nan, np.nan, np.inf, -1.0
    records = records._replace(
        odometry=add(records.odometry, fill(0.0, 2, 3)),
        odometry_cov=add(records.odometry_cov, np.tile(1e-4 * np.eye(3), (2, 1, 1))),
        measurement=add(add(records.measurement, seen, 1), fill(3.0, 2, M + 6, 2)),
        measurement_cov=add(add(records.measurement_cov, r, 1), np.tile(POINT, (2, M + 6, 1, 1))),
        kind=add(add(records.kind, fill(WALL, T, 6), 1), fill(JUNCTION, 2, M + 6)),
        landmark_index=add(add(records.landmark_index, which, 1), fill(-1, 2, M + 6)),
        prior=LandmarkPrior(
            add(records.prior.positions, fill(7.0, 2, 2)),
            add(records.prior.information, fill(0.0, 2, 2, 2)),
        ),
    )
    return records, add(poses, np.tile(poses[-1:] + 0.1, (2, 1))), add(places, fill(1.0, 2, 2))


def weighed(track):
    """A smooth function of a run: headings and directions count by their sines."""
    total = jnp.sum(track.poses[:T, :2] ** 2) + jnp.sum(jnp.sin(track.poses[:T, 2]))
    return total + jnp.sum(jnp.sin(2 * track.places[:L])) + track.cost[-1]


def test_padding_is_invisible_in_values_and_gradients():
    records, *guess = drive(4)
    names = ("start", "motion", "q", "seen", "r")
    more, *more_guess = padded(records, *guess)

    @jax.jit
    @jax.value_and_grad
    def padded_loss(numbers):
        full = more._replace(**numbers)
        return weighed(smooth_trial(full, *more_guess, iterations=ITERATIONS))

    loss, slope = padded_loss({name: getattr(more, name) for name in names})
    np.testing.assert_allclose(loss, weighed(smooth(records, *guess)), rtol=1e-10)
    rng = np.random.default_rng(0)
    for name in names:
        value, inside = getattr(records, name), slope[name]
        assert np.isfinite(inside).all(), name
        if name in ("seen", "r"):
            assert np.all(inside[T:] == 0.0) and np.all(inside[:, M:] == 0.0)
            inside = inside[:T, :M]
        side = 1e-6 * rng.normal(size=value.shape)
        side = side * np.abs(value) if name in ("q", "r") else side
        side = (side + side.swapaxes(-1, -2)) / 2 if name in ("q", "r") else side
        ends = [
            weighed(smooth(records._replace(**{name: value + d}), *guess)) for d in (side, -side)
        ]
        found = jnp.sum(inside[: len(value)] * side)
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2, rtol=1e-4, err_msg=name)


RUNS, STEPS, MARKS, SIGHT = 24, 100, 24, 4
NOISE = NoiseParams(*(jnp.array(x) for x in ([0.04, 0.0, 0.02, 0.0], 0.1, 0.03, 1.0, 1.0)))
CONFIG = Config(
    filter=FilterConfig(
        max_landmarks=MARKS,
        max_updates=SIGHT,
        max_new=SIGHT,
    ),
)


def loops(rng):
    """True poses (B, T, 3) of robots that go round among landmarks, and what they are told.

    That is odometry, range and bearing of the nearest landmarks within 6 m, and which they are.
    """
    angle = np.linspace(0, 2 * np.pi, MARKS, endpoint=False) + rng.uniform(-0.08, 0.08, MARKS)
    radius = np.where(np.arange(MARKS) % 2 == 0, 2.6, 5.6) + rng.uniform(-0.6, 0.6, (RUNS, MARKS))
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle) + 4.0], axis=-1)
    told = np.tile([0.25, 0.0, 0.06], (RUNS, STEPS, 1))
    told[:, 0] = 0.0
    q = np.array(motion_model.odometry_cov(NOISE.odometry_coefficients, jnp.array(told[0, 1])))
    rolled = told + rng.multivariate_normal(np.zeros(3), q, (RUNS, STEPS))
    rolled[:, 0] = 0.0
    poses = np.zeros((RUNS, STEPS, 3))
    for run in range(RUNS):
        for t in range(1, STEPS):
            poses[run, t] = reference_filter.compose(poses[run, t - 1], rolled[run, t])
    way = places[:, None] - poses[:, :, None, :2]
    bearing = np.arctan2(way[..., 1], way[..., 0]) - poses[..., 2:]
    polar = np.stack([np.hypot(way[..., 0], way[..., 1]), bearing], axis=-1)
    who = np.argsort(polar[..., 0], axis=-1)[..., :SIGHT]
    seen = np.take_along_axis(polar, who[..., None], axis=2)
    valid = seen[..., 0] < 6.0
    seen += rng.normal(size=seen.descriptor) * [0.1, 0.03]
    known = np.where(valid, who, -1).astype(np.int32)
    return poses, tuple(jnp.array(x) for x in (told, seen, valid, known))


def single(tree):
    """The same in single precision."""
    real = lambda x: jnp.issubdtype(x.dtype, jnp.floating)
    return jax.tree.map(lambda x: x.astype(jnp.float32) if real(x) else x, tree)


def test_it_is_better_than_the_filter_and_its_cost_is_chi_square():
    truth, log = loops(np.random.default_rng(0))

    @jax.jit
    @jax.vmap
    def filtered(told, seen, valid, known):
        inputs = Measurement(
            told, jax.vmap(features.features_from_range_bearing)(seen, valid), known
        )
        return inputs, slam_filter.run_filter(
            CONFIG.filter, NOISE, config.init(CONFIG.filter, jnp.zeros(3)), inputs
        )[1]

    @jax.jit
    @jax.vmap
    def smoothed(inputs, which, poses, places):
        records = problem.build_problem(single(NOISE), jnp.zeros(3, jnp.float32), inputs, which)
        return smooth_trial(records, poses, places, iterations=5)

    inputs, info = jax.tree.map(np.asarray, filtered(*log))
    marks = []
    for run in range(RUNS):
        seen = jax.tree.map(lambda x, run=run: x[run], inputs.features)
        marks.append(numbering.number_landmarks(info.id[run], info.pose[run], seen, capacity=MARKS))
    marks = jax.tree.map(lambda *x: np.stack(x), *marks)
    track = smoothed(*single((inputs, marks.landmark_index, info.pose, marks.positions)))
    assert track.poses.dtype == track.landmark_positions.dtype == track.cost.dtype == jnp.float32
    rmse = lambda poses: np.sqrt(
        np.mean(np.sum((np.asarray(poses) - truth)[..., :2] ** 2, axis=-1))
    )
    assert rmse(track.poses) < 0.8 * rmse(info.pose)
    # Two numbers a feature tell two a landmark, and all of what odometry tells is poses.
    dof = 2 * np.sum(marks.landmark_index < MARKS) - 2 * np.sum(marks.id >= 0)
    assert abs(float(jnp.sum(track.cost[:, -1])) - dof) < 4 * np.sqrt(2 * dof)


def test_without_a_finite_cost_the_guess_comes_back():
    records, poses, places = drive(5)
    track = smooth(records._replace(odometry=records.odometry.at[3].set(jnp.nan)), poses, places)
    np.testing.assert_allclose(np.sin(track.poses), np.sin(poses), atol=1e-12)
    np.testing.assert_array_equal(track.landmark_positions[KINDS != WALL], places[KINDS != WALL])
    assert np.isnan(track.cost).all()


def test_features_that_are_not_valid_or_hold_nan_have_no_landmark():
    seen = jax.vmap(features.features_from_range_bearing)(
        jnp.ones((2, 3, 2)), jnp.array([[True, True, False]] * 2)
    )
    seen = seen._replace(xy=seen.xy.at[1, 0].set(jnp.nan))
    told = Measurement(jnp.array([[0.0, 0.0, 0.0], [0.25, 0.0, 0.1]]), seen)
    which = jnp.array([[0, 2, 1]] * 2, jnp.int32)
    records = jax.jit(problem.build_problem)(NOISE, jnp.zeros(3), told, which)
    np.testing.assert_array_equal(records.landmark_index, [[0, 2, -1], [-1, 2, -1]])
    assert all(
        np.isfinite(x).all()
        for x in (records.measurement, records.measurement_cov, records.odometry_cov)
    )
    np.testing.assert_allclose(records.measurement[0, 0], [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(records.measurement_cov[1, 1], np.diag([0.1, 0.03]) ** 2, atol=1e-12)
    np.testing.assert_allclose(
        records.odometry_cov[0], problem.ODOMETRY_STD_FLOOR**2 * np.eye(3), atol=1e-15
    )


def test_wrong_shapes_are_told():
    records, poses, places = drive(0)
    for name, wrong in (("q", records.odometry_cov[:, :2]), ("kind", records.kind[:, :4])):
        with pytest.raises(ValueError, match=rf"records.{name} is .*, not"):
            smooth(records._replace(**{name: wrong}), poses, places)
    with pytest.raises(ValueError, match=r"records.prior.places is .*\(6, 2\), not .*\(5, 2\)"):
        smooth(records, poses, places[:5])
    with pytest.raises(ValueError, match=r"records.which is int32 \(12, 5\), not"):
        smooth(records, poses[:4], places)
    seen = jax.vmap(features.features_from_range_bearing)(
        jnp.ones((T, M, 2)), jnp.ones((T, M), bool)
    )
    given = Measurement(records.odometry, seen)
    with pytest.raises(ValueError, match=r"which is int32 \(12, 4\), not"):
        problem.build_problem(
            NoiseParams.for_laser_log(), START, given, records.landmark_index[:, :4]
        )


def test_on_drives_past_known_landmarks_it_leaves_less_error_than_the_filter():
    told = smoothing.compute(0, runs=16)
    gain = np.log(told["filter"]["position_rmse_m"] / told["smoother"]["position_rmse_m"])
    assert gain > 2 / np.sqrt(2 * 16)  # two standard errors, were each run one independent error
    assert told["runs_better"] > 0.5 and len(told["filter"]["position_rmse_by_step_m"]) == 200
