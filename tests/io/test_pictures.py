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
        (
            [0, 120, 120, 254, 254, 254],
            [0, 120, 120],
            [254] * 3,
        ),  # a grey that is not around the plan is a wall
        ([90, 254], [90], [254]),
        ([90, 205, 254], [90], [254]),  # unknown stays unknown
        ([205, 254], [205], [254]),
        ([150, 160, 240, 255], [150, 160], [240, 255]),
        ([254], [], [254]),
        ([0, 0, 200, 200, 200], [0, 0], [200, 200, 200]),  # the paper is grey
    ],
)
def test_walls_of_a_plan_are_its_darker_shades(tmp_path, shades, occupied, free):
    picture = plan(tmp_path / "a.png", np.repeat([shades], 5, axis=0))
    found = ros_map.read_picture(picture, 0.1)
    assert np.array(shades)[found.occupied[:, 0]].tolist() == occupied
    assert np.array(shades)[found.free[:, 0]].tolist() == free
    guessed = 120 in shades or 200 in shades or min(shades) > 89 and bool(occupied)
    assert len(found.notes) == guessed


def test_the_best_level_is_between_two_groups_of_any_size():
    rng = np.random.default_rng(0)
    dark, light = rng.normal(90, 5, 200), rng.normal(242, 3, 20_000)
    level = np.clip(np.concatenate([dark, light]), 0, 255).astype(int)
    assert 107 < pictures.two_groups(np.bincount(level, minlength=256)) < 232
    assert pictures.two_groups(np.bincount([0, 255], minlength=256)) == pytest.approx(127.5)
    assert pictures.two_groups(np.bincount([255] * 9, minlength=256)) is None
    assert pictures.two_groups(np.zeros(256, int)) is None


def two_rooms(wall, paper=255, ground=None):
    """Shades (70, 120) of two rooms with a door, 5 pixels of wall, 10 of ground around them."""
    shade = np.full((70, 120), paper if ground is None else ground)
    shade[10:60, 10:110] = wall
    shade[15:55, 15:57] = shade[15:55, 62:105] = shade[30:40, 57:62] = paper
    return shade


def read(tmp_path, shade, resolution=0.1):
    """Free and occupied cells as pixels [row, column], and notes."""
    found = ros_map.read_picture(plan(tmp_path / "a.png", shade), resolution)
    return found.free.T[::-1], found.occupied.T[::-1], found.notes


@pytest.mark.parametrize("wall", [90, 120, 204, 205, 215])
@pytest.mark.parametrize("dark", [0, 1, 30])
def test_a_dark_label_does_not_hide_walls_that_are_grey(tmp_path, wall, dark):
    shade = two_rooms(wall)
    is_wall = shade == wall
    shade[20, 20 : 20 + dark] = 0
    free, occupied, notes = read(tmp_path, shade)
    np.testing.assert_array_equal(free, shade == 255)
    np.testing.assert_array_equal(occupied, is_wall | (shade == 0))
    assert len(notes) == 1 and "of 255 are taken as walls" in notes[0]


def test_grey_walls_at_the_border_of_the_picture_are_walls(tmp_path):
    shade = two_rooms(120)[10:60, 10:110]
    shade[10, 10:30] = 0
    free, occupied, _ = read(tmp_path, shade)
    np.testing.assert_array_equal(free, shade == 255)
    np.testing.assert_array_equal(occupied, shade < 255)


def test_a_grey_around_dark_outlines_is_unknown_and_told(tmp_path):
    shade = two_rooms(60, ground=180)
    free, occupied, notes = read(tmp_path, shade)
    np.testing.assert_array_equal(free, shade == 255)
    np.testing.assert_array_equal(occupied, shade == 60)
    assert notes == ("the shade 180 of 255 around the plan is taken as unknown",)


def outlined(fill):
    """Walls that are an outline of shade 60 filled with another."""
    shade = two_rooms(60)
    inside = shade == 60
    for axis in (0, 1):
        for step in (-1, 1):
            inside &= np.roll(shade, step, axis) == 60
    shade[inside] = fill
    return shade, inside


@pytest.mark.parametrize("fill", [180, 211])
def test_light_insides_of_outlined_walls_are_walls(tmp_path, fill):
    shade, inside = outlined(fill)
    free, occupied, notes = read(tmp_path, shade)
    np.testing.assert_array_equal(free, shade == 255)
    np.testing.assert_array_equal(occupied, shade < 255)
    assert len(notes) == 1 and ("narrow light grey areas" in notes[0]) == (fill == 211)


def test_a_pale_floor_within_black_walls_is_free(tmp_path):
    shade = two_rooms(0)
    shade[15:55, 15:57] = 220
    free, occupied, notes = read(tmp_path, shade)
    np.testing.assert_array_equal(free, shade > 0)
    np.testing.assert_array_equal(occupied, shade == 0)
    assert not notes


def test_noise_of_white_paper_is_no_wall(tmp_path):
    noise = np.random.default_rng(0).normal(235, 6, (70, 120)).clip(206, 255)
    free, occupied, notes = read(tmp_path, noise)
    assert free.all() and not occupied.any() and not notes


def test_map_savers_unknown_stays_unknown_without_a_note(tmp_path):
    shade = two_rooms(0, ground=205)
    shade[15:55, 90:105] = 205  # seen from afar: no wall between free and unknown
    free, occupied, notes = read(tmp_path, shade)
    np.testing.assert_array_equal(free, shade == 255)
    np.testing.assert_array_equal(occupied, shade == 0)
    assert not notes


@pytest.mark.parametrize("spot", [200, 255])
def test_grey_paper_is_free_and_told(tmp_path, spot):
    shade = two_rooms(0, paper=200)
    shade[20, 20] = spot
    free, occupied, notes = read(tmp_path, shade)
    np.testing.assert_array_equal(free, shade >= 200)
    np.testing.assert_array_equal(occupied, shade == 0)
    assert len(notes) == 1 and "paper of the shade 200 is taken as free" in notes[0]


def test_a_picture_without_white_is_refused(tmp_path):
    ink = np.zeros((70, 120, 4))
    ink[..., 3] = np.where(two_rooms(0) == 0, 255, 0)
    for shade in (ink, np.full((70, 120), 205), np.full((70, 120), 60)):
        with pytest.raises(InputError, match="a.png: no pixel is white enough.*negate") as caught:
            read(tmp_path, shade)
        assert "\n" not in str(caught.value)


def test_a_plan_that_is_inverted_is_refused_or_told(tmp_path):
    shade = 255 - two_rooms(0)
    with pytest.raises(InputError, match="white, which is free, is at most 0.12 m wide.*invert it"):
        read(tmp_path, shade, 0.02)
    _, _, notes = read(tmp_path, shade, 0.2)
    assert len(notes) == 1 and "if this plan is inverted" in notes[0]
    assert not read(tmp_path, two_rooms(0, ground=0))[2]  # rooms within black


@pytest.mark.parametrize("orientation", range(10))
def test_a_photograph_is_turned_as_viewers_do(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    shade = two_rooms(0)
    shade[:10] = shade[20:30, 80:90] = 0
    path = plan(tmp_path / "a.png", shade, exif=exif)
    found = ros_map.read_picture(path, 0.1).free.T[::-1] == 1
    turns = {2: shade[:, ::-1], 3: shade[::-1, ::-1], 4: shade[::-1], 5: shade.T}
    turns |= {6: np.rot90(shade, -1), 7: shade[::-1, ::-1].T, 8: np.rot90(shade)}
    np.testing.assert_array_equal(found, turns.get(orientation, shade) == 255)
    assert pictures.read(path)[0].shape == shade.shape  # of a YAML file, as in map_server


def test_broken_exif_fields_do_not_matter(tmp_path):
    """A field of another type than its own, before the orientation."""
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x02"
    exif += b"\x01\0\0\x02\0\0\0\x02A\0\0\0"  # width: text
    exif += b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    path = plan(tmp_path / "a.png", two_rooms(0), exif=exif)
    assert pictures.read(path, upright=True)[0].shape == (120, 70)
