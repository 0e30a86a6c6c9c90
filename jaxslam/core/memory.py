"""Memory of this process."""

import ctypes
import os
import re
import sys
from pathlib import Path


def peak_memory() -> float:
    """Most memory [MB] that this process has held; `resource` counts its parent's too."""
    return _of_status("VmHWM")


def memory_now() -> float:
    """Memory [MB] that this process holds; where the system does not say, `peak_memory`."""
    return _of_status("VmRSS")


def _of_status(name: str) -> float:
    status = Path("/proc/self/status")
    found = re.search(rf"{name}:\s+(\d+)", status.read_text()) if status.is_file() else None
    if found:
        return int(found[1]) / 1024
    import resource  # Unix has it

    unit = 2**20 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def release_memory() -> None:
    """Return memory freed by the compiler to the system: two gigabytes that malloc would keep."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:  # glibc has it
        trim(0)
