"""The noise parameters of the filter (Q and R) in a file, `noise.json`.

{"format": "jaxslam-noise", "version": 1, "noise": {key: number or list}}

The keys are those of `KEYS`; `metrics.json` of `jaxslam tune` has the same.
"""

import json
from collections.abc import Mapping
from os import PathLike
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.output import write_json
from jaxslam.io.text import lines

FORMAT, VERSION = "jaxslam-noise", 1

KEYS: Mapping[str, str] = MappingProxyType(
    {
        "odometry_coefficients": "odometry",
        "range_std": "range",
        "bearing_std": "bearing",
        "feature_std_scale": "scale",
        "wall_angle_std": "wall",
        "scan_match_std_scale": "alignment",
    }
)
"""Key in files of each field of `NoiseParams`; other fields are their own keys."""

Noise = TypeVar("Noise", bound=NamedTuple)
"""Any NamedTuple of arrays."""


def key_of(name: str) -> str:
    """Key of a field or of one of its numbers: `range`, `odometry[2]`."""
    field, bracket, index = name.partition("[")
    return KEYS.get(field, field) + bracket + index


def name_of(key: str) -> str:
    """Field, or one of its numbers, that a key means; the inverse of `key_of`."""
    own, bracket, index = key.partition("[")
    fields = {key: field for field, key in KEYS.items()}
    return fields.get(own, own) + bracket + index


def to_keys(noise: NamedTuple) -> dict[str, Any]:
    """The fields of a record of noise parameters by their keys in files."""
    return {key_of(field): value for field, value in noise._asdict().items()}


def write(path: str | PathLike, noise: NamedTuple) -> None:
    """Write a record of noise parameters.

    Args:
        path: File to write, atomically.
        noise: NamedTuple of arrays, finite and positive; fields that are None are left out.

    Raises:
        InputError: A value is not finite and positive, or the file cannot be written.
    """
    numbers = {key: value for key, value in to_keys(noise).items() if value is not None}
    for key, value in numbers.items():
        _check_values(path, key, np.asarray(value, np.float64))
    write_json(path, {"format": FORMAT, "version": VERSION, "noise": numbers})


def read(path: str | PathLike, template: Noise) -> Noise:
    """Read a record of noise parameters.

    Args:
        path: File that `write` wrote.
        template: Record with the expected fields, shapes and dtypes; a field that is None may be
            in the file, and stays None.

    Returns:
        A record of the template's type, of NumPy arrays.

    Raises:
        InputError: The file cannot be read, is no such file, lacks a key, has an unknown one, or
            the shape or values of one are wrong.
    """
    numbers, expected = _load(path), to_keys(template)
    for key in numbers.keys() - expected.keys():
        advice = f"the fields are {', '.join(expected)}"
        raise InputError("unknown field", path=path, field=key, advice=advice)
    for key, like in expected.items():
        if like is not None and key not in numbers:
            raise InputError("missing", path=path, field=key, advice="add it, or tune again")
    return template._make(
        None if like is None else _parse_field(path, key, numbers[key], like)
        for key, like in expected.items()
    )


def _load(path: str | PathLike) -> dict[str, Any]:
    """The numbers of a noise file by their keys, not yet checked."""
    advice = "name a noise.json written by `jaxslam tune`"
    try:
        content = json.loads(b"".join(line for _, line in lines(path)))
    except json.JSONDecodeError as error:
        problem = f"is not JSON ({error.msg})"
        raise InputError(problem, path=path, line=error.lineno, advice=advice) from None
    except (UnicodeDecodeError, RecursionError):
        raise InputError("is not JSON", path=path, advice=advice) from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"is no {FORMAT} file", path=path, field="format", advice=advice)
    if content.get("version") != VERSION:
        problem = f"{content.get('version')!r} instead of {VERSION}"
        raise InputError(problem, path=path, field="version", advice=advice)
    if not isinstance(content.get("noise"), dict):
        raise InputError("missing or no object", path=path, field="noise", advice=advice)
    return content["noise"]


def _parse_field(path: str | PathLike, key: str, value: Any, like: Any) -> Any:
    """One field as an array of the shape and dtype of `like`."""
    like = np.asarray(like)
    form = "a number" if like.shape == () else f"numbers of shape {like.shape}"
    try:
        array = np.array(value)
    except ValueError:  # ragged lists
        array = np.array(None)
    if array.dtype.kind not in "fiu" or array.shape != like.shape:
        raise InputError(f"is not {form}", path=path, field=key, advice=f"give {form}")
    _check_values(path, key, array.astype(np.float64))
    return array.astype(like.dtype)


def _check_values(path: str | PathLike, key: str, array: np.ndarray) -> None:
    """Raise unless all values are finite and positive."""
    if not (np.isfinite(array) & (array > 0.0)).all():
        advice = "standard deviations are finite and above 0"
        raise InputError(f"{array.tolist()} is not positive", path=path, field=key, advice=advice)
