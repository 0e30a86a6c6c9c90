"""The exception for bad input."""

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
