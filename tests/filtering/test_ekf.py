"""Prediction, update and new landmarks, against dense EKF-SLAM, filterpy and samples."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter
from reference_filter import DenseSlam

from jaxslam.core.features import Features
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering import data_association, ekf, map_management, measurement_model
from jaxslam.filtering.belief import initial_belief, prune

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from filterpy.kalman import ExtendedKalmanFilter

L, M = 8, 5
KINDS = np.array([JUNCTION, WALL, CORNER, JUNCTION, WALL, CORNER])
POSITIONS = np.array([[4.0, 1.0], [0.3, 0.0], [-2.0, 3.0], [1.0, -4.0], [-1.2, 0.0], [6.0, 5.0]])
RANGE_STD, BEARING_STD, WALL_STD = 0.05, 0.02, 0.01
Q = np.diag([0.03, 0.01, 0.02]) ** 2 + 1e-5


def features(kind, seen):
    """Features (M) of measurements (k, 2), range and bearing or direction and 0; and their R."""
    return jax.tree.map(jnp.asarray, plain_features(kind, seen))


def plain_features(kind, seen):
    """`features` as NumPy arrays."""
    kind, seen = np.asarray(kind), np.asarray(seen, float)
    pad = M - len(kind)
    is_wall = kind == WALL
    xy = seen[:, :1] * np.stack([np.cos(seen[:, 1]), np.sin(seen[:, 1])], axis=-1)
    zero = np.zeros(M)

    def fill(x):
        return np.concatenate([x, np.zeros((pad,) + x.shape[1:], x.dtype)])

    padded = Features(
        kind=fill(kind.astype(np.int32)),
        xy=fill(np.where(is_wall[:, None], 0.0, xy)),
        cov=np.zeros((M, 2, 2)),
        direction=fill(np.where(is_wall, seen[:, 0], 0.0)),
        direction_variance=zero,
        descriptor=zero + 1.0,
        degree=np.zeros(M, np.int32),
        certified=np.zeros(M, bool),
        trusted=np.zeros(M, bool),
        valid=np.arange(M) < len(kind),
    )
    point = np.diag([RANGE_STD, BEARING_STD]) ** 2 + 1e-4
    wall = np.diag([WALL_STD**2, 1.0])
    return padded, np.where((padded.kind == WALL)[:, None, None], wall, point)


def slots(*numbers):
    return jnp.array([*numbers, *[L] * (M - len(numbers))], jnp.int32)


@jax.jit
def predicted(belief, motion, q):
    return ekf.predict(belief, motion, q)


@jax.jit
def updated(belief, scan, r, slot):
    belief, result = ekf.update(belief, ekf.linearize(belief, scan, r, slot))
    return belief, result.nis, result.logdet


@jax.jit
def augmented(belief, scan, r, wanted):
    return map_management.augment(belief, scan, r, wanted, max_new=3)


cov_of = jax.jit(lambda belief: belief.cov)
blank_belief = jax.jit(partial(initial_belief, max_landmarks=L))


def with_cov(belief, cov):
    """The belief with another covariance (D, D)."""
    return belief._replace(pose_cov=cov[:3, :3], cross_cov=cov[:3, 3:], map_cov=cov[3:, 3:])


def random_belief(seed, *, landmarks=4):
    """A belief with correlated pose and landmarks of the kinds KINDS; the rest is free."""
    rng = np.random.default_rng(seed)
    used = 3 + 2 * landmarks
    root = 0.1 * rng.normal(size=(used, used))
    mean = np.concatenate([[0.3, -0.2, 0.7], POSITIONS[:landmarks].ravel()])
    # A direction has one number; the other is a certain zero.
    for slot in np.flatnonzero(KINDS[:landmarks] == WALL):
        root[4 + 2 * slot] = 0.0
    blank = jax.tree.map(np.array, blank_belief(jnp.array(mean[:3])))
    cov = np.array(blank.cov)
    cov[:used, :used] = root @ root.T
    for field in (blank.mean, blank.first_estimate):
        field[:used] = mean
    blank.num_seen[:landmarks] = 2
    blank.kind[:landmarks] = KINDS[:landmarks]
    return jax.tree.map(jnp.asarray, with_cov(blank, cov))


def dense_of(belief, landmarks):
    dense, used = DenseSlam(np.zeros(3)), 3 + 2 * landmarks
    dense.mean = np.array(belief.mean[:used])
    dense.cov = np.array(cov_of(belief))[:used, :used]
    return dense


def observed(rng, pose, index):
    """Noisy measurement of the true landmark `index` from `pose`, in the form of `features`."""
    truth = np.concatenate([pose, POSITIONS.ravel()])
    expected, _ = reference_filter.observe(truth, index, KINDS[index])
    if KINDS[index] == WALL:
        return np.array([expected[0] + WALL_STD * rng.normal(), 0.0])
    return expected + np.array([RANGE_STD, BEARING_STD]) * rng.normal(size=2)


@pytest.mark.parametrize("seed", range(2))
def test_twenty_steps_equal_dense_ekf_slam(seed):
    rng = np.random.default_rng(seed)
    pose, motion = np.array([0.0, 0.0, 2.9]), np.array([0.3, 0.02, 0.15])
    belief, dense = blank_belief(jnp.array(pose)), DenseSlam(pose)
    slot_of, order = {}, []
    for _ in range(20):
        pose = reference_filter.compose(pose, motion + rng.multivariate_normal(np.zeros(3), Q))
        belief = predicted(belief, jnp.array(motion), jnp.array(Q))
        dense.predict(motion, Q)

        index = rng.choice(len(KINDS), 4, replace=False)
        kind, measured = KINDS[index], np.array([observed(rng, pose, i) for i in index])
        scan, r = features(kind, measured)
        size = np.where(kind == WALL, 1, 2)
        cut = [(measured[n, :k], np.asarray(r)[n, :k, :k]) for n, k in enumerate(size)]
        known = [n for n, i in enumerate(index) if i in slot_of]
        belief, nis, logdet = updated(belief, scan, r, slots(*[slot_of.get(i, L) for i in index]))
        if known:
            expected = dense.update([(order.index(index[n]), kind[n], *cut[n]) for n in known])
            # Our wall rows have an unused second number of variance 1.
            np.testing.assert_allclose([nis, logdet], expected, atol=1e-8)
        new = [n for n in range(4) if n not in known][:3]
        wanted = jnp.asarray(np.isin(np.arange(M), new))
        belief, got = augmented(belief, scan, r, wanted)
        for n in new:
            dense.augment(kind[n], *cut[n])
            slot_of[index[n]] = int(got[n])
            order.append(index[n])

        rows = np.concatenate([np.arange(3), *[3 + 2 * slot_of[i] + np.arange(2) for i in order]])
        mean, cov = np.asarray(belief.mean), np.asarray(cov_of(belief))
        np.testing.assert_allclose(mean[rows], dense.mean, atol=1e-9)
        np.testing.assert_allclose(cov[np.ix_(rows, rows)], dense.cov, atol=1e-10)
    assert len(order) == len(KINDS)
    assert np.linalg.norm(np.asarray(belief.pose)[:2] - pose[:2]) < 0.5


def test_predict_and_update_equal_filterpy():
    belief, landmarks = random_belief(0, landmarks=4), [0, 2, 3]
    motion, seen = np.array([0.4, -0.1, 0.3]), np.array([[3.9, 0.2], [3.1, -2.9], [4.0, -1.6]])
    scan, r = features(KINDS[landmarks], seen)
    ours, nis, _ = updated(predicted(belief, motion, jnp.array(Q)), scan, r, slots(*landmarks))

    used = 3 + 2 * 4

    class Theirs(ExtendedKalmanFilter):
        def predict_x(self, u=0):
            self.x = np.concatenate([reference_filter.compose(self.x[:3], u), self.x[3:]])

    theirs = Theirs(dim_x=used, dim_z=6)
    theirs.x, theirs.P = np.array(belief.mean[:used]), np.array(belief.cov[:used, :used])
    by_pose, by_motion = reference_filter.motion_jacobians(theirs.x[:3], motion)
    theirs.F = np.eye(used)
    theirs.F[:3, :3] = by_pose
    theirs.Q = np.zeros((used, used))
    theirs.Q[:3, :3] = by_motion @ Q @ by_motion.T
    theirs.predict(motion)
    theirs.R = np.kron(np.eye(3), np.asarray(r[0]))

    def predictions(x):
        return [reference_filter.observe(x, i, JUNCTION) for i in landmarks]

    theirs.update(
        seen.ravel(),
        lambda x: np.vstack([h for _, h in predictions(x)]),
        lambda x: np.concatenate([z for z, _ in predictions(x)]),
        residual=lambda a, b: np.concatenate(
            [reference_filter.difference(a[k : k + 2], b[k : k + 2], JUNCTION) for k in (0, 2, 4)]
        ),
    )
    np.testing.assert_allclose(ours.mean[:used], theirs.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.cov[:used, :used], theirs.P, rtol=0, atol=1e-9)
    np.testing.assert_allclose(nis, theirs.y @ theirs.SI @ theirs.y, rtol=1e-9)


def test_heading_and_wall_directions_are_a_linear_kalman_filter():
    rng = np.random.default_rng(1)
    walls, q, r = np.array([0.3, -0.4]), 0.02**2, WALL_STD**2
    belief = blank_belief(jnp.array([1.0, 2.0, 0.1]))
    scan, noise = features([WALL, WALL], np.array([[0.2, 0], [-0.5, 0]]))
    belief, _ = augmented(belief, scan, noise, scan.valid)
    mean, cov = np.array([0.1, 0.3, -0.4]), np.diag([0.0, r, r])
    h, f = np.array([[-1.0, 1, 0], [-1, 0, 1]]), np.eye(3)
    at = np.array([2, 3, 5])
    for turn in [0.1, -0.2, 0.15, 0.1]:
        seen = walls - mean[0] - turn + 0.01 * rng.normal(size=2)
        mean, cov = reference_filter.kalman(
            mean, cov, f, np.diag([q, 0, 0]), [turn, 0, 0], h, r * np.eye(2), seen
        )
        belief = predicted(belief, jnp.array([0, 0, turn]), jnp.array(np.diag([0, 0, q])))
        scan, noise = features([WALL, WALL], np.stack([seen, 0 * seen], axis=-1))
        belief, _, _ = updated(belief, scan, noise, slots(0, 1))
        np.testing.assert_allclose(np.asarray(belief.mean)[at], mean, atol=1e-12)
        np.testing.assert_allclose(np.asarray(cov_of(belief))[np.ix_(at, at)], cov, atol=1e-15)
    np.testing.assert_allclose(belief.pose[:2], [1.0, 2.0], atol=1e-15)


@jax.jit
def predict_and_derive(pose, position, kind):
    def prediction(pose, position):
        return measurement_model.predict_measurement(pose, position, kind)[0]

    derivatives = jax.jacfwd(prediction, (0, 1))(pose, position)
    return measurement_model.predict_measurement(pose, position, kind), derivatives


@pytest.mark.parametrize("kind", [JUNCTION, CORNER, WALL])
@pytest.mark.parametrize("position", [(1.0, 2.0), (-0.7, 0.2), (0.2, -3.0)])
def test_jacobians_of_the_prediction_are_its_derivatives(kind, position):
    pose, position = jnp.array([0.3, -0.2, 2.5]), jnp.array(position)
    (_, *ours), derived = predict_and_derive(pose, position, jnp.int32(kind))
    np.testing.assert_allclose(ours[0], derived[0], atol=1e-12)
    np.testing.assert_allclose(ours[1], derived[1], atol=1e-12)


def test_a_predicted_bearing_is_relative_to_the_heading():
    prediction = measurement_model.predict_measurement(
        jnp.array([1.0, 1.0, 0.5]), jnp.array([1.0, 3.0]), jnp.int32(JUNCTION)
    )[0]
    np.testing.assert_allclose(prediction, [2.0, np.pi / 2 - 0.5], atol=1e-12)


def test_a_landmark_where_the_robot_is_gives_finite_values_and_gradients():
    belief = random_belief(0, landmarks=1)
    belief = belief._replace(mean=belief.mean.at[3:5].set(belief.mean[:2]))
    scan, r = features([JUNCTION, JUNCTION], np.array([[0.1, 0.3], [0.0, 0.0]]))

    def total(mean, cov, r):
        now = with_cov(belief, cov)._replace(mean=mean)
        now, nis, logdet = updated(now, scan, r, slots(0))
        now, _ = augmented(now, scan, r, jnp.arange(M) == 1)
        distance = data_association.mahalanobis_distances(now, scan, r)[:2, :2]
        return jnp.sum(now.mean) + jnp.sum(now.cov) + nis + logdet + jnp.sum(distance)

    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))
    value, slopes = both(belief.mean, belief.cov, r)
    assert np.isfinite(value) and all(np.isfinite(s).all() for s in slopes)


def test_distances_are_the_norms_of_single_updates():
    belief = random_belief(3)
    scan, r = features(KINDS[:4], [[3.9, 0.2], [-0.3, 0], [4.3, 1.7], [4.0, -1.6]])
    distance = np.asarray(jax.jit(data_association.mahalanobis_distances)(belief, scan, r))
    for n in range(4):
        single = slots(*[n if k == n else L for k in range(4)])
        _, nis, _ = updated(belief, scan, r, single)
        np.testing.assert_allclose(distance[n, n], nis, rtol=1e-9)


def test_zero_matches_change_nothing():
    belief = random_belief(0)
    scan, r = features(KINDS[:3], np.ones((3, 2)))
    after, nis, logdet = updated(belief, scan, r, slots())
    jax.tree.map(np.testing.assert_array_equal, after, belief)
    assert nis == 0 and logdet == 0


@pytest.mark.parametrize("junk", [7.0, -1e3])
def test_unmatched_features_are_invisible_in_values_and_gradients(junk):
    belief = random_belief(0)
    scan, r = features(KINDS[:3], [[3.9, 0.2], [-0.3, 0], [4.3, 1.7]])
    dirty = scan._replace(
        xy=scan.xy.at[2:].set(junk),
        direction=scan.direction.at[2:].set(junk),
        kind=scan.kind.at[2:].set(WALL),
    )

    def total(r, scan):
        after, nis, logdet = updated(belief, scan, r, slots(0, 1))
        return jnp.sum(after.mean[:7]) + jnp.sum(after.cov[:7, :7]) + nis + logdet

    both = jax.jit(jax.value_and_grad(total))
    clean, dirty = both(r, scan), both(r.at[2:].set(abs(junk)), dirty)
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    assert np.any(clean[1][:2] != 0) and not np.any(clean[1][2:])


def test_a_new_landmark_has_the_moments_of_samples():
    """Against 200 000 samples of pose and measurement.

    The tolerance is 5 standard errors and what the linearisation neglects: with errors of a few
    hundredths of a radian over 4 m, its second-order terms stay below 1e-5 m^2.
    """
    samples, rng = 200_000, np.random.default_rng(0)
    pose, small = np.array([0.3, -0.2, 0.7]), 0.02
    root = small * rng.normal(size=(3, 3))
    belief = initial_belief(jnp.array(pose), max_landmarks=L)
    belief = belief._replace(pose_cov=root @ root.T)
    scan, r = features([JUNCTION], [[4.0, 0.6]])
    after, slot = augmented(belief, scan, r, scan.valid)
    assert slot[0] == 0

    poses = pose + rng.normal(size=(samples, 3)) @ root.T
    seen = rng.multivariate_normal([4.0, 0.6], np.asarray(r[0]), samples)
    angle = poses[:, 2] + seen[:, 1]
    position = poses[:, :2] + seen[:, :1] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    sampled = np.cov(np.hstack([poses, position]).T)
    error = np.sqrt((np.outer(np.diag(sampled), np.diag(sampled)) + sampled**2) / samples)
    assert np.all(np.abs(after.cov[:5, :5] - sampled) < 5 * error + 1e-5)
    assert np.abs(sampled[:3, 3:]).max() > 50 * error[:3, 3:].max()


def test_augment_leaves_the_rest_of_the_belief_alone_and_counts_ids():
    belief = random_belief(0)._replace(next_id=jnp.int32(7), step=jnp.int32(3))
    scan, r = features([JUNCTION, WALL, CORNER, JUNCTION], np.ones((4, 2)))
    after, slot = augmented(belief, scan, r, jnp.array([False, True, True, True, False]))
    np.testing.assert_array_equal(slot, [L, 4, 5, 6, L])
    np.testing.assert_array_equal(after.mean[:11], belief.mean[:11])
    np.testing.assert_array_equal(after.cov[:11, :11], belief.cov[:11, :11])
    np.testing.assert_array_equal(after.id[4:7], [7, 8, 9])
    np.testing.assert_array_equal(after.last_seen[4:7], 3)
    np.testing.assert_array_equal(after.kind[4:7], [WALL, CORNER, JUNCTION])
    assert after.next_id == 10


def test_a_reused_slot_keeps_nothing_of_its_last_landmark():
    belief = random_belief(0)
    scan, r = features([JUNCTION], [[2.0, 0.4]])
    freed = prune(belief, jnp.arange(L) == 1)
    cov = freed.cov.at[5:7].set(0.0).at[:, 5:7].set(0.0)
    blank = with_cov(freed, cov)._replace(
        mean=freed.mean.at[5:7].set(0.0), first_estimate=freed.first_estimate.at[5:7].set(0.0)
    )
    one, two = (augmented(b, scan, r, scan.valid)[0] for b in (freed, blank))
    assert one.num_seen[1] == 1
    jax.tree.map(np.testing.assert_array_equal, one, two)


def test_covariance_stays_symmetric_and_positive_definite_in_float32():
    steps, index = 2000, np.array([0, 1, 2, 3, 5])
    rng = np.random.default_rng(0)
    pose, poses = np.array([0.0, 0.0, 0.0]), []
    motion = np.array([0.2, 0.0, 0.1])
    for _ in range(steps):
        pose = reference_filter.compose(pose, motion + rng.multivariate_normal(np.zeros(3), Q))
        poses.append(pose)
    seen = [plain_features(KINDS[index], [observed(rng, p, i) for i in index]) for p in poses]
    inputs = jax.tree.map(lambda *x: np.stack(x), *seen)

    def run(dtype):
        def cast(x):
            return jnp.asarray(x, dtype if np.issubdtype(x.dtype, np.floating) else x.dtype)

        scan, r = jax.tree.map(cast, inputs)
        motions, q = jnp.asarray(motion, dtype), jnp.asarray(Q, dtype)

        def body(belief, now):
            belief = ekf.predict(belief, motions, q)
            slot = jnp.arange(M, dtype=jnp.int32)
            belief, _ = ekf.update(belief, ekf.linearize(belief, *now, slot))
            return belief, (belief.pose, belief.cov)

        @jax.jit
        def whole(first, now):
            earliest = jax.tree.map(lambda x: x[0], now)
            first, _ = map_management.augment(first, *earliest, jnp.ones(M, bool), max_new=M)
            return jax.lax.scan(body, first, now)[1]

        out = whole(initial_belief(jnp.zeros(3, dtype), max_landmarks=M), (scan, r))
        assert out[0].dtype == dtype
        return jax.tree.map(np.asarray, out)

    double = run(jnp.float64)
    with jax.enable_x64(False):
        single = run(jnp.float32)
    poses, cov = single
    scale = np.sqrt(np.diagonal(double[1], axis1=1, axis2=2))
    scale = np.maximum(scale[:, :, None] * scale[:, None], 1e-12)
    assert np.max(np.abs(cov - np.swapaxes(cov, 1, 2)) / scale) < 1e-5
    real = np.flatnonzero(np.arange(3 + 2 * M) != 6)  # without the unused number of the wall
    used = [c[:, real[:, None], real].astype(float) for c in (cov, double[1])]
    least = [np.linalg.eigvalsh(c)[:, 0] for c in used]
    assert np.all(least[0] > 0.5 * least[1]) and np.all(least[1] > 0)
    np.testing.assert_allclose(poses, double[0], atol=1e-4)
    assert np.max(np.abs(cov - double[1]) / scale) < 1e-3
