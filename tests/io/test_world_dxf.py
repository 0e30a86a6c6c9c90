"""Walls of DXF drawings: units, blocks, layers, curves, widths and what is left out."""

import numpy as np
import pytest

from jaxslam.io.drawing import CURVE_TOLERANCE
from jaxslam.io.errors import InputError
from jaxslam.io.world_files import read_world

ezdxf = pytest.importorskip("ezdxf", reason="pip install 'jaxslam[cad]'")

METRES, MILLIMETRES, FEET = 6, 4, 2


@pytest.fixture
def drawing():
    document = ezdxf.new(units=METRES)
    document.modelspace().add_line((0, 0), (9, 0))
    return document


def read(document, folder, **options):
    file = folder / "plan.dxf"
    document.saveas(file)
    return read_world(file, **options)


def rows(walls):
    """Walls as rows that do not depend on the order nor the direction."""
    ends = np.round(np.reshape(walls, (-1, 2, 2)), 6) + 0.0
    return sorted(tuple(map(tuple, sorted(pair.tolist()))) for pair in ends)


@pytest.mark.parametrize(
    "code, size", [(METRES, 1), (MILLIMETRES, 0.001), (FEET, 0.3048), (1, 0.0254)]
)
def test_the_unit_is_that_of_the_header(tmp_path, code, size):
    document = ezdxf.new(units=code)
    document.modelspace().add_line((0, 0, 1), (6 / size, 3 / size, 1))
    found = read(document, tmp_path)
    np.testing.assert_allclose(found.world.walls, [[0, 0, 6, 3]], rtol=1e-6)
    assert f"a unit is {size:g} m" in found.notes[0] and "as the header states" in found.notes[0]
    other = read(document, tmp_path, unit=str(2 * size))
    np.testing.assert_allclose(other.world.walls, [[0, 0, 12, 6]], rtol=1e-6)
    assert other.notes == (
        f"a unit is {2 * size:g} m by --unit, although the header states {size:g} m",
    )


def test_a_drawing_without_a_unit_needs_one(tmp_path, drawing):
    drawing.units = 0
    with pytest.raises(InputError, match=r"states no unit \(\$INSUNITS\); add --unit m\|cm"):
        read(drawing, tmp_path)
    with pytest.raises(InputError, match="is 0.09 m x 0 m, not the size of a building"):
        read(drawing, tmp_path, unit="cm")
    assert read(drawing, tmp_path, unit="m").notes == ()


def test_lines_of_all_kinds_are_walls(tmp_path, drawing):
    space = drawing.modelspace()
    space.add_lwpolyline([(0, 1), (2, 1), (2, 3)], close=True)
    space.add_polyline2d([(5, 5), (6, 5), (6, 6)])
    space.add_solid([(7, 7), (8, 7), (7, 8), (8, 8)])
    expected = [[0, 0, 9, 0], [0, 1, 2, 1], [2, 1, 2, 3], [2, 3, 0, 1], [5, 5, 6, 5], [6, 5, 6, 6]]
    expected += [[7, 7, 8, 7], [8, 7, 8, 8], [8, 8, 7, 8], [7, 8, 7, 7]]
    found = read(drawing, tmp_path)
    assert rows(found.world.walls) == rows(expected)
    assert len(found.notes) == 1
    space.add_polyline3d([(1, 1, 0), (1, 2, 3)])
    assert "heights are dropped: lines of all heights are walls" in read(drawing, tmp_path).notes


@pytest.mark.parametrize("kind", ["circle", "arc", "ellipse", "bulge", "mirrored"])
def test_curves_are_within_the_tolerance(tmp_path, kind):
    document = ezdxf.new(units=METRES)
    space, radii = document.modelspace(), np.array([3.0, 3.0])
    if kind == "circle":
        space.add_circle((0, 0), 3)
    elif kind == "arc":
        space.add_arc((0, 0), 3, 30, 250)
    elif kind == "ellipse":
        space.add_ellipse((0, 0), (3, 0), 0.5)
        radii = np.array([3.0, 1.5])
    elif kind == "bulge":
        space.add_lwpolyline([(-3, 0, 1), (3, 0, 1)], format="xyb", close=True)
    else:
        space.add_arc((0, 0), 3, 0, 90, dxfattribs={"extrusion": (0, 0, -1)})
    walls = read(document, tmp_path).world.walls / np.tile(radii, 2)
    middles = 0.5 * (walls[:, :2] + walls[:, 2:])
    np.testing.assert_allclose(np.hypot(*walls.reshape(-1, 2).T), 1.0, atol=5e-4)
    assert (1.0 - np.hypot(*middles.T)).max() * 3 <= 1.1 * CURVE_TOLERANCE
    if kind == "mirrored":  # about the y axis
        assert walls[:, 0].max() < 1e-9 and walls[:, 1].min() > -1e-9


def test_a_polyline_with_a_width_becomes_its_outline(tmp_path):
    document = ezdxf.new(units=METRES)
    space = document.modelspace()
    space.add_lwpolyline([(0, 0), (6, 0), (6, 4)], dxfattribs={"const_width": 0.2})
    expected = [[0, -0.1, 6.1, -0.1], [6.1, -0.1, 6.1, 4], [6.1, 4, 5.9, 4], [5.9, 4, 5.9, 0.1]]
    expected += [[5.9, 0.1, 0, 0.1], [0, 0.1, 0, -0.1]]
    assert rows(read(document, tmp_path).world.walls) == rows(expected)
    document = ezdxf.new(units=METRES)
    square = [(0, 0), (6, 0), (6, 4), (0, 4)]
    document.modelspace().add_lwpolyline(square, close=True, dxfattribs={"const_width": 0.2})
    rings = []
    for d in (0.1, -0.1):
        ring = np.array([(-d, -d), (6 + d, -d), (6 + d, 4 + d), (-d, 4 + d), (-d, -d)])
        rings.append(np.hstack([ring[:-1], ring[1:]]))
    assert rows(read(document, tmp_path).world.walls) == rows(np.vstack(rings))


def test_blocks_are_placed_and_repeated(tmp_path, drawing):
    block = drawing.blocks.new("DOOR")
    block.add_line((1, 0), (2, 0))
    outer = drawing.blocks.new("PAIR")
    outer.add_blockref("DOOR", (0, 1))
    space = drawing.modelspace()
    space.add_blockref("DOOR", (5, 5), dxfattribs={"rotation": 90, "xscale": 2, "yscale": 1})
    space.add_blockref("PAIR", (0, 0), dxfattribs={"xscale": -1})
    grid = {"row_count": 2, "column_count": 2, "row_spacing": 3, "column_spacing": 4}
    space.add_blockref("DOOR", (10, 10), dxfattribs=grid)
    expected = [[0, 0, 9, 0], [5, 7, 5, 9], [-1, 1, -2, 1]]
    expected += [[11 + x, 10 + y, 12 + x, 10 + y] for x in (0, 4) for y in (0, 3)]
    assert rows(read(drawing, tmp_path).world.walls) == rows(expected)


def test_hidden_layers_and_entities_are_left_out_and_counted(tmp_path, drawing):
    drawing.layers.add("OFF").off()
    drawing.layers.add("FROZEN").freeze()
    block = drawing.blocks.new("B")
    block.add_line((0, 1), (1, 1))  # on layer 0: that of the reference
    block.add_line((0, 2), (1, 2), dxfattribs={"layer": "WALL"})
    block.add_text("in a block")
    space = drawing.modelspace()
    space.add_line((0, 5), (1, 5), dxfattribs={"layer": "OFF"})
    space.add_line((0, 6), (1, 6), dxfattribs={"invisible": 1})
    space.add_blockref("B", (0, 0), dxfattribs={"layer": "FROZEN"})  # nothing of it is seen
    space.add_blockref("B", (3, 0), dxfattribs={"layer": "OFF"})  # but its lines on WALL
    space.add_text("Room")
    space.add_hatch()
    space.add_point((1, 1))
    space.add_line((4, 4), (4, 4))
    space.add_line((9, 0), (0, 0))
    found = read(drawing, tmp_path)
    assert rows(found.world.walls) == rows([[0, 0, 9, 0], [3, 2, 4, 2]])
    assert found.notes[1:] == (
        "walls are all lines of the layers '0' (3), 'WALL' (1); --layers picks some of them",
        "left out: invisible entities (1), texts (1), hatches (1), points (1), entities on layers "
        "that are hidden ('FROZEN', 'OFF') (4), lines of no length (1), duplicates (1)",
    )
    picked = read(drawing, tmp_path, layers=["WALL"])
    assert rows(picked.world.walls) == rows([[3, 2, 4, 2]])
    with pytest.raises(InputError, match="--layers: 'OFF' is no layer.*there are: '0', 'WALL'"):
        read(drawing, tmp_path, layers=["OFF"])


@pytest.mark.parametrize(
    "content, message",
    [
        (b"AC1032\0\0", "is a DWG file; save it as DXF in your CAD program"),
        (b"hello", "is no DXF file"),
        (b"", "is no DXF file"),
        (b"  0\nSECTION\n  2\nENTITIES\n  0\nLI", "is no DXF that can be read|states no unit"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, content, message):
    file = tmp_path / "plan.dxf"
    file.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        read_world(file)
    assert str(error.value).startswith(f"{file}") and "\n" not in str(error.value)
    with pytest.raises(InputError, match="does not exist"):
        read_world(tmp_path / "none.dxf")
