import numpy as np
import pytest
from matplotlib.path import Path

from jaxslam.core import regions
from jaxslam.core.regions import Region


def region(polygon, *holes):
    rings = [np.array(ring, float) for ring in (polygon, *holes)]
    return Region("room_1", "room", rings[0], 1.0, (), (), tuple(rings[1:]))


def box(x, y, x_end, y_end):
    return [(x, y), (x_end, y), (x_end, y_end), (x, y_end)]


def star(rng, centre, radius, count):
    """A ring (count, 2) around a centre, counter-clockwise."""
    angle = np.sort(rng.uniform(0.0, 2 * np.pi, count))
    length = radius * rng.uniform(0.5, 1.0, count)[:, None]
    return centre + length * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_points_are_in_a_region_as_matplotlib_has_it(seed):
    rng = np.random.default_rng(seed)
    outer = star(rng, [3.0, -2.0], 8.0, 40)
    holes = [star(rng, [3.0 + dx, -2.0], 1.2, 9)[::-1] for dx in (-1.5, 1.5)]
    points = rng.uniform(-7.0, 12.0, (3000, 2))
    expected = Path(outer).contains_points(points)
    for hole in holes:
        expected &= ~Path(hole).contains_points(points)
    found = regions.contains(region(outer, *holes), points)
    assert 200 < expected.sum() < 2000
    np.testing.assert_array_equal(found, expected)
    assert regions.contains(region(outer), np.zeros((0, 2))).shape == (0,)


@pytest.mark.parametrize(
    "shape",
    [
        region([(0, 0), (9, 0), (9, 2), (2, 2), (2, 7), (0, 7)]),
        region(box(0, 0, 20, 20), box(2, 2, 18, 18)[::-1]),
        region(box(0, 0, 40, 1)),
        region([(0, 0), (3, 0), (3, 3), (6, 3), (6, 6), (0, 6)]),
    ],
    ids=["L", "ring", "strip", "steps"],
)
def test_the_innermost_point_is_far_from_the_border(shape):
    point, clearance = regions.innermost(shape)
    assert regions.contains(shape, point[None])[0]
    rings = [shape.polygon, *shape.holes]
    border = np.concatenate(
        [np.linspace(ring, np.roll(ring, -1, axis=0), 2000).reshape(-1, 2) for ring in rings]
    )
    assert np.hypot(*(border - point).T).min() >= clearance - 1e-9
    low, high = shape.polygon.min(axis=0), shape.polygon.max(axis=0)
    tried = np.random.default_rng(0).uniform(low, high, (400, 2))
    tried = tried[regions.contains(shape, tried)]
    best = max(np.hypot(*(border - xy).T).min() for xy in tried)
    assert clearance >= 0.85 * best - 0.05


def test_of_several_innermost_points_it_is_the_middle_one():
    np.testing.assert_allclose(regions.innermost(region(box(0, 0, 40, 1)))[0], [20, 0.5], atol=0.1)
    flat = region([(1.0, 2.0), (3.0, 2.0), (2.0, 2.0)])
    point, clearance = regions.innermost(flat)
    assert clearance == 0.0 and np.isfinite(point).all()


def test_areas_have_the_sign_of_the_turn():
    ring = np.array(box(1, 1, 4, 3), float)
    assert regions.signed_area(ring) == 6.0 and regions.signed_area(ring[::-1]) == -6.0
    assert regions.outer_first([region(ring), region(10.0 * ring[::-1])]) == [1, 0]
