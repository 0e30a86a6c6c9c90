"""An extended Kalman filter of your own functions, as a `Model`: Jacobians by autodiff.

    prior:      mean, cov = init(params, sequence)
    each step:  x- = motion(params, x, input),       F = its derivative,  Q = motion_cov(...)
                z  = measure(params, x-),            H = its derivative,  R = measurement_cov(...)
                x, P = Kalman update of x- and F P F^T + Q by the measurement y - z   (`ekf_step`)

So input t leads to the state that measurement t is of. Where the prior is that of the first
measurement instead, as in dynamax, `predict_first=False` leaves out the first motion: the
likelihood is then that of dynamax with the inputs of the same steps.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.se2 import wrap_angle
from jaxslam.core.types import Array
from jaxslam.tuning.batch_last import Batched, recomputed
from jaxslam.tuning.ekf_data import EkfSequence as EkfSequence
from jaxslam.tuning.ekf_data import as_sequences
from jaxslam.tuning.ekf_step import UNROLLED, Linearized, kalman_step
from jaxslam.tuning.model import Model
from jaxslam.tuning.model_checks import call, called, check_hashable, float_array

SMALL = 3  # states and measurements up to which a batch of steps is batch first

_MOTION, _MOTION_COV = "motion(params, state, input)", "motion_cov(params, state, input)"
_MEASURE, _MEASUREMENT_COV = "measure(params, state)", "measurement_cov(params, state)"


class EkfState(NamedTuple):
    """Gaussian belief, and whether the next step moves.

    Attributes:
        mean: (n,).
        cov: (n, n).
        moves: () bool, False before the first step of a model with `predict_first=False`.
    """

    mean: Array
    cov: Array
    moves: Array


class EkfInfo(NamedTuple):
    """What a step reports.

    Attributes:
        mean: (n,) after the update.
        cov: (n, n) after the update.
        innovation: (m,) measured minus predicted, angles within pi; 0 where not measured.
        innovation_cov: (m, m) S; rows and columns of the identity where not measured.
        nis: () normalised innovation squared.
        dof: () int32 count of numbers measured.
        log_likelihood: () [nats] of the measurement, given all before; -inf where not `finite`.
        finite: () bool; False: S was not positive definite, or a result not finite. The step is
            then left out: the state is that before it.
    """

    mean: Array
    cov: Array
    innovation: Array
    innovation_cov: Array
    nis: Array
    dof: Array
    log_likelihood: Array
    finite: Array


class _Angles(NamedTuple):
    """Which numbers of an argument are angles.

    Attributes:
        name: Of the argument.
        indices: Of the angles.
        size: How many numbers there are, where a bool is given for each.
    """

    name: str
    indices: tuple[int, ...]
    size: int | None = None


class _Functions(NamedTuple):
    """The user's functions, and which numbers are angles; hashable."""

    init: Callable
    motion: Callable
    measure: Callable
    motion_cov: Callable
    measurement_cov: Callable
    state_angles: _Angles
    measurement_angles: _Angles
    predict_first: bool


def ekf_model(
    *,
    init: Callable[[Any, EkfSequence], tuple[Array, Array]],
    motion: Callable[[Any, Array, Any], Array],
    measure: Callable[[Any, Array], Array],
    motion_cov: Callable[[Any, Array, Any], Array],
    measurement_cov: Callable[[Any, Array], Array],
    state_angles: Sequence[int] | Sequence[bool] = (),
    measurement_angles: Sequence[int] | Sequence[bool] = (),
    predict_first: bool = True,
) -> Model:
    """An extended Kalman filter as a model that can be tuned; its data are `EkfSequence`s [B].

    Or a list of single ones, which may differ in length.

    All functions are pure JAX of one state. The model is the same object for the same functions:
    define them once, at the level of a module. Derivatives of the model are taken in reverse only.

    Args:
        init: Parameters and a sequence to mean (n,) and covariance (n, n) before the first step.
        motion: Parameters, state (n,) and the step's input to the state (n,) after it.
        measure: Parameters and state (n,) to the measurement (m,) that it predicts.
        motion_cov: Parameters, state (n,) before the step and input to the noise (n, n) of motion.
        measurement_cov: Parameters and state (n,) to the noise (m, m) of the measurement.
        state_angles: Which of the state's numbers are angles [rad]: indices, or n bools.
        measurement_angles: Likewise of the measurement's numbers.
        predict_first: Whether the first step moves before it measures.

    Raises:
        ValueError: A function is none, or has no hash; an index is no whole number of at least 0;
            or `predict_first` is no bool.
    """
    given: dict[str, Any] = {"init": init, "motion": motion, "measure": measure}
    given |= {"motion_cov": motion_cov, "measurement_cov": measurement_cov}
    for name, function in given.items():
        if not callable(function):
            raise ValueError(f"{name} is {type(function).__name__}, not a function")
        check_hashable(name, function)
    if predict_first not in (True, False):
        raise ValueError(f"predict_first is {predict_first!r}, not True or False")
    return _build(
        _Functions(
            **given,
            state_angles=_angles("state_angles", state_angles),
            measurement_angles=_angles("measurement_angles", measurement_angles),
            predict_first=bool(predict_first),
        )
    )


def _angles(name: str, given: Sequence[int] | Sequence[bool]) -> _Angles:
    array, size = np.asarray(given), None
    if array.dtype == bool:
        array, size = np.flatnonzero(array), array.size
    if array.size and (array.ndim != 1 or array.dtype.kind not in "iu" or array.min() < 0):
        raise ValueError(f"{name} is {given!r}, not indices of numbers, or a bool for each")
    return _Angles(name, tuple(array.astype(int).tolist()), size)


@lru_cache(maxsize=256)
def _build(functions: _Functions) -> Model:
    compute = {last: recomputed(partial(_compute, functions), last=last) for last in (False, True)}

    def step(params: Any, state: EkfState, now: EkfSequence) -> tuple[EkfState, EkfInfo]:
        # Of the smallest matrices XLA's own products are faster than vectors over the batch.
        last = max(state.mean.size, now.measurements.size) > SMALL
        floats, (dof, finite) = compute[last]((params, state, now))
        mean, cov, innovation, innovation_cov, nis, log_likelihood = floats
        info = EkfInfo(mean, cov, innovation, innovation_cov, nis, dof, log_likelihood, finite)
        return EkfState(mean, cov, jnp.ones_like(state.moves)), info

    return Model(partial(_init, functions), step, _inputs, partial(_check, functions))


def _init(functions: _Functions, params: Any, sequence: EkfSequence) -> EkfState:
    pair = called("init(params, sequence)", functions.init, params, sequence)
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ValueError("init(params, sequence) returns no pair of mean and covariance")
    mean = float_array("init(params, sequence): mean", pair[0], ("n",))
    cov = float_array("init(params, sequence): covariance", pair[1], 2 * mean.shape)
    return EkfState(mean, cov, jnp.asarray(functions.predict_first))


def _inputs(params: Any, sequence: EkfSequence) -> EkfSequence:
    del params
    return sequence._replace(truth=None)


def _compute(functions: _Functions, args: Any, batched: Batched) -> tuple[tuple, tuple]:
    """A step; the batch is the last axis of all arrays of which `batched` says so."""
    linearize = partial(_linearize, functions, batched is not None)
    if batched is not None:
        axes = jax.tree.map(lambda own: -1 if own else None, batched)
        linearize = jax.vmap(linearize, in_axes=axes, out_axes=-1)
    mean, cov, y, mask, x, F, Q, z, H, R = (_stack(part) for part in linearize(*args))
    if mask is None:
        v = _wrap(y - z, functions.measurement_angles)
        dof = jnp.full(v.shape[1:], len(v), jnp.int32)
    else:
        v = jnp.where(mask, _wrap(jnp.where(mask, y, 0.0) - z, functions.measurement_angles), 0.0)
        eye = jnp.eye(len(R), dtype=R.dtype).reshape(R.shape[:2] + (1,) * (R.ndim - 2))
        H, R = jnp.where(mask[:, None], H, 0.0), jnp.where(mask[:, None] & mask[None], R, eye)
        dof = jnp.sum(mask, axis=0, dtype=jnp.int32)
    result, good = kalman_step(Linearized(cov, F, Q, H, R, v))
    after = _wrap(x + result.shift, functions.state_angles)
    good &= jnp.isfinite(result.nis + jnp.sum(after, axis=0) + jnp.sum(result.cov, axis=(0, 1)))
    constant = dof.astype(after.dtype) * math.log(2 * math.pi)
    log_likelihood = -(result.nis + result.logdet + constant) / 2
    floats = (
        jnp.where(good[None], after, mean),
        jnp.where(good[None, None], result.cov, cov),
        v,
        result.innovation_cov,
        result.nis,
        jnp.where(good, log_likelihood, -jnp.inf),
    )
    return floats, (dof, good)


def _linearize(
    functions: _Functions, split: bool, params: Any, state: EkfState, now: EkfSequence
) -> tuple:
    """Belief and measurement as they are, and a step's functions and Jacobians, for one item.

    Where they are small and `split`, the latter are tuples of numbers, to be stacked by `_stack`.
    """
    mean, measured = state.mean, now.measurements
    n, m = mean.shape, measured.shape

    def motion(x: Array) -> Array:
        return call(_MOTION, functions.motion, n, params, x, now.inputs)

    def measure(x: Array) -> Array:
        return call(_MEASURE, functions.measure, m, params, x)

    x, F = _value_and_jacobian(motion, mean, split)
    Q = call(_MOTION_COV, functions.motion_cov, n + n, params, mean, now.inputs)
    if not functions.predict_first:
        eye = jnp.eye(len(mean), dtype=mean.dtype)
        x = jax.tree.map(partial(jnp.where, state.moves), x, _like(x, mean))
        F = jax.tree.map(partial(jnp.where, state.moves), F, _like(F, eye))
        Q = jnp.where(state.moves, Q, 0.0)
    z, H = _value_and_jacobian(measure, _stack(x), split)
    R = call(_MEASUREMENT_COV, functions.measurement_cov, m + m, params, _stack(x))
    return mean, state.cov, measured, now.mask, x, F, Q, z, H, R


def _value_and_jacobian(
    function: Callable[[Array], Array], x: Array, split: bool
) -> tuple[Any, Any]:
    """Value (m,) and Jacobian (m, n) at x (n,)."""
    if not split or x.size > UNROLLED:
        value, derivative = jax.linearize(function, x)
        return value, jax.vmap(derivative, out_axes=1)(jnp.eye(len(x), dtype=x.dtype))
    eye = np.eye(len(x), dtype=x.dtype)
    pairs = [jax.jvp(function, (x,), (jnp.asarray(unit),)) for unit in eye]
    value, columns = pairs[0][0], [column for _, column in pairs]
    rows = range(len(value))
    return tuple(value[i] for i in rows), tuple(tuple(c[i] for c in columns) for i in rows)


def _like(tree: Any, array: Array) -> Any:
    """An array as tuples of numbers, if `tree` is one."""
    if not isinstance(tree, tuple):
        return array
    return tuple(_like(part, row) for part, row in zip(tree, array, strict=True))


def _stack(tree: Any) -> Array:
    """An array of nested tuples of numbers, whose batch is the last axis, or of an array."""
    return jnp.stack([_stack(part) for part in tree]) if isinstance(tree, tuple) else tree


def _wrap(x: Array, angles: _Angles) -> Array:
    """Angles among the numbers (n, ...) within pi."""
    name, indices, size = angles
    if size not in (None, len(x)):
        raise ValueError(f"{name} has {size} bools, but there are {len(x)} numbers")
    if not indices:
        return x
    if max(indices) >= len(x):
        last = len(x) - 1
        raise ValueError(f"{name} names {max(indices)} of {len(x)} numbers, which are 0 to {last}")
    chosen = np.isin(np.arange(len(x)), indices).reshape(-1, *(1,) * (x.ndim - 1))
    return jnp.where(chosen, wrap_angle(x), x)


def _check(functions: _Functions, params: Any, data: Any, name: str) -> tuple[Any, EkfSequence]:
    """Parameters and data [B] as arrays; ValueError if they do not fit the functions."""
    del functions
    return params, as_sequences(data, name)
