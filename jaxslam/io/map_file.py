"""Saved maps as NumPy files, `map.npz`: what one session leaves to later ones.

    {"format": "jaxslam-map", "version": 1, name: array, ...}

The arrays are those of `map_arrays`; the file holds no pickled objects.
"""

import os
import zipfile
from os import PathLike
from typing import IO

import numpy as np

from jaxslam.core.types import check_type
from jaxslam.io import map_arrays
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace
from jaxslam.mapping.saved_map import SavedMap

NAME = "map.npz"  # of the file in the output folder of `jaxslam run`
FORMAT, VERSION = "jaxslam-map", 1
MAX_BYTES = 2**31  # of all arrays, unpacked
_OURS = f"name a {NAME} or output folder of `jaxslam run`"
_AGAIN = "copy the file again, or make it by `jaxslam run`"


def write(path: str | PathLike, saved_map: SavedMap) -> None:
    """Write a map.

    Args:
        path: File to write, atomically.
        saved_map: The map, as `pipeline.saving.to_saved_map` makes it.

    Raises:
        ValueError: It is no `SavedMap`, or its covariance is no square matrix.
        InputError: `read` would refuse the map; or the file cannot be written.
    """
    check_type("saved_map", saved_map, SavedMap)
    arrays = map_arrays.pack(saved_map)
    map_arrays.check(path, arrays, "make the map by pipeline.saving.to_saved_map")
    _check_size(path, sum(array.nbytes for array in arrays.values()))
    hit = np.asarray(saved_map.scans.hit)
    if not np.array_equal(arrays["scans.ranges"] > 0.0, hit):
        raise InputError("a beam hit something at 0 m", path=path, field="scans.ranges")
    with replace(path) as file:
        np.savez_compressed(file, format=FORMAT, version=VERSION, **arrays)  # type: ignore[arg-type]


def load_map(path: str | PathLike) -> SavedMap:
    """The map that `jaxslam run` saved.

    Args:
        path: Output folder of `jaxslam run`, or its `map.npz`.

    Returns:
        The map, of NumPy arrays: landmarks with their covariance, topological map, and the
        keyframes' scans [m], poses [m, m, rad] in the map frame and times [s]; `SavedMap` has
        shapes and units.

    Raises:
        InputError: The folder holds no map, or `read` refuses the file.
    """
    if not os.path.isdir(path):
        return read(path)
    file = os.path.join(path, NAME)
    if not os.path.exists(file):
        advice = "name an output folder of `jaxslam run`; older versions wrote no map: run it again"
        raise InputError(f"holds no {NAME}", path=path, advice=advice)
    return read(file)


def read(path: str | PathLike) -> SavedMap:
    """Read a map.

    Args:
        path: File that `write` wrote.

    Raises:
        InputError: The file cannot be read, is damaged or of another kind or version; lacks an
            array or has an unknown one; one has another dtype or shape, or values that cannot be;
            or it is larger than `MAX_BYTES` unpacked.
    """
    try:
        with open(path, "rb") as stream:
            arrays = _load(path, stream)
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice=_OURS) from None
    except IsADirectoryError:
        raise InputError("is a folder", path=path, advice="name a file inside it") from None
    except OSError as error:
        advice = "check the file and its permissions"
        raise InputError(f"cannot be read ({error.strerror})", path=path, advice=advice) from None
    map_arrays.check(path, arrays, _AGAIN)
    return map_arrays.unpack(arrays)


def _load(path: str | PathLike, stream: IO[bytes]) -> dict[str, np.ndarray]:
    """All arrays of a file of this format and version."""
    try:
        with zipfile.ZipFile(stream) as archive:
            num_bytes = sum(member.file_size for member in archive.infolist())
        stream.seek(0)
        file = np.load(stream, allow_pickle=False)
        names = set(file.files)
    except OSError:
        raise
    except Exception as error:  # NumPy and zipfile do not document what damage raises
        problem = f"is no NumPy file that can be read ({type(error).__name__})"
        raise InputError(problem, path=path, advice=_OURS) from None
    with file:
        _check_size(path, num_bytes)
        _check_format(path, file, names)
        names -= {"format", "version"}
        for name in sorted(names - map_arrays.LAYOUT.keys()):
            raise InputError("unknown array", path=path, field=name[:40], advice=_AGAIN)
        for name in map_arrays.LAYOUT:
            if name not in names and name not in map_arrays.OPTIONAL:
                raise InputError("missing", path=path, field=name, advice=_AGAIN)
        return {name: _array(path, file, name) for name in map_arrays.LAYOUT if name in names}


def _check_format(path: str | PathLike, file: np.lib.npyio.NpzFile, names: set[str]) -> None:
    """Raise InputError unless the file says that it is of this format and version."""
    for name in ("format", "version"):
        if name not in names:
            raise InputError(f"missing: this is no {FORMAT}", path=path, field=name, advice=_OURS)
    kind, version = _array(path, file, "format"), _array(path, file, "version")
    if kind.shape or str(kind) != FORMAT:
        problem = f"is {str(kind)[:40]!r}, not {FORMAT!r}"
        raise InputError(problem, path=path, field="format", advice=_OURS)
    if version.shape or version.dtype.kind not in "iu":
        problem = f"is {version.dtype} {version.shape}, not a whole number"
        raise InputError(problem, path=path, field="version", advice=_AGAIN)
    if version != VERSION:
        newer = "install a newer jaxslam, or make the map again with this one by `jaxslam run`"
        advice = newer if version > VERSION else "make the map again by `jaxslam run`"
        problem = f"is {version}, and this jaxslam reads {VERSION}"
        raise InputError(problem, path=path, field="version", advice=advice)


def _check_size(path: str | PathLike, num_bytes: int) -> None:
    """Raise InputError if the arrays are more than `MAX_BYTES`."""
    if num_bytes > MAX_BYTES:
        problem = f"has {num_bytes / 2**30:.1f} GiB of arrays, more than {MAX_BYTES / 2**30:g} GiB"
        raise InputError(problem, path=path, advice="make a map of a part of the log")


def _array(path: str | PathLike, file: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    """An array of the file."""
    try:
        return np.asarray(file[name])
    except Exception as error:  # as above
        problem = f"is damaged ({type(error).__name__})"
        raise InputError(problem, path=path, field=name, advice=_AGAIN) from None
