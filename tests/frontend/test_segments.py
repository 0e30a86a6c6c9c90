import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import inverse_transform
from jaxslam.frontend import segmentation, segments
from jaxslam.frontend.edge_codes import edge_code_bits, edge_codes
from jaxslam.frontend.grid import Grid, GridSpec, cell_of, seen_free
from jaxslam.frontend.lidar import beam_ends
from jaxslam.frontend.segments import SegmentSpec
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World

find_segments = jax.jit(segmentation.find_segments, static_argnums=(0, 1))
segment_cells = jax.jit(segments.segment_cells, static_argnums=(0, 1))
cast = jax.jit(ray_casting.cast, static_argnums=0)

SCANNER, SPEC = Lidar(), SegmentSpec()
# The axis of the sensor is between columns 4 and 5.
TINY = GridSpec(cell_size=0.1, x_max=0.5, x_min=0.0, y_half=0.5)
RIGHT, LEFT = (2, 2), (2, 7)  # cells on the clockwise and on the other side of the axis
TURN = {1: (1, 0), 2: (0, -1), 4: (-1, 0), 8: (0, 1)}  # N E S W: x is ahead, y to the left

# Code on the clockwise side of the axis and on the other, of each pattern N=1 E=2 S=4 W=8.
PATTERNS = {
    0b0000: (1, 1),  # alone: noise
    0b1111: (0, 0),  # inside
    0b1011: (2, 2),
    0b1010: (2, 2),
    0b0010: (2, 2),
    0b1000: (2, 2),
    0b0111: (3, 3),
    0b1101: (4, 4),
    0b0101: (3, 4),  # a line along the axis, and its ends
    0b0001: (3, 4),
    0b0100: (3, 4),
    0b0011: (5, 5),
    0b1001: (6, 6),
    0b1110: (2, 2),  # these three face away and count as what they mirror
    0b0110: (5, 5),
    0b1100: (6, 6),
}


def drawn(cell, pattern):
    """Grid with one occupied cell that has the given pattern of neighbours."""
    occupied = np.zeros(TINY.shape, bool)
    occupied[cell] = True
    for bit, (di, dj) in TURN.items():
        occupied[cell[0] + di, cell[1] + dj] = bool(pattern & bit)
    return Grid(occupied=jnp.asarray(occupied), free=jnp.asarray(~occupied))


def seen(walls, pose, scanner=SCANNER):
    """Noise-free scan of walls (S, 4) from a pose, and its segments."""
    scan = cast(scanner, World(jnp.asarray(walls)), jnp.asarray(pose, float))
    return scan, find_segments(scanner, SPEC, scan)


def comb(pieces):
    """Scan in which the range jumps after each of the given numbers of beams."""
    ranges = np.concatenate([np.full(n, 2.0 + 2.0 * (k % 2)) for k, n in enumerate(pieces)])
    scanner = Lidar(num_beams=len(ranges), angle_increment=math.pi / 360, angle_min=-1.8)
    return Scan(ranges=jnp.asarray(ranges), hit=jnp.ones(len(ranges), bool)), scanner


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("side", [0, 1])
def test_code_of_each_pattern(side, pattern):
    cell = (RIGHT, LEFT)[side]
    assert edge_codes(TINY, drawn(cell, pattern))[cell] == PATTERNS[pattern][side]


def test_empty_cells_have_no_code():
    grid = drawn(RIGHT, 15)
    assert not edge_codes(TINY, grid)[~grid.occupied].any()


@pytest.mark.parametrize("seed", range(3))
def test_mirroring_the_scan_swaps_the_codes_of_left_and_right(seed):
    occupied = np.random.default_rng(seed).random(TINY.shape) < 0.5
    here, there = (
        np.asarray(edge_codes(TINY, Grid(jnp.asarray(o), jnp.asarray(~o))))
        for o in (occupied, occupied[:, ::-1])
    )
    swapped = np.array([0, 1, 2, 4, 3, 6, 5], np.uint8)[here]
    np.testing.assert_array_equal(there[:, ::-1], swapped)
    assert set(here.ravel()) == set(range(7))


def test_every_code_but_noise_starts_a_label_of_its_own():
    bits = np.asarray(edge_code_bits(jnp.arange(7, dtype=jnp.uint8)))
    assert bits.dtype == np.uint8
    np.testing.assert_array_equal(bits, [0, 0, 1, 2, 4, 8, 16])


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.7, -0.3, 0.25), (0.6, 0.9, -0.3)])
def test_a_room_gives_exactly_its_visible_walls(pose):
    corners = np.array([[-1.0, -2.0], [3.0, -2.0], [3.0, 2.0], [-1.0, 2.0]])
    _, found = seen(worlds.outline([(-1.0, -2.0, 3.0, 2.0)]), pose)
    at = np.asarray(inverse_transform(jnp.asarray(pose), jnp.asarray(corners)))
    ends, normal, centre = (np.asarray(x)[:3] for x in (found.ends, found.normal, found.centre))
    np.testing.assert_array_equal(found.valid, np.arange(SPEC.max_segments) < 3)
    for k in range(3):  # right, ahead, left
        off = (at[k : k + 2] - centre[k]) @ normal[k]
        np.testing.assert_allclose(off, 0.0, atol=1e-9)
    assert np.all(np.sum(normal * -centre, axis=1) > 0)  # the robot is on the positive side
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(found.meets_next[:4], [True, True, False, False])
    np.testing.assert_allclose(ends[:2, 1], at[1:3], atol=1e-9)
    np.testing.assert_allclose(ends[1:, 0], at[1:3], atol=1e-9)
    assert found.end_is_real[:3].tolist() == [[False, True], [True, True], [True, False]]


@pytest.mark.parametrize("heading", np.linspace(-0.6, 0.6, 7).round(2))
def test_a_straight_wall_is_one_segment_whatever_its_direction(heading):
    scan, found = seen([[2.0, -9.0, 2.0, 9.0]], (0.0, 0.0, heading))
    assert found.valid.sum() == 1
    assert np.unique(np.asarray(found.segment_of_beam)[np.asarray(scan.hit)]).tolist() == [0]
    np.testing.assert_allclose(found.normal[0], [-math.cos(heading), math.sin(heading)], atol=1e-9)


def test_beams_of_a_segment_lie_on_its_line():
    """But for one beam at its end, which is cheaper as an outlier than as a segment."""
    scan, found = seen(worlds.named("office").walls, (8.1, 5.03, 1.9))
    of, valid = np.asarray(found.segment_of_beam), np.asarray(found.valid)
    owned = np.flatnonzero((of < SPEC.max_segments) & valid[np.minimum(of, SPEC.max_segments - 1)])
    k = of[owned]
    off = np.asarray(beam_ends(SCANNER, scan))[owned] - np.asarray(found.centre)[k]
    off = np.abs(np.sum(off * np.asarray(found.normal)[k], axis=1))
    assert valid.sum() > 5 and np.median(off) < 1e-9
    outlier = off > math.sqrt(SPEC.outlier_cost) * SCANNER.range_std / 2
    assert np.bincount(k[outlier]).max(initial=0) <= 1 and outlier.sum() < 0.02 * outlier.size
    ends = (of != np.roll(of, 1)) | (of != np.roll(of, -1))
    assert ends[owned[outlier]].all()


def test_the_line_fit_is_as_uncertain_as_it_says():
    """Mean square errors are within 4 standard errors of the variances that are claimed."""
    count = 1000
    scanner = Lidar(
        num_beams=81, angle_min=-math.pi / 9, angle_increment=math.pi / 360, range_std=0.01
    )
    clean = cast(scanner, World(jnp.array([[2.0, -9.0, 2.0, 9.0]])), jnp.zeros(3))
    offsets = jnp.array([-0.6, 0.0, 0.6])  # [m] along the wall, from its middle

    @jax.jit
    @jax.vmap
    def trial(key):
        found = segmentation.find_segments(
            scanner, SPEC, ray_casting.add_range_noise(key, scanner, clean)
        )
        line = jax.tree.map(
            lambda x: x[0], found._replace(segment_of_beam=found.segment_of_beam[:1])
        )
        at = jnp.stack([jnp.full(3, 2.0), offsets], axis=-1) - line.centre[None]
        along = at @ jnp.stack([line.normal[1], -line.normal[0]])
        return at @ line.normal, line.line_variance(along), found.valid.sum(), line.num_beams

    error, claimed, number, beams = trial(jax.random.split(jax.random.key(0), count))
    alone = np.asarray(number) == 1
    assert alone.mean() > 0.95 and np.all(beams[alone] == scanner.num_beams)
    ratio = np.mean(error[alone] ** 2, axis=0) / np.mean(claimed[alone], axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=4 * math.sqrt(2 / alone.sum()))
    bias = np.abs(np.mean(error[alone], axis=0)) / np.std(error[alone], axis=0)
    assert np.all(bias < 4 / math.sqrt(alone.sum()))


def test_surplus_pieces_share_one_segment():
    pieces = [5 + k % 4 for k in range(SPEC.max_segments + 20)]
    scan, scanner = comb(pieces)
    found = find_segments(scanner, SPEC, scan)
    of = np.asarray(found.segment_of_beam)
    piece = np.repeat(np.arange(len(pieces)), pieces)
    # Every beam that hit has a segment, and all but one segment hold one piece each.
    owner = {k: set(piece[of == k]) for k in range(SPEC.max_segments)}
    shared = max(owner, key=lambda k: len(owner[k]))
    assert of.max() == SPEC.max_segments - 1 and len(owner[shared]) == 21
    assert all(len(owner[k]) == 1 for k in owner if k != shared)
    # The longest pieces have their own.
    own = [pieces[next(iter(owner[k]))] for k in owner if k != shared]
    assert min(own) >= max(pieces[k] for k in owner[shared])
    # No line goes through all that share it.
    np.testing.assert_array_equal(found.valid, np.arange(SPEC.max_segments) != shared)


def test_every_hit_lies_on_a_cell_of_its_segment_even_where_pieces_share_one():
    scan, scanner = comb([5 + k % 4 for k in range(SPEC.max_segments + 20)])
    found = find_segments(scanner, SPEC, scan)
    spec = GridSpec(x_max=5.0, x_min=-5.0, y_half=5.0)
    drawn = np.asarray(segment_cells(scanner, spec, scan, found))
    at, of = np.asarray(cell_of(spec, beam_ends(scanner, scan))), np.asarray(found.segment_of_beam)
    here = drawn[tuple(at.T)]
    assert (here >= of).all()  # where two segments share a cell, the later has it
    assert np.mean(here == of) > 0.9
    assert drawn.dtype == np.int8 and drawn.min() == -1 and drawn.max() == of.max()


def test_beams_without_return_draw_no_segment():
    nothing = Scan(ranges=jnp.full(361, 10.0), hit=jnp.zeros(361, bool))
    found = find_segments(SCANNER, SPEC, nothing)
    assert not found.valid.any() and np.all(found.segment_of_beam == SPEC.max_segments)
    np.testing.assert_array_equal(segment_cells(SCANNER, GridSpec(), nothing, found), -1)


def test_cells_of_a_segment_have_no_gaps():
    scan, found = seen([[0.5, 0.5, 6.0, 0.5]], (0.0, 0.0, 0.0))  # grazing: hits far apart
    drawn = np.asarray(segment_cells(SCANNER, GridSpec(), scan, found))
    rows = np.flatnonzero((drawn >= 0).any(axis=1))
    assert np.all(np.diff(rows) == 1) and rows[-1] - rows[0] > 50
    assert set(drawn.ravel()) == {-1, 0}


def test_edge_codes_want_the_grid_of_their_spec():
    cells = jnp.zeros((4, 5), bool)
    with pytest.raises(ValueError, match=r"grid.occupied is bool \(4, 5\), not bool \(82, 160\)"):
        jax.eval_shape(lambda: edge_codes(GridSpec(), Grid(cells, cells)))


def test_what_is_drawn_is_constant_where_ranges_are_differentiated():
    """Cells are integers: of a batch, too, a gradient passes them by."""
    spec = GridSpec(cell_size=0.5)
    scans = Scan(jnp.full((2, 361), 2.0), jnp.ones((2, 361), bool))
    found = jax.vmap(lambda s: find_segments(SCANNER, SPEC, s))(scans)

    def total(ranges):
        def of_one(r, own, hit):
            scan = Scan(r, hit)
            drawn = segments.segment_cells(SCANNER, spec, scan, own)
            free = seen_free(SCANNER, spec, scan)
            return r.sum() + jnp.where(free | (drawn >= 0), r.dtype.type(1), r.dtype.type(0)).sum()

        return jax.vmap(of_one)(ranges, found, scans.hit).sum()

    np.testing.assert_array_equal(jax.jit(jax.grad(total))(scans.ranges), 1.0)
