"""Logs, maps and results in files: one module a format; README.md lists them."""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.io.errors import InputError as InputError
    from jaxslam.io.readers import NAMED_LOGS as NAMED_LOGS
    from jaxslam.io.readers import read_log as read_log
    from jaxslam.io.world_files import read_world as read_world

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.io.errors": "InputError",
        "jaxslam.io.readers": "NAMED_LOGS read_log",
        "jaxslam.io.world_files": "read_world",
    },
)
