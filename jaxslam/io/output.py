"""Atomic writing of results: a file appears complete or not at all."""

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
    """Collect files in a temporary folder and move them to `path` when the block succeeds.

    Each file appears complete and replaces one of the same name; others in `path` stay. If the
    block raises, no file appears.

    Args:
        path: Final folder; created if needed, with its parents.

    Yields:
        The temporary folder, on the same disk: inside `path` or its first existing parent.

    Raises:
        InputError: `path` is a file or cannot be written.
    """
    path = Path(path)
    existing = path
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise InputError("is a file", path=existing, advice="name a folder for the results")
    try:
        temporary = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=existing))
    except OSError as error:
        raise _cannot_write(path, error) from None
    try:
        yield temporary
        _move_files(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _move_files(source: Path, target: Path) -> None:
    """Move each file below `source` to the same relative path below `target`."""
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
    """Open a temporary file that replaces `path` when the block succeeds.

    Args:
        path: Its folder must exist. An existing file stays if the block raises.

    Yields:
        The temporary file, open for binary writing.

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
    """Write a text file atomically.

    Args:
        path: File to write; its folder must exist.
        text: Its content.

    Raises:
        InputError: The file cannot be written.
    """
    with replace(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: str | PathLike, value: Any) -> None:
    """Write a value as JSON; NaN and infinity, which JSON lacks, become null.

    Args:
        path: File to write, atomically.
        value: Mappings, records, sequences, arrays and scalars, nested to any depth.

    Raises:
        InputError: The file cannot be written.
        TypeError: Something in the value has no JSON form.
    """
    write_text(path, json.dumps(plain(value), indent=1, allow_nan=False) + "\n")


def write_json_rows(path: str | PathLike, members: Mapping[str, Any]) -> None:
    """As `write_json`, of an object whose lists are long: an item of a list is one line.

    It is several times as fast, and the file is smaller.
    """
    encode = json.JSONEncoder(allow_nan=False).encode
    text = []
    for name, member in plain(members).items():
        if isinstance(member, list) and member:
            own = "[\n" + ",\n".join(map(encode, member)) + "\n]"
        else:
            own = encode(member)
        text.append(f"{encode(name)}: {own}")
    write_text(path, "{\n" + ",\n".join(text) + "\n}\n")


def plain(value: Any) -> Any:
    """Convert a value to what JSON can hold: dicts, lists, numbers, strings, None.

    NaN and infinity become None.

    Raises:
        TypeError: Something in the value has no JSON form.
    """
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
        array = np.asarray(value)
        is_plain = array.dtype.kind in "biu" or (array.dtype == float and np.isfinite(array).all())
        return array.tolist() if is_plain else plain(array.tolist())
    if isinstance(value, PathLike):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _cannot_write(path: Path, error: OSError) -> InputError:
    """The InputError of a path that cannot be written."""
    advice = "name a folder that exists and that you may write to"
    return InputError(f"cannot be written ({error.strerror})", path=path, advice=advice)
