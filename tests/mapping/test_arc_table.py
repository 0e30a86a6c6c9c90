"""Arcs merged scan by scan, and frontiers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arc_examples import (
    BLIND,
    HERE,
    LIDAR,
    POSITIONS,
    THERE,
    add,
    curve,
    ids,
    local_arcs_of,
    used_slots,
)

from jaxslam.core import polylines
from jaxslam.core.scan import Scan
from jaxslam.core.se2 import compose, inverse_transform
from jaxslam.frontend.arc_tracing import POLYLINE_POINTS
from jaxslam.frontend.local_graph import LocalArcs
from jaxslam.mapping import arc_table


@pytest.mark.parametrize("clearances", [(0.9, 0.5), (0.5, 0.9)])
def test_a_branch_seen_twice_is_one_arc_seen_twice_with_the_smaller_clearance(clearances):
    arcs = arc_table.empty_arcs(capacity=12)
    for clearance, bulge in zip(clearances, (0.2, 0.4), strict=True):
        arcs = add(arcs, ids(3, 7), HERE, local_arcs_of((0, 1, clearance, bulge)))
    assert used_slots(arcs) == [((3, 7), 0.5, 2)]
    want = [curve(POSITIONS[0], POSITIONS[1], bulge) for bulge in (0.2, 0.4)]
    np.testing.assert_allclose(arcs.polyline[0], np.mean(want, axis=0), atol=1e-9)
    np.testing.assert_allclose(arcs.length[0], polylines.length(np.array(want)).mean())


def test_the_order_of_the_two_ends_does_not_matter():
    forward = add(
        arc_table.empty_arcs(capacity=12),
        ids(4, 9),
        THERE,
        local_arcs_of((0, 1, 0.5, 0.3), pose=THERE),
    )
    reverse = local_arcs_of((1, 0, 0.5, -0.3), pose=THERE)
    backward = add(arc_table.empty_arcs(capacity=12), ids(4, 9), THERE, reverse)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), forward, backward)
    np.testing.assert_allclose(
        forward.polyline[0], curve(POSITIONS[0], POSITIONS[1], 0.3), atol=1e-9
    )
    both = add(forward, ids(4, 9), THERE, reverse)
    assert used_slots(both) == [((4, 9), 0.5, 2)]


def test_two_branches_between_two_nodes_are_two_arcs_in_either_order():
    both_sides = local_arcs_of((0, 1, 0.5, 1.0), (0, 1, 0.4, -1.0))
    again = local_arcs_of((0, 1, 0.3, -1.1))
    arcs = add(arc_table.empty_arcs(capacity=12), ids(2, 5), HERE, both_sides)
    assert used_slots(arcs) == [((2, 5), 0.4, 1), ((2, 5), 0.5, 1)]
    assert used_slots(add(arcs, ids(2, 5), HERE, again)) == [((2, 5), 0.3, 2), ((2, 5), 0.5, 1)]
    duplicates = local_arcs_of((0, 1, 0.5, 1.0), (0, 1, 0.4, 1.1))
    assert used_slots(add(arc_table.empty_arcs(capacity=12), ids(2, 5), HERE, duplicates)) == [
        ((2, 5), 0.5, 1)
    ]


def test_an_arc_is_matched_when_the_estimate_has_drifted():
    arcs = add(arc_table.empty_arcs(capacity=12), ids(2, 5), HERE, local_arcs_of((0, 1, 0.5, 0.8)))
    drifted = compose(THERE, jnp.array([2.0, 1.0, 0.5]))
    arcs = add(arcs, ids(2, 5), drifted, local_arcs_of((0, 1, 0.5, 0.8), pose=THERE))
    assert used_slots(arcs) == [((2, 5), 0.5, 2)]


def test_local_arcs_without_two_different_landmarks_are_ignored():
    start = add(arc_table.empty_arcs(capacity=12), ids(1, 2, 0), HERE, local_arcs_of((0, 1, 0.5)))
    found = local_arcs_of((0, 1, 0.4), (1, 2, 0.4), (0, 2, 0.4))
    for known in (ids(-1, 1, -1), ids(-1, -1, -1), ids(2, 2, 2)):
        jax.tree.map(np.testing.assert_array_equal, add(start, known, THERE, found), start)


@pytest.mark.parametrize("junk", [7.0, np.nan])
def test_padding_is_invisible(junk):
    known = ids(1, 2, 0)
    clean, dirty = (
        add(arc_table.empty_arcs(capacity=12), known, THERE, local_arcs_of((0, 2, 0.5), junk=x))
        for x in (0.0, junk)
    )
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    assert used_slots(clean) == [((0, 1), 0.5, 1)]


def test_a_full_map_drops_new_arcs_and_still_counts_the_old():
    arcs = arc_table.empty_arcs(capacity=2)
    arcs = add(arcs, ids(0, 1, 2), HERE, local_arcs_of((0, 1, 0.5), (1, 2, 0.5), (0, 2, 0.5)))
    assert used_slots(arcs) == [((0, 1), 0.5, 1), ((1, 2), 0.5, 1)]
    arcs = add(arcs, ids(5, 1, 2), HERE, local_arcs_of((0, 1, 0.1), (1, 2, 0.2)))
    assert used_slots(arcs) == [((0, 1), 0.5, 1), ((1, 2), 0.2, 2)]


@pytest.mark.parametrize("seed", range(4))
def test_many_scans_agree_with_a_dictionary(seed):
    """Straight arcs between landmarks, in a sequence of scans, against a plain dictionary."""
    random, steps, size = np.random.default_rng(seed), 12, 6
    known = np.stack([random.permutation(len(POSITIONS)) - 2 for _ in range(steps)])
    known[known < 0] = -1
    rank = np.argsort(np.argsort(np.where(known < 0, 99, known), axis=1), axis=1)
    poses = jnp.array(random.normal(size=(steps, 3)))
    log, want = [], {}
    for t in range(steps):
        pairs = {
            tuple(sorted(random.permutation(len(POSITIONS))[:2].tolist())) for _ in range(size)
        }
        clearances = {pair: random.random() for pair in sorted(pairs)}
        branches = local_arcs_of(*[(i, j, c) for (i, j), c in clearances.items()], size=size)
        # A feature is where its landmark is.
        xy = POSITIONS[rank[t]][np.asarray(branches.pair)]
        line = np.array(
            [curve(a, b) if np.any(a != b) else np.zeros((POLYLINE_POINTS, 2)) for a, b in xy]
        )
        log.append(branches._replace(polyline=inverse_transform(poses[t], jnp.asarray(line))))
        for pair, narrowest in clearances.items():
            a, b = sorted(known[t, list(pair)].tolist())
            if a >= 0:
                clearance, count = want.get((a, b), (np.inf, 0))
                want[a, b] = min(clearance, narrowest), count + 1
    arcs = arc_table.empty_arcs(capacity=64)
    for t in range(steps):
        arcs = add(arcs, jnp.array(known[t], jnp.int32), poses[t], log[t])
    assert len(want) > 8
    assert used_slots(arcs) == sorted((ends, *rest) for ends, rest in want.items())


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"lidar": BLIND}, "lidar is of type Scan, not Lidar"),
        ({"arcs": local_arcs_of()}, "arcs is of type LocalArcs, not ArcTable"),
        ({"local_arcs": 3}, "local_arcs is of type int, not LocalArcs"),
        ({"scan": [1.0]}, "scan is of type list, not Scan"),
        ({"ids": jnp.zeros(4)}, "ids is float64"),
        ({"pose": jnp.zeros(2)}, r"pose is float64 \(2,\), not .*\(3,\)"),
        ({"scan": BLIND._replace(ranges=jnp.zeros(7))}, r"scan.ranges is .* \(7,\), not .*\(91,\)"),
        ({"scan": BLIND._replace(hit=jnp.zeros(91))}, r"scan.hit is float64 \(91,\), not bool"),
        (
            {"local_arcs": local_arcs_of(size=3)._replace(polyline=jnp.zeros((3, 2)))},
            r"local_arcs.polyline is float64 \(3, 2\), not",
        ),
        (
            {"local_arcs": local_arcs_of(size=3)._replace(pair=jnp.zeros((2, 2), int))},
            r"local_arcs.pair is int64 \(2, 2\), not integer \(3, 2\)",
        ),
    ],
)
def test_add_scan_arcs_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"lidar": LIDAR, "arcs": arc_table.empty_arcs(capacity=12), "ids": ids(0, 1)}
    given |= {"pose": HERE, "local_arcs": local_arcs_of(size=3), "scan": BLIND}
    with pytest.raises(ValueError, match=problem):
        arc_table.add_scan_arcs(**{**given, **wrong})


def test_a_map_without_slots_is_refused():
    with pytest.raises(ValueError, match="capacity is 0, not a number of slots >= 1"):
        arc_table.empty_arcs(capacity=0)


def test_lists_numpy_and_jax_arrays_give_the_same_arcs():
    branches = local_arcs_of((0, 1, 0.5, 0.5), (1, -1, 0.25, (0.0, 4.0)))
    branches = branches._replace(polyline=jnp.round(branches.polyline * 64) / 64)
    branches = branches._replace(length=jnp.round(branches.length * 64) / 64)
    start, pose = arc_table.empty_arcs(capacity=3), jnp.array([0.0, 1.0, 0.0])
    want = add(start, ids(4, 2), pose, branches)

    def single(x):
        return np.asarray(x, np.float32 if x.dtype == float else x.dtype)

    for convert in (np.asarray, single, lambda x: np.asarray(x).tolist()):
        found = arc_table.add_scan_arcs(
            LIDAR,
            jax.tree.map(np.asarray, start),
            convert(ids(4, 2)),
            convert(pose),
            LocalArcs(*map(convert, branches)),
            Scan(*map(np.asarray, BLIND)),
        )
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), found, want)
        assert [x.dtype for x in found] == [x.dtype for x in want]


# Frontiers.


def test_a_frontier_is_extended_and_is_dropped_once_explored():
    arcs = add(
        arc_table.empty_arcs(capacity=12), ids(6), HERE, local_arcs_of((0, -1, 0.5, (4.0, 0.0)))
    )
    assert used_slots(arcs) == [((6, -1), 0.5, 1)]
    arcs = add(arcs, ids(6), HERE, local_arcs_of((0, -1, 0.5, (4.6, 0.0))))
    arcs = add(arcs, ids(6), HERE, local_arcs_of((0, -1, 0.5, (4.2, 0.0))))
    assert used_slots(arcs) == [((6, -1), 0.5, 3)]  # the longest stands
    np.testing.assert_allclose(arcs.polyline[0, -1], [4.6, 0.0], atol=1e-9)
    both = add(arcs, ids(6), HERE, local_arcs_of((0, -1, 0.4, (0.0, 4.0))))
    assert len(used_slots(both)) == 2
    pose = jnp.array([2.0, 1.0, -0.4])
    for distance, left in ((2.7, 2), (3.1, 1)):  # its end is 2.8 m away; walls have a thickness
        wall = Scan(jnp.full(91, distance), jnp.ones(91, bool))
        assert len(used_slots(add(both, ids(-1), pose, local_arcs_of(), wall))) == left
    no_wall = Scan(jnp.full(91, 3.1), jnp.zeros(91, bool))
    assert len(used_slots(add(both, ids(-1), pose, local_arcs_of(), no_wall))) == 2
    behind = compose(pose, jnp.array([0.0, 0.0, np.pi]))
    after = add(both, ids(-1), behind, local_arcs_of(), Scan(jnp.full(91, 9.0), BLIND.hit))
    assert used_slots(after) == [((6, -1), 0.5, 3)]  # it is not in view, the other is
