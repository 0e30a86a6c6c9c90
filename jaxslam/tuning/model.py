"""What can be tuned: any state-space model, by the functions of one sequence.

    state = init(params, sequence)
    for now in inputs(params, sequence):
        state, info = step(params, state, now)

`lax.scan` runs the steps, `vmap` and devices the sequences, reverse-mode derivatives go through all
of it. The SLAM filter is one such model (`slam_model`), an EKF of your own functions another
(`ekf_model.ekf_model`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import BatchSize


def whole_sequence(params: Any, sequence: Any) -> Any:
    """The sequence as it is: `Model.inputs` by default."""
    del params
    return sequence


def as_arrays(params: Any, data: Any, name: str) -> tuple[Any, Any]:
    """The parameters, and data [B] as arrays: `Model.check` by default.

    Raises:
        ValueError: They hold no arrays, or something that is no array of numbers, or differ in B,
            or B is 0.
    """
    leaves = jax.tree_util.tree_leaves_with_path(data)
    if not leaves:
        raise ValueError(f"{name} holds no arrays")

    def convert(path: Any, leaf: Any) -> Any:
        own = f"{name}{jax.tree_util.keystr(path)}"
        array = leaf if isinstance(leaf, jax.Array | np.ndarray) else np.asarray(leaf)
        if array.ndim < 1 or array.dtype.kind not in "fiub":
            wanted = "an array of numbers that leads with the number of sequences"
            raise ValueError(f"{own} is {array.dtype} {array.shape}, not {wanted}")
        return _in_default_precision(own, array)

    arrays = jax.tree_util.tree_map_with_path(convert, data)
    sizes = {f"{name}{jax.tree_util.keystr(path)}": np.shape(leaf)[0] for path, leaf in leaves}
    if len(set(sizes.values())) > 1:
        text = ", ".join(f"{own} {size}" for own, size in sizes.items())
        raise ValueError(f"{name} differ in the number of sequences: {text}")
    if not min(sizes.values()):
        raise ValueError(f"{name}: no sequences")
    return params, arrays


def _in_default_precision(name: str, array: Any) -> Any:
    """An array in JAX's default precision; ValueError where its numbers are too large for it."""
    wanted = array.dtype
    if array.dtype.kind == "f":
        wanted = np.dtype(jnp.zeros(()).dtype)
    elif array.dtype.kind in "iu":
        wanted = np.dtype(jax.dtypes.canonicalize_dtype(array.dtype))
    if array.dtype == wanted:
        return array
    with np.errstate(over="ignore"):
        converted = array.astype(wanted)
    lost = np.isinf(converted) & ~np.isinf(array) if wanted.kind == "f" else converted != array
    if np.any(lost):
        at = np.argwhere(np.asarray(lost))[0].tolist()
        raise ValueError(
            f"{name}{at} is {array[tuple(at)]}, too large for {wanted}; use other units, or 64 bits"
        )
    return converted


class Model(NamedTuple):
    """A model whose parameters are tuned; hashable, static under jit.

    Its functions are pure, and the same objects in all calls: another object is compiled again.

    Attributes:
        init: Parameters and a sequence to the state before the first step.
        step: Parameters, state and the input of a step to the state after it, of the same shapes
            and types, and anything that the loss needs of the step.
        inputs: Parameters and a sequence to the inputs of its steps, arrays that lead with the
            number of steps T.
        check: Parameters, data [B] and their name for messages, to both in arrays; raises
            ValueError where they do not fit the model. Nothing is compiled yet.
        batch_size: Number of sequences that a device runs together; bounds memory. Of a
            `BatchSize` that of the devices.
    """

    init: Callable[..., Any]
    step: Callable[..., tuple[Any, Any]]
    inputs: Callable[..., Any] = whole_sequence
    check: Callable[..., tuple[Any, Any]] = as_arrays
    batch_size: int | BatchSize = 512


def run_model(model: Model, params: Any, sequence: Any) -> tuple[Any, Any]:
    """The state after the last step of a sequence, and what the steps returned, [T]."""

    def body(state: Any, now: Any) -> tuple[Any, Any]:
        return model.step(params, state, now)

    return lax.scan(body, model.init(params, sequence), model.inputs(params, sequence))


def num_steps(model: Model, params: Any, data: Any) -> int:
    """Number T of steps of the sequences of data [B]."""
    sequence = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x)[1:], x.dtype), data)
    inputs = jax.eval_shape(lambda *given: model.inputs(*given), params, sequence)
    return jax.tree.leaves(inputs)[0].shape[0]
