"""Gauss-Newton smoother for many short trials: one JAX program, vmapped and differentiable."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.types import Array
from jaxslam.smoothing import arrowhead
from jaxslam.smoothing.arrowhead import State
from jaxslam.smoothing.problem import (
    SmoothingProblem,
    SmoothingResult,
    check_problem,
    evaluate,
    whitened,
    wrap_state,
)

MAX_HALVINGS = 6  # of a step that raises the cost, at most; after these it is not taken


def _gauss_newton(records: SmoothingProblem, state: State) -> tuple[Array, State]:
    """Cost () of a state, and the Gauss-Newton step from it."""
    cost, residuals, rows, pull = evaluate(records, state)
    information, size = records.prior.information, state[1].shape[0]
    poses, landmarks = arrowhead.apply_transpose(rows, residuals, size)
    # A unit diagonal keeps unobserved landmarks where they are; all others are damped by no more
    # than rounding takes.
    diagonal = jnp.einsum("lii->li", arrowhead.landmark_blocks(rows, size) + information)
    diagonal = lax.stop_gradient(diagonal)
    damping = jnp.where(diagonal > 0.0, 4 * jnp.finfo(diagonal.dtype).eps * diagonal, 1.0)
    information += damping[..., None] * jnp.eye(2, dtype=damping.dtype)[None]
    return cost, arrowhead.solve_arrowhead(rows, information, (-poses, -landmarks - pull))


def _moved(state: State, step: State, size: Array) -> State:
    return jax.tree.map(lambda x, dx: x + size * dx, state, step)


def _step_size(records: SmoothingProblem, state: State, step: State, cost: Array) -> Array:
    """Largest of 1, 1/2, 1/4, ... whose part of a step does not raise the cost; 0 for none.

    A rise within rounding is accepted.
    """
    limit = cost * (1 + 8 * jnp.finfo(cost.dtype).eps)

    def halve(now: tuple[Array, Array]) -> tuple[Array, Array]:
        size = now[0] / 2
        return size, evaluate(records, _moved(state, step, size))[0] <= limit

    def unfinished(now: tuple[Array, Array]) -> Array:
        size, accepted = now
        return ~accepted & (size > 0.5**MAX_HALVINGS)

    start = jnp.full((), 2.0, cost.dtype), jnp.zeros((), bool)
    size, accepted = lax.while_loop(unfinished, halve, start)
    return jnp.where(accepted, size, 0.0)


@partial(jax.jit, static_argnames="iterations")
def smooth_trial(
    problem: SmoothingProblem, poses: Array, landmark_positions: Array, *, iterations: int = 10
) -> SmoothingResult:
    """Maximum a posteriori poses and landmarks by Gauss-Newton, from a guess.

        minimise  sum_t |x_t (-) x_t-1 - u_t|^2_Q + sum_tm |z_tm - h(x_t, l_which)|^2_R + prior

    A step that raises the cost is halved until it does not, so the cost never rises, but for
    rounding. Features without a landmark, or not finite, are ignored; landmarks without features or
    prior stay at the guess. Pad a trajectory at its end, by zero increments without features.
    There is no robust kernel: each correspondence counts fully. In single precision, what the
    measurements hardly constrain, such as the bend of a long path without known landmarks, stays
    near the guess.

    Args:
        problem: The problem. If the start is uncertain, `q[0]` includes its covariance.
        poses: (T, 3) guess, world frame.
        landmark_positions: (L, 2) guess.
        iterations: Number of steps; static.

    Returns:
        The smoothed trajectory and landmarks; the guess, if its cost is not finite. Derivatives are
        those of the iterations that were done.

    Raises:
        ValueError: An argument has another shape or type; while tracing.
    """
    check_problem(problem, poses, landmark_positions)
    problem = whitened(problem, landmark_positions.shape[0])

    def iterate(state: State, _: None) -> tuple[State, Array]:
        cost, step = _gauss_newton(problem, state)
        size = _step_size(*lax.stop_gradient((problem, state, step, cost)))
        new = _moved(state, step, size)
        return jax.tree.map(lambda x, y: jnp.where(size > 0.0, x, y), new, state), cost

    state, costs = lax.scan(iterate, (poses, landmark_positions), None, length=iterations)
    cost = jnp.append(costs, evaluate(problem, state)[0])
    poses, landmark_positions = wrap_state(problem, state)
    return SmoothingResult(poses, landmark_positions, cost)
