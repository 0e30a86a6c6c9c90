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

from jaxslam.io import svg_tree
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
from jaxslam.io.svg_paths import polylines_of
from jaxslam.io.svg_tree import ADVICE, LENGTH, SVG

INKSCAPE = "{http://www.inkscape.org/namespaces/inkscape}"
CLIP = re.compile(r"(clip-path|mask)'?\s*:\s*'?\s*url")  # in an attribute or a style
PIXEL = 0.0254 / 96  # [m] of CSS
PHYSICAL = {"mm", "cm", "in", "pt", "pc"}
"""Units of length of a page that are no pixels."""
LEFT_OUT = {f"{SVG}text": "texts", f"{SVG}image": "images", f"{SVG}foreignObject": "other objects"}
WIDE = 0.02  # [m] of a stroke that may be a wall and not a pen
PAGE = 0.99  # of its width and height: a filled rectangle as large is the paper


def read(path: Path, unit: str | float | None = None, layers: Sequence[str] = ()) -> Drawing:
    """Read the lines of a drawing: those of strokes in their middle, of filled shapes at the edge.

    The lower left corner of the page is the origin (of a page without a height the upper left one),
    y is up. Transforms, `viewBox` and `use` are applied; curves become segments within
    `CURVE_TOLERANCE`.

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
    tree = svg_tree.read(path)
    left_out = Counter(LEFT_OUT[item.tag] for item in tree.iter() if item.tag in LEFT_OUT)
    left_out += svg_tree.missing_uses(tree)
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
    elif (length := LENGTH.match(tree.get("width", ""))) and length[2].lower() in PHYSICAL:
        size = PIXEL
    else:
        raise unit_missing(path, "is a drawing without a unit")
    counted: Counter[str] = Counter()
    lines, stroke = [], 0.0
    for layer, shape, is_hidden in _shapes(svgelements, root, "", False):
        if is_hidden:
            left_out["hidden shapes"] += 1
            continue
        try:
            found = list(polylines_of(shape, CURVE_TOLERANCE / size))
        except ValueError as error:
            problem = f"has a shape that cannot be read ({error})"
            raise InputError(problem, path=path, advice=ADVICE) from None
        if _is_paper(svgelements, shape, page):
            left_out["pages"] += 1
            continue
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
        if isinstance(item, (svgelements.Group, svgelements.Use)):
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
