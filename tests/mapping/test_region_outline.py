"""Rings of regions are valid polygons, by shapely, and follow the cells."""

import numpy as np
import pytest
from scipy import ndimage

from jaxslam.core.regions import signed_area
from jaxslam.mapping import region_outline


def noise(seed):
    """Labels (H, W) of the 4-connected parts of smoothed noise, with many holes and corners."""
    rng = np.random.default_rng(seed)
    size = rng.integers(8, 90)
    values = ndimage.gaussian_filter(
        rng.normal(size=(size, size + 5)), rng.choice([0.1, 0.6, 1, 2])
    )
    label, count = ndimage.label(values > np.quantile(values, rng.uniform(0.15, 0.6)))
    return label.astype(np.int32), count


def between(cells):
    """Rings of the one region that cells of `#` make."""
    label = np.array([[c == "#" for c in row] for row in cells.split()], np.int32)
    (rings,) = region_outline.outlines(label, 1)
    return rings


@pytest.mark.parametrize("seed", range(40))
def test_rings_of_a_region_are_a_valid_polygon(seed):
    shapely = pytest.importorskip("shapely", reason="pip install 'jaxslam[test]'")
    label, count = noise(seed)
    c, s = np.cos(0.4), np.sin(0.4)
    for outer, *holes in region_outline.outlines(label, count):
        assert shapely.Polygon(outer, holes).is_valid
        assert signed_area(outer) > 0.0 and all(signed_area(hole) < 0.0 for hole in holes)
        turned = [np.round(0.05 * ring @ [[c, s], [-s, c]], 4) for ring in (outer, *holes)]
        assert shapely.Polygon(turned[0], turned[1:]).is_valid  # as a file has it


@pytest.mark.parametrize("seed", range(8))
def test_rings_are_a_cell_from_the_border_of_their_cells_at_most(seed):
    shapely = pytest.importorskip("shapely", reason="pip install 'jaxslam[test]'")
    label, count = noise(seed)
    points = np.argwhere(np.ones(label.shape, bool)) + 0.5
    for k, (outer, *holes) in enumerate(region_outline.outlines(label, count), start=1):
        cells = np.pad(label == k, 1)
        inside = shapely.contains_xy(shapely.Polygon(outer, holes), *points.T).reshape(label.shape)
        for is_cell, wrong in ((cells, ~inside), (~cells, inside)):
            depth = ndimage.distance_transform_edt(is_cell)[1:-1, 1:-1] - 0.5
            assert (depth * wrong).max() <= region_outline.TOLERANCE + 0.5


def test_a_hole_between_cells_that_meet_in_a_corner_does_not_touch_the_outer_ring():
    outer, hole = between("####### #.....# #.....# #.....# ######.")
    assert len(np.unique(outer, axis=0)) == len(outer)
    assert not any((outer == corner).all(axis=1).any() for corner in hole)
    np.testing.assert_allclose(hole.max(axis=0), [4.0, 6.0], atol=0.3)


def test_a_pocket_of_a_cell_between_cells_that_meet_in_a_corner_is_no_hole():
    assert len(between("######## ######## ###.#### ##.##### ######## ########")) == 1
    assert len(between("##### ##### ##.## ##### #####")) == 2


def test_sides_that_meet_are_found():
    ring = np.array([[0.0, 0.0], [4.0, 4.0], [4.0, 0.0], [0.0, 4.0]])
    meets = region_outline._meets(ring, np.roll(ring, -1, axis=0))
    np.testing.assert_array_equal(meets, [True, False, True, False])
    spike = np.array([[0.0, 0.0], [4.0, 0.0], [2.0, 0.0], [2.0, 3.0]])
    assert region_outline._meets(spike, np.roll(spike, -1, axis=0))[:2].all()


def test_a_hole_that_simplified_sides_would_leave_outside_is_put_back():
    outer = np.array(
        [[0.0, 0], [40, 0], [40, 20], [20, 20], [20, 20.9], [19, 20.9], [19, 20], [0, 20]]
    )
    hole = np.array([[19.2, 20.2], [19.2, 20.7], [19.7, 20.7], [19.7, 20.2]])
    found = region_outline._simplified([outer, hole])
    assert len(found[0]) > 4 and len(found[1]) == 4
