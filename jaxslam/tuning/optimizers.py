"""Optimisers for a loss that is evaluated together with its gradient, with optax's interface.

Where each step evaluates the same data, the losses of two steps are comparable: L-BFGS with
backtracking, which follows the narrow valleys between strongly correlated parameters. With
minibatches losses are not comparable: Adam.

The usual line search (`optax.lbfgs`) evaluates the loss several times per step inside `update`.
Here every evaluation runs the filter on all data, by a program of its own, so `lbfgs_backtracking`
does one evaluation per `update` and spreads the line search over several of them.
"""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxslam.core.types import Array, as_count

LEAST_CURVATURE = 1e-4  # of a direction that Newton's method takes, per the largest one
LBFGS_MEMORY = 10  # pairs of steps and gradient differences that L-BFGS stores
MAX_CHANGE = 0.4  # largest change of a parameter in one step
ADAM_RATE = 0.2  # initial learning rate of Adam


class BacktrackState(NamedTuple):
    """State of `lbfgs_backtracking`: F parameters.

    Attributes:
        inner: State of L-BFGS at the best point.
        value: () loss at the best point, the least so far.
        theta: (F,) the best point.
        direction: (F,) search direction from there.
        max_change: () largest change of a parameter in the next step.
    """

    inner: Any
    value: Array
    theta: Array
    direction: Array
    max_change: Array


def default_optimizer(num_updates: int, *, whole: bool) -> optax.GradientTransformationExtraArgs:
    """The default optimiser; the same object for the same arguments.

    Args:
        num_updates: Number of updates, over which Adam's learning rate decays to a tenth (cosine).
        whole: Whether each step evaluates all data.

    Returns:
        `lbfgs_backtracking` if so, else Adam.

    Raises:
        ValueError: `num_updates` is no integer of 0 or more, or `whole` is neither True nor False.
    """
    num_updates = as_count("num_updates", num_updates, least=0)
    if whole not in (True, False):
        raise ValueError(f"whole is {whole!r}, not True or False")
    return lbfgs_backtracking() if whole else _adam(num_updates)


def check_optimizer(optimizer: Any, num_params: int) -> optax.GradientTransformationExtraArgs:
    """An optimiser that takes the value of the loss; ValueError unless it is one of F parameters.

    By the shapes that it returns: nothing is compiled.
    """
    if not all(callable(getattr(optimizer, name, None)) for name in ("init", "update")):
        raise ValueError(f"optimizer is {optimizer!r}, not one of optax, as optax.adam(0.1)")
    optimizer = optax.with_extra_args_support(optimizer)
    theta = jax.ShapeDtypeStruct((num_params,), jnp.zeros(()).dtype)

    def first(theta: Array, value: Array) -> Array:
        return optimizer.update(theta, optimizer.init(theta), theta, value=value)[0]

    try:
        with jax.numpy_dtype_promotion("standard"):  # optax needs it
            change = jax.eval_shape(first, theta, jax.ShapeDtypeStruct((), theta.dtype))
    except Exception as error:
        line = (str(error).strip().splitlines() or [""])[0]
        raise ValueError(
            f"optimizer fails: {type(error).__name__}: {line}; it is given gradient, state, "
            "parameters and the value of the loss, which it does not evaluate"
        ) from error
    if getattr(change, "shape", None) != theta.shape:
        raise ValueError(f"optimizer.update returns {change}, not a change of {num_params} numbers")
    return optimizer


@cache
def _adam(num_updates: int) -> optax.GradientTransformationExtraArgs:
    """Adam, whose learning rate decays over `num_updates`."""
    rate = optax.cosine_decay_schedule(ADAM_RATE, max(num_updates, 1), alpha=0.1)
    return optax.with_extra_args_support(optax.adam(rate))


@cache
def lbfgs_backtracking() -> optax.GradientTransformationExtraArgs:
    """L-BFGS with backtracking to the best point; its `update` needs the `value` of the loss.

    The caller evaluates loss f and gradient g at a trial point x and calls `update(g, state, x,
    value=f)`, which returns the step from x to the next trial point. The state is the best point
    x*, with its loss f*, a search direction d from it and a bound r on the change of any parameter:

        start:  f* = inf, x* = x, d = 0, r = MAX_CHANGE

        f < f*, accepted:                         f >= f* or NaN, rejected:
            x*, f* <- x, f                            x*, f*, d and L-BFGS stay as they are
            d <- L-BFGS direction from g              r <- min(r, max|d|) / 4
            r <- min(2 r, MAX_CHANGE)                      (a quarter of the step that failed)

        in both cases the next trial point is  x* + d min(1, r / max|d|)

    A direction of L-BFGS that does not descend (g . d >= 0) is replaced by the negative gradient,
    scaled to a largest change of `MAX_CHANGE`. The first evaluation is always accepted if it is
    finite.
    """
    lbfgs = optax.scale_by_lbfgs(memory_size=LBFGS_MEMORY)

    @jax.jit  # one program instead of six
    def init(theta: Array) -> BacktrackState:
        reach = jnp.full((), MAX_CHANGE, theta.dtype)
        value = jnp.full((), jnp.inf, theta.dtype)
        return BacktrackState(lbfgs.init(theta), value, theta, jnp.zeros_like(theta), reach)

    def accept(
        gradient: Array, state: BacktrackState, theta: Array, value: Array
    ) -> BacktrackState:
        scaled, inner = lbfgs.update(gradient, state.inner, theta)
        steepest = -gradient * (MAX_CHANGE / _or_one(jnp.max(jnp.abs(gradient))))
        direction = jnp.where(jnp.vdot(scaled, gradient) > 0.0, -scaled, steepest)
        reach = jnp.minimum(2.0 * state.max_change, MAX_CHANGE)
        return BacktrackState(inner, value.astype(theta.dtype), theta, direction, reach)

    def reject(state: BacktrackState) -> BacktrackState:
        failed = jnp.minimum(state.max_change, jnp.max(jnp.abs(state.direction)))
        return state._replace(max_change=failed / 4.0)

    def update(
        gradient: Array, state: BacktrackState, theta: Array, *, value: Array, **extra_args: Any
    ) -> tuple[Array, BacktrackState]:
        del extra_args  # optax passes them to all transformations of a chain
        better = value < state.value
        choices = accept(gradient, state, theta, value), reject(state)
        state = jax.tree.map(lambda x, y: jnp.where(better, x, y), *choices)
        fraction = jnp.minimum(1.0, state.max_change / _or_one(jnp.max(jnp.abs(state.direction))))
        return state.theta + fraction * state.direction - theta, state

    return optax.GradientTransformationExtraArgs(init, update)


def _or_one(x: Array) -> Array:
    """`x` where it is positive, else 1, to divide by."""
    return jnp.where(x > 0.0, x, 1.0)


def newton(hessian: np.ndarray) -> optax.GradientTransformationExtraArgs:
    """Newton's method with one Hessian, along the directions that are clearly curved.

    For the last of a tuning. Where parameters are strongly correlated, such as the noise and the
    calibration of a robot, L-BFGS takes long for it, and a minimum that is missed by a standard
    error looks like an estimate that is off. `standard_errors.second_derivatives` has the Hessian;
    that of a point nearby, or of a part of the data, converges, too.

    Args:
        hessian: (F, F) of the mean loss in the unconstrained numbers of the free parameters.

    Raises:
        ValueError: `hessian` is no symmetric matrix of finite numbers, or nowhere curved upwards.
    """
    hessian = np.asarray(hessian, np.float64)
    if hessian.ndim != 2 or hessian.shape[0] != hessian.shape[1]:
        raise ValueError(f"hessian has the shape {hessian.shape}, not (F, F)")
    if not np.isfinite(hessian).all():
        raise ValueError("hessian is not finite throughout")
    if not np.allclose(hessian, hessian.T):
        raise ValueError("hessian is not symmetric")
    curvature, direction = np.linalg.eigh(hessian)
    kept = curvature > LEAST_CURVATURE * curvature.max(initial=0.0)
    if not kept.any():
        raise ValueError("hessian has no positive eigenvalue: this is no minimum")
    inverse = direction[:, kept] / curvature[kept] @ direction[:, kept].T

    def update(gradient: Array, state: Any, params: Any = None, **extra: Any) -> tuple[Array, Any]:
        del params, extra
        change = -(jnp.asarray(inverse, gradient.dtype) @ gradient)
        return change * jnp.minimum(1.0, MAX_CHANGE / _or_one(jnp.max(jnp.abs(change)))), state

    return optax.GradientTransformationExtraArgs(lambda _: optax.EmptyState(), update)
