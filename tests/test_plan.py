import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_world import clearance, length

from jaxslam import world
from jaxslam.geometry import compose
from jaxslam.plan import WINDOW, densify, follow, route


def driven(path, start, steps):
    """Poses (T, 3), motions (T, 3) and places (T,) of a robot that follows `path` without noise."""

    def body(now, _):
        pose, place = now
        motion, place = follow(path, place, pose)
        pose = compose(pose, motion)
        return (pose, place), (pose, motion, place)

    return jax.lax.scan(body, (start, jnp.int32(0)), length=steps)[1]


@pytest.fixture(scope="module")
def office():
    path = jnp.asarray(densify(world.drive("office")))
    return path, *driven(path, jnp.append(path[0], 0.0), 420)


def test_densify_keeps_way_points_and_spacing():
    points = densify(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.52]]))
    gaps = np.hypot(*np.diff(points, axis=0).T)
    np.testing.assert_allclose([points[0], points[-1]], [[0, 0], [1, 0.52]])
    assert np.any(np.all(np.isclose(points, [1, 0]), axis=1))
    assert gaps.max() < 0.06 and length(points) == pytest.approx(1.52)


def test_the_office_drive_arrives_and_rests(office):
    path, poses, motions, places = office
    moves = np.any(np.asarray(motions) != 0.0, axis=1)
    steps = int(moves.sum())
    assert 250 < steps < 400 and moves[:steps].all() and not moves[steps:].any()
    assert np.linalg.norm(poses[-1, :2] - path[-1]) < 0.05
    assert places.dtype == jnp.int32 and np.all(np.diff(places) >= 0)
    assert places[-1] >= len(path) - 2


def test_the_office_drive_keeps_its_bounds_and_its_distance(office):
    _, poses, motions, _ = office
    assert np.hypot(motions[:, 0], motions[:, 1]).max() <= 0.3 + 1e-9
    assert np.abs(motions[:, 2]).max() <= 0.2 + 1e-9
    track = np.asarray(poses[:, :2])
    track = np.concatenate([track, (track[1:] + track[:-1]) / 2])
    assert clearance(track, world.named("office").walls).min() >= 0.3


def test_a_robot_beside_its_path_returns_to_it():
    path = jnp.asarray(densify(np.array([[0.0, 0.0], [6.0, 0.0]])))
    poses = driven(path, jnp.array([0.0, 0.4, -0.3]), 30)[0]
    assert np.abs(poses[12:, 1]).max() < 0.02
    assert np.linalg.norm(poses[-1, :2] - path[-1]) < 0.05


def test_a_robot_that_looks_away_turns_on_the_spot():
    path = jnp.asarray(densify(np.array([[0.0, 0.0], [6.0, 0.0]])))
    step, place = jax.jit(follow)(path, jnp.int32(0), jnp.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(step, [0.0, 0.0, -0.2], atol=1e-12)
    assert place == 0


def test_only_the_window_ahead_of_the_last_place_counts():
    there_and_back = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 0.01], [0.0, 0.01]])
    path = jnp.asarray(densify(there_and_back))
    _, place = jax.jit(follow)(path, jnp.int32(10), jnp.array([1.0, 0.01, 0.0]))
    assert 10 <= place < 10 + WINDOW


def test_many_robots_follow_at_once_and_gradients_are_finite():
    path = jnp.asarray(densify(world.drive("office")))
    poses = jax.random.uniform(jax.random.key(0), (5, 3), minval=0.5, maxval=1.5)
    poses = poses.at[0].set(jnp.append(path[-1], 0.0))
    places = jnp.array([path.shape[0] - 1, 0, 0, 0, 0], jnp.int32)
    steer = jax.jit(lambda pose, place: follow(path, place, pose)[0])
    alone = [steer(pose, place) for pose, place in zip(poses, places, strict=True)]
    together = jax.jit(jax.vmap(steer))(poses, places)
    np.testing.assert_allclose(together, jnp.stack(alone), atol=1e-12)
    slope = jax.jit(jax.vmap(jax.jacrev(steer)))(poses, places)
    assert np.isfinite(slope).all()


POSITIONS = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [5, 5]])
PAIRS = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [3, 0]])


@pytest.mark.parametrize(
    "lengths, expected",
    [
        ([1.0, 1.0, 1.0, 3.0, 4.0], [0, 1, 2]),
        ([1.0, 5.0, 1.0, 3.0, 4.0], [0, 3, 2]),
        ([1.0, 3.0, 1.0, 9.0, 2.0], [0, 3, 2]),  # the shorter of two arcs counts
        ([1.0, 3.0, 0.0, 3.5, 9.0], [0, 3, 2]),  # an arc of no length is an arc
    ],
)
def test_route_is_the_shortest(lengths, expected):
    assert route(POSITIONS, PAIRS, np.array(lengths), 0, 2) == expected


def test_route_there_is_route_back_and_may_be_empty():
    lengths = np.ones(5)
    assert route(POSITIONS, PAIRS, lengths, 2, 0) in ([2, 1, 0], [2, 3, 0])
    assert route(POSITIONS, PAIRS, lengths, 4, 4) == [4]


@pytest.mark.parametrize("goal, line", [(4, "no route leads from place 0 to place 4"), (9, "9")])
def test_a_route_that_does_not_exist_is_refused(goal, line):
    with pytest.raises(ValueError, match=line):
        route(POSITIONS, PAIRS, np.ones(5), 0, goal)
