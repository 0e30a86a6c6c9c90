"""Logs, maps and results in files: one module a format; README.md lists them."""

from jaxslam.io.errors import InputError as InputError
from jaxslam.io.readers import NAMED_LOGS as NAMED_LOGS
from jaxslam.io.readers import read_log as read_log
