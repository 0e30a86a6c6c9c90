"""Smoother for one long recorded log: robust Gauss-Newton with a sparse LU factorisation.

Use `smooth_log` on a recording of kilometres: it is sparse in the landmarks, its cost grows with
the number of measurements, it takes loop closures, and all features and loop closures have a Cauchy
kernel, as one wrong correspondence would bend the whole map. It runs on the host in double
precision and is neither batched nor differentiated; for many short simulated trials use
`dense.smooth_trial`.

With e the norm of a whitened residual and c the kernel's scale, the Cauchy kernel is

    rho(e) = c^2 log(1 + e^2 / c^2)        w(e) = rho'(e) / (2 e) = 1 / (1 + e^2 / c^2)

and iteratively reweighted least squares (IRLS) minimises sum rho(e) by

    repeat:
        scale residuals and their Jacobian by sqrt(w(e))    `_evaluate`, `weighted_closures`
        solve (J^T J + prior) step = -gradient              `_normal_matrix`, SciPy's SuperLU
        halve the step until the cost does not rise
    until the cost hardly falls

SuperLU runs in its symmetric mode, without pivoting and with a minimum-degree ordering of
J^T J, which keeps the factors as sparse as those of a Cholesky factorisation.

References:
    Dellaert, Kaess (2006), Square root SAM. Holland, Welsch (1977), Robust regression using
    iteratively reweighted least-squares.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from jaxslam.core import trace_cache
from jaxslam.core.types import AnyArray, Array, as_count
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.smoothing import arrowhead
from jaxslam.smoothing.arrowhead import Jacobian
from jaxslam.smoothing.loop_closure_factors import (
    LoopClosureRows,
    as_loop_closures,
    weighted_closures,
)
from jaxslam.smoothing.problem import SmoothingProblem, SmoothingResult, as_problem
from jaxslam.smoothing.residuals import WhitenedProblem, evaluate, whitened, wrap_state

ROBUST_SCALE = 3.0
"""[std] scale c of the Cauchy kernel: at this residual the weight is one half."""

CONVERGED = 1e-5
"""Fraction of the cost: an iteration that lowers it by less is the last."""

MAX_HALVINGS = 8
"""Of a step that raises the cost, at most; after these it is not taken."""

NumpyState = tuple[np.ndarray, np.ndarray]
"""`arrowhead.State` on the host: poses (T, 3) and landmarks (L, 2), or a step, or a gradient."""

Blocks = tuple[np.ndarray, np.ndarray, AnyArray]
"""Blocks (N, n, m) of a sparse matrix, after the first row (N,) and first column (N,) of each."""

Rows = tuple[Jacobian, LoopClosureRows | None]
"""Reweighted Jacobian, NumPy, and that of the loop closures if there are any."""

_whitened = trace_cache.jit(
    whitened, static_argnames="num_landmarks", compile_quickly="unoptimised"
)
_wrapped = trace_cache.jit(wrap_state, compile_quickly="unoptimised")


def smooth_log(
    problem: SmoothingProblem,
    poses: AnyArray,
    landmark_positions: AnyArray,
    *,
    loop_closures: LoopClosures | None = None,
    robust_scale: float = ROBUST_SCALE,
    max_iterations: int = 50,
) -> SmoothingResult:
    """Robust maximum a posteriori poses and landmarks of one long recorded log, from a guess.

        minimise  sum_t |x_t (-) x_t-1 - u_t|^2_Q + sum_tm rho(|z_tm - h(x_t, l_index)|_R)
                  + sum_c rho(|x_first^-1 x_second - relative_pose_c|_information) + prior

    with the Cauchy kernel rho, by iteratively reweighted Gauss-Newton (see the module's docstring).
    It runs on the host, in double precision; for many short trials, batched and differentiated,
    there is `dense.smooth_trial`. Compiled programs depend on T, M and L: pad them to share
    programs between trajectories.

    Args:
        problem: The problem; arrays of either precision.
        poses: (T, 3) [m, m, rad] guess, map frame.
        landmark_positions: (L, 2) guess, as of `number_landmarks`.
        loop_closures: Loop closures between the poses; None for none.
        robust_scale: [std] scale c of the kernel; infinite for least squares.
        max_iterations: Largest number of steps.

    Returns:
        The smoothed trajectory and landmarks, NumPy, float64; the guess, if its cost is not finite.
        `cost` has one entry for the guess and one for each step that was taken.

    Raises:
        ValueError: An argument has another shape or kind, a loop closure is of no pose,
            `robust_scale` is not positive, or `max_iterations` is no whole number from 0.
    """
    if not robust_scale > 0.0:
        raise ValueError(f"robust_scale is {robust_scale}, not a positive number of std")
    max_iterations = as_count("max_iterations", max_iterations, least=0)
    scale = np.float64(min(robust_scale, 1e9))  # finite; so large that the kernel is a square
    with jax.enable_x64(True):
        given = as_problem(problem, poses, landmark_positions)
        problem, *guess = jax.tree.map(_double, given)
        state: NumpyState = (guess[0], guess[1])
        if loop_closures is not None:
            loop_closures = as_loop_closures(loop_closures, len(state[0]))
        information = np.zeros((len(state[1]), 2, 2))
        if problem.prior is not None:
            information = np.asarray(problem.prior.information)
        prepared = _whitened(problem, num_landmarks=len(state[1]))

        def linearise(state: NumpyState) -> tuple[float, NumpyState, Rows]:
            cost, gradient, jacobian = jax.tree.map(np.asarray, _evaluate(scale, prepared, state))
            if loop_closures is None:
                return cost, gradient, (jacobian, None)
            closure_cost, by_pose, closure_rows = weighted_closures(
                scale, state[0], gradient[0], loop_closures
            )
            return cost + closure_cost, (by_pose, gradient[1]), (jacobian, closure_rows)

        cost, gradient, rows = linearise(state)
        costs = [float(cost)]
        for _ in range(max_iterations if np.isfinite(cost) else 0):
            step = _solve(_normal_matrix(*rows, information), gradient)
            for fraction in 0.5 ** np.arange(MAX_HALVINGS + 1):
                new = (state[0] + fraction * step[0], state[1] + fraction * step[1])
                new_cost, new_gradient, new_rows = linearise(new)
                if new_cost <= cost:
                    break
            else:
                break
            decrease = cost - new_cost
            state, cost, gradient, rows = new, new_cost, new_gradient, new_rows
            costs.append(float(cost))
            if decrease <= CONVERGED * cost:
                break
        state = jax.tree.map(np.asarray, _wrapped(prepared, state))
    return SmoothingResult(*state, np.array(costs))


@partial(trace_cache.jit, compile_quickly=True)  # it runs at every step
def _evaluate(
    scale: Array, problem: WhitenedProblem, state: arrowhead.State
) -> tuple[Array, arrowhead.State, Jacobian]:
    """Cost (), half its gradient, and the reweighted Jacobian, of all but loop closures."""
    cost, (odometry, feature), jacobian, pull = evaluate(problem, state)
    square = jnp.sum(feature**2, axis=-1)
    cost += jnp.sum(scale**2 * jnp.log1p(square / scale**2) - square)
    root = (1.0 / jnp.sqrt(1.0 + square / scale**2))[..., None]
    jacobian = jacobian._replace(
        J_pose=root[..., None] * jacobian.J_pose, J_landmark=root[..., None] * jacobian.J_landmark
    )
    poses, landmarks = arrowhead.apply_transpose(
        jacobian, (odometry, root * feature), num_landmarks=state[1].shape[0]
    )
    return cost, (poses, landmarks + pull), jacobian


def _assembled(parts: list[Blocks], shape: tuple[int, int]) -> sparse.csc_array:
    """Sparse matrix that is the sum of blocks."""
    entries = []
    for row, column, blocks in parts:
        down, right = np.indices(blocks.shape[1:])
        rows, columns = row[:, None, None] + down, column[:, None, None] + right
        entries.append([x.ravel() for x in (blocks, rows, columns)])
    value, row, column = map(np.concatenate, zip(*entries, strict=True))
    return sparse.csc_array((value, (row, column)), shape=shape)


def _normal_matrix(
    jacobian: Jacobian, closure_rows: LoopClosureRows | None, information: np.ndarray
) -> sparse.csc_array:
    """J^T J, plus prior information of the landmarks (L, 2, 2), plus a damping of its diagonal.

    A unit diagonal keeps unobserved landmarks where they are; all else is damped by no more than
    rounding takes. The rows of J are, from above, those of odometry, features and loop closures;
    its columns those of poses and landmarks.
    """
    index, J_landmark = jacobian.landmark_index, jacobian.J_landmark
    steps, size = len(index), 3 * len(index) + 2 * len(information)
    pose, landmark = 3 * np.arange(steps), 3 * steps + 2 * np.arange(len(information))
    t, m = np.nonzero(np.any(J_landmark != 0.0, axis=(2, 3)))  # features that are not masked
    feature = 3 * steps + 2 * np.arange(len(t))
    parts: list[Blocks] = [
        (pose, pose, jacobian.odometry_root),
        (pose[1:], pose[:-1], -(jacobian.odometry_root @ jacobian.transition)[1:]),
        (feature, pose[t], jacobian.J_pose[t, m]),
        (feature, landmark[index[t, m]], J_landmark[t, m]),
    ]
    height = 3 * steps + 2 * len(t)
    if closure_rows is not None:
        closure = height + 3 * np.arange(len(closure_rows.residual))
        for first_or_second, block in zip(closure_rows.poses, closure_rows.J_pose, strict=True):
            parts.append((closure, 3 * first_or_second, block))
        height += closure_rows.residual.size
    tall = _assembled(parts, (height, size))
    matrix = tall.T @ tall + _assembled([(landmark, landmark, information)], (size, size))
    diagonal = matrix.diagonal()
    damping = np.where(diagonal > 0.0, 4 * np.finfo(float).eps * diagonal, 1.0)
    return (matrix + sparse.diags_array(damping)).tocsc()


def _solve(matrix: sparse.csc_array, gradient: NumpyState) -> NumpyState:
    """Gauss-Newton step (T, 3) and (L, 2), from the normal matrix and half the gradient."""
    right = np.concatenate([-np.ravel(x) for x in gradient])
    step, poses = factorise(matrix).solve(right), gradient[0].size
    return step[:poses].reshape(-1, 3), step[poses:].reshape(-1, 2)


def factorise(matrix: sparse.csc_array) -> SuperLU:
    """Factors of a symmetric, positive definite matrix, which `solve` and have a `shape`."""
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _double(x: Array) -> np.ndarray:
    """A NumPy array, float64 if its numbers are real."""
    array = np.asarray(x)
    return array.astype(np.float64, copy=False) if array.dtype.kind == "f" else array
