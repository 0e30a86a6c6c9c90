import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_worlds import clearance, length

from jaxslam.core.se2 import compose
from jaxslam.simulation import worlds
from jaxslam.simulation.path_following import (
    SEARCH_WINDOW,
    densify,
    poses_along,
    pure_pursuit,
)


def driven(path, start, steps):
    """Poses (T, 3), motions (T, 3) and path indices (T,) of a robot that moves without noise."""

    def body(carry, _):
        pose, index = carry
        motion, index = pure_pursuit(path, index, pose)
        pose = compose(pose, motion)
        return (pose, index), (pose, motion, index)

    return jax.lax.scan(body, (start, jnp.int32(0)), length=steps)[1]


@pytest.fixture(scope="module")
def office():
    path = jnp.asarray(densify(worlds.waypoints("office")))
    return path, *driven(path, jnp.append(path[0], 0.0), 420)


def test_densify_keeps_waypoints_and_spacing():
    points = densify(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.52]]))
    gaps = np.hypot(*np.diff(points, axis=0).T)
    np.testing.assert_allclose([points[0], points[-1]], [[0, 0], [1, 0.52]])
    assert np.any(np.all(np.isclose(points, [1, 0]), axis=1))
    assert gaps.max() < 0.06 and length(points) == pytest.approx(1.52)


def test_poses_along_a_path_are_on_it_and_look_where_it_goes():
    corner = [[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]]
    poses = poses_along(corner, 0.5)
    assert len(poses) == 10  # up to 0.3 m before the end, 5 m along
    np.testing.assert_allclose(poses[:4], [[0.5 * k, 0.0, 0.0] for k in range(4)], atol=1e-12)
    np.testing.assert_allclose(poses[4:, 1], 0.5 * np.arange(6), atol=1e-12)
    np.testing.assert_allclose(poses[4:, 2], np.pi / 2, atol=1e-12)
    near = poses_along(corner, 1.9, look_ahead=0.2)[1]  # 0.1 m before the corner: 45 degrees
    np.testing.assert_allclose(near, [1.9, 0.0, np.pi / 4], atol=1e-12)


def test_the_office_drive_arrives_and_rests(office):
    path, poses, motions, index = office
    moves = np.any(np.asarray(motions) != 0.0, axis=1)
    steps = int(moves.sum())
    assert 250 < steps < 400 and moves[:steps].all() and not moves[steps:].any()
    assert np.linalg.norm(poses[-1, :2] - path[-1]) < 0.05
    assert index.dtype == jnp.int32 and np.all(np.diff(index) >= 0)
    assert index[-1] >= len(path) - 2


def test_the_office_drive_keeps_its_bounds_and_its_distance(office):
    _, poses, motions, _ = office
    assert np.hypot(motions[:, 0], motions[:, 1]).max() <= 0.3 + 1e-9
    assert np.abs(motions[:, 2]).max() <= 0.2 + 1e-9
    track = np.asarray(poses[:, :2])
    track = np.concatenate([track, (track[1:] + track[:-1]) / 2])
    assert clearance(track, worlds.named("office").walls).min() >= 0.3


def test_a_robot_beside_its_path_returns_to_it():
    path = jnp.asarray(densify(np.array([[0.0, 0.0], [6.0, 0.0]])))
    poses = driven(path, jnp.array([0.0, 0.4, -0.3]), 30)[0]
    assert np.abs(poses[12:, 1]).max() < 0.02
    assert np.linalg.norm(poses[-1, :2] - path[-1]) < 0.05


def test_a_robot_that_looks_away_turns_on_the_spot():
    path = jnp.asarray(densify(np.array([[0.0, 0.0], [6.0, 0.0]])))
    step, index = jax.jit(pure_pursuit)(path, jnp.int32(0), jnp.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(step, [0.0, 0.0, -0.2], atol=1e-12)
    assert index == 0


def test_only_the_window_ahead_of_the_last_index_is_searched():
    there_and_back = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 0.01], [0.0, 0.01]])
    path = jnp.asarray(densify(there_and_back))
    _, index = jax.jit(pure_pursuit)(path, jnp.int32(10), jnp.array([1.0, 0.01, 0.0]))
    assert 10 <= index < 10 + SEARCH_WINDOW


def test_many_robots_follow_at_once_and_gradients_are_finite():
    path = jnp.asarray(densify(worlds.waypoints("office")))
    poses = jax.random.uniform(jax.random.key(0), (5, 3), minval=0.5, maxval=1.5)
    poses = poses.at[0].set(jnp.append(path[-1], 0.0))
    indices = jnp.array([path.shape[0] - 1, 0, 0, 0, 0], jnp.int32)

    @jax.jit
    def steer(pose, index):
        return pure_pursuit(path, index, pose)[0]

    alone = [steer(pose, index) for pose, index in zip(poses, indices, strict=True)]
    together = jax.jit(jax.vmap(steer))(poses, indices)
    np.testing.assert_allclose(together, jnp.stack(alone), atol=1e-12)
    gradient = jax.jit(jax.vmap(jax.jacrev(steer)))(poses, indices)
    assert np.isfinite(gradient).all()


def test_arguments_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"waypoints is float64 \(3,\), not \(K, 2\)"):
        densify(np.zeros(3))
    with pytest.raises(ValueError, match="waypoints is empty"):
        densify(np.zeros((0, 2)))
    with pytest.raises(ValueError, match="waypoints holds numbers that are not finite"):
        densify([[0.0, np.nan]])
    with pytest.raises(ValueError, match="spacing is 0.0, not above 0"):
        densify([[0.0, 1.0]], 0.0)
    with pytest.raises(ValueError, match=r"path is \(5, 3\), not \(N, 2\)"):
        pure_pursuit(jnp.zeros((5, 3)), jnp.int32(0), jnp.zeros(3))
    with pytest.raises(ValueError, match=r"pose is \(2,\), not \(3,\)"):
        pure_pursuit(jnp.zeros((5, 2)), jnp.int32(0), jnp.zeros(2))


@pytest.mark.parametrize("convert", [np.float32, jnp.asarray, np.ndarray.tolist])
def test_waypoints_are_a_list_or_an_array_of_either_precision(convert):
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.5]])
    np.testing.assert_array_equal(densify(convert(points)), densify(points))
