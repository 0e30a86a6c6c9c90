"""The filter with known association: a sensor that identifies the landmarks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter
from reference_filter import DenseSlam

from experiments import workload
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import JUNCTION
from jaxslam.filtering import motion_model, slam_filter
from jaxslam.filtering.belief import initial_belief
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import features

T, M, L = 80, 5, 12
CONFIG = FilterConfig(max_landmarks=L, max_updates=M, max_new=M)
NOISE = NoiseParams.for_simulated_robot()._replace(
    range_std=jnp.array(0.1), bearing_std=jnp.array(0.03)
)
R = np.diag([0.1, 0.03]) ** 2
MOTION = np.array([0.25, 0.0, 0.07])
Q = np.asarray(motion_model.odometry_cov(NOISE.odometry_coefficients, jnp.array(MOTION)))


def drive(seed):
    """True poses (T, 3), odometry (T, 3), range and bearing (T, M, 2) and landmark (T, M), or -1.

    The nearest landmarks within 5 m, in any order, padded.
    """
    rng = np.random.default_rng(seed)
    positions = rng.uniform([-5.0, -2.0], [5.0, 9.0], (L, 2))
    pose, poses = np.zeros(3), []
    polar, ids = np.zeros((T, M, 2)), np.full((T, M), -1, np.int32)
    for t in range(T):
        if t:
            pose = reference_filter.compose(pose, rng.multivariate_normal(MOTION, Q))
        poses.append(pose)
        distance = np.hypot(*(positions - pose[:2]).T)
        near = rng.permutation(np.argsort(distance)[: np.sum(distance < 5.0)][: M - t % 2])
        slot = rng.permutation(M)[: len(near)]
        state = np.concatenate([pose, positions.ravel()])
        for k, i in zip(slot, near, strict=True):
            seen, _ = reference_filter.observe(state, i, JUNCTION)
            polar[t, k], ids[t, k] = seen + rng.normal(size=2) * [0.1, 0.03], i
    odometry = np.where(np.arange(T)[:, None] > 0, MOTION, 0.0)
    return np.stack(poses), odometry, polar, ids


features_of = jax.jit(jax.vmap(features.features_from_range_bearing))


def measurements_of(odometry, polar, ids):
    seen = features_of(jnp.asarray(polar), jnp.asarray(ids >= 0))
    return Measurement(jnp.asarray(odometry), seen, jnp.asarray(ids))


def run(measurements, config=CONFIG):
    return run_with(NOISE, measurements, config)


def run_with(params, measurements, config=CONFIG):
    return slam_filter.run_filter(config, params, init(config, jnp.zeros(3)), measurements)


@pytest.mark.parametrize("seed", range(3))
def test_known_association_equals_dense_ekf_slam(seed):
    poses, odometry, polar, ids = drive(seed)
    belief, info = run(measurements_of(odometry, polar, ids))
    dense, order = DenseSlam(np.zeros(3)), []
    for t in range(T):
        dense.predict(odometry[t], Q if t else np.zeros((3, 3)))
        old = [k for k in range(M) if ids[t, k] in order]
        if old:
            nis, logdet = dense.update(
                [(order.index(ids[t, k]), JUNCTION, polar[t, k], R) for k in old]
            )
            density = nis + logdet + 2 * len(old) * np.log(2 * np.pi)
            np.testing.assert_allclose(info.nis[t], nis, atol=1e-8)
            np.testing.assert_allclose(info.log_likelihood[t], -0.5 * density, atol=1e-8)
        for k in range(M):
            if ids[t, k] >= 0 and k not in old:
                dense.augment(JUNCTION, polar[t, k], R)
                order.append(ids[t, k])
        np.testing.assert_allclose(info.pose[t], dense.mean[:3], atol=1e-9)
        np.testing.assert_allclose(info.pose_cov[t], dense.cov[:3, :3], atol=1e-10)
    rows = np.concatenate([np.arange(3), *[3 + 2 * i + np.arange(2) for i in order]])
    np.testing.assert_allclose(belief.mean[rows], dense.mean, atol=1e-9)
    np.testing.assert_allclose(belief.cov[np.ix_(rows, rows)], dense.cov, atol=1e-10)
    np.testing.assert_array_equal(info.slot, np.where(ids >= 0, ids, L))
    np.testing.assert_array_equal(info.id, ids)
    assert len(order) >= 9 and np.hypot(*(info.pose[-1] - poses[-1])[:2]) < 0.5


def test_a_landmark_that_occurs_twice_in_a_scan_is_used_once():
    _, odometry, polar, ids = drive(0)
    doubled = np.concatenate([polar, polar[:, :1] + 0.2], axis=1)
    doubled_ids = np.concatenate([ids, ids[:, :1]], axis=1)
    config = CONFIG._replace(max_updates=M + 1, max_new=M + 1)
    once = run(measurements_of(odometry, polar, ids))
    twice = run(measurements_of(odometry, doubled, doubled_ids), config)
    np.testing.assert_allclose(once[0].mean, twice[0].mean, atol=1e-12)
    np.testing.assert_array_equal(once[0].num_seen, twice[0].num_seen)


@pytest.mark.slow
def test_features_without_a_known_landmark_are_invisible_in_values_and_gradients():
    _, odometry, polar, ids = drive(1)
    extra_polar = np.tile([[[2.0, 0.3], [3.0, 0.1]]], (T, 1, 1))
    extra_ids = np.tile(np.array([[-1, L]], np.int32), (T, 1))

    @jax.jit  # where ids are not concrete, one that is out of range is left out
    @jax.value_and_grad
    def loss(params, measurements):
        _, info = run_with(params, measurements)
        return jnp.sum(info.pose[:, :2] ** 2)

    clean = measurements_of(odometry, polar, ids)
    extra = measurements_of(
        odometry,
        np.concatenate([polar, extra_polar], axis=1),
        np.concatenate([ids, extra_ids], axis=1),
    )
    valid = extra.features.valid.at[:, M:].set(True)
    extra = extra._replace(features=extra.features._replace(valid=valid))
    plain, with_extra = loss(NOISE, clean), loss(NOISE, extra)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), plain, with_extra
    )
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(plain))
    assert np.abs(plain[1].range_std) > 0 and np.abs(plain[1].bearing_std) > 0


def test_wrong_shapes_are_refused_by_name():
    _, odometry, polar, ids = drive(0)
    good = measurements_of(odometry, polar, ids)
    with pytest.raises(ValueError, match=r"landmark_ids is int32 \(80, 4\), not"):
        run(good._replace(landmark_ids=good.landmark_ids[:, :4]))
    with pytest.raises(ValueError, match=r" is .*\(5, 3\), not"):
        features.features_from_range_bearing(jnp.zeros((5, 3)), jnp.zeros(5, bool))
    with pytest.raises(ValueError, match="valid is .*, not"):
        features.features_from_range_bearing(jnp.zeros((5, 2)), jnp.zeros(4, bool))


@pytest.mark.slow
def test_the_covariance_stays_positive_definite_over_50_000_steps_in_float32():
    steps, count, most = 50_000, 16, 4
    rng = np.random.default_rng(0)
    true = np.tile([0.25, 0.0, 0.05], (1, steps, 1))
    truth = workload.dead_reckoning(np.zeros((1, 3)), true)
    angle = 2 * np.pi * np.arange(count) / count
    positions = rng.uniform(3, 7.5, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
    distance, bearing, ids = workload.nearest(truth, positions[None] + [0, 5.0], (0.4, 6.0), most)
    polar = np.stack([distance, bearing], -1)[0] + rng.normal(size=(steps, most, 2)) * [0.1, 0.03]
    odometry = true[0] + rng.normal(size=(steps, 3)) * [0.02, 0.02, 0.01]
    ids = np.where(polar[..., 0] > 0.4, ids[0], -1)
    q = jnp.diag(jnp.array([0.02, 0.02, 0.01], jnp.float32) ** 2)
    r = jnp.tile(jnp.diag(jnp.array([0.1, 0.03], jnp.float32) ** 2), (most, 1, 1))

    def step(belief, now):
        return workload.step("invariant", q, belief, (*now, r))

    def thousand(belief, chunk):
        belief, result = jax.lax.scan(step, belief, chunk)
        return belief, (belief.cov, result.pose, result.ok)

    data = jnp.asarray(odometry, jnp.float32), jnp.asarray(polar, jnp.float32), jnp.asarray(ids)
    chunks = jax.tree.map(lambda x: x.reshape((-1, 1000) + x.shape[1:]), data)
    first = initial_belief(jnp.zeros(3, jnp.float32), max_landmarks=count)
    _, (cov, pose, good) = jax.jit(partial(jax.lax.scan, thousand))(first, chunks)
    assert cov.dtype == jnp.float32 and good.all()
    cov = np.asarray(cov, float)
    np.testing.assert_allclose(cov, cov.swapaxes(1, 2), rtol=0, atol=1e-6)
    std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    assert np.linalg.eigvalsh(cov / std[:, :, None] / std[:, None]).min() > 1e-4
    assert np.abs(np.asarray(pose).reshape(-1, 3) - truth[0])[:, :2].max() < 0.6
