"""A laser scanner as its data sheet has it: more than the `Lidar` that the front end needs.

Three kinds of numbers are kept apart, because makers give one or another:

    range noise   standard deviation of a range at one place, "statistical error (1 sigma)"
    precision     bound +-b of the same, "repeatability"
    accuracy      bound +-b of the whole error, with the systematic part that noise does not have

What is simulated is the first. Where there is none, a third of the second is assumed, else a third
of the third (a Gaussian is within three standard deviations 99.7 % of the time), else
`DEFAULT_STD`; `Scanner.assumptions` says so. Each may depend on the range, in pieces

    c_i + p_i r    at ranges r from piece i on, up to the next piece.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import AnyArray, as_float64

DEFAULT_STD = Lidar().range_std
"""[m] standard deviation of a range of a scanner of which no error at all is known."""
STDS_OF_BOUND = 3.0
"""Standard deviations that a bound +-b is taken for."""
TYPICAL_RANGE = 3.0
"""[m] at which the one standard deviation of `Scanner.lidar` is taken."""
FULL_CIRCLE = 2.0 * math.pi


class ErrorPiece(NamedTuple):
    """An error of ranges from `from_range` on: constant + proportion * range.

    Attributes:
        from_range: [m].
        constant: [m].
        proportion: [-].
    """

    from_range: float
    constant: float
    proportion: float


Pieces = tuple[ErrorPiece, ...]


class Scanner(NamedTuple):
    """A 2-D laser scanner; static under jit. A number that no source gives is None.

    Attributes:
        name: What it is called.
        num_beams: Number of beams R, at least 2.
        angle_min: [rad] angle of beam 0 in the frame of the scanner.
        angle_increment: [rad] from one beam to the next, above 0.
        scan_rate: [Hz] scans per second.
        range_min: [m] nothing returns from nearer.
        range_max: [m] nothing returns from beyond.
        range_noise: Standard deviation of a range.
        precision: Bound of the repeatability of a range.
        accuracy: Bound of its whole error.
        range_resolution: [m] ranges are multiples of it; None: not rounded.
        beam_divergence: [rad] full angle by which a beam widens.
        beam_width: [m] width of a beam where it leaves the scanner.
        turn_time: [s] in which its mirror turns once: on a robot that moves, in `Life`, the beams
            of a scan are of different poses; None: all are of one.
        num_turns: Turns that a scan is put together of: beam i is of turn i mod `num_turns`.
        notes: What was assumed or chosen where sources say nothing or disagree.
        error_notes: Likewise, of its errors.
    """

    name: str
    num_beams: int
    angle_min: float
    angle_increment: float
    scan_rate: float
    range_min: float
    range_max: float
    range_noise: Pieces | None = None
    precision: Pieces | None = None
    accuracy: Pieces | None = None
    range_resolution: float | None = None
    beam_divergence: float | None = None
    beam_width: float | None = None
    turn_time: float | None = None
    num_turns: int = 1
    notes: tuple[str, ...] = ()
    error_notes: tuple[str, ...] = ()

    @property
    def full_circle(self) -> bool:
        """Whether the beams go all around, up to half an increment."""
        return abs(self.num_beams * self.angle_increment - FULL_CIRCLE) < self.angle_increment / 2

    @property
    def field_of_view(self) -> float:
        """Angle [rad] between the first and the last beam; 2 pi if they go all around."""
        return FULL_CIRCLE if self.full_circle else (self.num_beams - 1) * self.angle_increment

    def noise_pieces(self) -> Pieces:
        """The standard deviation of a range that is simulated."""
        if self.range_noise is not None:
            return self.range_noise
        bound = self.accuracy if self.precision is None else self.precision
        if bound is None:
            return (ErrorPiece(0.0, DEFAULT_STD, 0.0),)
        return tuple(
            ErrorPiece(x.from_range, x.constant / STDS_OF_BOUND, x.proportion / STDS_OF_BOUND)
            for x in bound
        )

    def assumptions(self) -> tuple[str, ...]:
        """What is simulated although no source says so, in words."""
        said = *self.error_notes, *self.notes
        if self.range_noise is not None:
            return said
        given = "precision" if self.precision is not None else "accuracy"
        if self.precision is None and self.accuracy is None:
            assumed = f"{1000 * DEFAULT_STD:g} mm is assumed"
        else:
            assumed = f"a third of its {given} is assumed"
        return (f"no standard deviation of its ranges is known: {assumed}", *said)

    def range_std(self, ranges: AnyArray) -> AnyArray:
        """Standard deviations (...) [m] of true ranges (...) [m]; NumPy or JAX as given."""
        first, *others = self.noise_pieces()
        std = first.constant + first.proportion * ranges
        where = ranges.__array_namespace__().where
        for piece in others:
            further = piece.constant + piece.proportion * ranges
            std = where(ranges >= piece.from_range, further, std)
        return std

    def lidar(self) -> Lidar:
        """What the front end knows of it; its one standard deviation is that at `TYPICAL_RANGE`."""
        at = min(max(TYPICAL_RANGE, self.range_min), self.range_max)
        std = float(self.range_std(as_float64("range", at, ())))
        return Lidar(self.num_beams, self.angle_min, self.angle_increment, self.range_max, std)


def pieces(*given: tuple[float, float, float]) -> Pieces:
    """Pieces of (from_range [m], constant [m], proportion [-])."""
    return tuple(ErrorPiece(*x) for x in given)


def digitise(scanner: Scanner, scan: Scan) -> Scan:
    """A noisy scan as the scanner reports it: rounded, and without returns out of its range.

    Args:
        scanner: The scanner.
        scan: Its ranges (R,) [m] with noise.
    """
    ranges = scan.ranges
    if scanner.range_resolution is not None:
        ranges = scanner.range_resolution * jnp.round(ranges / scanner.range_resolution)
    hit = scan.hit & (ranges >= scanner.range_min) & (ranges > 0.0) & (ranges < scanner.range_max)
    return Scan(ranges=jnp.where(hit, ranges, scanner.range_max), hit=hit)


def check_scanner(scanner: Any) -> None:
    """Raise ValueError, naming the field, unless the record is that of a possible scanner."""
    if not isinstance(scanner, Scanner):
        raise ValueError(f"scanner is {type(scanner).__name__}, not Scanner")
    for name in ("num_beams", "angle_min", "angle_increment", "scan_rate", "range_max"):
        if not math.isfinite(as_float64(f"scanner.{name}", getattr(scanner, name), ())):
            raise ValueError(f"scanner.{name} is {getattr(scanner, name)}, not a finite number")
    if scanner.num_beams < 2 or scanner.num_beams != int(scanner.num_beams):
        raise ValueError(f"scanner.num_beams is {scanner.num_beams}, not an integer of 2 or more")
    for name in ("angle_increment", "scan_rate", "range_max"):
        if not getattr(scanner, name) > 0.0:
            raise ValueError(f"scanner.{name} is {getattr(scanner, name)}, not above 0")
    if (scanner.num_beams - 1) * scanner.angle_increment >= FULL_CIRCLE * (1.0 + 1e-9):
        raise ValueError(
            f"scanner.num_beams is {scanner.num_beams} and scanner.angle_increment "
            f"{scanner.angle_increment}: together more than 2 pi"
        )
    if not 0.0 <= scanner.range_min < scanner.range_max:
        raise ValueError(
            f"scanner.range_min is {scanner.range_min}, not in [0, range_max), "
            f"and range_max is {scanner.range_max}"
        )
    if scanner.num_turns < 1 or scanner.num_turns != int(scanner.num_turns):
        raise ValueError(f"scanner.num_turns is {scanner.num_turns}, not an integer of 1 or more")
    for name in ("range_resolution", "beam_divergence", "beam_width", "turn_time"):
        value = getattr(scanner, name)
        if value is not None and not 0.0 < as_float64(f"scanner.{name}", value, ()) < math.inf:
            raise ValueError(f"scanner.{name} is {value}, not above 0")
    for name in ("range_noise", "precision", "accuracy"):
        _check_pieces(f"scanner.{name}", getattr(scanner, name))


def _check_pieces(name: str, given: Any) -> None:
    """Raise ValueError unless these are pieces in the order of their ranges, or None."""
    if given is None:
        return
    if not isinstance(given, tuple) or not all(isinstance(x, ErrorPiece) for x in given):
        raise ValueError(f"{name} is {given!r}, not a tuple of ErrorPiece")
    if not given or not all(math.isfinite(x) and x >= 0.0 for piece in given for x in piece):
        raise ValueError(f"{name} is {given!r}, not one or more pieces of numbers of 0 or more")
    starts = [piece.from_range for piece in given]
    if starts != sorted(set(starts)):
        raise ValueError(f"{name} has pieces from {starts}, not in the order of their ranges")
