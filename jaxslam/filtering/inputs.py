"""What the filter is called with, checked and converted before anything is compiled.

Shapes and types are checked always, while tracing too; values where they are concrete. Floats
become those of the belief, whose precision is that of the filter.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_float, check_covariance
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.types import Array, check_array, check_type
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.heteroscedastic import WEIGHTS
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.odometry_bias import NUM_BIASES

# Fields of `Features` that hold floats, with their trailing sizes.
FLOATS: dict[str, tuple[int, ...]] = {
    "xy": (2,),
    "cov": (2, 2),
    "direction": (),
    "direction_variance": (),
    "descriptor": (),
    "incidence": (),
}
# The other fields of `Features`, with the kind of numbers they accept and their type.
OTHERS = {
    "kind": (jnp.integer, jnp.int32),
    "degree": (jnp.integer, jnp.int32),
    "certified": (jnp.bool_, jnp.bool_),
    "trusted": (jnp.bool_, jnp.bool_),
    "valid": (jnp.bool_, jnp.bool_),
}
MAY_BE_ZERO = ("odometry_coefficients", "odometry_bias_walk")  # what does not grow
OPTIONAL = tuple(NoiseParams._field_defaults)  # fields of the noise that may be None
SHAPES: dict[str, tuple[int, ...]] = {
    "odometry_coefficients": (4,),
    "odometry_cov_rate": (3, 3),
    "odometry_bias_walk": (NUM_BIASES,),
}
"""Shapes of the fields of `NoiseParams` that are no single number."""


def check_inputs(
    params: NoiseParams, belief: Belief, measurement: Measurement, *, over_time: bool
) -> tuple[NoiseParams, Measurement]:
    """Check what `step` or `run_filter` is called with.

    Args:
        params: Noise parameters.
        belief: Belief.
        measurement: Measurement; records may hold NumPy arrays, lists and JAX arrays.
        over_time: Whether the measurement leads with T, as of `run_filter`.

    Returns:
        Noise parameters and measurement as JAX arrays in the belief's precision.

    Raises:
        ValueError: A record, shape, type or value is wrong, or there is scan matching and
            `params.scan_match_std_scale` is None; the message states which. The reverse is no
            error: loop closures use that parameter, too.
    """
    check_type("belief", belief, Belief)
    check_array("belief.mean", belief.mean, ("D",), jnp.floating)
    dtype = belief.mean.dtype
    params = check_params(params, dtype)
    name = "measurements" if over_time else "measurement"
    check_type(name, measurement, Measurement)
    scan_match = measurement.scan_match
    if scan_match is not None and params.scan_match_std_scale is None:
        raise ValueError(f"params.scan_match_std_scale is None, but {name}.scan_match is given")
    odometry = _floats(f"{name}.odometry", measurement.odometry, ("T", 3)[not over_time :], dtype)
    lead = odometry.shape[:-1]
    features = as_features(f"{name}.features", measurement.features, lead, dtype)
    ids = measurement.landmark_ids
    if ids is not None:
        ids = _check_ids(f"{name}.landmark_ids", ids, features, belief.num_seen.size)
    if scan_match is not None:
        scan_match = as_scan_match(f"{name}.scan_match", scan_match, lead, dtype)
    return params, Measurement(odometry, features, ids, scan_match)


def check_params(
    params: NoiseParams, dtype: Any = float, *, check_values: bool = True
) -> NoiseParams:
    """Check noise parameters, and convert them to JAX arrays.

    Args:
        params: Noise parameters.
        dtype: Type of the floats; by default JAX's.
        check_values: Whether values are checked, where they are concrete.

    Raises:
        ValueError: A shape is wrong, or a value is concrete and not positive and finite; those of
            `odometry_coefficients` may be 0, `odometry_cov_rate` is positive semi-definite, and
            weights are only finite.
    """
    check_type("params", params, NoiseParams)

    def convert(field: str, value: Any) -> Any:
        if value is None and field in OPTIONAL:
            return None
        name = f"params.{field}"
        if field == "custom":
            return as_tree(name, value, dtype, check_values=check_values)
        if field in WEIGHTS:
            return _as_weights(name, value, WEIGHTS[field], dtype, check_values=check_values)
        array = _floats(name, value, SHAPES.get(field, ()), dtype)
        if check_values:
            _check_values(name, field, array)
        return array

    return NoiseParams._make(convert(field, value) for field, value in params._asdict().items())


def _as_weights(name: str, weights: Any, kind: Any, dtype: Any, *, check_values: bool) -> Any:
    """A record of weights, each (3,) or None, as JAX arrays; checked, finite where concrete."""
    check_type(name, weights, kind)
    given = {field: x for field, x in weights._asdict().items() if x is not None}
    arrays = {field: _floats(f"{name}.{field}", x, (3,), dtype) for field, x in given.items()}
    for field, array in arrays.items():
        numbers = concrete_values(array)
        if check_values and numbers is not None and not np.isfinite(numbers).all():
            raise ValueError(f"{name}.{field} is {numbers.tolist()}, not finite")
    return kind(**arrays)


def as_tree(name: str, tree: Any, dtype: Any, *, check_values: bool) -> Any:
    """A tree of arrays of any shapes as JAX arrays of floats; checked, finite where concrete."""

    def convert(path: Any, x: Any) -> Array:
        own = name + jax.tree_util.keystr(path)
        array = as_float(own, x, (...,)).astype(dtype)
        numbers = concrete_values(array)
        if check_values and numbers is not None and not np.isfinite(numbers).all():
            raise ValueError(f"{own} holds numbers that are not finite")
        return array

    return jax.tree_util.tree_map_with_path(convert, tree)


def _check_values(name: str, field: str, array: Array) -> None:
    """Raise ValueError if the values of a field of the noise are concrete and out of range."""
    numbers = concrete_values(array)
    if numbers is None:
        return
    if field == "odometry_cov_rate":
        check_covariance(name, array, definite=False)
        return
    in_range = numbers >= 0.0 if field in MAY_BE_ZERO else numbers > 0.0
    if not np.all(in_range & np.isfinite(numbers)):
        wanted = "non-negative" if field in MAY_BE_ZERO else "positive"
        raise ValueError(f"{name} is {numbers.tolist()}, not {wanted} and finite")


def concrete_values(x: Array) -> np.ndarray | None:
    """Values of an array as NumPy; None while tracing, or where other processes hold some."""
    if isinstance(x, jax.core.Tracer) or not x.is_fully_addressable:
        return None
    return np.asarray(x)


def as_features(name: str, features: Features, lead: tuple[int, ...], dtype: Any) -> Features:
    """Features that lead with `lead` and M, checked and converted.

    Args:
        name: Name of `features`, for messages.
        features: Features; the fields may be NumPy arrays, lists or JAX arrays.
        lead: Sizes of the leading axes: (T,), or () for one scan.
        dtype: Type of the floats.

    Raises:
        ValueError: A shape or type is wrong, or there is no feature at all (M = 0).
    """
    check_type(name, features, Features)
    kind = _as_type(f"{name}.kind", features.kind, (*lead, "M"), jnp.integer, jnp.int32)
    if not kind.shape[-1]:
        raise ValueError(f"{name} holds no feature, M = 0; give one with valid = False")

    def convert(field: str, value: Any) -> Array | None:
        if value is None and field == "incidence":
            return None
        if field in FLOATS:
            return _floats(f"{name}.{field}", value, kind.shape + FLOATS[field], dtype)
        return _as_type(f"{name}.{field}", value, kind.shape, *OTHERS[field])

    return Features._make(convert(field, value) for field, value in features._asdict().items())


def as_scan_match(name: str, scan_match: ScanMatch, lead: tuple[int, ...], dtype: Any) -> ScanMatch:
    """Results of scan matching that lead with `lead`, checked and converted as `as_features`."""
    check_type(name, scan_match, ScanMatch)

    def optional(field: str, shape: tuple[int, ...]) -> Array | None:
        x = getattr(scan_match, field)
        return None if x is None else _floats(f"{name}.{field}", x, shape, dtype)

    return ScanMatch(
        _floats(f"{name}.increment", scan_match.increment, (*lead, 3), dtype),
        _floats(f"{name}.information", scan_match.information, (*lead, 3, 3), dtype),
        _floats(f"{name}.inlier_fraction", scan_match.inlier_fraction, lead, dtype),
        optional("expected", (*lead, 3)),
        optional("expected_variance", (*lead, 3)),
        optional("odometry_weight", lead),
    )


def _check_ids(name: str, ids: Any, features: Features, size: int) -> Array:
    """Known landmarks of the features, of which there are `size` at most."""
    ids = _as_type(name, ids, features.kind.shape, jnp.integer, jnp.int32)
    numbers, valid = concrete_values(ids), concrete_values(features.valid)
    if numbers is not None and valid is not None:
        used = numbers[valid]
        if used.size and not -1 <= used.min() <= used.max() < size:
            wrong = used.max() if used.max() >= size else used.min()
            wanted = f"-1 or a landmark below the belief's {size} (max_landmarks)"
            raise ValueError(f"{name} holds {wrong}, not {wanted}")
    return ids


def _floats(name: str, x: Any, shape: tuple[Any, ...], dtype: Any) -> Array:
    """`as_float` in a given precision."""
    return as_float(name, x, shape).astype(dtype)


def _as_type(name: str, x: Any, shape: tuple[Any, ...], kind: Any, dtype: Any) -> Array:
    """An array-like as a JAX array, its shape and kind of numbers checked."""
    if not isinstance(x, jax.Array):
        try:
            x = np.asarray(x)
        except ValueError:
            raise ValueError(f"{name} is not an array: its parts differ in shape") from None
    check_array(name, x, shape, kind)
    return jnp.asarray(x, dtype)
