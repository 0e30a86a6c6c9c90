import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import CENTRE, IN_TRIANGLE, RADIUS, TRIANGLE

from jaxslam.core.features import restrict_features
from jaxslam.core.se2 import compose, inverse_transform, transform, wrap_angle, wrap_direction
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.frontend import extract, segmentation
from jaxslam.frontend.features import find_corners
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World

CONFIG = Config()
LIDAR, SPEC = CONFIG.frontend.lidar, CONFIG.frontend.features
BOX = (-1.5, -2.0, 4.0, 3.0)
SLOPE = 2 / np.tan(np.radians(37))
SHED = [(0, 0), (5, 0), (5, 3), (5 - SLOPE, 5), (0, 5), (0, 0)]  # one wall at 143 degrees

extract_features = jax.jit(extract.extract_features, static_argnums=0)
cast = jax.jit(ray_casting.cast, static_argnums=0)


def scan_of(walls, pose):
    return cast(LIDAR, World(jnp.asarray(walls)), jnp.asarray(pose))


def features(walls, pose):
    """Features of a noise-free scan, and those of each kind that are valid."""
    found = extract_features(CONFIG.frontend, scan_of(walls, pose))
    masks = [np.asarray(found.valid & (found.kind == kind)) for kind in (JUNCTION, CORNER, WALL)]
    return found, *(jax.tree.map(lambda x, m=m: np.asarray(x)[m], found) for m in masks)


def test_the_junction_of_a_triangle_is_found():
    pose = np.array([1.0, 0.2, 0.05])
    _, junction, corner, wall = features(TRIANGLE / 1.5, pose)
    assert len(junction.xy) == 1 and junction.degree == 3
    np.testing.assert_allclose(transform(pose, junction.xy), CENTRE[None] / 1.5, atol=1e-6)
    np.testing.assert_allclose(junction.descriptor, RADIUS / 1.5, atol=1e-6)
    np.testing.assert_allclose(corner.descriptor, np.pi / 3, atol=1e-6)
    assert len(wall.direction) == 3


def test_corners_of_a_room_are_exact_and_face_into_it():
    pose = np.array([0.3, 0.2, 0.1])
    _, _, corner, _ = features(worlds.outline([BOX]), pose)
    position = np.asarray(transform(pose, corner.xy))
    order = np.argsort(position[:, 1])
    np.testing.assert_allclose(position[order], [[4.0, -2.0], [4.0, 3.0]], atol=1e-6)
    np.testing.assert_allclose(corner.descriptor, np.pi / 2, atol=1e-6)  # concave
    facing = wrap_angle(corner.direction[order] + pose[2])
    np.testing.assert_allclose(facing, np.array([3, -3]) * np.pi / 4, atol=1e-6)


def test_the_descriptor_distinguishes_convex_from_concave_corners():
    _, _, corner, _ = features(worlds.named("fig04").walls, np.array([0.0, 0.0, 0.0]))
    convex = corner.descriptor > np.pi
    assert convex.sum() == 1 and np.sum(~convex) >= 1
    np.testing.assert_allclose(corner.xy[convex], [[1.4, 0.3]], atol=1e-6)
    np.testing.assert_allclose(corner.descriptor[convex], 1.5 * np.pi, atol=1e-6)
    np.testing.assert_allclose(wrap_angle(corner.direction[convex]), -0.75 * np.pi, atol=1e-6)


@pytest.mark.parametrize("heading", [0.3, 1.0, 1.9])
def test_wall_directions_are_those_of_the_world_also_at_37_degrees(heading):
    _, _, _, wall = features(worlds.polyline(SHED), np.array([1.2, 1.1, heading]))
    seen = np.asarray(wrap_direction(wall.direction + heading))
    for true in np.radians([0.0, 90.0, 143.0]):
        assert np.abs(np.asarray(wrap_direction(seen - true))).min() < 1e-6
    assert len(seen) == 3


@pytest.mark.parametrize("seed", range(3))
def test_features_turn_with_world_and_robot(seed):
    pose, walls = np.array([2.21, 2.33, 2.0]), worlds.named("fig07").walls
    turn = jax.random.uniform(jax.random.key(seed), (3,), minval=-3, maxval=3)
    moved = transform(turn, jnp.asarray(walls).reshape(-1, 2, 2)).reshape(-1, 4)
    here, there = features(walls, pose)[0], features(moved, compose(turn, jnp.asarray(pose)))[0]
    assert here.valid.sum() >= 5
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), here, there)


def test_padding_is_zero():
    found = features(worlds.named("fig07").walls, np.array([2.2, 2.3, 2.0]))[0]
    assert found.kind.size == SPEC.max_features and 0 < found.valid.sum() < SPEC.max_features
    for field in jax.tree.leaves(found._replace(kind=found.degree)):
        assert not np.any(np.asarray(field)[~np.asarray(found.valid)])


def test_restricted_features_are_wanted_and_finite():
    found = features(worlds.named("fig07").walls, np.array([2.2, 2.3, 2.0]))[0]
    good = np.flatnonzero(found.valid)
    broken = found._replace(
        xy=found.xy.at[good[0], 1].set(jnp.nan), cov=found.cov.at[good[1]].set(jnp.inf)
    )
    kept = restrict_features(broken, jnp.arange(found.kind.size) != good[2])
    np.testing.assert_array_equal(np.flatnonzero(kept.valid), good[3:])
    assert all(np.isfinite(np.asarray(field, float)).all() for field in jax.tree.leaves(kept))
    assert not kept.xy[good[:3]].any() and not kept.cov[good[:3]].any()
    np.testing.assert_array_equal(kept.xy[good[3:]], found.xy[good[3:]])


def test_a_scan_of_many_walls_has_as_many_features_as_capacity():
    found, _, _, wall = features(worlds.named("office").walls, np.array([10.4, 7.6, 0.4]))
    assert found.kind.size == SPEC.max_features
    np.testing.assert_array_equal(
        found.kind,
        np.repeat([JUNCTION, CORNER, WALL], [SPEC.max_junctions, SPEC.max_corners, SPEC.max_walls]),
    )
    assert len(wall.direction) >= 2


def test_float32_finds_what_float64_finds():
    walls, pose = worlds.named("fig07").walls, np.array([2.2, 2.3, 2.0])
    double = features(walls, pose)[0]
    with jax.enable_x64(False):
        scan = cast(LIDAR, World(jnp.asarray(walls, jnp.float32)), jnp.asarray(pose, jnp.float32))
        single = jax.tree.map(np.asarray, extract_features(CONFIG.frontend, scan))
    assert single.xy.dtype == np.float32
    np.testing.assert_array_equal(single.valid, double.valid)
    np.testing.assert_array_equal(single.degree, double.degree)
    for name in ("xy", "direction", "descriptor"):
        np.testing.assert_allclose(getattr(single, name), getattr(double, name), atol=1e-4)


@pytest.mark.slow
def test_gradient_of_a_junction_by_the_ranges_equals_finite_differences():
    scan = ray_casting.add_range_noise(jax.random.key(0), LIDAR, scan_of(TRIANGLE, IN_TRIANGLE))

    def coordinate(ranges, x):
        xy = extract.extract_features(CONFIG.frontend, scan._replace(ranges=ranges)).xy[0]
        return xy @ x, xy

    slope = jax.jit(jax.grad(coordinate, has_aux=True))
    push = 1e-6 * jax.random.normal(jax.random.key(1), scan.ranges.shape)
    for x in jnp.eye(2):
        gradient, xy = slope(scan.ranges, x)
        np.testing.assert_allclose(xy, inverse_transform(IN_TRIANGLE, jnp.array(CENTRE)), atol=0.02)
        up, down = (slope(scan.ranges + s * push, x)[1] for s in (1, -1))
        assert np.isfinite(gradient).all() and np.any(gradient != 0)
        np.testing.assert_allclose(gradient @ push, (up - down) @ x / 2, rtol=1e-3)


@pytest.mark.parametrize("apart", [0.2, 0.3, 0.4])
def test_both_junctions_of_a_room_that_is_nearly_square_are_found(apart):
    pose, room = np.array([0.1, 0.1, np.pi / 4]), worlds.outline([(0.0, 0.0, 2.0 + apart, 2.0)])
    _, junction, _, _ = features(room, pose)
    xy = np.asarray(transform(pose, junction.xy))
    np.testing.assert_allclose(xy[np.argsort(xy[:, 0])], [[1, 1], [1 + apart, 1]], atol=1e-6)
    np.testing.assert_allclose(junction.descriptor, 1.0, atol=1e-6)


def test_a_junction_is_not_trusted_where_a_wall_may_hide_behind_its_end():
    """A plate ends 3 cm outside the circle; behind it, on the line of sight, lies the circle."""
    tips = [IN_TRIANGLE[:2] + 0.5 * np.array([np.cos(a), np.sin(a)]) for a in (0.85, 1.25)]
    plate = worlds.polyline(tips)
    want = inverse_transform(IN_TRIANGLE, jnp.array(CENTRE))
    for walls, hides in ((TRIANGLE, False), (np.vstack([TRIANGLE, plate]), True)):
        _, junction, _, _ = features(walls, IN_TRIANGLE)
        distance = np.linalg.norm(junction.xy - np.asarray(want), axis=1)
        assert distance.min() < 0.01
        assert junction.trusted[np.argmin(distance)] == (not hides)


def test_covariance_of_a_corner_is_that_of_noisy_scans():
    """5 standard errors on either side."""
    samples, pose, corner = 400, np.array([0.3, 0.2, 0.1]), jnp.array([4.0, 3.0])
    scan, want = scan_of(worlds.outline([BOX]), pose), inverse_transform(pose, corner)

    def one(key):
        noisy = ray_casting.add_range_noise(key, LIDAR, scan)
        found = find_corners(
            SPEC, segmentation.find_segments(LIDAR, CONFIG.frontend.segments, noisy)
        )
        distance = jnp.where(found.valid, jnp.linalg.norm(found.xy - want[None], axis=1), jnp.inf)
        best = jnp.argmin(distance)
        return found.xy[best], found.cov[best], distance[best]

    many = jax.jit(lambda keys: jax.lax.map(one, keys))
    xy, cov, distance = map(np.asarray, many(jax.random.split(jax.random.key(3), samples)))
    error, claimed = xy - np.asarray(want), cov.mean(axis=0)
    assert distance.max() < 0.1
    ratio = np.linalg.eigvals(np.linalg.solve(claimed, error.T @ error / samples))
    np.testing.assert_allclose(ratio, 1.0, atol=5 * np.sqrt(2 / samples))
    assert np.all(np.abs(error.mean(axis=0)) < 5 * error.std(axis=0) / np.sqrt(samples))
