"""Walls as GeoJSON lines and polygons, or as CSV of segments."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.io import strict_json, text
from jaxslam.io.drawing import Drawing, joined, layers_note, size_of_unit, unit_missing
from jaxslam.io.errors import InputError

ENDS = ("x1", "y1", "x2", "y2")
THICKNESS = "thickness"
MIN_SPAN = 1.0  # of coordinates in metres; of degrees it would be 50 km or more
LINES = {"LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3}
"""Geometries that are walls: how deep their lines are nested."""
DEGREES = re.compile(r"CRS:?84|:(4326|4979|4269|4258)\b")
MERCATOR = re.compile(r":(3857|3785|900913)\b")
UTM = re.compile(r":32[67](0[1-9]|[1-5]\d|60)\b")
GEOJSON_ADVICE = "name GeoJSON of lines or polygons"


def read_geojson(
    path: Path, unit: str | float | None = None, layers: Sequence[str] = ()
) -> Drawing:
    """Read lines and rings of polygons, in metres unless `unit` says otherwise.

    Args:
        path: GeoJSON file.
        unit: Of its coordinates; by default that of its coordinate reference system, or metres.
        layers: Values of the property `layer` of features to read; empty for all.

    Raises:
        InputError: It cannot be read, its coordinates are or may be degrees, or it is a route
            graph, whose lines are no walls.
    """
    content = strict_json.read(path, GEOJSON_ADVICE)
    if content is None:
        raise InputError("does not exist", path=path, advice="check the name")
    left_out: Counter[str] = Counter()
    found: list[tuple[str, np.ndarray]] = []
    for where, layer, geometry in geometries(path, content):
        if geometry is None:
            left_out["features without geometry"] += 1
            continue
        kind = geometry.get("type")
        if kind in ("Point", "MultiPoint"):
            left_out["points"] += 1
            continue
        if kind not in LINES:
            problem = f"{kind!r:.40} is no geometry of GeoJSON"
            raise InputError(problem, path=path, field=where, advice=GEOJSON_ADVICE)
        for line in lines_of(path, where, geometry.get("coordinates"), LINES[kind]):
            if "Polygon" in kind and (line[0] != line[-1]).any():
                line = np.concatenate([line, line[:1]])
            found.append((layer, line))
    counted: Counter[str] = Counter()
    for layer, line in found:
        counted[layer] += len(line) - 1
    notes = [layers_note(counted, layers, path)]
    kept = [line for layer, line in found if not layers or layer in layers]
    points = np.concatenate([line for _, line in found]) if found else np.zeros((0, 2))
    size, note = unit_of(path, content, points, unit)
    notes.append(note)
    return Drawing(size * joined(kept), left_out, tuple(filter(None, notes)))


def geometries(path: Path, content: Any) -> Iterator[tuple[str, str, dict | None]]:
    """Place in the file, layer and object of each geometry; None for a feature without one."""
    stack: list[tuple[str, str, Any]] = [("", "", content)]
    while stack:
        where, layer, item = stack.pop()
        field = where or None
        if not isinstance(item, dict) or not isinstance(item.get("type"), str):
            problem = "is no object of GeoJSON, with a type"
            raise InputError(problem, path=path, field=field, advice=GEOJSON_ADVICE)
        if where and item.get("crs") is not None:
            problem, advice = "has a crs of its own", "give one, at the top of the file"
            raise InputError(problem, path=path, field=field, advice=advice)
        lists = {"FeatureCollection": "features", "GeometryCollection": "geometries"}
        if item["type"] in lists:
            name = lists[item["type"]]
            parts = item.get(name)
            if not isinstance(parts, list):
                raise InputError(f"has no list {name}", path=path, field=field)
            place = f"{where}.{name}" if where else name
            stack += [(f"{place}[{k}]", layer, part) for k, part in enumerate(parts)][::-1]
        elif item["type"] == "Feature":
            named = item.get("properties") or {}
            if isinstance(named, dict) and {"startid", "endid"} <= named.keys():
                problem = "is an edge of a route graph, which is no wall"
                advice = "name the map of the walls, of `jaxslam map` and `run` map.yaml"
                raise InputError(problem, path=path, field=field, advice=advice)
            keys = [key for key in named if str(key).lower() == "layer"]
            layer = str(named[keys[0]]) if keys else layer
            if item.get("geometry") is None:
                yield where, layer, None
            else:
                stack.append((f"{where}.geometry".lstrip("."), layer, item["geometry"]))
        else:
            yield f"{where}.coordinates".lstrip("."), layer, item


def lines_of(path: Path, where: str, coordinates: Any, depth: int) -> Iterator[np.ndarray]:
    """Lines (n, 2) of coordinates nested `depth` deep."""
    if not isinstance(coordinates, list):
        raise InputError("are no list", path=path, field=where, advice=GEOJSON_ADVICE)
    if depth > 1:
        for k, part in enumerate(coordinates):
            yield from lines_of(path, f"{where}[{k}]", part, depth - 1)
        return
    for k, point in enumerate(coordinates):
        numbers = isinstance(point, list) and len(point) >= 2
        if not numbers or not all(type(value) in (int, float) for value in point[:2]):
            problem = f"{point!r:.40} is no position x, y"
            raise InputError(problem, path=path, field=f"{where}[{k}]", advice=GEOJSON_ADVICE)
    if len(coordinates) < 2:
        raise InputError("has less than two positions", path=path, field=where)
    yield np.array([point[:2] for point in coordinates], float)


def unit_of(
    path: Path,
    content: Any,
    points: np.ndarray,
    unit: str | float | None,
    *,
    has_option: bool = True,
) -> tuple[float, str]:
    """Length [m] of a unit of the coordinates (n, 2), and a note on it.

    Args:
        path: GeoJSON file.
        content: Of it.
        points: Its coordinates.
        unit: Of them, as it is given; None: not given.
        has_option: Whether the file is one for which a user can give it.

    Raises:
        InputError: They are or may be degrees, or their unit is not known.
    """
    advice = "project it to metres first, as by geopandas: data.to_crs(data.estimate_utm_crs())"
    crs = content.get("crs")
    name = str(crs.get("properties", {}).get("name", crs) if isinstance(crs, dict) else crs)[:80]
    if crs is not None:
        if DEGREES.search(name):
            problem = f"{name} has degrees of longitude and latitude, no metres"
            raise InputError(problem, path=path, field="crs", advice=advice)
        if MERCATOR.search(name):
            problem = f"{name} (Web Mercator) has lengths that grow with the latitude"
            raise InputError(problem, path=path, field="crs", advice=advice)
    if unit is not None:
        return size_of_unit(unit), ""
    if crs is not None and not UTM.search(name):
        problem = f"the unit of its coordinate reference system {name} is not known"
        if not has_option:
            advice = f"leave crs out if it has metres, or {advice}"
            raise InputError(problem, path=path, field="crs", advice=advice)
        raise unit_missing(path, problem)
    if crs is None and len(points) and np.ptp(points, axis=0).max() < MIN_SPAN:
        problem = f"spans less than {MIN_SPAN:g} and may have degrees of longitude and latitude"
        advice += "; or add --unit m if it has metres" if has_option else ", or write CSV of metres"
        raise InputError(problem, path=path, advice=advice)
    return 1.0, "" if crs is not None else "coordinates are taken as metres"


def read_csv(path: Path, unit: str | float | None = None) -> Drawing:
    """Read a table of wall segments, one a line, in metres unless `unit` says otherwise.

    Args:
        path: Text with four columns x1, y1, x2, y2 parted by commas, semicolons, tabs or spaces;
            `#` starts a comment line. A first line of names may give another order and further
            columns. Of these `thickness` makes a segment a rectangle around it.
        unit: Of all numbers.

    Raises:
        InputError: It cannot be read, or a line has not the columns or no finite numbers.
    """
    size = 1.0 if unit is None else size_of_unit(unit)
    names: list[str] | None = None
    advice = f"a line is {', '.join(ENDS)}"
    numbers, values = [], []
    for number, line in text.lines(path):
        fields = split_fields(line)
        if not fields or fields[0].startswith(b"#"):
            continue
        if names is None:
            words = [field.decode("utf-8", "replace").strip("\"' ").lower() for field in fields]
            if any(word in ENDS for word in words):
                missing = [name for name in ENDS if name not in words]
                if missing or len(set(words)) < len(words):
                    problem = f"no column {missing[0]}" if missing else "a column twice"
                    raise InputError(problem, path=path, line=number, advice=advice)
                names = words
                continue
            names = [*ENDS]
        numbers.append(number)
        values.append(numbers_of(path, number, fields, names, advice))
    if not values or names is None:
        raise InputError("holds no wall", path=path, advice=advice)
    table = size * np.array(values)
    walls = table[:, [names.index(name) for name in ENDS]]
    other = [name for name in names if name not in (*ENDS, THICKNESS)]
    notes = [f"columns not read: {', '.join(other)}"] if other else []
    notes += ["numbers are taken as metres"] if unit is None else []
    if THICKNESS in names:
        thickness = table[:, names.index(THICKNESS)]
        if (thickness < 0.0).any():
            first = numbers[int((thickness < 0.0).argmax())]
            problem = "is below 0"
            raise InputError(
                problem, path=path, line=first, field=THICKNESS, advice="give 0 or more"
            )
        walls = _faces(walls, thickness)
    return Drawing(walls, {}, tuple(notes))


def split_fields(line: bytes) -> list[bytes]:
    """Fields of a line of text, parted by semicolons, else commas, else white space."""
    for mark in (b";", b","):
        if mark in line:
            return [field.strip() for field in line.split(mark)]
    return line.split()


def numbers_of(
    path: Path, line: int, fields: Sequence[bytes], names: Sequence[str], advice: str
) -> list[float]:
    """Finite numbers of the columns `names` of a line; 0 for columns that are not read.

    Raises:
        InputError: There are more or fewer fields, or one is no finite number.
    """
    if len(fields) != len(names):
        problem = f"{len(fields)} fields instead of {len(names)}"
        raise InputError(problem, path=path, line=line, advice=advice)
    values = []
    for field, name in zip(fields, names, strict=True):
        is_read = name in (*ENDS, THICKNESS, "x", "y")
        if is_read and b"," in field:
            point = "write decimals with a point, not a comma"
            problem = f"{field.decode('utf-8', 'replace')!r:.40} is not a number"
            raise InputError(problem, path=path, line=line, field=name, advice=point)
        try:
            values.append(text.number(field, name) if is_read else 0.0)
        except InputError as error:
            raise InputError(str(error), path=path, line=line, advice=advice) from None
    return values


def _faces(walls: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """Sides (4 S, 4) of rectangles around walls (S, 4); those of no thickness stay as they are."""
    thin = ~(thickness > 0.0)
    start, end = walls[~thin, :2], walls[~thin, 2:]
    step = end - start
    length = np.maximum(np.hypot(*step.T), 1e-12)[:, None]
    normal = np.stack([-step[:, 1], step[:, 0]], axis=1) / length
    offset = 0.5 * thickness[~thin, None] * normal
    corners = np.stack([start - offset, end - offset, end + offset, start + offset], axis=1)
    sides = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2)
    return np.concatenate([walls[thin], sides.reshape(-1, 4)])
