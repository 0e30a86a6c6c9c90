import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxslam.core.scan import Lidar, Scan
from jaxslam.frontend import grid as grid_module
from jaxslam.frontend import lidar as lidar_module
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.lidar import beam_angles
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World

SPEC = GridSpec()
SMALL = GridSpec(cell_size=0.1, x_max=3.0, x_min=-0.3, y_half=3.0)
FRONT = Lidar(range_max=6.0)
ROUND = Lidar(num_beams=360, angle_min=-math.pi, angle_increment=math.pi / 180)
ROOM = World(worlds.outline([(-1.03, -2.04, 2.46, 1.57)]))
POSES = [(1.013, 0.917, 0.31), (8.1, 5.03, 1.9), (14.1, 5.3, -2.2)]

rasterise, seen_free = (
    jax.jit(f, static_argnums=(0, 1)) for f in (grid_module.rasterise, grid_module.seen_free)
)
cell_of, centre_of, centres, mark_cells, beam_ends = (
    jax.jit(f, static_argnums=0)
    for f in (
        grid_module.cell_of,
        grid_module.centre_of,
        grid_module.centres,
        grid_module.mark_cells,
        lidar_module.beam_ends,
    )
)
cast = jax.jit(ray_casting.cast, static_argnums=0)


def office_scan(pose, lidar=FRONT):
    return cast(lidar, worlds.named("office"), jnp.array(pose))


def before_hits(scan, lidar, short):
    """Points along every beam, as far as `short` [m] before its end."""
    part = np.linspace(0.05, 1.0, 60)[None, :, None]
    xy = np.asarray(beam_ends(lidar, scan))
    length = np.asarray(scan.ranges)[:, None, None]
    return (xy[:, None] / length * part * np.maximum(length - short, 0.0)).reshape(-1, 2)


def test_cells_and_their_centres_are_inverse():
    index = np.moveaxis(np.indices(SPEC.shape), 0, -1)
    np.testing.assert_array_equal(cell_of(SPEC, centres(SPEC)), index)
    np.testing.assert_array_equal(cell_of(SPEC, centre_of(SPEC, jnp.array([7, 3]))), [7, 3])
    np.testing.assert_allclose(centre_of(SPEC, jnp.array([2, 80])), [0.05, 0.05], atol=1e-12)


@pytest.mark.parametrize(
    "point", [(8.01, 0.0), (-0.21, 0.0), (1.0, 8.01), (1.0, -8.01), (np.inf, 0.0), (0.0, np.nan)]
)
def test_points_outside_have_no_cell(point):
    np.testing.assert_array_equal(cell_of(SPEC, jnp.array(point)), SPEC.shape)
    cells = cell_of(SPEC, jnp.array([point, (1.01, 0.01)]))
    assert np.argwhere(mark_cells(SPEC, cells)).tolist() == [[12, 80]]


@pytest.mark.parametrize("pose", POSES)
def test_cells_are_occupied_or_free_or_unknown(pose):
    grid = rasterise(FRONT, SPEC, office_scan(pose))
    assert not np.any(grid.occupied & grid.free)
    assert np.any(grid.occupied) and np.any(grid.free) and np.any(~grid.occupied & ~grid.free)


@pytest.mark.parametrize("pose", POSES)
def test_every_hit_is_occupied_and_the_second_cell_covers_no_free_one(pose):
    scan = office_scan(pose)
    grid = rasterise(FRONT, SPEC, scan)
    cells = np.asarray(cell_of(SPEC, beam_ends(FRONT, scan)))
    cells = np.where(np.asarray(scan.hit)[:, None], cells, SPEC.shape)
    hits = cells[cells[:, 0] < SPEC.shape[0]]
    assert np.asarray(grid.occupied)[tuple(hits.T)].all()
    front = np.asarray(mark_cells(SPEC, cells))
    behind = np.asarray(grid.occupied) & ~front
    assert behind.any() and not np.any(behind & np.asarray(seen_free(FRONT, SPEC, scan)))


def test_a_wall_is_two_cells_thick():
    scan = cast(FRONT, World(jnp.array([[1.05, -2.0, 1.05, 2.0]])), jnp.zeros(3))
    occupied = np.asarray(rasterise(FRONT, SPEC, scan).occupied)
    rows = np.flatnonzero(occupied.any(axis=1))
    assert rows.tolist() == [12, 13]  # x from 1.0 to 1.2 m
    columns = slice(*cell_of(SPEC, jnp.array([[0.0, -1.0], [0.0, 1.0]]))[:, 1].tolist())
    assert occupied[rows, columns].all()


@pytest.mark.parametrize(
    "angle, cells",
    [
        (0.02, [[13, 30], [14, 30]]),
        (0.25 * math.pi - 0.01, [[10, 37], [11, 38]]),
        (0.5 * math.pi - 0.02, [[3, 40], [3, 41]]),
        (0.02 - 0.5 * math.pi, [[3, 18], [3, 19]]),
    ],
)
def test_the_second_cell_is_behind_the_first_as_the_beam_goes(angle, cells):
    scan = Scan(ranges=jnp.full(3, 1.05), hit=jnp.ones(3, bool))
    grid = rasterise(Lidar(num_beams=3, angle_min=angle, angle_increment=1e-6), SMALL, scan)
    assert np.argwhere(grid.occupied).tolist() == cells


@pytest.mark.parametrize("pose", POSES)
def test_free_cells_agree_with_the_slow_reference(pose):
    scan = office_scan(pose)
    free = reference.seen_free(scan.ranges.tolist(), FRONT.angle_min, FRONT.angle_increment, SPEC)
    rim = np.abs(np.abs(np.arctan2(*np.moveaxis(centres(SPEC), -1, 0)[::-1])) - np.pi / 2) < 0.01
    differ = (free != np.asarray(seen_free(FRONT, SPEC, scan))) & ~rim
    assert not differ.any() and free.any()


@pytest.mark.parametrize("lidar", [FRONT, ROUND])
def test_cells_that_beams_pass_through_are_free(lidar):
    scan = cast(lidar, ROOM, jnp.array([0.0, 0.0, 0.1]))
    xy = before_hits(scan, lidar, short=0.2)
    spec = SMALL._replace(x_min=-3.0)
    seen = np.abs(np.arctan2(xy[:, 1], xy[:, 0])) < np.max(beam_angles(lidar)) - 0.3
    cells = np.unique(np.asarray(cell_of(spec, jnp.asarray(xy)))[seen], axis=0)
    assert np.asarray(rasterise(lidar, spec, scan).free)[tuple(cells.T)].all()
    assert len(cells) > 500


def test_beams_without_return_free_cells_and_occupy_none():
    scan = Scan(ranges=jnp.full(FRONT.num_beams, 2.0), hit=jnp.zeros(FRONT.num_beams, bool))
    grid = rasterise(FRONT, SPEC, scan)
    x, y = np.moveaxis(np.asarray(centres(SPEC)), -1, 0)
    np.testing.assert_array_equal(grid.free, (np.hypot(x, y) < 2.0) & (x > 0.0))
    assert not grid.occupied.any()


def test_turning_the_robot_by_a_right_angle_turns_the_grid():
    spec = GridSpec(x_max=3.0, x_min=-3.0, y_half=3.0)
    lidar = Lidar(num_beams=720, angle_min=-math.pi + 0.001, angle_increment=math.pi / 360)
    ahead, left = (
        rasterise(lidar, spec, cast(lidar, ROOM, jnp.array([0.013, 0.017, turn])))
        for turn in (0.0, math.pi / 2)
    )
    # A turn to the left takes what was on the left ahead.
    differ = np.mean(np.asarray(left.free) != np.rot90(np.asarray(ahead.free), -1))
    assert differ < 0.002
    differ = np.mean(np.asarray(left.occupied) != np.rot90(np.asarray(ahead.occupied), -1))
    assert differ < 0.002


def test_single_precision_gives_the_same_grid():
    double = rasterise(FRONT, SPEC, office_scan(POSES[0]))
    jax.config.update("jax_enable_x64", False)
    try:
        scan = office_scan(POSES[0])
        single = rasterise(FRONT, SPEC, scan)
        assert scan.ranges.dtype == jnp.float32
    finally:
        jax.config.update("jax_enable_x64", True)
    for a, b in zip(single, double, strict=True):
        assert np.mean(np.asarray(a) != np.asarray(b)) < 1e-3  # hits on the border of two cells


def test_grids_are_batched():
    scans = jax.tree.map(lambda *x: jnp.stack(x), *map(office_scan, POSES))
    together = jax.jit(jax.vmap(lambda scan: rasterise(FRONT, SPEC, scan)))(scans)
    for k, pose in enumerate(POSES):
        alone = rasterise(FRONT, SPEC, office_scan(pose))
        np.testing.assert_array_equal(together.free[k], alone.free)
        np.testing.assert_array_equal(together.occupied[k], alone.occupied)


@pytest.mark.parametrize(
    "call, message",
    [
        (
            lambda s: grid_module.seen_free(FRONT, SPEC, s),
            "scan.ranges is float64 (2, 361), not floating (361,)",
        ),
        (
            lambda s: grid_module.rasterise(FRONT, SPEC, s._replace(ranges=s.ranges[0])),
            "scan.hit is bool (2, 361), not bool (361,)",
        ),
        (
            lambda s: grid_module.rasterise(FRONT, SPEC, Scan(s.ranges[0], s.ranges[0])),
            "scan.hit is float64 (361,), not bool (361,)",
        ),
    ],
)
def test_wrong_shapes_and_types_are_named_while_tracing(call, message):
    scans = Scan(jnp.zeros((2, 361)), jnp.zeros((2, 361), bool))
    with pytest.raises(ValueError, match=re.escape(message)):
        jax.eval_shape(call, scans)


@pytest.mark.parametrize("count", [1, 7, 32, 33])
def test_free_cells_of_a_batch_are_those_of_each_scan(count):
    """Up to 32 scans are compared at once, as bits of one number."""
    random = np.random.default_rng(count)
    ranges = jnp.asarray(random.uniform(0.1, 8.0, (count, FRONT.num_beams)))
    scans = Scan(ranges, jnp.ones(ranges.shape, bool))
    batch = jax.jit(jax.vmap(lambda s: grid_module.seen_free(FRONT, SMALL, s)))(scans)
    for k in range(count):
        free = seen_free(FRONT, SMALL, Scan(ranges[k], scans.hit[k]))
        np.testing.assert_array_equal(batch[k], free)
    assert batch.any() and not batch.all()
