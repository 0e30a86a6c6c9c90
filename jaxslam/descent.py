"""Ways down a loss that is seen with its gradient, as optax has them.

Where every step sees the same runs, steps compare: L-BFGS finds its way along the narrow valleys
between parameters that do nearly the same. A step that does not lead down is taken back, and a
quarter of it tried. Where runs come in batches nothing compares: Adam.
"""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxslam.types import Array

MEMORY = 10  # steps that L-BFGS remembers
REACH = 0.4  # by which one of them changes a parameter at most
RATE = 0.2  # first step of Adam


class Trust(NamedTuple):
    """State of `careful`: F parameters."""

    inner: Any  # of L-BFGS, at the best point
    value: Array  # () loss there, the least so far
    theta: Array  # (F,) the best point
    direction: Array  # (F,) from there on
    reach: Array  # () greatest change of a parameter to try


@cache
def usual(steps: int, *, whole: bool) -> optax.GradientTransformationExtraArgs:
    """`careful` where each step sees all runs, else Adam with a rate that decays to a tenth."""
    if whole:
        return careful()
    rate = optax.cosine_decay_schedule(RATE, max(steps, 1), alpha=0.1)
    return optax.with_extra_args_support(optax.adam(rate))


@cache
def careful() -> optax.GradientTransformationExtraArgs:
    """L-BFGS that goes on from the least value that it has seen; `update` wants the `value`."""
    newton = optax.scale_by_lbfgs(memory_size=MEMORY)

    def init(theta: Array) -> Trust:
        most = jnp.full((), REACH, theta.dtype)
        none = jnp.full((), jnp.inf, theta.dtype)
        return Trust(newton.init(theta), none, theta, jnp.zeros_like(theta), most)

    def update(
        slope: Array, state: Trust, theta: Array, *, value: Array, **_: Any
    ) -> tuple[Array, Trust]:
        step, inner = newton.update(slope, state.inner, theta)
        steep = jnp.max(jnp.abs(slope))
        straight = -slope * (REACH / jnp.where(steep > 0.0, steep, 1.0))
        direction = jnp.where(jnp.vdot(step, slope) > 0.0, -step, straight)
        wider = jnp.minimum(2.0 * state.reach, REACH)
        down = Trust(inner, value.astype(theta.dtype), theta, direction, wider)
        tried = jnp.minimum(state.reach, jnp.max(jnp.abs(state.direction)))
        up = state._replace(reach=tried / 4.0)
        better = value < state.value
        state = jax.tree.map(lambda a, b: jnp.where(better, a, b), down, up)
        longest = jnp.max(jnp.abs(state.direction))
        part = jnp.minimum(1.0, state.reach / jnp.where(longest > 0.0, longest, 1.0))
        return state.theta + part * state.direction - theta, state

    return optax.GradientTransformationExtraArgs(init, update)
