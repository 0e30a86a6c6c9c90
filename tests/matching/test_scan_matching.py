from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from simulated_scans import CORRIDOR, LIDAR, item, odometry_of, scans_of

from jaxslam.core import se2_np
from jaxslam.core.scan import Scan
from jaxslam.core.se2 import compose
from jaxslam.frontend import lidar
from jaxslam.matching import fuse_odometry, oriented_points
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.scan_matching import empty_submap, match_scan, match_scans
from jaxslam.simulation import path_following, worlds

SPEC = ScanMatchSpec(window_scans=8)
STEPS, CHUNK = 16, 6  # scans of the drive, and of the program that most tests share


@pytest.fixture(scope="module")
def drive():
    """Half a metre a scan through the office, where it turns as well."""
    path = path_following.densify(worlds.waypoints("office"))
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    driven = np.linspace(8.0, 8.0 + 0.5 * STEPS, STEPS)
    x, y = (np.interp(driven, along, column) for column in path.T)
    ahead = [np.interp(driven + 0.3, along, column) for column in path.T]
    poses = jnp.stack([x, y, np.arctan2(ahead[1] - y, ahead[0] - x)], axis=1)
    return poses, scans_of(worlds.named("office"), poses, LIDAR.range_std)


def matches_of(scans, odometry):
    """Matches of all scans, in chunks of one length; after the last the robot stands still."""
    submap, found = empty_submap(SPEC, LIDAR), []
    for first in range(0, len(odometry), CHUNK):
        some, motion = (item(x, slice(first, first + CHUNK)) for x in (scans, odometry))
        count = len(motion)
        if more := CHUNK - count:
            some = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], more, 0)]), some)
            motion = np.concatenate([motion, np.zeros((more, 3))])
        submap, matches = match_scans(SPEC, LIDAR, submap, some, motion, count)
        found.append(item(jax.tree.map(np.asarray, matches), slice(count)))
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


def test_the_first_submap_has_the_types_of_all_later_ones(drive):
    """With another weak type the matcher would be compiled once more, for the first chunk alone."""
    scans, first = item(drive[1], slice(CHUNK)), empty_submap(SPEC, LIDAR)
    run = partial(match_scans, SPEC, LIDAR)
    later = jax.eval_shape(run, first, scans, jnp.zeros((CHUNK, 3)))[0]
    types = [jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), x) for x in (first, later)]
    assert types[0] == types[1]


def test_increments_of_slipping_wheels_are_corrected(drive):
    poses, scans = drive
    true = np.asarray(odometry_of(poses))
    rng = np.random.default_rng(0)
    slip = np.array([0.05, 0.03, 0.2]) * rng.uniform(-1, 1, true.shape)
    slip[0] = 0.0
    found = matches_of(scans, true + slip)
    error = se2_np.relative(true, found.increment)
    assert np.hypot(*error[:, :2].T).max() < 0.02
    assert np.degrees(np.abs(error[:, 2])).max() < 0.3
    assert np.asarray(found.inlier_fraction)[1:].min() > 0.6
    by_odometry = se2_np.relative(true, true + slip)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(by_odometry**2))


def test_the_information_agrees_with_the_errors(drive):
    """Of many draws of the range noise: the errors lie within what `point_std` = 0.1 m allows."""
    poses, _ = drive
    pair, true = poses[3:5], np.asarray(odometry_of(poses[3:5]))
    found = [matches_of(scans_of(worlds.named("office"), pair, 0.01, k), true) for k in range(40)]
    error = np.stack([se2_np.relative(true[1], match.increment[1]) for match in found])
    information = np.mean([match.information[1] for match in found], axis=0)
    square = np.einsum("ni,ij,nj->n", error, information, error)
    # Independent errors of 1 cm would make it 3 (0.01 / 0.1)^2; it is of that size.
    assert 0.1 * 0.03 < square.mean() < 3.0
    assert np.linalg.eigvalsh(information)[0] > 0.0


oriented_points_of = jax.jit(oriented_points.oriented_points, static_argnums=0)


def slow_cost(poses, scans, k):
    """Robust cost of the pose of scan k against all points of the scans before, by a k-d tree."""
    clouds, normals = [], []
    for i in range(k):
        surface = oriented_points_of(LIDAR, item(scans, i))
        use = np.asarray(surface.valid)
        c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        turned = np.asarray(surface.points)[use] @ np.array([[c, s], [-s, c]])
        clouds.append(turned + poses[i, :2])
        normals.append(np.asarray(surface.normal)[use] @ np.array([[c, s], [-s, c]]))
    trees = [cKDTree(cloud) for cloud in clouds]
    scan = item(scans, k)
    own = np.asarray(lidar.beam_ends(LIDAR, scan))[np.asarray(scan.hit)]

    def cost(pose):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        registered = own @ np.array([[c, s], [-s, c]]) + pose[:2]
        total, count = np.zeros(len(own)), np.zeros(len(own))
        for tree, cloud, normal in zip(trees, clouds, normals, strict=True):
            distance, nearest = tree.query(registered)
            error = np.sum((registered - cloud[nearest]) * normal[nearest], axis=1)
            near = distance < 0.15
            square = (error / 0.05) ** 2
            total += np.where(near, square / (1 + square), 1.0)
            count += 1
        return np.sum(total / count)

    return cost


def test_it_ends_where_an_independent_search_does(drive):
    poses, scans = drive
    found = matches_of(scans, odometry_of(poses))
    matched = [np.zeros(3)]
    for increment in found.increment[1:]:
        matched.append(se2_np.compose(matched[-1], increment))
    matched = np.array(matched)
    for k in (3, 6):
        cost = slow_cost(matched, scans, k)
        best = minimize(cost, matched[k] + np.array([0.01, -0.01, 0.005]), method="Nelder-Mead")
        off = se2_np.relative(matched[k], best.x)
        assert np.hypot(*off[:2]) < 0.006 and abs(off[2]) < 0.003


def test_a_bare_corridor_does_not_constrain_the_position_along_it():
    poses = jnp.array([[0.4 * k, 0.0, 0.1] for k in range(6)])
    true = odometry_of(poses)
    wheels = true.at[1:].add(jnp.array([0.04, 0.03, 0.05]))
    found = matches_of(scans_of(CORRIDOR, poses, 0.005), wheels)
    true, wheels, fuse = np.asarray(true), np.asarray(wheels), jax.jit(fuse_odometry)
    along = np.array([np.cos(0.1), -np.sin(0.1), 0.0])  # frame of the robot
    across = np.array([np.sin(0.1), np.cos(0.1), 0.0])
    noise = np.diag(np.array([0.05, 0.05, 0.05]) ** 2)
    for k in range(1, 6):
        match = item(jax.tree.map(np.asarray, found), k)
        assert along @ match.information @ along < 0.01 * (across @ match.information @ across)
        fused, cov = fuse(jnp.asarray(0.3), wheels[k], noise, match)
        off = fused - true[k]
        assert abs(off @ across) < 0.01 and abs(off[2]) < 0.01
        assert abs((fused - wheels[k]) @ along) < 0.01
        assert along @ cov @ along > 0.8 * 0.05**2 and across @ cov @ across < 0.2 * 0.05**2


def test_increments_do_not_depend_on_the_pose_in_the_world(drive):
    poses, scans = drive
    wheels = odometry_of(poses) + 0.02
    moved = jax.vmap(lambda pose: compose(jnp.array([5.0, -3.0, 2.0]), pose))(poses)
    np.testing.assert_allclose(odometry_of(moved), odometry_of(poses), atol=1e-9)
    once = matches_of(scans, wheels)
    submap = empty_submap(SPEC, LIDAR)._replace(last_pose=jnp.array([5.0, -3.0, 2.0]))
    step = jax.jit(match_scan, static_argnums=(0, 1))
    for k in range(4):
        submap, match = step(SPEC, LIDAR, submap, item(scans, k), wheels[k])
        np.testing.assert_allclose(match.increment, once.increment[k], atol=1e-6)
        np.testing.assert_allclose(match.information, once.information[k], rtol=1e-4, atol=1e-3)


def test_scans_without_returns_give_the_odometry():
    blind = Scan(
        jnp.full((3, LIDAR.num_beams), LIDAR.range_max), jnp.zeros((3, LIDAR.num_beams), bool)
    )
    wheels = jnp.array([[0.0, 0.0, 0.0], [0.5, 0.1, 0.2], [0.3, 0.0, -3.0]])
    found = matches_of(blind, wheels)
    np.testing.assert_allclose(found.increment, wheels, atol=1e-6)
    assert not np.asarray(found.information).any() and not np.asarray(found.inlier_fraction).any()


def refusals():
    """What is given in place of a right argument, and what the message says."""
    scans = Scan(np.ones((3, 181)), np.ones((3, 181), bool))
    return {
        "beams": (dict(scans=item(scans, np.s_[:, :90])), r"scans.ranges is .*\(3, 90\), not"),
        "hits": (dict(scans=scans._replace(hit=scans.ranges)), r"scans.hit is float64 \(3, 181\)"),
        "raw": (dict(scans=scans.ranges), "scans is a ndarray, not a Scan"),
        "length": (dict(scans=item(scans, np.s_[:2])), r"\(2, 181\), not floating \(3, 181\)"),
        "odometry": (dict(odometry=np.zeros((3, 2))), r"odometry is .*\(3, 2\), not"),
        "words": (dict(odometry=[["a", "b", "c"]] * 3), "odometry is .* not numbers"),
        "window": (dict(spec=ScanMatchSpec()), r"submap.poses is .*\(8, 3\), not .*\(25, 3\)"),
        "range": (dict(spec=SPEC._replace(max_beams=0)), "spec.max_beams is 0, not 1 or more"),
        "std": (dict(spec=SPEC._replace(point_std=0.0)), "spec.point_std is 0.0, not a finite"),
        "gates": (dict(spec=SPEC._replace(fine_gates=())), "spec.fine_gates is empty"),
        "list": (dict(spec=SPEC._replace(fine_gates=[0.1])), "spec must hold tuples"),
        "order": (dict(spec=LIDAR), "spec is a Lidar, not a ScanMatchSpec"),
        "submap": (dict(submap=None), "submap is a NoneType, not a Submap"),
        "count": (dict(count=4), "count is 4, not 0 to 3"),
        "half": (dict(count=1.5), "count is 1.5, not a whole number"),
    }


@pytest.mark.parametrize("case", refusals())
def test_wrong_arguments_are_refused_by_name(case):
    wrong, message = refusals()[case]
    right = dict(
        spec=SPEC, lidar=LIDAR, submap=empty_submap(SPEC, LIDAR), odometry=np.zeros((3, 3))
    )
    right["scans"] = Scan(np.ones((3, 181)), np.ones((3, 181), bool))
    with pytest.raises(ValueError, match=message):
        match_scans(**right | wrong)


def test_match_scan_refuses_several_scans_and_other_beams():
    submap = empty_submap(SPEC, LIDAR)
    scan = Scan(np.ones(181), np.ones(181, bool))
    with pytest.raises(ValueError, match=r"scan.ranges is .*\(3, 181\), not .*\(181,\)"):
        several = Scan(np.ones((3, 181)), np.ones((3, 181), bool))
        match_scan(SPEC, LIDAR, submap, several, np.zeros(3))
    with pytest.raises(ValueError, match=r"odometry is .*\(2,\), not .*\(3,\)"):
        match_scan(SPEC, LIDAR, submap, scan, np.zeros(2))
    with pytest.raises(ValueError, match=r"oriented_points.valid is bool \(8, 181\), not"):
        match_scan(SPEC, LIDAR._replace(num_beams=91), submap, scan, np.zeros(3))


def test_lists_numpy_and_jax_of_either_precision_give_the_same(drive):
    _, scans = drive
    scans, odometry = item(jax.tree.map(np.asarray, scans), slice(CHUNK)), np.zeros((CHUNK, 3))
    scans = scans._replace(ranges=scans.ranges.astype(np.float32).astype(float))
    match = partial(match_scans, SPEC, LIDAR, empty_submap(SPEC, LIDAR))
    _, expected = match(scans, odometry, CHUNK)
    to_list = Scan(scans.ranges.tolist(), scans.hit.tolist())
    single = scans._replace(ranges=scans.ranges.astype(np.float32))
    for given in (to_list, single, jax.tree.map(jnp.asarray, single)):
        _, found = match(given, odometry.astype(int).tolist(), CHUNK)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
