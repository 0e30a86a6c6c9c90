import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_world import clearance, length

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.se2 import compose
from jaxslam.mapping.routes import find_route
from jaxslam.simulation import worlds
from jaxslam.simulation.path_following import SEARCH_WINDOW, densify, pure_pursuit


def driven(path, start, steps):
    """Poses (T, 3), motions (T, 3) and places (T,) of a robot that follows `path` without noise."""

    def body(now, _):
        pose, place = now
        motion, place = pure_pursuit(path, place, pose)
        pose = compose(pose, motion)
        return (pose, place), (pose, motion, place)

    return jax.lax.scan(body, (start, jnp.int32(0)), length=steps)[1]


@pytest.fixture(scope="module")
def office():
    path = jnp.asarray(densify(worlds.waypoints("office")))
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
    assert clearance(track, worlds.named("office").walls).min() >= 0.3


def test_a_robot_beside_its_path_returns_to_it():
    path = jnp.asarray(densify(np.array([[0.0, 0.0], [6.0, 0.0]])))
    poses = driven(path, jnp.array([0.0, 0.4, -0.3]), 30)[0]
    assert np.abs(poses[12:, 1]).max() < 0.02
    assert np.linalg.norm(poses[-1, :2] - path[-1]) < 0.05


def test_a_robot_that_looks_away_turns_on_the_spot():
    path = jnp.asarray(densify(np.array([[0.0, 0.0], [6.0, 0.0]])))
    step, place = jax.jit(pure_pursuit)(path, jnp.int32(0), jnp.array([0.0, 0.0, 3.0]))
    np.testing.assert_allclose(step, [0.0, 0.0, -0.2], atol=1e-12)
    assert place == 0


def test_only_the_window_ahead_of_the_last_place_counts():
    there_and_back = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 0.01], [0.0, 0.01]])
    path = jnp.asarray(densify(there_and_back))
    _, place = jax.jit(pure_pursuit)(path, jnp.int32(10), jnp.array([1.0, 0.01, 0.0]))
    assert 10 <= place < 10 + SEARCH_WINDOW


def test_many_robots_follow_at_once_and_gradients_are_finite():
    path = jnp.asarray(densify(worlds.waypoints("office")))
    poses = jax.random.uniform(jax.random.key(0), (5, 3), minval=0.5, maxval=1.5)
    poses = poses.at[0].set(jnp.append(path[-1], 0.0))
    places = jnp.array([path.shape[0] - 1, 0, 0, 0, 0], jnp.int32)
    steer = jax.jit(lambda pose, place: pure_pursuit(path, place, pose)[0])
    alone = [steer(pose, place) for pose, place in zip(poses, places, strict=True)]
    together = jax.jit(jax.vmap(steer))(poses, places)
    np.testing.assert_allclose(together, jnp.stack(alone), atol=1e-12)
    slope = jax.jit(jax.vmap(jax.jacrev(steer)))(poses, places)
    assert np.isfinite(slope).all()


PLACES = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [5, 5]], float)
PAIRS = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 3]])


def graph_of(lengths, clearance=(1.0,) * 5):
    """A square of five arcs, two of them between the same nodes, and a node apart."""
    lines = [PLACES[pair] for pair in PAIRS[:4]]
    lines.append(np.array([PLACES[0], [-1.0, 0.5], PLACES[3]]))
    return TopologicalMap(
        id=np.arange(5),
        xy=PLACES,
        kind=np.zeros(5, int),
        clearance=np.ones(5),
        arc_ends=PAIRS,
        arc_length=np.array(lengths, float),
        arc_clearance=np.array(clearance),
        arc_lines=tuple(lines),
    )


@pytest.mark.parametrize(
    "lengths, nodes, arcs",
    [
        ([1.0, 1.0, 1.0, 3.0, 4.0], [0, 1, 2], [0, 1]),
        ([1.0, 5.0, 1.0, 3.0, 4.0], [0, 3, 2], [3, 2]),
        ([1.0, 3.0, 1.0, 9.0, 2.0], [0, 3, 2], [4, 2]),  # the shorter of two arcs counts
        ([1.0, 3.0, 0.0, 3.5, 9.0], [0, 3, 2], [3, 2]),  # an arc of no length is an arc
    ],
)
def test_route_is_the_shortest_and_its_line_goes_from_end_to_end(lengths, nodes, arcs):
    found = find_route(graph_of(lengths), 0, 2)
    assert (found.nodes, found.arcs) == (nodes, arcs)
    assert found.length == np.sum(np.array(lengths)[arcs])
    np.testing.assert_array_equal(found.line[[0, -1]], PLACES[[0, 2]])
    for place in PLACES[nodes]:
        assert np.any(np.all(found.line == place, axis=1))


def test_a_route_keeps_its_clearance():
    graph = graph_of([1.0, 1.0, 1.0, 3.0, 4.0], [0.3, 0.9, 0.5, np.nan, 0.6])
    assert find_route(graph, 0, 2).arcs == [0, 1]
    assert find_route(graph, 0, 2, min_clearance=0.4).arcs == [4, 2]  # not where none is known
    with pytest.raises(ValueError, match="no route leads from place 0 to place 2"):
        find_route(graph, 0, 2, min_clearance=0.55)


def test_route_there_is_route_back_and_may_be_empty():
    graph = graph_of(np.ones(5))
    assert find_route(graph, 2, 0).nodes in ([2, 1, 0], [2, 3, 0])
    rest = find_route(graph, 4, 4)
    assert (rest.nodes, rest.arcs, rest.length) == ([4], [], 0.0)
    np.testing.assert_array_equal(rest.line, PLACES[[4]])


@pytest.mark.parametrize("goal, line", [(4, "no route leads from place 0 to place 4"), (9, "9")])
def test_a_route_that_does_not_exist_is_refused(goal, line):
    with pytest.raises(ValueError, match=line):
        find_route(graph_of(np.ones(5)), 0, goal)


def test_arguments_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"waypoints is \(3,\), not \(K >= 1, 2\)"):
        densify(np.zeros(3))
    with pytest.raises(ValueError, match=r"path is \(5, 3\), not \(N, 2\)"):
        pure_pursuit(jnp.zeros((5, 3)), jnp.int32(0), jnp.zeros(3))
    with pytest.raises(ValueError, match=r"pose is \(2,\), not \(3,\)"):
        pure_pursuit(jnp.zeros((5, 2)), jnp.int32(0), jnp.zeros(2))
