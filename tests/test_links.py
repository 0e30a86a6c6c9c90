"""Arcs between the junctions of one scan, against a walk over the branch cells in plain Python."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxslam import lidar, links, slam, voronoi, world
from jaxslam.geometry import to_world
from jaxslam.grid import cell_of, centres
from jaxslam.plan import densify

CONFIG = slam.Config()
GRID, COUNT = CONFIG.grid, CONFIG.nodes.nodes
MIDDLE = np.asarray(centres(GRID))
AT = 2.5 * GRID.cell  # [m] cells this close to a junction belong to it

# A corridor 2 m wide with three openings on its left: a junction before each.
OPENINGS = [(1.6, 3.0), (3.8, 5.2), (6.0, 7.4)]
COMB = world.outline([(-0.5, -1.0, 8.5, 1.0), *[(a, 1.0, b, 3.0) for a, b in OPENINGS]])
IN_COMB = (0.1, -0.3, 0.1)


@jax.jit
def look(walls, pose):
    """Scan, and what the front end makes of it."""
    scan = lidar.cast(world.World(walls), pose, CONFIG.lidar)
    found, diagram, sources = slam.look(CONFIG, scan)
    return scan, found, diagram, sources


@jax.jit
def find(found, diagram, sources, scan):
    return links.find_links(found, diagram, sources, scan, CONFIG.lidar, GRID, CONFIG.nodes)


def scene(walls, pose):
    scan, found, diagram, sources = look(jnp.asarray(walls), jnp.asarray(pose))
    return found, diagram, sources, scan


def joined(links):
    """Pairs of features that are linked."""
    pairs = np.asarray(links.pair)[np.asarray(links.valid)].tolist()
    assert len(set(map(tuple, pairs))) == len(pairs)
    return set(map(tuple, pairs))


def walk(found, diagram, sources):
    """Pairs of junctions whose walkers meet, who leave all at once along the branch cells.

    A branch is three cells wide, so that a gap of one cell does not cut it. A cell belongs to
    those who come to it first.
    """
    sources, labels = np.asarray(sources), np.asarray(diagram.labels)
    branch = np.asarray(voronoi.branches(diagram, sources))
    open = np.zeros_like(branch)
    for cell in np.argwhere(branch):
        for near in reference.block(cell, branch.shape):
            open[near] = labels[near] != 0 and not sources[near]
    owners = {}
    for k in np.flatnonzero(np.asarray(found.valid[:COUNT])):
        away = np.linalg.norm(MIDDLE - np.asarray(found.xy[k]), axis=-1)
        for cell in map(tuple, np.argwhere(away < AT)):
            owners.setdefault(cell, set()).add(int(k))
    front = list(owners)
    for _ in range(links.LINK_STEPS):
        reached = {}
        for cell in front:
            for beside in reference.neighbours(cell, branch.shape):
                if len(owners[cell]) == 1 and open[beside] and beside not in owners:
                    reached.setdefault(beside, set()).update(owners[cell])
        owners |= reached
        front = list(reached)
    meets = list(owners.values())
    for cell, own in owners.items():
        for beside in reference.neighbours(cell, branch.shape):
            if len(own) == len(owners.get(beside, ())) == 1:
                meets.append(own | owners[beside])
    return {pair for met in meets for pair in combinations(sorted(met), 2)}


def test_junctions_before_the_openings_of_a_corridor_are_joined_one_after_the_other():
    found, *rest = scene(COMB, IN_COMB)
    place = np.asarray(to_world(jnp.array(IN_COMB), found.xy))[:COUNT]
    order = [k for k in np.argsort(place[:, 0]) if found.valid[k]]
    # Its circle touches the right wall and the two corners of the opening.
    want = [((a + b) / 2, (b - a) ** 2 / 16) for a, b in OPENINGS]
    np.testing.assert_allclose(place[order], want, atol=0.03)
    links = find(found, *rest)
    first, second, third = order
    assert joined(links) == {tuple(sorted(p)) for p in ((first, second), (second, third))}
    assert joined(links) == walk(found, *rest[:2])


@pytest.mark.parametrize("walls, pose", [(COMB, IN_COMB), ("fig07", (0.7, 1.3, -0.39))])
def test_an_arc_is_described_by_its_middle_and_its_narrowest_place(walls, pose):
    walls = world.named(walls).walls if isinstance(walls, str) else walls
    found, diagram, sources, scan = scene(walls, pose)
    links = find(found, diagram, sources, scan)
    hits = np.asarray(lidar.points(scan, CONFIG.lidar))
    branch = np.asarray(voronoi.branches(diagram, sources))
    assert len(joined(links)) == 2
    for k in np.flatnonzero(links.valid):
        pair, via = np.asarray(links.pair[k]), np.asarray(links.via[k])
        room = min(np.linalg.norm(hits - via, axis=1).min(), *np.asarray(found.shape)[pair])
        np.testing.assert_allclose(links.clearance[k], room, atol=1e-9)
        assert any(branch[c] for c in reference.block(np.asarray(cell_of(via, GRID)), GRID.shape))
        ends = np.linalg.norm(np.asarray(found.xy)[pair] - via, axis=1)
        assert np.all(ends < np.linalg.norm(np.diff(found.xy[pair], axis=0)))


def poses_in(name):
    """Poses from which junctions are seen: of the ten scans, or along the drive."""
    if name == "fig07":
        return world.places(name)
    path = densify(world.drive(name))[::45]
    ahead = np.diff(path, axis=0)
    return np.column_stack([path[:-1], np.arctan2(ahead[:, 1], ahead[:, 0])])


@pytest.mark.parametrize("name, least", [("fig07", 5), ("office", 10)])
def test_links_are_the_pairs_that_a_walk_joins(name, least):
    total = 0
    for pose in poses_in(name):
        found, diagram, sources, scan = scene(world.named(name).walls, pose)
        pairs = joined(find(found, diagram, sources, scan))
        assert pairs == walk(found, diagram, sources)
        assert all(found.valid[i] and found.valid[j] for i, j in pairs)
        total += len(pairs)
    assert total >= least, total


def test_where_no_front_arrives_an_arc_is_cut():
    found, *rest = scene(COMB, IN_COMB)
    diagram, sources, scan = rest
    x = np.asarray(to_world(jnp.array(IN_COMB), jnp.asarray(MIDDLE)))[..., 0]
    fenced = diagram._replace(labels=jnp.where(jnp.abs(x - 3.4) < 0.3, 0, diagram.labels))
    place = np.asarray(to_world(jnp.array(IN_COMB), found.xy))[:COUNT, 0]
    near = {k for k in np.flatnonzero(found.valid[:COUNT]) if place[k] < 3.4}
    pairs = joined(find(found, fenced, sources, scan))
    assert len(near) == 1 and len(pairs) == 1
    assert all((i in near) == (j in near) for i, j in pairs)


@pytest.mark.parametrize("junk", [3.0, jnp.nan])
def test_padding_is_invisible(junk):
    found, *rest = scene(COMB, IN_COMB)
    for gone in np.flatnonzero(found.valid[:COUNT]):
        fill = lambda x, k=gone: x.at[k].set(junk)
        clean = found._replace(valid=found.valid.at[gone].set(False))
        dirty = clean._replace(xy=fill(clean.xy), shape=fill(clean.shape), cov=fill(clean.cov))
        one, other = find(clean, *rest), find(dirty, *rest)
        assert joined(one) == joined(other) == walk(clean, *rest[:2])
        assert not any(gone in pair for pair in joined(one))
        keep = np.asarray(one.valid)
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(np.asarray(a)[keep], np.asarray(b)[keep])


def test_no_junctions_no_links():
    found, *rest = scene(COMB, IN_COMB)
    links = find(found._replace(valid=jnp.zeros_like(found.valid)), *rest)
    assert not links.valid.any()
    assert links.pair.tolist() == [list(p) for p in combinations(range(COUNT), 2)]


def test_local_map_is_front_end_and_links_and_maps_over_scans():
    found, diagram, sources, scan = scene(COMB, IN_COMB)
    links = find(found, diagram, sources, scan)
    many = slam.local_maps(CONFIG, jax.tree.map(lambda x: jnp.stack([x, x]), scan))
    for k in range(2):
        jax.tree.map(
            lambda one, all, k=k: np.testing.assert_allclose(all[k], one, atol=1e-9),
            (found, links),
            many,
        )
