"""Rooms and doors of a map in two files, `rooms.json` and `rooms.png`.

    {"format": "jaxslam-rooms", "version": 1, "frame": "map", "units": "m, m^2",
     "last_numbers": {"room": N, "door": N},    highest that were ever in a name
     "resolution": [m], "origin": [x, y, yaw],  of the cells of the map [m, m, rad]
     "rooms": [{"name": "room_1", "kind": "room", "polygon": [[x, y], ...],
               "holes": [[[x, y], ...], ...] in it,   a file without is read, too
               "area": [m^2], "doors": [names], "neighbours": [names],
               "colour": [r, g, b] in rooms.png}],
     "doors": [{"name": "door_1", "position": [x, y], "jambs": [[x, y], [x, y]], "width": [m],
                "rooms": [names of the two]}]}

`rooms.png` has a pixel for each cell, like the picture of the map: its top row has the largest y.
Black is no region. Names and colours of regions stay from one session to the next.
"""

import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.core.maps import MAX_COORDINATE
from jaxslam.core.regions import REGION_KINDS, Door, Region, Regions
from jaxslam.io import strict_json
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace, write_json_rows
from jaxslam.io.room_colours import region_colours
from jaxslam.mapping.region_names import number_of

JSON_NAME, PNG_NAME = "rooms.json", "rooms.png"
FORMAT, VERSION = "jaxslam-rooms", 1
_ADVICE = "correct it, or remove the file to do without its rooms"


def write_rooms(folder: str | PathLike, regions: Regions) -> None:
    """Write rooms.json and rooms.png to a folder.

    Raises:
        InputError: A file cannot be written.
    """
    from PIL import Image

    colours = region_colours(regions)
    names = [region.name for region in regions.regions]
    doors = [door.name for door in regions.doors]
    content = {
        "format": FORMAT,
        "version": VERSION,
        "frame": "map",
        "units": "m, m^2",
        "last_numbers": dict(zip(("room", "door"), regions.last_numbers, strict=True)),
        "resolution": regions.resolution,
        "origin": regions.origin,
        "rooms": [
            {
                "name": region.name,
                "kind": region.kind,
                "polygon": np.round(region.polygon, 4),
                "holes": [np.round(hole, 4) for hole in region.holes],
                "area": round(region.area, 4),
                "doors": [doors[k] for k in region.doors],
                "neighbours": [names[k] for k in region.neighbours],
                "colour": colour,
            }
            for region, colour in zip(regions.regions, colours, strict=True)
        ],
        "doors": [
            {
                "name": door.name,
                "position": np.round(door.xy, 4),
                "jambs": np.round(door.jambs, 4),
                "width": round(door.width, 4),
                "rooms": [names[k] for k in door.regions],
            }
            for door in regions.doors
        ],
    }
    palette = np.concatenate([np.zeros((1, 3), np.uint8), colours])
    picture = Image.fromarray(np.ascontiguousarray(palette[regions.label.T[::-1]]))
    with replace(Path(folder) / PNG_NAME) as file:
        picture.save(file, format="PNG")
    write_json_rows(Path(folder) / JSON_NAME, content)


def read_rooms(path: str | PathLike) -> Regions:
    """Read rooms.json.

    Args:
        path: The file, or the folder that it is in.

    Returns:
        The regions; their label has no cells (0, 0).

    Raises:
        InputError: The file cannot be read, is of another kind or version, lacks a key, or a value
            is of the wrong type or out of range, or contradicts another one.
    """
    path = Path(path) / JSON_NAME if Path(path).is_dir() else Path(path)
    content = strict_json.read(path, _ADVICE)
    if content is None:
        advice = f"name a {JSON_NAME} written by `jaxslam map`"
        raise InputError("does not exist", path=path, advice=advice)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"is no {FORMAT} file", path=path, field="format", advice=_ADVICE)
    if content.get("version") != VERSION:
        problem = f"{str(content.get('version'))[:40]} instead of {VERSION}"
        raise InputError(problem, path=path, field="version", advice=_ADVICE)
    return _Reader(path).regions(content)


class _Reader:
    """Reader of the values of one file, which its errors name."""

    def __init__(self, path: Path):
        """Read from the file at `path`."""
        self._path = path

    def regions(self, content: dict[str, Any]) -> Regions:
        """The regions of the content of a file."""
        last = self._member(content, "last_numbers", dict, "")
        numbers = tuple(self._count(last, kind, "last_numbers") for kind in ("room", "door"))
        resolution = float(self._numbers(content, "resolution", (), ""))
        if resolution <= 0.0:
            self._refuse("is not positive", "resolution")
        rows = [self._items(content, key) for key in ("rooms", "doors")]
        names, door_names = (
            self._names(items, key, last)
            for items, key, last in zip(rows, ("rooms", "doors"), numbers, strict=True)
        )
        doors = tuple(self._door(item, f"doors[{k}]", names) for k, item in enumerate(rows[1]))
        regions = tuple(
            self._region(item, k, names, door_names, doors) for k, item in enumerate(rows[0])
        )
        origin = self._numbers(content, "origin", (3,), "")
        none = np.zeros((0, 0), np.int32)
        return Regions(none, regions, doors, resolution, origin, (numbers[0], numbers[1]))

    def _refuse(self, problem: str, field: str) -> None:
        raise InputError(problem, path=self._path, field=field, advice=_ADVICE)

    def _member(self, item: dict[str, Any], key: str, kind: type, where: str) -> Any:
        """A member of a type, bool and int apart."""
        value = item.get(key)
        if not isinstance(value, kind) or isinstance(value, bool):
            self._refuse(f"missing or no {kind.__name__}", f"{where}.{key}".lstrip("."))
        return value

    def _count(self, item: dict[str, Any], key: str, where: str) -> int:
        value = int(self._member(item, key, int, where))
        if not 0 <= value < 10**9:
            self._refuse("is not a number from 0 to 999999999", f"{where}.{key}")
        return value

    def _items(self, content: dict[str, Any], key: str) -> list[dict[str, Any]]:
        items = self._member(content, key, list, "")
        for k, item in enumerate(items):
            if not isinstance(item, dict):
                self._refuse("is no object", f"{key}[{k}]")
        return items

    def _numbers(
        self,
        item: dict[str, Any],
        key: str,
        shape: tuple[int, ...],
        where: str,
        most: float = MAX_COORDINATE,
    ) -> np.ndarray:
        """Finite numbers up to `most` as an array of a shape; -1 is any length."""
        field = f"{where}.{key}".lstrip(".")

        def check(value: Any, shape: tuple[int, ...]) -> None:
            if not shape:
                is_number = isinstance(value, int | float) and not isinstance(value, bool)
                if not is_number or not abs(value) <= most or not math.isfinite(value):
                    self._refuse(f"missing or no numbers up to {most:g}", field)
                return
            if not isinstance(value, list) or shape[0] not in (-1, len(value)):
                self._refuse(f"missing or no list of {shape[0]}".replace(" of -1", ""), field)
            for part in value:
                check(part, shape[1:])

        check(item.get(key), shape)
        return np.array(item[key], float).reshape(shape)

    def _ring(self, item: dict[str, Any], key: str, where: str) -> np.ndarray:
        """The corners (n >= 3, 2) of a closed line."""
        ring = self._numbers(item, key, (-1, 2), where)
        if len(ring) < 3:
            self._refuse("has fewer than 3 points", f"{where}.{key}")
        return ring

    def _names(self, items: Sequence[dict[str, Any]], key: str, last: int) -> dict[str, int]:
        """Index of each item by its name."""
        kind = "room" if key == "rooms" else "door"
        names: dict[str, int] = {}
        for k, item in enumerate(items):
            field = f"{key}[{k}].name"
            name = self._member(item, "name", str, f"{key}[{k}]")
            if not name.startswith(kind) or not 0 < number_of(name) <= last:
                self._refuse(f"{name[:40]!r} is no {kind}_N with N up to {last}", field)
            if name in names:
                self._refuse(f"{name!r} is there twice", field)
            names[name] = k
        return names

    def _named(
        self, item: dict[str, Any], key: str, where: str, names: dict[str, int]
    ) -> tuple[int, ...]:
        """Indices of the items that a list names."""
        found = []
        for name in self._member(item, key, list, where):
            if not isinstance(name, str) or name not in names:
                self._refuse(f"{str(name)[:40]!r} is not in the file", f"{where}.{key}")
            found.append(names[name])
        return tuple(found)

    def _door(self, item: dict[str, Any], where: str, names: dict[str, int]) -> Door:
        sides = self._named(item, "rooms", where, names)
        if len(sides) != 2 or sides[0] == sides[1]:
            self._refuse("are not two regions", f"{where}.rooms")
        width = float(self._numbers(item, "width", (), where))
        if width <= 0.0:
            self._refuse("is not positive", f"{where}.width")
        position = self._numbers(item, "position", (2,), where)
        jambs = self._numbers(item, "jambs", (2, 2), where)
        return Door(item["name"], position, jambs, width, (sides[0], sides[1]))

    def _region(
        self,
        item: dict[str, Any],
        index: int,
        names: dict[str, int],
        door_names: dict[str, int],
        doors: Sequence[Door],
    ) -> Region:
        where = f"rooms[{index}]"
        kind = self._member(item, "kind", str, where)
        if kind not in REGION_KINDS:
            self._refuse(f"is none of {', '.join(REGION_KINDS)}", f"{where}.kind")
        polygon = self._ring(item, "polygon", where)
        holes = self._member({"holes": [], **item}, "holes", list, where)
        rings = {f"holes[{k}]": hole for k, hole in enumerate(holes)}
        area = float(self._numbers(item, "area", (), where, MAX_COORDINATE**2))
        if area <= 0.0:
            self._refuse("is not positive", f"{where}.area")
        own = self._named(item, "doors", where, door_names)
        if sorted(own) != [k for k, door in enumerate(doors) if index in door.regions]:
            self._refuse("are not the doors that name it", f"{where}.doors")
        neighbours = self._named(item, "neighbours", where, names)
        if sorted(neighbours) != sorted({r for k in own for r in doors[k].regions} - {index}):
            self._refuse("are not the regions behind its doors", f"{where}.neighbours")
        cut_out = tuple(self._ring(rings, key, where) for key in rings)
        return Region(item["name"], kind, polygon, area, own, neighbours, cut_out)
