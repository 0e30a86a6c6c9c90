"""The files of ROS bags: which one is a bag, of which kind, and how to open it.

The kind is seen from the first bytes. rosbags goes by the suffix: it is given links that have the
right one.
"""

import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from jaxslam.io.errors import InputError

_MAGIC = {b"#ROSBAG V2.0": ".bag", b"SQLite format 3\0": ".db3", b"\x89MCAP0\r\n": ".mcap"}
_OLD_BAG = b"#ROS"  # a bag of an older version, or of another
_PACKED = {b"\x1f\x8b": "gunzip", b"BZh": "bunzip2", b"\x28\xb5\x2f\xfd": "zstd -d"}
_SUFFIXES = (".bag", ".db3", ".mcap")
ROS2_SUFFIXES = (".db3", ".mcap")
HEAD = 16  # [bytes] that show the format


def is_bag(path: Path) -> bool:
    """Whether a file or folder is a bag, or one that was packed or not closed."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(_files(path))
    if not path.exists():
        return path.suffix in _SUFFIXES
    head = _head(path)
    if _kind(head) or head.startswith(_OLD_BAG):
        return True
    packed = any(head.startswith(magic) for magic in _PACKED)
    if packed and head.startswith(b"\x1f\x8b"):
        return bool(_kind(_unpacked_head(path)))
    named = any(suffix in _SUFFIXES for suffix in path.suffixes)
    return named and (packed or path.suffix in _SUFFIXES)


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """Open a bag; any error while it is read becomes an InputError.

    Yields:
        A reader of rosbags, whose `connections`, `messages` and `deserialize` are used.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        advice = "pip install '.[ros]'"
        raise InputError("is a ROS bag, which needs rosbags", path=path, advice=advice) from None
    if not path.exists():
        raise InputError("does not exist", path=path, advice="check the name")
    _check_packing(path)
    try:
        with TemporaryDirectory() as folder:
            links = [_link(Path(folder), index, x) for index, x in enumerate(_parts(path))]
            with AnyReader(links, default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
                yield bag
    except InputError:
        raise
    except Exception as error:  # rosbags does not document what a damaged bag raises
        reason = " ".join(str(error).split())[:200]
        problem = f"is a bag that cannot be read ({type(error).__name__}: {reason})"
        raise InputError(problem, path=path, advice=_advice(reason)) from None


def _kind(head: bytes) -> str:
    """Suffix of the kind of bag that begins so; "" if it is none."""
    return next((suffix for magic, suffix in _MAGIC.items() if head.startswith(magic)), "")


def _head(path: Path) -> bytes:
    """First bytes of a file; none if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(HEAD)
    except OSError:
        return b""


def _unpacked_head(path: Path) -> bytes:
    """First bytes of what is in a gzip file; none if it is damaged."""
    try:
        with gzip.open(path, "rb") as file:
            return file.read(HEAD)
    except (OSError, EOFError, zlib.error):
        return b""


def _files(folder: Path) -> list[Path]:
    """Bag files of one kind in a folder, in order of their names."""
    files = [path for path in sorted(folder.iterdir()) if path.suffix in _SUFFIXES]
    kinds = {path.suffix for path in files}
    return files if len(kinds) == 1 and all(path.is_file() for path in files) else []


def _parts(path: Path) -> list[Path]:
    """What rosbags is to open: a file, a folder of ROS 2, or all files of another folder.

    A file of a folder of ROS 2 stands for the folder.
    """
    if path.is_dir():
        return [path] if (path / "metadata.yaml").is_file() else _files(path)
    in_folder = path.suffix in ROS2_SUFFIXES and (path.parent / "metadata.yaml").is_file()
    return [path.parent] if in_folder else [path]


def _link(folder: Path, index: int, path: Path) -> Path:
    """A link to a bag, named as rosbags expects it."""
    suffix = "" if path.is_dir() else _kind(_head(path)) or path.suffix
    link = folder / f"bag{index}{suffix}"
    link.symlink_to(path.resolve(), target_is_directory=path.is_dir())
    return link


def _check_packing(path: str | PathLike) -> None:
    """Raise if a file must be unpacked first, or belongs to an old version."""
    path = Path(path)
    if path.is_dir():
        return
    head = _head(path)
    for magic, command in _PACKED.items():
        if head.startswith(magic):
            problem = "is a packed bag"
            raise InputError(problem, path=path, advice=f"unpack it first: {command} {path.name}")
    if head.startswith(_OLD_BAG) and not _kind(head):
        version = head.split(b"\n")[0].decode("latin-1")
        problem = f"is a bag of another version ({version})"
        raise InputError(problem, path=path, advice="convert it with `rosbag fix`")


def _advice(reason: str) -> str:
    """What to do about an error of rosbags."""
    if "index" in reason.lower():
        return "it was not closed: run `rosbag reindex` (ROS 1) or `ros2 bag reindex` on it"
    if "type definitions" in reason or "typestore" in reason:
        return "record it again with a newer ROS, which stores the types of its messages"
    return "copy it again, or reindex it: `rosbag reindex` (ROS 1), `ros2 bag reindex` (ROS 2)"
