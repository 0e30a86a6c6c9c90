"""Checks of a model, by the shapes that its functions return. Nothing is compiled."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxslam.core.types import Array
from jaxslam.tuning.model import Model


def check_hashable(name: str, x: Any) -> None:
    """Raise ValueError unless something can be static under jit."""
    try:
        hash(x)
    except TypeError as error:
        raise ValueError(
            f"{name} is {x!r}, which has no hash ({error}): give a function, or a frozen "
            "record of functions and numbers"
        ) from None


def check_model(model: Model, params: Any, sequence: Any) -> None:
    """Raise ValueError unless the functions of a model fit together on a sequence.

    Args:
        model: The model.
        params: Its parameters.
        sequence: One sequence; its values are not looked at.

    Raises:
        ValueError: A function fails, with the first line of its message; the inputs have no steps,
            or differ in their number; `step` returns no pair, or a state with other leaves, shapes
            or types than the state that it was given.
    """
    state = _shapes("model.init(params, sequence)", model.init, params, sequence)
    inputs = _shapes("model.inputs(params, sequence)", model.inputs, params, sequence)
    lengths = {_name(path): leaf.shape[:1] for path, leaf in _leaves(inputs)}
    for path, size in lengths.items():
        if not size or not size[0]:
            found = "has no steps" if size else "is a number"
            raise ValueError(
                f"model.inputs(params, sequence){path} {found}, not an array that leads with the "
                "steps: data are arrays (B, T, ...), or Model.inputs makes those of the steps"
            )
    if not lengths:
        raise ValueError("model.inputs(params, sequence) has no arrays that lead with the steps")
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{name or 'it'} {size[0]}" for name, size in lengths.items())
        raise ValueError(f"model.inputs(params, sequence) differs in the number of steps: {text}")
    now = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), inputs)
    result = _shapes("model.step(params, state, now)", model.step, params, state, now)
    if not (type(result) is tuple and len(result) == 2):
        raise ValueError("model.step(params, state, now) returns no pair of state and info")
    before, after = dict(_leaves(state)), dict(_leaves(result[0]))
    for path in [*before, *(path for path in after if path not in before)]:
        old, new = (_text(leaves.get(path)) for leaves in (before, after))
        if old != new:
            raise ValueError(
                f"model.step(params, state, now): state{_name(path)} is {new} after the step and "
                f"{old} before it; both must be the same"
            )
    wanted, found = str(jax.tree.structure(state)), str(jax.tree.structure(result[0]))
    if found != wanted:
        raise ValueError(
            "model.step(params, state, now) returns another structure than its state: "
            f"{found}, not {wanted}"
        )


def called(name: str, function: Callable, *given: Any) -> Any:
    """Result of a user's function; ValueError of one line, with its name, where it fails."""
    try:
        return function(*given)
    except Exception as error:
        lines = str(error).strip().splitlines() or [""]
        raise ValueError(f"{name}: {type(error).__name__}: {lines[0]}") from error


def call(name: str, function: Callable, shape: tuple[int, ...], *given: Any) -> Array:
    """Result of a user's function as an array of floats of the shape that it must have."""
    return float_array(name, called(name, function, *given), shape)


def float_array(name: str, result: Any, shape: tuple[Any, ...]) -> Array:
    """What a user's function returned, as an array of floats; a string stands for any size.

    Raises:
        ValueError: It is none, or has another shape.
    """
    try:
        array = jnp.asarray(result)
    except (TypeError, ValueError):
        raise ValueError(f"{name} returns {type(result).__name__}, not an array") from None
    fits = len(shape) == array.ndim and all(
        isinstance(size, str) or size == own for size, own in zip(shape, array.shape, strict=True)
    )
    if not fits or not jnp.issubdtype(array.dtype, jnp.floating):
        wanted = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
        raise ValueError(f"{name} returns {_text(array)}, not floats {wanted}")
    return array


def _shapes(name: str, function: Callable, *given: Any) -> Any:
    """Shapes of what a function of a model returns."""
    try:
        return jax.eval_shape(function, *given)
    except ValueError as error:
        lines = str(error).strip().splitlines() or [""]
        raise ValueError(f"{name}: {lines[0]}") from error
    except Exception as error:
        lines = str(error).strip().splitlines() or [""]
        raise ValueError(f"{name}: {type(error).__name__}: {lines[0]}") from error


def _leaves(tree: Any) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_leaves_with_path(tree)


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path)


def _text(leaf: Any) -> str:
    return "missing" if leaf is None else f"{leaf.dtype} {leaf.shape}"
