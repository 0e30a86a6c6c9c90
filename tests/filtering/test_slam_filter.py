"""A step, and the filter over a drive: against a loop, the truth and finite differences."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import compose, dead_reckoning
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering import motion_model, slam_filter
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.filtering.noise import NoiseParams

T, M = 8, 9
CONFIG = FilterConfig(
    max_landmarks=10, max_updates=5, max_new=4, confirm_count=3, max_unconfirmed_age=2
)
NOISE = NoiseParams.for_simulated_robot()
KINDS = np.array([JUNCTION, JUNCTION, JUNCTION, CORNER, CORNER, CORNER, WALL, WALL])
POSITIONS = np.array([[4.0, 1], [2, -3], [1, 4], [5, -2], [-3, 2], [6, 4], [0.3, 0], [-1.2, 0]])
FACING = np.array([0.0, 0.0, 0.0, 1.0, -2.0, 2.5, 0.0, 0.0])
DESCRIPTOR = np.array([0.5, 1.0, 2.0, 1.5, 1.5, 4.7, 0.0, 0.0])
MOTION = np.array([0.25, 0.0, 0.12])
SMALL = CONFIG._replace(max_landmarks=5, landmark_kinds=(JUNCTION, CORNER), confirm_count=1)
MERGING = AssociationSpec(ambiguity_margin=0.0)
TRACED = []


@partial(jax.jit, static_argnums=0)
def stepped(config, params, belief, measurement):
    TRACED.append(config)  # runs while tracing only
    return slam_filter.step(config, params, belief, measurement)


def seen_features(rng, pose, *, only=range(8)):
    """Features (M) of the landmarks `only`, seen from `pose` with 1 cm and 2 mrad of noise."""
    seen = np.array(sorted(only), int)

    def pad(x):
        return np.concatenate([x, np.zeros((M - len(seen),) + x.shape[1:], x.dtype)])

    c, s = np.cos(pose[2]), np.sin(pose[2])
    wall = KINDS[seen] == WALL
    xy = (POSITIONS[seen] - pose[:2]) @ np.array([[c, -s], [s, c]])
    xy = np.where(wall[:, None], 0.0, xy + 0.01 * rng.normal(size=xy.shape))
    turn = np.where(wall, POSITIONS[seen, 0] + 0.002 * rng.normal(size=len(seen)), FACING[seen])
    return Features(
        kind=pad(KINDS[seen].astype(np.int32)),
        xy=pad(xy),
        cov=pad(np.where(wall[:, None, None], 0.0, 1e-4 * np.eye(2)) + np.zeros((len(seen), 2, 2))),
        direction=pad(np.where(KINDS[seen] == JUNCTION, 0.0, turn - pose[2])),
        direction_variance=pad(np.where(wall, 4e-6, 0.0)),
        descriptor=pad(DESCRIPTOR[seen]),
        degree=pad(np.full(len(seen), 3, np.int32)),
        certified=pad(np.ones(len(seen), bool)),
        trusted=pad(np.ones(len(seen), bool)),
        valid=pad(np.ones(len(seen), bool)),
    )


def drive(seed, *, only=lambda t: range(8)):
    """True poses (T, 3) of a short drive, and the measurements [T]."""
    rng = np.random.default_rng(seed)
    poses, odometry, pose = [], [], np.zeros(3)
    for t in range(T):
        odometry.append(MOTION * (t > 0))
        if t:
            error = rng.multivariate_normal(
                np.zeros(3),
                motion_model.odometry_cov(NOISE.odometry_coefficients, jnp.array(MOTION)),
            )
            pose = np.asarray(compose(jnp.array(pose), jnp.array(MOTION + error)))
        poses.append(pose)
    seen = [seen_features(rng, pose, only=only(t)) for t, pose in enumerate(poses)]
    measured = Measurement(np.stack(odometry), jax.tree.map(lambda *x: np.stack(x), *seen))
    return np.stack(poses), jax.tree.map(jnp.asarray, measured)


def start(dtype=float, config=CONFIG):
    return init(config, jnp.zeros(3, dtype))


def at(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


def run(measured, config=CONFIG):
    return slam_filter.run_filter(config, NOISE, init(config, jnp.zeros(3)), measured)


@pytest.fixture(scope="module")
def drives():
    return [drive(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def together(drives):
    """Beliefs and infos of the three drives under vmap, and with a NaN in the last odometry."""
    batch = jax.tree.map(lambda *x: jnp.stack(x), *[measured for _, measured in drives])
    run_all = jax.jit(jax.vmap(run))
    broken = batch._replace(odometry=batch.odometry.at[2, 3, 0].set(jnp.nan))
    return run_all(batch), run_all(broken)


def close(one, two, atol):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), one, two)


def test_step_is_traced_once_and_run_filter_equals_a_loop(drives):
    measured, belief, infos = drives[0][1], start(), []
    for t in range(T):
        belief, info = stepped(CONFIG, NOISE, belief, at(measured, t))
        infos.append(info)
    assert TRACED.count(CONFIG) == 1
    whole = run(measured)
    close(whole, (belief, jax.tree.map(lambda *x: np.stack(x), *infos)), atol=1e-9)


def test_vmap_equals_a_loop_over_drives(drives, together):
    for b, (_, measured) in enumerate(drives):
        close(at(together[0], b), run(measured), atol=1e-9)


def test_the_estimate_follows_the_truth_and_its_matches_are_right(drives):
    truth, measured = drives[0]
    belief, info = run(measured)
    assert np.abs(info.pose - truth)[:, :2].max() < 0.05 and info.finite.all()
    odometry_only = dead_reckoning(jnp.zeros(3), measured.odometry)
    assert np.linalg.norm((info.pose - truth)[-1, :2]) < np.linalg.norm(
        (odometry_only - truth)[-1, :2]
    )
    # Feature k is landmark k in all scans: its id never changes.
    for ids in np.asarray(info.id).T:
        assert len(set(ids[ids >= 0])) <= 1
    assert np.all(info.id[-1, :8] >= 0) and np.all(info.id[:, 8] == -1)
    assert sorted(np.asarray(belief.id[belief.num_seen > 0])) == list(range(8))


def test_nan_in_one_odometry_is_reported_and_leaves_the_others_alone(together):
    good, bad = together
    close(at(bad, slice(0, 2)), at(good, slice(0, 2)), atol=0)
    assert good[1].finite.all() and bad[1].finite[:2].all()
    np.testing.assert_array_equal(bad[1].finite[2], np.arange(T) < 3)
    assert np.isfinite(bad[1].log_likelihood).all()


@pytest.mark.parametrize("field", ["xy", "cov", "direction", "direction_variance"])
def test_a_nan_feature_equals_none(drives, field):
    measured = drives[0][1]
    k = 7 if field in ("direction", "direction_variance") else 4
    value = getattr(measured.features, field).at[2:5, k].set(jnp.nan)
    bad = measured._replace(features=measured.features._replace(**{field: value}))
    none = measured._replace(
        features=measured.features._replace(valid=measured.features.valid.at[2:5, k].set(False))
    )
    bad, none = run(bad), run(none)
    close(bad, none, atol=0)
    assert bad[1].finite.all()


@pytest.fixture(scope="module")
def objective():
    """Mean squared position error of a drive by the logarithms of the noise parameters."""
    log_params, unravel = ravel_pytree(jax.tree.map(jnp.log, NOISE))

    def loss(log_params, measured, truth):
        params = jax.tree.map(jnp.exp, unravel(log_params))
        _, info = slam_filter.run_filter(CONFIG, params, start(), measured)
        return jnp.mean(jnp.sum((info.pose - truth)[:, :2] ** 2, axis=1)), info.slot

    return log_params, loss, jax.jit(jax.value_and_grad(loss, has_aux=True))


def test_gradient_of_the_localisation_error_equals_finite_differences(objective, drives):
    log_params, loss, value_and_grad = objective
    truth, measured = drives[0]
    (_, slot), ours = value_and_grad(log_params, measured, truth)
    assert log_params.size == 8 and np.all(ours != 0)
    for k, direction in enumerate(1e-4 * np.eye(8)):
        (high, up), (low, down) = (
            loss(log_params + s * direction, measured, truth) for s in (1, -1)
        )
        np.testing.assert_array_equal(up, slot)
        np.testing.assert_array_equal(down, slot)
        np.testing.assert_allclose(ours[k], (high - low) / 2e-4, rtol=1e-5)


@pytest.mark.parametrize("junk", [7.0, jnp.nan])
def test_padding_is_invisible_in_values_and_gradients(objective, drives, junk):
    log_params, _, value_and_grad = objective
    truth, measured = drives[0]
    features = measured.features
    clean = features._replace(valid=features.valid.at[:, 6].set(False))  # and 8 never was

    def fill(x):
        return x.at[:, jnp.array([6, 8])].set(junk)

    dirty = clean._replace(
        xy=fill(features.xy),
        cov=fill(features.cov),
        direction=fill(features.direction),
        direction_variance=fill(features.direction_variance),
    )
    clean, dirty = (
        value_and_grad(log_params, measured._replace(features=n), truth) for n in (clean, dirty)
    )
    close(clean, dirty, atol=0)


def test_landmarks_do_not_update_the_pose_before_they_are_confirmed(drives):
    _, measured = drives[0]
    _, info = run(measured)
    odometry_only = dead_reckoning(jnp.zeros(3), measured.odometry)
    first = CONFIG.confirm_count - 1
    assert np.all(info.id[1, :4] >= 0)  # they are matched nevertheless
    assert not info.used[:first].any() and info.used[first, :4].all()
    # The walls came with the second scan, and need more observations.
    np.testing.assert_array_equal(info.used[:, 6], np.arange(T) >= CONFIG.wall_confirm_count)
    np.testing.assert_allclose(info.pose[:first], odometry_only[:first], atol=1e-12)
    assert np.linalg.norm(info.pose[first] - odometry_only[first]) > 1e-4


def test_unconfirmed_landmarks_are_pruned_and_their_slots_reused(drives):
    _, measured = drive(0, only=lambda t: [0, 1] if t < 3 else [])
    belief, seen = start(), []
    _, late = drive(0, only=lambda t: [0, 1, 2, 3] if t == 1 else [0, 1])
    _, other = drive(0, only=lambda t: [4])
    for t in range(T):
        belief, info = stepped(CONFIG, NOISE, belief, at(other if t == 5 else late, t))
        seen.append(np.asarray(belief.num_seen[:5]))
    # 0 and 1 are confirmed; 2 and 3 were observed at the second step only, and kept for two.
    np.testing.assert_array_equal(np.stack(seen)[1:5, 2:4], [[1, 1], [1, 1], [1, 1], [0, 0]])
    np.testing.assert_array_equal(seen[5][2:5], [1, 0, 0])
    assert np.all(seen[-1][:2] >= CONFIG.confirm_count)
    np.testing.assert_array_equal(belief.id[:3], [0, 1, 4])
    assert belief.next_id == 5


def test_new_landmarks_respect_max_new_and_a_full_map(drives):
    truth, measured = drives[0]
    _, info = run(measured)
    np.testing.assert_array_equal(info.id[0], [0, 1, 2, 3, *[-1] * 5])
    np.testing.assert_array_equal(info.id[1], [*range(8), -1])
    belief = start(config=SMALL)
    for t in range(3):
        belief, info = stepped(SMALL, NOISE, belief, at(measured, t))
    np.testing.assert_array_equal(info.id, [*range(5), *[-1] * 4])
    np.testing.assert_array_equal(info.slot[5:], 5)
    assert belief.next_id == 5 and np.isfinite(belief.cov).all()


def test_only_the_kinds_of_the_config_are_used(drives):
    _, measured = drive(0, only=lambda t: [0, 3, 6, 7])
    belief = start(config=SMALL)
    for t in range(2):
        belief, info = stepped(SMALL, NOISE, belief, at(measured, t))
    np.testing.assert_array_equal(info.used, np.arange(M) < 2)
    assert info.dof == 4 and belief.next_id == 2


def test_float32_is_close_to_float64(drives):
    measured = drives[0][1]
    _, double = run(measured)
    with jax.enable_x64(False):

        def cast(x):
            return jnp.asarray(x, jnp.float32 if np.issubdtype(x.dtype, np.floating) else x.dtype)

        given = jax.tree.map(cast, (NOISE, start(jnp.float32), measured))
        belief, single = slam_filter.run_filter(CONFIG, *given)
        assert belief.cov.dtype == single.pose.dtype == single.nis.dtype == jnp.float32
    np.testing.assert_array_equal(single.slot, double.slot)
    assert double.used.any() and single.finite.all()
    np.testing.assert_allclose(single.pose, double.pose, atol=1e-5)
    np.testing.assert_allclose(single.pose_cov, double.pose_cov, atol=1e-7)


def counters(info):
    """The numbers of new, pruned, evicted and merged landmarks that are not zero."""
    names = "new", "pruned", "evicted", "merged"
    return {name: int(n) for name in names if (n := getattr(info, f"num_{name}"))}


def test_a_step_counts_landmarks_that_are_added_and_pruned():
    _, measured = drive(0, only=lambda t: [0, 1, 2] if t == 0 else [0, 1])
    belief, events = start(), []
    for t in range(5):
        belief, info = stepped(CONFIG, NOISE, belief, at(measured, t))
        events.append(counters(info))
    assert events == [{"new": 3}, {}, {}, {"pruned": 1}, {}]


def test_a_full_map_evicts_old_unconfirmed_landmarks_never_confirmed_ones():
    config = SMALL._replace(max_landmarks=3, confirm_count=2, evict_after=1, max_unconfirmed_age=40)
    _, measured = drive(0, only=lambda t: [0, 1, 2] if t < 1 else [0] if t < 3 else [0, 3, 4, 5])
    belief, events = start(config=config), []
    for t in range(5):
        belief, info = stepped(config, NOISE, belief, at(measured, t))
        events.append(counters(info))
    # Of three that need a slot two get one, and the next step finds none to evict.
    assert events == [{"new": 3}, {}, {}, {"new": 2, "evicted": 2}, {}]
    np.testing.assert_array_equal(belief.id, [0, 3, 4])
    assert np.isfinite(belief.cov).all()


def test_a_junction_whose_detection_is_missed_repeatedly_is_pruned():
    config = SMALL._replace(max_misses=2, confirm_count=2)
    # Junction 2 is 4.1 m away; from within its circle, which is wide here, it must be detected.
    wide = DESCRIPTOR[2] * 5
    _, measured = drive(0, only=lambda t: [0, 2] if t < 2 else [0])
    descriptor = jnp.where(
        measured.features.descriptor == DESCRIPTOR[2], wide, measured.features.descriptor
    )
    measured = measured._replace(features=measured.features._replace(descriptor=descriptor))
    belief, events = start(config=config), []
    for t in range(5):
        belief, info = stepped(config, NOISE, belief, at(measured, t))
        events.append(counters(info))
    assert events == [{"new": 2}, {}, {}, {"pruned": 1}, {}]
    _, other = drive(0, only=lambda t: [0, 2] if t < 2 else [0])  # from outside it need not be
    belief = start(config=config)
    for t in range(T):
        belief, _ = stepped(config, NOISE, belief, at(other, t))
    np.testing.assert_array_equal(belief.id[belief.num_seen > 0], [0, 1])


def test_duplicates_are_merged_into_the_older_landmark():
    # The one that is matched is looked at.
    config = SMALL._replace(confirm_count=1, max_updates=1, association=MERGING)
    _, measured = drive(0, only=lambda t: [0])
    belief, _ = stepped(config, NOISE, start(config=config), at(measured, 0))
    duplicate_cov = belief.map_cov[:2, :2] + 1e-3 * jnp.eye(2)
    belief = belief._replace(
        mean=belief.mean.at[5:7].set(belief.mean[3:5] + jnp.array([0.03, 0.02])),
        map_cov=belief.map_cov.at[2:4, 2:4].set(duplicate_cov),
        num_seen=belief.num_seen.at[1].set(1),
        id=belief.id.at[1].set(7),
        descriptor=belief.descriptor.at[1].set(belief.descriptor[0]),
        next_id=jnp.int32(8),
    )
    before = np.trace(belief.map_cov[:2, :2])
    belief, info = stepped(config, NOISE, belief, at(measured, 1))
    assert counters(info) == {"merged": 1}
    np.testing.assert_array_equal(belief.id[belief.num_seen > 0], [0])
    assert np.trace(belief.map_cov[:2, :2]) < before


@pytest.mark.slow
def test_gradients_stay_finite_with_a_full_map_and_a_diverged_neighbour(drives):
    config = SMALL._replace(max_landmarks=3, evict_after=0, confirm_count=2)
    log_params, unravel = ravel_pytree(jax.tree.map(jnp.log, NOISE))
    batch = jax.tree.map(lambda *x: jnp.stack(x), *[measured for _, measured in drives])
    truth = jnp.stack([truth for truth, _ in drives])
    broken = batch._replace(odometry=batch.odometry.at[1, 3].set(jnp.nan))

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, 0))
    def each(log_params, measured, truth):
        def loss(log_params):
            params = jax.tree.map(jnp.exp, unravel(log_params))
            _, info = slam_filter.run_filter(config, params, start(config=config), measured)
            off = jnp.where(info.finite[:, None], (info.pose - truth)[:, :2], 0.0)
            return jnp.mean(jnp.sum(off**2, axis=1)), info

        return jax.value_and_grad(loss, has_aux=True)(log_params)

    (_, info), good = each(log_params, batch, truth)
    _, bad = each(log_params, broken, truth)
    assert np.isfinite(good).all() and np.all(np.any(good != 0, axis=1))
    assert (info.num_new.sum(axis=1) - info.num_evicted.sum(axis=1) <= 3).all()
    np.testing.assert_array_equal(bad[jnp.array([0, 2])], good[jnp.array([0, 2])])
