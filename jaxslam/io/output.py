"""Results on disk: whole or not at all."""

import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy as np

from jaxslam.io.errors import InputError


@contextmanager
def folder(path: str | PathLike) -> Iterator[Path]:
    """Collect files in a temporary folder and move them to `path` when the block has ended well.

    Each file appears whole and replaces one of the same name; others in `path` stay. If the block
    raises, nothing appears.

    Args:
        path: Final folder; made if needed, with its parents.

    Yields:
        The temporary folder, on the same disk: inside `path`, or beside where it will be.

    Raises:
        InputError: `path` is a file or cannot be written.
    """
    path = Path(path)
    home = path
    while not home.exists() and home != home.parent:
        home = home.parent
    if not home.is_dir():
        raise InputError("is a file", path=home, advice="name a folder for the results")
    try:
        temporary = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=home))
    except OSError as error:
        raise _cannot_write(path, error) from None
    try:
        yield temporary
        _move_files(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _move_files(source: Path, target: Path) -> None:
    """Move each file below `source` to the same place below `target`."""
    files = sorted(file.relative_to(source) for file in source.rglob("*") if file.is_file())
    for name in files:
        if (target / name).is_dir():
            raise InputError("is a folder", path=target / name, advice="remove or rename it")
    try:
        target.mkdir(parents=True, exist_ok=True)
        for name in files:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(source / name, target / name)
    except OSError as error:
        raise _cannot_write(target, error) from None


@contextmanager
def replace(path: str | PathLike) -> Iterator[IO[bytes]]:
    """A file to write to, which takes the place of `path` when the block has ended well.

    Args:
        path: Its folder must exist. What was there stays if the block raises.

    Raises:
        InputError: The file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise _cannot_write(path, error) from None
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | PathLike, text: str) -> None:
    """Write a text file; it appears whole or not at all.

    Args:
        path: File to write; its folder must exist.
        text: All of its content.

    Raises:
        InputError: The file cannot be written.
    """
    with replace(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: str | PathLike, value: Any) -> None:
    """Write a value as JSON; NaN and infinity, which JSON lacks, become null.

    Args:
        path: File to write, all of it or nothing.
        value: Mappings, records, sequences, arrays and scalars, nested at will.

    Raises:
        InputError: The file cannot be written.
        TypeError: Something in the value has no JSON form.
    """
    write_text(path, json.dumps(plain(value), indent=1, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """The same value in dicts, lists, numbers and strings; NaN and infinity become None."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "__array__"):
        return plain(np.asarray(value).tolist())
    if isinstance(value, PathLike):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _cannot_write(path: Path, error: OSError) -> InputError:
    """Error that says why `path` cannot be written."""
    advice = "name a folder that exists and that you may write to"
    return InputError(f"cannot be written ({error.strerror})", path=path, advice=advice)
