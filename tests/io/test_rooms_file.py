import json

import numpy as np
import pytest
from PIL import Image

from jaxslam.core.regions import Door, Region, Regions
from jaxslam.io import rooms_file
from jaxslam.io.errors import InputError

HOLE = np.array([[1.75, 0.5], [1.75, 1.5], [2.25, 1.5]])  # clockwise


def two_regions():
    label = np.zeros((7, 5), np.int32)
    label[1:3, 1:4], label[4:6, 1:4] = 1, 2
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.0, 2.0]])
    regions = (
        Region("room_2", "room", square, 2.0, (0,), (1,)),
        Region("room_7", "corridor", square + [1.5, 0.0], 2.5, (0,), (0,), (HOLE,)),
    )
    jambs = np.array([[1.25, 0.5], [1.25, 1.25]])
    door = Door("door_4", jambs.mean(axis=0), jambs, 0.75, (0, 1))
    return Regions(label, regions, (door,), 0.5, np.array([1.0, -2.0, 0.25]), (9, 4))


@pytest.fixture
def written(tmp_path):
    rooms_file.write_rooms(tmp_path, two_regions())
    return tmp_path


def test_what_is_written_is_read_back(written):
    assert {path.name for path in written.iterdir()} == {"rooms.json", "rooms.png"}
    for path in (written, written / "rooms.json"):
        found, want = rooms_file.read_rooms(path), two_regions()
        assert found.label.shape == (0, 0) and found.last_numbers == (9, 4)
        assert found.resolution == want.resolution
        np.testing.assert_array_equal(found.origin, want.origin)
        for one, other in zip(
            [*found.regions, *found.doors], [*want.regions, *want.doors], strict=True
        ):
            for here, there in zip(one, other, strict=True):
                np.testing.assert_array_equal(here, there)


def test_the_picture_has_a_pixel_for_each_cell(written):
    picture = Image.open(written / "rooms.png")
    pixels, label = np.asarray(picture), two_regions().label
    assert picture.mode == "RGB" and pixels.shape == (5, 7, 3)
    content = json.loads((written / "rooms.json").read_text())
    colours = np.array([[0, 0, 0], *(region["colour"] for region in content["rooms"])])
    np.testing.assert_array_equal(pixels[::-1].transpose(1, 0, 2), colours[label])


def test_a_file_without_holes_is_read(written):
    content = json.loads((written / "rooms.json").read_text())
    for region in content["rooms"]:
        del region["holes"]
    (written / "rooms.json").write_text(json.dumps(content))
    assert [region.holes for region in rooms_file.read_rooms(written).regions] == [(), ()]


def test_no_rooms_at_all(tmp_path):
    empty = two_regions()._replace(label=np.zeros((3, 4), np.int32), regions=(), doors=())
    rooms_file.write_rooms(tmp_path, empty)
    found = rooms_file.read_rooms(tmp_path)
    assert found.regions == () and found.doors == () and found.last_numbers == (9, 4)
    assert not np.asarray(Image.open(tmp_path / "rooms.png")).any()


WRONG = [
    (("format",), "other", "format"),
    (("version",), 2, "version"),
    (("version",), None, "version"),
    (("last_numbers",), [9, 4], "last_numbers"),
    (("last_numbers", "room"), 6, "room_7"),
    (("last_numbers", "room"), -1, "last_numbers.room"),
    (("last_numbers", "door"), True, "last_numbers.door"),
    (("resolution",), 0, "resolution"),
    (("resolution",), "1", "resolution"),
    (("origin",), [0, 0], "origin"),
    (("rooms",), {}, "rooms"),
    (("rooms", 0), 3, "rooms[0]"),
    (("rooms", 0, "name"), "room_7", "twice"),
    (("rooms", 0, "name"), "door_2", "room_N"),
    (("rooms", 0, "name"), "kitchen", "room_N"),
    (("rooms", 0, "name"), 5, "name"),
    (("rooms", 0, "kind"), "kitchen", "room, corridor, hall"),
    (("rooms", 1, "polygon"), [[0, 0], [1, 1]], "fewer than 3"),
    (("rooms", 1, "polygon", 0), [0, 0, 0], "polygon"),
    (("rooms", 1, "polygon", 0), [0, True], "polygon"),
    (("rooms", 1, "polygon", 0, 1), 1e12, "polygon"),
    (("rooms", 1, "polygon"), None, "polygon"),
    (("rooms", 1, "holes"), None, "holes"),
    (("rooms", 1, "holes"), [[[0, 0], [1, 1]]], "rooms[1].holes[0]: has fewer than 3"),
    (("rooms", 1, "holes", 0, 2), [0, "1"], "rooms[1].holes[0]"),
    (("rooms", 1, "holes", 0), 3, "rooms[1].holes[0]"),
    (("rooms", 1, "area"), 0.0, "area"),
    (("rooms", 1, "area"), None, "area"),
    (("rooms", 1, "doors"), ["door_5"], "door_5"),
    (("rooms", 1, "doors"), [], "doors that name it"),
    (("rooms", 1, "neighbours"), [], "behind its doors"),
    (("rooms", 1, "neighbours"), [["room_2"]], "not in the file"),
    (("doors", 0, "name"), "door_5", "door_N with N up to 4"),
    (("doors", 0, "position"), [0.0], "position"),
    (("doors", 0, "jambs"), [[0.0, 1.0]], "jambs"),
    (("doors", 0, "width"), -0.1, "width"),
    (("doors", 0, "rooms"), ["room_2"], "doors[0].rooms: are not two regions"),
    (("doors", 0, "rooms"), ["room_2", "room_2"], "two regions"),
    (("doors", 0, "rooms"), ["room_2", "room_3"], "room_3"),
    (("doors", 0, "rooms"), "room_2", "rooms"),
]


def refused(folder, content):
    """The line with which a content of rooms.json is refused."""
    (folder / "rooms.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as error:
        rooms_file.read_rooms(folder)
    line = str(error.value)
    assert line.startswith(str(folder / "rooms.json")) and len(line.splitlines()) == 1
    return line


@pytest.mark.parametrize("keys, value, problem", WRONG)
def test_a_malformed_file_is_refused_in_one_line(written, keys, value, problem):
    content = json.loads((written / "rooms.json").read_text())
    *parents, last = keys
    place = content
    for key in parents:
        place = place[key]
    place[last] = value
    assert problem in refused(written, content)


def test_a_missing_key_is_refused_in_one_line(written):
    text = (written / "rooms.json").read_text()
    free = {"frame", "units", "colour"}  # for users, not read back
    free.add("holes")  # not in all files
    for path in ((), ("last_numbers",), ("rooms", 0), ("doors", 0)):
        whole = json.loads(text)
        place = whole
        for key in path:
            place = place[key]
        for key in place.keys() - free:
            whole = json.loads(text)
            place = whole
            for step in path:
                place = place[step]
            del place[key]
            assert key in refused(written, whole)


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"format": NaN}', "null", "\xff"])
def test_what_is_no_json_of_rooms_is_refused(tmp_path, text):
    (tmp_path / "rooms.json").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match="rooms.json"):
        rooms_file.read_rooms(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        rooms_file.read_rooms(tmp_path / "other.json")
