from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.batching import pad_to
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, increments, relative
from jaxslam.localisation import LocaliseSpec, init, localise, map_of_scans, run_steps, step
from jaxslam.localisation.probability import RIGHT
from jaxslam.simulation import path_following, ray_casting, worlds

SPEC = LocaliseSpec()
LIDAR = Lidar(num_beams=181, angle_increment=np.pi / 180, range_max=15.0, range_std=0.01)
OTHER = Lidar(num_beams=90, angle_min=-1.2, angle_increment=2.4 / 89, range_max=20.0)
NUM_STEPS = 14
STEP = 0.5  # [m] between two scans


def scans_of(lidar, poses, seed=0):
    """Scans [T] of the office from poses (T, 3), with noise."""
    world, noisy = worlds.named("office"), lidar._replace(range_std=0.01)
    scans = jax.jit(jax.vmap(partial(ray_casting.cast, lidar, world)))(jnp.asarray(poses))
    keys = jax.random.split(jax.random.key(seed), len(poses))
    return jax.vmap(lambda key, scan: ray_casting.add_range_noise(key, noisy, scan))(keys, scans)


@pytest.fixture(scope="module")
def drive():
    """Poses (T, 3) of a drive through the office."""
    path = path_following.densify(worlds.waypoints("office"))
    return path_following.poses_along(path, STEP)


@pytest.fixture(scope="module")
def place_map(drive):
    return map_of_scans(SPEC, LIDAR, drive, scans_of(LIDAR, drive))


def beside(drive, start, seed):
    """Poses of a later drive, beside the first one, and its odometry with noise."""
    rng = np.random.default_rng(seed)
    off = np.append(rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.3, 0.3))
    poses = compose(drive[start : start + NUM_STEPS], off)
    odometry = increments(poses) * rng.normal(1.0, 0.02, (NUM_STEPS, 3))
    odometry += rng.normal(0.0, (0.005, 0.005, 0.003), (NUM_STEPS, 3))
    odometry[0] = 0.0
    return poses, odometry


def run(place_map, poses, odometry, pose=None, lidar=LIDAR):
    """State and infos [T] of a drive; padded, so that all drives are one program."""
    count, scans = len(poses), scans_of(lidar, poses, 1)
    scans, odometry = pad_to((scans, jnp.asarray(odometry)), to=2 * NUM_STEPS)
    given = init(SPEC, lidar, pose), scans, odometry, jnp.int32(count)
    state, infos = run_steps(SPEC, lidar, place_map, *given)
    return state, jax.tree.map(lambda x: np.asarray(x)[:count], infos)


def is_right(info, poses, limits=RIGHT):
    off = relative(poses, np.asarray(info.pose))
    return (np.hypot(off[:, 0], off[:, 1]) < limits[0]) & (np.abs(off[:, 2]) < limits[1])


one_step = jax.jit(step, static_argnums=(0, 1))
STARTS = [3, 25, 47, 80, 110]


def test_another_scanner_finds_its_place(drive, place_map):
    poses, odometry = beside(drive, 30, seed=2)
    info = run(place_map, poses, odometry, lidar=OTHER)[1]
    sure = np.asarray(info.probability) > 0.9
    assert is_right(info, poses)[sure].all() and sure[-1]


def test_a_robot_that_is_carried_is_lost_and_found_again(drive, place_map):
    (first, odometry), (second, more) = beside(drive, 20, seed=3), beside(drive, 90, seed=4)
    info = run(place_map, np.concatenate([first, second]), np.concatenate([odometry, more]))[1]
    right = is_right(info, np.concatenate([first, second]))
    sure = np.asarray(info.probability) > 0.9
    assert sure[NUM_STEPS - 1] and right[sure].all() and sure[-1]
    assert np.asarray(info.searched)[NUM_STEPS]


def test_a_start_that_is_known_needs_no_search(drive, place_map):
    poses, odometry = beside(drive, 25, seed=5)
    info = run(place_map, poses, odometry, pose=compose(poses[0], np.array([0.2, -0.2, 0.1])))[1]
    assert is_right(info, poses).all() and not np.asarray(info.searched)[0]


def test_a_start_that_is_wrong_is_corrected(drive, place_map):
    poses, odometry = beside(drive, 25, seed=5)
    info = run(place_map, poses, odometry, pose=drive[90])[1]
    sure = np.asarray(info.probability) > 0.9
    assert is_right(info, poses)[sure].all() and sure[-1]


def test_a_robot_outside_of_the_map_is_not_sure(drive):
    part = drive[:30]
    place_map = map_of_scans(SPEC, LIDAR, part, scans_of(LIDAR, part))
    poses, odometry = beside(drive, 100, seed=6)
    assert np.hypot(*(poses[:, None, :2] - part[None, :, :2]).T).min() > 2.0
    assert (run(place_map, poses, odometry)[1].probability < 0.9).all()


def test_localisation_moves_with_the_map(drive, place_map):
    poses, odometry = beside(drive, 47, seed=47)
    move = np.array([31.0, -12.0, np.pi])
    moved = map_of_scans(SPEC, LIDAR, compose(move, drive), scans_of(LIDAR, drive))
    info = run(moved, poses, odometry)[1]
    assert is_right(info, compose(move, poses), (0.1, 0.02))[-5:].all()


@pytest.fixture(scope="module")
def robots(drive):
    """Scans [B, T] and odometry (B, T, 3) of robots that start at different places."""
    drives = [beside(drive, start, seed=start) for start in STARTS]
    scans = [scans_of(LIDAR, poses, seed=1) for poses, _ in drives]
    together = jax.tree.map(lambda *x: jnp.stack(x), *scans)
    return together, jnp.asarray(np.stack([odometry for _, odometry in drives]))


@jax.jit
def run_all(place_map, scans, odometry):
    """Infos [T, B], vectorised as on an accelerator; `vmap` of `step` is a loop on a CPU."""
    states = jax.vmap(lambda _: init(SPEC, LIDAR))(odometry[:, 0])
    steps = jax.vmap(partial(localise._step, SPEC, LIDAR), in_axes=(None, 0, 0, 0))

    def body(states, now):
        return steps(place_map, states, *now)

    by_time = jax.tree.map(lambda x: x.swapaxes(0, 1), (scans, odometry))
    return jax.lax.scan(body, states, by_time)[1]


@pytest.fixture(scope="module")
def together(place_map, robots):
    """Their infos [T, B]."""
    return run_all(place_map, *robots)


@pytest.mark.slow
def test_robots_are_found_anywhere_and_tracked(drive, together):
    info = together
    poses = np.stack([beside(drive, start, seed=start)[0] for start in STARTS], axis=1)
    off = relative(poses, np.asarray(info.pose))
    distance, angle = np.hypot(off[..., 0], off[..., 1]), np.abs(off[..., 2])
    sure = np.asarray(info.probability) > 0.9
    assert (distance[sure] < RIGHT[0]).all() and (angle[sure] < RIGHT[1]).all()
    assert sure[NUM_STEPS // 2 :].all()
    assert np.percentile(distance[sure], 95) < 0.1
    assert np.percentile(angle[sure], 95) < np.radians(1.0)


@pytest.mark.slow
def test_a_batch_is_the_same_as_its_robots_one_after_the_other(place_map, robots, together):
    scans, odometry = robots
    states = jax.vmap(lambda _: init(SPEC, LIDAR))(odometry[:, 0])
    steps = jax.jit(jax.vmap(partial(step, SPEC, LIDAR), in_axes=(None, 0, 0, 0)))
    looped = steps(place_map, states, jax.tree.map(lambda x: x[:, 0], scans), odometry[:, 0])[1]
    for of_all, of_loop in zip(together, looped, strict=True):
        np.testing.assert_allclose(of_all[0], of_loop, atol=1e-6)
    assert len(np.unique(np.asarray(together.searched).sum(axis=1))) > 1  # some robots, not all
    for k in range(len(odometry)):
        state = init(SPEC, LIDAR)
        for t in range(NUM_STEPS):
            scan = jax.tree.map(lambda x: x[k, t], scans)  # noqa: B023
            state, alone = one_step(SPEC, LIDAR, place_map, state, scan, odometry[k, t])
            for of_all, of_one in zip(together, alone, strict=True):
                np.testing.assert_allclose(of_all[t, k], of_one, atol=1e-6)


@pytest.mark.slow
def test_what_is_not_finite_stays_with_its_robot(place_map, robots, together):
    scans, odometry = robots
    bad = Scan(scans.ranges.at[1, 4].set(jnp.nan), scans.hit.at[1, 4].set(True))
    hurt = run_all(place_map, bad, odometry.at[1, 6].set(jnp.nan))
    for before, after in zip(together, hurt, strict=True):
        assert np.isfinite(after).all()
        np.testing.assert_array_equal(np.delete(after, 1, axis=1), np.delete(before, 1, axis=1))
    assert hurt.probability[-1, 1] > 0.9  # and found again


def test_padding_leaves_the_state(drive, place_map):
    poses, odometry = beside(drive, 25, seed=5)
    scans, odometry = scans_of(LIDAR, np.tile(poses, (2, 1))), np.tile(odometry, (2, 1))
    given = place_map, init(SPEC, LIDAR), scans, jnp.asarray(odometry), jnp.int32(5)
    padded = run_steps(SPEC, LIDAR, *given)[0]
    state = init(SPEC, LIDAR)
    for k in range(5):
        scan = jax.tree.map(lambda x: x[k], scans)  # noqa: B023
        state, _ = one_step(SPEC, LIDAR, place_map, state, scan, odometry[k])
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-9), padded, state)


def test_a_scan_without_any_return_is_no_evidence(drive, place_map):
    state = run(place_map, *beside(drive, 25, seed=5))[0]
    nothing = Scan(np.full(LIDAR.num_beams, LIDAR.range_max), np.zeros(LIDAR.num_beams, bool))
    after, info = one_step(SPEC, LIDAR, place_map, state, nothing, np.array([0.2, 0.0, 0.0]))
    assert not info.searched and not after.lost
    np.testing.assert_array_equal(after.hypotheses.log_weight, state.hypotheses.log_weight)


def test_arguments_are_checked(drive, place_map):
    scan = jax.tree.map(lambda x: x[0], scans_of(LIDAR, drive[:1]))
    state = init(SPEC, LIDAR)
    with pytest.raises(ValueError, match=r"pose is \[nan"):
        init(SPEC, LIDAR, [np.nan, 0.0, 0.0])
    with pytest.raises(ValueError, match="scan"):
        step(SPEC, OTHER, place_map, state, scan, np.zeros(3))
    with pytest.raises(ValueError, match="odometry"):
        step(SPEC, LIDAR, place_map, state, scan, np.zeros(2))
    with pytest.raises(ValueError, match=r"spec\.memory is 2"):
        init(SPEC._replace(memory=2), LIDAR)
    with pytest.raises(ValueError, match=r"spec\.gates"):
        init(SPEC._replace(gates=(0.0,)), LIDAR)
