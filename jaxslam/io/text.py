"""Lines, numbers and tables of text files, plain or compressed; errors name the line."""

import gzip
import math
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import IO

import numpy as np
from tqdm import tqdm

from jaxslam.io.errors import InputError


def with_progress(items: Iterable, path: Path, unit: str, total: int | None = None) -> Iterable:
    """Iterate over the items of a file with a progress bar.

    The bar appears on a terminal only, and after one second.

    Args:
        items: The items.
        path: The file.
        unit: What an item is called.
        total: Number of items, if known.
    """
    return tqdm(
        items,
        desc=f"reading {path.name}",
        unit=unit,
        unit_scale=True,
        total=total,
        leave=False,
        delay=1.0,
        disable=None,
    )


def lines(path: str | PathLike) -> Iterator[tuple[int, bytes]]:
    """Yield each line of a text file with its number, counted from 1.

    Args:
        path: Text file; a gzipped one, or the only one in a zip archive, is unpacked.

    Raises:
        InputError: The file is missing, a folder, unreadable, empty, binary, or a damaged archive;
            or an archive holds several files.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError("is a folder", path=path, advice="name a file inside it")
    try:
        with _open(path) as file:
            head = file.read(4096)
            if not head.strip():
                raise InputError("is empty", path=path, advice="name a file with content")
            if b"\0" in head:
                raise InputError("is binary", path=path, advice="name a text file")
            file.seek(0)
            for count, line in enumerate(with_progress(file, path, "line"), start=1):
                yield count, line.removeprefix(b"\xef\xbb\xbf") if count == 1 else line
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check the name") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        problem = f"is a damaged gzip file ({error})"
        raise InputError(problem, path=path, advice="copy it again") from None
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        problem = f"is a zip archive that cannot be read ({error})"
        raise InputError(problem, path=path, advice="unpack it") from None
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        raise InputError(problem, path=path, advice="check its permissions") from None


@contextmanager
def _open(path: Path) -> Iterator[IO[bytes] | gzip.GzipFile]:
    """Open a file, decompressed."""
    with open(path, "rb") as file:
        head = file.read(4)
    if head[:2] == b"\x1f\x8b":
        with gzip.open(path, "rb") as unpacked:
            yield unpacked
    elif head == b"PK\3\4":
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not name.endswith("/")]
            names = [name for name in names if not name.startswith("__MACOSX/")]
            if len(names) != 1:
                problem = f"is a zip archive of {len(names)} files"
                raise InputError(problem, path=path, advice="unpack it and name one of them")
            with archive.open(names[0]) as member:
                yield member
    else:
        with open(path, "rb") as file:
            yield file


def number(field: bytes, name: str) -> float:
    """Value of one field.

    Args:
        field: Text of the field.
        name: Its name, for the error.

    Raises:
        InputError: The text is no number, or NaN or infinite. It carries no line number.
    """
    try:
        value = float(field)
    except ValueError:
        excerpt = field[:20].decode("utf-8", "replace")
        raise InputError(f"{excerpt!r} is not a number", field=name) from None
    if not math.isfinite(value):
        raise InputError(f"{value} is not finite", field=name)
    return value


def rows(path: str | PathLike, names: Sequence[str], form: str) -> list[tuple[int, list[float]]]:
    """Read a table: a line number and the finite numbers of each line that is no comment.

    Args:
        path: Text file; `#` starts a comment line.
        names: Names of the fields, in order.
        form: Name of the file format, for the errors.

    Raises:
        InputError: As `lines`; or a line has too few or too many fields, or one is no finite
            number; or there are only comments.
    """
    parsed = []
    for line, text in lines(path):
        fields = text.split()
        if not fields or fields[0].startswith(b"#"):
            continue
        advice = f"a line of {form} is: {' '.join(names)}"
        if len(fields) != len(names):
            problem = f"{len(fields)} fields instead of {len(names)}"
            raise InputError(problem, path=path, line=line, advice=advice)
        try:
            values = [number(field, name) for field, name in zip(fields, names, strict=True)]
        except InputError as error:
            raise InputError(str(error), path=path, line=line, advice=advice) from None
        parsed.append((line, values))
    if not parsed:
        raise InputError("holds only comments", path=path, advice=f"name a file of {form}")
    return parsed


def table(path: str | PathLike, names: Sequence[str], form: str) -> tuple[np.ndarray, np.ndarray]:
    """Read a long table as `rows` does, but by NumPy, which is much faster.

    Args:
        path: Text file; `#` starts a comment line.
        names: Names of the K fields, in order.
        form: Name of the file format, for the errors.

    Returns:
        Line numbers (N,) and values (N, K).

    Raises:
        InputError: As `rows`.
    """
    kept = [(line, text) for line, text in lines(path) if not text.lstrip().startswith(b"#")]
    kept = [(line, text) for line, text in kept if text.strip()]
    try:
        values = np.loadtxt([text for _, text in kept], comments=None, ndmin=2) if kept else None
    except ValueError:
        values = None
    if values is not None and values.shape[1] == len(names) and np.isfinite(values).all():
        return np.array([line for line, _ in kept]), values
    parsed = rows(path, names, form)  # raises with the line that is broken
    return np.array([line for line, _ in parsed]), np.array([row for _, row in parsed])
