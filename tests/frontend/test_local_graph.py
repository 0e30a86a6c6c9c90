"""Arcs between the junctions of one scan, against a walk over the branch cells in plain Python."""

import re
from itertools import combinations, pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import transform
from jaxslam.frontend import (
    arc_tracing,
    automaton,
    extract,
    id_propagation,
    lidar,
    local_graph,
    voronoi,
)
from jaxslam.frontend.grid import centres
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.path_following import densify
from jaxslam.simulation.worlds import World

CONFIG = Config()
GRID, COUNT = CONFIG.frontend.grid, CONFIG.frontend.features.max_junctions
MIDDLE = np.asarray(centres(GRID))
SEED_RADIUS = 2.5 * GRID.cell_size  # [m] cells this close to a junction belong to it

# A corridor 2 m wide with three openings on its left: a junction before each, and at its end.
OPENINGS = [(1.6, 3.0), (3.8, 5.2), (6.0, 7.4)]
COMB = worlds.outline([(-0.5, -1.0, 8.5, 1.0), *[(a, 1.0, b, 3.0) for a, b in OPENINGS]])
IN_COMB = (0.1, -0.3, 0.1)
MOST_WALLS = len(worlds.named("office").walls)


@jax.jit
def simulate(walls, pose):
    """Scan, and its features, diagram and sources."""
    scan = ray_casting.cast(CONFIG.frontend.lidar, World(walls), pose)
    found, diagram, sources = extract.extract_diagram(CONFIG.frontend, scan)
    return scan, found, diagram, sources


@jax.jit
def find(found, diagram, sources, scan):
    return local_graph.find_local_arcs(
        CONFIG.frontend.lidar, GRID, CONFIG.frontend.features, found, diagram, sources, scan
    )


def scene(walls, pose):
    """For one number of walls: those of the office, the last of others many times."""
    walls = np.asarray(walls)
    walls = np.concatenate([walls, np.repeat(walls[-1:], MOST_WALLS - len(walls), axis=0)])
    scan, found, diagram, sources = simulate(jnp.asarray(walls), jnp.asarray(pose, float))
    return found, diagram, sources, scan


def all_joined(arcs):
    """Pairs of features that arcs join, one for each arc."""
    pairs = np.asarray(arcs.pair)[np.asarray(arcs.valid)].tolist()
    return sorted((i, j) for i, j in pairs if j >= 0)


def joined(arcs):
    """Pairs of features that arcs join, by one arc each."""
    pairs = all_joined(arcs)
    assert len(set(pairs)) == len(pairs)
    return set(pairs)


def frontiers(arcs):
    """Indices of the frontiers."""
    return np.flatnonzero(np.asarray(arcs.valid) & (np.asarray(arcs.pair)[:, 1] < 0))


def walk(found, diagram, sources):
    """Pairs of junctions whose walkers meet, who leave all at once along the branch cells.

    A branch is three cells wide, so that a gap of one cell does not cut it. A cell belongs to
    those who come to it first.
    """
    sources, labels = np.asarray(sources), np.asarray(diagram.labels)
    branch = np.asarray(voronoi.branch_cells(diagram, sources))
    free = np.zeros_like(branch)
    for cell in np.argwhere(branch):
        for near in reference.block(cell, branch.shape):
            free[near] = labels[near] != 0 and not sources[near]
    owners = {}
    for k in np.flatnonzero(np.asarray(found.valid[:COUNT])):
        distance = np.linalg.norm(MIDDLE - np.asarray(found.xy[k]), axis=-1)
        for cell in map(tuple, np.argwhere(distance < SEED_RADIUS)):
            owners.setdefault(cell, set()).add(int(k))
    front = list(owners)
    for _ in range(id_propagation.MAX_ARC_STEPS):
        reached = {}
        for cell in front:
            for beside in reference.neighbours(cell, branch.shape):
                if len(owners[cell]) == 1 and free[beside] and beside not in owners:
                    reached.setdefault(beside, set()).update(owners[cell])
        owners |= reached
        front = list(reached)
    meets = list(owners.values())
    for cell, own in owners.items():
        for beside in reference.neighbours(cell, branch.shape):
            if len(own) == len(owners.get(beside, ())) == 1:
                meets.append(own | owners[beside])
    return {pair for met in meets for pair in combinations(sorted(met), 2)}


def test_junctions_of_a_corridor_with_openings_are_joined_one_after_the_other():
    found, *rest = scene(COMB, IN_COMB)
    xy = np.asarray(transform(jnp.array(IN_COMB), found.xy))[:COUNT]
    order = [k for k in np.argsort(xy[:, 0]) if found.valid[k]]
    # Its circle touches the right wall and the two corners of the opening; that of the fourth,
    # at the end of the corridor, all its three walls.
    want = [*(((a + b) / 2, (b - a) ** 2 / 16) for a, b in OPENINGS), (7.5, 0.0)]
    np.testing.assert_allclose(xy[order], want, atol=0.03)
    arcs = find(found, *rest)
    assert joined(arcs) == {tuple(sorted(p)) for p in pairwise(order)}
    assert joined(arcs) == walk(found, *rest[:2])


@pytest.mark.parametrize(
    "walls, pose, count", [(COMB, IN_COMB, 3), ("fig07", (0.7, 1.3, -0.39), 2)]
)
def test_a_line_follows_the_branch_cells_from_end_to_end(walls, pose, count):
    walls = worlds.named(walls).walls if isinstance(walls, str) else walls
    found, diagram, sources, scan = scene(walls, pose)
    arcs = find(found, diagram, sources, scan)
    hits = np.asarray(lidar.beam_ends(CONFIG.frontend.lidar, scan))
    cells = MIDDLE[np.asarray(voronoi.branch_cells(diagram, sources))]
    assert len(joined(arcs)) == count and len(frontiers(arcs)) >= 2
    for k in np.flatnonzero(arcs.valid):
        line, pair = np.asarray(arcs.polyline[k]), np.asarray(arcs.pair[k])
        ends = np.asarray(found.xy)[pair[pair >= 0]]
        np.testing.assert_allclose(line[[0, -1]][: len(ends)], ends, atol=1e-9)
        steps = np.hypot(*np.diff(line, axis=0).T)
        assert steps.max() < 1.3 * steps.min()
        assert steps.sum() <= arcs.length[k] + 1e-9 < 1.1 * steps.sum()
        inner = line[np.min(np.linalg.norm(line[:, None] - ends, axis=2), axis=1) > SEED_RADIUS]
        off = np.linalg.norm(inner[:, None] - cells, axis=2).min(axis=1, initial=9.0)
        assert np.all(off < 1.5 * GRID.cell_size)
        # Clearance changes by no more than one moves, so the points bound it.
        least = np.linalg.norm(line[:, None] - hits, axis=2).min()
        least = min(least, *np.asarray(found.descriptor)[pair[pair >= 0]])
        assert least - steps.max() / 2 < arcs.clearance[k] <= least + 1e-9


def test_a_diagonal_arc_is_as_long_as_a_straight_one():
    """A corridor of walls at any angle: its middle line is shorter than the steps on cells."""
    for turn in np.linspace(0.0, 0.75, 4):
        c, s = np.cos(turn), np.sin(turn)
        walls = np.asarray(COMB).reshape(-1, 2, 2) @ np.array([[c, s], [-s, c]])
        position = np.array(IN_COMB[:2]) @ np.array([[c, s], [-s, c]])
        found, *rest = scene(walls.reshape(-1, 4), (*position, 0.1))
        arcs = find(found, *rest)
        assert len(joined(arcs)) >= 1
        for k in np.flatnonzero(np.asarray(arcs.valid) & (np.asarray(arcs.pair)[:, 1] >= 0)):
            chord = np.linalg.norm(np.subtract(*np.asarray(found.xy)[np.asarray(arcs.pair[k])]))
            if abs(chord - 2.2) < 0.1:  # neighbours, with a nearly straight arc
                assert chord < arcs.length[k] < 1.06 * chord


def test_a_branch_that_the_range_cuts_is_a_frontier():
    short = CONFIG.frontend._replace(lidar=CONFIG.frontend.lidar._replace(range_max=5.0))
    walls = worlds.outline([(-0.5, -1.0, 30.0, 1.0), (1.6, 1.0, 3.0, 3.0)])
    pose = jnp.array([0.1, -0.3, 0.1])
    scan = ray_casting.cast(short.lidar, World(jnp.asarray(walls)), pose)
    found, arcs = jax.jit(extract.extract_local_graph, static_argnums=0)(short, scan)
    (junction,) = np.flatnonzero(found.valid[:COUNT])
    assert not joined(arcs)
    ahead = [k for k in frontiers(arcs) if arcs.polyline[k, -1, 0] > 3.5]
    assert len(ahead) == 1
    line = np.asarray(transform(pose, arcs.polyline[ahead[0]]))
    np.testing.assert_allclose(line[-1], [4.9, 0.0], atol=0.2)
    assert arcs.pair[ahead[0]].tolist() == [junction, -1]
    chord = np.linalg.norm(line[-1] - line[0])
    assert chord <= arcs.length[ahead[0]] < 1.1 * chord
    assert 0.8 < arcs.clearance[ahead[0]] < 1.05


def test_a_branch_into_a_corner_is_no_frontier():
    found, *rest = scene(worlds.outline([(-2.0, -1.5, 3.0, 1.5)]), (0.0, 0.0, 0.0))
    arcs = find(found, *rest)
    assert found.valid[:COUNT].sum() == 1
    # The branch behind the robot leads out of its view, those into the two corners ahead do not.
    assert np.all(np.asarray(arcs.polyline)[frontiers(arcs), -1, 0] < 0.3)


# A diagram that no scan shows: a square ring around a pillar.
SQUARE = GRID._replace(x_max=3.0, x_min=-3.0, y_half=3.0)
# [m] Length of the ring between two opposite points, and x = y of the point at 45 degrees.
HALF_LENGTH, DIAGONAL = 5.45, 1.27


@jax.jit
def ring(xy, valid):
    """Arcs of junctions (N, 2) on the branch between a pillar and the walls."""
    x, y = jnp.abs(centres(SQUARE)).transpose(2, 0, 1)
    far = jnp.maximum(x, y)
    sources = (far > 2.9) | (far < 0.5)
    labels = jnp.where(far > 2.9, 2, jnp.where(far < 0.5, 1, 0)).astype(jnp.uint8)
    diagram = automaton.expand(labels, ~sources, steps=40)
    spec = CONFIG.frontend.features._replace(max_junctions=len(xy))
    found = Features(
        kind=jnp.zeros(len(xy), jnp.int32),
        xy=xy,
        cov=jnp.zeros((len(xy), 2, 2)),
        direction=jnp.zeros(len(xy)),
        direction_variance=jnp.zeros(len(xy)),
        descriptor=jnp.ones(len(xy)),
        degree=jnp.full(len(xy), 3, jnp.int32),
        certified=valid,
        trusted=valid,
        valid=valid,
    )
    around = Lidar(num_beams=721, angle_min=-np.pi)
    scan = Scan(jnp.full(721, 9.0), jnp.zeros(721, bool))
    return local_graph.find_local_arcs(around, SQUARE, spec, found, diagram, sources, scan)


def ring_of(*junctions, size=7):
    xy = np.full((size, 2), 9.0)
    xy[: len(junctions)] = junctions
    return ring(jnp.asarray(xy), jnp.arange(size) < len(junctions))


def test_two_branches_around_a_pillar_are_two_arcs():
    found = ring_of((1.7, 0.0), (-1.7, 0.0))
    assert all_joined(found) == [(0, 1), (0, 1)]
    lines = np.asarray(found.polyline)[np.asarray(found.valid)]
    np.testing.assert_allclose(
        np.asarray(found.length)[np.asarray(found.valid)], HALF_LENGTH, atol=0.15
    )
    np.testing.assert_allclose(np.sort(lines[:, 4, 1]), [-1.7, 1.7], atol=0.15)
    np.testing.assert_allclose(np.abs(lines[:, 2]), DIAGONAL, atol=0.25)


def test_a_junction_between_splits_one_of_two_branches():
    found = ring_of((1.7, 0.0), (-1.7, 0.0), (0.0, 1.7))
    assert all_joined(found) == [(0, 1), (0, 2), (1, 2)]
    k = [p.tolist() for p in found.pair].index([0, 1])
    assert found.valid[k] and found.polyline[k, 4, 1] < -1.4


def test_ten_junctions_need_wider_cells():
    turn = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    junctions = directions * np.where(np.arange(8) % 2, DIAGONAL * np.sqrt(2), 1.7)[:, None]
    found = ring_of(*junctions, size=10)
    assert all_joined(found) == sorted([*((k, k + 1) for k in range(7)), (0, 7)])
    assert id_propagation.id_bits(10).dtype == jnp.uint16
    assert id_propagation.id_bits(31).dtype == jnp.uint32
    with pytest.raises(ValueError, match="features.max_junctions is 32"):
        id_propagation.id_bits(32)


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_arcs_turn_with_the_junctions(quarter):
    c, s = [(0, 1), (-1, 0), (0, -1)][quarter - 1]
    turn = np.array([[c, -s], [s, c]])
    junctions = np.array([(1.7, 0.1), (-1.3, 1.3), (0.2, -1.7)])
    one, other = ring_of(*junctions), ring_of(*(junctions @ turn.T))
    assert all_joined(one) == all_joined(other) == [(0, 1), (0, 2), (1, 2)]
    by_pair = [np.argsort(np.asarray(x.pair)[:3] @ [9, 1]) for x in (one, other)]
    for a, b in zip(*by_pair, strict=True):
        np.testing.assert_allclose(
            other.polyline[b], np.asarray(one.polyline[a]) @ turn.T, atol=0.12
        )
        np.testing.assert_allclose(other.length[b], one.length[a], atol=0.1)


def poses_in(name):
    """Poses from which junctions are seen: of the ten scans, or along the drive."""
    if name == "fig07":
        return worlds.scan_poses(name)
    path = densify(worlds.waypoints(name))[::45]
    ahead = np.diff(path, axis=0)
    return np.column_stack([path[:-1], np.arctan2(ahead[:, 1], ahead[:, 0])])


@pytest.mark.parametrize("name, least", [("fig07", 5), ("office", 10)])
def test_arcs_join_the_pairs_that_a_walk_joins(name, least):
    total = 0
    for pose in poses_in(name):
        found, diagram, sources, scan = scene(worlds.named(name).walls, pose)
        pairs = joined(find(found, diagram, sources, scan))
        assert pairs == walk(found, diagram, sources)
        assert all(found.valid[i] and found.valid[j] for i, j in pairs)
        total += len(pairs)
    assert total >= least, total


def test_an_arc_ends_where_no_front_arrives():
    found, *rest = scene(COMB, IN_COMB)
    diagram, sources, scan = rest
    x = np.asarray(transform(jnp.array(IN_COMB), jnp.asarray(MIDDLE)))[..., 0]
    fenced = diagram._replace(labels=jnp.where(jnp.abs(x - 3.4) < 0.3, 0, diagram.labels))
    junction_x = np.asarray(transform(jnp.array(IN_COMB), found.xy))[:COUNT, 0]
    near = {k for k in np.flatnonzero(found.valid[:COUNT]) if junction_x[k] < 3.4}
    pairs = joined(find(found, diagram, sources, scan))
    within = {(i, j) for i, j in pairs if (i in near) == (j in near)}
    assert len(near) == 1 and len(pairs) == len(within) + 1 == 3
    assert joined(find(found, fenced, sources, scan)) == within


@pytest.mark.parametrize("junk", [3.0, jnp.nan])
def test_padding_is_invisible(junk):
    found, *rest = scene(COMB, IN_COMB)
    for gone in np.flatnonzero(found.valid[:COUNT]):
        clean = found._replace(valid=found.valid.at[gone].set(False))
        dirty = clean._replace(
            xy=clean.xy.at[gone].set(junk),
            descriptor=clean.descriptor.at[gone].set(junk),
            cov=clean.cov.at[gone].set(junk),
        )
        one, other = find(clean, *rest), find(dirty, *rest)
        assert joined(one) == joined(other) == walk(clean, *rest[:2])
        assert not any(gone in pair for pair in joined(one))
        keep = np.asarray(one.valid)
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(np.asarray(a)[keep], np.asarray(b)[keep])


def test_no_junctions_no_arcs():
    found, *rest = scene(COMB, IN_COMB)
    none = find(found._replace(valid=jnp.zeros_like(found.valid)), *rest)
    assert not none.valid.any()
    shapes = [x.shape for x in none]
    size = local_graph.MAX_LOCAL_ARCS + local_graph.MAX_LOCAL_FRONTIERS
    assert shapes == [(size, 2), (size, arc_tracing.POLYLINE_POINTS, 2), (size,), (size,), (size,)]


def test_arguments_that_do_not_fit_are_named():
    found, diagram, sources, scan = scene(COMB, IN_COMB)
    few = found._replace(xy=found.xy[:3])
    small = diagram._replace(labels=diagram.labels[:-1])
    for wrong, message in (
        ((few, diagram, sources), f"features.xy is (3, 2), not (M >= {COUNT}, 2)"),
        ((found, small, sources), "diagram.labels is uint32 (81, 160), not unsignedinteger (82,"),
        ((found, diagram, sources.astype(int)), "sources is int64 (82, 160), not bool (82, 160)"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            find(*wrong, scan)
    message = "scan.ranges is float64 (360,), not floating (361,)"
    with pytest.raises(ValueError, match=re.escape(message)):
        find(found, diagram, sources, scan._replace(ranges=scan.ranges[1:]))


def test_local_map_is_front_end_and_links_and_maps_over_scans():
    found, diagram, sources, scan = scene(COMB, IN_COMB)
    arcs = find(found, diagram, sources, scan)
    many = extract.extract_local_graphs(
        CONFIG.frontend, jax.tree.map(lambda x: jnp.stack([x, x]), scan)
    )
    for k in range(2):
        jax.tree.map(
            lambda own, every, k=k: np.testing.assert_allclose(every[k], own, atol=1e-9),
            (found, arcs),
            many,
        )
