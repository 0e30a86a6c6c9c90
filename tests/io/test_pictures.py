"""Pictures of maps: formats, shades that are walls."""

import numpy as np
import pytest
from PIL import Image

from jaxslam.io import pictures, ros_map
from jaxslam.io.errors import InputError


def plan(path, shade, **options):
    Image.fromarray(np.asarray(shade, np.uint8)).save(path, **options)
    return path


@pytest.mark.parametrize("suffix", [suffix for suffix in pictures.SUFFIXES if suffix != ".pbm"])
def test_every_picture_that_has_the_name_of_one_can_be_read(tmp_path, suffix):
    shade = np.full((40, 60, 3), 255)
    shade[:, :20] = 0
    found = ros_map.read_picture(plan(tmp_path / f"a{suffix}", shade), 0.1)
    assert pictures.is_picture(f"A{suffix.upper()}")
    assert found.occupied[:18].all() and found.free[22:].all() and not found.notes


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "I;16"])
def test_pictures_of_all_kinds_of_pixels_are_read(tmp_path, mode):
    image = Image.new("L", (6, 4), 255)
    image.paste(0, (0, 0, 2, 4))
    if mode == "I;16":
        image = Image.fromarray(np.asarray(image).astype(np.uint16) * 257)
    else:
        image = (image.convert("RGB") if mode == "CMYK" else image).convert(mode)
    image.save(tmp_path / "a.tif")
    found = ros_map.read_picture(tmp_path / "a.tif", 0.1)
    assert found.occupied[:2].all() and found.free[2:].all()


def test_what_is_no_picture_is_refused_with_the_formats_that_are(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"GIF89")
    with pytest.raises(InputError, match="a.jpg: is no image .*; give a PNG, PGM, BMP, JPEG, GIF"):
        ros_map.read_picture(tmp_path / "a.jpg", 0.1)
    (tmp_path / "a.webp").write_bytes(b"RIFF\xff")
    with pytest.raises(InputError, match=r"a.webp: is not .* a picture ends in .png, .pgm"):
        ros_map.read(tmp_path / "a.webp")


@pytest.mark.parametrize(
    "shades, occupied, free",
    [
        ([0, 205, 254], [0], [254]),  # of map_saver
        ([0, 120, 254], [0], [254]),  # a grey shade beside black walls is unknown
        ([90, 254], [90], [254]),
        ([90, 205, 254], [90], [254]),  # unknown stays unknown
        ([205, 254], [205], [254]),
        ([150, 160, 240, 255], [150, 160], [240, 255]),
        ([254], [], [254]),
        ([205], [], []),
        ([0, 200], [0], []),
    ],
)
def test_walls_of_a_plan_are_its_darker_shades(tmp_path, shades, occupied, free):
    picture = plan(tmp_path / "a.png", np.repeat([shades], 5, axis=0))
    found = ros_map.read_picture(picture, 0.1)
    assert np.array(shades)[found.occupied[:, 0]].tolist() == occupied
    assert np.array(shades)[found.free[:, 0]].tolist() == free
    assert bool(found.notes) == (min(shades) > 89 and bool(occupied))


def test_the_best_shade_is_between_two_groups_of_any_size():
    rng = np.random.default_rng(0)
    dark, light = rng.normal(0.35, 0.02, 200), rng.normal(0.95, 0.01, 20_000)
    limit = pictures.wall_shade(np.clip(np.concatenate([dark, light]), 0, 1))
    assert 0.42 < limit < 0.91
    assert pictures.wall_shade(np.array([0.0, 1.0])) == pytest.approx(0.5)
    assert pictures.wall_shade(np.ones(9)) is None
    assert pictures.wall_shade(np.zeros(0)) is None
