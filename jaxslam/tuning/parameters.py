"""Parameters as the optimiser sees them: unconstrained numbers theta (P,), their names.

Parameters are any pytree of float arrays. `theta` in a tree has the same structure, each leaf as
its transform makes it (`transforms`); flat, it is all of these numbers in the order of the leaves.
"""

import math
from collections.abc import Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array
from jaxslam.tuning.transforms import Transform, of_leaves


def constrain(theta: Any, transforms: Sequence[Transform]) -> Any:
    """Parameters from unconstrained numbers in the same tree, by the transform of each leaf."""
    leaves, tree = jax.tree.flatten(theta)
    pairs = zip(leaves, transforms, strict=True)
    return jax.tree.unflatten(tree, [one.forward(x, *one.constants) for x, one in pairs])


def unconstrain(params: Any, transforms: Sequence[Transform]) -> Any:
    """Unconstrained numbers of parameters in the same tree: the inverse of `constrain`.

    They are computed in NumPy, in float64, and returned as arrays of JAX's default float type.
    """
    leaves = [jnp.asarray(x, float) for x in _host_theta(params, transforms)]
    return jax.tree.unflatten(jax.tree.structure(params), leaves)


def _host_theta(params: Any, transforms: Sequence[Transform]) -> list[np.ndarray]:
    """Unconstrained numbers of each leaf, float64."""
    pairs = zip(jax.tree.leaves(params), transforms, strict=True)
    with np.errstate(all="ignore"):  # what is outside its domain becomes NaN
        return [one.inverse(np.asarray(x, np.float64), *one.constants) for x, one in pairs]


def as_params(params: Any, transforms: Any = None, *, name: str = "params") -> Any:
    """Parameters as JAX arrays of the default float type, checked.

    Args:
        params: Numbers, lists of NumPy or JAX arrays, in any pytree.
        transforms: As of `transforms.of_leaves`.
        name: What they are called in the error message.

    Raises:
        ValueError: There are none; or one is no number, or not finite, or outside the domain of
            its transform; the message names it.
    """
    paths = jax.tree_util.tree_leaves_with_path(params)
    if not paths:
        raise ValueError(f"{name} holds no numbers: nothing can be tuned")
    arrays = []
    for (path, leaf), transform in zip(paths, of_leaves(params, transforms), strict=True):
        own = ".".join(filter(None, [name, _path_text(path)]))
        try:
            numbers = np.asarray(leaf)
        except (TypeError, ValueError):
            numbers = np.asarray(None)
        if numbers.dtype.kind not in "fiu" and not jnp.issubdtype(numbers.dtype, jnp.floating):
            what = f"an array of {leaf.dtype}" if np.ndim(leaf) else f"a {type(leaf).__name__}"
            raise ValueError(f"{own} is {what}, not a number")
        if transform.is_of_matrix and numbers.ndim != 2:
            raise ValueError(f"{own} is of the shape {numbers.shape}, not a matrix in one array")
        arrays.append(_as_param(own, numbers, transform))
    return jax.tree.unflatten(jax.tree.structure(params), arrays)


def _as_param(name: str, value: np.ndarray, transform: Transform) -> Array:
    """A leaf in JAX's default float type; ValueError unless it is in the domain of its transform.

    Rounded to single precision it may be on the edge of it, from where no step leads on.
    """
    with np.errstate(all="ignore"):
        numbers = np.asarray(value, np.float64)
        array = jnp.asarray(numbers, float)
        for each, note in (numbers, ""), (np.asarray(array), f" in {array.dtype}"):
            fits = np.isfinite(each).all() and transform.domain(each, *transform.constants)
            each = each.astype(np.float64)
            theta = transform.inverse(each, *transform.constants) if fits else np.nan
            if not np.isfinite(theta).all():
                text = transform.text
                wanted = f"{text} and finite" if text != "a number" else "finite"
                raise ValueError(f"{name} is {numbers.tolist()}, not {wanted}{note}")
    return array


def flatten_params(params: Any, transforms: Any = None) -> np.ndarray:
    """Unconstrained numbers (P,) float64 of parameters."""
    return np.concatenate([np.ravel(x) for x in _host_theta(params, of_leaves(params, transforms))])


def unflatten_params(theta: Any, like: Any, transforms: Any = None) -> Any:
    """Parameters from unconstrained numbers (P,), with the tree of others, in JAX's precision."""
    leaves = _host_params(theta, like, of_leaves(like, transforms))
    arrays = [jnp.asarray(x, float) for x in leaves]
    return jax.tree.unflatten(jax.tree.structure(like), arrays)


def theta_tree(theta: Any, like: Any, transforms: Sequence[Transform]) -> Any:
    """Unconstrained numbers (P,) in the tree of parameters, in JAX's default float type."""
    leaves = [jnp.asarray(x, float) for x in _theta_leaves(theta, like, transforms)]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _theta_leaves(theta: Any, like: Any, transforms: Sequence[Transform]) -> list[np.ndarray]:
    """Unconstrained numbers (P,) in the shapes of those of each leaf, float64."""
    leaves = zip(jax.tree.leaves(like), transforms, strict=True)
    shapes = [theta_shape(leaf, transform) for leaf, transform in leaves]
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = np.split(np.asarray(theta, np.float64), ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def theta_shape(leaf: Any, transform: Transform) -> tuple[int, ...]:
    """Shape of the unconstrained numbers of a leaf of the parameters."""
    shape = np.shape(leaf)
    if transform.is_of_matrix:
        return (shape[0] * (shape[0] + 1) // 2,)
    return shape


def _host_params(theta: Any, like: Any, transforms: Sequence[Transform]) -> list[np.ndarray]:
    """The leaves of parameters of unconstrained numbers (P,), float64."""
    pairs = zip(_theta_leaves(theta, like, transforms), transforms, strict=True)
    with np.errstate(all="ignore"):  # an optimiser may propose what overflows
        return [one.forward(part, *one.constants) for part, one in pairs]


def _path_text(path: Sequence[Any]) -> str:
    """A path in a tree: names joined by dots, numbers in brackets."""
    text = ""
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            text += f".{key.name}"
        elif isinstance(key, jax.tree_util.DictKey) and isinstance(key.key, str):
            text += f".{key.key}"
        else:
            text += str(key)
    return text.removeprefix(".")


def leaf_names(params: Any) -> list[str]:
    """Name of each leaf of the parameters."""
    return [_path_text(path) for path, _ in jax.tree_util.tree_leaves_with_path(params)]


def param_names(params: Any, transforms: Any = None) -> tuple[str, ...]:
    """Names of the P unconstrained numbers: `range_std`, `odometry_coefficients[2]`, `w.b[0,1]`.

    Those of a matrix are the elements of a lower triangle, as `transforms` describes them.
    """
    names = []
    paths = jax.tree_util.tree_leaves_with_path(params)
    for (path, leaf), transform in zip(paths, of_leaves(params, transforms), strict=True):
        own, shape = _path_text(path), np.shape(leaf)
        if transform.is_of_matrix:
            indices = np.stack(np.tril_indices(shape[0]), axis=1)
        else:
            indices = np.argwhere(np.ones(shape, bool)) if shape else np.zeros((1, 0), int)
        for index in indices.tolist():
            names.append(own + (f"[{','.join(map(str, index))}]" if index else ""))
    return tuple(names)


def trainable_mask(params: Any, frozen: Collection[str] = (), transforms: Any = None) -> np.ndarray:
    """Mask (P,) bool of the parameters that are tuned.

    Args:
        params: The parameters.
        frozen: Names of parameters that are not tuned, or of what they are part of:
            `odometry_coefficients` is all four.
        transforms: As of `transforms.of_leaves`.

    Raises:
        ValueError: There is no such parameter, or none is left to tune.
    """
    if isinstance(frozen, str):
        raise ValueError(f"frozen is the string {frozen!r}, not a collection of names")
    if not isinstance(frozen, Collection):
        raise ValueError(f"frozen is {frozen!r}, not a collection of names")
    known = param_names(params, transforms)

    def is_part(name: str, whole: Any) -> bool:
        return name == whole or name.startswith((f"{whole}.", f"{whole}["))

    present = _field_paths(params)
    for whole in sorted(frozen, key=str):
        if whole not in present and not any(is_part(name, whole) for name in known):
            raise ValueError(f"no parameter is called {whole!r}; known: {', '.join(known)}")
    trainable = np.array([not any(is_part(name, whole) for whole in frozen) for name in known])
    if not trainable.any():
        raise ValueError("all parameters are frozen: nothing is left to tune")
    return trainable


def _field_paths(params: Any) -> set[str]:
    """Paths of the fields that are None or empty: they may be frozen, without a number."""
    paths = jax.tree_util.tree_leaves_with_path(params, is_leaf=lambda x: x is None)
    return {_path_text(path) for path, leaf in paths if leaf is None or not np.size(leaf)}


def shift_param(params: Any, index: int, by: float, transforms: Any = None) -> Any:
    """The parameters with one of the P unconstrained numbers changed by `by`."""
    theta = flatten_params(params, transforms)
    theta[index] += by
    return unflatten_params(theta, params, transforms)


def natural_jacobian(theta: np.ndarray, like: Any, transforms: Any = None) -> np.ndarray:
    """Derivative (N, P) of all N numbers of the parameters by the unconstrained ones.

    By central differences in float64: nothing is compiled.
    """
    used = of_leaves(like, transforms)

    def natural(x: np.ndarray) -> np.ndarray:
        return np.concatenate([np.ravel(leaf) for leaf in _host_params(x, like, used)])

    step = 1e-5
    return np.stack(
        [(natural(theta + e) - natural(theta - e)) / (2 * step) for e in step * np.eye(len(theta))],
        axis=1,
    )
