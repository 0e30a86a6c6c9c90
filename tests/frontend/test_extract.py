"""The front end as a whole: what it takes, and what it refuses."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.frontend.automaton import expand
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.edge_codes import edge_codes
from jaxslam.frontend.extract import extract_features, extract_local_graph
from jaxslam.frontend.features import FeatureSpec, features_from_range_bearing
from jaxslam.frontend.grid import Grid, GridSpec, rasterise
from jaxslam.frontend.lidar import begin_behind, to_scan
from jaxslam.frontend.segmentation import find_segments
from jaxslam.frontend.segments import SegmentSpec

LIDAR = Lidar(num_beams=61, angle_min=-np.pi / 3, angle_increment=np.pi / 90)
SMALL = FrontendConfig(
    lidar=LIDAR,
    grid=GridSpec(x_max=3.0, x_min=0.0, y_half=2.0),
    segments=SegmentSpec(max_segments=6, num_candidates=8),
    features=FeatureSpec(max_junctions=2, max_corners=2, max_walls=2),
    automaton_steps=16,
)
# A corridor that ends 2 m ahead, 1 m wide to either side; rounded to single precision.
ANGLE = LIDAR.angle_min + LIDAR.angle_increment * np.arange(61)
RANGES = np.float32(np.minimum(2.0 / np.cos(ANGLE), 1.0 / np.maximum(np.abs(np.sin(ANGLE)), 1e-9)))
HIT = np.ones(61, bool)

KINDS = {
    "list": lambda x: x.tolist(),
    "single": lambda x: x,
    "double": lambda x: x if x.dtype == bool else x.astype(np.float64),
    "jax": lambda x: jnp.asarray(x) if x.dtype == bool else jnp.asarray(x, float),
}


def assert_all_equal(results):
    first, *others = results
    for other in others:
        jax.tree.map(np.testing.assert_array_equal, other, first)


@pytest.mark.slow
def test_results_for_lists_and_arrays_are_the_same():
    """Scans are constants of the program: an argument of it would be a JAX array already."""

    def results(scan):
        return (
            find_segments(LIDAR, SMALL.segments, scan),
            rasterise(LIDAR, SMALL.grid, scan),
            extract_local_graph(SMALL, scan),
        )

    scans = [Scan(kind(RANGES), kind(HIT)) for kind in (KINDS["list"], KINDS["jax"])]
    found = jax.jit(lambda: [results(scan) for scan in scans])()
    assert_all_equal(found)
    features, _ = found[0][-1]
    assert features.valid.any() and features.xy.dtype == jnp.float64


def test_labels_and_cells_may_be_lists_or_arrays():
    labels = np.array([[1, 0, 0, 0, 2], [0, 0, 0, 0, 0]], np.uint8)
    free = np.ones(labels.shape, bool)
    kinds = (
        labels,
        labels.astype(np.uint32),
        labels.astype(int),
        labels.tolist(),
        jnp.asarray(labels),
    )
    assert_all_equal([expand(kind, free, steps=3) for kind in kinds])
    assert_all_equal([expand(labels, kind, steps=3) for kind in (free, free.tolist())])
    assert expand(labels.astype(int), free, steps=3).labels.dtype == jnp.uint32
    occupied = np.zeros(GridSpec().shape, bool)
    occupied[3:5, 4:9] = True
    kinds = (occupied, occupied.tolist(), jnp.asarray(occupied))
    assert_all_equal([edge_codes(GridSpec(), Grid(kind, None)) for kind in kinds])


def test_measured_landmarks_may_be_lists_or_arrays():
    polar, valid = np.float32([[1.0, 0.5], [2.0, -0.25]]), np.array([True, False])
    kinds = [(kind(polar), kind(valid)) for kind in KINDS.values()]
    assert_all_equal([features_from_range_bearing(*kind, 0.5) for kind in kinds])
    assert_all_equal(
        [
            features_from_range_bearing(x, valid)
            for x in ([[1, 0], [2, 0]], [[1.0, 0.0], [2.0, 0.0]])
        ]
    )


GOOD = to_scan(LIDAR, RANGES)


@pytest.mark.parametrize(
    "config, scan, message",
    [
        (SMALL._replace(labels="code"), GOOD, "config.labels is 'code', not 'segments' or 'codes'"),
        (SMALL._replace(labels=None), GOOD, "config.labels is None, not 'segments' or 'codes'"),
        (SMALL._replace(automaton_steps=-1), GOOD, "config.automaton_steps is -1, not 0 or more"),
        (SMALL._replace(lidar=LIDAR._replace(num_beams=1)), GOOD, "lidar.num_beams is 1, not an"),
        (
            SMALL._replace(lidar=LIDAR._replace(range_max=-1.0)),
            GOOD,
            "lidar.range_max is -1.0, not",
        ),
        (SMALL._replace(grid=GridSpec(cell_size=0.0)), GOOD, "grid.cell_size is 0.0, not above 0"),
        (SMALL._replace(grid=GridSpec(x_max=-1.0)), GOOD, "which has (-8, 160) cells"),
        (SMALL._replace(grid=GridSpec(x_max=np.nan)), GOOD, "not of finite numbers"),
        (SMALL._replace(grid=None), GOOD, "grid is a NoneType, not a GridSpec"),
        (
            SMALL._replace(segments=SegmentSpec(max_segments=65)),
            GOOD,
            "segments.max_segments is 65, not 1..64",
        ),
        (SMALL._replace(segments=31), GOOD, "segments is a int, not a SegmentSpec"),
        (
            SMALL._replace(features=FeatureSpec(max_walls=-1)),
            GOOD,
            "features.max_walls is -1, not 0",
        ),
        (
            SMALL._replace(features=FeatureSpec(max_corners=7)),
            GOOD,
            "features.max_corners is 7, more than segments.max_segments, 6",
        ),
        (
            SMALL._replace(features=FeatureSpec(max_junctions=0)),
            GOOD,
            "features.max_junctions is 0, not 1 or more",
        ),
        (
            SMALL._replace(features=FeatureSpec(max_junctions=60, max_corners=2)),
            GOOD,
            "features.max_junctions is 60, too many for a grid of (30, 40) cells",
        ),
        (LIDAR, GOOD, "config is a Lidar, not a FrontendConfig"),
        (SMALL, GOOD.ranges, "not a Scan"),
        (SMALL, Scan(RANGES[1:], HIT), "scan.ranges is float64 (60,), not floating (61,)"),
        (SMALL, Scan(RANGES, HIT[1:]), "scan.hit is bool (60,), not bool (61,)"),
        (SMALL, Scan(RANGES, RANGES), "scan.hit is float32 (61,), not bool (61,)"),
        (SMALL, Scan(HIT, HIT), "scan.ranges is bool (61,), not numbers"),
    ],
)
def test_bad_configurations_and_scans_are_named(config, scan, message):
    for extract in (extract_features, extract_local_graph):
        with pytest.raises(ValueError, match=re.escape(message)):
            jax.eval_shape(lambda extract=extract: extract(config, scan))


LABELS, FREE = np.zeros((4, 5), np.uint8), np.ones((4, 5), bool)


@pytest.mark.parametrize(
    "call, message",
    [
        (
            lambda: expand(LABELS.astype(int) - 1, FREE, steps=1),
            "labels is from -1 to -1, not from",
        ),
        (lambda: expand(LABELS + 0.5, FREE, steps=1), "labels is float64 (4, 5), not unsignedinte"),
        (lambda: expand([[1], [1, 2]], FREE, steps=1), "labels is not an array: its parts differ"),
        (
            lambda: expand(LABELS, FREE.astype(int), steps=1),
            "free is int64 (4, 5), not bool (4, 5)",
        ),
        (
            lambda: edge_codes(GridSpec(), Grid(FREE, FREE)),
            "grid.occupied is bool (4, 5), not bool (82, 160)",
        ),
        (
            lambda: find_segments(LIDAR, SegmentSpec(max_segments=0), GOOD),
            "segments.max_segments is 0, not 1..64",
        ),
        (
            lambda: find_segments(LIDAR, SegmentSpec(num_candidates=0), GOOD),
            "segments.num_candidates is 0, not 1 or more",
        ),
        (lambda: find_segments(LIDAR, SegmentSpec(), RANGES), "scan is a ndarray, not a Scan"),
        (
            lambda: features_from_range_bearing(np.zeros((3, 3)), np.ones(3, bool)),
            "range_bearing is float64 (3, 3), not floating (M, 2)",
        ),
        (
            lambda: features_from_range_bearing(np.zeros((3, 2)), np.ones(2, bool)),
            "valid is bool (2,), not bool (3,)",
        ),
        (
            lambda: features_from_range_bearing(np.zeros((3, 2)), np.ones(3)),
            "valid is float64 (3,), not bool (3,)",
        ),
        (
            lambda: features_from_range_bearing(np.zeros((3, 2)), np.ones(3, bool), -0.1),
            "range_std_fraction is -0.1, which is below 0",
        ),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


def test_more_junctions_than_bits_are_refused():
    many = SMALL._replace(features=FeatureSpec(max_junctions=32, max_corners=2))
    with pytest.raises(
        ValueError, match=re.escape("features.max_junctions is 32, more than the 31")
    ):
        jax.eval_shape(lambda: extract_local_graph(many, GOOD))


@pytest.mark.parametrize("labels", ["segments", pytest.param("codes", marks=pytest.mark.slow)])
def test_what_is_found_does_not_depend_on_which_beam_of_a_full_turn_is_the_first(labels):
    """A room with a doorway and a pillar, seen by scanners whose first beams look elsewhere."""
    count = 180
    step = 2 * np.pi / count
    around = Lidar(num_beams=count, angle_min=-np.pi, angle_increment=step)
    angles = np.asarray(around.angle_min + step * np.arange(count))
    walls = np.array(
        [[-2.0, -1.5, 2.5, -1.5], [2.5, -1.5, 2.5, 1.2], [2.5, 1.2, 0.5, 1.2], [-0.4, 1.2, -2, 1.2]]
        + [[-2.0, 1.2, -2.0, -1.5], [-1.2, 0.2, -0.9, 0.2], [-0.9, 0.2, -0.9, 0.5]]
    )
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ranges = np.full(count, 9.0)
    for x1, y1, x2, y2 in walls:
        edge = np.array([x2 - x1, y2 - y1])
        across = direction[:, 0] * edge[1] - direction[:, 1] * edge[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (x1 * edge[1] - y1 * edge[0]) / across
            at = (x1 * direction[:, 1] - y1 * direction[:, 0]) / across
        ranges = np.where((along > 0) & (at >= 0) & (at <= 1), np.minimum(ranges, along), ranges)
    found = []
    for first in (0, 137):
        lidar = around._replace(angle_min=-np.pi + first * step)
        config = FrontendConfig(lidar=lidar, labels=labels)
        scan = to_scan(lidar, jnp.asarray(np.roll(ranges, -first)))
        found.append(jax.jit(extract_local_graph, static_argnums=0)(config, scan))
    assert np.asarray(found[0][0].valid).sum() > 6
    for other in found[1:]:
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), found[0], other)


def test_where_a_scanner_does_not_see_all_around_its_scans_stay_as_they_are():
    lidar = Lidar(num_beams=61, angle_min=-np.pi / 3, angle_increment=np.pi / 90)
    scan = to_scan(lidar, jnp.arange(1.0, 62.0) / 10)
    assert begin_behind(lidar, scan) == (lidar, scan)
