"""The one call that makes a second start fast: `enable_caches`."""

import gc
import os
from pathlib import Path

import jax

from jaxslam.core import trace_cache

GC_THRESHOLD = 100_000
"""Threshold of the garbage collector: net new objects between two collections."""

MIN_COMPILE_SECONDS = 0.1
"""Only programs that take this long to compile are kept."""


def enable_caches(folder: str | os.PathLike | None = None) -> None:
    """Keep traced and compiled programs on disk, so that the next process starts fast.

    Call it once, before the first long computation. It turns on the cache of traced programs
    (`trace_cache`) and JAX's cache of compiled programs, both in one folder, and collects garbage
    less often from here on: otherwise garbage collection takes a quarter of the time in which JAX
    traces.

    Args:
        folder: Folder of both caches, made if it is missing. By default the one that JAX is
            configured with (`jax_compilation_cache_dir`), else `jaxslam` in the user's cache folder
            (`$XDG_CACHE_HOME` or `~/.cache`); where that cannot be written, nothing is kept.

    Raises:
        ValueError: `folder` cannot be made or written.
    """
    if folder is not None and not _usable(Path(folder)):
        raise ValueError(f"folder is {str(folder)!r}, not a folder that can be written")
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD)
    trace_cache.enable()
    if folder is None:
        if trace_cache.setting("jax_compilation_cache_dir") is not None:
            return
        folder = _user_folder()
        if not _usable(folder):
            return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)


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
