"""The one error that bad input raises."""

from os import PathLike


class InputError(ValueError):
    """Bad input, told in one line: where (file, line, field), what is wrong, what to do."""

    def __init__(
        self,
        problem: str,
        *,
        path: str | PathLike | None = None,
        line: int | None = None,
        field: str | None = None,
        advice: str | None = None,
    ):
        """Put the line together.

        Args:
            problem: What is wrong.
            path: File or folder that holds it.
            line: Its line in the file, counted from 1.
            field: Its field in the line or record.
            advice: What to do about it.
        """
        place = "" if path is None else str(path)
        place += "" if line is None else f":{line}"
        text = ": ".join(part for part in (place, field, problem) if part)
        text += "" if advice is None else f"; {advice}"
        super().__init__(" ".join(text.splitlines()))
