"""Types and checks of options."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro

from jaxslam.io.errors import InputError

OptionalFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
"""Option that names a file, or none."""

OptionalCount = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
"""Option that is a whole number, or not given."""

OptionalLength = Annotated[float | None, tyro.conf.arg(metavar="M", help_behavior_hint="")]
"""Option that is a length [m], or not given."""

OptionalTopic = Annotated[str | None, tyro.conf.arg(metavar="TOPIC", help_behavior_hint="")]
"""Option that names a topic of a bag, or none."""

OptionalFrame = Annotated[str | None, tyro.conf.arg(metavar="FRAME", help_behavior_hint="")]
"""Option that names a frame of a log, or none."""

Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
"""Option that names several files, or none."""

FileOfEach = Annotated[
    tyro.conf.UseAppendAction[tuple[Path, ...]],
    tyro.conf.arg(metavar="FILE", help_behavior_hint=""),
]
"""Option that names a file for each log, given once for each, or none."""

OutFolder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
"""Option that names the folder of the results."""


def check_range(option: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless the value of an option is in [low, high]."""
    if not low <= value <= high:
        raise InputError(f"{value} is not between {low} and {high}", field=option)


def require_other_folder(out: Path, map_folder: Path) -> None:
    """Raise InputError if the output folder is that of the map that a command reads, or its file.

    Results would replace those of the map.
    """
    if map_folder.is_file():
        map_folder = map_folder.parent
    if out.exists() and map_folder.exists() and out.samefile(map_folder):
        problem = f"{out} is the folder of the map, whose results would be replaced"
        raise InputError(problem, field="--out", advice="name another folder")


@contextmanager
def name_errors(what: str) -> Iterator[None]:
    """Turn a ValueError of the block into an InputError that names the option or file."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), field=what) from None
