"""State and result of a tuning: what is recorded, which evaluation is best, when it stops."""

from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np
import optax

from jaxslam.core.batching import on_device
from jaxslam.core.types import check_type
from jaxslam.tuning import parameters

LOSS_ROUNDING = 1e-4  # relative, by which the same loss may differ on another machine


class TuneState(NamedTuple):
    """State of a tuning, with all that it needs to continue. P parameters, N updates in all.

    Attributes:
        step: () int64 number of evaluations so far.
        theta: (P,) float64 unconstrained numbers of the parameters to be evaluated next.
        optimizer_state: State of the optimiser, of the free parameters.
        theta_history: (N + 1, P) float64 those that each evaluation used; NaN: not yet.
        loss: (N + 1,) float64 mean over the sequences of each evaluation, and prior; NaN: not yet.
        heldout: (N + 1,) float64 mean over the held-out sequences; NaN: not evaluated.
        skipped: (N + 1,) int64 sequences left out of the mean because a value was not finite.
    """

    step: np.int64
    theta: np.ndarray
    optimizer_state: Any
    theta_history: np.ndarray
    loss: np.ndarray
    heldout: np.ndarray
    skipped: np.ndarray


class TuneResult(NamedTuple):
    """Result of `tune`. N evaluations: one more than updates, or fewer when it stopped early.

    Attributes:
        params: The best parameters.
        best: Number of the evaluation it is from.
        loss: (N,) mean over the sequences of each evaluation, and prior.
        heldout: (N,) mean over the held-out sequences; NaN where not evaluated.
        history: [N] parameters that each evaluation used.
        skipped: (N,) sequences left out of the mean because a value was not finite.
    """

    params: Any
    best: int
    loss: np.ndarray
    heldout: np.ndarray
    history: Any
    skipped: np.ndarray


def init(
    params: Any,
    *,
    num_updates: int,
    optimizer: optax.GradientTransformation,
    frozen: Collection[str] = (),
    transforms: Any = None,
) -> TuneState:
    """The state before the first evaluation; the arguments are those of `tune`.

    Raises:
        ValueError: A parameter is outside the domain of its transform, or a name is unknown.
    """
    theta = parameters.flatten_params(parameters.as_params(params, transforms), transforms)
    not_yet = np.full(num_updates + 1, np.nan)
    trainable = parameters.trainable_mask(params, frozen, transforms)
    return TuneState(
        step=np.int64(0),
        theta=theta,
        optimizer_state=optimizer.init(on_device(theta[trainable])),
        theta_history=np.full((num_updates + 1, theta.size), np.nan),
        loss=not_yet,
        heldout=not_yet,
        skipped=np.zeros(num_updates + 1, np.int64),
    )


def check_state(state: TuneState, start: TuneState) -> None:
    """Raise ValueError unless a state is one of the tuning that begins with another."""
    check_type("state", state, TuneState)
    shape, wanted = np.shape(state.theta_history), np.shape(start.theta_history)
    if shape != wanted and len(shape) == 2:
        raise ValueError(
            f"state is of {shape[0] - 1} updates of {shape[1]} parameters, not of {wanted[0] - 1} "
            f"of {wanted[1]}"
        )
    for field in (name for name in TuneState._fields if name != "optimizer_state"):
        found, right = np.shape(getattr(state, field)), np.shape(getattr(start, field))
        if found != right:
            raise ValueError(f"state.{field} has the shape {found}, not {right}")
    ours, other = (
        (jax.tree.structure(each), [np.shape(x) for x in jax.tree.leaves(each)])
        for each in (start.optimizer_state, state.optimizer_state)
    )
    if ours != other:
        raise ValueError("state is of another optimizer, or other parameters were frozen")
    first = state.theta_history[0]
    if state.step > 0 and not np.allclose(first, start.theta, rtol=1e-5, atol=1e-5):
        raise ValueError("state is of a tuning that began with other params or transforms")


def check_loss_of_state(state: TuneState, value: float, size: float) -> None:
    """Raise ValueError unless the first loss of a state is that of the tuning, to rounding.

    Args:
        state: Of an earlier call.
        value: The loss of the tuning's first evaluation.
        size: Mean absolute loss of its sequences.
    """
    first = float(state.loss[0])
    if state.step > 0 and np.isfinite(first) and not abs(value - first) <= LOSS_ROUNDING * size:
        raise ValueError(
            f"state is of another model, data, loss, prior or seed: its first loss is {first:.6g}, "
            f"not {value:.6g}"
        )


def result(
    state: TuneState, params: Any, *, whole: bool = True, transforms: Any = None
) -> TuneResult:
    """Result of the evaluations so far.

    Args:
        state: After one evaluation at least.
        params: Any parameters in the same tree, for its structure and precision.
        whole: Whether each step evaluated all sequences, so that their losses are comparable.
        transforms: Of the parameters.
    """
    count = int(state.step)
    best = _best(state, whole)
    history = [
        parameters.unflatten_params(theta, params, transforms)
        for theta in state.theta_history[:count]
    ]
    return TuneResult(
        params=history[best],
        best=best,
        loss=state.loss[:count],
        heldout=state.heldout[:count],
        history=jax.tree.map(lambda *x: jax.device_put(np.stack(x)), *history),
        skipped=state.skipped[:count],
    )


def record(state: TuneState, value: float, validation: float, skipped: int) -> TuneState:
    """Record an evaluation; the arrays of the state before are not changed."""

    def put(old: np.ndarray, new: Any) -> np.ndarray:
        changed = np.array(old)
        changed[state.step] = new
        return changed

    return state._replace(
        step=state.step + 1,
        theta_history=put(state.theta_history, state.theta),
        loss=put(state.loss, value),
        heldout=put(state.heldout, validation),
        skipped=put(state.skipped, skipped),
    )


def _best(state: TuneState, whole: bool) -> int:
    """Number of the best evaluation: by held-out or comparable losses, else the last finite one."""
    for series in (state.heldout, state.loss) if whole else (state.heldout,):
        if np.isfinite(series).any():
            return int(np.nanargmin(np.where(np.isfinite(series), series, np.nan)))
    finite = np.flatnonzero(np.isfinite(state.loss[: state.step]))
    return int(finite[-1]) if finite.size else int(state.step) - 1


def stalled(state: TuneState, patience: int | None) -> bool:
    """Whether the best validation is `patience` or more validations ago."""
    validations = state.heldout[np.isfinite(state.heldout)]
    since_best = len(validations) - 1 - np.argmin([*validations, np.inf])
    return patience is not None and bool(since_best >= patience)
