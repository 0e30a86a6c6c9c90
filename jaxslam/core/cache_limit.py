"""The limit of the folder of both caches: programs that were used longest ago are removed first.

JAX's own limit (`jax_compilation_cache_max_size`) needs the package filelock, does not see traced
programs, and fails on compiled ones that were kept without it.

A file was used when it was read or written last. `trace_cache` notes that it has read one; of what
JAX has compiled the file system does, often no more than once a day. Only files with names of these
caches are looked at:

    jaxslam-NAME-DIGEST                  a traced program
    .unfinished-*/jaxslam-NAME-DIGEST    one that a process was writing when it was ended
    NAME-DIGEST-cache                    a compiled program, of any package, and
    NAME-DIGEST-atime                    when JAX has used it last, where JAX limits its cache

Several processes may do this at once: they find the same order, and what one has removed counts
for the others, too. A program that is removed while another process reads it is whole for that one
(POSIX), or is traced and compiled anew.
"""

import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

PACKAGE = __name__.split(".")[0]
DIGEST = "[0-9a-f]{64}"
TRACED = re.compile(rf"{PACKAGE}-.+-{DIGEST}")
COMPILED = re.compile(rf"(.+-{DIGEST})-cache")
UNFINISHED = ".unfinished-"
"""Prefix of the folders in which files are written before they are renamed."""

CLOCK_ERROR = 86_400.0
"""[s] by which times of files may be ahead of the clock; those farther ahead were never right."""


class CacheFile(NamedTuple):
    """A file of one of the caches.

    Attributes:
        path: Where it is.
        size: [bytes].
        used: [s] when it was read or written last, since 1970.
    """

    path: Path
    size: int
    used: float


def limit_size(folder: Path, max_bytes: int, *, compiled: bool) -> None:
    """Remove what was used longest ago until the files of the caches take no more than a limit.

    Nothing is raised: what cannot be read is left out, and what cannot be removed stays, and
    nothing else goes in its place.

    Args:
        folder: Folder of the caches; it need not exist.
        max_bytes: The limit.
        compiled: Whether JAX's compiled programs count and may be removed, too.
    """
    files = list(cache_files(folder, compiled=compiled))
    excess = sum(file.size for file in files) - max_bytes
    latest = time.time() + CLOCK_ERROR
    for file in sorted(files, key=lambda file: (file.used <= latest, file.used, file.path)):
        if excess <= 0:
            return
        excess -= file.size
        _remove(file.path)


def cache_files(folder: Path, *, compiled: bool) -> Iterator[CacheFile]:
    """Files of the caches in a folder; links are not followed.

    Args:
        folder: Folder of the caches.
        compiled: Whether JAX's compiled programs are wanted, too.
    """
    for entry in _entries(folder):
        if TRACED.fullmatch(entry.name) or (compiled and COMPILED.fullmatch(entry.name)):
            yield from _as_file(entry)
        elif entry.name.startswith(UNFINISHED) and entry.is_dir(follow_symlinks=False):
            for inner in _entries(Path(entry.path)):
                if TRACED.fullmatch(inner.name):
                    yield from _as_file(inner)


def _entries(folder: Path) -> list[os.DirEntry]:
    """What is in a folder; nothing where it cannot be read."""
    try:
        with os.scandir(folder) as found:
            return list(found)
    except OSError:
        return []


def _as_file(entry: os.DirEntry) -> Iterator[CacheFile]:
    """The file of an entry; nothing if it is a link or a folder, cannot be read, or is gone."""
    with suppress(OSError):
        if entry.is_file(follow_symlinks=False):
            found = entry.stat(follow_symlinks=False)
            yield CacheFile(Path(entry.path), found.st_size, max(found.st_atime, found.st_mtime))


def _remove(path: Path) -> None:
    """Remove a file, and what belongs to it alone."""
    with suppress(OSError):
        path.unlink()
    with suppress(OSError):
        if path.parent.name.startswith(UNFINISHED):
            path.parent.rmdir()
        elif found := COMPILED.fullmatch(path.name):
            path.with_name(f"{found[1]}-atime").unlink()


def mark_used(path: Path) -> None:
    """Note that a file was used now, where that is allowed."""
    with suppress(OSError):
        os.utime(path)
