"""Arguments as JAX arrays, checked by name."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import AnyArray, Array, as_numpy, check_array, check_numbers


def as_float(name: str, x: Any, shape: tuple[Any, ...]) -> Array:
    """A JAX array of floats made of a NumPy array, a list or a JAX array of numbers, checked.

    Args:
        name: Name of `x`, for the message.
        x: Numbers; what is not a JAX array of floats becomes one of JAX's default precision.
        shape: As of `check_array`.

    Raises:
        ValueError: It holds no numbers or has another shape; the message states both.
    """
    x = as_array(name, x)
    check_numbers(name, x)
    if not (isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)):
        x = jnp.asarray(x, float)
    check_array(name, x, shape, jnp.floating)
    return x


def as_bool(name: str, x: Any, shape: tuple[Any, ...]) -> Array:
    """A JAX array of bools made of a NumPy array, a list or a JAX array of bools, checked.

    Args:
        name: Name of `x`, for the message.
        x: Bools; numbers are refused.
        shape: As of `check_array`.

    Raises:
        ValueError: It holds no bools or has another shape; the message states both.
    """
    x = as_array(name, x)
    check_array(name, x, shape, np.bool_)
    return jnp.asarray(x)


def as_array(name: str, x: Any) -> AnyArray:
    """An array made of anything array-like; raise ValueError, naming it, if it is none."""
    return x if isinstance(x, jax.Array) else as_numpy(name, x)


def check_covariance(name: str, cov: Array, *, definite: bool = True) -> None:
    """Check that covariance matrices are finite, symmetric and positive definite.

    Nothing is checked while tracing, when there are no values.

    Args:
        name: Name of `cov`, for the message.
        cov: (..., n, n) the matrices.
        definite: False also accepts semi-definite ones: something known for certain.

    Raises:
        ValueError: One is not; the message states which, and why.
    """
    if isinstance(cov, jax.core.Tracer):
        return
    matrices = np.asarray(cov, float)
    for index in np.ndindex(matrices.shape[:-2]):
        matrix, label = matrices[index], name + (str(list(index)) if index else "")
        if not np.isfinite(matrix).all():
            raise ValueError(f"{label} holds numbers that are not finite")
        scale = np.abs(matrix).max()
        asymmetry = np.abs(matrix - matrix.T)
        if asymmetry.max() > 1e-5 * scale:
            i, j = np.unravel_index(np.argmax(asymmetry), matrix.shape)
            upper, lower = matrix[i, j], matrix[j, i]
            raise ValueError(
                f"{label} is not symmetric: [{i}, {j}] is {upper:g}, [{j}, {i}] {lower:g}"
            )
        smallest = np.linalg.eigvalsh((matrix + matrix.T) / 2)[0]
        if not (smallest > 0.0 if definite else smallest >= -1e-6 * scale):
            wanted = "positive definite" if definite else "positive semi-definite"
            raise ValueError(f"{label} is not {wanted}: its smallest eigenvalue is {smallest:g}")
