"""Walls as lines of a DXF drawing; needs the extra `[cad]`, for ezdxf."""

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

FLAT = {"LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE", "HELIX"}
FLAT |= {"SOLID", "TRACE", "3DFACE"}
"""Entities whose lines are walls."""
NAMES = {
    "TEXT": "texts",
    "MTEXT": "texts",
    "ATTRIB": "texts",
    "ATTDEF": "texts",
    "HATCH": "hatches",
}
NAMES |= {"MPOLYGON": "hatches", "DIMENSION": "dimensions", "LEADER": "leaders", "POINT": "points"}
NAMES |= {"MULTILEADER": "leaders", "ARC_DIMENSION": "dimensions", "IMAGE": "images"}
NOT_PRINTED = "defpoints"  # layer of the points that dimensions refer to
MAX_DEPTH = 32  # of blocks in blocks
ARC_SEGMENTS = 64  # of a full circle, of a polyline with a width
FLAT_Z = 1e-6  # [units] of heights that differ
BROKEN = (
    *(OSError, EOFError, ValueError, TypeError, AttributeError, LookupError),
    *(ArithmeticError, AssertionError, RuntimeError),
)
"""What a reader raises for a broken file, besides its own errors."""
ADVICE = "save it as DXF again (AutoCAD 2000 or later)"


class _Found:
    """What was found in a drawing so far."""

    def __init__(self) -> None:
        """Nothing."""
        self.lines: list[tuple[str, np.ndarray]] = []
        self.left_out: Counter[str] = Counter()
        self.hidden: Counter[str] = Counter()
        self.is_solid = False  # some z differ
        self.clipped = 0


def read(path: Path, unit: str | float | None = None, layers: Sequence[str] = ()) -> Drawing:
    """Read the lines of the model space, blocks resolved.

    Polylines with a width become their outline; curves become segments within `CURVE_TOLERANCE`;
    heights z are dropped. What is invisible, on a layer that is off or frozen, or no line is left
    out and counted.

    Args:
        path: DXF file, of text or binary.
        unit: Of the drawing; by default that of its header ($INSUNITS).
        layers: Names of the layers to read; empty for all that are visible.

    Raises:
        InputError: ezdxf is not installed; the file cannot be read; or its unit is not known.
    """
    try:
        import ezdxf
        from ezdxf import recover
    except ImportError:
        raise no_library(path, "ezdxf") from None
    head = _head(path)
    if head.startswith(b"AC10"):
        raise InputError("is a DWG file", path=path, advice="save it as DXF in your CAD program")
    if not head.startswith(b"AutoCAD Binary DXF") and b"SECTION" not in head:
        raise InputError("is no DXF file", path=path, advice=ADVICE)
    found = _Found()
    try:
        document, auditor = recover.readfile(path)
        size, notes = _unit(path, document, unit)
        _read_entities(found, document, document.modelspace(), CURVE_TOLERANCE / size, "", 0)
    except InputError:
        raise
    except (ezdxf.DXFError, *BROKEN) as error:
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        problem = f"is no DXF that can be read ({reason})"
        raise InputError(problem, path=path, advice=ADVICE) from None
    counted: Counter[str] = Counter()
    for layer, line in found.lines:
        counted[layer] += len(line) - 1
    notes.append(layers_note(counted, layers, path))
    if found.hidden:
        names = ", ".join(repr(name) for name in sorted(found.hidden))
        found.left_out[f"entities on layers that are hidden ({names})"] += found.hidden.total()
    if found.is_solid:
        notes.append("heights are dropped: lines of all heights are walls")
    if found.clipped:
        notes.append(f"{found.clipped} blocks are clipped: what is cut off is read, too")
    if auditor.has_errors or auditor.has_fixes:
        count = len(auditor.errors) + len(auditor.fixes)
        notes.append(f"the file has {count} errors, which were repaired or skipped")
    lines = [line for layer, line in found.lines if not layers or layer in layers]
    return Drawing(size * joined(lines), found.left_out, tuple(filter(None, notes)))


def _head(path: Path) -> bytes:
    """The first bytes of a file."""
    try:
        with open(path, "rb") as file:
            return file.read(2**16)
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check the name") from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path=path) from None


def _unit(path: Path, document: Any, unit: str | float | None) -> tuple[float, list[str]]:
    """Length [m] of a unit of the drawing, and notes on it."""
    from ezdxf import units

    code = document.header.get("$INSUNITS", 0)
    try:
        stated = units.conversion_factor(units.InsertUnits(code), units.InsertUnits.Meters)
        name = units.unit_name(code)
    except (TypeError, IndexError, ValueError, KeyError):
        stated, name = None, ""
    if unit is None:
        if stated is None:
            raise unit_missing(path, "states no unit ($INSUNITS)")
        return float(stated), [f"a unit is {stated:g} m ({name}), as the header states"]
    size = size_of_unit(unit)
    if stated is None or abs(size - stated) <= 1e-3 * size:
        return size, []
    return size, [f"a unit is {size:g} m by --unit, although the header states {stated:g} m"]


def _read_entities(
    found: _Found, document: Any, entities: Any, tolerance: float, inherited: str, depth: int
) -> None:
    """Collect the lines of entities.

    Args:
        found: Grows.
        document: The drawing.
        entities: Of the model space or of a block.
        tolerance: [units] of curves.
        inherited: Layer of the block's reference, which its entities on layer 0 are on.
        depth: Of blocks in blocks.
    """
    for entity in entities:
        kind = entity.dxftype()
        layer = entity.dxf.get("layer", "0")
        layer = inherited if inherited and layer == "0" else layer
        if entity.dxf.get("invisible", 0):
            found.left_out["invisible entities"] += 1
        elif kind == "INSERT":
            _read_block(found, document, entity, tolerance, layer, depth)
        elif _is_hidden(document, layer):
            found.hidden[layer] += 1
        elif kind == "MLINE":
            _read_entities(found, document, entity.virtual_entities(), tolerance, layer, depth)
        elif kind in FLAT:
            lines = list(_polylines(entity, tolerance))
            if not lines:
                found.left_out[f"{kind} without a line"] += 1
            for line in lines:
                found.is_solid |= bool(np.ptp(line[:, 2]) > FLAT_Z)
                found.lines.append((layer, line[:, :2]))
        elif kind != "VIEWPORT":
            found.left_out[NAMES.get(kind, f"{kind} entities")] += 1


def _read_block(
    found: _Found, document: Any, insert: Any, tolerance: float, layer: str, depth: int
) -> None:
    """Collect the lines of a block where it is inserted, once for each of its rows and columns."""
    from ezdxf.xclip import XClip

    record = document.layers.get(layer) if layer in document.layers else None
    block = insert.block()
    if record is not None and record.is_frozen():
        found.hidden[layer] += 1
    elif block is None or block.block.is_xref or block.block.is_xref_overlay:
        found.left_out["references to other files or missing blocks"] += 1
    elif depth >= MAX_DEPTH:
        found.left_out[f"blocks more than {MAX_DEPTH} deep"] += 1
    else:
        clip = XClip(insert)
        found.clipped += bool(clip.has_clipping_path and clip.is_clipping_enabled)

        def skipped(entity: Any, reason: str) -> None:
            found.left_out[NAMES.get(entity.dxftype(), f"{entity.dxftype()} entities")] += 1

        for one in insert.multi_insert() if insert.mcount > 1 else [insert]:
            inside = one.virtual_entities(skipped_entity_callback=skipped)
            _read_entities(found, document, inside, tolerance, layer, depth + 1)


def _is_hidden(document: Any, layer: str) -> bool:
    """Whether entities on a layer are not seen."""
    if layer.lower() == NOT_PRINTED:
        return True
    if layer not in document.layers:
        return False
    record = document.layers.get(layer)
    return bool(record.is_off() or record.is_frozen())


def _polylines(entity: Any, tolerance: float) -> Iterator[np.ndarray]:
    """Polylines (n, 3) [units] of an entity, within a tolerance [units] of its curves."""
    from ezdxf import path as paths
    from ezdxf.render import TraceBuilder

    is_flat_polyline = entity.dxftype() == "LWPOLYLINE" or (
        entity.dxftype() == "POLYLINE" and entity.is_2d_polyline
    )
    if is_flat_polyline and entity.has_width:
        elevation = entity.dxf.elevation
        height = float(getattr(elevation, "z", elevation))
        trace = TraceBuilder.from_polyline(entity, ARC_SEGMENTS)
        rings = _mitred(trace) if entity.is_closed else list(trace.polygons())
        for ring in rings:
            corners = entity.ocs().points_to_wcs([(x, y, height) for x, y in (*ring, ring[0])])
            yield np.array([(*point,) for point in corners], float)
        return
    if entity.dxftype() == "POLYLINE" and (entity.is_poly_face_mesh or entity.is_polygon_mesh):
        return
    for part in paths.make_path(entity).sub_paths():
        points = [(*point,) for point in part.flattening(tolerance)]
        if len(points) > 1:
            yield np.array(points, float)


def _mitred(trace: Any) -> list[Any]:
    """Outlines of a closed wide polyline: outer and inner, or one where it has arcs."""
    from ezdxf.render.trace import LinearTrace

    if len(trace) != 1 or not isinstance(trace[0], LinearTrace) or len(trace[0]) < 4:
        return list(trace.polygons())
    around, straight = LinearTrace(), trace[0]
    stations = [straight[k] for k in range(len(straight))]  # the last is the first once more
    for station in (*stations, *stations[1:3]):
        around.add_station(station.vertex, station.start_width, station.end_width)
    faces = list(around.faces())[1 : len(stations)]  # once around, from the second corner
    return [[face[0] for face in faces], [face[1] for face in faces]]
