"""The noise parameters of the filter (Q and R) in a file, `noise.json`.

{"format": "jaxslam-noise", "version": 1, "noise": {field: number or list}}
"""

import json
from os import PathLike
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.output import write_json
from jaxslam.io.text import lines

FORMAT, VERSION = "jaxslam-noise", 1

Noise = TypeVar("Noise")
"""Any NamedTuple of arrays."""


def write(path: str | PathLike, noise: Noise) -> None:
    """Write a record of noise parameters.

    Args:
        path: File to write, atomically.
        noise: NamedTuple of arrays, finite and positive; fields that are None are left out.

    Raises:
        InputError: A value is not finite and positive, or the file cannot be written.
    """
    fields = {name: value for name, value in noise._asdict().items() if value is not None}
    for name, value in fields.items():
        _check_values(path, name, np.asarray(value, np.float64))
    write_json(path, {"format": FORMAT, "version": VERSION, "noise": fields})


def read(path: str | PathLike, template: Noise) -> Noise:
    """Read a record of noise parameters.

    Args:
        path: File that `write` wrote.
        template: Record with the expected fields, shapes and dtypes; a field that is None may be
            in the file, and stays None.

    Returns:
        A record of the template's type.

    Raises:
        InputError: The file cannot be read, is no such file, lacks a field, has an unknown one, or
            a field's shape or values are wrong.
    """
    fields = _load(path)
    expected = template._asdict()
    for name in fields.keys() - expected.keys():
        advice = f"the fields are {', '.join(expected)}"
        raise InputError("unknown field", path=path, field=name, advice=advice)
    for name, like in expected.items():
        if like is not None and name not in fields:
            raise InputError("missing", path=path, field=name, advice="add it, or tune again")
    return template._make(
        None if like is None else _parse_field(path, name, fields[name], like)
        for name, like in expected.items()
    )


def _load(path: str | PathLike) -> dict[str, Any]:
    """The fields of a noise file, not yet checked."""
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


def _parse_field(path: str | PathLike, name: str, value: Any, like: Any) -> Any:
    """One field as an array of the shape and dtype of `like`."""
    like = np.asarray(like)
    form = "a number" if like.shape == () else f"numbers of shape {like.shape}"
    try:
        array = np.array(value)
    except ValueError:  # ragged lists
        array = np.array(None)
    if array.dtype.kind not in "fiu" or array.shape != like.shape:
        raise InputError(f"is not {form}", path=path, field=name, advice=f"give {form}")
    _check_values(path, name, array.astype(np.float64))
    return jnp.asarray(array.astype(like.dtype))


def _check_values(path: str | PathLike, name: str, array: np.ndarray) -> None:
    """Raise unless all values are finite and positive."""
    if not (np.isfinite(array) & (array > 0.0)).all():
        advice = "standard deviations are finite and above 0"
        raise InputError(f"{array.tolist()} is not positive", path=path, field=name, advice=advice)
