"""The map: arcs merged scan by scan, and the graph that comes of them."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import networkx
import numpy as np
import pytest

from jaxslam.core import polylines
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose, inverse_transform, transform
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering.belief import initial_belief
from jaxslam.frontend.arc_tracing import POLYLINE_POINTS
from jaxslam.frontend.local_graph import LocalArcs
from jaxslam.mapping import arc_table, graph_arcs, routes, topological_map

HERE = jnp.zeros(3)
THERE = jnp.array([2.0, -1.0, 2.2])
LIDAR = Lidar(num_beams=91, angle_increment=np.pi / 90)
BLIND = Scan(jnp.full(91, 0.1), jnp.ones(91, bool))  # sees nothing free
PLACES = np.stack([3.0 * np.arange(12), np.arange(12) ** 2 / 4], axis=1)  # of features, world

_add = jax.jit(arc_table.add_scan_arcs, static_argnames="lidar")


def add(arcs, ids, pose, links, scan=BLIND):
    return _add(arcs, ids, pose, links, scan, lidar=LIDAR)


def curve(a, b, bulge=0.0):
    """Line (K, 2) from `a` to `b`, `bulge` [m] to the left of the chord in the middle."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    part = np.linspace(0, 1, 50)[:, None]
    side = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    return polylines.resample_np(
        a + part * (b - a) + bulge * np.sin(np.pi * part) * side, POLYLINE_POINTS
    )


def linked(*found, size=4, junk=0.0, pose=HERE):
    """Links in the frame of `pose`, padded to `size` with junk.

    Each of `found` is (i, j, clearance, bulge or end of a frontier if j is -1), `i` at PLACES[i].
    """
    pair = np.zeros((size, 2), int)
    line, clearance = np.full((size, POLYLINE_POINTS, 2), junk), np.full(size, junk)
    for k, (i, j, room, *more) in enumerate(found):
        pair[k], clearance[k] = (i, j), room
        line[k] = curve(PLACES[i], *more) if j < 0 else curve(PLACES[i], PLACES[j], *more)
    return LocalArcs(
        pair=jnp.array(pair, jnp.int32),
        polyline=inverse_transform(pose, jnp.asarray(line)),
        length=jnp.asarray(polylines.length(line)),
        clearance=jnp.asarray(clearance),
        valid=jnp.arange(size) < len(found),
    )


def ids(*known):
    """Landmarks of 12 features, none of those not given."""
    return jnp.array([*known, *[-1] * (12 - len(known))], jnp.int32)


def rows(arcs):
    """What stands in the slots in use: (ends, clearance, seen), sorted."""
    used = np.flatnonzero(arcs.num_seen)
    table = [(tuple(np.asarray(arcs.ends)[k].tolist()), float(arcs.clearance[k])) for k in used]
    return sorted((*row, int(arcs.num_seen[k])) for row, k in zip(table, used, strict=True))


def arcs_of(*found):
    """Arcs (ends, line), seen once each."""
    arcs = jax.tree.map(np.array, arc_table.empty_arcs(capacity=12))
    for k, (ends, line) in enumerate(found):
        arcs.ends[k], arcs.polyline[k], arcs.num_seen[k] = ends, line, 1
        arcs.length[k] = polylines.length(line)
    return arcs


def belief_of(xy, kind, seen, id=None, shape=None):
    """Belief with landmarks in known states."""
    size = len(kind)
    belief = initial_belief(HERE, max_landmarks=size)
    return belief._replace(
        mean=belief.mean.at[3:].set(jnp.array(xy, float).reshape(-1)),
        kind=jnp.array(kind, jnp.int32),
        num_seen=jnp.array(seen, jnp.int32),
        id=jnp.array(np.arange(size) if id is None else id, jnp.int32),
        descriptor=jnp.ones(size) if shape is None else jnp.array(shape, float),
    )


def graph_of(belief, arcs, poses=None, confirm=2):
    far = np.full((1, 3), 99.0)
    return topological_map.build_map(
        belief, arcs, far if poses is None else np.array(poses), confirm_count=confirm
    )


@pytest.mark.parametrize("clearances", [(0.9, 0.5), (0.5, 0.9)])
def test_the_same_link_twice_is_one_arc_seen_twice_with_the_smaller_clearance(clearances):
    arcs = arc_table.empty_arcs(capacity=12)
    for clearance, bulge in zip(clearances, (0.2, 0.4), strict=True):
        arcs = add(arcs, ids(3, 7), HERE, linked((0, 1, clearance, bulge)))
    assert rows(arcs) == [((3, 7), 0.5, 2)]
    want = [curve(PLACES[0], PLACES[1], bulge) for bulge in (0.2, 0.4)]
    np.testing.assert_allclose(arcs.polyline[0], np.mean(want, axis=0), atol=1e-9)
    np.testing.assert_allclose(arcs.length[0], polylines.length(np.array(want)).mean())


def test_the_order_of_the_two_ends_does_not_matter():
    one = add(
        arc_table.empty_arcs(capacity=12), ids(4, 9), THERE, linked((0, 1, 0.5, 0.3), pose=THERE)
    )
    turned = linked((1, 0, 0.5, -0.3), pose=THERE)
    other = add(arc_table.empty_arcs(capacity=12), ids(4, 9), THERE, turned)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), one, other)
    np.testing.assert_allclose(one.polyline[0], curve(PLACES[0], PLACES[1], 0.3), atol=1e-9)
    both = add(one, ids(4, 9), THERE, turned)
    assert rows(both) == [((4, 9), 0.5, 2)]


def test_two_branches_between_two_nodes_are_two_arcs_in_either_order():
    one, other = linked((0, 1, 0.5, 1.0), (0, 1, 0.4, -1.0)), linked((0, 1, 0.3, -1.1))
    arcs = add(arc_table.empty_arcs(capacity=12), ids(2, 5), HERE, one)
    assert rows(arcs) == [((2, 5), 0.4, 1), ((2, 5), 0.5, 1)]
    assert rows(add(arcs, ids(2, 5), HERE, other)) == [((2, 5), 0.3, 2), ((2, 5), 0.5, 1)]
    twins = linked((0, 1, 0.5, 1.0), (0, 1, 0.4, 1.1))
    assert rows(add(arc_table.empty_arcs(capacity=12), ids(2, 5), HERE, twins)) == [
        ((2, 5), 0.5, 1)
    ]


def test_an_arc_is_known_again_when_the_estimate_has_drifted():
    arcs = add(arc_table.empty_arcs(capacity=12), ids(2, 5), HERE, linked((0, 1, 0.5, 0.8)))
    drifted = compose(THERE, jnp.array([2.0, 1.0, 0.5]))
    arcs = add(arcs, ids(2, 5), drifted, linked((0, 1, 0.5, 0.8), pose=THERE))
    assert rows(arcs) == [((2, 5), 0.5, 2)]


def test_links_of_features_without_landmark_or_of_one_landmark_are_ignored():
    start = add(arc_table.empty_arcs(capacity=12), ids(1, 2, 0), HERE, linked((0, 1, 0.5)))
    found = linked((0, 1, 0.4), (1, 2, 0.4), (0, 2, 0.4))
    for known in (ids(-1, 1, -1), ids(-1, -1, -1), ids(2, 2, 2)):
        jax.tree.map(np.testing.assert_array_equal, add(start, known, THERE, found), start)


@pytest.mark.parametrize("junk", [7.0, np.nan])
def test_padding_is_invisible(junk):
    known = ids(1, 2, 0)
    clean, dirty = (
        add(arc_table.empty_arcs(capacity=12), known, THERE, linked((0, 2, 0.5), junk=x))
        for x in (0.0, junk)
    )
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    assert rows(clean) == [((0, 1), 0.5, 1)]


def test_a_full_map_drops_new_arcs_and_still_counts_the_old():
    arcs = arc_table.empty_arcs(capacity=2)
    arcs = add(arcs, ids(0, 1, 2), HERE, linked((0, 1, 0.5), (1, 2, 0.5), (0, 2, 0.5)))
    assert rows(arcs) == [((0, 1), 0.5, 1), ((1, 2), 0.5, 1)]
    arcs = add(arcs, ids(5, 1, 2), HERE, linked((0, 1, 0.1), (1, 2, 0.2)))
    assert rows(arcs) == [((0, 1), 0.5, 1), ((1, 2), 0.2, 2)]


@pytest.mark.parametrize("seed", range(4))
def test_a_run_agrees_with_a_dictionary(seed):
    """Straight arcs between places in a row of scans that begins anew half-way."""
    random, steps, size = np.random.default_rng(seed), 12, 6
    known = np.stack([random.permutation(len(PLACES)) - 2 for _ in range(steps)])
    known[known < 0] = -1
    at = lambda t: np.argsort(np.argsort(np.where(known[t] < 0, 99, known[t])))
    poses = jnp.array(random.normal(size=(steps, 3)))
    log, want = [], {}
    for t in range(steps):
        pairs = {tuple(sorted(random.permutation(len(PLACES))[:2].tolist())) for _ in range(size)}
        rooms = {pair: random.random() for pair in sorted(pairs)}
        one = linked(*[(i, j, room) for (i, j), room in rooms.items()], size=size)
        # A feature lies at the place of its landmark.
        xy = PLACES[at(t)][np.asarray(one.pair)]
        line = np.array(
            [curve(a, b) if np.any(a != b) else np.zeros((POLYLINE_POINTS, 2)) for a, b in xy]
        )
        log.append(one._replace(polyline=inverse_transform(poses[t], jnp.asarray(line))))
        for pair, room in rooms.items():
            a, b = sorted(known[t, list(pair)].tolist())
            if a >= 0:
                clearance, count = want.get((a, b), (np.inf, 0))
                want[a, b] = min(clearance, room), count + 1
    run = jax.tree.map(lambda *x: jnp.stack(x), *log)
    scans = jax.tree.map(lambda x: jnp.stack([x] * steps), BLIND)
    arcs = arc_table.empty_arcs(capacity=64)
    for k in range(steps):
        told = (jnp.array(known, jnp.int32), poses, run, scans)
        arcs = add(arcs, *jax.tree.map(lambda x: x[k], told))  # noqa: B023
    assert len(want) > 8
    assert rows(arcs) == sorted((ends, *rest) for ends, rest in want.items())


@pytest.mark.parametrize(
    "wrong, told",
    [
        ({"ids": jnp.zeros(4)}, "ids is float64"),
        ({"pose": jnp.zeros(2)}, r"pose is \(2,\), not \(3,\)"),
        ({"scan": BLIND._replace(ranges=jnp.zeros(7))}, r"scan.ranges is \(7,\), not \(91,\)"),
        (
            {"links": linked(size=3)._replace(polyline=jnp.zeros((3, 2)))},
            r"links.line is \(3, 2\), not",
        ),
    ],
)
def test_arguments_that_do_not_fit_are_named(wrong, told):
    given = {"ids": ids(0, 1), "pose": HERE, "links": linked(size=3), "scan": BLIND} | wrong
    with pytest.raises(ValueError, match=told):
        add(arc_table.empty_arcs(capacity=12), **given)


# Frontiers.


def test_a_frontier_moves_ahead_and_goes_when_it_is_seen_free():
    arcs = add(arc_table.empty_arcs(capacity=12), ids(6), HERE, linked((0, -1, 0.5, (4.0, 0.0))))
    assert rows(arcs) == [((6, -1), 0.5, 1)]
    arcs = add(arcs, ids(6), HERE, linked((0, -1, 0.5, (4.6, 0.0))))
    arcs = add(arcs, ids(6), HERE, linked((0, -1, 0.5, (4.2, 0.0))))
    assert rows(arcs) == [((6, -1), 0.5, 3)]  # the longest stands
    np.testing.assert_allclose(arcs.polyline[0, -1], [4.6, 0.0], atol=1e-9)
    two = add(arcs, ids(6), HERE, linked((0, -1, 0.4, (0.0, 4.0))))
    assert len(rows(two)) == 2
    pose = jnp.array([2.0, 1.0, -0.4])
    for reach, left in ((2.7, 2), (3.1, 1)):  # it is 2.8 m away, and so far wall is no mystery
        after = add(two, ids(-1), pose, linked(), Scan(jnp.full(91, reach), jnp.ones(91, bool)))
        assert len(rows(after)) == left
    no_wall = Scan(jnp.full(91, 3.1), jnp.zeros(91, bool))
    assert len(rows(add(two, ids(-1), pose, linked(), no_wall))) == 2
    behind = compose(pose, jnp.array([0.0, 0.0, np.pi]))
    after = add(two, ids(-1), behind, linked(), Scan(jnp.full(91, 9.0), BLIND.hit))
    assert rows(after) == [((6, -1), 0.5, 3)]  # it is not in view, the other is


def test_the_graph_keeps_frontiers_that_lead_to_nothing_known():
    belief = belief_of(PLACES[:3], [JUNCTION] * 3, [3] * 3)
    onto = curve(PLACES[0], PLACES[1])[5]
    arcs = add(
        arc_table.empty_arcs(capacity=12),
        ids(*range(3)),
        HERE,
        linked((0, 1, 0.5), (0, -1, 0.5, (0.0, 3.0)), (2, -1, 0.5, onto), (1, -1, 0.5, PLACES[2])),
    )
    graph = graph_of(belief, arcs, confirm=1)
    assert graph.frontier_node.tolist() == [0]
    np.testing.assert_allclose(graph.frontiers[0][[0, -1]], [[0.0, 0.0], [0.0, 3.0]], atol=1e-9)
    # The one that ended on a node is an arc to it.
    assert {tuple(sorted(p)) for p in graph.arc_ends.tolist()} == {(0, 1), (1, 2)}
    assert graph_of(belief, arcs).frontiers == ()  # seen once only


# The graph.


def test_arcs_move_with_their_landmarks():
    """The graph of moved landmarks is the moved graph."""
    arcs = add(
        arc_table.empty_arcs(capacity=12),
        ids(10, 11, 12),
        HERE,
        linked((0, 1, 0.5, 0.7), (1, 2, 0.5)),
    )
    before = graph_of(belief_of(PLACES[:3], [JUNCTION] * 3, [3] * 3, id=[10, 11, 12]), arcs)
    moved = np.asarray(transform(jnp.array([0.5, -2.0, 1.1]), jnp.asarray(PLACES[:3])))
    # The landmarks also change slots.
    order = np.array([2, 0, 1])
    belief = belief_of(moved[order], [JUNCTION] * 3, [3] * 3, id=np.array([10, 11, 12])[order])
    after = graph_of(belief, arcs)
    named = lambda g: {tuple(g.id[pair].tolist()): k for k, pair in enumerate(g.arc_ends)}
    assert set(named(before)) == set(named(after)) == {(10, 11), (11, 12)}
    np.testing.assert_allclose(before.arc_lines[0], curve(PLACES[0], PLACES[1], 0.7), atol=1e-9)
    for name, k in named(before).items():
        want = transform(jnp.array([0.5, -2.0, 1.1]), jnp.asarray(before.arc_lines[k]))
        np.testing.assert_allclose(after.arc_lines[named(after)[name]], want, atol=1e-9)
        np.testing.assert_allclose(after.arc_length[named(after)[name]], before.arc_length[k])
    stretched = belief_of(PLACES[:3] * 1.5, [JUNCTION] * 3, [3] * 3, id=[10, 11, 12])
    for g in (before, after, graph_of(stretched, arcs)):
        for line, pair, length in zip(g.arc_lines, g.arc_ends, g.arc_length, strict=True):
            np.testing.assert_allclose(line[[0, -1]], g.xy[pair], atol=1e-9)
            np.testing.assert_allclose(length, polylines.length(line), rtol=1e-6)


def test_landmarks_of_one_place_are_one_node():
    place = [[0.0, 0.0], [3.0, 0.25], [3.1, 0.3], [3.0, 0.3], [6.0, 1.0]]
    shape = [1.0, 1.0, 1.1, 2.0, 1.0]  # the fourth is at the place, but of another size
    belief = belief_of(place, [JUNCTION] * 5, [3, 3, 1, 3, 3], id=[7, 4, 2, 1, 9], shape=shape)
    arcs = arc_table.empty_arcs(capacity=12)
    arcs = add(arcs, ids(7, 2, 9), HERE, linked((0, 1, 0.5), (1, 2, 0.4)))
    arcs = add(arcs, ids(7, 4), HERE, linked((0, 1, 0.6)))
    arcs = jax.tree.map(np.array, arcs)
    arcs.ends[5], arcs.polyline[5], arcs.num_seen[5] = [2, 4], curve(place[1], place[2]), 1
    # Landmark 2 is not confirmed: 4 stands for both, and their arcs are its.
    graph = graph_of(belief, arcs)
    assert graph.id.tolist() == [7, 4, 1, 9]
    rooms = graph.arc_clearance.tolist()
    named = {tuple(graph.id[p].tolist()): c for p, c in zip(graph.arc_ends, rooms, strict=True)}
    assert named == {(4, 7): 0.5, (4, 9): 0.4}
    assert graph_of(belief, arcs, confirm=1).id.tolist() == [7, 2, 1, 9]


def test_parallel_arcs_a_ring_and_a_loop_are_kept():
    corners = np.array([[0, 0], [3, 0], [3, 3], [0, 3], [3.1, 3.0]], float)
    belief = belief_of(corners, [JUNCTION] * 5, [3] * 5, shape=np.full(5, 0.5))
    line = [curve(corners[a], corners[b]) for a, b in pairwise([0, 1, 2, 3, 0])]
    line.append(curve(corners[0], corners[1], -1.5))
    turn = np.linspace(0, 2 * np.pi, 80)[:, None]
    around = corners[2] + np.concatenate([1 - np.cos(turn), np.sin(turn)], axis=1)
    line.append(polylines.resample_np(np.concatenate([around[:-5], corners[4:]]), POLYLINE_POINTS))
    line[3] = line[3][::-1]
    ends = [[0, 1], [1, 2], [2, 3], [0, 3], [0, 1], [2, 4]]
    arcs = arcs_of(*zip(ends, line, strict=True))
    graph = graph_of(belief, arcs)
    assert graph.id.tolist() == [0, 1, 2, 3]  # 4 is at the place of 2
    assert sorted(graph.arc_ends.tolist()) == [[0, 1], [0, 1], [0, 3], [1, 2], [2, 2], [2, 3]]
    (loop,) = (n for n, pair in enumerate(graph.arc_ends.tolist()) if pair == [2, 2])
    np.testing.assert_allclose(graph.arc_lines[loop][[0, -1]], corners[[2, 2]], atol=1e-9)
    assert 5.0 < graph.arc_length[loop] < 2 * np.pi


def test_an_arc_through_a_node_is_two():
    xy = np.array([[0, 0], [3, 0.3], [6, 0], [3, 0.9]], float)
    belief = belief_of(xy, [JUNCTION] * 4, [3] * 4)
    arcs = arcs_of(([0, 2], curve(xy[0], xy[2])))
    graph = graph_of(belief, arcs)
    assert graph.arc_ends.tolist() == [[0, 1], [1, 2]]
    np.testing.assert_allclose(
        [x[[0, -1]] for x in graph.arc_lines], xy[[[0, 1], [1, 2]]], atol=1e-9
    )
    np.testing.assert_allclose(graph.arc_length, 3.0, atol=0.1)


def test_the_graph_holds_confirmed_landmarks_and_arcs_between_nodes_only():
    kind = [JUNCTION, CORNER, JUNCTION, WALL, JUNCTION, JUNCTION, CORNER]
    seen = [2, 5, 1, 9, 3, 0, 1]  # the third is not confirmed, the slot of the sixth is free
    belief = belief_of(np.arange(14.0).reshape(7, 2), kind, seen, shape=np.arange(1.0, 8.0))
    everything = [(i, j, 0.5) for i in range(7) for j in range(i)]
    arcs = add(
        arc_table.empty_arcs(capacity=40), ids(*range(7)), HERE, linked(*everything, size=25)
    )
    assert len(rows(arcs)) == 21
    graph = graph_of(belief, arcs)
    np.testing.assert_array_equal(graph.id, [0, 1, 4])
    np.testing.assert_array_equal(graph.kind, [JUNCTION, CORNER, JUNCTION])
    np.testing.assert_array_equal(graph.xy, [[0, 1], [2, 3], [8, 9]])
    np.testing.assert_array_equal(graph.clearance, [1, 0, 5])
    np.testing.assert_array_equal(graph.id[graph.arc_ends], [[0, 4]])
    assert [len(x) for x in graph] == [3, 3, 3, 3, 1, 1, 1, 1, 0, 0]
    loose = graph_of(belief, arcs, confirm=1)
    np.testing.assert_array_equal(loose.id, [0, 1, 2, 4, 6])
    # The arc from 0 to 4 goes through 2, now that it counts.
    assert {tuple(sorted(p)) for p in loose.id[loose.arc_ends].tolist()} == {(0, 2), (2, 4)}


def test_a_slot_used_again_does_not_inherit_arcs():
    arcs = add(arc_table.empty_arcs(capacity=12), ids(0, 1), HERE, linked((0, 1, 0.5)))
    belief = belief_of([[0, 0], [1, 0]], [JUNCTION] * 2, [3, 3], id=[0, 8])  # 1 was forgotten
    assert len(graph_of(belief, arcs).arc_ends) == 0


def test_an_empty_map_has_shapes():
    graph = graph_of(initial_belief(HERE, max_landmarks=5), arc_table.empty_arcs(capacity=12))
    assert [x.shape for x in graph[:7]] == [(0,), (0, 2), (0,), (0,), (0, 2), (0,), (0,)]
    assert graph.arc_lines == graph.frontiers == () and graph.frontier_node.shape == (0,)
    assert graph.arc_ends.dtype.kind == "i"


# What was driven.


def test_nodes_the_robot_drove_between_are_joined_if_no_arcs_lead_the_same_way():
    belief = belief_of(PLACES[:4] * [1, 0], [JUNCTION] * 4, [3] * 4)
    flat = linked((0, 1, 0.5), (1, 2, 0.5))
    flat = flat._replace(polyline=flat.polyline.at[..., 1].set(0.0))
    arcs = add(arc_table.empty_arcs(capacity=12), ids(0, 1, 2), HERE, flat)
    way = [[x, 0.3, 0.0] for x in np.arange(0.0, 9.1, 0.5)]
    graph = graph_of(belief, arcs, way)
    np.testing.assert_array_equal(graph.arc_ends, [[0, 1], [1, 2], [2, 3]])
    np.testing.assert_array_equal(graph.arc_clearance, [0.5, 0.5, np.nan])
    np.testing.assert_allclose(
        graph.arc_lines[2][[0, 4, 8]], [[6, 0], [7.5, 0.3], [9, 0]], atol=0.1
    )
    # Past the second node at two metres: no way that arcs lead, and no node's circle on it.
    far = [[x, 2.0 * np.sin(np.pi * x / 6.0), 0.0] for x in np.arange(0.0, 6.1, 0.5)]
    assert [0, 2] in graph_of(belief, arcs, far).arc_ends.tolist()
    # Beside it, though outside its circle: where arcs lead.
    beside = [[x, 0.95 * np.sin(np.pi * x / 6.0), 0.0] for x in np.arange(0.0, 6.1, 0.5)]
    small = belief._replace(descriptor=belief.descriptor.at[1].set(0.5))
    assert [0, 2] not in graph_of(small, arcs, beside).arc_ends.tolist()


def test_a_drive_around_something_back_to_its_node_is_a_loop_and_out_and_back_is_not():
    belief = belief_of([[0.0, 0.0]], [JUNCTION], [3])
    turn = np.linspace(0.0, 2 * np.pi, 40)
    around = np.stack([2 - 2 * np.cos(turn), 2 * np.sin(turn), turn], axis=1)
    graph = graph_of(belief, arc_table.empty_arcs(capacity=2), np.concatenate([around, around]))
    assert graph.arc_ends.tolist() == [[0, 0]]
    assert graph.arc_length[0] == pytest.approx(4 * np.pi, rel=0.05)
    back = around * [1.0, 0.1, 1.0]
    assert len(graph_of(belief, arc_table.empty_arcs(capacity=2), back).arc_ends) == 0


@pytest.mark.parametrize(
    "way, pairs",
    [
        ([0.0, 0.5, 0.0], []),  # never out of a circle
        ([0.0, 0.5, 2.0, 0.5, 0.0], [(0, 0)]),  # out of it and back into it
        ([0.0, 2.0, 4.0], [(0, 1)]),
        ([4.0, 2.0, 0.0, 4.0], [(1, 0), (0, 1)]),
        ([0.0, 4.0, 6.0, 8.0, 0.0], [(0, 1), (1, 2), (2, 0)]),
        ([2.0, 6.0], []),  # in no circle
        ([7.4, 7.6], [(3, 2)]),  # in two: the nearer counts
    ],
)
def test_the_trail_goes_from_circle_to_circle(way, pairs):
    xy = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [7.0, 0.0]])
    poses = np.array([[x, 0.0, 1.0] for x in way])
    found = graph_arcs.driven_arcs(xy, np.array([1.0, 1.0, 0.9, 0.9]), poses)
    assert [(drive.start, drive.end) for drive in found] == pairs
    for drive in found:
        np.testing.assert_allclose(drive.polyline[[0, -1]], xy[[drive.start, drive.end]])


# Lines and ways.


def test_points_beside_a_line():
    line = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])
    points = np.array([[-1.0, 0.0], [1.0, 0.5], [3.0, 1.0], [2.5, -0.0]])
    away, along = polylines.project(points, line)
    np.testing.assert_allclose(away, [1.0, 0.5, 1.0, 0.5])
    np.testing.assert_allclose(along, [0.0, 1.0, 3.0, 2.0])


@pytest.mark.parametrize("seed", range(5))
def test_the_shortest_way_is_that_of_networkx(seed):
    random, places = np.random.default_rng(seed), 9
    pairs = random.integers(0, places, (14, 2))  # loops and parallel arcs among them
    lengths = random.integers(0, 9, 14).astype(float)  # and some of no length
    lengths[:2] = np.inf
    graph = networkx.MultiGraph()
    graph.add_nodes_from(range(places))
    for (a, b), length in list(zip(pairs.tolist(), lengths, strict=True))[2:]:
        graph.add_edge(a, b, weight=length)
    for goal in range(places):
        if not networkx.has_path(graph, 0, goal):
            with pytest.raises(ValueError, match=f"no route leads from place 0 to place {goal}"):
                routes.shortest_path(pairs, lengths, 0, goal, num_nodes=places)
            continue
        arcs = routes.shortest_path(pairs, lengths, 0, goal, num_nodes=places)
        want = networkx.shortest_path_length(graph, 0, goal, weight="weight")
        assert lengths[arcs].sum() == want
        assert routes.join_arcs([np.zeros((2, 2))] * 14, pairs, arcs, 0)[0][-1] == goal
