import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb

from jaxslam.core.regions import Door, Region, Regions, contains
from jaxslam.io.room_colours import region_colours
from jaxslam.viz import canvas
from jaxslam.viz.rooms import draw_rooms


def box(x, y, x_end, y_end):
    return np.array([(x, y), (x_end, y), (x_end, y_end), (x, y_end)], float)


def l_shape_and_ring():
    """A corridor in the shape of an L, and one around a room."""
    bent = np.array([(0, 0), (12, 0), (12, 1.5), (1.5, 1.5), (1.5, 12), (0, 12)], float)
    around, inner = box(14, 0, 26, 12), box(16, 2, 24, 10)
    jambs = np.array([[16.0, 5.0], [16.0, 6.0]])
    door = Door("door_1", jambs.mean(axis=0), jambs, 1.0, (1, 2))
    found = (
        Region("room_3", "corridor", bent, 33.75, (), ()),
        Region("room_14", "corridor", around, 80.0, (0,), (2,), (inner[::-1],)),
        Region("room_15", "room", inner, 64.0, (0,), (1,)),
        Region("room_16", "room", box(0, 14, 0.2, 14.2), 0.04, (), ()),
    )
    return Regions(np.zeros((0, 0), np.int32), found, (door,), 0.1, np.zeros(3))


@pytest.fixture
def drawn():
    figure, axis = canvas.map_canvas([0.0, 0.0], [26.0, 15.0])
    regions = l_shape_and_ring()
    draw_rooms(axis, regions)
    return regions, figure, axis


def test_rooms_are_filled_but_for_their_holes(drawn):
    regions, figure, axis = drawn
    axis.set_axis_off()
    agg = FigureCanvasAgg(figure)
    agg.draw()
    pixels = np.asarray(agg.buffer_rgba())[::-1, :, :3].astype(float)
    colours = region_colours(regions) * 0.55 + 255.0 * 0.45
    for point, k in (((1.0, 10.0), 0), ((14.7, 3.0), 1), ((22.0, 3.0), 2)):
        column, row = np.rint(axis.transData.transform(point)).astype(int)
        np.testing.assert_allclose(pixels[row, column], colours[k], atol=2.0)
    column, row = np.rint(axis.transData.transform((10.0, 10.0))).astype(int)
    np.testing.assert_array_equal(pixels[row, column], 255)


def test_numbers_stand_in_their_rooms_if_they_fit(drawn):
    regions, figure, axis = drawn
    assert [text.get_text() for text in axis.texts] == ["3", "14", "15"]
    figure.canvas.draw()
    for text, region in zip(axis.texts, regions.regions, strict=False):
        extent = text.get_window_extent()  # of the text, without its frame
        corners = axis.transData.inverted().transform(extent.corners())
        assert contains(region, corners).all()
    marks = axis.texts[0].get_zorder()
    assert marks < 3.0 and marks > 1.5  # of start and goal, and of arcs


def test_doors_are_lines_between_their_jambs(drawn):
    regions, figure, axis = drawn
    lines = axis.collections[-1]
    np.testing.assert_array_equal(lines.get_segments(), [regions.doors[0].jambs])
    assert to_rgb(lines.get_colors()[0][:3]) == to_rgb(canvas.PINK)
    canvas.legend(figure)
    assert {text.get_text() for text in figure.legends[0].get_texts()} >= {"door"}


def test_nothing_is_drawn_of_no_rooms():
    regions = Regions(np.zeros((4, 4), np.int32), (), (), 0.5, np.zeros(3))
    axis = canvas.map_canvas([0.0, 0.0], [2.0, 2.0])[1]
    draw_rooms(axis, regions)
    assert not axis.texts and not axis.collections
