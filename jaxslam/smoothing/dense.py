"""Smoother for many short simulated trials: one JAX program that is batched and differentiated.

Use `smooth_trial` inside `jax.jit`, `jax.vmap` and `jax.grad`: a Monte-Carlo experiment, a loss to
tune noise with. It is dense in the landmarks, O(T L^2 + L^3) for T poses and L landmarks, has no
robust kernel and takes no loop closures. For one long recorded log use `sparse.smooth_log`.

Each iteration linearises the problem (`residuals.evaluate`), solves the arrowhead normal equations
(`arrowhead`) and halves the step until the cost does not rise.

References:
    Lu, Milios (1997), Globally consistent range scan alignment for environment mapping. Dellaert,
    Kaess (2006), Square root SAM.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.types import AnyArray, Array, as_count
from jaxslam.smoothing import arrowhead
from jaxslam.smoothing.arrowhead import State
from jaxslam.smoothing.problem import SmoothingProblem, SmoothingResult, as_problem
from jaxslam.smoothing.residuals import WhitenedProblem, evaluate, whitened, wrap_state

MAX_HALVINGS = 6
"""Of a step that raises the cost, at most; after these it is not taken."""


def smooth_trial(
    problem: SmoothingProblem,
    poses: AnyArray,
    landmark_positions: AnyArray,
    *,
    iterations: int = 10,
) -> SmoothingResult:
    """Maximum a posteriori poses and landmarks of one short trial by Gauss-Newton, from a guess.

        minimise  sum_t |x_t (-) x_t-1 - u_t|^2_Q + sum_tm |z_tm - h(x_t, l_index)|^2_R + prior

    For trials by the thousand, batched by `jax.vmap` and differentiated by `jax.grad`; for one long
    recorded log there is `sparse.smooth_log`.

    A step that raises the cost is halved until it does not, so the cost never rises, but for
    rounding. Features without a landmark, or not finite, are ignored; landmarks without features or
    prior stay at the guess. Pad a trajectory at its end, by zero increments without features.
    There is no robust kernel: each correspondence counts fully. In single precision, what the
    measurements hardly constrain, such as the bend of a long path without known landmarks, stays
    near the guess.

    Args:
        problem: The problem. If the start is uncertain, `odometry_cov[0]` includes its covariance.
        poses: (T, 3) [m, m, rad] guess, map frame.
        landmark_positions: (L, 2) guess, as of `number_landmarks`.
        iterations: Number of steps; static.

    Returns:
        The smoothed trajectory and landmarks; the guess, if its cost is not finite. Derivatives are
        those of the iterations that were done. In the precision of the arrays that are given.

    Raises:
        ValueError: An argument has another shape or kind, or `iterations` is no whole number from
            0.
    """
    iterations = as_count("iterations", iterations, least=0)
    problem, poses, landmark_positions = as_problem(problem, poses, landmark_positions)
    return _smooth_trial(problem, poses, landmark_positions, iterations=int(iterations))


@partial(jax.jit, static_argnames="iterations")
def _smooth_trial(
    problem: SmoothingProblem, poses: Array, landmark_positions: Array, *, iterations: int
) -> SmoothingResult:
    """`smooth_trial` of what has been checked."""
    prepared = whitened(problem, num_landmarks=landmark_positions.shape[0])

    def iterate(state: State, _: None) -> tuple[State, Array]:
        cost, step = _gauss_newton(prepared, state)
        size = _step_size(*lax.stop_gradient((prepared, state, step, cost)))
        new = _moved(state, step, size)
        return jax.tree.map(lambda x, y: jnp.where(size > 0.0, x, y), new, state), cost

    state, costs = lax.scan(iterate, (poses, landmark_positions), None, length=iterations)
    cost = jnp.append(costs, evaluate(prepared, state)[0])
    return SmoothingResult(*wrap_state(prepared, state), cost)


def _gauss_newton(problem: WhitenedProblem, state: State) -> tuple[Array, State]:
    """Cost () of a state, and the Gauss-Newton step from it."""
    cost, residuals, jacobian, pull = evaluate(problem, state)
    information, size = problem.prior.information, state[1].shape[0]
    poses, landmarks = arrowhead.apply_transpose(jacobian, residuals, num_landmarks=size)
    # A unit diagonal keeps unobserved landmarks where they are; all others are damped by no more
    # than rounding takes.
    blocks = arrowhead.landmark_blocks(jacobian, num_landmarks=size)
    diagonal = jnp.einsum("lii->li", blocks + information)
    diagonal = lax.stop_gradient(diagonal)
    damping = jnp.where(diagonal > 0.0, 4 * jnp.finfo(diagonal.dtype).eps * diagonal, 1.0)
    information += damping[..., None] * jnp.eye(2, dtype=damping.dtype)[None]
    return cost, arrowhead.solve_arrowhead(jacobian, information, (-poses, -landmarks - pull))


def _moved(state: State, step: State, size: Array) -> State:
    """The state after a fraction () of a step."""
    return jax.tree.map(lambda x, dx: x + size * dx, state, step)


def _step_size(problem: WhitenedProblem, state: State, step: State, cost: Array) -> Array:
    """Largest of 1, 1/2, 1/4, ... whose part of a step does not raise the cost; 0 for none.

    A rise within rounding is accepted.
    """
    limit = cost * (1 + 8 * jnp.finfo(cost.dtype).eps)

    def halve(now: tuple[Array, Array]) -> tuple[Array, Array]:
        size = now[0] / 2
        return size, evaluate(problem, _moved(state, step, size))[0] <= limit

    def unfinished(now: tuple[Array, Array]) -> Array:
        size, accepted = now
        return ~accepted & (size > 0.5**MAX_HALVINGS)

    start = jnp.full((), 2.0, cost.dtype), jnp.zeros((), bool)
    size, accepted = lax.while_loop(unfinished, halve, start)
    return jnp.where(accepted, size, 0.0)
