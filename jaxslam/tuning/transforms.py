"""Transforms between parameters and the unconstrained numbers that an optimiser changes.

A standard deviation is positive, a correlation is between -1 and 1, a covariance is positive
definite; an optimiser knows none of it. It changes numbers theta, and `forward` makes parameters of
them. A step of 0.4 in theta is a large one (`optimizers.MAX_CHANGE`), and a standard error of 0.5
is that of a parameter which is not known. So theta is in units in which 1 is a change that matters:
a factor of e of what is positive, `scale` of a real number.

| transform | parameter | theta |
|---|---|---|
| `REAL` | any number | the number |
| `real(scale)` | any number | the number / scale |
| `POSITIVE` | above 0 | its logarithm |
| `bounded(low, high)` | between the bounds | its logit |
| `CHOLESKY` | positive definite matrix (n, n) | logarithms of the standard deviations; below them |

Below the diagonal theta is asinh(L_ij / L_ii), with the Cholesky factor L: of two numbers this is
Fisher's z of their correlation, atanh(r). So theta is the same in any units, but for a shift of the
logarithms, and all of its numbers are covariances.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.calibration import Calibration
from jaxslam.filtering.noise import NoiseParams


class Transform(NamedTuple):
    """How a leaf of the parameters is optimised; hashable.

    Its functions take arrays of NumPy and of JAX, and return what they are given.

    Attributes:
        forward: Unconstrained array and constants to the parameter; differentiable.
        inverse: The inverse.
        domain: Array (NumPy) and constants to True if it is a possible value of the parameter.
        text: What values are possible, for messages: "positive".
        constants: Further arguments of the three.
    """

    forward: Callable[..., Any]
    inverse: Callable[..., Any]
    domain: Callable[..., bool]
    text: str
    constants: tuple = ()

    @property
    def is_of_matrix(self) -> bool:
        """Whether the parameter is a matrix, its numbers those of a triangle: `CHOLESKY`."""
        return self.forward is _of_cholesky


def _real_forward(theta: Any, scale: Any) -> Any:
    return theta * theta.__array_namespace__().asarray(scale, dtype=theta.dtype)


def _real_inverse(value: Any, scale: Any) -> Any:
    return value / value.__array_namespace__().asarray(scale, dtype=value.dtype)


def _has_its_scale(value: np.ndarray, scale: Any) -> bool:
    return np.ndim(scale) == 0 or np.shape(value)[-1:] == (len(scale),)


def _exp(theta: Any) -> Any:
    return theta.__array_namespace__().exp(theta)


def _log(value: Any) -> Any:
    return value.__array_namespace__().log(value)


def _exp_scaled(theta: Any, scale: float) -> Any:
    return theta.__array_namespace__().exp(scale * theta)


def _log_scaled(value: Any, scale: float) -> Any:
    return value.__array_namespace__().log(value) / scale


def _is_positive(value: np.ndarray, *_: Any) -> bool:
    return bool(np.all(value > 0.0))


def _bounded_forward(theta: Any, low: float, high: float) -> Any:
    return low + (high - low) * 0.5 * (1.0 + theta.__array_namespace__().tanh(theta / 2))


def _bounded_inverse(value: Any, low: float, high: float) -> Any:
    xp = value.__array_namespace__()
    return xp.log(value - low) - xp.log(high - value)


def _is_between(value: np.ndarray, low: float, high: float) -> bool:
    return bool(np.all((value > low) & (value < high)))


def _triangle(size: int) -> tuple[np.ndarray, np.ndarray]:
    """The elements of a lower triangle: unit matrices (P, n, n), and which are diagonal (P,)."""
    rows, columns = np.tril_indices(size)
    units = np.zeros((len(rows), size, size))
    units[np.arange(len(rows)), rows, columns] = 1.0
    return units, rows == columns


def _of_cholesky(theta: Any) -> Any:
    xp = theta.__array_namespace__()
    units, diagonal = _triangle((math.isqrt(8 * theta.shape[0] + 1) - 1) // 2)
    below = ~xp.asarray(diagonal)
    numbers = xp.where(below, xp.sinh(xp.where(below, theta, 0.0)), 1.0)
    ratios = xp.einsum("p,pij->ij", numbers, xp.asarray(units, dtype=theta.dtype))
    rows = ratios / xp.sqrt(xp.sum(ratios**2, axis=1, keepdims=True))
    root = xp.exp(theta[np.flatnonzero(diagonal)])[:, None] * rows
    return root @ root.T


def _to_cholesky(value: Any) -> Any:
    xp = value.__array_namespace__()
    units, diagonal = _triangle(value.shape[0])
    units = xp.asarray(units, dtype=value.dtype)
    root = xp.linalg.cholesky(value)
    below = xp.arcsinh(xp.einsum("ij,pij->p", root / xp.diagonal(root)[:, None], units))
    logs = xp.einsum("i,pii->p", xp.log(xp.diagonal(value)) / 2, units)
    return xp.where(xp.asarray(diagonal), logs, below)


def _is_positive_definite(value: np.ndarray) -> bool:
    if value.ndim != 2 or not value.size or value.shape[0] != value.shape[1]:
        return False
    std = np.sqrt(np.abs(np.diagonal(value)))
    if not (std > 0.0).all() or not np.allclose(value, value.T, rtol=1e-5, atol=0.0):
        return False
    try:
        return bool(np.isfinite(np.linalg.cholesky(value / std / std[:, None])).all())
    except np.linalg.LinAlgError:
        return False


REAL = Transform(_real_forward, _real_inverse, _has_its_scale, "a number", (1.0,))
"""Any number, as it is."""

POSITIVE = Transform(_exp, _log, _is_positive, "positive")
"""Numbers above 0, by their logarithm."""

CHOLESKY = Transform(_of_cholesky, _to_cholesky, _is_positive_definite, "positive definite")
"""A symmetric, positive definite matrix (n, n), by deviations and its Cholesky factor."""


def _numbers(x: Any) -> np.ndarray | None:
    """An array of floats, or None if it is none."""
    try:
        return np.asarray(x, float)
    except (TypeError, ValueError):
        return None


def real(scale: float | tuple[float, ...]) -> Transform:
    """Any number, in units of `scale`: a change that matters; one for all, or one for each.

    Raises:
        ValueError: A scale is not positive and finite.
    """
    array = _numbers(scale)
    if array is None or array.ndim > 1 or not (np.isfinite(array) & (array > 0.0)).all():
        raise ValueError(f"scale is {scale!r}, not positive and finite, one number or one for each")
    if not array.ndim:
        return REAL._replace(constants=(float(array),))
    text = f"numbers (..., {len(array)}) as their scale is"
    return REAL._replace(text=text, constants=(tuple(array.tolist()),))


def positive(scale: float) -> Transform:
    """Numbers above 0, by their logarithm in units of `scale`: a relative change that matters.

    Raises:
        ValueError: The scale is not positive and finite.
    """
    array = _numbers(scale)
    if array is None or array.ndim or not 0.0 < array < math.inf:
        raise ValueError(f"scale is {scale!r}, not positive and finite")
    return Transform(_exp_scaled, _log_scaled, _is_positive, "positive", (scale,))


def bounded(low: float, high: float) -> Transform:
    """Numbers between two bounds, by their logit.

    Raises:
        ValueError: The bounds are not finite, or not in this order.
    """
    arrays = _numbers(low), _numbers(high)
    if any(x is None or x.ndim or not np.isfinite(x) for x in arrays) or not low < high:
        raise ValueError(f"bounds are {low} and {high}, not finite numbers in order")
    text = f"between {low:g} and {high:g}"
    return Transform(_bounded_forward, _bounded_inverse, _is_between, text, (low, high))


CALIBRATION = Calibration._make(
    [positive(0.05), positive(0.05), real(0.1), real((0.1, 0.1, 0.05)), real(0.1)]
)
"""Transforms of a `Calibration`; the scales are [rad / m], [m, m, rad] and [s]."""

BY_FIELD: Mapping[str, Transform] = MappingProxyType(
    {
        "odometry_cov_rate": CHOLESKY,
        "odometry_weights": REAL,
        "measurement_weights": REAL,
        "custom": REAL,
    }
)
"""Transforms of fields of `NoiseParams` that are no standard deviations; others are positive."""


def default_transforms(params: Any) -> Any:
    """Transforms of parameters, in a tree like theirs.

    Fields of `NoiseParams` are positive, but for those of `BY_FIELD`; a `Calibration` has those of
    `CALIBRATION`; any other leaf is a real number.
    """

    def of(node: Any) -> Any:
        if isinstance(node, NoiseParams):
            return NoiseParams._make(
                jax.tree.map(lambda _, f=field: BY_FIELD.get(f, POSITIVE), value)
                for field, value in node._asdict().items()
            )
        return CALIBRATION if isinstance(node, Calibration) else REAL

    return jax.tree.map(of, params, is_leaf=lambda x: isinstance(x, NoiseParams | Calibration))


def of_leaves(params: Any, transforms: Any = None) -> tuple[Transform, ...]:
    """The transform of each leaf of the parameters.

    Args:
        params: Parameters.
        transforms: A tree like theirs, whose leaves are `Transform`s, each for all below it; None
            stands for the default ones, of all parameters or of a part of them.

    Raises:
        ValueError: It is no such tree.
    """
    if transforms is None:
        transforms = default_transforms(params)

    def spread(transform: Any, below: Any) -> Any:
        if transform is None:
            return default_transforms(below)
        return jax.tree.map(lambda _: transform, below)

    found = spread_leaves("transforms", transforms, params, _is_transform_or_none, spread)
    if not all(map(_is_transform, found)):
        wrong = next(x for x in found if not _is_transform(x))
        raise ValueError(f"transforms holds {wrong!r}, not a Transform, as transforms.POSITIVE")
    return tuple(found)


def spread_leaves(
    name: str, given: Any, params: Any, is_leaf: Callable[[Any], bool], spread: Callable
) -> list[Any]:
    """What a tree of options gives for each leaf of the parameters.

    Args:
        name: Of the options, for the message.
        given: A tree like the parameters, whose leaves are options for all below them.
        params: The parameters.
        is_leaf: Whether something is an option.
        spread: Makes of an option, and the parameters below it, the tree of those below.

    Raises:
        ValueError: It is no such tree.
    """
    try:
        whole = jax.tree.map(spread, given, params, is_leaf=is_leaf)
    except (ValueError, TypeError, KeyError) as error:
        if isinstance(given, dict) and isinstance(params, dict) and given.keys() != params.keys():
            parts = [
                f"{which} {', '.join(map(str, sorted(keys, key=str)))}"
                for which, keys in (
                    ("lacks", params.keys() - given.keys()),
                    ("has beside them", given.keys() - params.keys()),
                )
                if keys
            ]
            reason = f"it {' and '.join(parts)}; None stands for the default"
        else:
            reason = str(error).splitlines()[0]
        raise ValueError(f"{name} is no tree like the parameters: {reason}") from None
    return jax.tree.leaves(whole, is_leaf=lambda x: is_leaf(x) and x is not None)


def _is_transform(x: Any) -> bool:
    return isinstance(x, Transform)


def _is_transform_or_none(x: Any) -> bool:
    return x is None or isinstance(x, Transform)
