import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import CENTRE, IN_TRIANGLE, TRIANGLE

from jaxslam.core.se2 import inverse_transform
from jaxslam.core.types import JUNCTION
from jaxslam.frontend import automaton, circle_search, junctions, segmentation
from jaxslam.frontend.grid import cell_of, centre_of
from jaxslam.frontend.lidar import beam_angles, beam_ends
from jaxslam.frontend.segments import LABEL_BITS, segment_bits
from jaxslam.frontend.tangent_circles import wall_segments
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World

CONFIG = Config().frontend
LIDAR, GRID, SPEC = CONFIG.lidar, CONFIG.grid, CONFIG.features
LEVELS = CONFIG.pyramid()
SCAN = jax.jit(ray_casting.cast, static_argnums=0)(
    LIDAR, World(jnp.asarray(TRIANGLE)), jnp.array(IN_TRIANGLE)
)
SEGMENTS = jax.jit(segmentation.find_segments, static_argnums=(0, 1))(LIDAR, CONFIG.segments, SCAN)
WALLS = jax.jit(wall_segments)(SEGMENTS)
HERE = inverse_transform(jnp.array(IN_TRIANGLE), jnp.array(CENTRE))  # the junction, robot frame
CELL = np.asarray(cell_of(GRID, HERE[None]))[0]

find_starts = jax.jit(circle_search._starts, static_argnums=(2, 3, 4, 5))
find = jax.jit(junctions.find_junctions, static_argnums=(0, 1, 2))


def marked(*cells):
    """Junction cells of the grid."""
    result = np.zeros(GRID.shape, bool)
    for cell in cells:
        result[tuple(cell)] = True
    return jnp.asarray(result)


def starts(cells):
    """Starts of circles from junction cells: their centres (N, 2)."""
    x, y, _, found = find_starts(
        cells, WALLS, LEVELS[0], SPEC.num_candidates, SPEC, SCAN.ranges.dtype
    )
    return np.stack([x, y], axis=1)[np.asarray(found)]


def test_cells_of_one_junction_start_one_circle():
    around = [CELL + np.array([i, j]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    found = starts(marked(*around))
    assert len(found) == 1 and np.hypot(*(found[0] - HERE)) < 0.3


def test_cells_too_near_to_walls_do_not_displace_a_junction():
    hits = np.asarray(beam_ends(LIDAR, SCAN))
    xy = np.asarray(centre_of(GRID, jnp.asarray(np.indices(GRID.shape).reshape(2, -1).T)))
    clearance = np.hypot(*(xy[:, None] - hits[None]).transpose(2, 0, 1)).min(axis=1)
    tight = (clearance < SPEC.min_clearance - 0.15) & (clearance > 0.05)
    tight &= np.hypot(*xy.T) < np.hypot(*HERE)
    cells = jnp.asarray(tight.reshape(GRID.shape)) | marked(CELL)
    blocks = np.unique(np.argwhere(cells) // circle_search.BLOCK, axis=0)
    assert SPEC.num_candidates < len(blocks) < 3 * SPEC.num_candidates
    found = starts(cells)
    assert len(found) == 1 and np.hypot(*(found[0] - HERE)) < 0.3


@pytest.mark.parametrize(
    ("step", "valid", "trusted"), [(0.03, True, True), (0.065, True, False), (0.11, False, False)]
)
def test_a_step_of_a_wall_costs_a_junction_its_trust_and_a_large_one_the_junction(
    step, valid, trusted
):
    clean = find(LIDAR, LEVELS, SPEC, [marked(CELL)], SCAN, SEGMENTS)
    assert clean.trusted[0] and np.hypot(*(clean.xy[0] - HERE)) < 0.01
    # The beam next to a foot ends `step` inside the circle.
    centre, hits = np.asarray(clean.xy[0]), np.asarray(beam_ends(LIDAR, SCAN))
    beam = int(np.argmin(np.hypot(*(hits - centre).T)))
    angle = float(beam_angles(LIDAR)[beam])
    reach = np.arange(0.0, 1.0, 1e-4)
    ends = (float(SCAN.ranges[beam]) - reach)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    depth = float(clean.descriptor[0]) - np.hypot(*(ends - centre).T)
    shorter = reach[np.argmax(depth > step)]
    stepped = SCAN._replace(ranges=SCAN.ranges.at[beam].add(-shorter))
    found = find(LIDAR, LEVELS, SPEC, [marked(CELL)], stepped, SEGMENTS)
    assert found.valid[0] == valid and found.trusted[0] == trusted
    if valid:
        assert found.kind[0] == JUNCTION
        np.testing.assert_allclose(found.xy[0], clean.xy[0])


def test_segments_past_the_last_bit_keep_their_number_and_share_a_bit():
    segment = jnp.array([[3, -1, -1, -1, LABEL_BITS + 5, -1, -1, -1, 6]], jnp.int8)
    labels = segment_bits(segment)
    np.testing.assert_array_equal(labels, [[8, 0, 0, 0, 32, 0, 0, 0, 64]])
    start = jnp.where(segment >= 0, segment, automaton.EMPTY).astype(jnp.int8)
    diagram = automaton.decode(labels, automaton.expand_encoded(start, steps=4))
    np.testing.assert_array_equal(diagram.labels, [[8, 8, 40, 32, 32, 32, 96, 64, 64]])
    np.testing.assert_array_equal(diagram.arrival, [[0, 1, 2, 1, 0, 1, 2, 1, 0]])
