"""The one call that makes a second start fast: `enable_caches`."""

import gc
import os
from pathlib import Path

import jax

from jaxslam.core import trace_cache
from jaxslam.core.cache_limit import limit_size
from jaxslam.core.types import as_count

GC_THRESHOLD = 100_000
"""Threshold of the garbage collector: net new objects between two collections."""

MIN_COMPILE_SECONDS = 0.01
"""Only programs that take this long to compile are kept; reading one takes some milliseconds."""

MAX_BYTES = 2**30
"""Limit of the folder of both caches; programs of a command take 2 to 7 MB."""


def enable_caches(
    folder: str | os.PathLike | None = None, *, max_bytes: int | None = MAX_BYTES
) -> None:
    """Keep traced and compiled programs on disk, so that the next process starts fast.

    Call it once, before the first long computation. It turns on the cache of traced programs
    (`trace_cache`) and JAX's cache of compiled programs, both in one folder, and collects garbage
    less often from here on: otherwise garbage collection takes a quarter of the time in which JAX
    traces.

    Args:
        folder: Folder of both caches, made if it is missing. By default the one that JAX is
            configured with (`jax_compilation_cache_dir`), else `jaxslam` in the user's cache folder
            (`$XDG_CACHE_HOME` or `~/.cache`); where that cannot be written, nothing is kept.
        max_bytes: Above which the files that were used longest ago are removed, by this call; what
            the process adds after it is left to the next one. Other files are never touched, and
            in a folder that JAX is configured with only traced programs. None: no limit.

    Raises:
        ValueError: `folder` cannot be made or written, or `max_bytes` is no whole number from 0.
    """
    if max_bytes is not None:
        max_bytes = as_count("max_bytes", max_bytes, least=0)
    if folder is not None and not _usable(Path(folder)):
        raise ValueError(f"folder is {str(folder)!r}, not a folder that can be written")
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD)
    trace_cache.enable()
    configured = trace_cache.setting("jax_compilation_cache_dir")
    own = folder is not None or configured is None
    if own:
        folder = _user_folder() if folder is None else folder
        if not _usable(Path(folder)):
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    if max_bytes is not None:
        by_jax = trace_cache.setting("jax_compilation_cache_max_size") >= 0
        limit_size(Path(folder or configured), max_bytes, compiled=own and not by_jax)


def _user_folder() -> Path:
    """Folder of this package in the user's cache folder."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(home) / "jaxslam"


def _usable(folder: Path) -> bool:
    """Whether files can be written in a folder, which is made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)
