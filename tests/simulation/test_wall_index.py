"""Ray casting by an index of the walls, against trying all walls, in worlds of many kinds."""

import math
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.simulation import worlds
from jaxslam.simulation.nearest_walls import nearest_walls
from jaxslam.simulation.ray_casting import cast, share_leaving
from jaxslam.simulation.wall_index import WallIndex, index_walls
from jaxslam.simulation.worlds import UNINDEXED, World, with_index

ROUND = Lidar(num_beams=90, angle_min=-math.pi, angle_increment=math.pi / 45, range_max=12.0)
NUM_WALLS, NUM_CELLS, NUM_ROWS, NUM_POSES = 400, 1200, 60_000, 24


def segments(rng, count, size, lengths):
    """Walls (count, 4) anywhere, of lengths between two limits [m], at any angle."""
    start, angle = rng.uniform(0, size, (count, 2)), rng.uniform(-np.pi, np.pi, count)
    length = np.exp(rng.uniform(*np.log(lengths), count))
    return np.hstack([start, start + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)])


def boxes(rng, count, size, sides):
    """Outlines (4 count, 4) of boxes parallel to the axes."""
    low = rng.uniform(0, size, (count, 2))
    high = low + rng.uniform(*sides, (count, 2))
    return np.vstack([worlds.outline([(*a, *b)]) for a, b in zip(low, high, strict=True)])


def stairs(rng, count):
    """A closed curve of steps of 0.05 m, as traced around the cells of a grid."""
    angle = np.linspace(0, 2 * np.pi, 20 * count)
    radius = 4 + rng.uniform(0.2, 1.5) * np.sin(rng.integers(2, 6) * angle)
    cells = np.round(10 + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1) * 20)
    corners = [cells[0]]
    for x, y in cells[1:]:
        corners += [np.array([x, corners[-1][1]]), np.array([x, y])]
    corners = np.array(corners)
    moves = np.append(True, (np.diff(corners, axis=0) != 0).any(axis=1))
    return worlds.polyline(corners[moves] * 0.05)


WORLDS = {
    "any lengths": lambda rng: segments(rng, 300, 25.0, (0.05, 30.0)),
    "short walls": lambda rng: segments(rng, 400, 12.0, (0.03, 0.3)),
    "hall with columns": lambda rng: np.vstack(
        [boxes(rng, 40, 80.0, (0.3, 0.6)), boxes(rng, 1, 1.0, (70, 90))]
    ),
    "rooms": lambda rng: boxes(rng, 90, 30.0, (0.2, 9.0)),
    "traced grid": lambda rng: stairs(rng, 150)[:NUM_WALLS],
    "one long wall": lambda rng: np.array([[0.0, 0.0, 200.0, 0.0]]),
    "far from the origin": lambda rng: 5000.0 + segments(rng, 100, 20.0, (0.5, 5.0)),
    "no walls": lambda rng: np.zeros((0, 4)),
}


def padded(walls):
    """Walls (NUM_WALLS, 4); those that are added have no length."""
    point = walls[0, [0, 1, 0, 1]] if len(walls) else np.zeros(4)
    return np.vstack([walls, np.tile(point, (NUM_WALLS - len(walls), 1))])


def of_one_shape(index):
    """An index with unused cells and rows, so that nothing is compiled again for it."""
    grow = {"first": NUM_CELLS, "walls": NUM_ROWS, "horizon": NUM_ROWS, "following": NUM_ROWS}
    fields = {}
    for name, x in index._asdict().items():
        more = grow.get(name, len(x) if x.ndim else 0) - (len(x) if x.ndim else 0)
        assert more >= 0, (name, x.shape)
        fields[name] = jnp.asarray(
            np.pad(x, [(0, more)] + [(0, 0)] * (x.ndim - 1)) if x.ndim else x
        )
    return WallIndex(**fields)


def poses_in(rng, walls):
    """Poses (NUM_POSES, 3): among the walls, outside, on walls and corners, along the axes."""
    ends = walls.reshape(-1, 2)
    low, high = ends.min(axis=0), ends.max(axis=0)
    poses = np.hstack([rng.uniform(low, high, (NUM_POSES, 2)), rng.uniform(-9, 9, (NUM_POSES, 1))])
    poses[:3, :2] += (high - low + 3.0) * np.array([[1, 0], [0, -1], [-1, 1]])
    poses[3:5, :2] = ends[rng.integers(len(ends), size=2)]
    poses[5:7, :2] = walls[rng.integers(len(walls), size=2)].reshape(-1, 2, 2).mean(axis=1)
    poses[5:9, 2] = np.pi / 2 * np.arange(4)
    return poses


def slow_distances(lidar, walls, poses):
    """Distances (N, R), by solving p + t u = a + s (b - a) for each beam and wall."""
    angle = poses[:, 2:] + lidar.angle_min + lidar.angle_increment * np.arange(lidar.num_beams)
    u = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, :, None]  # (N, R, 1, 2)
    a, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    matrix = np.stack(np.broadcast_arrays(u, -along), axis=-1)
    singular = np.abs(np.linalg.det(matrix)) < 1e-9
    matrix[singular] = np.eye(2)
    right = np.broadcast_to((a - poses[:, None, None, :2]), matrix.shape[:-1])
    t, s = np.moveaxis(np.linalg.solve(matrix, right[..., None])[..., 0], -1, 0)
    met = ~singular & (t > 1e-6) & (s >= -1e-5) & (s <= 1 + 1e-5)
    return np.where(met, t, np.inf).min(axis=-1)


@partial(jax.jit, static_argnums=0)
def both(lidar, walls, index, poses):
    """Distances and walls by the index and by trying all, (N, R) each."""
    by_index = jax.lax.map(lambda pose: nearest_walls(lidar, pose, walls, index), poses)
    return by_index, jax.vmap(lambda pose: nearest_walls(lidar, pose, walls, None))(poses)


def assert_equal_within(lidar, by_index, by_all):
    """The same walls, at the same distances, up to the range."""
    within = np.asarray(by_all[0]) < lidar.range_max
    np.testing.assert_array_equal(np.asarray(by_index[0]) < lidar.range_max, within)
    np.testing.assert_array_equal(np.asarray(by_index[1])[within], np.asarray(by_all[1])[within])
    np.testing.assert_allclose(
        np.asarray(by_index[0])[within], np.asarray(by_all[0])[within], rtol=1e-9
    )


@pytest.mark.parametrize("kind", WORLDS)
def test_index_finds_what_trying_all_walls_finds(kind):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        walls = padded(WORLDS[kind](rng))
        poses = poses_in(rng, walls)
        index = of_one_shape(index_walls(walls, (12.0, 5.0)[seed % 2]))  # or less than the range
        by_index, by_all = both(ROUND, jnp.asarray(walls), index, jnp.asarray(poses))
        assert_equal_within(ROUND, by_index, by_all)
        if kind != "far from the origin":  # where solving is no more precise than walls are
            slow = slow_distances(ROUND, walls, poses[:8])
            near = np.minimum(slow, 200.0)
            np.testing.assert_allclose(np.minimum(by_all[0][:8], 200.0), near, rtol=1e-6)


def rooms_of(seed):
    """Walls of rooms, a pose among them, and their index."""
    walls = padded(WORLDS["rooms"](np.random.default_rng(seed)))
    return jnp.asarray(walls), of_one_shape(index_walls(walls, 12.0)), jnp.array([14.2, 15.1, 0.3])


@pytest.mark.slow
def test_scans_by_an_index_are_batched_and_differentiable():
    walls, index, pose = rooms_of(0)
    poses = pose[None] + jnp.arange(3.0)[:, None]

    def ranges(pose, walls, index):
        return cast(ROUND, World(walls, index), pose).ranges

    batch = jax.jit(jax.vmap(ranges, (0, None, None)))(poses, walls, index)
    alone = jax.jit(lambda *xs: jax.lax.map(lambda p: ranges(p, *xs[1:]), xs[0]))
    np.testing.assert_array_equal(batch, alone(poses, walls, index))
    slope = jax.jit(jax.jacrev(ranges, (0, 1)))
    of_pose, of_walls = slope(pose, walls, index)
    for one, other in zip((of_pose, of_walls), slope(pose, walls, None), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    step = jnp.array([2e-7, -1e-7, 1e-7])
    before, after = (alone((pose + sign * step)[None], walls, index)[0] for sign in (-1, 1))
    np.testing.assert_allclose(2 * of_pose @ step, after - before, atol=1e-10)
    forward = jax.jit(jax.jacfwd(ranges))(pose, walls, index)
    np.testing.assert_allclose(forward, of_pose, atol=1e-9)


def test_walls_may_vanish_after_they_were_indexed():
    walls, index, pose = rooms_of(1)
    poses = jnp.tile(jnp.stack([pose, pose + 1.0]), (NUM_POSES // 2, 1))
    seen = np.asarray(both(ROUND, walls, index, poses)[0][1])
    removed = np.unique(seen[seen >= 0])[::2]
    fewer = walls.at[removed, 2:].set(walls[removed, :2])
    by_index, by_all = both(ROUND, fewer, index, poses)
    assert_equal_within(ROUND, by_index, by_all)
    assert not np.isin(by_index[1], removed).any()


@pytest.mark.usefixtures("single_precision")
def test_single_precision_finds_the_same():
    rng = np.random.default_rng(3)
    walls = padded(WORLDS["any lengths"](rng))
    poses = np.hstack([rng.uniform(0, 25, (200, 2)), rng.uniform(-3, 3, (200, 1))])
    index = with_index(World(jnp.asarray(walls, float)), ROUND.range_max).wall_index
    assert index.horizon.dtype == jnp.float32
    (by_index, wall), (by_all, same) = both(
        ROUND, jnp.asarray(walls, float), index, jnp.asarray(poses, float)
    )
    within = np.asarray(by_all) < ROUND.range_max
    np.testing.assert_array_equal(np.asarray(wall)[within], np.asarray(same)[within])
    np.testing.assert_allclose(np.asarray(by_index)[within], np.asarray(by_all)[within], rtol=1e-5)


def test_other_scanners_are_cast_by_the_same_index():
    walls, index, pose = rooms_of(2)
    for lidar in (
        Lidar(num_beams=3, angle_min=2.9, angle_increment=0.7, range_max=12.0),
        ROUND._replace(num_beams=123, range_max=100.0),  # more than once around
    ):
        by_index, by_all = both(lidar, walls, index, jnp.stack([pose, -pose]))
        assert_equal_within(lidar, by_index, by_all)


def test_only_many_walls_are_indexed():
    walls = jnp.asarray(padded(np.zeros((0, 4))))
    assert with_index(World(walls[:UNINDEXED]), 10.0).wall_index is None
    assert with_index(World(walls[: UNINDEXED + 1]), 10.0).wall_index is not None


def test_the_share_of_beams_that_leave_an_open_world():
    walls = worlds.polyline([(5.0, 20.0), (5.0, -20.0), (-5.0, -20.0), (-5.0, 20.0)])
    poses = jnp.array([[0.0, 15.0, 0.1], [0.0, 5.0, 0.3]])
    index = jax.tree.map(jnp.asarray, index_walls(walls, 8.0))
    lidar = ROUND._replace(num_beams=900, angle_increment=2 * np.pi / 900, range_max=8.0)
    open_angle = 2 * np.arctan2(5.0, 20.0 - np.array([15.0, 5.0]))
    far = 2 * np.arcsin(5 / 8)  # between the two walls, up or down
    for world in (World(jnp.asarray(walls)), World(jnp.asarray(walls), index)):
        shares = share_leaving(lidar, world, poses)
        np.testing.assert_allclose(shares.no_wall, np.mean(open_angle) / (2 * np.pi), atol=3e-3)
        expected = np.mean(np.maximum(far, open_angle) + far) / (2 * np.pi)
        np.testing.assert_allclose(shares.beyond_range, expected, atol=3e-3)


@pytest.mark.parametrize(
    "walls, range_max, message",
    [
        (np.zeros((0, 4)), 10.0, "walls is (0, 4), not at least one wall"),
        (np.full((3, 4), np.inf), 10.0, "walls is (3, 4), not at least one wall of finite numbers"),
        (np.zeros((3, 4)), 0.0, "range_max is 0.0, not a positive number of metres"),
        (np.zeros((3, 2)), 1.0, "walls is float64 (3, 2), not (S, 4)"),
    ],
)
def test_what_cannot_be_indexed_is_named(walls, range_max, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        index_walls(walls, range_max)
