import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import ekf, topomap
from jaxslam.geometry import to_world
from jaxslam.links import Links
from jaxslam.types import CORNER, NODE, WALL

HERE = jnp.zeros(3)
THERE = jnp.array([2.0, -1.0, 2.2])

add = jax.jit(topomap.add)


def links(*found, size=4, junk=0.0):
    """Links of features (i, j, clearance), each half-way at (i, j), padded to `size` with junk."""
    rest = size - len(found)
    pair = [f[:2] for f in found] + [(0, 1)] * rest
    return Links(
        pair=jnp.array(pair, jnp.int32),
        via=jnp.array([[float(i), float(j)] for i, j, _ in found] + [[junk, junk]] * rest),
        clearance=jnp.array([float(f[2]) for f in found] + [junk] * rest),
        valid=jnp.arange(size) < len(found),
    )


def ids(*known):
    return jnp.array(known, jnp.int32)


def table(arcs):
    """What stands in the slots in use: ends -> (clearance, seen)."""
    seen = np.asarray(arcs.seen)
    ends = [tuple(e) for e in np.asarray(arcs.ends)[seen > 0].tolist()]
    assert len(set(ends)) == len(ends), "an arc stands there twice"
    rows = zip(np.asarray(arcs.clearance)[seen > 0].tolist(), seen[seen > 0].tolist(), strict=True)
    return dict(zip(ends, rows, strict=True))


def belief_of(xy, kind, seen, id=None, shape=None):
    """Belief with landmarks in known states."""
    size = len(kind)
    belief = ekf.initial(HERE, landmarks=size)
    return belief._replace(
        mean=belief.mean.at[3:].set(jnp.array(xy, float).reshape(-1)),
        kind=jnp.array(kind, jnp.int32),
        seen=jnp.array(seen, jnp.int32),
        id=jnp.arange(size, dtype=jnp.int32) if id is None else ids(*id),
        shape=jnp.ones(size) if shape is None else jnp.array(shape, float),
    )


def graph_of(belief, arcs, poses=None, confirm=2):
    far = np.full((1, 3), 99.0)
    return topomap.graph(belief, arcs, far if poses is None else np.array(poses), confirm=confirm)


@pytest.mark.parametrize("clearances", [(0.9, 0.5), (0.5, 0.9)])
def test_the_same_link_twice_is_one_arc_seen_twice_with_the_smaller_clearance(clearances):
    arcs = topomap.empty(arcs=5)
    for clearance in clearances:
        arcs = add(arcs, ids(7, 3), HERE, links((0, 1, clearance)))
    assert table(arcs) == {(3, 7): (0.5, 2)}


def test_the_order_of_the_two_ends_does_not_matter():
    one, other = (
        add(topomap.empty(arcs=3), known, THERE, links((0, 1, 0.5)))
        for known in (ids(4, 9), ids(9, 4))
    )
    jax.tree.map(np.testing.assert_array_equal, one, other)
    swapped = links((0, 1, 0.5))
    swapped = swapped._replace(pair=swapped.pair[:, ::-1])
    jax.tree.map(
        np.testing.assert_array_equal,
        one,
        add(one._replace(seen=one.seen * 0), *(ids(9, 4), THERE, swapped)),
    )


def test_the_middle_of_an_arc_is_in_the_world_frame_where_it_was_seen_last():
    arcs = topomap.empty(arcs=3)
    for pose in (HERE, THERE):
        arcs = add(arcs, ids(4, 9), pose, links((0, 1, 0.5)))
        np.testing.assert_allclose(arcs.via[0], to_world(pose, jnp.array([0.0, 1.0])), atol=1e-12)


def test_links_of_features_without_landmark_or_of_one_landmark_are_ignored():
    start = add(topomap.empty(arcs=5), ids(1, 2, 0), HERE, links((0, 1, 0.5)))
    found = links((0, 1, 0.4), (1, 2, 0.4), (0, 2, 0.4))
    for known in (ids(-1, 1, -1), ids(-1, -1, -1), ids(2, 2, 2)):
        jax.tree.map(np.testing.assert_array_equal, add(start, known, THERE, found), start)


@pytest.mark.parametrize("junk", [7.0, np.nan])
def test_padding_is_invisible(junk):
    known = ids(1, 2, 0)
    clean, dirty = (
        add(topomap.empty(arcs=5), known, THERE, links((0, 2, 0.5), junk=x)) for x in (0.0, junk)
    )
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    assert table(clean) == {(0, 1): (0.5, 1)}


def test_a_full_map_drops_new_arcs_and_still_counts_the_old():
    arcs = topomap.empty(arcs=2)
    arcs = add(arcs, ids(0, 1, 2), HERE, links((0, 1, 0.5), (1, 2, 0.5), (0, 2, 0.5)))
    assert set(table(arcs)) == {(0, 1), (1, 2)}
    arcs = add(arcs, ids(5, 1, 0), HERE, links((0, 1, 0.1), (1, 2, 0.2)))
    assert table(arcs) == {(0, 1): (0.2, 2), (1, 2): (0.5, 1)}


@pytest.mark.parametrize("seed", range(4))
def test_a_run_agrees_with_a_dictionary(seed):
    random, steps, features, size = np.random.default_rng(seed), 12, 5, 6
    pairs = np.array([random.permutation(features)[:2] for _ in range(steps * size)])
    known = np.stack([random.permutation(10)[:features] - 2 for _ in range(steps)])
    known[known < 0] = -1
    # One scan sees a pair of features once.
    pairs = pairs.reshape(steps, size, 2)
    first = [[sorted(p) not in np.sort(q[:k]).tolist() for k, p in enumerate(q)] for q in pairs]
    log = Links(
        pair=jnp.array(pairs, jnp.int32),
        via=jnp.array(random.normal(size=(steps, size, 2))),
        clearance=jnp.array(random.random((steps, size))),
        valid=jnp.array(first) & jnp.array(random.random((steps, size)) < 0.7),
    )
    poses = jnp.array(random.normal(size=(steps, 3)))
    arcs = jax.jit(topomap.build, static_argnames="arcs")(
        jnp.array(known, jnp.int32), poses, log, arcs=64
    )
    want = {}
    for t, k in np.argwhere(np.asarray(log.valid)):
        a, b = sorted(known[t, pairs[t, k]].tolist())
        if a >= 0:
            clearance, seen = want.get((a, b), (np.inf, 0))
            want[a, b] = min(clearance, float(log.clearance[t, k])), seen + 1
    assert len(want) > 8
    assert table(arcs) == want


def test_arcs_stay_with_their_landmarks_when_these_move():
    arcs = add(topomap.empty(arcs=4), ids(10, 11, 12), HERE, links((0, 1, 0.5), (1, 2, 0.5)))
    xy = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
    before = graph_of(belief_of(xy, [NODE] * 3, [3] * 3, id=[10, 11, 12]), arcs)
    # The landmarks move, and change slots.
    order = np.array([2, 0, 1])
    belief = belief_of((xy + 0.5)[order], [NODE] * 3, [3] * 3, id=np.array([10, 11, 12])[order])
    after = graph_of(belief, arcs)
    named = lambda g: {tuple(sorted(g.id[pair].tolist())) for pair in g.pairs}
    assert named(before) == named(after) == {(10, 11), (11, 12)}
    for g, shift in ((before, 0.0), (after, 0.5)):
        np.testing.assert_allclose(g.xy[np.argsort(g.id)], xy + shift)
        ends = g.xy[g.pairs] - g.via[:, None]
        np.testing.assert_allclose(g.length, np.hypot(ends[..., 0], ends[..., 1]).sum(axis=1))
        assert np.all(g.length >= np.hypot(*(g.xy[g.pairs[:, 0]] - g.xy[g.pairs[:, 1]]).T))


def test_the_graph_holds_confirmed_landmarks_and_arcs_between_nodes_only():
    kind = [NODE, CORNER, NODE, WALL, NODE, NODE, CORNER]
    seen = [2, 5, 1, 9, 3, 0, 1]  # the third is not confirmed, the slot of the sixth is free
    belief = belief_of(np.arange(14.0).reshape(7, 2), kind, seen, shape=np.arange(1.0, 8.0))
    everything = [(i, j, 0.5) for i in range(7) for j in range(i)]
    arcs = add(
        topomap.empty(arcs=40), jnp.arange(7, dtype=jnp.int32), HERE, links(*everything, size=25)
    )
    assert len(table(arcs)) == 21
    graph = graph_of(belief, arcs)
    np.testing.assert_array_equal(graph.id, [0, 1, 4])
    np.testing.assert_array_equal(graph.kind, [NODE, CORNER, NODE])
    np.testing.assert_array_equal(graph.xy, [[0, 1], [2, 3], [8, 9]])
    np.testing.assert_array_equal(graph.clearance, [1, 0, 5])
    np.testing.assert_array_equal(graph.id[graph.pairs], [[0, 4]])
    assert [len(x) for x in graph] == [3, 3, 3, 3, 1, 1, 1, 1]
    loose = graph_of(belief, arcs, confirm=1)
    np.testing.assert_array_equal(loose.id, [0, 1, 2, 4, 6])
    assert {tuple(sorted(p)) for p in loose.id[loose.pairs].tolist()} == {(0, 2), (0, 4), (2, 4)}


def test_a_slot_used_again_does_not_inherit_arcs():
    arcs = add(topomap.empty(arcs=4), ids(0, 1), HERE, links((0, 1, 0.5)))
    belief = belief_of([[0, 0], [1, 0]], [NODE] * 2, [3, 3], id=[0, 8])  # 1 was forgotten
    assert len(graph_of(belief, arcs).pairs) == 0


def test_an_empty_map_has_shapes():
    graph = graph_of(ekf.initial(HERE, landmarks=5), topomap.empty(arcs=4))
    assert [x.shape for x in graph] == [(0,), (0, 2), (0,), (0,), (0, 2), (0,), (0,), (0, 2)]
    assert graph.pairs.dtype.kind == "i"


def test_nodes_the_robot_drove_between_are_joined():
    belief = belief_of([[0, 0], [3, 0], [6, 0]], [NODE] * 3, [3] * 3)
    arcs = add(topomap.empty(arcs=4), ids(0, 1), HERE, links((0, 1, 0.5)))
    way = [[x, 0.3, 0.0] for x in np.arange(0.0, 6.1, 0.5)]
    graph = graph_of(belief, arcs, way)
    # The first pair was seen as well as driven; what was seen stands, with its clearance.
    np.testing.assert_array_equal(graph.pairs, [[0, 1], [1, 2]])
    np.testing.assert_array_equal(graph.arc_clearance, [0.5, np.nan])
    np.testing.assert_allclose(graph.via[1], [4.5, 0.3], atol=0.51)


@pytest.mark.parametrize(
    "way, pairs",
    [
        ([0.0, 0.5, 2.0, 0.5, 0.0], []),  # out of a circle and back into it
        ([0.0, 2.0, 4.0], [(0, 1)]),
        ([4.0, 2.0, 0.0, 4.0], [(0, 1)]),  # the smaller first, once
        ([0.0, 4.0, 6.0, 8.0, 0.0], [(0, 1), (1, 2), (0, 2)]),
        ([2.0, 6.0], []),  # in no circle
        ([7.4, 7.6], [(2, 3)]),  # in two: the nearer counts
    ],
)
def test_the_trail_goes_from_circle_to_circle(way, pairs):
    xy = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [7.0, 0.0]])
    poses = np.array([[x, 0.0, 1.0] for x in way])
    found = topomap.trail(xy, np.array([1.0, 1.0, 0.9, 0.9]), poses)
    assert list(found) == pairs
    for place in found.values():
        assert poses[:, 0].min() <= place[0] <= poses[:, 0].max() and place[1] == 0.0
