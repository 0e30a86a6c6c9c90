"""Walls and waypoints as GeoJSON and CSV."""

import json

import numpy as np
import pytest

from jaxslam.io import path_file
from jaxslam.io.errors import InputError
from jaxslam.io.world_files import read_world

ROOM = [[0, 0], [6, 0], [6, 4], [0, 4]]
CLOSED = [*ROOM, ROOM[0]]
SIDES = np.hstack([CLOSED[:-1], CLOSED[1:]]).astype(float)


def geojson(path, *geometries, **members):
    features = [
        {"type": "Feature", "properties": properties, "geometry": geometry}
        for geometry, properties in geometries
    ]
    content = {"type": "FeatureCollection", "features": features} | members
    path.write_text(json.dumps(content))
    return path


def line(points, kind="LineString"):
    return {"type": kind, "coordinates": points}


def crs(name):
    return {"type": "name", "properties": {"name": name}}


def test_lines_and_rings_of_polygons_are_walls(tmp_path):
    hole = [[1, 1], [2, 1], [2, 2], [1, 1]]
    collection = {"type": "GeometryCollection", "geometries": [line([[9, 9], [9, 8, 2.5]])]}
    file = geojson(
        tmp_path / "plan.geojson",
        (line([ROOM, hole], "Polygon"), {"layer": "walls"}),
        (line([[[7, 7], [8, 7]], [[7, 6], [8, 6]]], "MultiLineString"), None),
        (line([1, 1], "Point"), {}),
        (None, {}),
        (collection, {"Layer": "more"}),
    )
    found = read_world(file)
    hole_sides = [[1, 1, 2, 1], [2, 1, 2, 2], [2, 2, 1, 1]]
    lines = [[7, 7, 8, 7], [7, 6, 8, 6], [9, 9, 9, 8]]
    np.testing.assert_array_equal(found.world.walls, np.vstack([SIDES, hole_sides, lines]))
    assert found.notes == (
        "walls are all lines of the layers 'walls' (7), '' (2), 'more' (1); --layers picks some "
        "of them",
        "coordinates are taken as metres",
        "left out: points (1), features without geometry (1)",
    )
    picked = read_world(file, layers=["walls", "more"], unit="ft")
    np.testing.assert_allclose(picked.world.walls[-1], 0.3048 * np.array(lines[-1]))
    assert len(picked.world.walls) == 8


def test_coordinates_far_from_the_origin_are_moved(tmp_path):
    far = np.array(CLOSED) + [691000.5, 5334000.25]
    name = "urn:ogc:def:crs:EPSG::25832"
    file = geojson(tmp_path / "plan.json", (line(far.tolist()), None), crs=crs(name))
    with pytest.raises(InputError, match=f"{name} is not known; add --unit m"):
        read_world(file)
    geojson(file, (line(far.tolist()), None), crs=crs("EPSG:32632"))
    found = read_world(file)
    np.testing.assert_array_equal(found.origin, [691000.0, 5334000.0])
    np.testing.assert_allclose(found.world.walls, SIDES + [0.5, 0.25, 0.5, 0.25])
    assert found.notes == ("the origin of the world is x 691000, y 5334000 m of the file",)


@pytest.mark.parametrize(
    "name, message",
    [
        ("urn:ogc:def:crs:OGC:1.3:CRS84", "has degrees of longitude and latitude"),
        ("EPSG:4326", "has degrees of longitude and latitude"),
        ("EPSG:3857", "has lengths that grow with the latitude"),
    ],
)
def test_degrees_are_refused(tmp_path, name, message):
    file = geojson(tmp_path / "plan.geojson", (line(CLOSED), None), crs=crs(name))
    with pytest.raises(InputError, match=f"crs: .*{message}.*project it to metres first"):
        read_world(file, unit="m")


def test_what_may_be_degrees_needs_a_unit(tmp_path):
    near = (np.array(CLOSED) * 1e-4 + [11.5, 48.1]).tolist()
    file = geojson(tmp_path / "plan.geojson", (line(near), None))
    with pytest.raises(InputError, match=r"plan.geojson: spans less than 1 and may have degrees"):
        read_world(file)
    with pytest.raises(InputError, match=r"is 0.0006 m x 0.0004 m, not the size of a building"):
        read_world(file, unit="m")


@pytest.mark.parametrize("name", ["plan.csv", "plan.geojson"])
def test_a_building_of_kilometres_needs_a_unit(tmp_path, name):
    """As a file in millimetres would be, of which nothing says so."""
    file = tmp_path / name
    walls = 1000.0 * np.array(SIDES)
    if name == "plan.csv":
        file.write_text("\n".join(",".join(map(str, row)) for row in walls))
    else:
        geojson(file, (line((1000.0 * np.array(CLOSED)).tolist()), None))
    with pytest.raises(InputError, match="is 6e.03 m x 4e.03 m, not the size of a building.*unit"):
        read_world(file)
    np.testing.assert_allclose(read_world(file, unit="mm").world.walls, SIDES)
    np.testing.assert_allclose(read_world(file, unit="m").world.walls, walls)


@pytest.mark.parametrize(
    "content, message",
    [
        ("{", r":1: is not JSON"),
        ('{"type": "LineString", "type": "Point"}', "has the key 'type' twice"),
        ("[1]", "is no object of GeoJSON"),
        (
            '{"type": "Feature", "geometry": {"type": "Point", "crs": {"a": 1}}}',
            "geometry: has a crs of its own; give one, at the top of the file",
        ),
        ('{"type": "Topology"}', "coordinates: 'Topology' is no geometry"),
        ('{"type": "FeatureCollection"}', "has no list features"),
        ('{"type": "LineString", "coordinates": [[0, 0], [1]]}', r"coordinates\[1\]: \[1\] is no"),
        ('{"type": "LineString", "coordinates": [[0, 0], [true, 1]]}', r"\[1\]: \[True, 1\] is no"),
        ('{"type": "LineString", "coordinates": [[0, 0]]}', "has less than two positions"),
        ('{"type": "Polygon", "coordinates": {}}', "coordinates: are no list"),
        ('{"type": "LineString", "coordinates": [[0, 0], [1e12, 1]]}', "beyond 1e"),
        ('{"type": "Point", "coordinates": [0, 0]}', r"holds no wall; left out: points \(1\)"),
        (
            '{"type": "Feature", "geometry": null, "properties": {"startid": 1, "endid": 2}}',
            "is an edge of a route graph, which is no wall",
        ),
    ],
)
def test_bad_geojson_is_refused_in_one_line(tmp_path, content, message):
    file = tmp_path / "plan.geojson"
    file.write_text(content)
    with pytest.raises(InputError, match=message) as error:
        read_world(file)
    assert str(error.value).startswith(f"{file}") and "\n" not in str(error.value)


@pytest.mark.parametrize("mark", [",", ";", "\t", "  ", ", "])
def test_csv_of_walls(tmp_path, mark):
    file = tmp_path / "walls.csv"
    file.write_text("# a room\n\n" + "\n".join(mark.join(map(str, row)) for row in SIDES))
    found = read_world(file)
    np.testing.assert_array_equal(found.world.walls, SIDES)
    assert found.notes == ("numbers are taken as metres",)
    given = read_world(file, unit="2")
    np.testing.assert_allclose(given.world.walls, 2 * SIDES)
    assert given.notes == ()


def test_csv_with_names_and_a_thickness(tmp_path):
    file = tmp_path / "walls.csv"
    file.write_text('"x1",y1,name,X2,y2,thickness\n100,0,a,700,0,20\n0,0,b,0,400,0\n0,400,b,0,0,0')
    found = read_world(file, unit="cm")
    faces = [[1, -0.1, 7, -0.1], [7, -0.1, 7, 0.1], [7, 0.1, 1, 0.1], [1, 0.1, 1, -0.1]]
    np.testing.assert_allclose(found.world.walls, [[0, 0, 0, 4], *faces])
    assert found.notes == ("columns not read: name", "left out: duplicates (1)")


@pytest.mark.parametrize(
    "content, message",
    [
        ("", "is empty"),
        ("# only\n", "holds no wall; a line is x1, y1, x2, y2"),
        ("1,2,3,4\n1,2,3\n", ":2: 3 fields instead of 4; a line is x1, y1, x2, y2"),
        ("1,2,3,nan\n", ":1: y2: nan is not finite"),
        ("a,b,c,d\n", ":1: x1: 'a' is not a number"),
        ("x1,y1,x2\n1,2,3\n", ":1: no column y2"),
        ("x1,y1,x2,y2,x1\n1,2,3,4,5\n", ":1: a column twice"),
        ("0;0;1,5;2\n", ":1: x2: '1,5' is not a number; write decimals with a point"),
        ("x1,y1,x2,y2,thickness\n0,0,9,0,1\n0,0,9,1,-1\n", ":3: thickness: is below 0"),
        ("0,0,1e300,0\n", "has coordinates beyond"),
        ("0,0,0,0\n", r"holds no wall; left out: lines of no length \(1\)"),
        ("0,0,1e6,0\n", "is 1e.06 m x 0 m, not the size of a building"),
    ],
)
def test_bad_csv_is_refused_in_one_line(tmp_path, content, message):
    file = tmp_path / "walls.csv"
    file.write_text(content)
    with pytest.raises(InputError, match=message) as error:
        read_world(file)
    assert str(error.value).startswith(f"{file}") and "\n" not in str(error.value)


def test_waypoints_are_read(tmp_path):
    table = tmp_path / "path.csv"
    table.write_text("x,y\n" + "\n".join(f"{x};{y}" for x, y in ROOM))
    np.testing.assert_array_equal(path_file.read(table), ROOM)
    file = geojson(tmp_path / "path.geojson", (line(ROOM), None), (line([1, 1], "Point"), None))
    np.testing.assert_array_equal(path_file.read(file), ROOM)


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("p.csv", "1,2\n1,2,3\n", ":2: 3 fields instead of 2; name CSV of x,y"),
        ("p.csv", "x,y\n1,2\n", "is a path shorter than 0.5 m"),
        ("p.csv", "1,2\n1,inf\n", ":2: y: inf is not finite"),
        ("p.csv", "y,x\n1,2\n", ":1: x: 'y' is not a number"),
        ("p.csv", "1,2\n1e9,2\n", "has coordinates beyond 1e.07 m"),
        ("p.geojson", '{"type": "Point", "coordinates": [1, 2]}', "has 0 LineStrings, not one"),
        (
            "p.geojson",
            json.dumps(line([[8.0, 48.0], [8.0, 48.5]])),
            "may have degrees of .*, or write CSV of metres$",
        ),
        (
            "p.geojson",
            json.dumps(line([[1, 2], [1, 4]]) | {"crs": crs("EPSG:25832")}),
            "crs: the unit .* EPSG:25832 is not known; leave crs out if it has metres",
        ),
        ("none.geojson", None, "does not exist"),
        ("none.csv", None, "does not exist"),
    ],
)
def test_bad_waypoints_are_refused(tmp_path, name, content, message):
    file = tmp_path / name
    if content is not None:
        file.write_text(content)
    with pytest.raises(InputError, match=message) as error:
        path_file.read(file)
    assert str(error.value).startswith(f"{file}")
