"""A long run smoothed: sparse normal equations, factored by SciPy in double precision.

`smoother.smooth` is one program that can be batched and differentiated, and is dense in the
landmarks. This is for one recorded run of kilometres: the work grows with what was seen, and
matches are doubted, since one that is wrong would bend the whole map.

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

from jaxslam import arrow, programs, smoother
from jaxslam import closures as closing
from jaxslam.arrow import Rows, State
from jaxslam.closures import Closures
from jaxslam.smoother import Records, Track
from jaxslam.types import Array

DOUBT = 3.0  # [std] from which a feature is hardly believed
SETTLED = 1e-5  # part of the cost: an iteration that takes less of it is the last
HALVINGS = 8  # of a step that raises the cost; after these it is not taken


_prepared = programs.jit(smoother.prepared, static_argnames="size")
_wrapped = programs.jit(smoother.wrapped)


@programs.jit
def _evaluate(records: Records, state: State, doubt: Array) -> tuple[Array, State, Rows]:
    """Cost (), its gradient over two, and the rows of the reweighted residuals."""
    cost, (motion, seen), rows, pull = smoother.evaluate(records, state)
    square = jnp.sum(seen**2, axis=-1)
    cost += jnp.sum(doubt**2 * jnp.log1p(square / doubt**2) - square)
    root = (1.0 / jnp.sqrt(1.0 + square / doubt**2))[..., None]
    rows = rows._replace(
        by_pose=root[..., None] * rows.by_pose, by_place=root[..., None] * rows.by_place
    )
    slope = arrow.gradient(rows, (motion, root * seen), state[1].shape[0])
    return cost, (slope[0], slope[1] + pull), rows


class _Ties(NamedTuple):
    """Reweighted residuals of loop closures, as `Rows` are those of features."""

    at: tuple[np.ndarray, np.ndarray]  # (C,) each, of the two poses
    residual: np.ndarray  # (C, 3)
    by_pose: tuple[np.ndarray, np.ndarray]  # (C, 3, 3) each


def _doubted(
    closures: Closures, poses: np.ndarray, slope: np.ndarray, doubt: float
) -> tuple[float, np.ndarray, _Ties]:
    """Cost of closures, a gradient over two (T, 3) with theirs added, and their rows."""
    residual, *by_pose = closing.residuals(closures, poses)
    square = np.sum(residual**2, axis=1)
    root = 1.0 / np.sqrt(1.0 + square / doubt**2)[:, None]
    ties = _Ties(closures[:2], root * residual, tuple(root[..., None] * by for by in by_pose))
    slope = np.array(slope)
    for at, by in zip(ties.at, ties.by_pose, strict=True):
        np.add.at(slope, at, (by.swapaxes(1, 2) @ ties.residual[..., None])[..., 0])
    return float(np.sum(doubt**2 * np.log1p(square / doubt**2))), slope, ties


Blocks = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Blocks (N, n, m), from rows (N,) and columns (N,) on; as arguments: rows, columns, blocks."""


def _assembled(parts: list[Blocks], shape: tuple[int, int]) -> sparse.csc_array:
    """The matrix that blocks add up to."""
    found = []
    for row, column, blocks in parts:
        down, right = np.indices(blocks.shape[1:])
        at = row[:, None, None] + down, column[:, None, None] + right
        found.append([x.ravel() for x in (blocks, *at)])
    value, row, column = map(np.concatenate, zip(*found, strict=True))
    return sparse.csc_array((value, (row, column)), shape=shape)


def _matrix(rows: Rows, ties: _Ties | None, extra: np.ndarray) -> sparse.csc_array:
    """J^T J, and what is known of landmarks (L, 2, 2).

    Places of which nothing is known stay; all else is held by no more than rounding takes.
    """
    steps, size = len(rows.at), 3 * len(rows.at) + 2 * len(extra)
    pose, place = 3 * np.arange(steps), 3 * steps + 2 * np.arange(len(extra))
    t, m = np.nonzero(np.any(rows.by_place != 0.0, axis=(2, 3)))
    feature = 3 * steps + 2 * np.arange(len(t))
    parts = [
        (pose, pose, rows.by_motion),
        (pose[1:], pose[:-1], -(rows.by_motion @ rows.transition)[1:]),
        (feature, pose[t], rows.by_pose[t, m]),
        (feature, place[rows.at[t, m]], rows.by_place[t, m]),
    ]
    height = 3 * steps + 2 * len(t)
    if ties is not None:
        at = height + 3 * np.arange(len(ties.residual))
        parts += [(at, 3 * k, by) for k, by in zip(ties.at, ties.by_pose, strict=True)]
        height += ties.residual.size
    jacobian = _assembled(parts, (height, size))
    matrix = jacobian.T @ jacobian + _assembled([(place, place, extra)], (size, size))
    known = matrix.diagonal()
    held = np.where(known > 0.0, 4 * np.finfo(float).eps * known, 1.0)
    return (matrix + sparse.diags_array(held)).tocsc()


def smooth(
    records: Records,
    poses: Array,
    places: Array,
    *,
    closures: Closures | None = None,
    doubt: float = DOUBT,
    iterations: int = 50,
) -> Track:
    """Most likely poses and places of one run, from a guess, as `smoother.smooth` finds them.

        minimise  sum_t |x_t (-) x_t-1 - u_t|^2_Q + sum_tm rho(|z_tm - h(x_t, l_which)|_R) + prior

    with Cauchy's rho(e) = c^2 log(1 + e^2 / c^2), of closures too, by Gauss-Newton with these
    weights, which is ended once the cost hardly falls. Runs on the host. To use one program for
    runs of many lengths, pad them.

    Args:
        records: What the robot was told; arrays of either precision.
        poses: (T, 3) guess, world frame.
        places: (L, 2) guess.
        closures: Pairs of poses that scans tie to each other; they are doubted as features are.
        doubt: c [std]; infinite to believe all.
        iterations: At most.

    Returns:
        The smoothed run, NumPy, float64; the guess, if the cost of that is not finite.

    Raises:
        ValueError: An argument has another shape or type, or `doubt` is not positive.
    """
    if not doubt > 0.0:
        raise ValueError(f"doubt is {doubt}, not a positive number of standard deviations")
    real = lambda x: np.asarray(x, np.float64 if np.asarray(x).dtype.kind == "f" else None)
    records, state = jax.tree.map(real, (records, (poses, places)))
    smoother.check(records, *state)
    size = len(state[1])
    extra = np.zeros((size, 2, 2)) if records.prior is None else records.prior.information
    limit = np.float64(min(doubt, 1e9))  # from which the logarithm is a square
    with jax.enable_x64(True):
        own = _prepared(records, size)

        def evaluate(state: State) -> tuple[np.ndarray, State, tuple[Rows, _Ties | None]]:
            cost, slope, rows = jax.tree.map(np.asarray, _evaluate(own, state, limit))
            if closures is None:
                return cost, slope, (rows, None)
            more, by_pose, ties = _doubted(closures, state[0], slope[0], limit)
            return cost + more, (by_pose, slope[1]), (rows, ties)

        cost, slope, rows = evaluate(state)
        costs = [float(cost)]
        for _ in range(iterations if np.isfinite(cost) else 0):
            right = np.concatenate([-np.ravel(x) for x in slope])
            how = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}}
            step = splu(_matrix(*rows, extra), diag_pivot_thresh=0.0, **how).solve(right)
            step = step[: state[0].size].reshape(-1, 3), step[state[0].size :].reshape(-1, 2)
            for part in 0.5 ** np.arange(HALVINGS + 1):
                new = tuple(x + part * dx for x, dx in zip(state, step, strict=True))
                found = evaluate(new)
                if found[0] <= cost:
                    break
            else:
                break
            fallen, state, (cost, slope, rows) = cost - found[0], new, found
            costs.append(float(cost))
            if fallen <= SETTLED * cost:
                break
        poses, places = jax.tree.map(np.asarray, _wrapped(own, state))
    return Track(poses, places, np.array(costs))
