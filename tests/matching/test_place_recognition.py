from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulated_scans import LIDAR, item, scans_of

from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, relative
from jaxslam.matching import oriented_points, place_fit, place_index
from jaxslam.matching.place_index import PlaceSpec, build_index
from jaxslam.matching.place_recognition import find_places, make_query
from jaxslam.simulation import path_following, ray_casting, worlds
from jaxslam.simulation.worlds import World

SPEC = PlaceSpec()
HERE = jnp.zeros((1, 3))


def drive(name, step=0.5):
    """Poses (T, 3) on the drive through a world, and its scans."""
    path = path_following.densify(worlds.waypoints(name))
    poses = path_following.poses_along(path, step)
    return poses, scans_of(worlds.named(name), jnp.asarray(poses), LIDAR.range_std)


@pytest.fixture(scope="module")
def office():
    return drive("office")


@pytest.fixture(scope="module")
def index(office):
    return build_index(SPEC, LIDAR, *office)


@pytest.fixture(scope="module")
def queries(office):
    """Poses beside the path, turned away from it, and the scans from there."""
    rng = np.random.default_rng(5)
    off = np.column_stack([rng.uniform(-0.25, 0.25, (20, 2)), rng.uniform(-0.8, 0.8, 20)])
    poses = compose(office[0][3 :: len(office[0]) // 20][:20], off)
    return poses, scans_of(worlds.named("office"), jnp.asarray(poses), LIDAR.range_std, 7)


query_of = jax.jit(make_query, static_argnums=(0, 1))


@partial(jax.jit, static_argnums=1)
def queries_of(scans, lidar=LIDAR):
    return jax.vmap(lambda scan: make_query(SPEC, lidar, scan, HERE))(
        jax.tree.map(lambda x: x[:, None], scans)
    )


@jax.jit
def places_of(index, queries):
    return jax.vmap(partial(find_places, SPEC, index))(queries)


def is_right(found, poses):
    off = relative(poses, np.asarray(found, float))
    return (np.hypot(off[:, 0], off[:, 1]) < 0.1) & (np.abs(off[:, 2]) < 0.03)


def test_places_are_found_and_none_that_is_accepted_is_wrong(index, queries):
    poses, scans = queries
    found = places_of(index, queries_of(scans))
    right, accepted = is_right(found.poses[:, 0], poses), np.asarray(found.accepted)
    assert right[accepted].all() and accepted.mean() >= 0.7
    assert (np.diff(found.score, axis=1) <= 0.0).all()
    np.testing.assert_allclose(found.margin, found.score[:, 0] - found.score[:, 1])


def test_one_query_alone_gives_the_same(index, queries):
    many = places_of(index, queries_of(queries[1]))
    one = find_places(SPEC, index, query_of(SPEC, LIDAR, item(queries[1], slice(2, 3)), HERE))
    for all_of_them, alone in zip(many, one, strict=True):
        np.testing.assert_allclose(all_of_them[2], alone, atol=1e-6)


def test_what_is_found_moves_with_the_map(office, index, queries):
    move = np.array([31.0, -12.0, 2.1])
    moved = build_index(SPEC, LIDAR, compose(move, office[0]), office[1])
    found = places_of(moved, queries_of(queries[1]))
    accepted = np.asarray(found.accepted)
    assert accepted.mean() >= 0.7
    assert is_right(found.poses[:, 0], compose(move, queries[0]))[accepted].all()


def test_a_scanner_with_other_beams_finds_its_place(index, queries):
    other = Lidar(90, -1.2, 2.4 / 89, 12.0, 0.02)
    poses = jnp.asarray(queries[0])
    scans = jax.jit(jax.vmap(partial(ray_casting.cast, other, worlds.named("office"))))(poses)
    found = places_of(index, queries_of(scans, other))
    accepted = np.asarray(found.accepted)
    assert accepted.mean() >= 0.4
    assert is_right(found.poses[:, 0], queries[0])[accepted].all()


def test_a_window_of_scans_is_put_together_in_the_frame_of_the_last(office):
    poses, scans = item(office, slice(6, 9))
    query = query_of(SPEC, LIDAR, scans, relative(poses[-1], poses))
    walls = np.asarray(worlds.named("office").walls)
    t = np.linspace(0.0, 1.0, 2000)[:, None, None]
    on_walls = (walls[None, :, :2] * (1 - t) + walls[None, :, 2:] * t).reshape(-1, 2)
    distance = cKDTree(relative(poses[-1], np.pad(on_walls, [(0, 0), (0, 1)]))[:, :2])
    assert query.valid.all()
    assert np.median(distance.query(query.points)[0]) < 0.02
    free = np.asarray(query.free)[np.asarray(query.is_free)]
    assert np.quantile(distance.query(free)[0], 0.01) > 0.02


@pytest.mark.parametrize("length, num_places", [(4.0, 4), (6.0, 2)])
def test_a_symmetric_room_is_ambiguous_rather_than_guessed(length, num_places):
    """A square looks the same after each quarter of a turn, a rectangle after half a one."""
    a, b = length / 2, 2.0
    corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
    walls = [(*p, *q) for p, q in zip(corners, corners[1:] + corners[:1], strict=True)]
    turn = Lidar(360, -np.pi, 2 * np.pi / 360, 15.0, 0.0)
    poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.3, 1.0], [-0.6, 0.2, -2.0], [0.2, -0.5, 2.5]])
    cast = jax.jit(jax.vmap(partial(ray_casting.cast, turn, World(jnp.array(walls)))))
    scans = cast(jnp.asarray(poses))
    index = build_index(SPEC, turn, poses, scans)
    found = find_places(SPEC, index, query_of(SPEC, turn, item(scans, slice(1, 2)), HERE))
    assert not found.accepted and found.margin < 0.03
    score = np.asarray(found.score)
    assert (score[:num_places] > score[0] - 0.05).all()
    turned = np.arange(num_places) * 2 * np.pi / num_places
    alike = [compose(np.array([0.0, 0.0, t]), poses[1]) for t in turned]
    for pose in alike:
        assert is_right(found.poses[:num_places], np.tile(pose, (num_places, 1))).any()


def test_places_of_another_building_are_hardly_ever_accepted(index):
    """A plain room may look like part of an office: one scan of it in ten does."""
    scans = scans_of(worlds.named("fig07"), jnp.asarray(worlds.scan_poses("fig07")), 0.01)
    assert np.asarray(places_of(index, queries_of(scans)).accepted).sum() <= 1


def test_a_scan_without_any_return_is_nowhere(index, queries):
    nothing = jax.tree.map(jnp.zeros_like, item(queries[1], slice(0, 1)))
    found = find_places(SPEC, index, query_of(SPEC, LIDAR, nothing, HERE))
    assert not found.accepted and np.isfinite(found.poses).all()


def test_cells_know_the_nearest_surface(office, index):
    poses, scans = office

    @jax.jit
    @jax.vmap
    def surface(pose, scan):
        points = oriented_points.oriented_points(LIDAR, scan)
        return oriented_points.transform_points(pose, points)

    surfaces = surface(jnp.asarray(poses), scans)
    points = np.asarray(surfaces.points)[np.asarray(surfaces.valid)]
    cells = np.random.default_rng(0).integers(0, index.distance.shape, (500, 2))
    centres = np.asarray(index.origin) + SPEC.cell * cells
    nearest, _ = cKDTree(points).query(centres)
    at = tuple(cells.T)
    rounding = SPEC.cell * np.sqrt(0.5)
    assert (np.abs(np.asarray(index.distance)[at] - nearest) <= rounding + 1e-9).all()
    on_line = np.asarray(index.normal)[at] * np.asarray(index.offset)[at][:, None]
    to_points, _ = cKDTree(points).query(on_line + np.asarray(index.origin))
    assert np.isfinite(to_points).all()
    length = np.linalg.norm(np.asarray(index.normal)[at], axis=-1)
    np.testing.assert_allclose(length, 1.0, rtol=1e-6)


def test_the_score_is_that_of_the_slow_version(index, queries):
    query = query_of(SPEC, LIDAR, item(queries[1], slice(4, 5)), HERE)
    pose = np.array([*queries[0][4, :2] + 0.07, queries[0][4, 2]])
    score_pose = jax.jit(place_fit.score_pose, static_argnums=0)
    fast = score_pose(SPEC, index, query, jnp.asarray(pose))

    def on_wall(point, across=False):
        xy = compose(pose, np.array([*point, 0.0]))[:2] - np.asarray(index.origin)
        at = tuple(np.round(xy / SPEC.cell).astype(int))
        distance = float(index.distance[at])
        if across:
            distance = np.inf if distance > 0.25 else index.normal[at] @ xy - index.offset[at]
        return np.exp(-0.5 * (distance / SPEC.std) ** 2)

    points = np.asarray(query.points)[np.asarray(query.valid)]
    free = np.asarray(query.free)[np.asarray(query.is_free)]
    hits = [(on_wall(p) + on_wall(p, across=True)) / 2 for p in points]
    slow = np.mean(hits) - np.mean([on_wall(p) for p in free])
    np.testing.assert_allclose(fast, slow, atol=1e-6)


def test_arguments_are_checked(office):
    poses, scans = office
    with pytest.raises(ValueError, match="poses"):
        build_index(SPEC, LIDAR, np.full_like(poses, np.nan), scans)
    with pytest.raises(ValueError, match="scans"):
        build_index(SPEC, LIDAR, poses[:-1], scans)
    with pytest.raises(ValueError, match="num_views is 0"):
        build_index(SPEC._replace(num_views=0), LIDAR, poses, scans)
    with pytest.raises(ValueError, match=r"spec\.cell"):
        place_index.check_place_spec(SPEC._replace(cell=0.0))
    with pytest.raises(ValueError, match="scans"):
        make_query(SPEC, LIDAR, item(scans, slice(0, 2)), HERE)
