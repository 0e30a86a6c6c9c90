"""The topological map built from arcs, landmarks and the trajectory."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arc_examples import (
    HERE,
    POSITIONS,
    add,
    arcs_of,
    belief_of,
    curve,
    ids,
    local_arcs_of,
    used_slots,
)

from jaxslam.core import polylines
from jaxslam.core.se2 import transform
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering.belief import initial_belief
from jaxslam.frontend.arc_tracing import POLYLINE_POINTS
from jaxslam.mapping import arc_table, topological_map


def graph_of(belief, arcs, poses=None, confirm_count=2):
    far = np.full((1, 3), 99.0)
    return topological_map.build_map(
        belief, arcs, far if poses is None else np.array(poses), confirm_count=confirm_count
    )


def test_the_map_keeps_frontiers_that_lead_to_nothing_known():
    belief = belief_of(POSITIONS[:3], [JUNCTION] * 3, [3] * 3)
    onto = curve(POSITIONS[0], POSITIONS[1])[5]
    arcs = add(
        arc_table.empty_arcs(capacity=12),
        ids(*range(3)),
        HERE,
        local_arcs_of(
            (0, 1, 0.5), (0, -1, 0.5, (0.0, 3.0)), (2, -1, 0.5, onto), (1, -1, 0.5, POSITIONS[2])
        ),
    )
    graph = graph_of(belief, arcs, confirm_count=1)
    assert graph.frontier_node.tolist() == [0]
    np.testing.assert_allclose(graph.frontiers[0][[0, -1]], [[0.0, 0.0], [0.0, 3.0]], atol=1e-9)
    # The one that ended on a node is an arc to it.
    assert {tuple(sorted(p)) for p in graph.arc_ends.tolist()} == {(0, 1), (1, 2)}
    assert graph_of(belief, arcs).frontiers == ()  # seen once only


def test_arcs_move_with_their_landmarks():
    """The map of moved landmarks is the moved map."""
    arcs = add(
        arc_table.empty_arcs(capacity=12),
        ids(10, 11, 12),
        HERE,
        local_arcs_of((0, 1, 0.5, 0.7), (1, 2, 0.5)),
    )
    before = graph_of(belief_of(POSITIONS[:3], [JUNCTION] * 3, [3] * 3, ids=[10, 11, 12]), arcs)
    moved = np.asarray(transform(jnp.array([0.5, -2.0, 1.1]), jnp.asarray(POSITIONS[:3])))
    # The landmarks also change slots.
    order = np.array([2, 0, 1])
    belief = belief_of(moved[order], [JUNCTION] * 3, [3] * 3, ids=np.array([10, 11, 12])[order])
    after = graph_of(belief, arcs)

    def named(graph):
        return {tuple(graph.id[pair].tolist()): k for k, pair in enumerate(graph.arc_ends)}

    assert set(named(before)) == set(named(after)) == {(10, 11), (11, 12)}
    np.testing.assert_allclose(
        before.arc_lines[0], curve(POSITIONS[0], POSITIONS[1], 0.7), atol=1e-9
    )
    for name, k in named(before).items():
        want = transform(jnp.array([0.5, -2.0, 1.1]), jnp.asarray(before.arc_lines[k]))
        np.testing.assert_allclose(after.arc_lines[named(after)[name]], want, atol=1e-9)
        np.testing.assert_allclose(after.arc_length[named(after)[name]], before.arc_length[k])
    scaled = belief_of(POSITIONS[:3] * 1.5, [JUNCTION] * 3, [3] * 3, ids=[10, 11, 12])
    for graph in (before, after, graph_of(scaled, arcs)):
        for line, pair, length in zip(
            graph.arc_lines, graph.arc_ends, graph.arc_length, strict=True
        ):
            np.testing.assert_allclose(line[[0, -1]], graph.xy[pair], atol=1e-9)
            np.testing.assert_allclose(length, polylines.length(line), rtol=1e-6)


def test_duplicate_landmarks_are_one_node():
    positions = [[0.0, 0.0], [3.0, 0.25], [3.1, 0.3], [3.0, 0.3], [6.0, 1.0]]
    clearance = [1.0, 1.0, 1.1, 2.0, 1.0]  # the fourth is at the same position, but larger
    belief = belief_of(
        positions, [JUNCTION] * 5, [3, 3, 1, 3, 3], ids=[7, 4, 2, 1, 9], descriptor=clearance
    )
    arcs = arc_table.empty_arcs(capacity=12)
    arcs = add(arcs, ids(7, 2, 9), HERE, local_arcs_of((0, 1, 0.5), (1, 2, 0.4)))
    arcs = add(arcs, ids(7, 4), HERE, local_arcs_of((0, 1, 0.6)))
    arcs = jax.tree.map(np.array, arcs)
    arcs.ends[5], arcs.polyline[5], arcs.num_seen[5] = [2, 4], curve(positions[1], positions[2]), 1
    # Landmark 2 is not confirmed: 4 stands for both, and their arcs are its.
    graph = graph_of(belief, arcs)
    assert graph.id.tolist() == [7, 4, 1, 9]
    narrowest = graph.arc_clearance.tolist()
    pairs = [tuple(graph.id[pair].tolist()) for pair in graph.arc_ends]
    named = dict(zip(pairs, narrowest, strict=True))
    assert named == {(4, 7): 0.5, (4, 9): 0.4}
    assert graph_of(belief, arcs, confirm_count=1).id.tolist() == [7, 2, 1, 9]


def test_parallel_arcs_a_ring_and_a_loop_are_kept():
    corners = np.array([[0, 0], [3, 0], [3, 3], [0, 3], [3.1, 3.0]], float)
    belief = belief_of(corners, [JUNCTION] * 5, [3] * 5, descriptor=np.full(5, 0.5))
    line = [curve(corners[a], corners[b]) for a, b in pairwise([0, 1, 2, 3, 0])]
    line.append(curve(corners[0], corners[1], -1.5))
    turn = np.linspace(0, 2 * np.pi, 80)[:, None]
    around = corners[2] + np.concatenate([1 - np.cos(turn), np.sin(turn)], axis=1)
    line.append(polylines.resample(np.concatenate([around[:-5], corners[4:]]), POLYLINE_POINTS))
    line[3] = line[3][::-1]
    ends = [[0, 1], [1, 2], [2, 3], [0, 3], [0, 1], [2, 4]]
    arcs = arcs_of(*zip(ends, line, strict=True))
    graph = graph_of(belief, arcs)
    assert graph.id.tolist() == [0, 1, 2, 3]  # 4 is a duplicate of 2
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


def test_the_map_holds_confirmed_landmarks_and_arcs_between_nodes_only():
    kind = [JUNCTION, CORNER, JUNCTION, WALL, JUNCTION, JUNCTION, CORNER]
    seen = [2, 5, 1, 9, 3, 0, 1]  # the third is not confirmed, the slot of the sixth is free
    belief = belief_of(np.arange(14.0).reshape(7, 2), kind, seen, descriptor=np.arange(1.0, 8.0))
    everything = [(i, j, 0.5) for i in range(7) for j in range(i)]
    arcs = add(
        arc_table.empty_arcs(capacity=40), ids(*range(7)), HERE, local_arcs_of(*everything, size=25)
    )
    assert len(used_slots(arcs)) == 21
    graph = graph_of(belief, arcs)
    np.testing.assert_array_equal(graph.id, [0, 1, 4])
    np.testing.assert_array_equal(graph.kind, [JUNCTION, CORNER, JUNCTION])
    np.testing.assert_array_equal(graph.xy, [[0, 1], [2, 3], [8, 9]])
    np.testing.assert_array_equal(graph.clearance, [1, 0, 5])
    np.testing.assert_array_equal(graph.id[graph.arc_ends], [[0, 4]])
    assert [len(x) for x in graph] == [3, 3, 3, 3, 1, 1, 1, 1, 0, 0, 0, 0]
    loose = graph_of(belief, arcs, confirm_count=1)
    np.testing.assert_array_equal(loose.id, [0, 1, 2, 4, 6])
    # The arc from 0 to 4 goes through 2, now that it counts.
    assert {tuple(sorted(p)) for p in loose.id[loose.arc_ends].tolist()} == {(0, 2), (2, 4)}


def test_a_slot_used_again_does_not_inherit_arcs():
    arcs = add(arc_table.empty_arcs(capacity=12), ids(0, 1), HERE, local_arcs_of((0, 1, 0.5)))
    belief = belief_of([[0, 0], [1, 0]], [JUNCTION] * 2, [3, 3], ids=[0, 8])  # 1 was pruned
    assert len(graph_of(belief, arcs).arc_ends) == 0


def test_an_empty_map_has_shapes():
    graph = graph_of(initial_belief(HERE, max_landmarks=5), arc_table.empty_arcs(capacity=12))
    assert [x.shape for x in graph[:7]] == [(0,), (0, 2), (0,), (0,), (0, 2), (0,), (0,)]
    assert graph.arc_lines == graph.frontiers == () and graph.frontier_node.shape == (0,)
    assert graph.arc_ends.dtype.kind == "i"


# Driven arcs.


def test_nodes_are_joined_by_a_driven_arc_if_no_known_arcs_run_beside_it():
    belief = belief_of(POSITIONS[:4] * [1, 0], [JUNCTION] * 4, [3] * 4)
    flat = local_arcs_of((0, 1, 0.5), (1, 2, 0.5))
    flat = flat._replace(polyline=flat.polyline.at[..., 1].set(0.0))
    arcs = add(arc_table.empty_arcs(capacity=12), ids(0, 1, 2), HERE, flat)
    trajectory = [[x, 0.3, 0.0] for x in np.arange(0.0, 9.1, 0.5)]
    graph = graph_of(belief, arcs, trajectory)
    np.testing.assert_array_equal(graph.arc_ends, [[0, 1], [1, 2], [2, 3]])
    np.testing.assert_array_equal(graph.arc_clearance, [0.5, 0.5, np.nan])
    np.testing.assert_allclose(
        graph.arc_lines[2][[0, 4, 8]], [[6, 0], [7.5, 0.3], [9, 0]], atol=0.1
    )
    # Past the second node at two metres: beside no known arcs, and through no node's circle.
    far = [[x, 2.0 * np.sin(np.pi * x / 6.0), 0.0] for x in np.arange(0.0, 6.1, 0.5)]
    assert [0, 2] in graph_of(belief, arcs, far).arc_ends.tolist()
    # Closer to it, though outside its circle: beside known arcs.
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
    "wrong, problem",
    [
        ({"belief": HERE}, "belief is of type .*, not Belief"),
        ({"arcs": local_arcs_of()}, "arcs is of type LocalArcs, not ArcTable"),
        ({"poses": np.zeros((4, 2))}, r"poses is float64 \(4, 2\), not \(T, 3\)"),
        ({"poses": [[0, 0, 0], [1]]}, "poses is not an array: its parts differ in shape"),
        ({"confirm_count": 0}, "confirm_count is 0, not a number of observations >= 1"),
        ({"min_separation": -0.1}, "min_separation is -0.1, not a number >= 0"),
        ({"max_log_clearance_ratio": np.nan}, "max_log_clearance_ratio is nan"),
    ],
)
def test_build_map_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"belief": belief_of(POSITIONS[:3], [JUNCTION] * 3, [3] * 3), "poses": np.zeros((2, 3))}
    given |= {"arcs": arc_table.empty_arcs(capacity=4), "confirm_count": 2}
    with pytest.raises(ValueError, match=problem):
        topological_map.build_map(**{**given, **wrong})


def test_lists_numpy_and_jax_arrays_give_the_same_map():
    belief = belief_of(POSITIONS[:4] * [1, 0], [JUNCTION] * 4, [3] * 4)
    arcs = arcs_of(([0, 1], curve([0, 0], [3, 0])))
    poses = np.array([[x, 0.25, 0.0] for x in range(10)])
    want = topological_map.build_map(belief, arcs, poses, confirm_count=2)
    assert len(want.arc_ends) == 3
    for convert in (np.ndarray.tolist, np.float32, jnp.asarray):
        for records in (np.asarray, jnp.asarray):
            given = (jax.tree.map(records, tree) for tree in (belief, arcs))
            graph = topological_map.build_map(*given, convert(poses), confirm_count=2)
            jax.tree.map(np.testing.assert_array_equal, graph, want)
