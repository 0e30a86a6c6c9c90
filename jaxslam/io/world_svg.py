"""Walls as lines and shapes of an SVG drawing; needs the extra `[cad]`, for svgelements."""

import io
import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.io.drawing import (
    CURVE_TOLERANCE,
    Drawing,
    joined,
    layers_note,
    no_library,
    size_of_unit,
    unit_missing,
)
from jaxslam.io.errors import InputError

SVG = "{http://www.w3.org/2000/svg}"
INKSCAPE = "{http://www.inkscape.org/namespaces/inkscape}"
CLIP = re.compile(r"(clip-path|mask)'?\s*:\s*'?\s*url")  # in an attribute or a style
PIXEL = 0.0254 / 96  # [m] of CSS
PHYSICAL = re.compile(r"\s*[+]?[\d.]+(e[+-]?\d+)?\s*(mm|cm|in|pt|pc)\s*$", re.IGNORECASE)
NOT_DRAWN = {f"{SVG}{tag}" for tag in ("symbol", "marker", "mask", "clipPath", "pattern")}
LEFT_OUT = {f"{SVG}text": "texts", f"{SVG}image": "images", f"{SVG}foreignObject": "other objects"}
WIDE = 0.02  # [m] of a stroke that may be a wall and not a pen
PAGE = 0.99  # of its width and height: a filled rectangle as large is the paper
MAX_BYTES = 2**26
ADVICE = "save it as plain SVG"


def read(path: Path, unit: str | float | None = None, layers: Sequence[str] = ()) -> Drawing:
    """Read the lines of a drawing: those of strokes in their middle, of filled shapes at the edge.

    The lower left corner of the page is the origin (of a page without a height the upper left one),
    y is up. Transforms, `viewBox` and `use` are
    applied; curves become segments within `CURVE_TOLERANCE`.

    Args:
        path: SVG file.
        unit: Of a unit of the drawing (of its `viewBox`); by default the page must have a width in
            mm, cm, in, pt or pc, and the drawing is as large as the page.
        layers: Inkscape's layers, or ids of groups, to read; empty for all.

    Raises:
        InputError: svgelements is not installed; the file cannot be read; or its unit is not known.
    """
    try:
        import svgelements
    except ImportError:
        raise no_library(path, "svgelements") from None
    tree = _tree(path)
    left_out = Counter(LEFT_OUT[item.tag] for item in tree.iter() if item.tag in LEFT_OUT)
    _hide_what_is_not_drawn(path, tree)
    try:
        source = io.StringIO(ET.tostring(tree, encoding="unicode"))
        root = svgelements.SVG.parse(source, parse_display_none=True, on_error="raise")
    except RecursionError:
        raise InputError("has groups or uses too deep", path=path, advice=ADVICE) from None
    except (ValueError, TypeError, IndexError, KeyError, AttributeError) as error:
        problem = f"has a shape that cannot be read ({str(error) or 'its path or a number'})"
        raise InputError(problem, path=path, advice=ADVICE) from None
    page = np.array([root.width, root.height], float)
    if not page.min() > 0.0:
        raise InputError("has a page without a size", path=path, field="width, height")
    scale = _pixels_of_a_unit(path, tree, root)
    if unit is not None:
        size = size_of_unit(unit) / scale
    elif PHYSICAL.match(tree.get("width", "")):
        size = PIXEL
    else:
        raise unit_missing(path, "is a drawing without a unit")
    counted: Counter[str] = Counter()
    lines, stroke = [], 0.0
    for layer, shape, is_hidden in _shapes(svgelements, root, "", False):
        if is_hidden:
            left_out["hidden shapes"] += 1
            continue
        if _is_paper(svgelements, shape, page):
            left_out["pages"] += 1
            continue
        found = list(_polylines(svgelements, shape, CURVE_TOLERANCE / size))
        counted[layer or "no layer"] += sum(len(line) - 1 for line in found)
        if not layers or layer in layers:
            lines += found
            if shape.stroke.value is not None:
                stroke = max(stroke, float(shape.stroke_width or 0.0) * size)
    notes = [layers_note(counted, layers, path)]
    if any(CLIP.search(f"{item.attrib}") for item in tree.iter()):
        notes.append("clip paths and masks are not applied: what they cut off is read, too")
    if stroke > WIDE:
        note = f"strokes, of up to {stroke:.2g} m, are read as their middle line; draw walls as "
        notes.append(f"{note}outlines (Inkscape: Path, Stroke to Path) for their thickness")
    if unit is None:
        width, height = page * size
        notes.append(f"the drawing is taken as large as its page, {width:.3g} m x {height:.3g} m")
    bottom = page[1] if tree.get("viewBox") or tree.get("height") else 0.0
    walls = joined(lines) * [1.0, -1.0, 1.0, -1.0] + [0.0, bottom, 0.0, bottom]
    return Drawing(walls * size, left_out, tuple(filter(None, notes)))


def _tree(path: Path) -> ET.Element:
    """The XML tree of a file."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check the name") from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path=path) from None
    if len(data) > MAX_BYTES:
        raise InputError(f"is larger than {MAX_BYTES >> 20} MiB", path=path, advice=ADVICE)
    if data[:2] == b"\x1f\x8b":
        raise InputError("is compressed", path=path, advice="unpack it: gunzip, and name it .svg")
    try:
        tree = ET.fromstring(data)
    except ET.ParseError as error:
        line = error.position[0]
        problem = f"is no XML ({error.msg.partition(':')[0]})"
        raise InputError(problem, path=path, line=line, advice=ADVICE) from None
    except (ValueError, LookupError):  # of its encoding
        raise InputError("is no XML", path=path, advice=ADVICE) from None
    if tree.tag == "svg":  # without its namespace
        for item in tree.iter():
            if isinstance(item.tag, str) and not item.tag.startswith("{"):
                item.tag = SVG + item.tag
    if tree.tag != f"{SVG}svg":
        problem = f"is XML of <{tree.tag.rpartition('}')[2]:.20}>, not of <svg>"
        raise InputError(problem, path=path, advice=ADVICE)
    return tree


def _hide_what_is_not_drawn(path: Path, tree: ET.Element) -> None:
    """Move elements that are drawn only where others refer to them into definitions.

    Raises:
        InputError: A symbol that is used has a `viewBox`, which svgelements does not apply.
    """
    used = {
        value.removeprefix("#")
        for item in tree.iter(f"{SVG}use")
        for key, value in item.attrib.items()
        if key.endswith("href")
    }
    for item in tree.iter(f"{SVG}symbol"):
        if item.get("id") in used and item.get("viewBox"):
            problem = f"uses the symbol {item.get('id')!r:.40}, which has a viewBox"
            advice = "convert symbols to groups (Inkscape: Object, Symbols), or remove them"
            raise InputError(problem, path=path, advice=advice)
    for parent in list(tree.iter()):
        if parent.tag == f"{SVG}defs":
            continue
        for k, item in enumerate(parent):
            if item.tag in NOT_DRAWN:
                parent[k] = ET.Element(f"{SVG}defs")
                parent[k].append(item)


def _pixels_of_a_unit(path: Path, tree: ET.Element, root: Any) -> float:
    """Pixels of a unit of the drawing, by the page's `viewBox`."""
    import svgelements

    box = tree.get("viewBox")
    if box is None:
        return 1.0
    try:
        _, _, width, height = map(float, box.replace(",", " ").split())
    except ValueError:
        width = height = math.nan
    if not (0.0 < width < math.inf and 0.0 < height < math.inf):
        problem = f"{box!r:.40} is not x, y and a width and height above 0"
        raise InputError(problem, path=path, field="viewBox", advice=ADVICE)
    page = svgelements.Matrix(root.viewbox_transform)
    x, y = float(page.a), float(page.d)
    if not abs(x - y) <= 1e-6 * x:
        problem = "and the size of the page scale x and y unlike each other"
        advice = "leave preserveAspectRatio out"
        raise InputError(problem, path=path, field="viewBox", advice=advice)
    return x


def _shapes(
    svgelements: Any, group: Any, layer: str, is_hidden: bool
) -> Iterator[tuple[str, Any, bool]]:
    """Layer of each shape below a group, the shape, and whether it is hidden."""
    for item in group:
        own = item.values.get("attributes", {})
        hidden = is_hidden or str(item.values.get("display", "")).lower() == "none"
        if isinstance(item, svgelements.Group):
            inside = layer
            if own.get(f"{INKSCAPE}groupmode") == "layer":
                inside = own.get(f"{INKSCAPE}label") or own.get("id") or layer
            elif not layer:
                inside = own.get("id") or ""
            yield from _shapes(svgelements, item, inside, hidden)
        elif isinstance(item, svgelements.Shape):
            hidden |= str(item.values.get("visibility", "")).lower() in ("hidden", "collapse")
            hidden |= str(item.values.get("opacity", "1")).strip() in ("0", "0.0", "0%")
            is_line = isinstance(item, svgelements.SimpleLine)
            unpainted = item.stroke.value is None and item.fill.value is None and not is_line
            yield layer, item, hidden or unpainted


def _is_paper(svgelements: Any, shape: Any, page: np.ndarray) -> bool:
    """Whether a shape is a filled rectangle that covers the page."""
    if not isinstance(shape, svgelements.Rect) or shape.stroke.value is not None:
        return False
    box = shape.bbox()
    return box is not None and bool((np.subtract(box[2:], box[:2]) >= PAGE * page).all())


def _polylines(svgelements: Any, shape: Any, tolerance: float) -> Iterator[np.ndarray]:
    """Polylines (n, 2) [px] of a shape, within a tolerance [px] of its curves."""
    points: list[tuple[float, float]] = []
    for part in svgelements.Path(shape):
        if isinstance(part, svgelements.Move):
            if len(points) > 1:
                yield np.array(points)
            points = [(part.end.x, part.end.y)]
            continue
        if not points:
            points = [(part.start.x, part.start.y)]
        count = _pieces(svgelements, part, tolerance)
        points += [(p.x, p.y) for p in (part.point(k / count) for k in range(1, count))]
        points.append((part.end.x, part.end.y))
    if len(points) > 1:
        yield np.array(points)


def _pieces(svgelements: Any, part: Any, tolerance: float) -> int:
    """Number of segments for a part of a path.

    References:
        Wang, Shen, Zheng (1984): a Bezier curve of degree n with second differences of its control
        points of M at most is within n (n - 1) M / (8 k^2) of k segments at equal parameters.
    """
    if isinstance(part, svgelements.Arc):
        radius = max(part.rx, part.ry)
        if not radius > tolerance:
            return 4
        step = 2.0 * math.acos(1.0 - tolerance / radius)
        return max(1, math.ceil(abs(float(part.sweep)) / step))
    if isinstance(part, svgelements.QuadraticBezier):
        control = [part.start, part.control, part.end]
    elif isinstance(part, svgelements.CubicBezier):
        control = [part.start, part.control1, part.control2, part.end]
    else:
        return 1
    bend = np.diff(np.array([(p.x, p.y) for p in control]), 2, axis=0)
    degree = len(control) - 1
    furthest = float(np.hypot(*bend.T).max())
    return max(1, math.ceil(math.sqrt(degree * (degree - 1) * furthest / (8.0 * tolerance))))
