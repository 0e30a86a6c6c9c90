"""Laws of random buildings: closed, reachable, with true proportions and look-alike rooms."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxslam.core.scan import Lidar
from jaxslam.simulation import buildings, ray_casting
from jaxslam.simulation.buildings import named_building
from jaxslam.simulation.worlds import World

SIZES = [(10.0, 8.0), (8.0, 11.0), (20.0, 15.0), (30.0, 20.0)]
CASES = [(seed, size) for seed in range(4) for size in SIZES]

building = lru_cache(buildings.building)


def clearance(points, walls):
    """Distance (N,) [m] of points (N, 2) to the nearest wall, exact."""
    best = np.full(len(points), np.inf)
    for x1, y1, x2, y2 in walls:
        along, offset = np.array([x2 - x1, y2 - y1]), points - [x1, y1]
        part = np.clip(offset @ along / (along @ along), 0, 1)
        best = np.minimum(best, np.hypot(*(offset - part[:, None] * along).T))
    return best


def inside(points, box):
    """Whether points (N, 2) lie in a box, its border not counted."""
    return ((points > box[:2]) & (points < box[2:])).all(axis=1)


@pytest.mark.parametrize("seed, size", CASES)
def test_every_end_of_a_wall_is_the_end_of_another(seed, size):
    ends, count = np.unique(
        building(seed, size).world.walls.reshape(-1, 2), axis=0, return_counts=True
    )
    assert np.all(count % 2 == 0), ends[count % 2 == 1]


@pytest.mark.parametrize("seed, size", CASES)
def test_walls_reach_from_the_origin_to_the_size(seed, size):
    ends = building(seed, size).world.walls.reshape(-1, 2)
    np.testing.assert_array_equal([ends.min(axis=0), ends.max(axis=0)], [(0.0, 0.0), size])


def test_no_beam_leaves():
    lidar = Lidar(num_beams=720, angle_increment=np.pi / 360, range_max=float(np.hypot(*SIZES[1])))
    cast = jax.jit(partial(ray_casting.cast, lidar))
    for seed in range(4):
        plan = building(seed, SIZES[1])
        walls = jnp.pad(jnp.asarray(plan.world.walls), ((0, 400 - len(plan.world.walls)), (0, 0)))
        for door in plan.doors:
            middle = (door[:2] + door[2:]) / 2
            scan = cast(World(walls), jnp.array([*middle, 0.123]))
            assert np.all(scan.hit), (seed, door)


@pytest.mark.parametrize("seed, size", CASES)
def test_no_wall_crosses_a_door(seed, size):
    plan = building(seed, size)
    walls = plan.world.walls
    fraction = np.linspace(0, 1, 400)[:, None, None]
    points = (walls[:, :2] + fraction * (walls[:, 2:] - walls[:, :2])).reshape(-1, 2)
    for door in plan.doors:
        across = int(np.argmax(door[2:] - door[:2]))  # along the wall that the door is in
        free = door.copy()
        free[[1 - across, 3 - across]] += [-0.4, 0.4]  # and in front of it
        free += [1e-6, 1e-6, -1e-6, -1e-6]
        assert not inside(points, free).any(), door


@pytest.mark.parametrize("seed, size", CASES)
def test_doors_corridors_and_walls_have_true_proportions(seed, size):
    plan = building(seed, size)
    sides = np.sort(plan.doors[:, 2:] - plan.doors[:, :2], axis=1)
    assert np.all((sides[:, 1] >= 0.8 - 1e-9) & (sides[:, 1] <= 1.2 + 1e-9))
    assert np.all((sides[:, 0] >= 0.1 - 1e-9) & (sides[:, 0] <= 0.26))
    width = (plan.corridors[:, 2:] - plan.corridors[:, :2]).min(axis=1)
    assert np.all((width >= 1.6 - 1e-9) & (width <= 3.0 + 1e-9))
    assert (plan.rooms[:, 2:] - plan.rooms[:, :2]).min() >= 2.4 - 1e-9
    overlap = np.minimum(plan.rooms[:, None, 2:], plan.rooms[None, :, 2:])
    overlap -= np.maximum(plan.rooms[:, None, :2], plan.rooms[None, :, :2])
    apart = -overlap.max(axis=-1)[~np.eye(len(plan.rooms), dtype=bool)]
    assert np.all(overlap.min(axis=-1)[~np.eye(len(plan.rooms), dtype=bool)] < -0.09), apart


@pytest.mark.parametrize("seed, size", CASES)
def test_doors_join_what_they_are_said_to_join(seed, size):
    plan = building(seed, size)
    regions = np.concatenate([plan.rooms, plan.corridors])
    reached = {len(plan.rooms)}
    for door, sides in zip(plan.doors, plan.door_sides, strict=True):
        for box in regions[sides]:
            gap = np.maximum(box[:2] - door[2:], door[:2] - box[2:])
            assert np.isclose(np.sort(gap)[1], 0.0, atol=1e-6)  # it touches, along its width
            assert np.sort(gap)[0] < -0.8 + 1e-6
    for _ in regions:  # along doors, and where corridors overlap
        reached |= {b for a, b in plan.door_sides.tolist() if a in reached}
        reached |= {a for a, b in plan.door_sides.tolist() if b in reached}
        for k in range(len(plan.rooms), len(regions)):
            others = [regions[n] for n in reached if n >= len(plan.rooms)]
            if any(np.all((regions[k][:2] <= o[2:]) & (regions[k][2:] >= o[:2])) for o in others):
                reached.add(k)
    assert reached == set(range(len(regions)))


@pytest.mark.parametrize("seed, size", [(s, SIZES[0]) for s in range(8)] + [(5, SIZES[2])])
def test_a_robot_reaches_every_room_and_all_that_is_not_under_a_table(seed, size):
    plan, cell = building(seed, size), 0.05
    axes = [np.arange(cell / 2, side, cell) for side in size]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    fits = clearance(points, plan.world.walls) >= 0.25
    part, _ = ndimage.label(fits.reshape(len(axes[0]), -1))
    part = part.ravel()
    corridor = inside(points, plan.corridors[0]) & fits
    main = np.bincount(part[corridor]).argmax()
    for room in plan.rooms:
        area = np.bincount(part[inside(points, room) & fits], minlength=main + 1) * cell**2
        assert area[main] > 0.5 * area.sum()
        assert np.delete(area, main).max() < 0.55, room  # between the legs of a table


def in_room(plan, k, quarter):
    """The walls of room k in its own frame, turned by quarter turns: sorted rows, to 1 um."""
    low, high = plan.rooms[k][:2], plan.rooms[k][2:]
    walls = plan.world.walls.reshape(-1, 2, 2)
    own = walls[((walls >= low - 1e-6) & (walls <= high + 1e-6)).all(axis=(1, 2))]
    turn = np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarter)
    own = np.round((own - (low + high) / 2) @ turn, 6) + 0.0
    rows = [sorted(map(tuple, wall)) for wall in own.tolist()]
    return np.array(sorted(rows))


@pytest.mark.parametrize("seed, size", CASES)
def test_look_alike_rooms_are_equal_but_for_their_pose(seed, size):
    plan = building(seed, size)
    assert plan.alike.max() >= 0
    for group in range(plan.alike.max() + 1):
        first, *others = np.flatnonzero(plan.alike == group)
        assert others
        wanted = in_room(plan, first, 0)
        for k in others:
            turned = [in_room(plan, k, quarter) for quarter in range(4)]
            assert any(
                t.shape == wanted.shape and np.allclose(t, wanted, atol=2e-6) for t in turned
            ), (first, k)


def test_look_alike_rooms_are_furnished():
    pieces = [
        len(in_room(plan, k, 0)) > 6  # four walls, one of them in two parts, and one more
        for plan in (building(seed, SIZES[3]) for seed in range(4))
        for k in np.flatnonzero(plan.alike >= 0)
    ]
    assert np.mean(pieces) > 0.8


def test_columns_are_round_and_stand_free():
    found = [
        (c, building(s, SIZES[3]))
        for s in range(4)
        for c in building(s, SIZES[3]).furniture.columns
    ]
    assert len(found) > 4
    for (x, y, radius), plan in found:
        distance = clearance(np.array([[x, y]]), plan.world.walls)[0]
        assert radius - 0.002 <= distance <= radius + 1e-9
        ring = np.array([x, y]) + (radius + 0.7) * np.column_stack(
            [f(np.linspace(0, 2 * np.pi, 60)) for f in (np.cos, np.sin)]
        )
        assert clearance(ring, plan.world.walls).min() > 0.04


def test_seeds_differ_and_a_seed_gives_the_same_building():
    plans = [buildings.building(seed).world.walls for seed in range(6)]
    shapes = {walls.tobytes() for walls in plans}
    assert len(shapes) == 6
    np.testing.assert_array_equal(buildings.building(np.int64(3)).world.walls, plans[3])
    np.testing.assert_array_equal(named_building("random:3").world.walls, plans[3])


def test_a_name_gives_seed_and_size():
    plan = named_building("random:7:21.5x9")
    assert plan.size == (21.5, 9.0)
    np.testing.assert_array_equal(plan.world.walls, building(7, (21.5, 9.0)).world.walls)


@pytest.mark.parametrize(
    "name, line",
    [
        ("random:", r"world 'random:' is not of the form random:SEED or random:SEED:LENGTHxWIDTH"),
        ("random:-1", "is not of the form random:SEED"),
        ("random:7:40", "is not of the form random:SEED"),
        ("random:7:40x25m", "is not of the form random:SEED"),
        ("random:9999999999", "seed is 9999999999, not a whole number from 0 to 4294967295"),
        ("random:1:9x9", "size is 9 x 9 m; a building has at least 10 x 8 m and at most 200 x 200"),
        ("random:1:300x20", "size is 300 x 20 m; .* at most 200 x 200 m"),
    ],
)
def test_a_name_that_is_not_possible_is_refused(name, line):
    with pytest.raises(ValueError, match=line):
        named_building(name)


@pytest.mark.parametrize(
    "seed, size, line",
    [
        (1.5, (20, 15), "seed is 1.5, not a whole number"),
        (True, (20, 15), "seed is True, not a whole number"),
        (1, 20, "size is 20, not length and width in metres"),
        (1, (20, float("nan")), "size is nan, not"),
    ],
)
def test_arguments_that_are_not_possible_are_refused(seed, size, line):
    with pytest.raises(ValueError, match=line):
        buildings.building(seed, size)
