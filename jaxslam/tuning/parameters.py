"""Noise parameters as the optimiser sees them: logarithms, names, what is trainable."""

from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxslam.core.types import check_type
from jaxslam.filtering.noise import NoiseParams


def unconstrain(params: NoiseParams) -> NoiseParams:
    """Logarithms of the noise: the numbers that the optimiser sees."""
    return jax.tree.map(jnp.log, params)


def constrain(theta: NoiseParams) -> NoiseParams:
    """Noise from its logarithms; the inverse of `unconstrain`."""
    return jax.tree.map(jnp.exp, theta)


def flatten_params(params: NoiseParams) -> np.ndarray:
    """Logarithms (P,) float64 of the parameters."""
    return np.log(np.asarray(ravel_pytree(params)[0], np.float64))


def unflatten_params(theta: Any, like: NoiseParams) -> NoiseParams:
    """Noise from logarithms (P,), with the fields and precision of another."""
    flat, unravel = ravel_pytree(like)
    return constrain(unravel(jnp.asarray(theta, flat.dtype)))


def param_names(params: NoiseParams) -> tuple[str, ...]:
    """Names of the P parameters: `range_std`, or `odometry_coefficients[2]` of several.

    Raises:
        ValueError: It is no `NoiseParams`.
    """
    check_type("params", params, NoiseParams)
    return tuple(
        f"{field}[{i}]" if np.ndim(value) else field
        for field, value in params._asdict().items()
        if value is not None
        for i in range(np.size(value))
    )


def trainable_mask(params: NoiseParams, frozen: Collection[str] = ()) -> np.ndarray:
    """Mask (P,) bool of the parameters that are tuned.

    Args:
        params: The noise.
        frozen: Names of parameters that are not tuned, or of fields: `odometry_coefficients` is
            all four.

    Raises:
        ValueError: There is no such parameter, or none is left to tune.
    """
    if isinstance(frozen, str):
        raise ValueError(f"frozen is the string {frozen!r}, not a collection of names")
    known = param_names(params)
    unknown = set(frozen) - set(known) - set(params._fields)
    if unknown:
        name = sorted(unknown, key=str)[0]
        raise ValueError(f"no parameter is called {name!r}; known: {', '.join(known)}")
    trainable = np.array([not {name, name.split("[")[0]} & set(frozen) for name in known])
    if not trainable.any():
        raise ValueError("all parameters are frozen: nothing is left to tune")
    return trainable


def scale_param(params: NoiseParams, index: int, by: float) -> NoiseParams:
    """The noise with one of its P parameters multiplied by exp(by)."""
    flat, unravel = ravel_pytree(params)
    return unravel(flat.at[index].multiply(jnp.exp(jnp.asarray(by, flat.dtype))))
