"""Levels of grids: one is the front end without them, two reach as far as the scan."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import se2_np
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import inverse_transform, transform
from jaxslam.core.types import FAR_JUNCTION, JUNCTION
from jaxslam.filtering.config import FilterConfig
from jaxslam.frontend import circle_search, extract, pyramid, segmentation
from jaxslam.frontend import junctions as junction_search
from jaxslam.frontend.circle_fitting import FittedCircles
from jaxslam.frontend.config import COARSE_LEVEL, PYRAMID, FrontendConfig
from jaxslam.frontend.grid import GridSpec, cell_of
from jaxslam.frontend.pyramid import Level, largest_radius, make_level
from jaxslam.frontend.tangent_circles import wall_segments
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World

LIDAR = Lidar(range_max=40.0)
TWO = FrontendConfig(lidar=LIDAR, levels=PYRAMID)
ONE = TWO._replace(levels=())
COUNT = TWO.features.max_junctions

# A hall of 20 m x 35 m: a junction 10 m from either end, as far from three walls.
HALL = worlds.outline([(0.0, 0.0, 35.0, 20.0)])
IN_HALL = (14.0, 8.0, 0.2)
# A corridor 4 m wide with an opening on its left: a junction before it, and one 2 m before the end.
CORRIDOR = worlds.outline([(-2.0, -2.0, 14.0, 2.0), (2.0, 2.0, 5.0, 6.0)])
IN_CORRIDOR = (0.5, -1.0, 0.05)
# A hall 16 m wide with a bay 3 m wide on its left.
BAY = worlds.outline([(0.0, -8.0, 30.0, 8.0), (8.0, 8.0, 11.0, 13.0)])
IN_BAY = (9.0, 4.0, 0.6)
WORLDS = [(HALL, IN_HALL), (CORRIDOR, IN_CORRIDOR), (BAY, IN_BAY)]
MOST_WALLS = max(len(walls) for walls, _ in WORLDS)

local_graph = jax.jit(extract.extract_local_graph, static_argnums=0)
levels_of = jax.jit(extract.extract_levels, static_argnums=0)


find_segments = jax.jit(segmentation.find_segments, static_argnums=(0, 1))
grow = jax.jit(extract.grow, static_argnums=(0, 1))


@partial(jax.jit, static_argnums=0)
def cast(lidar, walls, pose):
    return ray_casting.cast(lidar, World(walls), pose)


def scan_of(walls, pose, lidar=LIDAR):
    """For one number of walls, the last of which may be there many times."""
    walls = np.concatenate([walls, np.repeat(walls[-1:], MOST_WALLS - len(walls), axis=0)])
    return cast(lidar, jnp.asarray(walls), jnp.asarray(pose))


def junctions(config, walls, pose):
    """Position in the map frame and clearance (N, 3) of the valid junctions."""
    found, _ = local_graph(config, scan_of(walls, pose, config.lidar))
    own = np.asarray(found.valid) & np.isin(found.kind, (JUNCTION, FAR_JUNCTION))
    xy = np.asarray(transform(jnp.asarray(pose), found.xy))
    return np.column_stack([xy, found.descriptor])[own]


def test_a_hall_has_its_junctions_with_two_levels_only():
    assert len(junctions(ONE, HALL, IN_HALL)) == 0
    np.testing.assert_allclose(junctions(TWO, HALL, IN_HALL), [[25.0, 10.0, 10.0]], atol=1e-3)


def test_its_covariance_is_that_of_its_error():
    exact = scan_of(HALL, IN_HALL)
    noise = LIDAR.range_std * jax.random.normal(jax.random.key(0), (64, LIDAR.num_beams))
    each = [local_graph(TWO, exact._replace(ranges=exact.ranges + n))[0] for n in noise]
    found = jax.tree.map(lambda *x: np.stack(x), *each)
    assert np.all(found.valid[:, 0] & found.trusted[:, 0])
    error = se2_np.transform(np.array(IN_HALL), found.xy[:, 0]) - [25.0, 10.0]
    assert np.abs(error).max() < 0.03
    # What is assumed for rough walls, 2 mm for each foot, is not in these scans.
    predicted = np.sqrt(np.trace(found.cov[:, 0], axis1=1, axis2=2)).mean()
    assert 0.3 * predicted < np.sqrt(np.sum(error**2, axis=1).mean()) < 1.5 * predicted


@pytest.mark.parametrize("walls, pose", WORLDS)
def test_a_world_and_a_grid_four_times_as_large_have_the_same_diagram(walls, pose):
    small = np.asarray(walls) / 4
    near = np.array([pose[0] / 4, pose[1] / 4, pose[2]])
    large_scan = scan_of(walls, pose)
    small_scan = scan_of(small, near, LIDAR._replace(range_max=10.0))
    np.testing.assert_allclose(4 * small_scan.ranges, large_scan.ranges)
    # The same beams are of the same walls, on either scale.
    segments = find_segments(TWO.lidar, TWO.segments, large_scan)
    fine = make_level(GridSpec(x_max=6.4, y_half=6.4, x_min=-0.1), GridSpec(), 3.2, 32)
    coarse = make_level(GridSpec(0.4, 25.6, -0.4, 25.6), GridSpec(), 3.2, 32)
    grown = [
        grow(config, level._replace(scale=1.0), scan, segments)
        for config, level, scan in (
            (TWO._replace(lidar=LIDAR._replace(range_max=10.0)), fine, small_scan),
            (TWO, coarse, large_scan),
        )
    ]
    assert len(np.unique(grown[0][0].diagram.labels)) > 3
    jax.tree.map(np.testing.assert_array_equal, *grown)


@pytest.mark.parametrize("walls, pose", WORLDS)
def test_what_the_finest_level_finds_stays(walls, pose):
    scan = scan_of(walls, pose)
    (one, arcs_one), (two, arcs_two) = local_graph(ONE, scan), local_graph(TWO, scan)
    kept = np.asarray(one.valid)
    for a, b in zip(*map(jax.tree.leaves, (one, two)), strict=True):
        np.testing.assert_allclose(np.asarray(a)[kept], np.asarray(b)[kept], rtol=1e-12)
    assert np.asarray(two.valid).sum() > kept.sum()
    ends = [p for p, ok in zip(arcs_one.pair.tolist(), arcs_one.valid, strict=True) if ok]
    more = [p for p, ok in zip(arcs_two.pair.tolist(), arcs_two.valid, strict=True) if ok]
    assert {tuple(p) for p in ends if p[1] >= 0} <= {tuple(p) for p in more}


def test_each_junction_is_found_once_on_its_level():
    np.testing.assert_allclose(
        junctions(TWO, BAY, IN_BAY), [[9.5, 11.5, 1.5], [22.0, 0.0, 8.0]], atol=1e-2
    )
    np.testing.assert_allclose(junctions(ONE, BAY, IN_BAY), [[9.5, 11.5, 1.5]], atol=1e-2)
    want = [[3.5, 0.28, 2.28], [12.0, 0.0, 2.0]]
    np.testing.assert_allclose(junctions(TWO, CORRIDOR, IN_CORRIDOR), want, atol=0.05)


def test_an_arc_goes_on_beyond_the_fine_grid():
    scan = scan_of(CORRIDOR, IN_CORRIDOR)
    (found, arcs), (_, fine_arcs) = local_graph(TWO, scan), local_graph(ONE, scan)
    joined = np.asarray(arcs.valid) & (np.asarray(arcs.pair) == [0, 1]).all(axis=1)
    assert joined.sum() == 1
    line = np.asarray(transform(jnp.asarray(IN_CORRIDOR), arcs.polyline[joined][0]))
    ends = np.asarray(transform(jnp.asarray(IN_CORRIDOR), found.xy[:2]))
    np.testing.assert_allclose(line[[0, -1]], ends, atol=1e-9)
    assert np.all(np.diff(line[:, 0]) > 0) and np.abs(line[:, 1]).max() < 0.5
    np.testing.assert_allclose(arcs.length[joined], 8.5, atol=0.5)
    # The far junction is no landmark: for a map of landmarks the branch is still a frontier.
    assert found.kind[:3].tolist() == [JUNCTION, FAR_JUNCTION, JUNCTION]
    assert len(frontiers_ahead(fine_arcs)) == len(frontiers_ahead(arcs)) == 1


def frontiers_ahead(arcs):
    """Frontiers from 7 m ahead on."""
    own = np.asarray(arcs.valid) & (np.asarray(arcs.pair)[:, 1] < 0)
    return np.flatnonzero(own & (np.asarray(arcs.polyline)[:, -1, 0] > 7.0))


def test_a_frontier_is_where_the_view_ends_not_the_grid():
    walls = worlds.outline([(-2.0, -2.0, 60.0, 2.0), (2.0, 2.0, 5.0, 6.0)])
    scan = scan_of(walls, IN_CORRIDOR)
    (_, one), (_, two) = local_graph(ONE, scan), local_graph(TWO, scan)
    (k,), (n,) = frontiers_ahead(one), frontiers_ahead(two)
    assert one.polyline[k, -1, 0] < 8.0 and two.polyline[n, -1, 0] > 20.0
    assert one.pair[k].tolist() == two.pair[n].tolist() == [0, -1]


def test_the_filter_leaves_far_junctions_out():
    found, _ = local_graph(TWO, scan_of(HALL, IN_HALL))
    assert found.kind[0] == FAR_JUNCTION and found.valid[0]
    assert FAR_JUNCTION not in FilterConfig().landmark_kinds


@pytest.mark.parametrize("kept", [False, True])
def test_a_circle_that_the_finer_level_holds_is_not_of_the_coarser(kept):
    levels = TWO.pyramid()
    circle = FittedCircles(
        centre=jnp.array([[4.0, 1.0], [4.0, 1.0], [7.0, 0.0]]),
        radius=jnp.array([2.0, 4.0, 2.0]),
        cov=None,
        penetration=None,
        touched=None,
        feet_real=None,
        hidden_depth=None,
    )
    of_level = np.zeros(3, int) if kept else np.ones(3, int)
    want = [True, True, True] if kept else [False, True, True]
    assert junction_search._not_of_finer(circle, levels, of_level).tolist() == want


def test_cells_of_one_far_junction_start_one_circle():
    coarse = TWO.pyramid()[1]
    scan = scan_of(HALL, IN_HALL)
    walls = jax.jit(wall_segments)(find_segments(LIDAR, TWO.segments, scan))
    here = inverse_transform(jnp.asarray(IN_HALL), jnp.array([25.0, 10.0]))
    row, column = np.asarray(cell_of(coarse.grid, here[None]))[0]
    cells = np.zeros(coarse.grid.shape, bool)
    cells[row - 1 : row + 3, column - 1 : column + 3] = True
    assert len(np.unique(np.argwhere(cells) // circle_search.BLOCK, axis=0)) >= 4
    count = TWO.features.max_coarse_candidates
    starts = jax.jit(circle_search._starts, static_argnums=(2, 3, 4, 5))
    x, y, _, found = starts(
        jnp.asarray(cells), walls, coarse, count, TWO.features, scan.ranges.dtype
    )
    assert found.shape == (count,) and found.tolist() == [True] + [False] * (count - 1)
    assert np.hypot(x[0] - here[0], y[0] - here[1]) < 1.2


def test_edge_codes_have_one_level():
    codes = FrontendConfig(labels="codes", levels=PYRAMID)
    assert codes.pyramid() == codes._replace(levels=()).pyramid()
    assert len(FrontendConfig().pyramid()) == 1 and len(TWO.pyramid()) == 2


def test_a_level_is_cut_to_the_range_of_the_scanner():
    for range_max, extent in ((10.0, 10.0), (9.9, 10.0), (40.0, 25.6)):
        grid = TWO._replace(lidar=Lidar(range_max=range_max)).pyramid()[1].grid
        np.testing.assert_allclose([grid.x_max, grid.y_half, grid.x_min], [extent, extent, -0.4])
    # No more cells than blocks to search in: few cells are padded.
    few = TWO._replace(lidar=Lidar(range_max=1.0))
    assert few.pyramid()[1].grid.shape == (4, 6)
    jax.eval_shape(lambda: extract.extract_features(few, Scan(np.ones(361), np.ones(361, bool))))


def test_an_edge_counts_only_where_the_next_level_reaches_farther():
    level = Level(GridSpec(), 3.2, 1.0)
    x, y = jnp.array([1.0, 7.0, 9.0, 1.0]), jnp.array([0.0, 0.0, 0.0, -6.0])
    radius = largest_radius(x, y, level, Level(COARSE_LEVEL, 12.8, 4.0))
    np.testing.assert_allclose(radius, [3.2, 1.0, -1.0, 2.0])
    around = Level(COARSE_LEVEL._replace(x_min=-25.6), 12.8, 4.0)
    np.testing.assert_allclose(largest_radius(x, y, level, around), [1.2, 1.0, -1.0, 1.2])
    same = Level(level.grid._replace(cell_size=0.2), 6.4, 2.0)
    np.testing.assert_allclose(largest_radius(x, y, level, same), 3.2)


def test_cells_near_the_edge_of_the_finer_grid_are_not_left_out():
    fine, coarse = TWO.pyramid()
    arrival = jnp.full(coarse.grid.shape, 3, jnp.uint8)  # a clearance of 1.2 m everywhere
    beyond = np.asarray(pyramid.beyond_finer(arrival, coarse, fine))
    x = np.arange(coarse.grid.shape[0]) * 0.4 - 0.2
    ahead = beyond[:, coarse.grid.shape[1] // 2]
    assert ahead[x > 8.0 - 1.2].all() and not ahead[x < 5.5].any()
    wide = pyramid.beyond_finer(jnp.full(coarse.grid.shape, 9, jnp.uint8), coarse, fine)
    assert np.asarray(wide).all()


@pytest.mark.parametrize(
    "levels, message",
    [
        ((GridSpec(),), "config.levels has cells of 0.1 m after cells of 0.1 m"),
        ((COARSE_LEVEL, COARSE_LEVEL), "config.levels has cells of 0.4 m after cells of 0.4 m"),
        ((COARSE_LEVEL._replace(y_half=0.0),), "which has (65, 0) cells"),
    ],
)
def test_impossible_levels_are_refused(levels, message):
    scan = Scan(np.ones(361), np.ones(361, bool))
    with pytest.raises(ValueError, match=re.escape(message)):
        jax.eval_shape(lambda: extract.extract_features(TWO._replace(levels=levels), scan))
