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
from jaxslam.pipeline.config import Config

T, M = 8, 9
CONFIG = Config(
    filter=FilterConfig(
        max_landmarks=10,
        max_updates=5,
        max_new=4,
        confirm_count=3,
        max_unconfirmed_age=2,
    ),
)
NOISE = NoiseParams.for_simulated_robot()
KINDS = np.array([JUNCTION, JUNCTION, JUNCTION, CORNER, CORNER, CORNER, WALL, WALL])
PLACES = np.array([[4.0, 1], [2, -3], [1, 4], [5, -2], [-3, 2], [6, 4], [0.3, 0], [-1.2, 0]])
FACING = np.array([0.0, 0.0, 0.0, 1.0, -2.0, 2.5, 0.0, 0.0])
SHAPE = np.array([0.5, 1.0, 2.0, 1.5, 1.5, 4.7, 0.0, 0.0])
MOTION = np.array([0.25, 0.0, 0.12])
SMALL = CONFIG._replace(
    filter=CONFIG.filter._replace(
        max_landmarks=5,
        landmark_kinds=(JUNCTION, CORNER),
        confirm_count=1,
    ),
)
MERGING = AssociationSpec(ambiguity_margin=0.0)
TRACED = []


@partial(jax.jit, static_argnums=0)
def stepped(config, noise, belief, inputs):
    TRACED.append(config)  # runs while tracing only
    return slam_filter.step(config.filter, noise, belief, inputs)


def sight(rng, pose, *, only=range(8), kinds=KINDS, places=PLACES):
    """Features (M,) of the landmarks `only`, seen from `pose` with 1 cm and 2 mrad of noise."""
    seen = np.array(sorted(only), int)
    pad = lambda x: np.concatenate([x, np.zeros((M - len(seen),) + x.shape[1:], x.dtype)])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    wall = kinds[seen] == WALL
    xy = (places[seen] - pose[:2]) @ np.array([[c, -s], [s, c]])
    xy = np.where(wall[:, None], 0.0, xy + 0.01 * rng.normal(size=xy.shape))
    turn = np.where(wall, places[seen, 0] + 0.002 * rng.normal(size=len(seen)), FACING[seen])
    return Features(
        kind=pad(kinds[seen].astype(np.int32)),
        xy=pad(xy),
        cov=pad(np.where(wall[:, None, None], 0.0, 1e-4 * np.eye(2)) + np.zeros((len(seen), 2, 2))),
        direction=pad(np.where(kinds[seen] == JUNCTION, 0.0, turn - pose[2])),
        direction_variance=pad(np.where(wall, 4e-6, 0.0)),
        descriptor=pad(SHAPE[seen]),
        degree=pad(np.full(len(seen), 3, np.int32)),
        certified=pad(np.ones(len(seen), bool)),
        trusted=pad(np.ones(len(seen), bool)),
        valid=pad(np.ones(len(seen), bool)),
    )


def drive(seed, *, only=lambda t: range(8)):
    """True poses (T, 3) of a short drive, and what the filter is given at each of T steps."""
    rng = np.random.default_rng(seed)
    poses, told, pose = [], [], np.zeros(3)
    for t in range(T):
        told.append(MOTION * (t > 0))
        if t:
            error = rng.multivariate_normal(
                np.zeros(3),
                motion_model.odometry_cov(NOISE.odometry_coefficients, jnp.array(MOTION)),
            )
            pose = np.asarray(compose(jnp.array(pose), jnp.array(MOTION + error)))
        poses.append(pose)
    seen = [sight(rng, pose, only=only(t)) for t, pose in enumerate(poses)]
    told = Measurement(np.stack(told), jax.tree.map(lambda *x: np.stack(x), *seen))
    return np.stack(poses), jax.tree.map(jnp.asarray, told)


def start(dtype=float):
    return init(CONFIG.filter, jnp.zeros(3, dtype))


def at(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


@pytest.fixture(scope="module")
def logs():
    return [drive(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def together(logs):
    """Beliefs and infos of the three logs under vmap, and with a NaN in the last one's wheels."""
    inputs = jax.tree.map(lambda *x: jnp.stack(x), *[told for _, told in logs])
    many = jax.jit(
        jax.vmap(lambda told: slam_filter.run_filter(CONFIG.filter, NOISE, start(), told))
    )
    broken = inputs._replace(odometry=inputs.odometry.at[2, 3, 0].set(jnp.nan))
    return many(inputs), many(broken)


def close(one, two, atol):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), one, two)


def test_step_is_traced_once_and_run_equals_a_loop(logs):
    told, belief, infos = logs[0][1], start(), []
    for t in range(T):
        belief, info = stepped(CONFIG, NOISE, belief, at(told, t))
        infos.append(info)
    assert TRACED.count(CONFIG) == 1
    whole = slam_filter.run_filter(CONFIG.filter, NOISE, start(), told)
    close(whole, (belief, jax.tree.map(lambda *x: np.stack(x), *infos)), atol=1e-9)


def test_vmap_equals_a_loop_over_runs(logs, together):
    for b, (_, told) in enumerate(logs):
        close(
            at(together[0], b),
            slam_filter.run_filter(CONFIG.filter, NOISE, start(), told),
            atol=1e-9,
        )


def test_the_estimate_follows_the_truth_and_its_matches_are_right(logs):
    truth, told = logs[0]
    belief, info = slam_filter.run_filter(CONFIG.filter, NOISE, start(), told)
    assert np.abs(info.pose - truth)[:, :2].max() < 0.05 and info.finite.all()
    blind = dead_reckoning(jnp.zeros(3), told.odometry)
    assert np.linalg.norm((info.pose - truth)[-1, :2]) < np.linalg.norm((blind - truth)[-1, :2])
    # Feature k is landmark k in all scans: whoever got an id keeps it.
    for ids in np.asarray(info.id).T:
        assert len(set(ids[ids >= 0])) <= 1
    assert np.all(info.id[-1, :8] >= 0) and np.all(info.id[:, 8] == -1)
    assert sorted(np.asarray(belief.id[belief.num_seen > 0])) == list(range(8))


def test_a_nan_run_is_reported_and_leaves_its_neighbours_alone(together):
    good, bad = together
    close(at(bad, slice(0, 2)), at(good, slice(0, 2)), atol=0)
    assert good[1].finite.all() and bad[1].finite[:2].all()
    np.testing.assert_array_equal(bad[1].finite[2], np.arange(T) < 3)
    assert np.isfinite(bad[1].log_likelihood).all()


@pytest.mark.parametrize("field", ["xy", "cov", "direction", "variance"])
def test_a_nan_feature_is_as_good_as_none(logs, field):
    told = logs[0][1]
    k = 7 if field in ("direction", "variance") else 4
    value = getattr(told.features, field).at[2:5, k].set(jnp.nan)
    sick = told._replace(features=told.features._replace(**{field: value}))
    none = told._replace(
        features=told.features._replace(valid=told.features.valid.at[2:5, k].set(False))
    )
    sick, none = (
        slam_filter.run_filter(CONFIG.filter, NOISE, start(), log) for log in (sick, none)
    )
    close(sick, none, atol=0)
    assert sick[1].finite.all()


@pytest.fixture(scope="module")
def objective():
    """Mean squared position error of a drive as a function of the logarithms of the noise."""
    log_noise, unravel = ravel_pytree(jax.tree.map(jnp.log, NOISE))

    def loss(log_noise, told, truth):
        noise = jax.tree.map(jnp.exp, unravel(log_noise))
        _, info = slam_filter.run_filter(CONFIG.filter, noise, start(), told)
        return jnp.mean(jnp.sum((info.pose - truth)[:, :2] ** 2, axis=1)), info.slot

    return log_noise, loss, jax.jit(jax.value_and_grad(loss, has_aux=True))


def test_gradient_of_the_localisation_error_equals_finite_differences(objective, logs):
    log_noise, loss, slope = objective
    truth, told = logs[0]
    (_, slot), ours = slope(log_noise, told, truth)
    assert log_noise.size == 8 and np.all(ours != 0)
    for k, direction in enumerate(1e-4 * np.eye(8)):
        (high, up), (low, down) = (loss(log_noise + s * direction, told, truth) for s in (1, -1))
        np.testing.assert_array_equal(up, slot)
        np.testing.assert_array_equal(down, slot)
        np.testing.assert_allclose(ours[k], (high - low) / 2e-4, rtol=1e-5)


@pytest.mark.parametrize("junk", [7.0, jnp.nan])
def test_padding_is_invisible_in_values_and_gradients(objective, logs, junk):
    log_noise, _, slope = objective
    truth, told = logs[0]
    nodes = told.features
    clean = nodes._replace(valid=nodes.valid.at[:, 6].set(False))  # and 8 never was
    fill = lambda x: x.at[:, jnp.array([6, 8])].set(junk)
    dirty = clean._replace(
        **{name: fill(getattr(nodes, name)) for name in ("xy", "cov", "direction", "variance")}
    )
    clean, dirty = (slope(log_noise, told._replace(features=n), truth) for n in (clean, dirty))
    close(clean, dirty, atol=0)


def test_candidates_do_not_move_the_pose_before_they_are_confirmed(logs):
    _, told = logs[0]
    _, info = slam_filter.run_filter(CONFIG.filter, NOISE, start(), told)
    blind = dead_reckoning(jnp.zeros(3), told.odometry)
    first = CONFIG.filter.confirm_count - 1
    assert np.all(info.id[1, :4] >= 0)  # they are matched, all the same
    assert not info.used[:first].any() and info.used[first, :4].all()
    # The walls came with the second scan, and have to be seen more often.
    np.testing.assert_array_equal(info.used[:, 6], np.arange(T) >= CONFIG.filter.wall_confirm_count)
    np.testing.assert_allclose(info.pose[:first], blind[:first], atol=1e-12)
    assert np.linalg.norm(info.pose[first] - blind[first]) > 1e-4


def test_unconfirmed_landmarks_are_dropped_and_their_slots_used_again(logs):
    _, told = drive(0, only=lambda t: [0, 1] if t < 3 else [])
    belief, seen = start(), []
    _, late = drive(0, only=lambda t: [0, 1, 2, 3] if t == 1 else [0, 1])
    _, other = drive(0, only=lambda t: [4])
    for t in range(T):
        belief, info = stepped(CONFIG, NOISE, belief, at(other if t == 5 else late, t))
        seen.append(np.asarray(belief.num_seen[:5]))
    # 0 and 1 are confirmed; 2 and 3 were seen at the second step only, and outlive two more.
    np.testing.assert_array_equal(np.stack(seen)[1:5, 2:4], [[1, 1], [1, 1], [1, 1], [0, 0]])
    np.testing.assert_array_equal(seen[5][2:5], [1, 0, 0])
    assert np.all(seen[-1][:2] >= CONFIG.filter.confirm_count)
    np.testing.assert_array_equal(belief.id[:3], [0, 1, 4])
    assert belief.next_id == 5


def test_new_landmarks_respect_fresh_and_a_full_map(logs):
    truth, told = logs[0]
    _, info = slam_filter.run_filter(CONFIG.filter, NOISE, start(), told)
    np.testing.assert_array_equal(info.id[0], [0, 1, 2, 3, *[-1] * 5])
    np.testing.assert_array_equal(info.id[1], [*range(8), -1])
    belief = init(SMALL.filter, jnp.zeros(3))
    for t in range(3):
        belief, info = stepped(SMALL, NOISE, belief, at(told, t))
    np.testing.assert_array_equal(info.id, [*range(5), *[-1] * 4])
    np.testing.assert_array_equal(info.slot[5:], 5)
    assert belief.next_id == 5 and np.isfinite(belief.cov).all()


def test_only_the_kinds_of_the_config_are_used(logs):
    _, told = drive(0, only=lambda t: [0, 3, 6, 7])
    belief = init(SMALL.filter, jnp.zeros(3))
    for t in range(2):
        belief, info = stepped(SMALL, NOISE, belief, at(told, t))
    np.testing.assert_array_equal(info.used, np.arange(M) < 2)
    assert info.dof == 4 and belief.next_id == 2


def test_a_run_in_float32_is_close_to_float64(logs):
    told = logs[0][1]
    _, double = slam_filter.run_filter(CONFIG.filter, NOISE, start(), told)
    with jax.enable_x64(False):
        cast = lambda x: jnp.asarray(
            x, jnp.float32 if np.issubdtype(x.dtype, np.floating) else x.dtype
        )
        given = jax.tree.map(cast, (NOISE, start(jnp.float32), told))
        belief, single = slam_filter.run_filter(CONFIG.filter, *given)
        assert belief.cov.dtype == single.pose.dtype == single.nis.dtype == jnp.float32
    np.testing.assert_array_equal(single.slot, double.slot)
    assert double.used.any() and single.finite.all()
    np.testing.assert_allclose(single.pose, double.pose, atol=1e-5)
    np.testing.assert_allclose(single.pose_cov, double.pose_cov, atol=1e-7)


def counters(info):
    names = "fresh", "forgotten", "evicted", "merged"
    return {name: int(n) for name in names if (n := getattr(info, name))}


def test_a_step_counts_candidates_that_are_taken_in_and_forgotten():
    _, told = drive(0, only=lambda t: [0, 1, 2] if t == 0 else [0, 1])
    belief, events = start(), []
    for t in range(5):
        belief, info = stepped(CONFIG, NOISE, belief, at(told, t))
        events.append(counters(info))
    assert events == [{"fresh": 3}, {}, {}, {"forgotten": 1}, {}]


def test_a_full_map_gives_up_idle_candidates_never_what_counts():
    config = SMALL._replace(
        filter=SMALL.filter._replace(
            max_landmarks=3,
            confirm_count=2,
            evict_after=1,
            max_unconfirmed_age=40,
        ),
    )
    _, told = drive(0, only=lambda t: [0, 1, 2] if t < 1 else [0] if t < 3 else [0, 3, 4, 5])
    belief, events = init(config.filter, jnp.zeros(3)), []
    for t in range(5):
        belief, info = stepped(config, NOISE, belief, at(told, t))
        events.append(counters(info))
    # Of three that ask for a slot two get one, and the next step finds none to give up.
    assert events == [{"fresh": 3}, {}, {}, {"fresh": 2, "evicted": 2}, {}]
    np.testing.assert_array_equal(belief.id, [0, 3, 4])
    assert np.isfinite(belief.cov).all()


def test_a_node_in_plain_sight_that_is_missed_is_forgotten():
    config = SMALL._replace(
        filter=SMALL.filter._replace(
            max_misses=2,
            confirm_count=2,
        ),
    )
    # Node 2 is 4.1 m from where it is looked from; from within its circle, it cannot be missed.
    wide = SHAPE[2] * 5
    _, told = drive(0, only=lambda t: [0, 2] if t < 2 else [0])
    shape = jnp.where(told.features.descriptor == SHAPE[2], wide, told.features.descriptor)
    told = told._replace(features=told.features._replace(descriptor=shape))
    belief, events = init(config.filter, jnp.zeros(3)), []
    for t in range(5):
        belief, info = stepped(config, NOISE, belief, at(told, t))
        events.append(counters(info))
    assert events == [{"fresh": 2}, {}, {}, {"forgotten": 1}, {}]
    _, other = drive(0, only=lambda t: [0, 2] if t < 2 else [0])  # from outside it can
    belief, _ = slam_filter.run_filter(
        config.filter, NOISE, init(config.filter, jnp.zeros(3)), other
    )
    np.testing.assert_array_equal(belief.id[belief.num_seen > 0], [0, 1])


def test_two_landmarks_that_are_one_become_the_older():
    config = SMALL._replace(
        filter=SMALL.filter._replace(
            confirm_count=1,
            max_updates=1,
        ),
    )  # the one that is matched is looked at
    _, told = drive(0, only=lambda t: [0])
    belief, _ = stepped(config, NOISE, init(config.filter, jnp.zeros(3)), at(told, 0))
    twin = belief.map_cov[:2, :2] + 1e-3 * jnp.eye(2)
    belief = belief._replace(
        mean=belief.mean.at[5:7].set(belief.mean[3:5] + jnp.array([0.03, 0.02])),
        map_cov=belief.map_cov.at[2:4, 2:4].set(twin),
        num_seen=belief.num_seen.at[1].set(1),
        id=belief.id.at[1].set(7),
        descriptor=belief.descriptor.at[1].set(belief.descriptor[0]),
        next_id=jnp.int32(8),
    )
    before = np.trace(belief.map_cov[:2, :2])
    belief, info = stepped(
        config._replace(
            filter=config.filter._replace(
                association=MERGING,
            ),
        ),
        NOISE,
        belief,
        at(told, 1),
    )
    assert counters(info) == {"merged": 1}
    np.testing.assert_array_equal(belief.id[belief.num_seen > 0], [0])
    assert np.trace(belief.map_cov[:2, :2]) < before


def test_gradients_stay_finite_with_a_full_map_and_a_diverged_neighbour(logs):
    config = SMALL._replace(
        filter=SMALL.filter._replace(
            max_landmarks=3,
            evict_after=0,
            confirm_count=2,
        ),
    )
    log_noise, unravel = ravel_pytree(jax.tree.map(jnp.log, NOISE))
    inputs = jax.tree.map(lambda *x: jnp.stack(x), *[told for _, told in logs])
    truth = jnp.stack([truth for truth, _ in logs])
    broken = inputs._replace(odometry=inputs.odometry.at[1, 3].set(jnp.nan))

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, 0))
    def each(log_noise, told, truth):
        def loss(log_noise):
            noise = jax.tree.map(jnp.exp, unravel(log_noise))
            _, info = slam_filter.run_filter(
                config.filter, noise, init(config.filter, jnp.zeros(3)), told
            )
            off = jnp.where(info.finite[:, None], (info.pose - truth)[:, :2], 0.0)
            return jnp.mean(jnp.sum(off**2, axis=1)), info

        return jax.value_and_grad(loss, has_aux=True)(log_noise)

    (_, info), good = each(log_noise, inputs, truth)
    _, bad = each(log_noise, broken, truth)
    assert np.isfinite(good).all() and np.all(np.any(good != 0, axis=1))
    assert (info.num_new.sum(axis=1) - info.num_evicted.sum(axis=1) <= 3).all()
    np.testing.assert_array_equal(bad[jnp.array([0, 2])], good[jnp.array([0, 2])])
