from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose, relative, transform
from jaxslam.frontend import lidar
from jaxslam.matching import oriented_points, scan_matching
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.simulation import path_following, ray_casting, worlds
from jaxslam.simulation.worlds import World

LIDAR = Lidar(num_beams=181, angle_increment=np.pi / 180, range_max=15.0, range_std=0.01)
SPEC = ScanMatchSpec(window_scans=8)
STEPS = 16
CORRIDOR = World(jnp.array([[-60.0, 1.0, 60.0, 1.0], [60.0, -1.2, -60.0, -1.2]]))


@partial(jax.jit, static_argnames="noise")
def scans_of(place, poses, noise=0.0, seed=0):
    """Scans [T] from poses (T, 3)."""
    seen = jax.vmap(ray_casting.cast, in_axes=(None, 0, None))(place, poses, LIDAR)
    keys = jax.random.split(jax.random.key(seed), len(poses))
    loud = LIDAR._replace(range_std=noise)
    return jax.vmap(ray_casting.add_range_noise, in_axes=(0, 0, None))(keys, seen, loud)


@jax.jit
def motions_of(poses):
    return jnp.concatenate([jnp.zeros((1, 3)), jax.vmap(relative)(poses[:-1], poses[1:])])


@pytest.fixture(scope="module")
def drive():
    """Half a metre a scan through the office, where it turns as well."""
    path = path_following.densify(worlds.waypoints("office"))
    way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.linspace(8.0, 8.0 + 0.5 * STEPS, STEPS)
    x, y = (np.interp(at, way, column) for column in path.T)
    ahead = [np.interp(at + 0.3, way, column) for column in path.T]
    poses = jnp.stack([x, y, np.arctan2(ahead[1] - y, ahead[0] - x)], axis=1)
    return poses, scans_of(worlds.named("office"), poses, LIDAR.range_std)


def odometry(scans, wheels):
    return scan_matching.match_scans(
        SPEC, LIDAR, scan_matching.empty_submap(SPEC, LIDAR), scans, wheels
    )[1]


def test_surfaces_are_the_walls_a_scan_sees():
    pose = jnp.array([3.0, 0.2, 0.4])
    (scan,) = [jax.tree.map(lambda x: x[0], scans_of(CORRIDOR, pose[None]))]
    found = jax.jit(oriented_points.oriented_points, static_argnums=1)(scan, LIDAR)
    points = np.asarray(transform(pose, found.points))[found.valid]
    normal = np.asarray(found.normal)[found.valid]
    across = np.array([np.sin(0.4), np.cos(0.4)])  # of the corridor, robot frame
    np.testing.assert_allclose(np.abs(normal @ across), 1.0, atol=1e-6)
    assert np.min(np.abs(points[:, 1:] - [1.0, -1.2]), axis=1).max() < 1e-6
    assert found.valid.sum() > 120
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-12)


def test_a_surface_ends_at_a_jump():
    """A door in a wall: the points of the wall behind have normals of their own."""
    ranges = np.where(np.abs(lidar.beam_angles(LIDAR)) < 0.3, 6.0, 2.0) / np.cos(
        np.clip(lidar.beam_angles(LIDAR), -1.2, 1.2)
    )
    found = oriented_points.oriented_points(LIDAR, lidar.to_scan(LIDAR, jnp.asarray(ranges)))
    steep = np.abs(np.asarray(lidar.beam_angles(LIDAR))) < 1.1
    use = np.asarray(found.valid) & steep
    assert use.sum() > 0.95 * steep.sum()
    np.testing.assert_allclose(np.abs(found.normal[use, 0]), 1.0, atol=1e-6)
    assert np.asarray(found.neighbour_gap)[use].max() < 1.0


def test_motions_of_wheels_that_slip_are_found(drive):
    poses, scans = drive
    true = motions_of(poses)
    rng = np.random.default_rng(0)
    off = np.array([0.05, 0.03, 0.2]) * rng.uniform(-1, 1, true.shape)
    off[0] = 0.0
    found = odometry(scans, true + off)
    error = np.asarray(jax.vmap(relative)(true, found.increment))
    assert np.hypot(*error[:, :2].T).max() < 0.02
    assert np.degrees(np.abs(error[:, 2])).max() < 0.3
    assert np.asarray(found.inlier_fraction)[1:].min() > 0.6
    blind = np.asarray(jax.vmap(relative)(true, true + off))
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(blind**2))


def test_the_information_is_as_large_as_the_errors(drive):
    """Of many draws of the range noise: the errors lie within what `noise` = 0.1 m allows."""
    poses, _ = drive
    pair, true = poses[3:5], motions_of(poses[3:5])
    found = [odometry(scans_of(worlds.named("office"), pair, 0.01, k), true) for k in range(40)]
    error = np.stack([relative(true[1], one.increment[1]) for one in found])
    information = np.mean([one.information[1] for one in found], axis=0)
    square = np.einsum("ni,ij,nj->n", error, information, error)
    # Independent errors of 1 cm would make it 3 (0.01 / 0.1)^2; it is of that size, not of noise.
    assert 0.1 * 0.03 < square.mean() < 3.0
    assert np.linalg.eigvalsh(information)[0] > 0.0


def slow_cost(poses, scans, k):
    """Robust cost of the pose of scan k against all points of the scans before, by a k-d tree."""
    clouds, normals = [], []
    for i in range(k):
        surface = oriented_points.oriented_points(LIDAR, jax.tree.map(lambda x: x[i], scans))  # noqa: B023
        use = np.asarray(surface.valid)
        clouds.append(np.asarray(transform(poses[i], surface.points))[use])
        c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        normals.append(np.asarray(surface.normal)[use] @ np.array([[c, s], [-s, c]]))
    trees = [cKDTree(cloud) for cloud in clouds]
    one = jax.tree.map(lambda x: x[k], scans)
    own = np.asarray(lidar.beam_ends(LIDAR, one))[np.asarray(one.hit)]

    def cost(pose):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        there = own @ np.array([[c, s], [-s, c]]) + pose[:2]
        total, count = np.zeros(len(own)), np.zeros(len(own))
        for tree, cloud, normal in zip(trees, clouds, normals, strict=True):
            away, at = tree.query(there)
            error = np.sum((there - cloud[at]) * normal[at], axis=1)
            near = away < 0.15
            square = (error / 0.05) ** 2
            total += np.where(near, square / (1 + square), 1.0)
            count += 1
        return np.sum(total / count)

    return cost


def test_it_ends_where_an_independent_search_does(drive):
    poses, scans = drive
    found = odometry(scans, motions_of(poses))
    way = [np.zeros(3)]
    for motion in found.increment[1:]:
        way.append(np.asarray(compose(jnp.asarray(way[-1]), motion)))
    way = jnp.asarray(np.array(way))
    for k in (3, 6):
        cost = slow_cost(way, scans, k)
        best = minimize(cost, way[k] + np.array([0.01, -0.01, 0.005]), method="Nelder-Mead")
        off = np.asarray(relative(way[k], jnp.asarray(best.x)))
        assert np.hypot(*off[:2]) < 0.006 and abs(off[2]) < 0.003


def test_a_bare_corridor_says_nothing_of_the_way_along_it():
    poses = jnp.array([[0.4 * k, 0.0, 0.1] for k in range(6)])
    true = motions_of(poses)
    wheels = true.at[1:].add(jnp.array([0.04, 0.03, 0.05]))
    found = odometry(scans_of(CORRIDOR, poses, 0.005), wheels)
    true, wheels, fuse = np.asarray(true), np.asarray(wheels), jax.jit(scan_matching.fuse_odometry)
    along = np.array([np.cos(0.1), -np.sin(0.1), 0.0])  # frame of the robot
    across = np.array([np.sin(0.1), np.cos(0.1), 0.0])
    noise = np.diag(np.array([0.05, 0.05, 0.05]) ** 2)
    for k in range(1, 6):
        one = jax.tree.map(lambda x: np.asarray(x)[k], found)  # noqa: B023
        assert along @ one.information @ along < 0.01 * (across @ one.information @ across)
        motion, cov = fuse(wheels[k], noise, one, jnp.asarray(0.3))
        off = motion - true[k]
        assert abs(off @ across) < 0.01 and abs(off[2]) < 0.01
        assert abs((motion - wheels[k]) @ along) < 0.01
        assert along @ cov @ along > 0.8 * 0.05**2 and across @ cov @ across < 0.2 * 0.05**2


def test_motions_do_not_depend_on_where_the_world_lies(drive):
    poses, scans = drive
    wheels = motions_of(poses) + 0.02
    moved = jax.vmap(lambda pose: compose(jnp.array([5.0, -3.0, 2.0]), pose))(poses)
    np.testing.assert_allclose(motions_of(moved), motions_of(poses), atol=1e-9)
    once = odometry(scans, wheels)
    local = scan_matching.empty_submap(SPEC, LIDAR)._replace(last_pose=jnp.array([5.0, -3.0, 2.0]))
    step = jax.jit(scan_matching.match_scan, static_argnums=(0, 1))
    for k in range(4):
        local, one = step(SPEC, LIDAR, local, jax.tree.map(lambda x: x[k], scans), wheels[k])  # noqa: B023
        np.testing.assert_allclose(one.increment, once.increment[k], atol=1e-6)
        np.testing.assert_allclose(one.information, once.information[k], rtol=1e-4, atol=1e-3)


def test_scans_that_see_nothing_leave_the_wheels_alone():
    blind = Scan(
        jnp.full((3, LIDAR.num_beams), LIDAR.range_max), jnp.zeros((3, LIDAR.num_beams), bool)
    )
    wheels = jnp.array([[0.0, 0.0, 0.0], [0.5, 0.1, 0.2], [0.3, 0.0, -3.0]])
    found = odometry(blind, wheels)
    np.testing.assert_allclose(found.increment, wheels, atol=1e-6)
    assert not np.asarray(found.information).any() and not np.asarray(found.inlier_fraction).any()


def some_aligned(rank):
    a = np.random.default_rng(1).normal(size=(rank, 3)) * 30
    return ScanMatch(jnp.array([0.52, 0.03, 0.4]), jnp.asarray(a.T @ a), jnp.asarray(0.9))


def test_fused_motions_are_those_of_a_kalman_update():
    wheels, scale = jnp.array([0.5, 0.0, 0.3]), 0.7
    noise = np.diag([0.03, 0.02, 0.05]) ** 2 + 1e-5
    aligned = some_aligned(3)
    motion, cov = scan_matching.fuse_odometry(
        wheels, jnp.asarray(noise), aligned, jnp.asarray(scale)
    )
    prior = noise + np.diag(
        [*[scan_matching.FUSION_STD_FLOOR[0] ** 2] * 2, scan_matching.FUSION_STD_FLOOR[1] ** 2]
    )
    r = scale**2 * np.linalg.inv(aligned.information)
    gain = prior @ np.linalg.inv(prior + r)
    np.testing.assert_allclose(motion, wheels + gain @ (aligned.increment - wheels), rtol=1e-9)
    np.testing.assert_allclose(cov, prior - gain @ prior, rtol=1e-7)


def test_fusing_with_nothing_changes_nothing_and_headings_are_wrapped():
    wheels, noise = jnp.array([0.5, 0.0, 3.1]), jnp.diag(jnp.array([1e-4, 2e-4, 3e-4]))
    nothing = some_aligned(3)._replace(information=jnp.zeros((3, 3)))
    motion, cov = scan_matching.fuse_odometry(wheels, noise, nothing, jnp.asarray(1.0))
    np.testing.assert_array_equal(motion, wheels)
    np.testing.assert_array_equal(cov, noise)
    beyond = some_aligned(3)._replace(increment=jnp.array([0.5, 0.0, -3.1]))
    motion, _ = scan_matching.fuse_odometry(wheels, noise, beyond, jnp.asarray(1.0))
    assert 3.1 < motion[2] < 2 * np.pi - 3.1


@pytest.mark.parametrize("rank", [0, 1, 3])
def test_gradients_of_fused_motions_are_finite_and_right(rank):
    wheels = jnp.array([0.5, 0.1, 0.3])
    aligned = some_aligned(rank) if rank else some_aligned(1)
    aligned = aligned if rank else aligned._replace(information=jnp.zeros((3, 3)))

    @jax.jit
    def value(scale, spread):
        noise = jnp.diag(spread * jnp.array([1.0, 0.5, 2.0]))
        motion, cov = scan_matching.fuse_odometry(wheels, noise, aligned, scale)
        return jnp.sum(motion**2) + jnp.sum(cov)

    given = jnp.asarray(0.7), jnp.asarray(1e-3)
    slope = jax.jit(jax.grad(value, argnums=(0, 1)))(*given)
    for i in range(2):
        step = 1e-4 * given[i]
        up, down = (list(given) for _ in range(2))
        up[i], down[i] = given[i] + step, given[i] - step
        expected = (value(*up) - value(*down)) / (2 * step)
        np.testing.assert_allclose(slope[i], expected, rtol=1e-5, atol=1e-9)
