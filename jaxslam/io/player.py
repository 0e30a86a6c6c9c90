"""Logs of the Player server, the raw form of many public logs.

    time host robot interface index type subtype data ...      since Player 2
    time host robot interface index data ...                   older, perhaps with a second time

    laser: [id] min_angle max_angle resolution [max_range] count range intensity ...
    position2d, position: px py pa vx vy va stall

Lines of other interfaces, comments and messages that are no data are ignored. Angles of older logs
are in degrees.
"""

import math
from os import PathLike

import numpy as np

from jaxslam.core.logs import DEFAULT_RANGE_MAX, MAX_BROKEN_FRACTION, LaserLog
from jaxslam.io.assemble import read_assembled
from jaxslam.io.errors import InputError
from jaxslam.io.raw_log import RawLog, RawScan, as_odometry
from jaxslam.io.text import lines, number

LASER, POSITIONS = b"laser", (b"position2d", b"position")
HEADER_FIELDS = 5  # time host robot interface index
DATA = (b"001", b"1")  # type of a message that is data, and its subtype
MAX_NAMED = 5  # other sources of odometry that a note names
MAX_HEAD = 8  # fields between those of the header and the ranges, at most
_FORM = (
    "time host robot laser index [type subtype] min_angle max_angle resolution [max_range] count "
    "and range intensity of each beam"
)


def read(path: str | PathLike, *, range_max: float = DEFAULT_RANGE_MAX) -> LaserLog:
    """Read a log of the Player server, plain or gzipped, in file order.

    Args:
        path: The log.
        range_max: Range [m] from which on a reading counts as no return, unless the scanner's own
            is smaller; so does one <= 0.

    Raises:
        InputError: `range_max` is not positive, the file cannot be read or has no scans, or more
            than 5 % of its lines of scans and odometry are broken.
    """
    return read_assembled(path, read_raw, range_max=range_max)


def is_line(text: bytes) -> bool:
    """Whether a line is one of a Player log: its header, or a message of interest."""
    fields = text.split(maxsplit=HEADER_FIELDS)
    if fields[:2] == [b"##", b"Player"] or fields[:2] == [b"#", b"Player"]:
        return True
    return len(fields) > HEADER_FIELDS and fields[3] in (LASER, *POSITIONS)


def read_raw(path: str | PathLike) -> RawLog:
    """Scans and odometry of a log: of several robots' bases the one with most messages.

    Raises:
        InputError: As `read`.
    """
    scans: list[RawScan] = []
    odometry: dict[bytes, list[tuple[float, float, int, float, float, float]]] = {}
    broken: dict[int, str] = {}
    for line, text in lines(path):
        fields = text.split()
        if len(fields) <= HEADER_FIELDS or fields[0].startswith(b"#") or not _is_data(fields):
            continue
        try:
            if fields[3] == LASER:
                scans.append(_parse_laser(line, fields))
            elif fields[3] in POSITIONS:
                name = b" ".join(fields[3:5])
                odometry.setdefault(name, []).append(_parse_position(line, fields))
        except InputError as error:
            broken[line] = str(error)
    total = len(scans) + sum(map(len, odometry.values())) + len(broken)
    if len(broken) > MAX_BROKEN_FRACTION * total:
        line = min(broken)
        problem = f"{broken[line]} ({len(broken)} of {total} lines are broken)"
        raise InputError(problem, path=path, line=line, advice=f"repair them, each is: {_FORM}")
    if not scans:
        advice = "name a log that holds laser scans"
        raise InputError("has no laser lines", path=path, advice=advice)
    chosen = max(sorted(odometry), key=lambda name: len(odometry[name]), default=b"")
    rows = odometry.get(chosen, [])
    notes = []
    if len(odometry) > 1:
        others = ", ".join(map(_text, sorted(odometry.keys() - {chosen})[:MAX_NAMED]))
        notes.append(f"odometry of {_text(chosen)!r} is used, not of {others}")
    return RawLog(
        scans=scans,
        odometry=as_odometry(_in_radians(rows) if chosen.startswith(b"position ") else rows),
        num_skipped=len(broken),
        notes=tuple(notes),
    )


def _text(field: bytes) -> str:
    """A field as text, shortened."""
    return field[:20].decode("utf-8", "replace")


def _is_data(fields: list[bytes]) -> bool:
    """Whether a message is data, where its header says: not a reply, not a geometry."""
    kind, subtype = fields[5], fields[6] if len(fields) > 6 else b""
    if not (kind.isdigit() and subtype.isdigit() and len(kind) == len(subtype) == 3):
        return True  # an older log, whose lines are all data
    return kind in DATA and subtype in DATA


def _parse_laser(line: int, fields: list[bytes]) -> RawScan:
    """The scan of a line; errors carry no line number."""
    time = number(fields[0], "field 1 (time)")
    head, num_beams = _head_of_scan(fields)
    values = [number(field, "angles") for field in fields[head - 4 : head]]
    numbers = [number(field, "a range") for field in fields[head + 1 :]]
    first, last, step, range_max = _angles(values, num_beams)
    ranges = np.array(numbers[::2] if len(numbers) == 2 * num_beams else numbers)
    scale = math.pi / 180 if max(abs(first), abs(last)) > 2 * math.pi else 1.0
    frame = f"laser {_text(fields[4])}"
    step = math.copysign(step, last - first) * scale
    return RawScan(time, math.nan, line, frame, first * scale, step, range_max, ranges)


def _head_of_scan(fields: list[bytes]) -> tuple[int, int]:
    """Place of the field that counts the beams, and their number, which the length confirms."""
    start = HEADER_FIELDS + 3
    for place in range(start, min(start + MAX_HEAD, len(fields))):
        if fields[place].isdigit():
            count, rest = int(fields[place]), len(fields) - place - 1
            if count >= 2 and rest in (count, 2 * count):
                return place, count
    raise InputError(f"cut or damaged: {len(fields)} fields", field="count")


def _angles(values: list[float], num_beams: int) -> tuple[float, float, float, float]:
    """First and last angle, step and largest range [m] of the four numbers before the count.

    Older lines have no largest range: the step then is the last of the four.
    """
    for (first, last, step), range_max in ((values[:3], values[3]), (values[1:], math.inf)):
        beams = abs(last - first) / step + 1.0 if step > 0.0 else 0.0
        if abs(beams - num_beams) <= 1.5:
            return first, last, step, range_max if range_max > 0.0 else math.inf
    problem = f"{num_beams} beams do not fit between the angles {values}"
    raise InputError(problem, field="min_angle max_angle resolution")


def _parse_position(
    line: int, fields: list[bytes]
) -> tuple[float, float, int, float, float, float]:
    """Stamp, line and pose of a line of odometry; errors carry no line number."""
    if not HEADER_FIELDS + 7 <= len(fields) <= HEADER_FIELDS + 9:
        raise InputError(f"cut or damaged: {len(fields)} fields")
    time = number(fields[0], "field 1 (time)")
    x, y, heading = (
        number(field, name) for field, name in zip(fields[-7:-4], ("px", "py", "pa"), strict=True)
    )
    return time, math.nan, line, x, y, heading


def _in_radians(
    rows: list[tuple[float, float, int, float, float, float]],
) -> list[tuple[float, float, int, float, float, float]]:
    """Rows of odometry whose headings are in radians: those of older logs are in degrees."""
    if max((abs(row[5]) for row in rows), default=0.0) <= 2 * math.pi + 0.1:
        return rows
    return [(*row[:5], math.radians(row[5])) for row in rows]
