"""Laws of drives that are found: clear of walls, through all rooms, short, driven to the end."""

from functools import lru_cache
from itertools import pairwise, permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse import csgraph, csr_array

from jaxslam import simulation
from jaxslam.core.maps import OccupancyMap
from jaxslam.simulation import arguments, drives, named_worlds, wall_grid, worlds
from jaxslam.simulation.buildings import building
from jaxslam.simulation.patrols import patrol, route
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.visiting_order import visiting_order
from jaxslam.simulation.worlds import World, outline

RADIUS = 0.25
SMALL = (12.0, 10.0)
OFFICE = worlds.named("office").walls
OPEN = worlds.named("fig06b").walls  # a corridor with an alcove, open at both ends

found_patrol = lru_cache(lambda seed, size=SMALL: patrol(building(seed, size).world.walls))


def clearance(points, walls):
    """Distance (N,) [m] of points (N, 2) to the nearest wall, exact."""
    best = np.full(len(points), np.inf)
    for x1, y1, x2, y2 in walls:
        along, offset = np.array([x2 - x1, y2 - y1]), points - [x1, y1]
        part = np.clip(offset @ along / (along @ along), 0, 1)
        best = np.minimum(best, np.hypot(*(offset - part[:, None] * along).T))
    return best


def between(path):
    """A path (N, 2) with the middles between its points, too."""
    return np.concatenate([path, (path[1:] + path[:-1]) / 2])


def grid(walls, cell):
    """Points (H, W, 2) [m] over the bounding box, and where a robot fits, by exact distances."""
    ends = walls.reshape(-1, 2)
    axes = [np.arange(a, b, cell) for a, b in zip(ends.min(axis=0), ends.max(axis=0), strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return points, (clearance(points.reshape(-1, 2), walls) >= RADIUS).reshape(points.shape[:2])


def shortest(walls, cell, start):
    """Length (H, W) [m] of the shortest paths from `start` over a grid, and its points.

    Steps lead to 16 neighbours, so lengths are at most 3 % longer than those of straight lines.
    """
    points, free = grid(walls, cell)
    number = np.arange(free.size).reshape(free.shape)
    pairs, lengths = [], []
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1)):
        h, w = free.shape
        one = np.s_[: h - i, max(0, -j) : w - max(0, j)]
        two = np.s_[i:, max(0, j) : w + min(0, j)]
        both = free[one] & free[two]
        pairs.append(np.stack([number[one][both], number[two][both]]))
        lengths.append(np.full(both.sum(), cell * np.hypot(i, j)))
    steps = np.concatenate(lengths), tuple(np.concatenate(pairs, axis=1))
    graph = csr_array(steps, shape=(free.size, free.size))
    gap = np.where(free, np.hypot(*np.moveaxis(points - start, -1, 0)), np.inf)
    length = csgraph.dijkstra(graph, directed=False, indices=gap.argmin()).reshape(free.shape)
    return length, points


def driven(path):
    """Positions of a robot without noise that drives along a path, every 4 cm or so."""
    points = arguments.as_path(path, None)
    num_scans = drives.num_scans_of_drive(Robot(), points)
    robot = Robot(encoder_noise=0.0)
    poses = np.asarray(drives.drive(jax.random.key(0), robot, points, num_scans=num_scans)[0])
    fraction = np.linspace(0, 1, 8, endpoint=False)[:, None, None]
    steps = poses[:-1, :2] + fraction * np.diff(poses[:, :2], axis=0)
    return np.concatenate([steps.transpose(1, 0, 2).reshape(-1, 2), poses[-1:, :2]])


def visited(path, boxes):
    """Which boxes (K, 4) a path enters, by 0.2 m at least."""
    deep = (path[:, None] > boxes[:, :2] + 0.2) & (path[:, None] < boxes[:, 2:] - 0.2)
    return deep.all(axis=2).any(axis=0)


@pytest.mark.parametrize("seed", range(4))
def test_a_patrol_visits_every_room_and_keeps_its_distance(seed):
    plan, found = building(seed, SMALL), found_patrol(seed)
    assert visited(found.path, plan.rooms).all()
    assert clearance(between(found.path), plan.world.walls).min() >= RADIUS
    assert len(found.stops) >= len(plan.rooms)


def test_a_patrol_of_the_office_visits_all_that_a_flood_fill_reaches():
    """Rooms are here what remains connected of the flood fill when doors are closed."""
    found = patrol(OFFICE)
    points, free = grid(OFFICE, 0.1)
    wide = (clearance(points.reshape(-1, 2), OFFICE) > 0.6).reshape(free.shape)
    part, _ = ndimage.label(free)
    reached = part == np.bincount(part[free]).argmax()
    rooms, count = ndimage.label(wide & reached)
    index = np.round((found.path - points[0, 0]) / 0.1).astype(int)
    assert count >= 10
    assert set(np.unique(rooms[tuple(index.T)])) >= set(range(1, count + 1))
    assert clearance(between(found.path), OFFICE).min() >= RADIUS


@pytest.mark.parametrize("kind", ["patrol", "route"])
def test_a_robot_drives_to_the_end_and_into_every_room(kind):
    plan = building(1, SMALL)
    found = found_patrol(1) if kind == "patrol" else route(plan.world.walls)
    positions = driven(found.path)
    assert np.hypot(*(positions[-1] - found.path[-1])) < 0.06
    assert clearance(positions, plan.world.walls).min() >= RADIUS
    if kind == "patrol":
        assert visited(positions, plan.rooms).all()


def test_a_closed_patrol_ends_where_it_begins():
    walls = building(2, SMALL).world.walls
    start = found_patrol(2).stops[3]
    found = patrol(walls, start=start, closed=True)
    np.testing.assert_allclose(found.path[[0, -1]], [start, start], atol=1e-9)
    assert visited(found.path, building(2, SMALL).rooms).all()
    assert clearance(between(found.path), walls).min() >= RADIUS


@pytest.mark.parametrize("seed", range(3))
def test_a_route_is_hardly_longer_than_the_shortest_path(seed):
    walls = building(seed, SMALL).world.walls
    stops = found_patrol(seed).stops
    found = route(walls, stops[0], stops[-2])
    length, points = shortest(walls, 0.05, stops[0])
    near = np.hypot(*np.moveaxis(points - stops[-2], -1, 0)).argmin()
    assert 0.9 * length.ravel()[near] <= found.length <= 1.2 * length.ravel()[near]
    np.testing.assert_allclose(found.path[[0, -1]], [stops[0], stops[-2]], atol=1e-9)
    assert clearance(between(found.path), walls).min() >= RADIUS


def test_a_route_takes_a_narrow_passage_rather_than_a_long_detour():
    walls = outline([(0, 0, 4, 8), (4, 1, 6, 1.56), (4, 6, 6, 8), (6, 0, 10, 8)])
    found = route(walls, (3.0, 1.3), (7.0, 1.3))
    assert found.length < 1.1 * 4.0
    assert clearance(between(found.path), walls).min() >= RADIUS


def test_a_route_without_ends_is_about_as_long_as_any():
    walls = building(0, SMALL).world.walls
    found = route(walls)
    length, _ = shortest(walls, 0.1, found.path[0])
    assert found.length > 0.85 * length[np.isfinite(length)].max()
    longest = 0.0
    for stop in found_patrol(0).stops:
        length, _ = shortest(walls, 0.1, stop)
        longest = max(longest, length[np.isfinite(length)].max())
    assert found.length > 0.8 * longest


def rooms_with_passage(width, height=4.0):
    """Two rooms that a passage joins, [m] wide and 1 m long."""
    return outline([(0, 0, 4, height), (4, 1, 5, 1 + width), (5, 0, 9, height)])


def test_a_passage_is_passed_if_the_robot_fits_and_not_if_it_does_not():
    found = route(rooms_with_passage(0.56), (1.0, 3.0), (8.0, 3.0))
    assert found.path[:, 0].max() > 7.9
    assert clearance(between(found.path), rooms_with_passage(0.56)).min() >= RADIUS
    with pytest.raises(ValueError, match=r"goal \(8, 3\) cannot be reached from start \(1, 3\)"):
        route(rooms_with_passage(0.49), (1.0, 3.0), (8.0, 3.0))
    assert "1 more enclosed region" in patrol(rooms_with_passage(0.49, 5.0)).notes[1]


def test_the_inside_of_a_thick_wall_is_not_free():
    """The block in the middle holds a larger disc than the ring around it; it is not entered."""
    ring, block = (0.0, 0.0, 9.0, 9.0), (1.5, 1.5, 7.5, 7.5)
    found = patrol(outline([ring], [block]))
    inside = ((found.path > 1.5) & (found.path < 7.5)).all(axis=1)
    assert not inside.any()
    assert "1 more enclosed region" in found.notes[1]


def test_an_open_world_needs_a_start():
    with pytest.raises(ValueError, match=r"walls enclose no free space .* give start = \(x, y\)"):
        patrol(OPEN)
    found = patrol(OPEN, start=(1.0, 0.0))
    assert "not enclosed" in found.notes[0]
    np.testing.assert_allclose(found.path[0], (1.0, 0.0))
    assert clearance(between(found.path), OPEN).min() >= RADIUS
    goal = route(OPEN, (0.5, 0.0), (5.5, 0.0))
    assert 5.0 <= goal.length < 5.3


def map_of_an_open_plan():
    """Walls of two rooms with an exit, open to the outside, and a map that is free inside."""
    free_boxes = [(0, 0, 4, 4), (4, 1, 4.5, 2), (4.5, 0, 9, 4), (2, 4, 3, 4.5)]
    cell, origin = 0.05, np.array([-1.0, -1.0, 0.0])
    centre = np.stack(np.indices((220, 140)), axis=-1) * cell + cell / 2 - 1.0
    free = np.zeros(centre.shape[:2], bool)
    for box in free_boxes:
        free |= ((centre > box[:2]) & (centre < box[2:])).all(axis=-1)
    walls = outline(free_boxes)
    walls = walls[~(walls[:, [1, 3]] == 4.5).all(axis=1)]  # the exit has no door
    occupied = ndimage.binary_dilation(free, np.ones((3, 3))) & ~free
    free[60:62, 60:62] = False  # an island that no beam has passed
    return walls, OccupancyMap(occupied, free, cell, origin)


def test_a_robot_stays_where_a_map_is_free():
    walls, occupancy = map_of_an_open_plan()
    with pytest.raises(ValueError, match="walls enclose no free space"):
        patrol(walls)
    found = patrol(walls, occupancy=occupancy)
    assert visited(found.path, np.array([(0, 0, 4, 4), (4.5, 0, 9, 4)])).all()
    assert found.path.min() > RADIUS and found.path[:, 0].max() < 8.75
    assert found.path[:, 1].max() < 4.3  # the map ends behind the exit
    assert clearance(between(found.path), walls).min() >= RADIUS
    whole = occupancy._replace(occupied=occupancy.occupied & False, free=occupancy.free | True)
    found = patrol(walls, occupancy=whole)  # nothing is enclosed but by the border of the map
    assert clearance(between(found.path), walls).min() >= RADIUS
    with pytest.raises(ValueError, match="occupancy is int, not OccupancyMap"):
        patrol(walls, occupancy=3)


@pytest.mark.parametrize("seed", range(3))
def test_distances_on_the_grid_are_never_too_large_where_they_decide(seed):
    """Walls at random angles; the robot fits where it does by exact distances, to half a cell."""
    rng = np.random.default_rng(seed)
    walls = rng.uniform(0, 6, (12, 4))
    found = wall_grid.wall_grid(walls, RADIUS)
    cells = np.indices(found.region.shape).reshape(2, -1).T
    exact = clearance(found.to_world(cells), walls)
    fits = found.region.ravel() > 0
    assert exact[fits].min() >= RADIUS
    assert np.all(fits[exact >= RADIUS + 0.005])
    points = rng.uniform(0, 6, (500, 2))
    exact = clearance(points, walls)
    assert np.all(found.clearances(points) <= exact + 1e-12)
    assert np.all(found.clearances(points)[exact > 0.1] >= exact[exact > 0.1] - 0.002)


def test_large_worlds_have_larger_cells_and_say_so(monkeypatch):
    monkeypatch.setattr(wall_grid, "MAX_CELLS", 20_000)
    walls = building(1, SMALL).world.walls
    found = patrol(walls)
    assert any("cells of 0.08" in note for note in found.notes)
    assert clearance(between(found.path), walls).min() >= RADIUS
    assert visited(found.path, building(1, SMALL).rooms).all()
    with pytest.raises(ValueError, match="more than 20000 cells, or too large ones"):
        patrol(walls * 10)


@pytest.mark.parametrize(
    "walls, options, line",
    [
        (
            OFFICE,
            {"start": (0.1, 5.0)},
            r"start \(0.1, 5\) is in a wall or 0.10 m from one; .*0.25 m",
        ),
        (OFFICE, {"start": (2.07, 5.0)}, r"start \(2.07, 5\) is in a wall"),
        (OFFICE, {"start": (50.0, 5.0)}, r"start \(50, 5\) is not within the walls' bounding box"),
        (OFFICE, {"start": (np.nan, 5.0)}, r"start is \[nan, 5.0\], not finite"),
        (OFFICE, {"start": 3.0}, "start is .*"),
        (OFFICE, {"robot_radius": 4.0}, "walls enclose no free space .* robot_radius = 4 m fits"),
        (OFFICE, {"robot_radius": 0.0}, "robot_radius is 0"),
        (OFFICE, {"resolution": 0.5}, "or too large ones for robot_radius = 0.25 m"),
        (OFFICE[:, :3], {}, r"walls is .*\(36, 3\)|walls is .*, 3\), not"),
        (np.zeros((3, 4)), {}, "walls holds no wall with a length"),
        (np.full((3, 4), np.nan), {}, "walls holds numbers that are not finite"),
    ],
)
def test_a_patrol_that_is_not_possible_is_refused(walls, options, line):
    with pytest.raises(ValueError, match=line) as error:
        patrol(walls, **options)
    assert "\n" not in str(error.value)


def test_a_random_building_is_a_world_with_a_patrol():
    world = arguments.as_world("random:1:12x10")
    np.testing.assert_array_equal(world.walls, building(1, SMALL).world.walls)
    path = arguments.as_path(None, "random:1:12x10")
    np.testing.assert_array_equal(path, found_patrol(1).path)
    np.testing.assert_array_equal(arguments.as_path(path, None), path)
    assert isinstance(path, jax.Array) and path.dtype == jnp.zeros(0).dtype
    np.testing.assert_array_equal(named_worlds.found_drive(world, "patrol").path, path)
    with pytest.raises(ValueError, match="no kind of drive named 'walk'; there are: patrol, route"):
        named_worlds.found_drive(World(OFFICE), "walk")
    with pytest.raises(ValueError, match="no world named 'moon'; .*, random:SEED"):
        named_worlds.named("moon")


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("closed, first", [(False, False), (False, True), (True, True)])
def test_a_visiting_order_is_nearly_the_shortest(seed, closed, first):
    points = np.random.default_rng(seed).uniform(size=(7, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))

    def length(order):
        return sum(distance[pair] for pair in pairwise(order))

    order = visiting_order(distance, closed=closed, first=first)
    assert sorted(order[: len(points)]) == list(range(7))
    assert not closed or order[-1] == order[0]
    assert not first or order[0] == 0
    every = [p for p in permutations(range(7)) if not first or p[0] == 0]
    best = min(length((*p, p[0]) if closed else p) for p in every)
    assert best - 1e-12 <= length(order) <= 1.05 * best


@pytest.mark.parametrize("closed", [False, True])
def test_no_turn_of_a_part_and_no_move_of_a_place_makes_an_order_shorter(closed):
    points = np.random.default_rng(5).uniform(size=(40, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    order = visiting_order(distance, closed=closed, first=False)

    def length(order):
        return sum(distance[pair] for pair in pairwise(order))

    least = length(order) - 1e-9
    low, high = (1, 40) if closed else (0, 40)
    for i in range(low, high):
        for j in range(i + 1, high):
            assert length([*order[:i], *order[i : j + 1][::-1], *order[j + 1 :]]) > least
        rest = [*order[:i], *order[i + 1 :]]
        for j in range(low, high):
            assert length([*rest[:j], order[i], *rest[j:]]) > least


def test_a_visiting_order_goes_round_a_circle():
    angle = np.random.default_rng(0).permutation(60) * 2 * np.pi / 60
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    order = visiting_order(distance, closed=True, first=False)
    assert np.isclose(distance[order[:-1], order[1:]].sum(), 120 * np.sin(np.pi / 60))
    assert visiting_order(distance[:1, :1], closed=False, first=False) == [0]


def test_random_buildings_are_named_like_the_built_in_worlds():
    walls = np.asarray(simulation.named("random:3:12.5x10").walls)
    np.testing.assert_array_equal(walls, simulation.building(3, (12.5, 10.0)).world.walls)
    np.testing.assert_array_equal(simulation.named("office").walls, worlds.named("office").walls)
    assert len(simulation.named_path("random:3:12.5x10")) > 100
