"""Arcs on which an obstacle was put, or from which one was taken away."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.maps import TopologicalMap, without_arcs
from jaxslam.core.scan import Lidar, Scan
from jaxslam.mapping.blocked_arcs import LOOKS, MIN_BLOCKED, blocked_arcs
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World, outline

LIDAR = Lidar(num_beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=12.0)
ROOM, BOX, FAR = [(0, 0, 10, 4)], [(4.5, 1.6, 5.2, 2.6)], [(900, 900, 901, 901)]
LINES = (
    np.array([[1.0, 2.0], [9.0, 2.0]]),  # through the box
    np.array([[1.0, 1.0], [9.0, 1.0]]),  # past it, 0.6 m off
    np.array([[1.0, 3.2], [5.0, 2.9], [9.0, 3.2]]),
)
CLEARANCE = np.array([1.6, 0.6, np.nan])


@partial(jax.jit, static_argnums=0)
def cast(lidar, walls, poses):
    return jax.vmap(lambda pose: ray_casting.cast(lidar, World(walls), pose))(poses)


def scans_of(poses, blocks, room=ROOM, lidar=LIDAR):
    """Scans, of up to nine poses; of the same shapes with a block and without, compiled once."""
    walls = [outline(room, blocks)] if blocks else [outline(room), outline(FAR)]
    padded = np.concatenate([poses, np.tile(poses[-1:], (9 - len(poses), 1))])
    found = cast(lidar, jnp.asarray(np.concatenate(walls), float), jnp.asarray(padded))
    return jax.tree.map(lambda x: np.asarray(x)[: len(poses)], found)


def visit(count):
    """Poses of a robot that comes towards the box, on the line past it."""
    return np.stack([np.linspace(0.5, 3.5, count), np.full(count, 1.0), np.zeros(count)], axis=1)


def blocked_after(*visits):
    """Blocked arcs after visits, each a number of scans and whether the box is there."""
    poses = [visit(count) for count, _ in visits]
    scans = [
        scans_of(pose, BOX if there else []) for pose, (_, there) in zip(poses, visits, strict=True)
    ]
    scans = Scan(*(np.concatenate(x) for x in zip(*scans, strict=True)))
    return blocked_arcs(LIDAR, np.concatenate(poses), scans, LINES, CLEARANCE).tolist()


@pytest.mark.parametrize(
    "visits, expected",
    [
        ([(9, False)], False),
        ([(9, False), (9, True)], True),
        ([(9, True), (9, False)], False),
        ([(9, False), (2, True)], False),  # somebody who walked by
        ([(9, False), (9, True), (9, False)], False),
        ([(9, True), (9, False), (9, True)], True),
    ],
)
def test_the_last_looks_decide(visits, expected):
    assert blocked_after(*visits) == [expected, False, False]


def test_as_many_looks_are_needed_as_are_said():
    alone = [blocked_after((9, False), (count, True))[0] for count in range(2, LOOKS + 2)]
    assert alone == [count >= MIN_BLOCKED for count in range(2, LOOKS + 2)]


@pytest.mark.parametrize("y", [1.9, 1.98, 1.99, 2.0, 2.01, 2.02, 2.1])
@pytest.mark.parametrize("first", [-np.pi, 0.0])
def test_an_obstacle_that_was_taken_away_is_gone_in_a_long_room_and_behind_the_robot(y, first):
    lidar = Lidar(num_beams=360, angle_min=first, angle_increment=np.pi / 180, range_max=80.0)
    poses = np.stack([np.linspace(6.0, 8.5, 9), np.full(9, 2.0), np.zeros(9)], axis=1)
    scans = [
        scans_of(x, blocks, [(0, 0, 40, 4)], lidar) for x, blocks in ((poses, BOX), (poses, []))
    ]
    scans = Scan(*(np.concatenate(x) for x in zip(*scans, strict=True)))
    line = (np.array([[1.0, y], [9.0, y]]),)
    both = np.concatenate([poses, poses])
    assert blocked_arcs(lidar, poses, jax.tree.map(lambda x: x[:9], scans), line, np.ones(1)).all()
    assert not blocked_arcs(lidar, both, scans, line, np.ones(1)).any()


def test_a_map_without_arcs_or_scans_has_none_that_is_blocked():
    scans = scans_of(visit(3), [])
    assert not blocked_arcs(LIDAR, visit(3), scans, (), np.zeros(0)).size
    none = Scan(scans.ranges[:0], scans.hit[:0])
    assert blocked_arcs(LIDAR, visit(3)[:0], none, LINES, CLEARANCE).tolist() == 3 * [False]


def test_a_map_loses_the_arcs_that_are_gone_and_no_node():
    graph = TopologicalMap(
        id=np.arange(4),
        xy=np.zeros((4, 2)),
        kind=np.zeros(4, int),
        clearance=np.ones(4),
        arc_ends=np.array([[0, 1], [1, 2], [2, 3]]),
        arc_length=np.array([8.0, 8.0, 8.1]),
        arc_clearance=CLEARANCE,
        arc_lines=LINES,
    )
    left = without_arcs(graph, np.array([False, True, False]))
    assert left.arc_ends.tolist() == [[0, 1], [2, 3]] and left.arc_length.tolist() == [8.0, 8.1]
    assert len(left.arc_lines) == len(left.arc_clearance) == 2 and len(left.id) == 4
