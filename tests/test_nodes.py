import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import edges, junctions, lidar, nodes, slam, world
from jaxslam.geometry import compose, to_robot, to_world, wrap_angle, wrap_line
from jaxslam.slam import Config
from jaxslam.types import CORNER, NODE, WALL
from jaxslam.world import World

CONFIG = Config()
LIDAR, SPEC = CONFIG.lidar, CONFIG.nodes
LEG = 3 * np.sqrt(3)  # [m] height of a triangle with sides of 6 m
TRIANGLE = world.polyline([(0, 0), (LEG, -3), (LEG, 3), (0, 0)])
CENTRE, RADIUS = np.array([2 * LEG / 3, 0.0]), LEG / 3
IN_TRIANGLE = np.array([1.5, 0.3, 0.05])
BOX = (-1.5, -2.0, 4.0, 3.0)
SLOPE = 2 / np.tan(np.radians(37))
SHED = [(0, 0), (5, 0), (5, 3), (5 - SLOPE, 5), (0, 5), (0, 0)]  # one wall at 143 degrees

front_end = jax.jit(slam.front_end, static_argnums=0)
cast = jax.jit(lidar.cast, static_argnums=2)


def scan_of(walls, pose):
    return cast(World(jnp.asarray(walls)), jnp.asarray(pose), LIDAR)


def features(walls, pose):
    """Features of a noise-free scan, and those of each kind that are valid."""
    found = front_end(CONFIG, scan_of(walls, pose))
    of = lambda kind: jax.tree.map(
        lambda x: np.asarray(x)[np.asarray(found.valid & (found.kind == kind))], found
    )
    return found, of(NODE), of(CORNER), of(WALL)


def near(place, runs):
    """Runs (K,) bool about as far from a place as the nearest."""
    away = junctions.feet(place[0], place[1], junctions.walls_of(runs)).distance
    return away < jnp.min(away) + 0.5


@jax.jit
def circle(scan, place):
    runs = edges.runs(scan, LIDAR, CONFIG.runs)
    return junctions.tangent_circle(place, near(place, runs), runs, SPEC)


def test_the_incircle_of_a_triangle_is_exact_from_any_start():
    want = to_robot(IN_TRIANGLE, jnp.array(CENTRE))
    for off in ([0.0, 0.0], [0.15, -0.1], [-0.1, 0.2]):
        found = circle(scan_of(TRIANGLE, IN_TRIANGLE), want + jnp.array(off))
        np.testing.assert_allclose(found.centre, want, atol=1e-6)
        np.testing.assert_allclose(found.radius, RADIUS, atol=1e-6)
        np.testing.assert_allclose(found.spread, 2 * np.pi / 3, atol=1e-6)
        assert found.touched.sum() == 3 and found.real


def test_the_front_end_finds_the_one_node_of_a_triangle():
    pose = np.array([1.0, 0.2, 0.05])
    _, node, corner, wall = features(TRIANGLE / 1.5, pose)
    assert len(node.xy) == 1 and node.degree == 3
    np.testing.assert_allclose(to_world(pose, node.xy), CENTRE[None] / 1.5, atol=1e-6)
    np.testing.assert_allclose(node.shape, RADIUS / 1.5, atol=1e-6)
    np.testing.assert_allclose(corner.shape, np.pi / 3, atol=1e-6)
    assert len(wall.direction) == 3


def test_corners_of_a_room_are_exact_and_face_into_it():
    pose = np.array([0.3, 0.2, 0.1])
    _, _, corner, _ = features(world.outline([BOX]), pose)
    place = np.asarray(to_world(pose, corner.xy))
    order = np.argsort(place[:, 1])
    np.testing.assert_allclose(place[order], [[4.0, -2.0], [4.0, 3.0]], atol=1e-6)
    np.testing.assert_allclose(corner.shape, np.pi / 2, atol=1e-6)  # concave
    facing = wrap_angle(corner.direction[order] + pose[2])
    np.testing.assert_allclose(facing, np.array([3, -3]) * np.pi / 4, atol=1e-6)


def test_convex_corners_are_told_from_concave_ones_by_their_shape():
    _, _, corner, _ = features(world.named("fig04").walls, np.array([0.0, 0.0, 0.0]))
    convex = corner.shape > np.pi
    assert convex.sum() == 1 and np.sum(~convex) >= 1
    np.testing.assert_allclose(corner.xy[convex], [[1.4, 0.3]], atol=1e-6)
    np.testing.assert_allclose(corner.shape[convex], 1.5 * np.pi, atol=1e-6)
    np.testing.assert_allclose(wrap_angle(corner.direction[convex]), -0.75 * np.pi, atol=1e-6)


@pytest.mark.parametrize("heading", [0.3, 1.0, 1.9])
def test_wall_directions_are_the_worlds_also_at_37_degrees(heading):
    _, _, _, wall = features(world.polyline(SHED), np.array([1.2, 1.1, heading]))
    seen = np.asarray(wrap_line(wall.direction + heading))
    for true in np.radians([0.0, 90.0, 143.0]):
        assert np.abs(np.asarray(wrap_line(seen - true))).min() < 1e-6
    assert len(seen) == 3


@pytest.mark.parametrize("seed", range(3))
def test_features_turn_with_world_and_robot(seed):
    pose, walls = np.array([2.21, 2.33, 2.0]), world.named("fig07").walls
    turn = jax.random.uniform(jax.random.key(seed), (3,), minval=-3, maxval=3)
    moved = to_world(turn, jnp.asarray(walls).reshape(-1, 2, 2)).reshape(-1, 4)
    here, there = features(walls, pose)[0], features(moved, compose(turn, jnp.asarray(pose)))[0]
    assert here.valid.sum() >= 5
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), here, there)


def test_padding_is_blank():
    found = features(world.named("fig07").walls, np.array([2.2, 2.3, 2.0]))[0]
    assert found.kind.size == SPEC.size and 0 < found.valid.sum() < SPEC.size
    for field in found._replace(kind=found.degree):
        assert not np.any(np.asarray(field)[~np.asarray(found.valid)])


def test_restrict_blanks_what_is_unwanted_or_not_finite():
    found = features(world.named("fig07").walls, np.array([2.2, 2.3, 2.0]))[0]
    good = np.flatnonzero(found.valid)
    sick = found._replace(
        xy=found.xy.at[good[0], 1].set(jnp.nan), cov=found.cov.at[good[1]].set(jnp.inf)
    )
    kept = nodes.restrict(sick, jnp.arange(found.kind.size) != good[2])
    np.testing.assert_array_equal(np.flatnonzero(kept.valid), good[3:])
    assert all(np.isfinite(np.asarray(field, float)).all() for field in kept)
    assert not kept.xy[good[:3]].any() and not kept.cov[good[:3]].any()
    np.testing.assert_array_equal(kept.xy[good[3:]], found.xy[good[3:]])


def test_gradient_of_a_node_by_the_ranges_equals_finite_differences():
    """The ridge of the Gauss-Newton step leaves a relative error of about 1e-4 in gradients."""
    scan = lidar.disturb(jax.random.key(0), scan_of(TRIANGLE, IN_TRIANGLE), LIDAR)
    start = to_robot(IN_TRIANGLE, jnp.array(CENTRE))
    centre = lambda ranges: circle(scan._replace(ranges=ranges), start).centre
    slope = jax.jit(jax.grad(lambda ranges, x: centre(ranges) @ x))
    push = 1e-5 * jax.random.normal(jax.random.key(1), scan.ranges.shape)
    change = (centre(scan.ranges + push) - centre(scan.ranges - push)) / 2
    for x in jnp.eye(2):
        ours = slope(scan.ranges, x)
        assert np.isfinite(ours).all() and np.any(ours != 0)
        np.testing.assert_allclose(ours @ push, change @ x, rtol=1e-3)


def shifted(runs, draws):
    """Runs whose lines err as their covariance says, by standard normals (2, K)."""
    tilt = draws[1] * jnp.sqrt(runs.angle_variance)
    off = draws[0] * jnp.sqrt(runs.offset_variance)
    normal = runs.normal - tilt[:, None] * runs.along
    normal = normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
    at = jnp.sum((runs.ends - runs.centre[:, None]) * runs.along[:, None], axis=2)
    ends = runs.ends + (off[:, None] + tilt[:, None] * at)[..., None] * runs.normal[:, None]
    centre = runs.centre + off[:, None] * runs.normal
    return runs._replace(normal=normal, centre=centre, ends=ends)


def test_covariance_of_a_node_is_that_of_its_lines():
    """Centres fitted to 2000 draws of the lines; each entry within 5 standard errors."""
    samples = 2000
    scan = lidar.disturb(jax.random.key(0), scan_of(TRIANGLE, IN_TRIANGLE), LIDAR)
    start = to_robot(IN_TRIANGLE, jnp.array(CENTRE))
    claimed = np.asarray(circle(scan, start).cov)

    @jax.jit
    def centres(scan, draws):
        runs = edges.runs(scan, LIDAR, CONFIG.runs)
        fit = lambda draw: (
            junctions.tangent_circle(start, near(start, runs), shifted(runs, draw), SPEC).centre
        )
        return jax.lax.map(fit, draws)

    draws = jax.random.normal(jax.random.key(1), (samples, 2, CONFIG.runs.capacity))
    sampled = np.cov(np.asarray(centres(scan, draws)).T)
    error = np.sqrt((np.outer(np.diag(claimed), np.diag(claimed)) + claimed**2) / samples)
    assert np.all(np.abs(sampled - claimed) < 5 * error)


def test_covariance_of_a_node_is_that_of_noisy_scans():
    """Each beam counts by its noise across its wall; the lower bound is still the former fit's."""
    samples = 400
    scan, start = scan_of(TRIANGLE, IN_TRIANGLE), to_robot(IN_TRIANGLE, jnp.array(CENTRE))
    one = lambda key: circle(lidar.disturb(key, scan, LIDAR), start)
    many = jax.jit(lambda keys: jax.lax.map(one, keys))
    found = many(jax.random.split(jax.random.key(2), samples))
    error = np.asarray(found.centre) - np.asarray(start)
    claimed = np.asarray(found.cov).mean(axis=0)
    ratio = np.linalg.eigvals(np.linalg.solve(claimed, error.T @ error / samples))
    slack = 5 * np.sqrt(2 / samples)
    assert np.all(ratio < 1 + slack) and np.all(ratio > 0.45 * (1 - slack))
    assert np.all(np.abs(error.mean(axis=0)) < 5 * error.std(axis=0) / np.sqrt(samples))


def test_many_walls_keep_to_the_capacity_and_the_longest_lead():
    found, _, _, wall = features(world.named("office").walls, np.array([10.4, 7.6, 0.4]))
    assert found.kind.size == SPEC.size
    np.testing.assert_array_equal(
        found.kind, np.repeat([NODE, CORNER, WALL], [SPEC.nodes, SPEC.corners, SPEC.walls])
    )
    assert len(wall.direction) >= 2


def test_float32_finds_what_float64_finds():
    walls, pose = world.named("fig07").walls, np.array([2.2, 2.3, 2.0])
    double = features(walls, pose)[0]
    with jax.enable_x64(False):
        single = World(jnp.asarray(walls, jnp.float32)), jnp.asarray(pose, jnp.float32)
        single = jax.tree.map(np.asarray, front_end(CONFIG, cast(*single, LIDAR)))
    assert single.xy.dtype == np.float32
    np.testing.assert_array_equal(single.valid, double.valid)
    np.testing.assert_array_equal(single.degree, double.degree)
    for name in ("xy", "direction", "shape"):
        np.testing.assert_allclose(getattr(single, name), getattr(double, name), atol=1e-4)


def test_gradient_of_a_node_through_the_front_end_equals_finite_differences():
    scan = lidar.disturb(jax.random.key(0), scan_of(TRIANGLE, IN_TRIANGLE), LIDAR)
    place = lambda ranges: slam.front_end(CONFIG, scan._replace(ranges=ranges)).xy[0]
    value = jax.jit(place)
    slope = jax.jit(jax.grad(lambda ranges, x: place(ranges) @ x))
    np.testing.assert_allclose(
        value(scan.ranges), to_robot(IN_TRIANGLE, jnp.array(CENTRE)), atol=0.02
    )
    push = 1e-6 * jax.random.normal(jax.random.key(1), scan.ranges.shape)
    change = (value(scan.ranges + push) - value(scan.ranges - push)) / 2
    for x in jnp.eye(2):
        ours = slope(scan.ranges, x)
        assert np.isfinite(ours).all() and np.any(ours != 0)
        np.testing.assert_allclose(ours @ push, change @ x, rtol=1e-2)


def test_a_node_is_not_trusted_where_a_wall_may_hide_behind_its_end():
    """A plate ends 3 cm outside the circle; behind it, on the line of sight, lies the circle."""
    tip = lambda turn: IN_TRIANGLE[:2] + 0.5 * np.array([np.cos(turn), np.sin(turn)])
    plate = world.polyline([tip(0.85), tip(1.25)])
    want = to_robot(IN_TRIANGLE, jnp.array(CENTRE))
    for walls, hides in ((TRIANGLE, False), (np.vstack([TRIANGLE, plate]), True)):
        _, node, _, _ = features(walls, IN_TRIANGLE)
        away = np.linalg.norm(node.xy - np.asarray(want), axis=1)
        assert away.min() < 0.01
        assert node.trusted[np.argmin(away)] == (not hides)
        deep = circle(scan_of(walls, IN_TRIANGLE), want).hidden
        np.testing.assert_allclose(deep, 0.031 if hides else 0.0, atol=0.01)


def test_covariance_of_a_corner_is_that_of_noisy_scans():
    """5 standard errors on either side."""
    samples, pose, corner = 400, np.array([0.3, 0.2, 0.1]), jnp.array([4.0, 3.0])
    scan, want = scan_of(world.outline([BOX]), pose), to_robot(pose, corner)

    def one(key):
        runs = edges.runs(lidar.disturb(key, scan, LIDAR), LIDAR, CONFIG.runs)
        found = nodes.find_corners(runs, SPEC)
        away = jnp.where(found.valid, jnp.linalg.norm(found.xy - want[None], axis=1), jnp.inf)
        best = jnp.argmin(away)
        return found.xy[best], found.cov[best], away[best]

    many = jax.jit(lambda keys: jax.lax.map(one, keys))
    place, cov, away = map(np.asarray, many(jax.random.split(jax.random.key(3), samples)))
    error, claimed = place - np.asarray(want), cov.mean(axis=0)
    assert away.max() < 0.1
    ratio = np.linalg.eigvals(np.linalg.solve(claimed, error.T @ error / samples))
    np.testing.assert_allclose(ratio, 1.0, atol=5 * np.sqrt(2 / samples))
    assert np.all(np.abs(error.mean(axis=0)) < 5 * error.std(axis=0) / np.sqrt(samples))
