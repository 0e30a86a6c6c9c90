"""The exception for bad input, and the check of an argument that all readers of logs have."""

import math
from numbers import Real
from os import PathLike


class InputError(ValueError):
    """Bad input, in one line: location (file, line, field), problem, advice."""

    def __init__(
        self,
        problem: str,
        *,
        path: str | PathLike | None = None,
        line: int | None = None,
        field: str | None = None,
        advice: str | None = None,
    ):
        """Build the message `path:line: field: problem; advice`.

        Args:
            problem: What is wrong.
            path: File or folder that holds it.
            line: Its line in the file, counted from 1.
            field: Its field in the line or record, or the command line option.
            advice: How to fix it.
        """
        location = "" if path is None else str(path)
        location += "" if line is None else f":{line}"
        text = ": ".join(part for part in (location, field, problem) if part)
        text += "" if advice is None else f"; {advice}"
        super().__init__(" ".join(text.splitlines()))


def check_range_max(range_max: float, *, infinite: bool = False) -> None:
    """Raise InputError unless `range_max` is a positive number, of metres.

    Args:
        range_max: The argument of a reader.
        infinite: Whether it may be infinite: where the log states a range_max itself.
    """
    number = isinstance(range_max, Real) and not isinstance(range_max, bool)
    if not number or not (range_max > 0.0 and (infinite or math.isfinite(range_max))):
        problem = f"range_max {range_max!r} is not a length [m]"
        raise InputError(problem, advice="give a positive number of metres")
