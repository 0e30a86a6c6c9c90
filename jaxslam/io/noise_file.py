"""The noise parameters of the filter (Q and R) in a file, `noise.json`.

{"format": "jaxslam-noise", "version": 1, "noise": {key: number or list}}

The keys are those of `KEYS`; `metrics.json` of `jaxslam tune` has the same. A record inside the
noise has a key for each of its numbers: `measurement_weights.range`.
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

ODOMETRY = ("distance", "turn", "clearance", "unexplained")
MEASUREMENT = ("range", "incidence", "turn", "clearance", "unexplained")
"""Weights of factors on Q and on R; `filtering.heteroscedastic` has them."""
OPTIONAL: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {
        "odometry_cov_rate": (3, 3),
        **{f"odometry_weights.{name}": (3,) for name in ODOMETRY},
        **{f"measurement_weights.{name}": (3,) for name in MEASUREMENT},
        "student_dof": (),
        "odometry_bias_walk": (3,),
    }
)
"""Shape of each key that a file may have where the template has None; it is read then, too."""
SIGNED = ("odometry_weights", "measurement_weights", "custom")
"""Fields whose numbers may be negative or 0."""
MAY_BE_ZERO = ("odometry_bias_walk",)
"""Fields whose numbers may be 0, but not negative."""
COVARIANCES = ("odometry_cov_rate",)
"""Fields that are covariance matrices."""

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
    """The numbers of a record of noise parameters by their keys in files.

    Fields that are None are left out, except those of `KEYS`.
    """
    found: dict[str, Any] = {}
    for field, value in noise._asdict().items():
        if value is not None or field in KEYS:
            _add_leaves(found, key_of(field), value)
    return found


def _add_leaves(found: dict[str, Any], key: str, node: Any) -> None:
    """Add the leaves of a tree under keys that lead with `key`; those inside that are None, not."""
    children = _children(node)
    if children is None:
        found[key] = node
        return
    for name, child in children.items():
        if child is not None:
            _add_leaves(found, f"{key}.{name}", child)


def _children(node: Any) -> dict[str, Any] | None:
    """Parts of a record, dict, or tuple or list of arrays, by name; None for a leaf."""
    if hasattr(node, "_asdict"):
        return node._asdict()
    if isinstance(node, dict):
        return {str(name): child for name, child in node.items()}
    if isinstance(node, tuple | list) and any(np.ndim(x) or _children(x) for x in node):
        return {str(i): child for i, child in enumerate(node)}
    return None


def write(path: str | PathLike, noise: NamedTuple) -> None:
    """Write a record of noise parameters.

    Args:
        path: File to write, atomically.
        noise: NamedTuple of arrays, finite and positive but for those of `SIGNED`; fields that are
            None are left out.

    Raises:
        InputError: A value is out of range, or the file cannot be written.
    """
    numbers = {key: value for key, value in to_keys(noise).items() if value is not None}
    for key, value in numbers.items():
        _check_values(path, key, np.asarray(value, np.float64))
    write_json(path, {"format": FORMAT, "version": VERSION, "noise": numbers})


def read(path: str | PathLike, template: Noise) -> Noise:
    """Read a record of noise parameters.

    Args:
        path: File that `write` wrote, now or by a version without some of the options.
        template: Record with the expected fields, shapes and dtypes; a field that is None may be
            in the file. One of `OPTIONAL` is then read, another stays None.

    Returns:
        A record of the template's type, of NumPy arrays.

    Raises:
        InputError: The file cannot be read, is no such file, lacks a key, has an unknown one, or
            the shape or values of one are wrong.
    """
    numbers, expected = _load(path), to_keys(template)
    dtype = np.asarray(next(x for x in expected.values() if x is not None)).dtype
    options = {key: np.zeros(shape, dtype) for key, shape in OPTIONAL.items()}
    options = {key: like for key, like in options.items() if _holds(template, key)}
    for key in sorted(numbers.keys() - expected.keys() - options.keys()):
        others = {own.partition(".")[0]: None for own in options if own not in expected}
        advice = f"the fields are {', '.join([*expected, *others])}"
        raise InputError("unknown field", path=path, field=key, advice=advice)
    for key, like in expected.items():
        if like is not None and key not in numbers:
            raise InputError("missing", path=path, field=key, advice="add it, or tune again")
    wanted = {key: like for key, like in options.items() if key in numbers} | expected
    arrays = {
        key: _parse_field(path, key, numbers[key], like)
        for key, like in wanted.items()
        if like is not None
    }
    return _rebuild(template, arrays)


def _holds(record: Any, key: str) -> bool:
    """Whether a record has the field that a key means."""
    return name_of(key).partition(".")[0] in record._fields


def _rebuild(template: Noise, arrays: Mapping[str, Any]) -> Noise:
    """The template with its leaves, and fields that are None, replaced by the arrays of a file."""

    def of(key: str, node: Any) -> Any:
        children = _children(node)
        if children is None:
            return arrays.get(key)
        built = {name: of(f"{key}.{name}", child) for name, child in children.items()}
        if hasattr(node, "_replace"):
            return node._replace(**built)
        if isinstance(node, dict):
            return {name: built[str(name)] for name in node}
        return type(node)(built.values())

    fields = template._asdict()
    for field in fields.keys() & {key.partition(".")[0] for key in arrays if "." in key}:
        if fields[field] is None or hasattr(fields[field], "_asdict"):
            fields[field] = _weights(field, arrays)
    return template._replace(**{field: of(key_of(field), x) for field, x in fields.items()})


def _weights(field: str, arrays: Mapping[str, Any]) -> Any:
    """Record of weights of a field, with those that a file has."""
    # Imported here, because JAX is slow to import.
    from jaxslam.filtering.heteroscedastic import WEIGHTS

    kind: Any = WEIGHTS[field]
    return kind(**{name: arrays.get(f"{field}.{name}") for name in kind._fields})


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
    """Raise unless all values are finite and in the range of their field."""
    field = name_of(key).partition(".")[0].partition("[")[0]
    if field in SIGNED or field in COVARIANCES:
        if not np.isfinite(array).all():
            advice = "give finite numbers"
            raise InputError(f"{array.tolist()} is not finite", path=path, field=key, advice=advice)
        if field in COVARIANCES and not _is_covariance(array):
            advice = "give a symmetric matrix without negative eigenvalues"
            raise InputError("is no covariance", path=path, field=key, advice=advice)
    elif field in MAY_BE_ZERO:
        if not (np.isfinite(array) & (array >= 0.0)).all():
            advice = "give finite numbers of 0 or more"
            raise InputError(f"{array.tolist()} is below 0", path=path, field=key, advice=advice)
    elif not (np.isfinite(array) & (array > 0.0)).all():
        advice = "standard deviations are finite and above 0"
        raise InputError(f"{array.tolist()} is not positive", path=path, field=key, advice=advice)


def _is_covariance(array: np.ndarray) -> bool:
    """Whether a finite matrix (n, n) is symmetric and positive semi-definite, up to rounding."""
    rounding = 1e-5 * np.abs(array).max(initial=0.0)
    return bool(
        np.allclose(array, array.T, rtol=0.0, atol=rounding)
        and np.linalg.eigvalsh((array + array.T) / 2).min() >= -rounding
    )
