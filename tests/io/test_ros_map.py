import sys

import numpy as np
import pytest
from PIL import Image

from jaxslam.core.maps import OccupancyMap
from jaxslam.io import ros_map
from jaxslam.io.errors import InputError

FIELDS = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": "[-1.5, 2.0, 0.25]",
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}
SHADES = np.array([[0, 89, 90], [205, 206, 254]], np.uint8)  # occupied twice, unknown; u., free t.
OCCUPIED = np.array([[1, 1, 0], [0, 0, 0]], bool)
FREE = np.array([[0, 0, 0], [0, 1, 1]], bool)


def turned(image):
    """Rows of an image, top first, as cells [i, j] with i along x and j along y."""
    return np.array([[image[-1 - j, i] for j in range(2)] for i in range(3)])


@pytest.fixture
def write(tmp_path):
    """Function that writes a map with some fields changed (None: left out)."""

    def make(shades=SHADES, name="map.pgm", **change):
        fields = {**FIELDS, "image": name, **change}
        if shades is not None:
            Image.fromarray(shades).save(tmp_path / name)
        text = "".join(f"{k}: {v}\n" for k, v in fields.items() if v is not None)
        (tmp_path / "map.yaml").write_text(text)
        return tmp_path / "map.yaml"

    return make


def assert_cells(grid, occupied=OCCUPIED, free=FREE):
    np.testing.assert_array_equal(grid.occupied, turned(occupied))
    np.testing.assert_array_equal(grid.free, turned(free))


@pytest.mark.parametrize("name", ["map.pgm", "map.png", "map.bmp"])
def test_shades_become_cells_with_x_first(write, name):
    grid = ros_map.read(write(name=name))
    assert_cells(grid)
    assert grid.resolution == 0.05
    np.testing.assert_array_equal(grid.origin, [-1.5, 2.0, 0.25])


@pytest.mark.parametrize(
    "content",
    [
        b"P5\n# made by hand\n3 2\n255\n" + SHADES.tobytes(),
        b"P2 3 2 # plain\n255\n0 89 90\n205 206 254\n",
        b"P5 3 2 65535\n" + (SHADES.astype(">u2") * 257).tobytes(),
    ],
    ids=["comment", "plain", "16 bits"],
)
def test_every_kind_of_pgm_is_read(write, tmp_path, content):
    path = write()
    (tmp_path / "map.pgm").write_bytes(content)
    assert_cells(ros_map.read(path))


def test_a_small_maxval_is_the_brightest_shade(write, tmp_path):
    path = write()
    (tmp_path / "map.pgm").write_bytes(b"P2 3 2 100\n0 34 36\n80 81 100\n")
    assert_cells(ros_map.read(path))


def test_negate_turns_dark_and_bright(write):
    assert_cells(ros_map.read(write(255 - SHADES, negate=1)))
    assert_cells(ros_map.read(write(255 - SHADES, negate="true")))


def test_colours_are_averaged_and_transparent_pixels_unknown(write):
    image = np.stack([SHADES] * 3 + [np.full_like(SHADES, 255)], axis=-1)
    assert_cells(ros_map.read(write(image, "map.png")))
    image[0, 0, 3] = image[1, 2, 3] = 0
    occupied, free = OCCUPIED.copy(), FREE.copy()
    occupied[0, 0] = free[1, 2] = False
    assert_cells(ros_map.read(write(image, "map.png")), occupied, free)


def test_raw_shades_are_percent_and_above_100_unknown(write):
    raw = np.array([[66, 100, 65], [255, 19, 0]], np.uint8)
    assert_cells(ros_map.read(write(raw, mode="raw")))


def test_scale_differs_in_nothing_that_counts(write):
    assert_cells(ros_map.read(write(mode="scale")))


def test_numbers_that_yaml_takes_for_text_are_numbers(write):
    assert ros_map.read(write(resolution="5e-2")).resolution == 0.05


def test_an_image_in_a_folder_below_is_found(write, tmp_path):
    (tmp_path / "images").mkdir()
    assert_cells(ros_map.read(write(name="images/map.pgm")))


@pytest.mark.parametrize("field", list(FIELDS))
def test_a_missing_field_is_named(write, field):
    with pytest.raises(InputError, match=f"map.yaml: {field}: missing"):
        ros_map.read(write(**{field: None}))


@pytest.mark.parametrize(
    "change",
    [
        {"resolution": 0},
        {"resolution": -0.05},
        {"resolution": ".inf"},
        {"resolution": ".nan"},
        {"resolution": "fine"},
        {"resolution": "true"},
        {"resolution": "[0.05]"},
        {"origin": "0"},
        {"origin": "[0, 0]"},
        {"origin": "[0, 0, east]"},
        {"origin": "[0, 0, .nan]"},
        {"origin": "[0, 0, 90]"},
        {"negate": 2},
        {"negate": "never"},
        {"occupied_thresh": 1.5},
        {"free_thresh": -0.1},
        {"free_thresh": 0.65},
        {"free_thresh": "[]"},
        {"mode": "ternary"},
        {"mode": "[raw]"},
        {"image": "7"},
        {"image": "''"},
        {"image": "[map.pgm]"},
        {"image": "../map.pgm"},
        {"image": "/etc/hostname"},
        {"image": "a/../../map.pgm"},
    ],
)
def test_a_bad_field_is_named(write, change):
    (field,) = change
    with pytest.raises(InputError, match=f"map.yaml: {field}: "):
        ros_map.read(write(**change))


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"\0\1\2",
        b"image: [map.pgm\nresolution",
        b"- a\n- b\n",
        b"just text\n",
        b"\xff\xfe\xfa",
        b"!!python/object/apply:os.getcwd []\n",
        b"image: map.pgm\nresolution: 2020-13-45\n",
        b"[" * 30_000,
        b"# long\n" * 20_000,
    ],
)
def test_what_is_no_map_file_is_named(tmp_path, content):
    path = tmp_path / "map.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="map.yaml") as caught:
        ros_map.read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"hello",
        b"P5\n3 2\n255\nab",
        b"P5\n0 2\n255\n",
        b"P5\n-3 2\n255\n",
        b"P5\n3 2\n99999\n",
        b"P2 3 2 255\n1 2 x 4 5 6\n",
        b"P5\n9000 9000\n255\n",
        b"P5\n900000 900000\n255\n",
        b"\x89PNG\r\n\x1a\n\0\0",
        b"GIF89a\x01\0\x01\0\0\0\0",
    ],
)
def test_a_bad_image_is_named(write, tmp_path, content):
    path = write(shades=None)
    if content is not None:
        (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(InputError, match="map.pgm: ") as caught:
        ros_map.read(path)
    assert "\n" not in str(caught.value)


def test_a_folder_is_no_image(write, tmp_path):
    (tmp_path / "map.pgm").mkdir()
    with pytest.raises(InputError, match="map.pgm: "):
        ros_map.read(write(shades=None))


def test_a_link_that_leaves_the_folder_is_refused(write, tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    write().rename(inside / "map.yaml")
    (inside / "map.pgm").symlink_to(tmp_path / "map.pgm")
    with pytest.raises(InputError, match="image: .* outside"):
        ros_map.read(inside / "map.yaml")


def test_without_pyyaml_the_line_says_how_to_install_it(write, monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(InputError, match=r"pip install 'jaxslam\[ros\]'"):
        ros_map.read(write())


def test_a_map_comes_back_as_it_was_written(tmp_path):
    grid = OccupancyMap(turned(OCCUPIED), turned(FREE), np.float32(0.5), [1, 2, 0.25])
    ros_map.write(tmp_path / "a.yaml", grid)
    found = ros_map.read(tmp_path / "a.yaml")
    assert_cells(found)
    assert found.resolution == 0.5 and found.origin.tolist() == [1, 2, 0.25]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"occupied": np.zeros(3, bool)}, r"occupied is bool \(3,\), not bool_? ?\(H, W\)"),
        ({"occupied": np.zeros((3, 2))}, "occupied is float"),
        ({"free": np.zeros((2, 3), bool)}, r"free is bool \(2, 3\), not bool_? ?\(3, 2\)"),
        ({"resolution": 0.0}, "resolution is 0.0"),
        ({"resolution": "fine"}, "resolution is <U4"),
        ({"origin": [0.0, 0.0]}, r"origin is .* \(2,\), not \(3,\)"),
        ({"origin": [0.0, np.nan, 0.0]}, "origin .*nan"),
    ],
)
def test_what_is_no_map_is_not_written(tmp_path, change, message):
    grid = OccupancyMap(turned(OCCUPIED), turned(FREE), 0.5, np.zeros(3))
    with pytest.raises(ValueError, match=message):
        ros_map.write(tmp_path / "a.yaml", grid._replace(**change))
    assert not list(tmp_path.iterdir())


WRITTEN = np.array([[0, 0, 205], [205, 254, 254]], np.uint8)  # as map_saver writes


@pytest.mark.parametrize("free", [0.196, 0.25])
def test_unknown_stays_unknown_where_the_thresholds_contradict_it(write, free):
    grid = ros_map.read(write(WRITTEN, free_thresh=free))
    assert_cells(grid, WRITTEN == 0, WRITTEN == 254)
    assert len(grid.notes) == (free == 0.25) and all("stay unknown" in x for x in grid.notes)


def test_a_shade_that_is_not_for_unknown_is_what_the_thresholds_say(write):
    """Raw and scale maps, other shades, and a map in which 205 is the only light shade."""
    grid = ros_map.read(write(WRITTEN, free_thresh=0.25, mode="scale"))
    assert_cells(grid, WRITTEN == 0, WRITTEN > 0)
    grid = ros_map.read(write(np.where(WRITTEN == 205, 204, WRITTEN), free_thresh=0.25))
    assert_cells(grid, WRITTEN == 0, WRITTEN > 0)
    grid = ros_map.read(write(WRITTEN.clip(0, 205), free_thresh=0.25))
    assert_cells(grid, WRITTEN == 0, WRITTEN > 0)
    assert grid.notes == ()


@pytest.mark.parametrize(
    "name", ["/home/robot/maps/map.pgm", r"C:\\maps\\map.pgm", r"\\\\nas\\a\\map.pgm"]
)
def test_a_path_of_another_machine_is_the_image_beside(write, tmp_path, name):
    path = write(WRITTEN)
    path.write_text(path.read_text().replace("image: map.pgm", f'image: "{name}"'))
    grid = ros_map.read(path)
    assert_cells(grid, WRITTEN == 0, WRITTEN == 254)
    assert len(grid.notes) == 1 and "is taken to be 'map.pgm' beside" in grid.notes[0]
    (tmp_path / "map.pgm").unlink()
    with pytest.raises(InputError, match="image: .* (outside|does not exist)|does not exist"):
        ros_map.read(path)
