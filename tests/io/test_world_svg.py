"""Walls of SVG drawings: units, transforms, curves, what is hidden and what is left out."""

import numpy as np
import pytest

from jaxslam.io.drawing import CURVE_TOLERANCE
from jaxslam.io.errors import InputError
from jaxslam.io.world_files import read_world

pytest.importorskip("svgelements", reason="pip install 'jaxslam[cad]'")

NAMES = (
    'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
    'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape"'
)


def svg(folder, body, page='viewBox="0 0 20 10"'):
    file = folder / "plan.svg"
    file.write_text(f"<svg {NAMES} {page}>{body}</svg>")
    return file


def walls(folder, body, page='viewBox="0 0 20 10"', unit="m", **options):
    return read_world(svg(folder, body, page), unit=unit, **options).world.walls


def test_y_is_up_from_the_lower_left_corner_of_the_page(tmp_path):
    body = '<line x1="2" y1="1" x2="8" y2="4"/><polygon points="3,3 5,3 5,6"/>'
    expected = [[2, 9, 8, 6], [3, 7, 5, 7], [5, 7, 5, 4], [5, 4, 3, 7]]
    np.testing.assert_allclose(walls(tmp_path, body), expected)
    moved = walls(tmp_path, body, 'viewBox="-5 2 20 10"')
    np.testing.assert_allclose(moved, np.array(expected) + [5, 2, 5, 2])
    np.testing.assert_allclose(walls(tmp_path, body, "")[0], [2, -1, 8, -4])  # no page at all


@pytest.mark.parametrize(
    "page, unit, size",
    [
        ('viewBox="0 0 20 10"', "ft", 0.3048),
        ('viewBox="0 0 20 10" width="200mm" height="100mm"', "0.5", 0.5),
        ('viewBox="0 0 20 10" width="777" height="100"', "m", 1.0),  # the page has margins
        ('viewBox="0 0 20 10" width="400cm" height="200cm"', None, 0.2),
        ('width="20in" height="10in"', "in", 0.0254),  # units are pixels
        ('viewBox="0 0 2000 1000" width="2834.64567pt"', None, 0.0005),
        ('viewBox="0 0 2000 1000" height="50cm" width="100%"', None, 0.0005),
    ],
)
def test_units_are_of_the_drawing_or_of_the_page(tmp_path, page, unit, size):
    body = '<line x1="1" y1="2" x2="7" y2="2"/><line x1="1" y1="2" x2="1" y2="10000"/>'
    found = walls(tmp_path, body, page, unit)
    assert found[0, 2] - found[0, 0] == pytest.approx(6 * size, rel=1e-5)
    assert found[0, 1] - found[0, 3] == pytest.approx(0, abs=1e-9)


def test_the_size_of_a_page_is_noted_and_one_of_paper_is_refused(tmp_path):
    body = '<line x1="0" y1="0" x2="20" y2="0"/>'
    page = 'viewBox="0 0 20 10" width="400cm" height="200cm"'
    (note,) = read_world(svg(tmp_path, body, page)).notes
    assert note == "the drawing is taken as large as its page, 4 m x 2 m"
    page = 'viewBox="0 0 20 10" width="200mm" height="100mm"'
    with pytest.raises(InputError, match="is 0.2 m x 0 m, not the size of a building.*--unit"):
        read_world(svg(tmp_path, body, page))
    for page in ("", 'viewBox="0 0 20 10"', 'width="100%"', 'width="600" height="300px"'):
        with pytest.raises(InputError, match=r"is a drawing without a unit; add --unit m\|cm\|mm"):
            read_world(svg(tmp_path, body, page))


def test_transforms_uses_and_nested_pages_are_applied(tmp_path):
    body = """
    <defs><g id="door"><line x1="0" y1="0" x2="1" y2="0"/></g></defs>
    <symbol id="wall"><path d="M0 0 V2"/></symbol>
    <g transform="translate(3 1)"><g transform="rotate(90) scale(2)">
      <line x1="0" y1="0" x2="1" y2="0"/></g></g>
    <use href="#door" x="5" y="2"/> <use xlink:href="#wall" x="7" y="3"/>
    <svg x="10" y="0" width="4" height="4" viewBox="0 0 2 2"><path d="m1 1 h1"/></svg>
    """
    expected = [[3, 9, 3, 7], [5, 8, 6, 8], [7, 7, 7, 5], [12, 8, 14, 8]]
    np.testing.assert_allclose(walls(tmp_path, body), expected, atol=1e-9)


BOX = "M4 1 H7 V2 H4 Z"
SHAPES = {
    "rect": ('<rect x="4" y="1" width="3" height="1" {}/>', f'<path d="{BOX}" {{}}/>'),
    "ellipse": (
        '<ellipse cx="5" cy="2" rx="2" ry="1" {}/>',
        '<path d="M7 2 A2 1 0 0 1 3 2 A2 1 0 0 1 7 2 Z" {}/>',
    ),
    "circle": (
        '<circle cx="5" cy="2" r="1" {}/>',
        '<path d="M6 2 A1 1 0 0 1 4 2 A1 1 0 0 1 6 2 Z" {}/>',
    ),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    "transform",
    [
        "rotate(30)",
        "rotate(0.25turn 5 2)",
        "rotate(180 5,2)",
        "skewX(20)",
        "scale(-1 1) translate(-9px)",
        "matrix(0-1 2 0 1 8)",
    ],
)
def test_a_shape_that_is_turned_is_where_its_path_is(tmp_path, shape, transform):
    """Of all shapes the paths alone are in the frame of the page in svgelements."""
    own, path = (
        walls(tmp_path, text.format(f'transform="{transform}"')).reshape(-1, 2)
        for text in SHAPES[shape]
    )
    tolerance = 2 * CURVE_TOLERANCE
    np.testing.assert_allclose(own.min(axis=0), path.min(axis=0), atol=tolerance)
    np.testing.assert_allclose(own.max(axis=0), path.max(axis=0), atol=tolerance)
    assert np.ptp(own, axis=0).min() > 0.9


@pytest.mark.parametrize(
    "shape, centre, radii",
    [
        ('<circle cx="9" cy="5" r="3"/>', (9, 5), (3, 3)),
        ('<ellipse cx="9" cy="5" rx="4" ry="2"/>', (9, 5), (4, 2)),
        ('<path d="M6 5 a3 3 0 0 1 6 0 a3 3 0 0 1 -6 0 z"/>', (9, 5), (3, 3)),
        ('<circle cx="1" cy="1" r="1" transform="translate(5 2) scale(4 2)"/>', (9, 6), (4, 2)),
    ],
)
def test_curves_are_within_the_tolerance(tmp_path, shape, centre, radii):
    found = (walls(tmp_path, shape) - np.tile(centre, 2)) / np.tile(radii, 2)
    ends, middles = found.reshape(-1, 2), 0.5 * (found[:, :2] + found[:, 2:])
    np.testing.assert_allclose(np.hypot(*ends.T), 1.0, atol=1e-6)
    assert (1.0 - np.hypot(*middles.T)).max() * max(radii) <= 1.1 * CURVE_TOLERANCE
    assert 20 < len(found) < 200
    np.testing.assert_array_equal(found[:-1, 2:], found[1:, :2])


def test_bezier_curves_are_within_the_tolerance(tmp_path):
    control = np.array([[1, 9], [2, -6], [9, 20], [12, 3]], float)
    body = f'<path d="M1 9 C {" ".join(f"{x:g} {y:g}" for x, y in control[1:])}"/>'
    found = walls(tmp_path, body) * [1, -1, 1, -1] + [0, 10, 0, 10]
    t = np.linspace(0, 1, 2001)[:, None]
    curve = (1 - t) ** 3 * control[0] + 3 * t * (1 - t) ** 2 * control[1]
    curve = curve + 3 * t**2 * (1 - t) * control[2] + t**3 * control[3]
    start, step = found[:, None, :2], (found[:, 2:] - found[:, :2])[:, None]
    share = np.clip(((curve - start) * step).sum(-1) / (step**2).sum(-1), 0, 1)
    distance = np.hypot(*np.moveaxis(start + share[..., None] * step - curve, -1, 0)).min(axis=0)
    assert 1e-4 < distance.max() <= CURVE_TOLERANCE
    assert len(found) < 100


def test_what_is_not_drawn_is_left_out_and_counted(tmp_path):
    body = """
    <style>.away {display: none}</style>
    <rect width="20" height="10" fill="white"/>
    <line x1="1" y1="1" x2="9" y2="1"/> <line x1="9" y1="1" x2="1" y2="1"/>
    <g style="display:none"><line x1="1" y1="2" x2="9" y2="2"/></g>
    <g visibility="hidden"><line x1="1" y1="3" x2="9" y2="3"/></g>
    <line class="away" x1="1" y1="4" x2="9" y2="4"/>
    <rect x="1" y="5" width="3" height="3" fill="none"/>
    <path d="M1 6 H9" stroke="red" fill="none" opacity="0"/>
    <marker id="m"><path d="M0 0 L5 5"/></marker> <mask><path d="M0 0 L6 5"/></mask>
    <clipPath id="c"><rect width="3" height="3"/></clipPath>
    <line x1="1" y1="7" x2="1" y2="7"/> <line x1="2" y1="7" x2="2.00001" y2="7"/>
    <use href="other.svg#door"/>
    <text x="1" y="1">Room <tspan>1</tspan></text> <image href="a.png" width="9" height="9"/>
    """
    found = read_world(svg(tmp_path, body), unit="m")
    np.testing.assert_allclose(found.world.walls, [[1, 9, 9, 9]])
    assert found.notes == (
        "left out: texts (1), images (1), uses of what is not in the file (1), pages (1), hidden "
        "shapes (5), lines of no length (2), duplicates (1)",
    )


def test_wide_strokes_and_clip_paths_are_noted(tmp_path):
    body = '<path d="M1 1 H9" fill="none" stroke="black" stroke-width=".2" clip-path="url(#c)"/>'
    clips, strokes = read_world(svg(tmp_path, body), unit="m").notes
    assert strokes.startswith("strokes, of up to 0.2 m, are read as their middle line")
    assert clips == "clip paths and masks are not applied: what they cut off is read, too"


def test_layers_can_be_picked(tmp_path):
    body = """
    <g inkscape:groupmode="layer" inkscape:label="walls" id="layer1"><g id="in">
      <line x1="1" y1="1" x2="9" y2="1"/></g></g>
    <g id="furniture"><rect x="1" y="2" width="3" height="3"/></g>
    <line x1="0" y1="9" x2="9" y2="9"/>
    """
    found = read_world(svg(tmp_path, body), unit="m")
    assert found.notes == (
        "walls are all lines of the layers 'furniture' (4), 'no layer' (1), 'walls' (1); --layers "
        "picks some of them",
    )
    np.testing.assert_allclose(walls(tmp_path, body, layers=["walls"]), [[1, 9, 9, 9]])
    with pytest.raises(InputError, match="--layers: 'wall' is no layer .* 'furniture', 'no layer'"):
        walls(tmp_path, body, layers=["wall"])


@pytest.mark.parametrize(
    "content, message",
    [
        ("", ":1: is no XML"),
        ("<svg>\n<g>\n</svg>", ":3: is no XML"),
        ("<html/>", "is XML of <html>, not of <svg>"),
        (b"\x1f\x8b8", "is compressed; unpack it"),
        (f"<svg {NAMES}/>", "holds no wall"),
        (f"<svg {NAMES}><path d='M0 0 L5 x'/></svg>", "has a shape that cannot be read"),
        (f"<svg {NAMES}><path d='L5 5 L6 6'/></svg>", "a path does not begin with M"),
        (f"<svg {NAMES}><line x1='1,5' x2='9'/></svg>", "<line> x1: '1,5' is malformed"),
        (f"<svg {NAMES}><line x1='5o' x2='9'/></svg>", "<line> x1: '5o' is malformed"),
        (f"<svg {NAMES}><polygon points='0,0 5,5 6'/></svg>", "points: '0,0 5,5 6' is malformed"),
        (f"<svg {NAMES}><polygon points='0,0 5,NaN'/></svg>", "points: '0,0 5,NaN' is malformed"),
        (
            f"<svg {NAMES}><g transform='turn(3)'/></svg>",
            r"<g> transform: 'turn\(3\)' is malformed",
        ),
        (
            f"<svg {NAMES}><path d='M0 0H9' transform='translate(1mm)'/></svg>",
            r"<path> transform: 'translate\(1mm\)' is malformed; write numbers without units",
        ),
        (
            f"<svg {NAMES}><g style='fill:none;transform: rotate(1 2)'/></svg>",
            r"<g> transform: 'rotate\(1 2\)' is malformed",
        ),
        (
            f"<svg {NAMES}><style>.a {{text-transform: none; transform: scale(50%)}}</style></svg>",
            r"<style> transform: 'scale\(50%\)' is malformed",
        ),
        (
            f"<svg {NAMES}><g transform='rotate(9)' transform-origin='5 5'/></svg>",
            "<g> transform-origin: '5 5' is not applied; write rotate",
        ),
        (f"<svg {NAMES}><g style='transform-origin: center'/></svg>", "origin: 'center' is not"),
        (f"<svg {NAMES}><use id='a' href='#a'/></svg>", "has groups or uses too deep"),
        (f"<svg {NAMES}><line x2='1e999' y2='2'/></svg>", "cannot be read|has coordinates beyond"),
        (
            f"<svg {NAMES} viewBox='0 0 2x 9'><line x2='9'/></svg>",
            "viewBox: '0 0 2x 9' is not x, y",
        ),
        (f"<svg {NAMES} width='0' viewBox='0 0 2 9'><line x2='9'/></svg>", "page without a size"),
        (
            f"<svg {NAMES} width='9' height='2' viewBox='0 0 2 9' preserveAspectRatio='none'/>",
            "viewBox: and the size of the page scale x and y unlike each other",
        ),
        (
            f"<svg {NAMES}><symbol id='a' viewBox='0 0 2 2'/><use href='#a'/></svg>",
            "uses the symbol 'a', which has a viewBox",
        ),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, content, message):
    file = tmp_path / "plan.svg"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=message) as error:
        read_world(file, unit="m")
    assert str(error.value).startswith(f"{file}") and "\n" not in str(error.value)
    with pytest.raises(InputError, match="does not exist"):
        read_world(tmp_path / "none.svg", unit="m")
