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

from jaxslam.tuning.transforms import CHOLESKY, Transform, of_leaves


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
            numbers = np.asarray(leaf, np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"{own} is a {type(leaf).__name__}, not a number") from None
        finite = np.isfinite(numbers).all()
        if not finite or not transform.domain(numbers, *transform.constants):
            wanted = f"{transform.text} and finite" if transform.text != "a number" else "finite"
            raise ValueError(f"{own} is {numbers.tolist()}, not {wanted}")
        arrays.append(jnp.asarray(leaf, float))
    return jax.tree.unflatten(jax.tree.structure(params), arrays)


def flatten_params(params: Any, transforms: Any = None) -> np.ndarray:
    """Unconstrained numbers (P,) float64 of parameters."""
    return np.concatenate([np.ravel(x) for x in _host_theta(params, of_leaves(params, transforms))])


def unflatten_params(theta: Any, like: Any, transforms: Any = None) -> Any:
    """Parameters from unconstrained numbers (P,), with the tree of others, in JAX's precision."""
    leaves = _host_params(theta, like, of_leaves(like, transforms))
    arrays = [jnp.asarray(x, float) for x in leaves]
    return jax.tree.unflatten(jax.tree.structure(like), arrays)


def _host_params(theta: Any, like: Any, transforms: Sequence[Transform]) -> list[np.ndarray]:
    """The leaves of parameters of unconstrained numbers (P,), float64."""
    shapes = [np.shape(x) for x in _host_theta(like, transforms)]
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = np.split(np.asarray(theta, np.float64), ends[:-1])
    with np.errstate(all="ignore"):  # an optimiser may propose what overflows
        return [
            one.forward(part.reshape(shape), *one.constants)
            for part, shape, one in zip(parts, shapes, transforms, strict=True)
        ]


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


def param_names(params: Any, transforms: Any = None) -> tuple[str, ...]:
    """Names of the P unconstrained numbers: `range_std`, `odometry_coefficients[2]`, `w.b[0,1]`.

    Those of a matrix by its Cholesky factor are the elements of the factor.
    """
    names = []
    paths = jax.tree_util.tree_leaves_with_path(params)
    for (path, leaf), transform in zip(paths, of_leaves(params, transforms), strict=True):
        own, shape = _path_text(path), np.shape(leaf)
        if transform.forward is CHOLESKY.forward:
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
    """Paths of the fields that are None: names that may be frozen, though there is no number."""
    paths = jax.tree_util.tree_leaves_with_path(params, is_leaf=lambda x: x is None)
    return {_path_text(path) for path, leaf in paths if leaf is None}


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
