"""Sparse batch smoother for long recordings: robust Gauss-Newton with a sparse LU factorisation.

`dense.smooth_trial` is one compiled program that can be batched and differentiated, but it is dense in
the landmarks and has no robust kernel. This one is for a single recording of kilometres. Its cost
grows with the number of measurements, it takes loop closures, and all features and loop closures
have a Cauchy kernel, as one wrong correspondence would bend the whole map.

With e the norm of a whitened residual and c the kernel's scale, the Cauchy kernel is

    rho(e) = c^2 log(1 + e^2 / c^2)        w(e) = rho'(e) / (2 e) = 1 / (1 + e^2 / c^2)

and iteratively reweighted least squares (IRLS) minimises sum rho(e) by

    repeat:
        scale residuals and their Jacobian by sqrt(w(e))    `_evaluate`, `_weighted_closures`
        solve (J^T J + prior) step = -gradient              `_normal_matrix`, SciPy's SuperLU
        halve the step until the cost does not rise
    until the cost hardly falls

SuperLU runs in its symmetric mode, without pivoting and with a minimum-degree ordering of
J^T J, which keeps the factors as sparse as those of a Cholesky factorisation.

References:
    Dellaert, Kaess (2006), Square root SAM. Holland, Welsch (1977), Robust regression using
    iteratively reweighted least-squares.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from jaxslam.core import trace_cache
from jaxslam.core.types import Array
from jaxslam.matching import loop_closure
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.smoothing import arrowhead, problem
from jaxslam.smoothing.arrowhead import Jacobian, State
from jaxslam.smoothing.problem import SmoothingProblem, SmoothingResult

ROBUST_SCALE = 3.0  # [std] scale c of the Cauchy kernel: at this residual the weight is one half
CONVERGED = 1e-5  # fraction of the cost: an iteration that lowers it by less is the last
MAX_HALVINGS = 8  # of a step that raises the cost, at most; after these it is not taken

_prepared = trace_cache.jit(problem.whitened, static_argnames="size")
_wrapped = trace_cache.jit(problem.wrap_state)


@trace_cache.jit
def _evaluate(
    records: SmoothingProblem, state: State, scale: Array
) -> tuple[Array, State, Jacobian]:
    """Cost (), half its gradient, and the reweighted Jacobian, of all but loop closures."""
    cost, (motion, feature), rows, pull = problem.evaluate(records, state)
    square = jnp.sum(feature**2, axis=-1)
    cost += jnp.sum(scale**2 * jnp.log1p(square / scale**2) - square)
    root = (1.0 / jnp.sqrt(1.0 + square / scale**2))[..., None]
    rows = rows._replace(
        J_pose=root[..., None] * rows.J_pose, J_landmark=root[..., None] * rows.J_landmark
    )
    gradient = arrowhead.apply_transpose(rows, (motion, root * feature), state[1].shape[0])
    return cost, (gradient[0], gradient[1] + pull), rows


class _ClosureRows(NamedTuple):
    """Reweighted residuals of C loop closures, and their Jacobian.

    Attributes:
        poses: Indices (C,) of the first pose of each, and (C,) of the second.
        residual: (C, 3).
        by_pose: Derivatives (C, 3, 3) with respect to the first pose, and to the second.
    """

    poses: tuple[np.ndarray, np.ndarray]
    residual: np.ndarray
    by_pose: tuple[np.ndarray, np.ndarray]


def _weighted_closures(
    closures: LoopClosures, poses: np.ndarray, gradient: np.ndarray, scale: float
) -> tuple[float, np.ndarray, _ClosureRows]:
    """Cost of loop closures, `gradient` (T, 3) with half of theirs added, and their Jacobian."""
    residual, *by_pose = loop_closure.closure_residuals(closures, poses)
    square = np.sum(residual**2, axis=1)
    root = 1.0 / np.sqrt(1.0 + square / scale**2)[:, None]
    weighted = tuple(root[..., None] * block for block in by_pose)
    rows = _ClosureRows((closures.first, closures.second), root * residual, weighted)
    gradient = np.array(gradient)
    for index, block in zip(rows.poses, rows.by_pose, strict=True):
        np.add.at(gradient, index, (block.swapaxes(1, 2) @ rows.residual[..., None])[..., 0])
    return float(np.sum(scale**2 * np.log1p(square / scale**2))), gradient, rows


Blocks = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Blocks (N, n, m) of a sparse matrix, after the first row (N,) and first column (N,) of each."""


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
    rows: Jacobian, closure_rows: _ClosureRows | None, information: np.ndarray
) -> sparse.csc_array:
    """J^T J, plus prior information of the landmarks (L, 2, 2), plus a damping of its diagonal.

    A unit diagonal keeps unobserved landmarks where they are; all else is damped by no more than
    rounding takes. The rows of J are, from above, those of motions, features and loop closures; its
    columns those of poses and landmarks.
    """
    steps, size = len(rows.landmark_index), 3 * len(rows.landmark_index) + 2 * len(information)
    pose, landmark = 3 * np.arange(steps), 3 * steps + 2 * np.arange(len(information))
    t, m = np.nonzero(np.any(rows.J_landmark != 0.0, axis=(2, 3)))  # features that are not masked
    feature = 3 * steps + 2 * np.arange(len(t))
    parts = [
        (pose, pose, rows.odometry_root),
        (pose[1:], pose[:-1], -(rows.odometry_root @ rows.transition)[1:]),
        (feature, pose[t], rows.J_pose[t, m]),
        (feature, landmark[rows.landmark_index[t, m]], rows.J_landmark[t, m]),
    ]
    height = 3 * steps + 2 * len(t)
    if closure_rows is not None:
        closure = height + 3 * np.arange(len(closure_rows.residual))
        for index, block in zip(closure_rows.poses, closure_rows.by_pose, strict=True):
            parts.append((closure, 3 * index, block))
        height += closure_rows.residual.size
    jacobian = _assembled(parts, (height, size))
    matrix = jacobian.T @ jacobian + _assembled([(landmark, landmark, information)], (size, size))
    diagonal = matrix.diagonal()
    damping = np.where(diagonal > 0.0, 4 * np.finfo(float).eps * diagonal, 1.0)
    return (matrix + sparse.diags_array(damping)).tocsc()


def _solve(matrix: sparse.csc_array, gradient: State) -> State:
    """Gauss-Newton step (T, 3) and (L, 2), from the normal matrix and half the gradient."""
    right = np.concatenate([-np.ravel(x) for x in gradient])
    factors = splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    step, poses = factors.solve(right), gradient[0].size
    return step[:poses].reshape(-1, 3), step[poses:].reshape(-1, 2)


def _double(x: Array) -> np.ndarray:
    """A NumPy array, float64 if its numbers are real."""
    x = np.asarray(x)
    return x.astype(np.float64, copy=False) if x.dtype.kind == "f" else x


def smooth_log(
    problem: SmoothingProblem,
    poses: Array,
    landmark_positions: Array,
    *,
    loop_closures: LoopClosures | None = None,
    robust_scale: float = ROBUST_SCALE,
    max_iterations: int = 50,
) -> SmoothingResult:
    """Robust maximum a posteriori poses and landmarks of one trajectory, from a guess.

        minimise  sum_t |x_t (-) x_t-1 - u_t|^2_Q + sum_tm rho(|z_tm - h(x_t, l_which)|_R)
                  + sum_c rho(|x_first^-1 x_second - motion_c|_information) + prior

    with the Cauchy kernel rho, by iteratively reweighted Gauss-Newton (see the module's docstring).
    Runs on the host, in double precision. Compiled programs depend on T, M and L: pad them to share
    programs between trajectories.

    Args:
        problem: The problem; arrays of either precision.
        poses: (T, 3) guess, world frame.
        landmark_positions: (L, 2) guess.
        loop_closures: Loop closures between the poses; None for none.
        robust_scale: [std] scale c of the kernel; infinite for least squares.
        max_iterations: Largest number of steps.

    Returns:
        The smoothed trajectory and landmarks, NumPy, float64; the guess, if its cost is not finite.
        `cost` has one entry for the guess and one for each step that was taken.

    Raises:
        ValueError: An argument has another shape or type, or `robust_scale` is not positive.
    """
    if not robust_scale > 0.0:
        raise ValueError(f"doubt is {robust_scale}, not a positive number of standard deviations")
    problem, state = jax.tree.map(_double, (problem, (poses, landmark_positions)))
    problem.check_problem(problem, *state)
    size = len(state[1])
    if problem.prior is None:
        information = np.zeros((size, 2, 2))
    else:
        information = problem.prior.information
    scale = np.float64(min(robust_scale, 1e9))  # finite; so large that the kernel is a square
    with jax.enable_x64(True):
        prepared = _prepared(problem, size)

        def evaluate(state: State) -> tuple[float, State, tuple[Jacobian, _ClosureRows | None]]:
            cost, gradient, rows = jax.tree.map(np.asarray, _evaluate(prepared, state, scale))
            if loop_closures is None:
                return cost, gradient, (rows, None)
            closure_cost, by_pose, closure_rows = _weighted_closures(
                loop_closures, state[0], gradient[0], scale
            )
            return cost + closure_cost, (by_pose, gradient[1]), (rows, closure_rows)

        cost, gradient, (rows, closure_rows) = evaluate(state)
        costs = [float(cost)]
        for _ in range(max_iterations if np.isfinite(cost) else 0):
            step = _solve(_normal_matrix(rows, closure_rows, information), gradient)
            for fraction in 0.5 ** np.arange(MAX_HALVINGS + 1):
                new = tuple(x + fraction * dx for x, dx in zip(state, step, strict=True))
                new_cost, new_gradient, new_rows = evaluate(new)
                if new_cost <= cost:
                    break
            else:
                break
            decrease = cost - new_cost
            state, cost, gradient, (rows, closure_rows) = new, new_cost, new_gradient, new_rows
            costs.append(float(cost))
            if decrease <= CONVERGED * cost:
                break
        poses, landmark_positions = jax.tree.map(np.asarray, _wrapped(prepared, state))
    return SmoothingResult(poses, landmark_positions, np.array(costs))
