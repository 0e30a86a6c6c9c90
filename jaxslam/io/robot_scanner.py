"""The section `[scanner]` of a robot's file (`robot_file`): a preset, its own numbers, or both."""

import math
import re
from typing import Any

from jaxslam.io.quantities import Table
from jaxslam.simulation import scanner_presets
from jaxslam.simulation.scanners import FULL_CIRCLE, ErrorPiece, Pieces, Scanner, check_scanner

GEOMETRY = ("beams", "field_of_view", "angle_increment")
ERRORS = ("range_noise", "precision", "accuracy")
ERROR_FORM = 'write "10 mm", "1 %", "5 mm + 1 %" or ["10 mm", "3.5 % from 0.5 m"]'
LIMITS = {
    "scan_rate": ("rate", 0.05, 1000.0),
    "range_min": ("length", 0.0, 100.0),
    "range_max": ("length", 0.05, 1000.0),
    "range_resolution": ("length", 1e-6, 1.0),
    "beam_divergence": ("angle", 1e-6, 0.2),
    "beam_width": ("length", 1e-4, 0.5),
}
"""Kind and limits of the quantities that stand for themselves."""


def read_scanner(table: Table) -> Scanner:
    """A scanner of a section whose keys are known ones.

    Raises:
        InputError: A value is not possible, one that is needed is missing, or two contradict each
            other.
    """
    base = None
    name = table.text("preset")
    if name is not None:
        try:
            base = scanner_presets.preset(name)
        except ValueError as error:
            problem, _, known = str(error).partition("; there are: ")
            raise table.error("preset", problem, f"presets are {known}") from None
    own: dict[str, Any] = {}
    for key, (kind, low, high) in LIMITS.items():
        value = table.quantity(key, kind, low, high)
        if value is not None:
            own[key] = value
        elif base is None and key in ("scan_rate", "range_min", "range_max"):
            table.required(key, kind, low, high)
    for key in ERRORS:
        if key in table.content:
            own[key] = _pieces(table, key)
    if base is None and not any(key in own for key in ERRORS):
        raise table.error("range_noise", "is missing", ERROR_FORM)
    if "range_noise" in own:
        for key in ERRORS[1:]:
            if key in own:
                raise table.error(key, "says nothing beside range_noise", "leave one of both out")
    own |= _geometry(table, base)
    scanner_name = table.text("name")
    if base is None:
        scanner = Scanner(scanner_name or "own scanner", **own)
    else:
        if any(key in own for key in ERRORS):  # those of the file alone count
            own = dict.fromkeys(ERRORS) | {"error_notes": ()} | own
        if own:
            notes = *base.notes, *_beyond_source(own, base)
            base = base._replace(notes=tuple(f"preset {base.name}: {x}" for x in notes))
        scanner = base._replace(**own, name=scanner_name or base.name)
    if not scanner.range_min < scanner.range_max:
        problem = f"{scanner.range_min:g} m is not below range_max, {scanner.range_max:g} m"
        raise table.error("range_min", problem, "give both")
    for key in ERRORS:
        start = max((piece.from_range for piece in own.get(key) or ()), default=0.0)
        if start >= scanner.range_max:
            problem = f"a piece from {start:g} m says nothing: range_max is {scanner.range_max:g} m"
            raise table.error(key, problem, "check its unit")
    try:
        check_scanner(scanner)
    except ValueError as error:
        raise table.error("", str(error)) from None
    return scanner


def _beyond_source(own: dict[str, Any], base: Scanner) -> list[str]:
    """Notes on values of a section that are better than those of the source of its preset."""
    better = {"scan_rate": ("Hz", 1), "range_max": ("m", 1), "range_min": ("m", -1)}
    return [
        f"{key} is {own[key]:g} {unit}, and {getattr(base, key):g} {unit} by its source"
        for key, (unit, sign) in better.items()
        if key in own and sign * (own[key] - getattr(base, key)) > 0.0
    ]


def _geometry(table: Table, base: Scanner | None) -> dict[str, Any]:
    """Fields of the beams' directions that the section gives; none if it leaves those of a preset.

    Beams that go all around are field of view / increment, others one more.
    """
    beams, span, step = (
        _beams(table),
        *(table.quantity(key, "angle", 1e-5, FULL_CIRCLE * (1 + 1e-6)) for key in GEOMETRY[1:]),
    )
    first = table.quantity("angle_min", "angle", -FULL_CIRCLE, FULL_CIRCLE)
    given = sum(x is not None for x in (beams, span, step))
    if given == 0 and base is not None:
        return {} if first is None else {"angle_min": first}
    if given < 2 and base is None:
        missing = next(key for key in GEOMETRY if key not in table.content)
        raise table.error(missing, "is missing", f"give two of {', '.join(GEOMETRY)}")
    if given == 1 and base is not None:
        if span is None:
            span = base.field_of_view
        else:
            step = base.angle_increment
    if span is not None and span > FULL_CIRCLE * (1 - 1e-6):
        span = FULL_CIRCLE
    if beams is None:
        assert span is not None and step is not None  # two of three are given
        beams = _count(table, span, step)
    around = span == FULL_CIRCLE
    if span is None:
        assert step is not None
        around = abs(beams * step - FULL_CIRCLE) < step / 2
        if not around and (beams - 1) * step >= FULL_CIRCLE:
            problem = f"{beams} beams at {math.degrees(step):g} degrees are more than a circle"
            raise table.error("beams", problem, "check angle_increment")
        span = FULL_CIRCLE if around else (beams - 1) * step
    fitting = span / beams if around else span / (beams - 1)
    if step is not None and abs(fitting - step) * beams > 1.01 * step:
        problem = f"{math.degrees(step):g} degrees contradict beams and field_of_view"
        advice = f"{beams} beams over {math.degrees(span):g} degrees are {math.degrees(fitting):g}"
        raise table.error("angle_increment", problem, advice + " degrees apart")
    step = fitting if step is None or around else step
    middle = -math.pi if around else -(beams - 1) * step / 2
    return {
        "num_beams": beams,
        "angle_increment": step,
        "angle_min": middle if first is None else first,
    }


def _count(table: Table, span: float, step: float) -> int:
    """Number of beams, of a field of view that is a multiple of the increment."""
    intervals = span / step
    # Makers round increments: 0.33 degrees are a third.
    if abs(intervals - round(intervals)) > 0.02 * intervals or round(intervals) < 2:
        problem = f"{math.degrees(step):g} degrees do not divide {math.degrees(span):g} degrees"
        raise table.error("angle_increment", problem, "give beams and field_of_view")
    return round(intervals) + (span != FULL_CIRCLE)


def _beams(table: Table) -> int | None:
    """Number of beams, if it is given."""
    value = table.content.get("beams")
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or not 2 <= value <= 100_000:
        raise table.error("beams", f"{value!r} is no whole number from 2 to 100000"[:200])
    return value


def _pieces(table: Table, key: str) -> Pieces:
    """An error of ranges, by range: `ERROR_FORM`."""
    value = table.content[key]
    texts = value if isinstance(value, list) else [value]
    if not texts or not all(isinstance(text, str) for text in texts):
        raise table.error(key, f"{value!r} is no error of a range"[:200], ERROR_FORM)
    found = [_piece(table, key, text) for text in texts]
    starts = [piece.from_range for piece in found]
    if starts != sorted(set(starts)):
        raise table.error(key, "pieces are not in the order of their ranges", ERROR_FORM)
    return tuple(found)


def _piece(table: Table, key: str, text: str) -> ErrorPiece:
    """One piece: "5 mm + 1 % from 0.5 m"."""
    terms, word, start = re.fullmatch(r"(.*?)(?:\s+(from)\s+(.*))?", text.strip(), re.S).groups()  # type: ignore[union-attr]
    constant = proportion = None
    for term in terms.split("+"):
        if term.strip().endswith("%") and proportion is None:
            proportion = table.checked(key, term.strip(), "ratio", 0.0, 0.5)
        elif constant is None:
            constant = table.checked(key, term.strip(), "length", 0.0, 1.0)
        else:
            raise table.error(key, f"{text[:80]!r} is no error of a range", ERROR_FORM)
    begin = table.checked(key, start, "length", 0.0, 1000.0) if word else 0.0
    return ErrorPiece(begin or 0.0, constant or 0.0, proportion or 0.0)
