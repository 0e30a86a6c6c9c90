"""Outlines of grids: exact where walls are straight along the cells, one side where they slant."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxslam import Lidar
from jaxslam.core.maps import OccupancyMap
from jaxslam.core.se2_np import transform
from jaxslam.io import ros_map, world_grid, world_outline
from jaxslam.simulation.ray_casting import cast
from jaxslam.simulation.worlds import World

SIZE = 200
BEAMS = 90
RAY_CAST = jax.jit(cast, static_argnums=0)


def grid_of(occupied, resolution=1.0, origin=(0.0, 0.0, 0.0)):
    return OccupancyMap(occupied, ~occupied, resolution, np.array(origin))


def building(angle, size=SIZE):
    """Cells of a turned room with thick walls, an inner wall and a round column."""
    x, y = np.meshgrid(*2 * [np.arange(size) + 0.5 - size / 2], indexing="ij")
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    inside = (abs(u) < 70) & (abs(v) < 50)
    walls = (abs(u) < 74) & (abs(v) < 54) & ~inside
    walls |= inside & (abs(u - 10) < 1.6) & (v > -20)
    return walls | (np.hypot(u + 30, v - 10) < 6)


def marched(occupied, start, angle, furthest):
    """Distance [cells] from a point to the first occupied cell, cell by cell."""
    beam = np.array([np.cos(angle), np.sin(angle)])
    cell, step = np.floor(start).astype(int), np.where(beam > 0, 1, -1)
    with np.errstate(divide="ignore"):
        border, width = (cell + (beam > 0) - start) / beam, abs(1 / beam)
    while (first := border.min()) < furthest:
        axis = int(border.argmin())
        cell[axis] += step[axis]
        border[axis] += width[axis]
        if not (0 <= cell[axis] < occupied.shape[axis]):
            return furthest
        if occupied[tuple(cell)]:
            return first
    return furthest


def errors_of_ranges(grid, num_scans, seed=0, furthest=300.0, sideways=0.0):
    """Ranges in the walls less those marched in the cells (N,) [cells], from random free places.

    With `sideways` [cells] those that are off by more than that are compared with the ranges of
    beams up to that much beside them: a wall that moves by a cell changes the range of a beam that
    grazes it, or passes its edge, by much more.
    """
    rng = np.random.default_rng(seed)
    far = ndimage.distance_transform_edt(~grid.occupied) > 1.5
    places = np.argwhere(grid.free & far)
    walls, _ = world_grid.walls(grid)
    walls = jnp.asarray(np.pad(walls, ((0, -len(walls) % 256), (0, 0))))  # few shapes to compile
    lidar = Lidar(BEAMS, -np.pi, 2 * np.pi / BEAMS, furthest * grid.resolution)
    angles = -np.pi + 2 * np.pi / BEAMS * np.arange(BEAMS)
    found = []
    for cell in places[rng.integers(len(places), size=num_scans)]:
        start, heading = cell + rng.uniform(0.2, 0.8, 2), rng.uniform(-np.pi, np.pi)
        xy = transform(grid.origin, start * grid.resolution)
        pose = jnp.asarray([*xy, heading + grid.origin[2]])
        ranges = np.asarray(RAY_CAST(lidar, World(walls), pose).ranges)
        truth = np.array([marched(grid.occupied, start, heading + a, furthest) for a in angles])
        error = ranges / grid.resolution - truth
        for k in np.flatnonzero(abs(error) > sideways) if sideways else ():
            angle = heading + angles[k]
            normal = sideways * np.array([-np.sin(angle), np.cos(angle)])
            beside = [
                marched(grid.occupied, start + shift * normal, angle, furthest)
                for shift in np.linspace(-1, 1, 9)
            ]
            error[k] = np.clip(ranges[k] / grid.resolution, min(beside), max(beside))
            error[k] = ranges[k] / grid.resolution - error[k]
        found.append(error)
    return np.concatenate(found)


@pytest.mark.parametrize("seed", range(4))
def test_ranges_are_those_of_the_cells_where_walls_follow_these(seed):
    rng = np.random.default_rng(seed)
    blocks = rng.random((12, 12)) < 0.3
    grid = grid_of(np.kron(blocks, np.ones((5, 4), bool)), 0.05, rng.normal(size=3))
    np.testing.assert_allclose(errors_of_ranges(grid, 6, seed), 0.0, atol=1e-3)


def test_ranges_in_a_slanting_building_are_within_a_cell():
    for angle in (0.1, 0.5, np.pi / 4):
        grid = grid_of(building(angle))
        error = abs(errors_of_ranges(grid, 12))
        assert np.mean(error <= 1.0) >= 0.95 and np.median(error) < 0.3
        assert np.mean(abs(errors_of_ranges(grid, 12, sideways=1.0)) <= 1.0) >= 0.997


@pytest.mark.parametrize("angle", [0.02, 0.1, 0.3, 0.5, np.pi / 4, 0.9, 1.2, 1.5])
def test_a_slanting_wall_is_one_segment_on_the_true_line(angle):
    walls, _ = world_grid.walls(grid_of(building(angle)))
    ends = walls.reshape(-1, 2, 2) - SIZE / 2
    turned = ends @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    length = np.hypot(*np.diff(ends, axis=1)[:, 0].T)
    assert len(walls) <= 36  # 8 faces of the walls, 3 of the inner one, 15 or so of the column
    for side, span in ((74, 108), (54, 148), (70, 100), (50, 140)):
        across = turned[:, :, 0 if side in (74, 70) else 1]
        for place in (-side, side):
            on = (abs(across - place) < 0.75).all(axis=1) & (length > 5)
            assert length[on].sum() == pytest.approx(span, rel=0.05)
            assert on.sum() <= 2  # the inner wall ends at one of them


@pytest.mark.parametrize("seed", range(20))
def test_no_corner_of_a_cell_is_further_than_a_cell_from_a_wall(seed):
    shapely = pytest.importorskip("shapely", reason="pip install 'jaxslam[test]'")
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.normal(size=(60, 50)), rng.choice([0.1, 0.6, 1, 2]))
    cells = noise > np.quantile(noise, rng.uniform(0.4, 0.9))
    for ring in world_outline.rings(cells):
        polygon = world_outline.straight_sides(ring)
        line = shapely.LinearRing(polygon)
        distance = shapely.distance(line, shapely.points(ring))
        assert distance.max() <= world_outline.MAX_SHIFT + 1e-9
        assert len(polygon) <= len(ring)


def test_walls_of_one_cell_keep_their_thickness():
    cells = np.zeros((30, 30), bool)
    cells[3, 3] = cells[6, 6:26] = cells[20:25, 2] = True  # a speck, two walls
    walls, notes = world_grid.walls(grid_of(cells))
    assert len(walls) == 12
    assert np.hypot(*(walls[:, 2:] - walls[:, :2]).T).sum() == 4 + 2 * 21 + 2 * 6
    assert "specks of 2 cells or less are kept as obstacles (1)" in notes
    cells = np.eye(30, dtype=bool)  # joined at corners alone: as plans in pixels are drawn
    walls, _ = world_grid.walls(grid_of(cells))
    assert len(walls) <= 8
    lengths = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    assert (lengths > 38).sum() == 2  # both faces, 0.71 of a cell apart
    error = errors_of_ranges(grid_of(cells), 8)
    assert np.mean(abs(error) <= 1.0) >= 0.97


def test_unknown_space_is_no_wall_and_pockets_inside_walls_are_left_out():
    occupied = np.zeros((40, 40), bool)
    occupied[5:20, 5:20] = True
    occupied[8:12, 8:12] = False  # unknown, closed off
    free = ~occupied
    free[8:12, 8:12] = free[30:] = False
    walls, notes = world_grid.walls(OccupancyMap(occupied, free, 0.5, np.zeros(3), ("as told",)))
    assert sorted(map(tuple, walls.reshape(-1, 2).tolist())) == sorted(
        2 * [(2.5, 2.5), (10.0, 2.5), (10.0, 10.0), (2.5, 10.0)]
    )
    assert notes == ("as told", "unknown space is no wall: free space borders it on 20 m")


def test_ranges_in_a_recorded_map(shared_data):
    grid = ros_map.read(shared_data / "maps" / "willow-full.yaml")
    assert np.mean(abs(errors_of_ranges(grid, 20)) <= 1.0) >= 0.95
    assert np.mean(abs(errors_of_ranges(grid, 20, sideways=1.0)) <= 1.0) >= 0.99
