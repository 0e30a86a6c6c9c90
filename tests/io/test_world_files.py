"""Which file needs which option, and buildings of grids and pictures."""

import numpy as np
import pytest

from jaxslam.core.maps import OccupancyMap
from jaxslam.core.se2_np import transform
from jaxslam.io import ros_map
from jaxslam.io.errors import InputError
from jaxslam.io.world_files import is_world_file, read_world

Image = pytest.importorskip("PIL.Image")


@pytest.fixture
def room():
    """A room of 30 x 20 cells with walls of two cells, in which a block of 4 x 3 cells stands."""
    occupied = np.zeros((34, 24), bool)
    occupied[1:-1, 1:-1] = True
    occupied[3:-3, 3:-3] = False
    occupied[10:14, 8:11] = True
    return occupied


def picture_of(occupied):
    return Image.fromarray(np.where(occupied, 0, 255).astype(np.uint8).T[::-1])


def test_a_picture_needs_its_scale_and_is_not_scaled_down(tmp_path, room):
    file = tmp_path / "plan.png"
    picture_of(room).save(file)
    with pytest.raises(InputError, match=r"plan.png: is a picture, .* no scale; add --resolution"):
        read_world(file)
    walls = read_world(file, resolution=0.1).world.walls
    corners = {(x, y) for x in (0.1, 3.3) for y in (0.1, 2.3)}
    corners |= {(x, y) for x in (0.3, 3.1) for y in (0.3, 2.1)}
    corners |= {(x, y) for x in (1.0, 1.4) for y in (0.8, 1.1)}
    assert len(walls) == 12
    assert {tuple(end) for end in np.round(walls.reshape(-1, 2), 9)} == corners
    np.testing.assert_allclose(read_world(file, resolution=0.5).world.walls, 5 * walls)
    with pytest.raises(InputError, match="--resolution: 0 is not between 0.001 and 100"):
        read_world(file, resolution=0)
    with pytest.raises(InputError, match="is 0.032 m x 0.022 m, not the size of a building"):
        read_world(file, resolution=0.001)


def test_a_map_keeps_its_frame_and_its_grid(tmp_path, room):
    pytest.importorskip("yaml", reason="pip install 'jaxslam[ros]'")
    origin = np.array([-7.0, 3.0, 0.4])
    free = ~room
    free[:, :1] = False
    ros_map.write(tmp_path / "map.yaml", OccupancyMap(room, free, 0.1, origin))
    found = read_world(tmp_path / "map.yaml")
    inner = transform(origin, np.array([[0.3, 0.3], [3.1, 2.1]]))
    ends = found.world.walls.reshape(-1, 2)
    for corner in inner:
        assert np.hypot(*(ends - corner).T).min() < 1e-9
    np.testing.assert_array_equal(found.occupancy.occupied, room)
    np.testing.assert_array_equal(found.origin, 0.0)
    far = origin + [500000.0, 4e6, 0.0]
    ros_map.write(tmp_path / "map.yaml", OccupancyMap(room, free, 0.1, far))
    moved = read_world(tmp_path / "map.yaml")
    assert abs(moved.world.walls).max() < 5.0
    np.testing.assert_allclose(
        moved.world.walls + np.tile(moved.origin, 2),
        found.world.walls + np.tile(far[:2] - origin[:2], 2),
        atol=1e-6,
    )
    np.testing.assert_allclose(moved.occupancy.origin[:2] + moved.origin, far[:2])
    ros_map.write(tmp_path / "map.yaml", OccupancyMap(room & False, ~room, 0.1, origin))
    with pytest.raises(InputError, match="has no occupied cell, so no wall"):
        read_world(tmp_path / "map.yaml")


@pytest.mark.parametrize(
    "name, options, message",
    [
        ("a.yaml", {"resolution": 0.1}, "--resolution: is for a picture alone; leave it out"),
        ("a.dxf", {"resolution": 0.1}, "--resolution: is for a picture alone; leave it out"),
        ("a.yaml", {"unit": "m"}, "--unit: is for drawings alone"),
        ("a.png", {"unit": "m", "resolution": 0.1}, "--unit: is for drawings alone"),
        ("a.yaml", {"layers": ["x"]}, "--layers: is for SVG, DXF and GeoJSON"),
        ("a.csv", {"layers": ["x"]}, "--layers: is for SVG, DXF and GeoJSON"),
        ("a.csv", {"unit": "yard"}, "--unit: 'yard' is no unit of length; write m, cm, mm, in, ft"),
        ("a.csv", {"unit": "-1"}, "--unit: '-1' is no unit of length"),
        ("a.dwg", {}, "a.dwg: ends in .dwg, which is not read; save it as DXF"),
        ("a.pdf", {}, r"a.pdf: ends in .pdf, which is not read; name a ROS map \(.yaml\)"),
        ("office/", {}, "office: has no ending"),
        ("none.csv", {}, "none.csv: does not exist"),
        ("none.geojson", {}, "none.geojson: does not exist"),
        ("none.yaml", {}, "none.yaml: does not exist"),
        ("none.png", {"resolution": 0.1}, "none.png: does not exist"),
    ],
)
def test_options_that_do_not_go_with_a_file_are_refused(tmp_path, name, options, message):
    with pytest.raises(InputError, match=message) as error:
        read_world(tmp_path / name, **options)
    assert "\n" not in str(error.value)


def test_names_of_worlds_are_no_files():
    assert not is_world_file("office") and not is_world_file("random:3")
    assert is_world_file("office.dxf") and is_world_file("maps/office") and is_world_file("./a")
