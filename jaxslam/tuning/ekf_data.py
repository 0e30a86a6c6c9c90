"""Data of an EKF of your own functions, checked and in arrays. Nothing is compiled."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.types import AnyArray, as_numpy, check_array, check_type
from jaxslam.tuning.model import as_arrays


class EkfSequence(NamedTuple):
    """Data of one sequence, or of many [B]: all arrays lead with B then.

    Attributes:
        inputs: [T] what `motion` is given at each step, arrays that lead with T, or None.
        measurements: (T, m) what `measure` predicts.
        mask: (T, m) bool, False where a number was not measured, which may then be anything, NaN
            too; or (T,), of steps; None: all were.
        truth: Anything that a loss compares with; the filter does not see it.
    """

    inputs: Any
    measurements: AnyArray
    mask: AnyArray | None = None
    truth: Any = None


def as_sequences(data: Any, name: str) -> EkfSequence:
    """Sequences [B] as arrays, floats in JAX's default precision, with a mask by number or None.

    Args:
        data: [B]; or a list of B sequences, which are stacked (`stack_sequences`).
        name: What they are called in messages.

    Raises:
        ValueError: An array has another shape or kind, or a number that counts is not finite.
    """
    if isinstance(data, list):
        data = stack_sequences(data, name)
    check_type(
        name, data, EkfSequence, advice="; ekf_model takes EkfSequence(inputs, measurements)"
    )
    y = _floats(f"{name}.measurements", data.measurements, ("B", "T", "m"))
    if not y.size:
        raise ValueError(f"{name}.measurements is {y.shape}: nothing was measured")
    mask = None if data.mask is None else as_numpy(f"{name}.mask", data.mask)
    if mask is not None:
        by_step = mask.ndim == 2
        check_array(f"{name}.mask", mask, y.shape[:2] if by_step else y.shape, np.bool_)
        mask = np.broadcast_to(mask[..., None], y.shape) if by_step else mask
        if not mask.any():
            raise ValueError(f"{name}.mask is False everywhere: nothing was measured")
    bad = ~np.isfinite(y) & (True if mask is None else mask)
    if bad.any():
        at = np.argwhere(bad)[0].tolist()
        value, advice = y[tuple(at)], "say in the mask what was not measured"
        raise ValueError(f"{name}.measurements{at} is {value}; {advice}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(data.inputs):
        own = f"{name}.inputs{jax.tree_util.keystr(path)}"
        array = as_numpy(own, leaf)
        if array.shape[:2] != y.shape[:2]:
            wanted = f"an array {y.shape[:2]}, sequences and steps, and more"
            raise ValueError(f"{own} is {array.dtype} {array.shape}, not {wanted}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            at = np.argwhere(~np.isfinite(array))[0].tolist()
            raise ValueError(f"{own}{at} is {array[tuple(at)]}: inputs are known at all steps")
    return as_arrays(None, data._replace(measurements=y, mask=mask), name)[1]


def stack_sequences(sequences: Sequence[EkfSequence], name: str = "data") -> EkfSequence:
    """Stack single sequences [T], which may differ in T, as [B]: the shorter are padded.

    What is added was not measured, by the mask; inputs are repeated, and so is truth that leads
    with T. The filter then predicts on, which no likelihood counts.

    Raises:
        ValueError: There are none, or one has other fields or shapes.
    """
    if not sequences:
        raise ValueError(f"{name}: no sequences")
    for i, one in enumerate(sequences):
        check_type(f"{name}[{i}]", one, EkfSequence)
    y = [
        _floats(f"{name}[{i}].measurements", one.measurements, ("T", "m"))
        for i, one in enumerate(sequences)
    ]
    longest = max(map(len, y))

    def pad(i: int, x: Any) -> np.ndarray:
        x, steps = np.asarray(x), len(y[i])
        if x.shape[:1] != (steps,) or steps in (0, longest):
            return x
        return np.concatenate([x, np.repeat(x[-1:], longest - steps, axis=0)])

    padded = []
    for i, one in enumerate(sequences):
        mask = np.ones(y[i].shape, bool) if one.mask is None else np.asarray(one.mask)
        mask = np.broadcast_to(mask[:, None], y[i].shape) if mask.ndim == 1 else mask
        one = one._replace(measurements=y[i], mask=mask)
        whole = jax.tree.map(lambda x, i=i: pad(i, x), one)
        padded.append(whole._replace(mask=whole.mask & (np.arange(longest) < len(y[i]))[:, None]))
    shapes = [(jax.tree.structure(x), [np.shape(a) for a in jax.tree.leaves(x)]) for x in padded]
    for i, shape in enumerate(shapes):
        if shape != shapes[0]:
            raise ValueError(f"{name}[{i}] has other fields, or arrays of other shapes, than [0]")
    stacked = jax.tree.map(lambda *x: np.stack(x), *padded)
    every = all(one.mask is None for one in sequences) and stacked.mask.all()
    return stacked._replace(mask=None) if every else stacked


def _floats(name: str, x: Any, shape: tuple[Any, ...]) -> np.ndarray:
    """An array of floats, of numbers of any kind, in lists too."""
    array = as_numpy(name, x)
    if array.dtype.kind in "iu":
        array = array.astype(float)
    check_array(name, array, shape, np.floating)
    return array
