import numpy as np
from matplotlib.colors import to_rgb

from jaxslam.core.regions import Door, Region, Regions
from jaxslam.viz import canvas
from jaxslam.viz.rooms import draw_rooms


def test_rooms_and_doors_are_drawn_where_they_are():
    label = np.zeros((20, 10), np.int32)
    label[2:9, 1:9], label[10:18, 1:9] = 1, 2
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    rooms = tuple(Region(f"room_{n}", "room", square, 2.0, (0,), ()) for n in (3, 14))
    jambs = np.array([[5.0, 2.0], [5.0, 3.0]])
    door = Door("door_1", jambs.mean(axis=0), jambs, 1.0, (0, 1))
    regions = Regions(label, rooms, (door,), 0.5, np.array([1.0, 2.0, np.pi / 2]))
    figure, axis = canvas.map_canvas([-5.0, 0.0], [5.0, 12.0])
    draw_rooms(axis, regions, np.array([[250, 0, 0], [0, 0, 250]], np.uint8))
    (image,) = axis.images
    shown = image.get_transform() - axis.transData
    np.testing.assert_allclose(shown.transform((20, 10)), [-4.0, 12.0], atol=1e-9)
    pixels = np.asarray(image.get_array())
    assert pixels.shape == (10, 20, 4) and not pixels[0].any()
    np.testing.assert_array_equal(pixels[4, 12, :3], [0, 0, 250])
    (lines,) = axis.collections
    np.testing.assert_array_equal(lines.get_segments(), [jambs])
    assert to_rgb(lines.get_colors()[0][:3]) == to_rgb(canvas.PINK)
    assert [text.get_text() for text in axis.texts] == ["3", "14"]
    for text, low in zip(axis.texts, (2, 10), strict=True):
        assert low * 0.5 <= text.get_position()[1] - 2.0 <= low * 0.5 + 4.0
    canvas.legend(figure)
    assert {text.get_text() for text in figure.legends[0].get_texts()} >= {"door"}


def test_nothing_is_drawn_of_no_rooms():
    regions = Regions(np.zeros((4, 4), np.int32), (), (), 0.5, np.zeros(3))
    axis = canvas.map_canvas([0.0, 0.0], [2.0, 2.0])[1]
    draw_rooms(axis, regions, np.zeros((0, 3), np.uint8))
    assert not axis.texts and not axis.collections
