import jax
import numpy as np
import pytest
from scipy import ndimage

from jaxslam.core import se2_np
from jaxslam.core.regions import Regions
from jaxslam.mapping import region_names, region_outline, rooms
from jaxslam.mapping.gaps import gaps_between, line_cells
from jaxslam.mapping.planner_data import region_at
from jaxslam.mapping.rooms import find_regions

CELL = 0.05
ORIGIN = np.array([-3.0, 2.0, 0.4])
DOOR = (np.array([4.2, 2.0]), 0.9)  # [m] middle and width


def carved(*boxes, shape=(180, 100)):
    """Free cells of boxes x0, x1, y0, y1 [m]."""
    free = np.zeros(shape, bool)
    for x0, x1, y0, y1 in np.rint(np.array(boxes) / CELL).astype(int):
        free[x0:x1, y0:y1] = True
    return free


def two_rooms():
    """Rooms of 3.8 x 4 m and 4 x 4 m with a wall of 0.2 m and a door of 0.9 m between them."""
    return carved((0.3, 4.1, 0.3, 4.3), (4.3, 8.3, 0.3, 4.3), (4.1, 4.3, 1.55, 2.45))


def divided(free, occupied=None, **options):
    occupied = ~free if occupied is None else occupied
    options = {"resolution": CELL, "origin": np.zeros(3)} | options
    return find_regions(occupied, free, **options)


def turned(free, degrees):
    return ndimage.rotate(free.astype(np.uint8), degrees, order=0) > 0


def contains(polygon, points):
    """Whether points (n, 2) are inside a polygon (m, 2), by crossings."""
    inside = np.zeros(len(points), bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crossed = (x0 <= points[:, 0]) != (x1 <= points[:, 0])
        at = y0 + (points[:, 0] - x0) / np.where(x1 == x0, 1.0, x1 - x0) * (y1 - y0)
        inside ^= crossed & (points[:, 1] < at)
    return inside


def check_records(found, free):
    """Laws of every division."""
    labels = np.unique(found.label)
    assert found.label.shape == free.shape and found.label.dtype == np.int32
    np.testing.assert_array_equal(labels[labels > 0], np.arange(len(found.regions)) + 1)
    for k, region in enumerate(found.regions):
        cells = (found.label == k + 1) & free
        assert region.area == pytest.approx(cells.sum() * found.resolution**2)
        assert all(k in found.regions[n].neighbours for n in region.neighbours)
        assert region.doors == tuple(i for i, d in enumerate(found.doors) if k in d.regions)
        behind = {r for i in region.doors for r in found.doors[i].regions} - {k}
        assert set(region.neighbours) == behind
        for ring, sign in ((region.polygon, 1.0), *((hole, -1.0) for hole in region.holes)):
            x, y = ring.T
            assert sign * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0.0
    for door in found.doors:
        assert door.regions[0] < door.regions[1]
        assert door.width == pytest.approx(np.hypot(*(door.jambs[1] - door.jambs[0])))
        np.testing.assert_allclose(door.jambs.mean(axis=0), door.xy)
    names = [r.name for r in found.regions] + [d.name for d in found.doors]
    assert len(set(names)) == len(names)


def test_two_rooms_and_a_door():
    free = two_rooms()
    found = divided(free)
    check_records(found, free)
    assert [r.name for r in found.regions] == ["room_1", "room_2"]
    assert [r.kind for r in found.regions] == ["room", "room"]
    (door,) = found.doors
    assert door.name == "door_1" and door.regions == (0, 1)
    assert door.width == pytest.approx(DOOR[1], abs=CELL)
    np.testing.assert_allclose(door.xy, DOOR[0], atol=2 * CELL)
    np.testing.assert_allclose(np.sort(door.jambs[:, 1]), [1.55, 2.45], atol=CELL)
    assert found.regions[0].area == pytest.approx(16.0, abs=0.2)  # the larger one
    assert found.last_numbers == (2, 1)


@pytest.mark.parametrize("degrees", [30, 45, 77])
def test_a_turned_map_has_the_same_rooms(degrees):
    free = turned(two_rooms(), degrees)
    found = divided(free)
    check_records(found, free)
    (door,) = found.doors
    assert len(found.regions) == 2 and door.width == pytest.approx(DOOR[1], abs=2 * CELL)
    areas = sorted(region.area for region in found.regions)
    np.testing.assert_allclose(areas, [15.2, 16.0], atol=0.4)


def test_positions_are_in_the_frame_of_the_map():
    found, moved = divided(two_rooms()), divided(two_rooms(), origin=ORIGIN)
    c, s = np.cos(ORIGIN[2]), np.sin(ORIGIN[2])
    for here, there in zip(found.regions, moved.regions, strict=True):
        expected = here.polygon @ np.array([[c, s], [-s, c]]) + ORIGIN[:2]
        np.testing.assert_allclose(there.polygon, expected, atol=1e-9)
    expected = found.doors[0].jambs @ np.array([[c, s], [-s, c]]) + ORIGIN[:2]
    np.testing.assert_allclose(moved.doors[0].jambs, expected, atol=1e-9)


def test_translation_and_mirror_images_have_the_same_rooms():
    free = corridor_with_rooms()
    found = divided(free)
    moved = divided(np.pad(free, ((13, 4), (9, 2))))
    np.testing.assert_array_equal(moved.label[13:-4, 9:-2], found.label)
    for flip in (np.s_[::-1], np.s_[:, ::-1]):
        mirrored = divided(free[flip])
        assert len(mirrored.regions) == len(found.regions)
        assert len(mirrored.doors) == len(found.doors)
        pairs = found.label[flip].astype(np.int64) * 100 + mirrored.label
        counts = np.unique(pairs, return_counts=True)[1]
        assert np.sort(counts)[-len(found.regions) - 1 :].sum() > 0.99 * free.size


def corridor_with_rooms():
    """A corridor of 12 x 1.6 m with two rooms on each side, and a hall at its end."""
    return carved(
        (0.3, 12.3, 3.6, 5.2),
        *((x, x + 4.0, 0.3, 3.4) for x in (0.3, 4.6)),
        *((x, x + 4.0, 5.4, 8.5) for x in (0.3, 4.6)),
        *((x, x + 0.85, 3.3, 3.7) for x in (1.5, 5.5)),
        *((x, x + 0.85, 5.1, 5.5) for x in (2.5, 6.5)),
        (12.3, 20.3, 0.3, 8.5),
        shape=(420, 180),
    )


def test_corridor_rooms_and_hall():
    free = corridor_with_rooms()
    found = divided(free)
    check_records(found, free)
    assert sorted(r.kind for r in found.regions) == ["corridor", "hall", *["room"] * 4]
    assert len(found.doors) == 5
    corridor = next(r for r in found.regions if r.kind == "corridor")
    assert len(corridor.neighbours) == 5 and corridor.area == pytest.approx(19.2, abs=1.0)
    widths = sorted(door.width for door in found.doors)
    np.testing.assert_allclose(widths, [0.85] * 4 + [1.6], atol=CELL)


def test_door_frames_and_bends_do_not_divide_a_corridor():
    ring = carved((0.3, 8.3, 0.3, 8.3), shape=(180, 180)) & ~carved(
        (1.9, 6.7, 1.9, 6.7), shape=(180, 180)
    )
    ring[80:84, 6:8] = ring[80:84, 36:38] = False  # a shallow frame, 1.4 m wide in 1.6 m
    found = divided(ring)
    assert [r.kind for r in found.regions] == ["corridor"] and not found.doors


def test_furniture_divides_nothing():
    free = two_rooms()
    rng = np.random.default_rng(1)
    furnished = free.copy()
    for x, y in rng.uniform([0.5, 0.5], [8.1, 4.1], (60, 2)):
        size = rng.uniform(0.05, 0.3)
        leg = carved((x, x + size, y, y + size)) & ~ndimage.binary_dilation(~free, iterations=4)
        furnished &= ~leg
    assert furnished.sum() < free.sum() - 500
    bare, found = divided(free), divided(furnished)
    check_records(found, furnished)
    np.testing.assert_array_equal(found.label, bare.label)
    for one, other in zip(found.regions, bare.regions, strict=True):
        np.testing.assert_array_equal(one.polygon, other.polygon)
        assert one.area < other.area
    assert found.doors[0].width == bare.doors[0].width


def test_labels_are_all_of_the_free_space_of_the_robot():
    free = corridor_with_rooms()
    free[2:4, 2:170] = True  # a slit that the robot does not fit in
    found = divided(free)
    assert not found.label[2:4].any()
    np.testing.assert_array_equal(found.label[5:] > 0, free[5:])
    for k in range(len(found.regions)):
        assert ndimage.label(found.label == k + 1)[1] == 1


def test_polygons_follow_the_cells():
    free = turned(corridor_with_rooms(), 17)
    found = divided(free)
    cells = np.argwhere(np.ones(free.shape, bool))[::7]
    for k, region in enumerate(found.regions):
        far = ndimage.distance_transform_edt(found.label == k + 1) > 2.0
        far |= ndimage.distance_transform_edt(found.label != k + 1) > 2.0
        inside = contains(region.polygon, (cells + 0.5) * CELL)
        is_region = found.label[tuple(cells.T)] == k + 1
        checked = far[tuple(cells.T)]
        np.testing.assert_array_equal(inside[checked], is_region[checked])
        assert len(region.polygon) < 80


def test_what_surrounds_a_plan_is_no_region():
    plan = np.pad(two_rooms(), 2)
    occupied = ndimage.binary_dilation(plan, iterations=2) & ~plan
    occupied[3:6, 40:60] = False  # the door of the house
    picture = np.pad(~occupied, 20, constant_values=True)
    found = divided(picture)
    assert len(found.regions) == 2 and not found.label[:10].any()
    assert len(found.doors) == 1


def test_free_space_up_to_the_border_of_a_picture_is_a_room():
    """The border bounds it like a wall: a plan without margins, or of one room."""
    for free in (np.ones((80, 60), bool), np.pad(np.ones((78, 58), bool), ((2, 0), (0, 2)))):
        (only,) = divided(free).regions
        assert only.area == pytest.approx(free.sum() * CELL**2)
    plan = two_rooms()[6:166, 6:86]  # a room of 60 % of the picture and one of 40 %
    plan = np.concatenate([np.repeat(plan[:76], 2, axis=0), plan[76:]])
    found = divided(plan)
    assert len(found.regions) == 2 and len(found.doors) == 1
    assert found.regions[0].area > 1.5 * found.regions[1].area


@pytest.mark.parametrize("size", [(1, 1), (3, 7), (40, 40)])
def test_maps_without_a_room(size):
    for value in (True, False) if max(size) < 40 else (False,):
        free = np.full(size, value)
        found = divided(free)
        assert isinstance(found, Regions) and not found.doors
        assert len(found.regions) == 0 and not found.label.any()


def test_names_stay_when_a_map_is_made_again():
    free = corridor_with_rooms()
    first = divided(free)
    rng = np.random.default_rng(2)
    edge = free & ndimage.binary_dilation(~free)
    noisy = free & ~(edge & (rng.random(free.shape) < 0.2))
    again = divided(noisy, previous=first)
    assert [r.name for r in again.regions] == [r.name for r in first.regions]
    assert [d.name for d in again.doors] == [d.name for d in first.doors]
    for one, other in zip(first.regions, again.regions, strict=True):
        np.testing.assert_allclose(one.polygon.mean(axis=0), other.polygon.mean(axis=0), atol=1.5)
        assert one.kind == other.kind
    fresh = divided(free)
    assert fresh.regions[0].name == "room_1"
    np.testing.assert_array_equal(fresh.label, first.label)


def test_names_stay_when_a_map_grows_and_are_not_used_again():
    free = corridor_with_rooms()
    small = free.copy()
    small[:, 108:] = False  # without the rooms on one side
    first = divided(small)
    grown = np.pad(free, ((30, 0), (10, 0)))
    origin = np.array([-30 * CELL, -10 * CELL, 0.0])
    second = divided(grown, previous=first, origin=origin)
    assert len(second.regions) == len(first.regions) + 2
    for old in first.regions:
        (new,) = (r for r in second.regions if r.name == old.name)
        np.testing.assert_allclose(new.polygon.min(axis=0), old.polygon.min(axis=0), atol=0.2)
    assert second.last_numbers[0] == len(second.regions)
    third = divided(small, previous=second)
    assert [r.name for r in third.regions] == [r.name for r in first.regions]
    assert third.last_numbers == second.last_numbers
    fourth = divided(grown, previous=third, origin=origin)
    names = {r.name for r in fourth.regions} - {r.name for r in first.regions}
    assert not names & {r.name for r in second.regions}


def test_a_room_in_the_ring_of_another_keeps_its_own_name():
    free = np.pad(two_rooms(), 60)
    ring = np.ones_like(free)
    ring[30:-30, 30:-30] = False
    ring[[0, 1, -2, -1]] = ring[:, [0, 1, -2, -1]] = False
    first = divided(free | ring)
    assert len(first.regions) == 3
    again = divided(free | ring, previous=first._replace(label=np.zeros((0, 0), np.int32)))
    np.testing.assert_array_equal(again.label, first.label)


def test_number_of_a_name():
    names = ("room_12", "door_3", "room_0", "room_-1", "kitchen", "room_1x")
    assert [region_names.number_of(name) for name in names] == [12, 3, 0, 0, 0, 0]


def test_outlines_do_not_join_cells_across_corners():
    label = np.zeros((6, 8), np.int32)
    label[1:3, 1:4] = label[3:5, 4:6] = 1  # two parts that touch in a corner
    ((polygon,),) = region_outline.outlines(label, 1)
    np.testing.assert_array_equal(polygon, [[1, 1], [3, 1], [3, 4], [1, 4]])


def test_outlines_of_few_cells_have_three_corners_at_least():
    label = np.array([[1, 2, 2, 2, 2, 0, 3]], np.int32)
    label = np.concatenate([label, [[0, 2, 0, 0, 2, 0, 0]], [[0, 2, 2, 2, 2, 0, 0]]])
    for loops in region_outline.outlines(label.astype(np.int32), 3):
        assert all(len(loop) >= 3 for loop in loops)


def rings_and_rooms(rng):
    """Free cells of rooms in rings of corridors in each other, turned, with doors at random."""
    size = 260
    x, y = np.indices((size, size)) - 0.5 * size
    angle = rng.uniform(0.0, np.pi)
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    stretch = rng.uniform(0.7, 1.0)
    out = np.maximum(np.abs(u), np.abs(v) / stretch)
    wide = rng.uniform(40.0, 50.0)  # of the room in the middle, larger than the ring
    first, second = wide + rng.uniform([16.0, 34.0], [19.0, 41.0])
    free = (out < wide) | ((out > wide + 4) & (out < first)) | ((out > first + 4) & (out < second))
    for start in (wide, first):
        side = rng.choice([-1.0, 1.0])
        at = rng.uniform(-0.5, 0.5) * wide * stretch
        free |= (side * u > start - 3) & (side * u < start + 7) & (np.abs(v - at) < 8.0)
    return free


@pytest.mark.parametrize("seed", range(8))
def test_by_polygons_cells_lie_in_the_region_that_the_picture_has(seed):
    """But for cells at the borders, as polygons are simplified by up to a cell."""
    free = rings_and_rooms(np.random.default_rng(seed))
    found = divided(free, origin=ORIGIN)
    assert len(found.regions) >= 3 and any(region.holes for region in found.regions)
    cells = np.argwhere(free)
    centres = se2_np.transform(ORIGIN, (cells + 0.5) * CELL)
    by_polygon = region_at(found._replace(label=np.zeros((0, 0), np.int32)), centres)
    by_cell = found.label[tuple(cells.T)] - 1
    assert np.mean(by_polygon == by_cell) > 0.97
    inner = np.zeros(free.shape, bool)
    for k in range(len(found.regions)):
        inner |= ndimage.distance_transform_edt(found.label == k + 1) > 2.0
    inner = inner[tuple(cells.T)]
    assert inner.mean() > 0.7
    np.testing.assert_array_equal(by_polygon[inner], by_cell[inner])


def walled(rng, door, hole, thickness):
    """A room of 6 x 6 m that a wall at a random angle divides, with a door and a hole [cells]."""
    x, y = np.indices((130, 130)) - 65.0
    angle = rng.choice([0.0, np.pi / 2, rng.uniform(0.0, np.pi)])
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    is_open = (np.abs(v - 15.0) < 0.5 * door) | (np.abs(v + 20.0) <= 0.5 * hole)
    wall = (np.abs(u) < max(0.5 * thickness, 0.75)) & ~is_open
    return (np.maximum(np.abs(x), np.abs(y)) < 60) & ~wall


@pytest.mark.parametrize("seed", range(30))
def test_a_small_hole_in_a_wall_joins_no_rooms_and_hides_no_door(seed):
    rng = np.random.default_rng(seed)
    free = walled(rng, 9, rng.integers(1, 4), rng.integers(1, 4))
    found = divided(free, resolution=0.1)
    assert len(found.regions) >= 2
    sides = {tuple(found.label[tuple(cell)] for cell in ((8, 8), (121, 121)))}
    sides |= {tuple(found.label[tuple(cell)] for cell in ((8, 121), (121, 8)))}
    assert any(a != b for a, b in sides)
    assert any(door.width == pytest.approx(0.9, abs=0.2) for door in found.doors)


@pytest.mark.parametrize("cell", [0.05, 0.2])
def test_steps_of_walls_that_are_turned_divide_no_corridor(cell):
    x, y = (np.indices((round(20 / cell),) * 2) + 0.5) * cell - 10.0
    for angle in np.linspace(0.0, 1.5, 9):
        c, s = np.cos(angle), np.sin(angle)
        free = (np.abs(x * c + y * s) < 8.0) & (np.abs(y * c - x * s) < 0.75)
        assert [region.kind for region in divided(free, resolution=cell).regions] == ["corridor"]


@pytest.mark.parametrize("cell", [0.1, 1.0])
def test_a_door_of_one_cell_is_a_door(cell):
    free = np.zeros((60, 30), bool)
    free[2:28, 2:28] = free[29:58, 2:28] = free[28, 12] = True
    found = divided(free, resolution=cell)
    assert len(found.regions) == 2
    assert [door.width for door in found.doors] == [pytest.approx(cell)]


def strips(*boxes):
    return lambda u, v: np.any(
        [(u >= x) & (u < x_end) & (v >= y) & (v < y_end) for x, x_end, y, y_end in boxes], axis=0
    )


KINDS = {
    "L": (strips((-9, 9, -9, -7), (-9, -7, -9, 9)), "corridor"),
    "T": (strips((-9, 9, -1.5, 1.5), (-1.5, 1.5, -9, 0)), "corridor"),
    "plus": (strips((-9, 9, -1, 1), (-1, 1, -9, 9)), "corridor"),
    "ring": (lambda u, v: np.abs(np.maximum(np.abs(u), np.abs(v)) - 8.0) <= 1.0, "corridor"),
    "round ring": (lambda u, v: np.abs(np.hypot(u, v) - 8.0) <= 1.0, "corridor"),
    "with a lobby": (lambda u, v: strips((-12, 12, -1, 1))(u, v) | (u**2 + v**2 < 4), "corridor"),
    "short": (strips((-4, 4, -0.8, 0.8)), "corridor"),
    "square of 100": (strips((-5, 5, -5, 5)), "hall"),
    "circle of 100": (lambda u, v: np.hypot(u, v) < 5.64, "hall"),
    "2:1 of 100": (strips((-7.07, 7.07, -3.535, 3.535)), "hall"),
    "nave": (strips((-12, 12, -3, 3), (-12, -6, -9, 3)), "hall"),
    "round hall": (lambda u, v: np.hypot(u, v) < 3.9, "hall"),
    "square of 25": (strips((-2.5, 2.5, -2.5, 2.5)), "room"),
    "2:1 of 32": (strips((-4, 4, -2, 2)), "room"),
    "circle of 20": (lambda u, v: np.hypot(u, v) < 2.5, "room"),
}


@pytest.mark.parametrize("angle", [0.0, 0.4])
@pytest.mark.parametrize("cell", [0.05, 0.2])
@pytest.mark.parametrize("name", KINDS)
def test_kinds_are_those_of_the_shape(name, cell, angle):
    inside, kind = KINDS[name]
    x, y = (np.indices((round(34 / cell),) * 2) + 0.5) * cell - 17.0
    free = inside(x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle))
    assert {region.kind for region in divided(free, resolution=cell).regions} == {kind}


def furnished(size, *boxes):
    """Free cells of a room of a size [m] with obstacles x0, x1, y0, y1 [m] in it."""
    free = np.ones(np.rint(np.array(size) / CELL).astype(int), bool)
    return np.pad(free & ~carved(*boxes, shape=free.shape), 6)


STANDING_FREE = {
    "long table": (furnished((6.0, 6.0), (2.25, 3.75, 1.5, 4.5)), "room"),
    "square table": (furnished((6.0, 6.0), (2.1, 3.9, 2.1, 3.9)), "room"),
    "small table": (furnished((5.0, 6.0), (1.75, 3.25, 2.25, 3.75)), "room"),
    "bed": (furnished((4.0, 5.0), (1.0, 3.0, 1.0, 2.6)), "room"),
    "pillars": (
        furnished(
            (12.0, 20.0),
            *((x, x + 1.2, y, y + 1.2) for x in (2, 5, 8) for y in range(2, 18, 3)),
        ),
        "hall",
    ),
    "shelves": (furnished((20.0, 30.0), *((x, x + 1, 2, 28) for x in range(3, 17, 3))), "hall"),
    "ring": (furnished((8.0, 8.0), (1.5, 6.5, 1.5, 6.5)), "corridor"),
    "two corridors": (furnished((7.0, 24.0), (2.0, 5.0, 2.0, 22.0)), "corridor"),
}


@pytest.mark.parametrize("name", STANDING_FREE)
def test_obstacles_that_stand_free_make_no_corridor(name):
    free, kind = STANDING_FREE[name]
    found = divided(free)
    assert [region.kind for region in found.regions] == [kind] and not found.doors
    assert found.regions[0].area == pytest.approx(free.sum() * CELL**2)


def test_a_ring_around_rooms_with_doors_is_a_corridor_around_a_closed_table_it_is_a_hall():
    around = furnished((9.0, 9.0), (2.8, 6.2, 2.8, 6.2))
    inside = np.pad(carved((2.9, 6.1, 2.9, 6.1), shape=(180, 180)), 6)
    closed = divided(around | inside)
    assert [region.kind for region in closed.regions] == ["hall", "room"] and not closed.doors
    door = np.pad(carved((4.0, 4.9, 2.8, 2.9), shape=(180, 180)), 6)
    opened = divided(around | inside | door)
    assert [region.kind for region in opened.regions] == ["corridor", "room"]


def test_space_between_furniture_and_walls_is_part_of_the_room():
    corner = furnished((6.0, 6.0), (0.85, 2.35, 0.85, 1.85))
    bed = furnished((4.0, 5.0), (0.0, 2.0, 0.7, 2.3))
    for free in (corner, bed):
        found = divided(free)
        assert [region.kind for region in found.regions] == ["room"] and not found.doors


def test_a_passage_into_unseen_space_is_a_region():
    free = np.pad(two_rooms(), ((0, 60), (0, 0)))
    free[166:210, 32:50] = True  # 2.2 x 0.9 m
    walls = ndimage.binary_dilation(free, iterations=2) & ~free
    assert len(divided(free, walls).regions) == 2
    walls[210:] = False
    assert len(divided(free, walls).regions) == 3


@pytest.mark.parametrize(
    "size, kind", [((7.0, 7.0), "hall"), ((7.05, 7.0), "hall"), ((6.95, 7.0), "room")]
)
def test_a_hall_is_seven_metres_wide_at_least(size, kind):
    assert [region.kind for region in divided(furnished(size)).regions] == [kind]


def test_lines_between_cells_are_connected():
    cells = line_cells(np.array([[2, 3], [9, 7]]))
    np.testing.assert_array_equal(cells[[0, -1]], [[2, 3], [9, 7]])
    assert np.abs(np.diff(cells, axis=0)).max() == 1
    gaps = gaps_between(np.array([[[2, 3], [2, 9]]]))
    np.testing.assert_allclose([*gaps.normal[0], gaps.width[0]], [-1.0, 0.0, 5.0])


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"resolution": 0.0}, "resolution"),
        ({"resolution": None}, "resolution"),
        ({"robot_radius": np.nan}, "robot_radius"),
        ({"robot_radius": 0.0}, "robot_radius is 0.0, not a positive number of metres"),
        ({"robot_radius": "a"}, "robot_radius"),
        ({"origin": np.zeros(2)}, "origin"),
        ({"origin": [np.nan, 0.0, 0.0]}, "origin"),
        ({"previous": 3}, "previous is int, not Regions"),
        (dict.fromkeys(("occupied", "free"), np.zeros((0, 0), bool)), "occupied"),
        ({"occupied": np.zeros((3, 3), bool)}, "free"),
        ({"free": np.zeros((180, 100))}, "free"),
    ],
)
def test_arguments_that_do_not_fit(wrong, problem):
    free = two_rooms()
    given = {"occupied": ~free, "free": free, "resolution": CELL, "origin": np.zeros(3)}
    with pytest.raises(ValueError, match=f"^{problem}"):
        find_regions(**{**given, **wrong})


def test_lists_and_jax_arrays_are_taken_alike():
    free = two_rooms()
    want = divided(free)
    found = find_regions(
        (~free).tolist(), jax.numpy.asarray(free), resolution=CELL, origin=[0, 0, 0]
    )
    np.testing.assert_array_equal(found.label, want.label)


def test_parts_too_small_for_a_region_join_a_neighbour():
    free = two_rooms()
    free |= carved((8.3, 8.4, 1.0, 1.6), (8.4, 8.95, 0.9, 1.7))  # a niche behind a gap
    found = divided(free)
    assert len(found.regions) == 2 and len(found.doors) == 1
    assert found.label[172, 26] == found.label[150, 40]
    assert rooms.MIN_AREA > 0.5
