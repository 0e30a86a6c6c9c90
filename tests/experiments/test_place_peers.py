import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import place_curves, place_peers
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, relative
from jaxslam.core.types import CORNER, WALL
from jaxslam.matching.place_index import PlaceSpec, build_index
from jaxslam.matching.place_recognition import make_query
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World

SPEC = PlaceSpec(max_points=30)
LIDAR = Lidar(120, -np.pi, np.pi / 60, 12.0, 0.0)
SQUARE = World(jnp.array([[-2.0, -2, 2, -2], [2, -2, 2, 2], [2, 2, -2, 2], [-2, 2, -2, -2]]))


def test_search_is_that_of_the_slow_version():
    """In a square the best other place is at about the same position, turned."""
    poses = np.array([[0.07, 0.1, 0.2], [0.5, -0.6, 1.0], [-0.4, 0.3, -2.0]])
    scans = [ray_casting.cast(LIDAR, SQUARE, jnp.asarray(pose)) for pose in poses]
    scans = jax.tree.map(lambda *x: jnp.stack(x), *scans)
    index = build_index(SPEC, LIDAR, poses, scans)
    query = make_query(SPEC, LIDAR, jax.tree.map(lambda x: x[:1], scans), jnp.zeros((1, 3)))
    found = place_peers.search_everywhere(SPEC, index, query)

    quarter = SPEC.position_spacing / 4
    offsets = np.array([(a, b) for a in (-quarter, quarter) for b in (-quarter, quarter)])
    positions = np.asarray(index.positions)[np.asarray(index.valid)][:, None] + offsets
    turns = 2 * np.pi / place_peers.NUM_HEADINGS * np.arange(place_peers.NUM_HEADINGS)
    tried = np.array([[*xy, turn] for xy in positions.reshape(-1, 2) for turn in turns])
    points = np.asarray(query.points)[np.asarray(query.valid)][:: place_peers.POINT_STEP]
    scores = 0.0
    for point in points:
        ends = compose(tried, np.array([*point, 0.0]))[:, :2] - np.asarray(index.origin)
        cells = np.round(ends / SPEC.cell).astype(int).clip(0, np.array(index.distance.shape) - 1)
        distance = np.asarray(index.distance)[tuple(cells.T)]
        scores += np.exp(-0.5 * (distance / place_peers.SEARCH_STD) ** 2) / len(points)
    np.testing.assert_allclose(found.score, scores.max(), atol=1e-6)
    off = relative(tried[scores.argmax()], tried)
    other = (np.hypot(*off[:, :2].T) >= SPEC.distinct[0]) | (abs(off[:, 2]) >= SPEC.distinct[1])
    np.testing.assert_allclose(found.margin, scores.max() - scores[other].max(), atol=1e-6)
    elsewhere = np.hypot(*off[:, :2].T) >= SPEC.distinct[0]
    assert found.margin < 0.5 * (scores.max() - scores[elsewhere].max())


def test_a_histogram_of_pairs_is_shifted_by_a_turn_and_by_nothing_else():
    rng = np.random.default_rng(1)
    points = rng.uniform(-4, 4, (8, 2))
    histogram = place_peers.pair_histogram(points)
    assert histogram.sum() == pytest.approx(1.0)
    moved = place_peers.pair_histogram(rng.permutation(points) + [3.0, -1.0])
    np.testing.assert_allclose(moved, histogram, atol=1e-9)
    turn = np.array([0.0, 0.0, 5 * np.pi / place_peers.DIRECTIONS])
    turned = place_peers.pair_histogram(compose(turn, np.pad(points, [(0, 0), (0, 1)]))[:, :2])
    np.testing.assert_allclose(turned, np.roll(histogram, 5, axis=0), atol=1e-9)
    other = place_peers.pair_histogram(rng.uniform(-4, 4, (8, 2)))
    alike = place_peers.similarities(histogram, np.stack([other, turned]))
    assert alike[1] == pytest.approx(1.0) and 0.0 <= alike[0] < 0.8


def test_walls_and_padding_are_no_landmarks():
    rng = np.random.default_rng(2)
    names = {name: np.zeros((2, 6)) for name in Features._fields}
    kind = np.array([[CORNER, CORNER, 0, 0, CORNER, WALL]] * 2)
    valid = np.array([[True] * 4 + [False, True]] * 2)
    xy = rng.uniform(-3, 3, (2, 6, 2))
    found = place_peers.histograms(Features(**names | {"kind": kind, "valid": valid, "xy": xy}))
    np.testing.assert_allclose(found[1], place_peers.pair_histogram(xy[1, :4]))


def test_recall_at_a_precision_is_that_of_the_best_threshold():
    rights = [True, True, False, True, True, False]
    rows = [
        {"in_map": k != 4, "places": {"right": right, "confidence": 1.0 - k / 10}}
        for k, right in enumerate(rights)
    ]
    points = place_curves.curve(rows[::-1], "places")
    assert points[0] == (0.2, 1.0) and points[3] == (0.6, 0.75)
    assert place_curves.recall_at(points) == 0.4
    assert place_curves.recall_at(points, 0.75) == 0.6
    assert place_curves.recall_at(points, 1.1) == 0.0
